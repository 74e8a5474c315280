//! A motion command: family, fields, when it moves, and the quantity that the controller holds then.

use super::super::codec::Motion;
use super::super::codec::commands::{FIELDS, layout, values, width};
use super::super::demand::When;
use super::NEWTON_PER_AMPERE;
use fieldbeat_core::time::Time;

/// The result of a motion command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Taken {
    /// Run, refused or ignored.
    Done,
    /// The firmware restarts.
    Restart,
}

/// The quantity that the controller holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Effort {
    /// The position.
    Position,
    /// The position, with at most this force, N.
    Pressing(f64),
    /// The current, for this force, N.
    Current(f64),
}

/// A command as the drive reads it: its family, its number in that, and its fields.
#[derive(Clone, Copy, Debug)]
pub(super) struct Command {
    /// No family has this number if the drive does not know the command.
    pub family: u16,
    pub sub: u16,
    layout: &'static str,
    parameters: [u8; 30],
}

impl Command {
    pub(super) fn of(motion: Motion) -> Command {
        let (id, layout) = (motion.id(), layout(motion.id()));
        let family = layout.map_or(u16::MAX, |_| id >> 4);
        Command { family, sub: id & 0xF, layout: layout.unwrap_or_default(), parameters: motion.parameters }
    }

    /// The numbers in its fields. Some may be out of their range, since a drive has to take what comes.
    pub(super) fn values(&self) -> [i64; FIELDS] {
        values(self.layout, &self.parameters)
    }

    /// The numbers in the fields with one of these letters.
    pub(super) fn fields(&self, letters: [char; 2]) -> impl Iterator<Item = i64> {
        let fields = self.layout.chars().zip(self.values());
        fields.filter(move |(letter, _)| letters.contains(letter)).map(|(_, value)| value)
    }

    /// The bytes that it writes into a curve or an entry: those behind its id and the offset.
    pub(super) fn written(&self) -> &[u8] {
        let size: usize = self.layout.chars().map(width).sum();
        self.parameters.get(4..size).unwrap_or_default()
    }

    /// When it begins to move to a position, if it does. Positions mean nothing before homing.
    pub(super) fn moves(&self) -> Option<When> {
        Some(match (self.family, self.sub) {
            // Stops, and another profile for the motion that runs.
            (0x01 | 0x02 | 0x09 | 0x0A, 0x7) | (0x01 | 0x09, 0xE | 0xF) => return None,
            (0x01 | 0x02 | 0x09..=0x0F, 0xA..=0xD) => When::Trigger,
            (0x04, 0x6 | 0x7 | 0xA | 0xC | 0xE | 0xF) => When::Trigger,
            (0x01 | 0x02 | 0x09..=0x0F, 0x8) => When::AfterActual,
            (0x01 | 0x02 | 0x04 | 0x09..=0x0F | 0x3A, _) | (0x03, 0x0..=0x5) => When::Now,
            _ => return None,
        })
    }

    /// The quantity that the controller holds from now on, if the command starts another motion at once.
    pub(super) fn effort(&self) -> Option<Effort> {
        let force = |milliamperes: i64| milliamperes as f64 / 1e3 * NEWTON_PER_AMPERE;
        match (self.family, self.sub) {
            (0x0C, 0x5..=0x7) => Some(Effort::Pressing(force(self.values()[3]))),
            (0x39, 0x0) => Some(Effort::Current(force(self.values()[0]))),
            (0x00, 0x9) | (0x01 | 0x02 | 0x09 | 0x0A, 0x7) | (0x39, 0xF) => Some(Effort::Position),
            _ => self.moves().filter(|when| *when == When::Now).map(|_| Effort::Position),
        }
    }
}

/// The position in the table.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sequence {
    pub entry: u16,
    /// The command that waits, and until when if it waits for a time; `None`: it is still to run.
    pub waiting: Option<(Command, Time)>,
}
