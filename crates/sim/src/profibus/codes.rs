//! The drive's parameters: a table of codes with their types, limits and values, common to all three ways to them.
//!
//! Knows no telegram. Facts: sheet, 0, 1, 2; the codes are those of Lenze's 8200 and 9300, limits and defaults assumed.

use super::settings::LenzeMotorSettings;

/// Counts of 1: four decimals.
pub(super) const ONE: i32 = 10_000;

/// Codes that the drive itself reads, or that show what it does.
pub(super) mod code {
    pub const SAVING: u16 = 3;
    pub const MAX_SPEED: u16 = 11;
    pub const ACCELERATION: u16 = 12;
    pub const DECELERATION: u16 = 13;
    pub const JOGS: u16 = 39;
    pub const TRIP_RESET: u16 = 43;
    pub const SPEED: u16 = 51;
    pub const TORQUE: u16 = 56;
    pub const TEMPERATURE: u16 = 61;
    pub const IDENTIFICATION: u16 = 93;
    pub const QUICK_STOP: u16 = 105;
    pub const STATUS_WORD: u16 = 150;
    pub const FAULTS: u16 = 168;
    pub const SOFTWARE: u16 = 200;
}

/// How a value looks on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Type {
    /// Integer32 with four decimals.
    Fixed,
    /// Unsigned16.
    Word,
    /// A visible string.
    Text(&'static str),
}

/// When it can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    Never,
    Always,
    /// Not while the drive runs.
    Inhibited,
}

struct Entry {
    code: u16,
    /// Subcodes 1 ... so many, with 0 for the first; 0: it has none.
    count: u8,
    of: Type,
    access: Access,
    range: (i32, i32),
    value: i32,
}

const fn entry(code: u16, access: Access, range: (i32, i32), value: i32) -> Entry {
    Entry { code, count: 0, of: Type::Fixed, access, range: (range.0 * ONE, range.1 * ONE), value }
}

const TABLE: [Entry; 14] = [
    entry(code::SAVING, Access::Always, (0, 1), ONE),
    entry(code::MAX_SPEED, Access::Inhibited, (1, 36_000), 1_500 * ONE),
    entry(code::ACCELERATION, Access::Always, (0, 1_300), 0),
    entry(code::DECELERATION, Access::Always, (0, 1_300), 0),
    Entry { count: 3, ..entry(code::JOGS, Access::Always, (-480, 480), 0) },
    entry(code::TRIP_RESET, Access::Always, (0, 1), 0),
    entry(code::SPEED, Access::Never, (0, 0), 0),
    entry(code::TORQUE, Access::Never, (0, 0), 0),
    entry(code::TEMPERATURE, Access::Never, (0, 0), 43 * ONE),
    Entry { of: Type::Word, ..entry(code::IDENTIFICATION, Access::Never, (0, 0), 2_133) },
    entry(code::QUICK_STOP, Access::Always, (0, 1_300), 0),
    Entry { of: Type::Word, ..entry(code::STATUS_WORD, Access::Never, (0, 0), 0) },
    Entry { of: Type::Word, count: 8, ..entry(code::FAULTS, Access::Never, (0, 0), 0) },
    Entry {
        of: Type::Text("82S8212V_31000 simulated, with EMF2133IB PROFIBUS-DP"),
        ..entry(code::SOFTWARE, Access::Never, (0, 0), 0)
    },
];

/// Why a parameter cannot be read or written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    NoCode,
    NoSubcode,
    ReadOnly,
    TooHigh,
    TooLow,
    State,
    WrongType,
    /// DRIVECOM: the data have another length.
    TooLong,
    TooShort,
    NotAnArray,
    NoText,
    ResponseTooLong,
    Count,
    Format,
    Axis,
    Service,
}

impl Refusal {
    /// Its number in a job of the PKW channel and in a parameter request.
    pub(super) fn number(self) -> u16 {
        match self {
            Refusal::NoCode => 0x00,
            Refusal::ReadOnly => 0x01,
            Refusal::TooHigh | Refusal::TooLow => 0x02,
            Refusal::NoSubcode => 0x03,
            Refusal::NotAnArray => 0x04,
            Refusal::WrongType | Refusal::TooLong | Refusal::TooShort => 0x05,
            Refusal::NoText => 0x0F,
            Refusal::State => 0x11,
            Refusal::ResponseTooLong => 0x15,
            Refusal::Count => 0x16,
            Refusal::Format | Refusal::Service => 0x17,
            Refusal::Axis => 0x19,
        }
    }

