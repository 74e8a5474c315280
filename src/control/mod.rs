//! The control socket of a running master: a Unix socket in a directory of its owner, which answers questions from
//! other processes. One JSON object a line, each way. Normal threads only; the loop knows nothing of it.
//!
//! | file | what |
//! |---|---|
//! | `place` | where the sockets are, and whose they may be |
//! | `server` | the master's side |
//! | `client` | the asking side |
//! | `desk`, `remote` | acyclic access to the drives of a running master: its side, and that of another process |
//! | `talk` | a line each way, in a time that the other side cannot prolong |

mod client;
mod desk;
pub mod place;
mod remote;
mod server;
mod talk;

pub use client::{AskError, Conversation, ask};
pub use desk::Desk;
pub use remote::Remote;
pub use server::{Answering, ServeError, Server};
