//! The drive's software: restart, stop and start, and resetting parameters to their defaults.

use std::time::Duration;

use super::{FLASH, SLOW, ServiceError, Services, describe};
use crate::UNACKNOWLEDGED;
use crate::upid::call;
use crate::wire::{Refusal, RtcCommand};
use fieldbeat_core::axis::acyclic::Call;

/// For so long, starting the drive's software is retried. The drive may be silent at first: it has always answered
/// after [`FLASH`], by which a lost save has failed.
const PATIENCE: Duration = Duration::from_secs(60);

/// A part of a drive's parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Part {
    /// Operating system (UPIDs 0xxxh).
    Os = RtcCommand::DEFAULT_OS.0,
    /// Motion control (1xxxh).
    MotionControl = RtcCommand::DEFAULT_MC.0,
    /// Interface (2xxxh), its addresses included.
    Interface = RtcCommand::DEFAULT_INTERFACE.0,
    /// Application (3xxxh).
    Application = RtcCommand::DEFAULT_APPLICATION.0,
}

impl Part {
    /// Each part, with its name.
    pub const WORDS: [(&'static str, Part); 4] = [
        ("os", Part::Os),
        ("mc", Part::MotionControl),
        ("interface", Part::Interface),
        ("application", Part::Application),
    ];

    /// The command that resets it.
    fn command(self) -> RtcCommand {
        RtcCommand(self as u8)
    }
}

/// How a save to flash ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Saved {
    /// The drive acknowledged it.
    Acknowledged,
    /// The drive became silent and came back without an acknowledge, as some drives do: a restart and a check show
    /// the result.
    Silently,
}

impl Services<'_> {
    /// Saves with this command, with the software stopped meanwhile.
    pub(super) fn save(&self, command: RtcCommand) -> Result<Saved, ServiceError> {
        let answer = self.with_software_stopped(|| self.command(call(command, 0, 0), FLASH))?;
        Ok(if answer.status == UNACKNOWLEDGED { Saved::Silently } else { Saved::Acknowledged })
    }

    /// Restarts the drive. Its link drops, values that are in RAM only are lost, and it has to be homed again.
    pub fn restart(&self) -> Result<(), ServiceError> {
        self.require_off("a restart")?;
        self.command(call(RtcCommand::RESTART, 0, 0), SLOW).map(drop)
    }

    /// Stops motion control and application software: flash can be written then.
    pub fn stop_software(&self) -> Result<(), ServiceError> {
        self.require_off("stopping its software")?;
        self.command(call(RtcCommand::STOP_SOFTWARE, 0, 0), SLOW).map(drop)
    }

    /// Starts them again. The drive has to be homed again.
    pub fn start_software(&self) -> Result<(), ServiceError> {
        self.command(call(RtcCommand::START_SOFTWARE, 0, 0), SLOW).map(drop)
    }

    /// Resets `part` of the parameters in ROM to defaults, with the software stopped meanwhile. Takes effect after
    /// a restart.
    pub fn reset_to_default(&self, part: Part) -> Result<(), ServiceError> {
        self.with_software_stopped(|| self.command(call(part.command(), 0, 0), FLASH).map(drop))
    }

    /// Does `what` while the software is stopped, and starts it again whatever the result, and even if the caller
    /// disappears. Software that was stopped before stays stopped: that is intended.
    pub(super) fn with_software_stopped<T>(
        &self,
        what: impl Fn() -> Result<T, ServiceError>,
    ) -> Result<T, ServiceError> {
        if self.off("stopping its software")?.not_ready {
            match what() {
                // It was only starting up.
                Err(error) if error.refusal() == Some(Refusal::SoftwareRuns) => {}
                done => return done,
            }
        }
        let start = call(RtcCommand::START_SOFTWARE, 0, 0);
        self.bequeath(&[start])?;
        let done = match self.stop_software() {
            Ok(()) => what(),
            Err(error) if error.refusal().is_some() => {
                self.bequeath(&[])?;
                return Err(error);
            }
            // Its answer may be lost, and the software stopped.
            Err(error) => Err(error),
        };
        if let Err(error) = self.carrier.insist(start, SLOW, PATIENCE) {
            let start = Box::new(self.failed(describe(Some(&start)), error));
            return Err(ServiceError::Stopped { failed: done.err().map(Box::new), start });
        }
        let taken_back = self.bequeath(&[]);
        let done = done?;
        taken_back.map(|()| done)
    }

    fn bequeath(&self, calls: &[Call]) -> Result<(), ServiceError> {
        self.carrier.bequeath(calls).map_err(|error| self.failed(describe(calls.first()), error))
    }
}
