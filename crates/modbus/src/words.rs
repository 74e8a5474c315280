//! Control word and status word of a Unidrive: bits with their names, nothing more.
//!
//! Facts: SI-PROFIBUS guide, control word and status word. What the available copy does not show is marked
//! *assumed*.

use std::fmt;

/// The control word, Pr 06.042. A drive obeys it while its bit [`AUTO`](Self::AUTO) and Pr 06.043 are 1.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct ControlWord(pub u16);

impl ControlWord {
    /// Bit 0: 1 = enabled, if the hardware enable (safe torque off) is there as well; 0 = power stage off at once, the
    /// motor coasts.
    pub const ENABLE: u16 = 1 << 0;
    /// Bit 1: 1 = run forward; 0 = ramp down to a stop.
    pub const RUN_FORWARD: u16 = 1 << 1;
    /// Bit 2: 1 = jog forward. Any of the run bits takes precedence.
    pub const JOG_FORWARD: u16 = 1 << 2;
    /// Bit 3: 1 = run in reverse; 0 = ramp down to a stop.
    pub const RUN_REVERSE: u16 = 1 << 3;
    /// Bit 4: the direction of bit 5: 1 = reverse.
    pub const REVERSE: u16 = 1 << 4;
    /// Bit 5: 1 = run, in the direction of bit 4.
    pub const RUN: u16 = 1 << 5;
    /// Bit 6: 1 = the sequencer may latch; 0 clears its latches. Pr 06.004 must suit.
    pub const NOT_STOP: u16 = 1 << 6;
    /// Bit 7: 1 = this word is obeyed, if Pr 06.043 is 1; 0 = the terminals are.
    pub const AUTO: u16 = 1 << 7;
    /// Bit 8: 1 = the reference is preset 1, Pr 01.021; 0 = the analogue reference, Pr 01.036. Pr 01.014 and 01.015
    /// must be 0.
    pub const REMOTE: u16 = 1 << 8;
    /// Bit 9: 1 = jog in reverse. Any of the run bits takes precedence.
    pub const JOG_REVERSE: u16 = 1 << 9;
    /// Bit 12: a rising edge trips the drive (assumed).
    pub const TRIP: u16 = 1 << 12;
    /// Bit 13: a rising edge resets a trip (assumed).
    pub const RESET: u16 = 1 << 13;
    /// Bit 14: arms a watchdog: the word has to be written again within about 1 s, or the drive trips (assumed).
    pub const KEYPAD_WATCHDOG: u16 = 1 << 14;
    /// The bits that make the motor turn.
    pub const ANY_RUN: u16 =
        Self::RUN_FORWARD | Self::JOG_FORWARD | Self::RUN_REVERSE | Self::RUN | Self::JOG_REVERSE;

    /// 0180h: in control by this word, disabled.
    pub const IDLE: ControlWord = ControlWord(Self::AUTO | Self::REMOTE);
    /// 0181h: enabled, not running.
    pub const ENABLED: ControlWord = ControlWord(Self::IDLE.0 | Self::ENABLE);
    /// 0183h: running forward.
    pub const FORWARD: ControlWord = ControlWord(Self::ENABLED.0 | Self::RUN_FORWARD);
    /// 0189h: running in reverse.
    pub const BACKWARD: ControlWord = ControlWord(Self::ENABLED.0 | Self::RUN_REVERSE);
    /// 2180h: resetting a trip; the edge counts, so [`IDLE`](Self::IDLE) stands before and after it.
    pub const RESETTING: ControlWord = ControlWord(Self::IDLE.0 | Self::RESET);

    const NAMES: [Option<&'static str>; 16] = [
        Some("enable"),
        Some("run forward"),
        Some("jog forward"),
        Some("run reverse"),
        Some("reverse"),
        Some("run"),
        Some("not stop"),
        Some("auto"),
        Some("remote"),
        Some("jog reverse"),
        None,
        None,
        Some("trip"),
        Some("reset"),
        Some("keypad watchdog"),
        None,
    ];

    /// All of `bits` are 1.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }

    /// One of `bits` is 1.
    pub const fn has_any(self, bits: u16) -> bool {
        self.0 & bits != 0
    }

    /// With `bits` as 1.
    pub const fn with(self, bits: u16) -> ControlWord {
        ControlWord(self.0 | bits)
    }

    /// With `bits` as 0.
    pub const fn without(self, bits: u16) -> ControlWord {
        ControlWord(self.0 & !bits)
    }

    /// The names of the bits that are 1. Reserved ones have none.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        names(self.0, &Self::NAMES)
    }
}

impl fmt::Debug for ControlWord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_word(f, "ControlWord", self.0, self.names())
    }
}

/// The status word, Pr 10.040: bit n is Pr 10.0(n + 1).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct StatusWord(pub u16);

