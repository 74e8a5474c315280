//! The words inside a telegram: bits and numbers with their names, nothing more.
//!
//! Facts: "User Manual Motion Control SW" (SG5) 4.3.4, sections Control Word, Status Word and State Machine.

use std::fmt;

debug_as_hex!(ControlWord, StatusWord, StateVar);

/// The control word (SG5 manual).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct ControlWord(pub u16);

impl ControlWord {
    /// Bit 0: 0 = current off, power stage off; 0 -> 1 switches on.
    pub const SWITCH_ON: u16 = 1 << 0;
    /// Bit 1: 0 = power stage off at once.
    pub const VOLTAGE_ENABLE: u16 = 1 << 1;
    /// Bit 2: 0 = quick stop, then power off.
    pub const NO_QUICK_STOP: u16 = 1 << 2;
    /// Bit 3: 0 = position controlled, motion commands refused.
    pub const ENABLE_OPERATION: u16 = 1 << 3;
    /// Bit 4: 0 = quick stop, stay controlled, motion command dropped.
    pub const NO_ABORT: u16 = 1 << 4;
    /// Bit 5: 0 = quick stop, stay controlled; back to 1 resumes the target of a profile move. Not for a master's
    /// stop: a motion that resumes by itself is not stopped.
    pub const NO_FREEZE: u16 = 1 << 5;
    /// Bit 6: 1 = go to the parameterised position.
    pub const GO_TO_POSITION: u16 = 1 << 6;
    /// Bit 7: rising edge acknowledges an error.
    pub const ERROR_ACKNOWLEDGE: u16 = 1 << 7;
    /// Bit 8: 1 = jog in positive direction.
    pub const JOG_PLUS: u16 = 1 << 8;
    /// Bit 9: 1 = jog in negative direction.
    pub const JOG_MINUS: u16 = 1 << 9;
    /// Bit 11: 1 = run homing; hold until finished, then clear.
    pub const HOMING: u16 = 1 << 11;
    /// Bit 12: 1 = run the clearance check.
    pub const CLEARANCE_CHECK: u16 = 1 << 12;
    /// Bit 13: rising edge goes to the initial position.
    pub const GO_TO_INITIAL: u16 = 1 << 13;
    /// Bit 15: 1 = run the phase search.
    pub const PHASE_SEARCH: u16 = 1 << 15;
    /// The enabling bits 1 ... 5, which many drives force to 1 by parameter. A master sends them as 1 itself.
    pub const ENABLES: u16 = 0x003E;

    /// 003Eh: power off, everything else allowed.
    pub const BASE: ControlWord = ControlWord(Self::ENABLES);
    /// 003Fh: switched on, operation enabled.
    pub const ON: ControlWord = ControlWord(0x003F);
    /// 083Fh: on and homing.
    pub const HOME: ControlWord = ControlWord(0x083F);
    /// 00BEh: off and acknowledging; the edge counts, so [`BASE`](Self::BASE) stands before and after it.
    pub const ACKNOWLEDGE: ControlWord = ControlWord(0x00BE);
    /// 002Fh: on, aborting: stop and stay in position.
    pub const ABORT: ControlWord = ControlWord(0x002F);
    /// 003Bh: quick stop, then power off.
    pub const QUICK_STOP: ControlWord = ControlWord(0x003B);

    /// All of `bits` are 1.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }
}

/// The status word (SG5 manual).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct StatusWord(pub u16);

