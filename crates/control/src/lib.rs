//! The control socket of a running master: a Unix socket in a directory of its owner, which answers requests of
//! other processes. One JSON object a line, each way. Normal threads only; the loop knows nothing of it.
//!
//! | file | what |
//! |---|---|
//! | `place` | where the sockets are, and who may own them |
//! | `server` | the master's side |
//! | `client` | the client's side |
//! | `session`, `remote` | acyclic access to the drives of a running master: its side, and that of another process |
//! | `watch` | the records of all cycles of a running master, as they are made |
//! | `operate` | the axes of a running master, operated from elsewhere |
//! | `protocol` | one line each way, within a time that the other side cannot extend |

mod client;
mod operate;
pub mod place;
mod protocol;
mod remote;
mod server;
mod session;
mod watch;

pub use client::{AskError, Conversation, ask};
pub use operate::{
    Act, AxisFacts, AxisLacks, AxisState, CommandEnd, Ended, Goal, HOLD_EVERY, HOLD_LIMIT, Notice,
    OPERATOR_LIMIT, OperateError, Operated, Operation, OperationState, Operator, OperatorSession, Order,
    Reply, Request, Station,
};
pub use operate::{answer as answer_operator, urgency as operator_urgency};
pub use remote::Remote;
pub use server::{Answering, Sender, ServeError, Server, Urgency};
pub use session::{Legacies, Session};
pub use watch::{About, Happened, Late, NEWS_EVERY, News, Part, Watch, Watched};