impl StatusWord {
    /// Bit 0: 0 = tripped.
    pub const HEALTHY: u16 = 1 << 0;
    /// Bit 1: the power stage is on.
    pub const ACTIVE: u16 = 1 << 1;
    /// Bit 2: zero speed.
    pub const ZERO_SPEED: u16 = 1 << 2;
    /// Bit 3: at or below the minimum speed.
    pub const AT_MINIMUM: u16 = 1 << 3;
    /// Bit 4: below the set speed.
    pub const BELOW_SPEED: u16 = 1 << 4;
    /// Bit 5: at the set speed.
    pub const AT_SPEED: u16 = 1 << 5;
    /// Bit 6: above the set speed.
    pub const ABOVE_SPEED: u16 = 1 << 6;
    /// Bit 7: the load is reached.
    pub const LOAD_REACHED: u16 = 1 << 7;
    /// Bit 8: the current limit is active.
    pub const CURRENT_LIMIT: u16 = 1 << 8;
    /// Bit 9: regenerating.
    pub const REGENERATING: u16 = 1 << 9;
    /// Bit 10: the braking transistor is active.
    pub const BRAKING: u16 = 1 << 10;
    /// Bit 11: the braking resistor is getting too hot.
    pub const BRAKE_ALARM: u16 = 1 << 11;
    /// Bit 12: the reverse direction is commanded.
    pub const REVERSE_COMMANDED: u16 = 1 << 12;
    /// Bit 13: running in reverse.
    pub const REVERSE_RUNNING: u16 = 1 << 13;
    /// Bit 14: the mains are lost.
    pub const MAINS_LOSS: u16 = 1 << 14;
    /// The bits that count as a warning.
    pub const WARNINGS: u16 = Self::CURRENT_LIMIT | Self::BRAKE_ALARM | Self::MAINS_LOSS;

    const NAMES: [Option<&'static str>; 16] = [
        Some("healthy"),
        Some("active"),
        Some("zero speed"),
        Some("at or below minimum speed"),
        Some("below set speed"),
        Some("at speed"),
        Some("above set speed"),
        Some("load reached"),
        Some("current limit"),
        Some("regenerating"),
        Some("braking transistor active"),
        Some("braking resistor alarm"),
        Some("reverse commanded"),
        Some("reverse running"),
        Some("mains loss"),
        None,
    ];

    /// All of `bits` are 1.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }

    /// Not tripped.
    pub const fn healthy(self) -> bool {
        self.has(Self::HEALTHY)
    }

    /// The power stage is on.
    pub const fn active(self) -> bool {
        self.has(Self::ACTIVE)
    }

    /// Zero speed.
    pub const fn zero_speed(self) -> bool {
        self.has(Self::ZERO_SPEED)
    }

    /// At the set speed.
    pub const fn at_speed(self) -> bool {
        self.has(Self::AT_SPEED)
    }

    /// The names of the bits that are 1. Bit 15 is not used and has none.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        names(self.0, &Self::NAMES)
    }
}

impl fmt::Debug for StatusWord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_word(f, "StatusWord", self.0, self.names())
    }
}

fn names(word: u16, names: &'static [Option<&'static str>; 16]) -> impl Iterator<Item = &'static str> {
    names.iter().enumerate().filter(move |(bit, _)| word >> bit & 1 == 1).filter_map(|(_, name)| *name)
}

fn write_word(
    f: &mut fmt::Formatter<'_>,
    word: &str,
    bits: u16,
    names: impl Iterator<Item = &'static str>,
) -> fmt::Result {
    write!(f, "{word}({bits:#06x}")?;
    for (index, name) in names.enumerate() {
        write!(f, "{}{name}", if index == 0 { ": " } else { ", " })?;
    }
    f.write_str(")")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_useful_control_words_are_those_of_the_si_profibus_guide() {
        assert_eq!(ControlWord::IDLE.0, 0x0180);
        assert_eq!(ControlWord::ENABLED.0, 0x0181);
        assert_eq!(ControlWord::FORWARD.0, 0x0183);
        assert_eq!(ControlWord::BACKWARD.0, 0x0189);
        assert_eq!(ControlWord::RESETTING.0, 0x2180);
        assert_eq!(ControlWord::ANY_RUN, 0x022E);
    }

    #[test]
    fn a_word_in_a_message_names_its_bits() {
        let forward = ControlWord::FORWARD;
        assert_eq!(format!("{forward:?}"), "ControlWord(0x0183: enable, run forward, auto, remote)");
        assert_eq!(format!("{:?}", ControlWord(0x8C00)), "ControlWord(0x8c00)");
        let status = StatusWord(0x0007);
        assert_eq!(format!("{status:?}"), "StatusWord(0x0007: healthy, active, zero speed)");
        assert_eq!(StatusWord(0xFFFF).names().count(), 15);
        assert_eq!(ControlWord(0xFFFF).names().count(), 13);
    }

    #[test]
    fn bits_are_set_and_cleared_alone() {
        let word = ControlWord::ENABLED.with(ControlWord::RUN_FORWARD);
        assert_eq!(word, ControlWord::FORWARD);
        assert_eq!(word.without(ControlWord::ANY_RUN), ControlWord::ENABLED);
        assert!(word.has_any(ControlWord::ANY_RUN) && !ControlWord::ENABLED.has_any(ControlWord::ANY_RUN));
        assert!(!word.has(ControlWord::RUN_FORWARD | ControlWord::RUN_REVERSE));
    }

    #[test]
    fn ok_is_positive_logic() {
        assert!(!StatusWord(0).healthy());
        let running = StatusWord(StatusWord::HEALTHY | StatusWord::ACTIVE | StatusWord::AT_SPEED);
        assert!(running.healthy() && running.active() && running.at_speed() && !running.zero_speed());
    }
}
