//! What others make of our bytes on the wire, and we of theirs: Wireshark's dissectors, and where a protocol has them,
//! other implementations of it, each a program of its own. `.ci/run` installs them.
//!
//!     cargo test --test peers -- --ignored --test-threads 1
//!
//! Each test owns 127.x.n.0/24, by the number n of its machine, which is unique in all of these files.

mod capture;
mod captures;
mod dashboard;
mod ethercat;
mod ethernet_ip;
mod linudp;
mod modbus;
mod peer;
mod profibus;
mod readers;
mod recordings;
mod schema;
#[path = "../support/mod.rs"]
mod support;