impl StatusWord {
    /// Bit 0: main state 8 or higher.
    pub const OPERATION_ENABLED: u16 = 1 << 0;
    /// Bit 1: control word bit 0 as the drive sees it, forced bits included; so are bits 2, 4 and 5.
    pub const SWITCH_ON_ACTIVE: u16 = 1 << 1;
    /// Bit 2: control word bit 3 as the drive sees it.
    pub const ENABLE_OPERATION: u16 = 1 << 2;
    /// Bit 3: an error stands or is being reacted to.
    pub const ERROR: u16 = 1 << 3;
    /// Bit 4: control word bit 1 as the drive sees it.
    pub const VOLTAGE_ENABLE: u16 = 1 << 4;
    /// Bit 5: control word bit 2 as the drive sees it.
    pub const NO_QUICK_STOP: u16 = 1 << 5;
    /// Bit 6: switching on is locked until control word bit 0 was 0.
    pub const SWITCH_ON_LOCKED: u16 = 1 << 6;
    /// Bit 7: the warn word is not 0.
    pub const WARNING: u16 = 1 << 7;
    /// Bit 8: a trigger or after-actual command is armed.
    pub const EVENT_HANDLER: u16 = 1 << 8;
    /// Bit 9: homing, jogging or another motion of the drive's own.
    pub const SPECIAL_MOTION: u16 = 1 << 9;
    /// Bit 10: setpoint done and actual position inside the window.
    pub const IN_TARGET: u16 = 1 << 10;
    /// Bit 11: the reference is valid.
    pub const HOMED: u16 = 1 << 11;
    /// Bit 12: the error cannot be acknowledged.
    pub const FATAL_ERROR: u16 = 1 << 12;
    /// Bit 13: the setpoint generator is running.
    pub const MOTION_ACTIVE: u16 = 1 << 13;
    /// Bits 14 and 15: range indicators 1 and 2, as configured in the drive.
    pub const RANGE_INDICATORS: u16 = 0b11 << 14;

    /// All of `bits` are 1.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }

    /// Main state 8 or higher.
    pub const fn operation_enabled(self) -> bool {
        self.has(Self::OPERATION_ENABLED)
    }

    /// An error stands or is being reacted to.
    pub const fn error(self) -> bool {
        self.has(Self::ERROR)
    }

    /// Setpoint done and actual position inside the window.
    pub const fn in_target(self) -> bool {
        self.has(Self::IN_TARGET)
    }

    /// The reference is valid.
    pub const fn homed(self) -> bool {
        self.has(Self::HOMED)
    }

    /// The error cannot be acknowledged: restart the drive.
    pub const fn fatal(self) -> bool {
        self.has(Self::FATAL_ERROR)
    }

    /// The setpoint generator is running.
    pub const fn motion_active(self) -> bool {
        self.has(Self::MOTION_ACTIVE)
    }
}

/// The state variable: main state in the high byte, sub state in the low byte (SG5 manual).
///
/// In state 8 the sub state carries the motion command count and three status bits, sampled together: sufficient
/// for a consistent handshake.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct StateVar(pub u16);

impl StateVar {
    /// Sub state of homing and of the drive's other own motions: finished.
    pub const FINISHED: u8 = 0x0F;
    /// Sub state bit in state 8: an event command is armed.
    pub const EVENT_HANDLER: u8 = 1 << 4;
    /// Sub state bit in state 8: the setpoint generator is running.
    pub const MOTION_ACTIVE: u8 = 1 << 5;
    /// Sub state bit in state 8: in target.
    pub const IN_TARGET: u8 = 1 << 6;
    /// Sub state bit in state 8: homed.
    pub const HOMED: u8 = 1 << 7;

    /// From main and sub state.
    pub const fn new(main: MainState, sub: u8) -> StateVar {
        StateVar((main.0 as u16) << 8 | sub as u16)
    }

    /// Main state.
    pub const fn main(self) -> MainState {
        MainState((self.0 >> 8) as u8)
    }

    /// Sub state; its meaning depends on the main state.
    pub const fn sub(self) -> u8 {
        self.0 as u8
    }

    /// The count of the last motion command that the drive accepted. Only state 8 carries it.
    pub const fn count(self) -> Option<u8> {
        if self.operating() { Some(self.sub() & 0xF) } else { None }
    }

    /// The setpoint generator is running, sampled with the count. Only state 8 carries it.
    pub const fn motion_active(self) -> Option<bool> {
        self.bit(Self::MOTION_ACTIVE)
    }

    /// In target, sampled with the count. Only state 8 carries it.
    pub const fn in_target(self) -> Option<bool> {
        self.bit(Self::IN_TARGET)
    }

    /// Homed, sampled with the count. Only state 8 carries it.
    pub const fn homed(self) -> Option<bool> {
        self.bit(Self::HOMED)
    }

