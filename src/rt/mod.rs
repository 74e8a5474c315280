//! The operating system, as far as real time needs it.
//!
//! | file | what |
//! |---|---|
//! | `clock` | now, absolute sleep, wait for descriptors; the seam to virtual time |

pub mod clock;

pub use clock::{Clock, MonotonicClock};

/// How badly real-time scheduling is wanted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Realtime {
    /// Refuse to start without SCHED_FIFO and locked memory.
    Require,
    /// Take what can be had and say clearly what could not.
    #[default]
    Prefer,
    /// An ordinary thread, on purpose.
    Off,
}

/// What memory is locked against paging.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Memory {
    /// All of the process, now and in future (`mlockall`).
    #[default]
    Process,
    /// Only what the loop touches; for a master inside a large host program.
    Own,
}
