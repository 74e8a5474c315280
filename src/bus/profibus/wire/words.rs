//! Control and status words of DRIVECOM and of PROFIdrive: bits with their names, and the states they are (sheet, 4).
//!
//! The commands that a master sends are constants; which one is next is decided elsewhere.

use std::fmt;

use crate::axis::State;

/// Defines a word and what is common to all of them: bits of which `names` has the names.
macro_rules! word {
    ($(#[$about:meta])* $Word:ident, $names:expr) => {
        $(#[$about])*
        #[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
        pub struct $Word(pub u16);

        impl $Word {
            const NAMES: &[(u16, &'static str)] = &$names;

            /// All of `bits` are 1.
            pub const fn has(self, bits: u16) -> bool {
                self.0 & bits == bits
            }

            /// With `bits` as 1.
            pub const fn with(self, bits: u16) -> $Word {
                $Word(self.0 | bits)
            }

            /// With `bits` as 0.
            pub const fn without(self, bits: u16) -> $Word {
                $Word(self.0 & !bits)
            }

            /// The names of the bits that are 1. Reserved ones have none.
            pub fn names(self) -> impl Iterator<Item = &'static str> {
                Self::NAMES.iter().filter(move |(bit, _)| self.has(*bit)).map(|(_, name)| *name)
            }
        }

        impl fmt::Debug for $Word {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write_word(f, stringify!($Word), format_args!("{:#06x}", self.0), self.names())
            }
        }
    };
}

word! {
    /// The control word of DRIVECOM, profile 21. Its bits are those of CiA 402 (the sheet names the commands; the bits
    /// are assumed).
    DrivecomControl, [
        (Self::SWITCH_ON, "switch on"),
        (Self::ENABLE_VOLTAGE, "enable voltage"),
        (Self::NO_QUICK_STOP, "no quick stop"),
        (Self::ENABLE_OPERATION, "enable operation"),
        (Self::RAMP_ENABLE, "ramp enable"),
        (Self::RAMP_RUN, "ramp run"),
        (Self::SETPOINT, "setpoint"),
        (Self::FAULT_RESET, "fault reset"),
    ]
}

impl DrivecomControl {
    /// Bit 0: switch on.
    pub const SWITCH_ON: u16 = 1 << 0;
    /// Bit 1: 0 = voltage inhibited, the motor coasts.
    pub const ENABLE_VOLTAGE: u16 = 1 << 1;
    /// Bit 2: 0 = quick stop.
    pub const NO_QUICK_STOP: u16 = 1 << 2;
    /// Bit 3: enable operation.
    pub const ENABLE_OPERATION: u16 = 1 << 3;
    /// Bit 4: 0 = the output of the ramp generator is 0.
    pub const RAMP_ENABLE: u16 = 1 << 4;
    /// Bit 5: 0 = the ramp generator holds its output.
    pub const RAMP_RUN: u16 = 1 << 5;
    /// Bit 6: 0 = the input of the ramp generator is 0.
    pub const SETPOINT: u16 = 1 << 6;
    /// Bit 7: the rising edge resets a fault.
    pub const FAULT_RESET: u16 = 1 << 7;

    /// 0006h: be ready to switch on.
    pub const SHUTDOWN: DrivecomControl = DrivecomControl(0x0006);
    /// 0007h: switch on.
    pub const SWITCHED_ON: DrivecomControl = DrivecomControl(0x0007);
    /// 000Fh: enable operation. The ramp generator is at 0.
    pub const ENABLED: DrivecomControl = DrivecomControl(0x000F);
    /// 007Fh: enable operation, and follow the setpoint.
    pub const RUN: DrivecomControl = DrivecomControl(0x007F);
    /// 0002h: quick stop.
    pub const QUICK_STOP: DrivecomControl = DrivecomControl(0x0002);
    /// 0000h: inhibit the voltage.
    pub const INHIBIT: DrivecomControl = DrivecomControl(0x0000);
}

word! {
    /// The status word of DRIVECOM (EMF2133IB manual, page 76).
    DrivecomStatus, [
        (Self::READY, "ready to start"),
        (Self::SWITCHED_ON, "switched on"),
        (Self::OPERATION_ENABLED, "operation enabled"),
        (Self::FAULT, "fault"),
        (Self::VOLTAGE_INHIBIT, "voltage inhibited"),
        (Self::NO_QUICK_STOP, "no quick stop"),
        (Self::SWITCH_ON_INHIBIT, "switch-on inhibit"),
        (Self::WARNING, "warning"),
        (Self::MESSAGE, "message"),
        (Self::REMOTE, "remote"),
        (Self::SETPOINT_REACHED, "setpoint reached"),
        (Self::LIMIT, "limit"),
    ]
}

impl DrivecomStatus {
    /// Bit 0: ready to start.
    pub const READY: u16 = 1 << 0;
    /// Bit 1: switched on.
    pub const SWITCHED_ON: u16 = 1 << 1;
    /// Bit 2: operation enabled.
    pub const OPERATION_ENABLED: u16 = 1 << 2;
    /// Bit 3: fault.
    pub const FAULT: u16 = 1 << 3;
    /// Bit 4: voltage inhibited.
    pub const VOLTAGE_INHIBIT: u16 = 1 << 4;
    /// Bit 5: 0 = quick stop.
    pub const NO_QUICK_STOP: u16 = 1 << 5;
    /// Bit 6: switching on is inhibited.
    pub const SWITCH_ON_INHIBIT: u16 = 1 << 6;
    /// Bit 7: warning (assumed, as all that follow).
    pub const WARNING: u16 = 1 << 7;
    /// Bit 8: message.
    pub const MESSAGE: u16 = 1 << 8;
    /// Bit 9: the bus is in control.
    pub const REMOTE: u16 = 1 << 9;
    /// Bit 10: the setpoint is reached.
    pub const SETPOINT_REACHED: u16 = 1 << 10;
    /// Bit 11: a limit is active.
    pub const LIMIT: u16 = 1 << 11;

    /// Its state; [`State::Unknown`]: none of the manual's.
    pub const fn state(self) -> State {
        // A fault reaction is looked for before a fault, as the manual does.
        match (self.0 & 0x4F, self.0 & 0x6F) {
            (0x00, _) => State::NotReadyToSwitchOn,
            (0x40, _) => State::SwitchOnDisabled,
            (_, 0x21) => State::ReadyToSwitchOn,
            (_, 0x23) => State::SwitchedOn,
            (_, 0x27) => State::OperationEnabled,
            (_, 0x07) => State::QuickStopActive,
            (0x0F, _) => State::FaultReactionActive,
            (0x08, _) => State::Fault,
            _ => State::Unknown,
        }
    }
}

word! {
    /// The control word of PROFIdrive, STW1 (FPBA-01 manual).
    ProfidriveControl, [
        (Self::ON, "on"),
        (Self::NO_OFF2, "no OFF2"),
        (Self::NO_OFF3, "no OFF3"),
        (Self::ENABLE_OPERATION, "enable operation"),
        (Self::RAMP_ENABLE, "ramp enable"),
        (Self::RAMP_RUN, "ramp run"),
        (Self::SETPOINT, "setpoint"),
        (Self::FAULT_RESET, "fault reset"),
        (Self::JOG_1, "jog 1"),
        (Self::JOG_2, "jog 2"),
        (Self::BY_PLC, "control by PLC"),
    ]
}

impl ProfidriveControl {
    /// Bit 0: on; 0 = OFF1, ramp down and power off.
    pub const ON: u16 = 1 << 0;
    /// Bit 1: 0 = OFF2, the motor coasts.
    pub const NO_OFF2: u16 = 1 << 1;
    /// Bit 2: 0 = OFF3, quick stop.
    pub const NO_OFF3: u16 = 1 << 2;
    /// Bit 3: enable operation.
    pub const ENABLE_OPERATION: u16 = 1 << 3;
    /// Bit 4: 0 = the output of the ramp generator is 0.
    pub const RAMP_ENABLE: u16 = 1 << 4;
    /// Bit 5: 0 = the ramp generator holds its output.
    pub const RAMP_RUN: u16 = 1 << 5;
    /// Bit 6: 0 = the input of the ramp generator is 0.
    pub const SETPOINT: u16 = 1 << 6;
    /// Bit 7: the rising edge acknowledges a fault.
    pub const FAULT_RESET: u16 = 1 << 7;
    /// Bit 8: jog 1.
    pub const JOG_1: u16 = 1 << 8;
    /// Bit 9: jog 2.
    pub const JOG_2: u16 = 1 << 9;
    /// Bit 10: 0 = the drive ignores the process data. DRIVECOM has no such bit.
    pub const BY_PLC: u16 = 1 << 10;

    /// 047Eh: everything but on.
    pub const READY: ProfidriveControl = ProfidriveControl(0x047E);
    /// 047Fh: on, and follow the setpoint.
    pub const RUN: ProfidriveControl = ProfidriveControl(0x047F);
}

word! {
    /// The status word of PROFIdrive, ZSW1 (FPBA-01 manual).
    ProfidriveStatus, [
        (Self::READY, "ready to switch on"),
        (Self::SWITCHED_ON, "ready to operate"),
        (Self::OPERATION_ENABLED, "operation enabled"),
        (Self::FAULT, "fault"),
        (Self::NO_OFF2, "no OFF2"),
        (Self::NO_OFF3, "no OFF3"),
        (Self::SWITCH_ON_INHIBIT, "switch-on inhibit"),
        (Self::WARNING, "warning"),
        (Self::WITHIN_TOLERANCE, "within tolerance"),
        (Self::REMOTE, "control requested"),
        (Self::SETPOINT_REACHED, "setpoint reached"),
    ]
}

impl ProfidriveStatus {
    /// Bit 0: ready to switch on.
    pub const READY: u16 = 1 << 0;
    /// Bit 1: ready to operate.
    pub const SWITCHED_ON: u16 = 1 << 1;
    /// Bit 2: operation enabled.
    pub const OPERATION_ENABLED: u16 = 1 << 2;
    /// Bit 3: fault.
    pub const FAULT: u16 = 1 << 3;
    /// Bit 4: 0 = OFF2.
    pub const NO_OFF2: u16 = 1 << 4;
    /// Bit 5: 0 = OFF3.
    pub const NO_OFF3: u16 = 1 << 5;
    /// Bit 6: switching on is inhibited.
    pub const SWITCH_ON_INHIBIT: u16 = 1 << 6;
    /// Bit 7: warning.
    pub const WARNING: u16 = 1 << 7;
    /// Bit 8: the speed is within its tolerance.
    pub const WITHIN_TOLERANCE: u16 = 1 << 8;
    /// Bit 9: the drive wants to be controlled by the bus.
    pub const REMOTE: u16 = 1 << 9;
    /// Bit 10: the compared value of frequency or speed is reached.
    pub const SETPOINT_REACHED: u16 = 1 << 10;

    /// Its state in terms of CiA 402; [`State::Unknown`]: no state of the profile.
    ///
    /// The sheet has the bits, not the table of states. This one is the profile's general state machine: S1 to S5 by
    /// bits 6, 0, 1, 2, a quick stop by OFF3 in operation, a fault reaction by a fault in operation (assumed).
    pub const fn state(self) -> State {
        const OPERATION: u16 = ProfidriveStatus::OPERATION_ENABLED;
        if self.has(Self::FAULT) {
            return if self.has(OPERATION) { State::FaultReactionActive } else { State::Fault };
        }
        match self.0 & (Self::SWITCH_ON_INHIBIT | Self::READY | Self::SWITCHED_ON | OPERATION) {
            0x00 => State::NotReadyToSwitchOn,
            0x40 => State::SwitchOnDisabled,
            0x01 => State::ReadyToSwitchOn,
            0x03 => State::SwitchedOn,
            0x07 if self.has(Self::NO_OFF3) => State::OperationEnabled,
            0x07 => State::QuickStopActive,
            _ => State::Unknown,
        }
    }
}

/// A word in a message: its bits, and their names.
pub(super) fn write_word(
    f: &mut fmt::Formatter<'_>,
    word: &str,
    bits: fmt::Arguments<'_>,
    names: impl Iterator<Item = &'static str>,
) -> fmt::Result {
    write!(f, "{word}({bits}")?;
    for (index, name) in names.enumerate() {
        write!(f, "{}{name}", if index == 0 { ": " } else { ", " })?;
    }
    f.write_str(")")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_page_76_is_its_state_whatever_the_other_bits() {
        for (state, mask, value) in [
            (State::NotReadyToSwitchOn, 0x4F_u16, 0x00_u16),
            (State::SwitchOnDisabled, 0x4F, 0x40),
            (State::ReadyToSwitchOn, 0x6F, 0x21),
            (State::SwitchedOn, 0x6F, 0x23),
            (State::OperationEnabled, 0x6F, 0x27),
            (State::QuickStopActive, 0x6F, 0x07),
            (State::FaultReactionActive, 0x4F, 0x0F),
            (State::Fault, 0x4F, 0x08),
        ] {
            let of_state = (0..=u16::MAX).filter(|word| DrivecomStatus(*word).state() == state);
            let by_mask = (0..=u16::MAX).filter(|word| word & mask == value);
            assert!(of_state.eq(by_mask), "{state}");
        }
        // The reply of the sheet's Data_Exchange.
        assert_eq!(DrivecomStatus(0x0237).state(), State::OperationEnabled);
        // Both words of a fault: one in which the drive still reacts, one in which it is off.
        assert_eq!(DrivecomStatus(0x002F).state(), State::FaultReactionActive);
        assert_eq!(DrivecomStatus(0x0008).state(), State::Fault);
    }

    #[test]
    fn commands_are_the_bits_of_the_sheet() {
        use DrivecomControl as C;
        let up = C::ENABLE_VOLTAGE | C::NO_QUICK_STOP;
        assert_eq!(C::SHUTDOWN.0, up);
        assert_eq!(C::SWITCHED_ON, C::SHUTDOWN.with(C::SWITCH_ON));
        assert_eq!(C::ENABLED, C::SWITCHED_ON.with(C::ENABLE_OPERATION));
        assert_eq!(C::RUN, C::ENABLED.with(C::RAMP_ENABLE | C::RAMP_RUN | C::SETPOINT));
        assert_eq!((C::QUICK_STOP.0, C::INHIBIT.0), (C::ENABLE_VOLTAGE, 0));
        use ProfidriveControl as P;
        assert_eq!(P::READY, P::RUN.without(P::ON));
        assert_eq!(P::RUN.0 & !P::BY_PLC, C::RUN.0, "DRIVECOM's, with the bit that DRIVECOM has not");
        assert!(P::RUN.has(P::BY_PLC));
    }

    #[test]
    fn states_of_profidrive_on_the_way_up_and_out() {
        for (word, state) in [
            (0x0000, State::NotReadyToSwitchOn),
            (0x0270, State::SwitchOnDisabled),
            (0x0231, State::ReadyToSwitchOn),
            (0x0233, State::SwitchedOn),
            (0x0337, State::OperationEnabled),
            (0x0217, State::QuickStopActive),
            (0x023F, State::FaultReactionActive),
            (0x0278, State::Fault),
            (0x0238, State::Fault),
            (0x0234, State::Unknown),
            (0x0271, State::Unknown),
        ] {
            assert_eq!(ProfidriveStatus(word).state(), state, "{word:#06x}");
        }
    }

    #[test]
    fn a_word_in_a_message_names_its_bits() {
        let shutdown = DrivecomControl::SHUTDOWN;
        assert_eq!(format!("{shutdown:?}"), "DrivecomControl(0x0006: enable voltage, no quick stop)");
        assert_eq!(format!("{:?}", ProfidriveControl(0x8000)), "ProfidriveControl(0x8000)");
        let all = u16::MAX;
        assert_eq!(DrivecomControl(all).names().count() + ProfidriveControl(all).names().count(), 8 + 11);
        assert_eq!(DrivecomStatus(all).names().count() + ProfidriveStatus(all).names().count(), 12 + 11);
    }
}
