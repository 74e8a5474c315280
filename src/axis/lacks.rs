//! What a drive does not do, whatever its state: a command for it is refused on submission.

use super::command::{Command, Failure};

/// Why a drive does not do something, with the remedy; `None`: it does.
pub type Cannot = Option<&'static str>;

/// What a drive does not do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lacks {
    /// Be commanded at all.
    pub control: Cannot,
    /// Be enabled.
    pub enable: Cannot,
    /// Moves.
    pub moves: Cannot,
    /// Rows of a stream.
    pub rows: Cannot,
    /// Velocities and jogs.
    pub velocities: Cannot,
    /// Torques.
    pub torques: Cannot,
    /// Homing.
    pub homing: Cannot,
}

impl Lacks {
    /// Why this drive cannot do that, in any state.
    pub fn refuses(&self, command: &Command) -> Option<Failure> {
        let why = match command {
            Command::Reset => None,
            _ if self.control.is_some() => self.control,
            Command::Enable => self.enable,
            Command::Move(_) => self.moves,
            Command::Follow => self.rows,
            Command::Jog(_) | Command::Velocity { .. } => self.velocities,
            Command::Torque { .. } => self.torques,
            Command::Home => self.homing,
            _ => None,
        };
        why.map(Failure::Unsupported)
    }
}
