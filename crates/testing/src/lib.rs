//! What the tests of several packages share. Nothing here is part of a program.

mod pty;
pub mod runs;

use std::time::{Duration, Instant};

pub use pty::Pty;

/// Nothing takes this long, however busy the host.
const LONG: Duration = Duration::from_secs(60);

/// Waits until it is `done`. Panics, with `what` did not happen, if that takes longer than any host does.
pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !done() {
        assert!(begun.elapsed() < LONG, "still not: {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}
