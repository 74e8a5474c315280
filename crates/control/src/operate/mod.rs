//! Axes of a running master that are operated from elsewhere: a panel in a terminal, a page in a browser.
//!
//! | file | what |
//! |---|---|
//! | `request` | what an operator and a master say to each other |
//! | `operated` | one axis under an operator |
//! | `operation` | who operates, and for how long: the rules |
//! | `station` | the axes of a master under these rules, on the machine's clock; sessions of clients |
//! | `operator` | the client's side |

mod operated;
mod operation;
mod operator;
mod request;
mod station;
#[cfg(test)]
mod tests;

pub use operated::Operated;
pub use operation::{HOLD_LIMIT, OPERATOR_LIMIT, Operation};
pub use operator::{HOLD_EVERY, OperateError, Operator};
pub use request::{
    Act, AxisFacts, AxisLacks, AxisState, CommandEnd, Ended, Goal, Notice, OperationState, Order, Reply,
    Request,
};
pub use station::{OperatorSession, Station, answer, urgency};
