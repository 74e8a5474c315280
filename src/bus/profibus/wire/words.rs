//! Control and status words of DRIVECOM and of PROFIdrive: bits with their names, and the states they are (sheet, 4).
//!
//! The commands that a master sends are constants; which one is next is decided elsewhere.

use crate::axis::State;

/// Defines a word by its bits, each with its number and its name.
macro_rules! bits {
    (
        $(#[$about:meta])*
        pub struct $Word:ident($bits:ty) { $($BIT:ident = $bit:literal: $name:literal $(, $more:literal)?;)+ }
    ) => {
        $(#[$about])*
        #[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
        pub struct $Word(pub $bits);

        impl $Word {
            $(
                #[doc = concat!("Bit ", $bit, ": ", $name, ".", $(" ", $more)?)]
                pub const $BIT: $bits = 1 << $bit;
            )+

            /// All of `bits` are 1.
            pub const fn has(self, bits: $bits) -> bool {
                self.0 & bits == bits
            }

            /// One of `bits` is 1.
            pub const fn has_any(self, bits: $bits) -> bool {
                self.0 & bits != 0
            }

            /// With `bits` as 1.
            pub const fn with(self, bits: $bits) -> $Word {
                $Word(self.0 | bits)
            }

            /// With `bits` as 0.
            pub const fn without(self, bits: $bits) -> $Word {
                $Word(self.0 & !bits)
            }

            /// The names of the bits that are 1. Reserved ones have none.
            pub fn names(self) -> impl Iterator<Item = &'static str> {
                let names = [$(($Word::$BIT, $name)),+];
                names.into_iter().filter(move |(bit, _)| self.has(*bit)).map(|(_, name)| name)
            }
        }

        impl std::fmt::Debug for $Word {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, "{}({:#0width$x}", stringify!($Word), self.0, width = 2 + size_of::<$bits>() * 2)?;
                for (index, name) in self.names().enumerate() {
                    write!(f, "{}{name}", if index == 0 { ": " } else { ", " })?;
                }
                f.write_str(")")
            }
        }
    };
}
pub(super) use bits;

bits! {
    /// The control word of DRIVECOM, profile 21. Its bits are those of CiA 402 (the sheet names the commands; the bits
    /// are assumed).
    pub struct DrivecomControl(u16) {
        SWITCH_ON = 0: "switch on";
        ENABLE_VOLTAGE = 1: "enable voltage", "0: the voltage is inhibited, the motor coasts.";
        NO_QUICK_STOP = 2: "no quick stop", "0: quick stop.";
        ENABLE_OPERATION = 3: "enable operation";
        RAMP_ENABLE = 4: "ramp enable", "0: the output of the ramp generator is 0.";
        RAMP_RUN = 5: "ramp run", "0: the ramp generator holds its output.";
        SETPOINT = 6: "setpoint", "0: the input of the ramp generator is 0.";
        FAULT_RESET = 7: "fault reset", "The rising edge counts.";
    }
}

impl DrivecomControl {
    /// Be ready to switch on.
    pub const SHUTDOWN: DrivecomControl = DrivecomControl(0x0006);
    /// Switch on.
    pub const SWITCHED_ON: DrivecomControl = DrivecomControl(0x0007);
    /// Enable operation. The ramp generator is at 0.
    pub const ENABLED: DrivecomControl = DrivecomControl(0x000F);
    /// Enable operation, and follow the setpoint.
    pub const RUN: DrivecomControl = DrivecomControl(0x007F);
    /// Quick stop.
    pub const QUICK_STOP: DrivecomControl = DrivecomControl(0x0002);
    /// Inhibit the voltage.
    pub const INHIBIT: DrivecomControl = DrivecomControl(0x0000);
}

bits! {
    /// The status word of DRIVECOM (EMF2133IB manual, page 76). Bits 7 and up are assumed.
    pub struct DrivecomStatus(u16) {
        READY = 0: "ready to start";
        SWITCHED_ON = 1: "switched on";
        OPERATION_ENABLED = 2: "operation enabled";
        FAULT = 3: "fault";
        VOLTAGE_INHIBIT = 4: "voltage inhibited";
        NO_QUICK_STOP = 5: "no quick stop", "0: quick stop.";
        SWITCH_ON_INHIBIT = 6: "switch-on inhibit";
        WARNING = 7: "warning";
        MESSAGE = 8: "message";
        REMOTE = 9: "remote", "The bus is in control.";
        SETPOINT_REACHED = 10: "setpoint reached";
        LIMIT = 11: "limit";
    }
}

impl DrivecomStatus {
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

bits! {
    /// The control word of PROFIdrive, STW1 (FPBA-01 manual).
    pub struct ProfidriveControl(u16) {
        ON = 0: "on", "0: OFF1, ramp down and power off.";
        NO_OFF2 = 1: "no OFF2", "0: the motor coasts.";
        NO_OFF3 = 2: "no OFF3", "0: quick stop.";
        ENABLE_OPERATION = 3: "enable operation";
        RAMP_ENABLE = 4: "ramp enable", "0: the output of the ramp generator is 0.";
        RAMP_RUN = 5: "ramp run", "0: the ramp generator holds its output.";
        SETPOINT = 6: "setpoint", "0: the input of the ramp generator is 0.";
        FAULT_RESET = 7: "fault reset", "The rising edge counts.";
        JOG_1 = 8: "jog 1";
        JOG_2 = 9: "jog 2";
        BY_PLC = 10: "control by PLC", "0: the drive ignores the process data. DRIVECOM has no such bit.";
    }
}

impl ProfidriveControl {
    /// Everything but on.
    pub const READY: ProfidriveControl = ProfidriveControl(0x047E);
    /// On, and follow the setpoint.
    pub const RUN: ProfidriveControl = ProfidriveControl(0x047F);
}

bits! {
    /// The status word of PROFIdrive, ZSW1 (FPBA-01 manual).
    pub struct ProfidriveStatus(u16) {
        READY = 0: "ready to switch on";
        SWITCHED_ON = 1: "ready to operate";
        OPERATION_ENABLED = 2: "operation enabled";
        FAULT = 3: "fault";
        NO_OFF2 = 4: "no OFF2";
        NO_OFF3 = 5: "no OFF3", "0: quick stop.";
        SWITCH_ON_INHIBIT = 6: "switch-on inhibit";
        WARNING = 7: "warning";
        WITHIN_TOLERANCE = 8: "within tolerance";
        REMOTE = 9: "control requested";
        SETPOINT_REACHED = 10: "setpoint reached", "Frequency or speed, as compared in the drive.";
    }
}

impl ProfidriveStatus {
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