    /// Homing or another motion of the drive's own is finished, and waits for its control bit to be released.
    pub const fn finished(self) -> bool {
        matches!(self.main().0, 9..=11 | 15..=17) && self.sub() == Self::FINISHED
    }

    const fn operating(self) -> bool {
        self.main().0 == MainState::OPERATION_ENABLED.0
    }

    const fn bit(self, bit: u8) -> Option<bool> {
        if self.operating() { Some(self.sub() & bit != 0) } else { None }
    }
}

/// The main state of the drive (SG5 manual). Newer firmware may have more: unknown states stay numbers.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MainState(pub u8);

named! {
    MainState

    /// Not ready to switch on: until control word bit 0 was 0.
    NOT_READY = 0, "not ready to switch on";
    /// Switch on disabled: until control word bits 0 ... 2 are 0, 1, 1.
    SWITCH_ON_DISABLED = 1, "switch on disabled";
    /// Ready to switch on.
    READY_TO_SWITCH_ON = 2, "ready to switch on";
    /// Setup error; the sub state is the code about to be logged.
    SETUP_ERROR = 3, "setup error";
    /// Error; the sub state is the low byte of the logged code.
    ERROR = 4, "error";
    /// Hardware tests, about 300 ms.
    HW_TESTS = 5, "hardware tests";
    /// Ready to operate: powered, position controlled, no motion commands.
    READY_TO_OPERATE = 6, "ready to operate";
    /// Brake release.
    BRAKE_RELEASE = 7, "brake release";
    /// Operation enabled: takes motion commands. The only state whose sub state carries their count.
    OPERATION_ENABLED = 8, "operation enabled";
    /// Homing.
    HOMING = 9, "homing";
    /// Clearance check.
    CLEARANCE_CHECK = 10, "clearance check";
    /// Going to the initial position.
    GOING_TO_INITIAL = 11, "going to initial position";
    /// Aborting.
    ABORTING = 12, "aborting";
    /// Freezing.
    FREEZING = 13, "freezing";
    /// Quick stop, commanded or in reaction to an error.
    QUICK_STOP = 14, "quick stop";
    /// Going to the parameterised position.
    GOING_TO_POSITION = 15, "going to position";
    /// Jogging in positive direction.
    JOGGING_PLUS = 16, "jogging +";
    /// Jogging in negative direction.
    JOGGING_MINUS = 17, "jogging -";
    /// Linearizing.
    LINEARIZING = 18, "linearizing";
    /// Phase search.
    PHASE_SEARCH = 19, "phase search";
    /// Special mode.
    SPECIAL_MODE = 20, "special mode";
    /// Brake delay (newer firmware).
    BRAKE_DELAY = 21, "brake delay";
}

impl fmt::Debug for MainState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.0, self.name().unwrap_or("unknown"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_named_control_words_are_made_of_their_bits() {
        use ControlWord as C;
        assert_eq!(C::BASE.0, 0x003E);
        assert_eq!(C::ON.0, C::BASE.0 | C::SWITCH_ON);
        assert_eq!(C::HOME.0, C::ON.0 | C::HOMING);
        assert_eq!(C::ACKNOWLEDGE.0, C::BASE.0 | C::ERROR_ACKNOWLEDGE);
        assert_eq!(C::ABORT.0, C::ON.0 & !C::NO_ABORT);
        assert_eq!(C::QUICK_STOP.0, C::ON.0 & !C::NO_QUICK_STOP);
    }

    #[test]
    fn only_state_8_carries_a_count() {
        // SG5 manual, state machine: in every other state the low nibble is no count.
        let operating = StateVar(0x08C3);
        assert_eq!(operating.main(), MainState::OPERATION_ENABLED);
        assert_eq!(operating.count(), Some(3));
        assert_eq!((operating.homed(), operating.in_target()), (Some(true), Some(true)));
        assert_eq!(operating.motion_active(), Some(false));
        let homed = StateVar::new(MainState::HOMING, StateVar::FINISHED);
        assert_eq!(homed, StateVar(0x090F));
        assert!(homed.finished() && homed.count().is_none() && homed.motion_active().is_none());
        // In state 8 the sub state 0Fh is a count.
        assert!(!StateVar(0x080F).finished());
    }
}
