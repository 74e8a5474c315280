//! A running machine in a browser: a page, and the samples of all cycles over a websocket. Normal threads only; the
//! loop knows nothing of it, and the telemetry thread waits for none of it.
//!
//! | file | what |
//! |---|---|
//! | `server` | the listener, its limits, and what it answers |
//! | `rules` | who is let in |
//! | `assets` | the files of the page, built in |
//! | `feed` | attaches to a master, and attaches again |
//! | `signals` | what can be shown of a cycle |
//! | `samples` | the records of cycles as columns of signals |
//! | `operate` | commands of one browser, where they are allowed |
//! | `client` | one browser: what it shows, and how much it is let send |
//! | `frame` | samples in binary, each one or as an envelope |

mod assets;
mod client;
mod feed;
mod frame;
mod operate;
mod rules;
mod samples;
mod server;
mod signals;

pub use feed::{Control, Source};
pub use server::{Endpoint, ScopeError, Server};
