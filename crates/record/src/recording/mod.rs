//! Recordings: every cycle of every axis, commands, events and the causes of late cycles in a file that Foxglove,
//! PlotJuggler and Rerun open: MCAP with messages in Protocol Buffers, described in the file itself.
//!
//! | file | what |
//! |---|---|
//! | `recorder` | what is recorded, and where to |
//! | `whole` | the whole run |
//! | `newest` | what is newest, and when it is to be written: of a window, and of the black box |
//! | `window` | what is newest, written when something fails |
//! | `machine` | what a file says of its machine |
//! | `messages` | the fields of each topic |
//! | `native` | native process data, which come in parts |
//! | `schema` | messages as bytes, and their description |
//! | `writer` | records as messages |
//! | `container`, `lz4` | the file, and its compression |
//! | `wire` | the log of the loop in it, for a replay |
//! | `recent` | the end of that log, for a capture of a black box |
//! | `reading` | a file, whichever version wrote it |
//! | `csv` | the same for spreadsheets |
//!
//! A normal thread of its own writes it, fed like every other reader of the loop's records: the loop pays nothing for
//! it. A disk that is too slow, or full, costs records, which are counted, and makes the run a failure.

mod container;
pub mod csv;
pub(crate) mod lz4;
pub mod machine;
mod messages;
mod native;
pub(crate) mod newest;
pub mod reading;
pub mod recent;
mod recorder;
mod schema;
mod whole;
mod window;
mod wire;
pub mod writer;

pub use self::recorder::{RecordError, Recorder};

#[cfg(test)]
mod tests;
