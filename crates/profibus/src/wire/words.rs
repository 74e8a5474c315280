//! Control and status words of DRIVECOM and of PROFIdrive: the bits and commands that a master sends, and the states
//! that status words are (sheet, 4).

use fieldbeat_core::axis::State;
use fieldbeat_core::bus::cia402;

/// The control word of DRIVECOM, profile 21. Its bits are those of CiA 402 (the sheet names the commands; the bits are
/// assumed). That of PROFIdrive, STW1, has the same, and one in addition (FPBA-01 manual).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct DrivecomControl(pub u16);

impl DrivecomControl {
    /// Bit 4; 0: the output of the ramp generator is 0.
    pub const RAMP_ENABLE: u16 = 1 << 4;
    /// Bit 5; 0: the ramp generator holds its output.
    pub const RAMP_RUN: u16 = 1 << 5;
    /// Bit 6; 0: the input of the ramp generator is 0.
    pub const SETPOINT: u16 = 1 << 6;
    /// Bit 7: the rising edge resets a fault.
    pub const FAULT_RESET: u16 = 1 << 7;
    /// Bit 10 of PROFIdrive: control by PLC; 0: the drive ignores the process data. DRIVECOM has no such bit.
    pub const BY_PLC: u16 = 1 << 10;

    /// Be ready to switch on.
    pub const SHUTDOWN: DrivecomControl = DrivecomControl(0x0006);
    /// Switch on.
    pub const SWITCHED_ON: DrivecomControl = DrivecomControl(0x0007);
    /// Enable operation. The ramp generator is at 0.
    pub const ENABLED: DrivecomControl = DrivecomControl(0x000F);
    /// Quick stop.
    pub const QUICK_STOP: DrivecomControl = DrivecomControl(0x0002);
    /// Inhibit the voltage.
    pub const INHIBIT: DrivecomControl = DrivecomControl(0x0000);

    /// With `bits` as 1.
    pub const fn with(self, bits: u16) -> DrivecomControl {
        DrivecomControl(self.0 | bits)
    }
}

/// The status word of DRIVECOM (EMF2133IB manual, page 76).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct DrivecomStatus(pub u16);

impl DrivecomStatus {
    /// The state; [`State::Unknown`]: none of the manual's.
    pub fn state(self) -> State {
        cia402::state(self.0)
    }
}

/// The status word of PROFIdrive, ZSW1 (FPBA-01 manual).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ProfidriveStatus(pub u16);

impl ProfidriveStatus {
    /// The state in terms of CiA 402; [`State::Unknown`]: no state of the profile.
    ///
    /// The sheet has the bits, not the table of states. This one is the profile's general state machine: S1 to S5 by
    /// bits 6 (switch-on inhibit), 0 (ready to switch on), 1 (ready to operate), 2 (operation enabled), a quick stop by
    /// bit 5 (no OFF3) in operation, a fault reaction by bit 3 (fault) in operation (assumed).
    pub fn state(self) -> State {
        let has = |bit: u16| self.0 >> bit & 1 != 0;
        match self.0 & 0x47 {
            _ if has(3) && has(2) => State::FaultReactionActive,
            _ if has(3) => State::Fault,
            0x00 => State::NotReadyToSwitchOn,
            0x40 => State::SwitchOnDisabled,
            0x01 => State::ReadyToSwitchOn,
            0x03 => State::SwitchedOn,
            0x07 if has(5) => State::OperationEnabled,
            0x07 => State::QuickStopActive,
            _ => State::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_and_commands_of_drivecom_are_those_of_the_sheet() {
        // The rows of page 76 are those of CiA 402. The reply of the sheet's Data_Exchange.
        assert_eq!(DrivecomStatus(0x0237).state(), State::OperationEnabled);
        // Both words of a fault: one in which the drive still reacts, one in which it is off.
        assert_eq!(DrivecomStatus(0x002F).state(), State::FaultReactionActive);
        assert_eq!(DrivecomStatus(0x0008).state(), State::Fault);
        // Commands, as the sheet has them.
        use DrivecomControl as C;
        let run = C::ENABLED.with(C::RAMP_ENABLE | C::RAMP_RUN | C::SETPOINT);
        assert_eq!(run, C(0x007F));
        assert_eq!(run.with(C::BY_PLC), C(0x047F), "that of PROFIdrive");
        assert_eq!(C::SHUTDOWN.with(C::BY_PLC), C(0x0406));
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
}
