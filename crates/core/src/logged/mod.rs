//! The clock and the carriers of a loop with a log of its inputs: those of a recorded run, which are others with the
//! log around them, and those of a repeated one, which read it.
//!
//! | file | what |
//! |---|---|
//! | `clock` | both clocks |
//! | `recorded` | the carriers of a recorded run |
//! | `link` | what passes connections while the link thread has them |
//! | `replayed` | those of a repeated one |
//! | `codes` | results of carriers as words |

mod clock;
mod codes;
mod link;
mod recorded;
mod replayed;

pub use self::clock::{LoggedClock, ReplayClock};
pub use self::link::{LinkEvent, LinkPassed, LinkTap};
pub use self::recorded::LoggedCarriers;
pub use self::replayed::ReplayCarriers;
