//! The control socket of a running master: a Unix socket in a directory of its owner, which answers requests of
//! other processes. One JSON object a line, each way. Normal threads only; the loop knows nothing of it.
//!
//! | file | what |
//! |---|---|
//! | `place` | where the sockets are, and who may own them |
//! | `server` | the master's side |
//! | `client` | the client's side |
//! | `session`, `remote` | acyclic access to the drives of a running master: its side, and that of another process |
//! | `protocol` | one line each way, within a time that the other side cannot extend |

mod client;
pub(crate) mod place;
mod protocol;
mod remote;
mod server;
mod session;

pub use client::{AskError, Conversation, ask};
pub use remote::Remote;
pub use server::{Answering, ServeError, Server};
pub use session::Session;
