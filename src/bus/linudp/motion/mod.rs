//! Motion commands: what a motion block says.
//!
//! Knows no state: whether a drive takes a command, and what its count should be, is the business of station and sim.
//!
//! | file | what |
//! |---|---|
//! | `values` | positions, velocities, ids ...: a type each, over its wire integer; units and ranges |
//! | `commands` | a command, and the list of all of them, from which constructors and catalogue are made |
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
mod commands;
mod values;

pub use catalogue::{CommandInfo, FIELDS, Field, Mark};
pub use commands::{CATALOGUE, MotionCommand};
pub use values::*;

use super::plan::StreamCommand;

impl StreamCommand {
    /// Master and sub id.
    pub const fn id(self) -> u16 {
        self as u16
    }

    /// The command of this id.
    pub fn from_id(id: u16) -> Option<StreamCommand> {
        StreamCommand::ALL.into_iter().find(|command| command.id() == id)
    }

    /// Setpoints carry a velocity.
    pub const fn has_velocity(self) -> bool {
        !matches!(self, StreamCommand::P | StreamCommand::PConfigured)
    }

    /// Setpoints carry an acceleration.
    pub const fn has_acceleration(self) -> bool {
        matches!(self, StreamCommand::Pva | StreamCommand::PvaConfigured)
    }

    /// The time base is the period configured in the drive (UPID 14E6h), not the instant at which it receives.
    pub const fn has_configured_period(self) -> bool {
        matches!(
            self,
            StreamCommand::PConfigured | StreamCommand::PvConfigured | StreamCommand::PvaConfigured
        )
    }
}

#[cfg(test)]
mod golden;
#[cfg(test)]
mod tests;
