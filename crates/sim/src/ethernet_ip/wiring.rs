//! The inputs and outputs of the drive, as words.
//!
//! Facts: sheet, 5.2 and 5.5: an open input is 1, a closed output is 1.

use super::settings::MoonsMotorSettings;

/// The inputs with nothing wired, and outputs from there on.
const OPEN: u16 = 0xFF;
const OUTPUTS: u32 = 8;

/// What is wired to one drive.
#[derive(Debug)]
pub(super) struct Wiring {
    settings: MoonsMotorSettings,
    /// The closed outputs, from bit 0.
    outputs: u8,
}

impl Wiring {
    pub(super) fn new(settings: &MoonsMotorSettings) -> Wiring {
        Wiring { settings: settings.clone(), outputs: 0 }
    }

    /// Power was lost.
    pub(super) fn restart(&mut self) {
        self.outputs = 0;
    }

    /// Closes or opens output `number`, 1 ... 4; false: there is none.
    pub(super) fn set_output(&mut self, number: u8, closed: bool) -> bool {
        let exists = (1..=4).contains(&number);
        if exists {
            let bit = 1 << (number - 1);
            self.outputs = if closed { self.outputs | bit } else { self.outputs & !bit };
        }
        exists
    }

    pub(super) fn outputs(&self) -> u16 {
        self.outputs.into()
    }

    /// The inputs with the motor there, steps from the first zero, and the hardware enable like that.
    pub(super) fn main(&self, place: f64, enabled: bool) -> u16 {
        let home = self.settings.home.map(|home| {
            let (low, high) = (home.range.0.min(home.range.1), home.range.0.max(home.range.1));
            (home.at, (f64::from(low)..=f64::from(high)).contains(&place))
        });
        let enable = self.settings.enable.map(|wired| (wired, enabled));
        let inputs = home.into_iter().chain(enable).fold(OPEN, |inputs, (wired, acts)| {
            let bit = 1_u16.checked_shl(u32::from(wired.input).wrapping_sub(1)).unwrap_or(0) & OPEN;
            if acts == wired.closed { inputs & !bit } else { inputs }
        });
        inputs | self.outputs() << OUTPUTS
    }
}
