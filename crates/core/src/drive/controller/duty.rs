//! What an axis is about: who owns its drive, whether it is stopped, and which command runs.
//!
//! Each of them changes rarely, and is consulted several times in each cycle. What follows from them together is
//! therefore computed when one of them changes, here and nowhere else.

use std::mem::offset_of;

use crate::axis::command::NativeOwner;
use crate::axis::{Command, QueuedCommand, StopCause};
use crate::drive::stop::StopSequence;

/// Who owns the drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Claim {
    /// Only read so far: not ours to brake or to power off.
    #[default]
    Found,
    /// Something was requested of it.
    Ours,
    /// Enabled: it is expected to stay in operation.
    Armed,
}

/// Whether the axis is stopped, and why.
#[derive(Clone, Copy, Debug, Default)]
pub(super) enum Latch {
    #[default]
    Open,
    /// Nothing was requested of the drive: it was not ours.
    Kept(StopCause),
    /// In the stop sequence, or at its end.
    Down(StopCause, StopSequence),
}

impl Latch {
    pub(super) fn is_open(&self) -> bool {
        matches!(self, Latch::Open)
    }

    pub(super) fn cause(&self) -> Option<StopCause> {
        match self {
            Latch::Open => None,
            Latch::Kept(cause) | Latch::Down(cause, _) => Some(*cause),
        }
    }

    /// Nothing is under way.
    pub(super) fn is_settled(&self) -> bool {
        match self {
            Latch::Open | Latch::Kept(_) => true,
            Latch::Down(_, sequence) => sequence.is_down(),
        }
    }
}

/// All of it; by default a drive was found, and nothing is done.
#[derive(Debug, Default)]
#[repr(C)]
pub(super) struct Duty {
    follows: Follows,
    claim: Claim,
    /// The newest command of the drive machine follows torques: no position leads the drive, and its reported demand is
    /// meaningless.
    under_torque: bool,
    latch: Latch,
    active: Option<QueuedCommand>,
}

/// The consequences of a duty. Keeping them saves 205 instructions a drive and cycle in motion, and 48 at rest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Follows {
    /// The source of the setpoints.
    pub lead: Lead,
    /// A stop runs: that of the application, or the stop sequence.
    pub stops: bool,
    /// The application owns its control word.
    pub is_free: bool,
    /// It runs a stream of rows.
    pub rows: bool,
    /// The command that runs, as [`Command::code`]; 0 = none.
    pub command: u8,
}

/// The source of an axis's setpoints.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Lead {
    /// The loop: it is enabled, nothing stops it, and a motion runs that is no homing and no torque.
    Loop,
    /// Nothing: it is enabled, nothing stops it, and no command runs.
    Nothing,
    /// Something else, or that is not to be seen from its duty alone.
    #[default]
    Else,
}

impl Duty {
    /// Up to here it is read in each cycle.
    pub(super) const USUAL: usize = offset_of!(Duty, latch);

    pub(super) fn follows(&self) -> Follows {
        self.follows
    }

    pub(super) fn claim(&self) -> Claim {
        self.claim
    }

    pub(super) fn is_under_torque(&self) -> bool {
        self.under_torque
    }

    pub(super) fn latch(&self) -> &Latch {
        &self.latch
    }

    /// The running command.
    pub(super) fn active(&self) -> &Option<QueuedCommand> {
        &self.active
    }

    /// The command of this duty.
    pub(super) fn command(&self) -> Option<&Command> {
        self.active.as_ref().map(|active| &active.command)
    }

    /// The cause and the sequence of the stop.
    pub(super) fn sequence(&mut self) -> Option<(StopCause, &mut StopSequence)> {
        if let Latch::Down(cause, sequence) = &mut self.latch { Some((*cause, sequence)) } else { None }
    }

    pub(super) fn set_claim(&mut self, claim: Claim) {
        self.claim = claim;
        self.note();
    }

    pub(super) fn set_latch(&mut self, latch: Latch) {
        self.latch = latch;
        self.note();
    }

    pub(super) fn set_active(&mut self, active: Option<QueuedCommand>) {
        self.active = active;
        self.note();
    }

    /// The newest command of the drive machine; it need not be that of the application.
    pub(super) fn set_ordered(&mut self, command: Option<Command>) {
        self.under_torque = command.is_some_and(|command| command.takes_torques());
        self.note();
    }

    fn note(&mut self) {
        let command = self.command();
        let lead = match command {
            _ if self.claim != Claim::Armed || !self.latch.is_open() || self.under_torque => Lead::Else,
            Some(Command::Move(_) | Command::Jog(_) | Command::Velocity { .. } | Command::Follow) => {
                Lead::Loop
            }
            None => Lead::Nothing,
            Some(_) => Lead::Else,
        };
        self.follows = Follows {
            lead,
            stops: command.is_some_and(Command::is_stop) || matches!(self.latch, Latch::Down(..)),
            is_free: command == Some(&Command::Native(NativeOwner::Application)),
            rows: command == Some(&Command::Follow),
            command: command.map_or(0, Command::code),
        };
    }
}
