//! Opens, initialises and re-opens connections and ports outside the loop, and keeps those of sessions.
//!
//! | file | what |
//! |---|---|
//! | `peer` | where a connection leads, and whose handshake or session it has |
//! | `connection` | one connection's life, without a socket or a clock |
//! | `words` | why a connection is not open |
//! | `thread` | the thread that runs this life for all connections and ports of a master |
//! | `connections` | the sockets of one carrier on that thread |
//! | `port` | a serial port on that thread |
//! | `pending` | whether that thread has to be woken |

pub mod connection;
mod connections;
mod peer;
mod pending;
mod port;
mod thread;
mod words;

pub use connection::{Action, Connection};
pub(super) use connections::{Ends, GivenBack, Opened};
#[cfg(test)]
pub(super) use connections::{REPEATED_US, TCP_RTO_MIN_US};
pub use peer::{Peer, Target};
pub(super) use port::PortEnds;
pub use port::PortLife;
pub(crate) use port::local_address;
pub(super) use thread::LinkThread;

#[cfg(test)]
pub(super) mod tests;
