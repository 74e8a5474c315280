//! The page of a running machine: who is let in, what browsers that mean no good get, and the page itself in a browser.
//! Real sockets on loopback, without privileges.
//!
//!     cargo test --features scope --test scope
//!
//! | file | what |
//! |---|---|
//! | `clients` | requests and browsers that mean no good, against a master in this process |
//! | `program` | `fieldbeat scope` and `--scope` as a user runs them |
//! | `browser` | the page in Chromium; `browser.cjs` drives it. Its trigger and cursors alone: `assets.mjs` |
//! | `socket` | a websocket client that does what no browser would |
//!
//! Each test owns 127.x.n.0/24, by the number n of its machine, which is unique in all of these files.

mod browser;
mod clients;
#[path = "../peers/peer.rs"]
#[allow(dead_code, reason = "a browser is no package of its own")]
mod peer;
mod program;
mod socket;
#[path = "../support/mod.rs"]
mod support;
