//! A recorded run, repeated bit by bit.
//!
//! The loop logs all that it takes from outside; its inputs say where, each of them. A recording keeps the log
//! ([`Recorder::with_wire`](fieldbeat_record::recording::Recorder::with_wire)), and a machine in virtual time repeats the
//! run from it ([`Replay`]): the same loop makes the same telegrams, or the first difference is found. What happened in
//! the field becomes a test of a few lines.
//!
//! | file | what |
//! |---|---|
//! | `machine` | the machine that repeats a run |
//! | `difference` | the first difference, in words |
//! | `reader` | reads the log of them |

mod difference;
pub mod machine;
mod reader;

pub use self::difference::{Difference, Telegrams};
pub use self::machine::{Replay, Verdict};
pub use self::reader::{LogEnd, Recorded, ReplayError};
