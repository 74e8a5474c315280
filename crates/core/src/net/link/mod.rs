//! Opens, initialises and re-opens connections and ports outside the loop, and keeps those of sessions.
//!
//! | file | what |
//! |---|---|
//! | `connection` | one connection's life, without a socket or a clock |
//! | `words` | why a connection is not open |
//! | `thread` | the thread that runs this life for all connections and ports of a master |
//! | `connections` | the sockets and ports of one carrier on that thread |

pub mod connection;
mod connections;
mod thread;
mod words;

pub use connection::{Action, Connection};
pub use connections::local_address;
pub(super) use connections::{Ends, GivenBack, Opened};
#[cfg(test)]
pub(super) use connections::{REPEATED_US, TCP_RTO_MIN_US};
pub(super) use thread::LinkThread;

#[cfg(test)]
pub mod tests;
