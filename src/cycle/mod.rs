//! The loop.
//!
//! | file | what |
//! |---|---|
//! | `plan` | the cycle as configured |

pub mod plan;

pub use plan::{CyclePlan, Guard, Overrun, Plan, Wait};
