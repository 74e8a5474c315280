//! Warnings and errors, with their names.
//!
//! Facts: "User Manual Motion Control SW" (SG5) 4.3.4, sections Warn Word and Error Codes.

use std::fmt;

debug_as_hex!(WarnWord, ErrorCode);

/// The warn word (SG5 manual).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct WarnWord(pub u16);

impl WarnWord {
    /// Bit 4: the following error is large.
    pub const POSITION_LAG: u16 = 1 << 4;
    /// Bit 7: the motor is not homed.
    pub const NOT_HOMED: u16 = 1 << 7;

    /// The name of a warning, `bit` 0 ... 15; `None` for a reserved bit.
    pub const fn name(bit: u32) -> Option<&'static str> {
        Some(match bit {
            0 => "motor hot (sensor)",
            1 => "motor short-time overload (I2t)",
            2 => "supply voltage low",
            3 => "supply voltage high",
            4 => "position lag",
            6 => "drive hot",
            7 => "motor not homed",
            8 => "PTC 1 hot",
            9 => "PTC 2 hot",
            10 => "regeneration resistor hot",
            11 => "speed lag",
            12 => "position sensor",
            14 => "interface",
            15 => "application",
            _ => return None,
        })
    }

    /// The names of the warnings that stand. Reserved bits have none.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        (0..16).filter(move |bit| self.0 >> bit & 1 == 1).filter_map(WarnWord::name)
    }
}

/// An error code (SG5 manual). Newer firmware has more: unknown codes stay numbers.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct ErrorCode(pub u16);

impl ErrorCode {
    /// 0000h: no error.
    pub const NONE: ErrorCode = ErrorCode(0x0000);
    /// 0007h: minimum position undershot.
    pub const MIN_POSITION: ErrorCode = ErrorCode(0x0007);
    /// 0008h: maximum position overshot.
    pub const MAX_POSITION: ErrorCode = ErrorCode(0x0008);
    /// 000Bh: position lag.
    pub const POSITION_LAG: ErrorCode = ErrorCode(0x000B);
    /// 0062h: the curve is not defined.
    pub const CURVE_NOT_DEFINED: ErrorCode = ErrorCode(0x0062);
    /// 0080h: the motor is not homed.
    pub const NOT_HOMED: ErrorCode = ErrorCode(0x0080);
    /// 0081h: unknown motion command.
    pub const UNKNOWN_COMMAND: ErrorCode = ErrorCode(0x0081);
    /// 0082h: the buffer of streamed setpoints overflowed.
    pub const STREAM_OVERFLOW: ErrorCode = ErrorCode(0x0082);
    /// 0083h: streamed setpoints did not come.
    pub const STREAM_UNDERFLOW: ErrorCode = ErrorCode(0x0083);
    /// 0084h: streamed setpoints come too fast.
    pub const STREAM_TOO_FAST: ErrorCode = ErrorCode(0x0084);
    /// 0085h: streamed setpoints come too slowly.
    pub const STREAM_TOO_SLOW: ErrorCode = ErrorCode(0x0085);
    /// 0086h: motion command in a state that accepts none.
    pub const WRONG_STATE: ErrorCode = ErrorCode(0x0086);
    /// 008Ah: the command table has no such entry.
    pub const ENTRY_MISSING: ErrorCode = ErrorCode(0x008A);

    /// The meaning, if known.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x0000 => "no error",
            0x0001 => "logic supply voltage low",
            0x0002 => "logic supply voltage high",
            0x0003 => "motor supply voltage low",
            0x0004 => "motor supply voltage high",
            0x0005 => "regeneration resistor not connected",
            0x0006 => "PTC 1 too hot",
            0x0007 => "minimum position undershot",
            0x0008 => "maximum position overshot",
            0x0009 => "difference between position sensors",
            0x000A => "external sensor signals missing (X12)",
            0x000B => "position lag",
            0x000C => "position lag at standstill",
            0x000D => "over-current (X1)",
            0x000E => "digital output supply missing",
            0x000F => "PTC 2 too hot",
            0x0010 => "bridge hot, phase 1+",
            0x0011 => "bridge hot, phase 1-",
            0x0012 => "bridge hot, phase 2+",
            0x0013 => "bridge hot, phase 2-",
            0x0014 => "power stage hot",
            0x0015 => "regeneration resistor driver hot",
            0x0016 => "X3 hot",
            0x0017 => "core hot",
            0x0018..=0x001B => "bridge defective",
            0x001C => "fuse X6",
            0x001D => "fuse X3.3",
            0x001E => "fuse X3.8",
            0x0020 => "motor too hot",
            0x0021 => "motor hall signals missing",
            0x0022 => "motor slider missing",
            0x0023 => "motor short-time overload",
            0x0024 => "regeneration resistor hot (calculated)",
            0x0025 => "sensor alarm",
            0x0028..=0x002B => "phase short to ground",
            0x002C => "short between phase 1 and phase 2",
            0x0030..=0x0039 => "motor wiring",
            0x003A => "phase U broken",
            0x003B => "phase V broken",
            0x003C => "phase W broken",
            0x0040 => "brake driver",
            0x0041 => "X4 output",
            0x0042 => "X6 output",
            0x0044 => "X4 ground fuse",
            0x0045 => "motor communication lost",
            0x0046 => "PTC 1 broken",
            0x0047 => "PTC 1 short circuit",
            0x0050 => "hardware not supported",
            0x0051 => "software key missing",
            0x0058 => "ROM write failed",
            0x0060 => "regeneration resistor voltage too low",
            0x0061 => "regeneration resistor hysteresis",
            0x0062 => "curve not defined",
            0x0063 => "maximum current setting",
            0x0064 => "no motor defined",
            0x0065 => "no trigger mode defined",
            0x0067 => "wrong stator",
            0x0068 => "no motor communication",
            0x0069 => "wrong slider",
            0x0080 => "motor not homed",
            0x0081 => "unknown motion command",
            0x0082 => "stream buffer overflow",
            0x0083 => "stream buffer underflow",
            0x0084 => "stream master too fast",
            0x0085 => "stream master too slow",
            0x0086 => "motion command in wrong state",
            0x0087 => "limit switch in",
            0x0088 => "limit switch out",
            0x0089 => "curve amplitude scale",
            0x008A => "command table entry missing",
            0x0090..=0x0093 => "not enough calculation time",
            0x00CD => "CANopen guard time-out",
            _ => return None,
        })
    }

    /// The error cannot be acknowledged: the drive has to be restarted.
    pub const fn is_fatal(self) -> bool {
        matches!(self.0, 0x000A | 0x000D | 0x0021 | 0x0022 | 0x0045 | 0x0064 | 0x0065 | 0x0067 | 0x0068)
    }
}

impl fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04X}h {}", self.0, self.name().unwrap_or("(not in the manual of 2014)"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_and_errors_have_their_names() {
        assert_eq!(WarnWord(0x2090).names().collect::<Vec<_>>(), ["position lag", "motor not homed"]);
        assert_eq!(ErrorCode::WRONG_STATE.name(), Some("motion command in wrong state"));
        assert_eq!(ErrorCode(0x0084).to_string(), "0084h stream master too fast");
        assert_eq!(ErrorCode(0xABCD).name(), None);
        let fatal: Vec<_> = (0..=u16::MAX).filter(|code| ErrorCode(*code).is_fatal()).collect();
        assert_eq!(fatal, [0x0A, 0x0D, 0x21, 0x22, 0x45, 0x64, 0x65, 0x67, 0x68]);
        assert!(fatal.iter().all(|code| ErrorCode(*code).name().is_some()));
    }
}
