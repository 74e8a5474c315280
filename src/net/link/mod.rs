//! Opens, initialises and re-opens connections, outside the loop.
//!
//! | file | what |
//! |---|---|
//! | `connection` | one connection's life, without a socket or a clock |
//! | `thread` | the thread that runs this life for all connections of a master |

pub mod connection;
mod thread;

pub use connection::{Action, Connection};
pub(super) use thread::{Ends, GivenBack, LinkThread, Opened};
#[cfg(test)]
pub(super) use thread::{REPEATED_US, TCP_RTO_MIN_US};

#[cfg(test)]
pub(super) mod tests;
