//! Layouts of the motion commands that the drive can run, or that its command table can.
//!
//! A command that is not here is unknown to the drive. The fields follow each other behind the header, without gaps;
//! a letter each:
//!
//! | letter | field |
//! |---|---|
//! | `P` `V` `A` `J` | position (i32, 0.1 um), velocity (u32, um/s), acceleration, deceleration (u32, 1e-5 m/s2), jerk (u32) |
//! | `p` `v` `a` | position (i16), velocity and acceleration (u16) of the 16-bit commands, each with a scale |
//! | `l` `u` `h` `w` | a number: i32, u32, i16, u16 |

/// The most fields of a command.
pub const FIELDS: usize = 5;

/// The fields of a command.
pub fn layout(id: u16) -> Option<&'static str> {
    Some(match (id >> 4, id & 0xF) {
        // No operation, clear events, reset.
        (0x00, 0x0 | 0x8 | 0xF) => "",
        // Control word, controller set.
        (0x00, 0x1 | 0x5) => "w",
        // UPID and value.
        (0x00, 0x2) => "wu",
        // Mask and value of outputs.
        (0x00, 0x3 | 0x4) => "ww",
        (0x00, 0x9) => "P",
        (0x01, 0x7) => "A",
        (0x01, 0x9) => "VAA",
        (0x01, _) => "PVAA",
        (0x02 | 0x0A, 0x7) | (0x02, 0xE | 0xF) => "",
        (0x02, 0x0..=0x4 | 0x8 | 0xA..=0xD) => "P",
        (0x03, 0x0 | 0x2) => "P",
        (0x03, 0x1 | 0x3) => "Pl",
        (0x03, 0x4 | 0x5) => "Pll",
        (0x03, 0xF) => "",
        // A curve's id; target, time; or offset, scale of time or time, amplitude.
        (0x04, 0x0 | 0x1) => "w",
        (0x04, 0x2 | 0xA | 0xC) => "wP",
        (0x04, 0x3 | 0xE | 0xF) => "wPl",
        (0x04, 0x4) => "wPwh",
        (0x04, 0x5..=0x7) => "wPlh",
        // Id, offset, the values written there.
        (0x05, 0x1) => "wwh",
        (0x05, 0x2 | 0x4) => "wwl",
        (0x05, 0x5) => "wwll",
        (0x05, 0x6) => "wwlll",
        (0x09, 0x7) => "a",
        (0x09, 0x0..=0x6 | 0x8 | 0xA..=0xF) => "pvaa",
        (0x0A, 0x0..=0x4 | 0x8 | 0xA..=0xD) => "p",
        (0x0B, 0x0..=0x4 | 0x8 | 0xA..=0xD) => "PV",
        (0x0C, 0x0..=0x4 | 0x8 | 0xA..=0xD) => "PVA",
        // Pressing, with a largest current.
        (0x0C, 0x5..=0x7) => "PVAw",
        (0x0C, 0xE | 0xF) => "VA",
        (0x0D, 0x0 | 0x9) => "PVAA",
        (0x0D, 0x1) => "pva",
        (0x0D, 0x4..=0x7) => "VAA",
        (0x0D, 0xE | 0xF) => "",
        (0x0E, 0x9) => "VA",
        (0x0E, 0x0 | 0x1 | 0x4 | 0x6 | 0x8 | 0xA..=0xD) => "PVA",
        (0x0F, 0x9) => "VAJ",
        (0x0F, 0x0 | 0x1 | 0x4 | 0x6 | 0x8 | 0xA..=0xD) => "PVAJ",
        // An entry of the command table; with an offset and the value written there.
        (0x20, 0x0..=0x2) => "w",
        (0x20, 0x8) => "wwh",
        (0x20, 0x9) => "wwl",
        (0x21, 0x0) => "u",
        (0x21, 0x1..=0x4 | 0x8 | 0x9) => "",
        (0x22, 0x0..=0xB) => "l",
        (0x22, 0xE | 0xF) => "h",
        (0x24, 0x0..=0x3) => "l",
        (0x24, 0x8 | 0x9 | 0xC..=0xE) => "w",
        // Condition, or mask and value; the entries if it holds and if not.
        (0x25, 0x0..=0x3 | 0x8..=0xF) | (0x26, 0x0 | 0x6) => "lww",
        (0x26, 0x2..=0x5) => "wwww",
        (0x39, 0x0) => "l",
        (0x39, 0xF) => "",
        (0x3A, 0x0 | 0x1) => "PVAAJ",
        _ => return None,
    })
}

/// The value of each field; 0 for those that the command does not have.
pub fn values(layout: &str, parameters: &[u8; 30]) -> [i64; FIELDS] {
    let mut values = [0; FIELDS];
    let mut rest = &parameters[..];
    for (value, letter) in values.iter_mut().zip(layout.chars()) {
        let (field, behind) = rest.split_at(width(letter));
        *value = match (letter, field) {
            ('P' | 'l', &[a, b, c, d]) => i32::from_le_bytes([a, b, c, d]).into(),
            (_, &[a, b, c, d]) => u32::from_le_bytes([a, b, c, d]).into(),
            ('p' | 'h', &[a, b]) => i16::from_le_bytes([a, b]).into(),
            (_, &[a, b]) => u16::from_le_bytes([a, b]).into(),
            _ => 0,
        };
        rest = behind;
    }
    values
}

/// The bytes of a field.
pub fn width(letter: char) -> usize {
    if matches!(letter, 'P' | 'V' | 'A' | 'J' | 'l' | 'u') { 4 } else { 2 }
}

/// How a stream command gives its setpoints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StreamKind(u16);

impl StreamKind {
    /// The kind of command 03`sub`x.
    pub fn of(sub: u16) -> Option<StreamKind> {
        (sub <= 5).then_some(StreamKind(sub))
    }

    /// With velocities; else bare positions.
    pub fn has_velocity(self) -> bool {
        !matches!(self.0, 0 | 2)
    }

    /// The time base is a configured period; else the time of reception.
    pub fn has_configured_period(self) -> bool {
        matches!(self.0, 2 | 3 | 5)
    }

    /// The shortest and the longest period, ns.
    pub fn periods_ns(self) -> (u64, u64) {
        if self.0 < 3 { (2_000_000, 5_000_000) } else { (400_000, 10_000_000) }
    }
}
