//! A motion command: its id and its parameters, and the block that it makes.

use super::stream::StreamCommand;
use super::values::{Acceleration, Position, SignedAcceleration, SignedVelocity};
use crate::wire::MotionBlock;

/// A motion command without its count: 12 bits of master and sub id, and the parameters. A constructor each for all
/// that are in the `CATALOGUE`; what is newer than that is written as it stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionCommand {
    /// Master id (bits 11-4) and sub id (3-0): `0x010` is "VAI go to position".
    pub id: u16,
    /// The parameters, little-endian, unused bytes 0.
    pub parameters: [u8; 30],
}

impl MotionCommand {
    /// The command `id`, all parameters 0.
    pub const fn new(id: u16) -> MotionCommand {
        MotionCommand { id, parameters: [0; 30] }
    }

    /// It is "VAI stop", whatever its deceleration.
    #[inline]
    pub const fn is_stop(&self) -> bool {
        self.id == MotionCommand::vai_stop(Acceleration(0)).id
    }

    /// The header word with this command count, 0 ... 15.
    #[inline]
    pub const fn header(&self, count: u8) -> u16 {
        self.id << 4 | (count & 0xF) as u16
    }

    /// The block to send with this command count, 0 ... 15.
    #[inline]
    pub const fn block(&self, count: u8) -> MotionBlock {
        MotionBlock { header: self.header(count), parameters: self.parameters }
    }

    /// 030x ... 035x: one streamed setpoint. What `command` does not carry is left out.
    #[inline]
    pub const fn stream(
        command: StreamCommand,
        position: Position,
        velocity: SignedVelocity,
        acceleration: SignedAcceleration,
    ) -> MotionCommand {
        let row = match (command.has_velocity(), command.has_acceleration()) {
            (false, _) => MotionCommand::stream_p(position),
            (true, false) => MotionCommand::stream_pv(position, velocity),
            (true, true) => MotionCommand::stream_pva(position, velocity, acceleration),
        };
        MotionCommand { id: command.id(), ..row }
    }

    /// With a field of `size` bytes at `at`.
    #[inline]
    pub(super) const fn with(mut self, at: usize, wire: u32, size: usize) -> MotionCommand {
        let bytes = wire.to_le_bytes();
        let mut index = 0;
        while index < size {
            self.parameters[at + index] = bytes[index];
            index += 1;
        }
        self
    }
}
