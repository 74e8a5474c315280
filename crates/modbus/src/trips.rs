//! Trips of a Unidrive: the meaning of Pr 10.020 after a fault.
//!
//! Facts: trip list of the M700, M702 user guide. Entries that it does not show are marked
//! [`assumed`](Trip::assumed): they are known of drives of this family.

use std::fmt;

use fieldbeat_core::time::S;

/// A trip's number. Firmware and modules have more than are known here: unknown ones stay numbers.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Trip(pub u16);

impl Trip {
    /// 0: none.
    pub const NONE: Trip = Trip(0);
    /// 1: under-voltage of the DC bus (assumed).
    pub const UNDER_VOLTS: Trip = Trip(1);
    /// 2: over-voltage of the DC bus.
    pub const OVER_VOLTS: Trip = Trip(2);
    /// 3: instantaneous over-current. No reset is accepted for 10 s.
    pub const OVER_CURRENT: Trip = Trip(3);
    /// 6: external trip (assumed).
    pub const EXTERNAL: Trip = Trip(6);
    /// 7: over-speed (assumed).
    pub const OVER_SPEED: Trip = Trip(7);
    /// 20: the motor is too hot.
    pub const MOTOR_TOO_HOT: Trip = Trip(20);
    /// 30: the watchdog of the control word was not served in time (assumed).
    pub const WATCHDOG: Trip = Trip(30);
    /// 35: bit 12 of the control word (assumed).
    pub const CONTROL_WORD: Trip = Trip(35);

    /// Written to Pr 10.038, a reset instead of a trip (assumed).
    pub const USER_RESET: u16 = 100;
    /// Written to Pr 10.038, the log is cleared instead of a trip (assumed).
    pub const USER_CLEAR: u16 = 255;

    /// The meaning, if known.
    pub const fn name(self) -> Option<&'static str> {
        match self.known() {
            Some((name, _)) => Some(name),
            None => None,
        }
    }

    /// The name is not from a document.
    pub const fn assumed(self) -> bool {
        matches!(self.known(), Some((_, true)))
    }

    /// How long after the trip a drive accepts no reset, ns.
    pub const fn reset_after_ns(self) -> u64 {
        match self.0 {
            3 => 10 * S,
            _ => 0,
        }
    }

    /// The master was silent: the watchdog of the control word, or that of a module, which shares its trip with other
    /// errors of the module.
    pub const fn is_of_silence(self) -> bool {
        matches!(self, Trip::WATCHDOG | Trip(202 | 207 | 212 | 252))
    }

    const fn known(self) -> Option<(&'static str, bool)> {
        let assumed = true;
        Some(match self.0 {
            0 => ("no trip", false),
            1 => ("under volts", assumed),
            2 => ("over volts", false),
            3 => ("OI ac: instantaneous over-current, no reset for 10 s", false),
            4 => ("OI brake: over-current of the braking transistor", assumed),
            6 => ("external trip", assumed),
            7 => ("over speed", assumed),
            8 => ("inductance", false),
            20 => ("motor too hot", false),
            21 => ("inverter too hot", assumed),
            22 => ("power stage too hot", assumed),
            23 => ("control stage too hot", assumed),
            24 => ("thermistor", assumed),
            30 => ("watchdog: the control word was not written in time", assumed),
            31 => ("EEPROM fail", assumed),
            32 => ("phase loss", assumed),
            35 => ("control word", assumed),
            38 => ("low load", false),
            40..=89 => ("user trip", assumed),
            176 => ("name plate", false),
            202 => ("slot 1 error: its module, or no Modbus traffic for its time-out", assumed),
            207 => ("slot 2 error: its module, or no Modbus traffic for its time-out", assumed),
            212 => ("slot 3 error: its module, or no Modbus traffic for its time-out", assumed),
            252 => ("slot 4 error: its module, or no Modbus traffic for its time-out", assumed),
            _ => return None,
        })
    }
}

impl fmt::Debug for Trip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Trip({})", self.0)
    }
}

impl fmt::Display for Trip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "trip {} {}", self.0, self.name().unwrap_or("(look it up in the drive's manual)"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_trips_of_the_documents_are_not_marked_as_assumed_and_the_others_are() {
        for trip in [2, 3, 8, 20, 38, 176].map(Trip) {
            assert!(trip.name().is_some() && !trip.assumed(), "{trip}");
        }
        for trip in [1, 6, 7, 30, 35].map(Trip) {
            assert!(trip.name().is_some() && trip.assumed(), "{trip}");
        }
    }

    #[test]
    fn only_over_current_delays_its_reset() {
        assert_eq!(Trip::OVER_CURRENT.reset_after_ns(), 10_000_000_000);
        assert!((0..=u16::MAX).map(Trip).filter(|trip| trip.reset_after_ns() != 0).eq([Trip(3)]));
    }

    #[test]
    fn a_watchdog_says_that_the_master_was_silent_and_no_other_trip_does() {
        let of_silence: Vec<u16> = (0..=u16::MAX).filter(|code| Trip(*code).is_of_silence()).collect();
        assert_eq!(of_silence, [30, 202, 207, 212, 252]);
    }

    #[test]
    fn an_unknown_trip_stays_a_number() {
        assert_eq!((Trip(999).name(), Trip(999).assumed()), (None, false));
        assert_eq!(Trip(999).to_string(), "trip 999 (look it up in the drive's manual)");
        assert_eq!(Trip(2).to_string(), "trip 2 over volts");
    }
}
