//! The drive's memories, and how values get into flash.
//!
//! Knows no wire block and no motion. Curves and command table have a copy in RAM, which runs, and one in flash,
//! which a restart loads.

use super::log::ErrorLog;
use super::parameters::Parameters;
use super::settings::{FlashMode, LinMotSettings};
use super::store::Store;
use fieldbeat_core::time::Time;

/// Writing one parameter takes this share of the time of a whole save. Masters in the field saw saves of 40 s and
/// more, and of a single parameter that it "may stall the interface briefly".
const PARAMETER_SHARE: u64 = 500;

/// Content that is written into flash.
#[derive(Clone, Copy, Debug)]
pub(super) enum Save {
    Curves,
    Table,
    /// A UPID and its value, which was checked before.
    Parameter(u16, u32),
    /// The parameters of one part of the software to their defaults: the highest digit of their UPIDs.
    Defaults(u16),
}

/// All memories of the drive.
#[derive(Debug)]
pub(super) struct Memory {
    pub parameters: Parameters,
    pub log: ErrorLog,
    pub curves: Store,
    pub table: Store,
    /// The content that is being written, and when that is complete.
    saving: Option<(Save, Time)>,
    save_ns: u64,
    mode: FlashMode,
}

impl Memory {
    pub(super) fn new(plan: &LinMotSettings) -> Memory {
        Memory {
            parameters: Parameters::new(plan),
            log: ErrorLog::default(),
            curves: Store::curves(),
            table: Store::table(),
            saving: None,
            save_ns: plan.flash_time_ns,
            mode: plan.flash,
        }
    }

    /// Begins to write into flash.
    pub(super) fn save(&mut self, what: Save, now: Time) {
        let duration_ns = match what {
            Save::Parameter(..) => self.save_ns / PARAMETER_SHARE,
            _ => self.save_ns,
        };
        self.saving = Some((what, now + duration_ns));
        self.advance(now);
    }

    /// Ends the writing if its time has come.
    pub(super) fn advance(&mut self, now: Time) {
        let Some((what, _)) = self.saving.take_if(|(_, until)| *until <= now) else { return };
        match what {
            Save::Curves => self.curves.save(),
            Save::Table => self.table.save(),
            Save::Parameter(upid, value) => {
                // Checked on reception, and the rules do not change.
                let _ = self.parameters.write_rom(upid, value);
            }
            Save::Defaults(part) => self.parameters.restore(part),
        }
    }

    /// Until when it writes; the drive is busy meanwhile.
    pub(super) fn saving_until(&self) -> Option<Time> {
        self.saving.map(|(_, until)| until)
    }

    /// Until when it answers nothing.
    pub(super) fn silent_until(&self) -> Option<Time> {
        self.saving_until().filter(|_| self.mode != FlashMode::Busy)
    }

    /// It begins to write without an acknowledge, then or later.
    pub(super) fn is_mute(&self) -> bool {
        self.saving.is_some() && self.mode == FlashMode::Mute
    }

    /// The drive restarts: RAM is loaded from flash. A save of curves or of the command table that this interrupts
    /// has erased the old ones already and leaves none; a parameter keeps its old value.
    pub(super) fn restart(&mut self) {
        match self.saving.take() {
            Some((Save::Curves, _)) => self.curves.erase(),
            Some((Save::Table, _)) => self.table.erase(),
            Some((Save::Parameter(..) | Save::Defaults(_), _)) | None => {}
        }
        self.parameters.load();
        self.curves.load();
        self.table.load();
    }
}