    /// Its code in the DRIVECOM channel: class, code, additional code.
    pub(super) fn drivecom(self) -> u32 {
        match self {
            Refusal::NoCode => 0x0607_0000,
            Refusal::NoSubcode | Refusal::NotAnArray | Refusal::Count => 0x0605_0011,
            Refusal::ReadOnly => 0x0603_0000,
            Refusal::TooHigh => 0x0800_0031,
            Refusal::TooLow => 0x0800_0032,
            Refusal::State => 0x0800_0022,
            Refusal::WrongType | Refusal::NoText | Refusal::Format => 0x0608_0000,
            Refusal::TooLong | Refusal::ResponseTooLong => 0x0605_0012,
            Refusal::TooShort => 0x0605_0013,
            Refusal::Axis => 0x0606_0000,
            Refusal::Service => 0x0605_0010,
        }
    }
}

/// The values of all codes.
#[derive(Debug)]
pub(super) struct Codes {
    /// By entry and subcode.
    values: Vec<Vec<i32>>,
    saved: Vec<Vec<i32>>,
    /// Writes that have gone to the EEPROM.
    pub eeprom_writes: u64,
}

impl Codes {
    pub(super) fn new(motor: &LenzeMotorSettings) -> Codes {
        let values: Vec<Vec<i32>> =
            TABLE.iter().map(|entry| vec![entry.value; usize::from(entry.count.max(1))]).collect();
        let mut codes = Codes { saved: values.clone(), values, eeprom_writes: 0 };
        let raw = |value: f64| (value * f64::from(ONE)).round() as i32;
        for (code, value) in [
            (code::MAX_SPEED, motor.full_rpm),
            (code::ACCELERATION, motor.ramps_s.0),
            (code::DECELERATION, motor.ramps_s.1),
            (code::QUICK_STOP, motor.ramps_s.2),
            (code::TEMPERATURE, motor.temperature),
        ] {
            codes.set(code, 0, raw(value));
        }
        codes.saved = codes.values.clone();
        codes
    }

    /// Power was lost, and what was not saved with it.
    pub(super) fn restart(&mut self) {
        self.values.clone_from(&self.saved);
    }

    /// The place of a code, and of its subcode. 0 is the first one of an array.
    fn place(code: u16, subcode: u16) -> Result<(usize, usize), Refusal> {
        let place = TABLE.iter().position(|entry| entry.code == code).ok_or(Refusal::NoCode)?;
        let sub = usize::from(subcode.saturating_sub(1));
        match subcode <= TABLE[place].count.into() {
            true => Ok((place, sub)),
            false => Err(Refusal::NoSubcode),
        }
    }

    /// The type of a code, and whether it has subcodes.
    pub(super) fn describe(code: u16, subcode: u16) -> Result<(Type, bool), Refusal> {
        let (place, _) = Codes::place(code, subcode)?;
        Ok((TABLE[place].of, TABLE[place].count > 0))
    }

    /// The value of a code; 0 if there is none.
    pub(super) fn get(&self, code: u16, subcode: u16) -> i32 {
        Codes::place(code, subcode).map_or(0, |(place, sub)| self.values[place][sub])
    }

    /// The drive itself sets a value.
    pub(super) fn set(&mut self, code: u16, subcode: u16, value: i32) {
        if let Ok((place, sub)) = Codes::place(code, subcode) {
            self.values[place][sub] = value;
        }
    }

    /// A master writes a value.
    pub(super) fn write(&mut self, code: u16, subcode: u16, value: i32, runs: bool) -> Result<(), Refusal> {
        let (place, sub) = Codes::place(code, subcode)?;
        let Entry { access, range: (low, high), .. } = TABLE[place];
        match access {
            Access::Never => return Err(Refusal::ReadOnly),
            Access::Inhibited if runs => return Err(Refusal::State),
            Access::Inhibited | Access::Always if value < low => return Err(Refusal::TooLow),
            Access::Inhibited | Access::Always if value > high => return Err(Refusal::TooHigh),
            Access::Inhibited | Access::Always => {}
        }
        self.values[place][sub] = value;
        if self.get(code::SAVING, 0) != 0 {
            self.saved[place][sub] = value;
            self.eeprom_writes += 1;
        }
        Ok(())
    }

    /// A fault is logged.
    pub(super) fn log(&mut self, fault: u16) {
        if let Ok((place, _)) = Codes::place(code::FAULTS, 0) {
            self.values[place].rotate_right(1);
            self.values[place][0] = fault.into();
            self.saved[place].clone_from(&self.values[place]);
        }
    }
}
