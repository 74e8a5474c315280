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
//!
//! ```
//! use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
//!
//! let ramp = Acceleration::from_mm_per_s2(1_000.0)?;
//! let velocity = Velocity::from_mm_per_s(200.0)?;
//! let command = MotionCommand::vai_go_to(Position::from_mm(120.5)?, velocity, ramp, ramp);
//! assert_eq!(command.header(1), 0x0101);
//! assert_eq!(command.parameters[..4], 1_205_000_i32.to_le_bytes());
//! # Ok::<(), fieldbeat::axis::RangeError>(())
//! ```

mod catalogue;
mod command;
mod commands;
pub(crate) mod stream;
mod values;

pub use catalogue::{CommandInfo, FIELDS, Field, Mark};
pub use command::MotionCommand;
pub use commands::CATALOGUE;
pub(crate) use stream::StreamCommand;
pub use values::*;

#[cfg(test)]
mod golden;
#[cfg(test)]
mod tests;
