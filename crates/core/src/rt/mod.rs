//! The operating system, as far as real time needs it.
//!
//! | file | what |
//! |---|---|
//! | `child` | a process of its own that outlives this one |
//! | `clock` | now, absolute sleep, wait for descriptors; the seam to virtual time |
//! | `confine` | what a thread gives up once it needs it no longer |
//! | `guard` | how long before a grid point the loop wakes to spin up to it |
//! | `held` | values that threads share, and that another process can share as well |
//! | `host` | facts about this host, for the summary |
//! | `mapping` | memory that outlives its process, or that another process gets |
//! | `memory` | memory that is present before the loop starts and locked while it runs |
//! | `rights` | limits and capabilities, and the messages for those that are missing |
//! | `thread` | what the loop's thread does to itself at the start |
//! | `usage` | page faults and context switches of a thread |
//! | `watch` | run time, run delay, faults and steal of another thread |
//! | `wires` | who may use the wires: the loop, or who has taken them from it |

pub mod child;
pub mod clock;
pub mod confine;
pub mod guard;
mod held;
pub mod host;
pub mod mapping;
pub mod memory;
pub mod rights;
#[cfg(test)]
pub mod testing;
pub mod thread;
pub mod usage;
pub mod watch;
mod wires;

pub use clock::{Clock, MonotonicClock, PollSet};
pub use guard::GuardTuner;
pub use held::{Held, Plain};
pub use mapping::Mapping;
pub use memory::{Regions, deque, ring};
pub use rights::Denied;
pub use thread::{Granted, RealtimeError, RealtimePlan};
pub use usage::Usage;
pub use wires::{Taker, Wires, Words};

// SAFETY: atomic numbers in the layout of C.
unsafe impl Plain for Words {}

/// Whether real-time scheduling is required.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Realtime {
    /// Refuse to start without SCHED_FIFO and locked memory.
    Require,
    /// Use what is available and report clearly what is not.
    #[default]
    Prefer,
    /// An ordinary thread, on purpose.
    Off,
}

/// Which memory is locked against paging.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Memory {
    /// All of the process, now and in future (`mlockall`).
    #[default]
    Process,
    /// Only what the loop touches; for a master inside a large host program.
    Own,
}
