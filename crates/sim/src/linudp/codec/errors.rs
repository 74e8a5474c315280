//! Error codes of the motion control software, and their texts.

pub const NONE: u16 = 0x0000;
pub const MIN_POSITION: u16 = 0x0007;
pub const MAX_POSITION: u16 = 0x0008;
pub const POSITION_LAG: u16 = 0x000B;
pub const POSITION_LAG_STANDING: u16 = 0x000C;
pub const CURVE_NOT_DEFINED: u16 = 0x0062;
pub const NOT_HOMED: u16 = 0x0080;
pub const UNKNOWN_COMMAND: u16 = 0x0081;
pub const STREAM_OVERFLOW: u16 = 0x0082;
pub const STREAM_UNDERFLOW: u16 = 0x0083;
pub const STREAM_TOO_FAST: u16 = 0x0084;
pub const STREAM_TOO_SLOW: u16 = 0x0085;
pub const WRONG_STATE: u16 = 0x0086;
pub const CURVE_SCALE: u16 = 0x0089;
pub const ENTRY_MISSING: u16 = 0x008A;

/// Errors that no acknowledge removes.
const FATAL: [u16; 9] = [0x000A, 0x000D, 0x0021, 0x0022, 0x0045, 0x0064, 0x0065, 0x0067, 0x0068];

/// Whether only a restart removes it.
pub fn is_fatal(code: u16) -> bool {
    FATAL.contains(&code)
}

/// The text of an error; `None`: no such error.
pub fn text(code: u16) -> Option<&'static str> {
    let index = TEXTS.binary_search_by_key(&code, |(code, _)| *code).ok()?;
    Some(TEXTS[index].1)
}

#[rustfmt::skip]
const TEXTS: &[(u16, &str)] = &[
    (0x0000, "no error"),
    (0x0001, "logic supply voltage low"), (0x0002, "logic supply voltage high"),
    (0x0003, "motor supply voltage low"), (0x0004, "motor supply voltage high"),
    (0x0005, "regeneration resistor not connected"), (0x0006, "PTC 1 sensor hot"),
    (0x0007, "minimum position undershot"), (0x0008, "maximum position overshot"),
    (0x0009, "position sensor difference"), (0x000A, "X12 signals missing"),
    (0x000B, "position lag always"), (0x000C, "position lag standing"),
    (0x000D, "X1 over-current"), (0x000E, "digital output supply missing"), (0x000F, "PTC 2 sensor hot"),
    (0x0010, "bridge phase 1+ hot"), (0x0011, "bridge phase 1- hot"),
    (0x0012, "bridge phase 2+ hot"), (0x0013, "bridge phase 2- hot"),
    (0x0014, "power stage hot"), (0x0015, "RR driver hot"), (0x0016, "X3 hot"), (0x0017, "core hot"),
    (0x0018, "bridge phase 1+ defective"), (0x0019, "bridge phase 1- defective"),
    (0x001A, "bridge phase 2+ defective"), (0x001B, "bridge phase 2- defective"),
    (0x001C, "fuse X6"), (0x001D, "fuse X3.3"), (0x001E, "fuse X3.8"),
    (0x0020, "motor hot"), (0x0021, "hall signals missing"), (0x0022, "slider missing"),
    (0x0023, "motor short-time overload"), (0x0024, "RR hot calculated"), (0x0025, "sensor alarm"),
    (0x0028, "phase 1+ short to ground"), (0x0029, "phase 1- short to ground"),
    (0x002A, "phase 2+ short to ground"), (0x002B, "phase 2- short to ground"),
    (0x002C, "phase 1 short to phase 2"),
    (0x0030, "motor wiring 0"), (0x0031, "motor wiring 1"), (0x0032, "motor wiring 2"),
    (0x0033, "motor wiring 3"), (0x0034, "motor wiring 4"), (0x0035, "motor wiring 5"),
    (0x0036, "motor wiring 6"), (0x0037, "motor wiring 7"), (0x0038, "motor wiring 8"),
    (0x0039, "motor wiring 9"),
    (0x003A, "phase U broken"), (0x003B, "phase V broken"), (0x003C, "phase W broken"),
    (0x0040, "brake driver"), (0x0041, "X4 output"), (0x0042, "X6 output"), (0x0044, "X4 ground fuse"),
    (0x0045, "motor communication lost"), (0x0046, "PTC 1 broken wire"), (0x0047, "PTC 1 short circuit"),
    (0x0050, "hardware not supported"), (0x0051, "software key missing"), (0x0058, "ROM write error"),
    (0x0060, "RR voltage set too low"), (0x0061, "RR hysteresis"), (0x0062, "curve not defined"),
    (0x0063, "maximum current setting"), (0x0064, "no motor defined"), (0x0065, "no trigger mode defined"),
    (0x0067, "wrong stator type"), (0x0068, "no motor communication"), (0x0069, "wrong slider type"),
    (0x0080, "not homed"), (0x0081, "unknown motion command"),
    (0x0082, "stream buffer overflow"), (0x0083, "stream buffer underflow"),
    (0x0084, "stream master too fast"), (0x0085, "stream master too slow"),
    (0x0086, "motion command in wrong state"), (0x0087, "limit switch in"), (0x0088, "limit switch out"),
    (0x0089, "curve amplitude scale"), (0x008A, "command table entry missing"),
    (0x0090, "less calc time C0"), (0x0091, "less calc time C1"),
    (0x0092, "less calc time C2"), (0x0093, "less calc time C3"),
    (0x00CD, "CANopen guard time-out"),
];
