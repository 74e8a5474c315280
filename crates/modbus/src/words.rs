//! Control word and status word of a Unidrive: bits with their names, nothing more.
//!
//! Facts: SI-PROFIBUS guide, control word and status word. What the available copy does not show is marked
//! *assumed*.

use std::fmt;

/// A word, and its bits: each with its number, and its name in messages. Reserved ones have none.
macro_rules! word {
    (
        $(#[$doc:meta])* $Word:ident;
        $($(#[$doc_of_bit:meta])* $BIT:ident = $bit:literal: $name:literal;)+
    ) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
        pub struct $Word(pub u16);

        impl $Word {
            $($(#[$doc_of_bit])* pub const $BIT: u16 = 1 << $bit;)+

            /// All of `bits` are 1.
            pub const fn has(self, bits: u16) -> bool {
                self.0 & bits == bits
            }

            /// The names of the bits that are 1.
            pub fn names(self) -> impl Iterator<Item = &'static str> {
                let names = [$(($Word::$BIT, $name)),+];
                names.into_iter().filter(move |(bit, _)| self.has(*bit)).map(|(_, name)| name)
            }
        }

        impl fmt::Debug for $Word {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                let names: Vec<&str> = self.names().collect();
                let colon = if names.is_empty() { "" } else { ": " };
                write!(f, "{}({:#06x}{colon}{})", stringify!($Word), self.0, names.join(", "))
            }
        }
    };
}

word! {
    /// The control word, Pr 06.042. A drive obeys it while its bit [`AUTO`](Self::AUTO) and Pr 06.043 are 1.
    ControlWord;
    /// Bit 0: 1 = enabled, if the hardware enable (safe torque off) is there as well; 0 = power stage off at once, the
    /// motor coasts.
    ENABLE = 0: "enable";
    /// Bit 1: 1 = run forward; 0 = ramp down to a stop.
    RUN_FORWARD = 1: "run forward";
    /// Bit 2: 1 = jog forward. Any of the run bits takes precedence.
    JOG_FORWARD = 2: "jog forward";
    /// Bit 3: 1 = run in reverse; 0 = ramp down to a stop.
    RUN_REVERSE = 3: "run reverse";
    /// Bit 4: the direction of bit 5: 1 = reverse.
    REVERSE = 4: "reverse";
    /// Bit 5: 1 = run, in the direction of bit 4.
    RUN = 5: "run";
    /// Bit 6: 1 = the sequencer may latch; 0 clears its latches. Pr 06.004 must suit.
    NOT_STOP = 6: "not stop";
    /// Bit 7: 1 = this word is obeyed, if Pr 06.043 is 1; 0 = the terminals are.
    AUTO = 7: "auto";
    /// Bit 8: 1 = the reference is preset 1, Pr 01.021; 0 = the analogue reference, Pr 01.036. Pr 01.014 and 01.015
    /// must be 0.
    REMOTE = 8: "remote";
    /// Bit 9: 1 = jog in reverse. Any of the run bits takes precedence.
    JOG_REVERSE = 9: "jog reverse";
    /// Bit 12: a rising edge trips the drive (assumed).
    TRIP = 12: "trip";
    /// Bit 13: a rising edge resets a trip (assumed).
    RESET = 13: "reset";
    /// Bit 14: arms a watchdog: the word has to be written again within about 1 s, or the drive trips (assumed).
    KEYPAD_WATCHDOG = 14: "keypad watchdog";
}

impl ControlWord {
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
}

word! {
    /// The status word, Pr 10.040: bit n is Pr 10.0(n + 1).
    StatusWord;
    /// Bit 0: 0 = tripped.
    HEALTHY = 0: "healthy";
    /// Bit 1: the power stage is on.
    ACTIVE = 1: "active";
    /// Bit 2: zero speed.
    ZERO_SPEED = 2: "zero speed";
    /// Bit 3: at or below the minimum speed.
    AT_MINIMUM = 3: "at or below minimum speed";
    /// Bit 4: below the set speed.
    BELOW_SPEED = 4: "below set speed";
    /// Bit 5: at the set speed.
    AT_SPEED = 5: "at speed";
    /// Bit 6: above the set speed.
    ABOVE_SPEED = 6: "above set speed";
    /// Bit 7: the load is reached.
    LOAD_REACHED = 7: "load reached";
    /// Bit 8: the current limit is active.
    CURRENT_LIMIT = 8: "current limit";
    /// Bit 9: regenerating.
    REGENERATING = 9: "regenerating";
    /// Bit 10: the braking transistor is active.
    BRAKING = 10: "braking transistor active";
    /// Bit 11: the braking resistor is getting too hot.
    BRAKE_ALARM = 11: "braking resistor alarm";
    /// Bit 12: the reverse direction is commanded.
    REVERSE_COMMANDED = 12: "reverse commanded";
    /// Bit 13: running in reverse.
    REVERSE_RUNNING = 13: "reverse running";
    /// Bit 14: the mains are lost.
    MAINS_LOSS = 14: "mains loss";
}

impl StatusWord {
    /// The bits that count as a warning.
    pub const WARNINGS: u16 = Self::CURRENT_LIMIT | Self::BRAKE_ALARM | Self::MAINS_LOSS;

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
}
