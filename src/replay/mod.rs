//! A recorded run, repeated bit by bit.
//!
//! The loop logs all that it takes from outside; its inputs say where, each of them. A recording keeps the log
//! ([`Recorder::with_wire`](crate::telemetry::recording::Recorder::with_wire)), and a machine in virtual time repeats the
//! run from it ([`Replay`]): the same loop makes the same telegrams, or the first difference is found. What happened in
//! the field becomes a test of a few lines.
//!
//! | file | what |
//! |---|---|
//! | `machine` | the machine that repeats a run |
//! | `difference` | the first difference, in words |
//! | `layout` | where the log is in a recording, and what describes its machine |
//! | `records` | the records of a recording, as far as they are sound |
//! | `reader` | reads the log of them |

mod difference;
#[cfg(any(feature = "record", feature = "replay"))]
pub(crate) mod layout;
pub(crate) mod machine;
#[cfg(feature = "replay")]
mod reader;
#[cfg(any(feature = "record", feature = "replay"))]
pub(crate) mod records;

pub use self::difference::{Difference, Telegrams};
pub use self::machine::{Replay, Verdict};
#[cfg(feature = "replay")]
pub use self::reader::{LogEnd, Recorded, ReplayError};
