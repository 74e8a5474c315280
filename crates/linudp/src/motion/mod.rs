//! Motion commands: what a motion block says.
//!
//! Knows no state: whether a drive takes a command, and what its count should be, is the business of station and sim.
//!
//! | file | what |
//! |---|---|
//! | `values` | positions, velocities, ids ...: a type each, over its wire integer; units and ranges |
//! | `command` | a command: its id, its parameters, its block |
//! | `commands` | the list of all of them, from which constructors and catalogue are made |
//! | `stream` | which streaming commands there are, and the periods that each takes |
//! | `catalogue` | what is known of a command, as data: name, marks, layout |
//!
//! A command is a header word, `id << 4 | count`, and up to 30 parameter bytes, unused ones 0. The drive runs a command
//! only if its count differs from the last one it stored (SG5 manual, motion command interface). Values are in wire
//! units; their types convert from user units, round, and check the range:

mod catalogue;
mod command;
mod commands;
#[doc(hidden)]
pub mod stream;
mod values;

pub use catalogue::{CommandInfo, FIELDS, Field, Mark};
pub use command::MotionCommand;
pub use commands::CATALOGUE;
pub(crate) use stream::StreamCommand;
pub use values::*;

#[cfg(test)]
mod tests;
