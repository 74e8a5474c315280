//! The dictionary of a drive, its fixed PDOs, its modes and its faults.

use fieldbeat_ethercat::Family;

/// An object.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Object {
    /// Its index.
    pub index: u16,
    /// Its subindex.
    pub sub: u8,
}

impl Object {
    /// The object with these numbers.
    pub const fn new(index: u16, sub: u8) -> Object {
        Object { index, sub }
    }
}

/// The assignment of output PDOs, and of input PDOs.
pub const OUTPUT_PDO: u16 = 0x1C12;
/// See [`OUTPUT_PDO`].
pub const INPUT_PDO: u16 = 0x1C13;

/// Objects that a drive evaluates or shows.
#[expect(missing_docs)]
pub mod number {
    use super::Object;

    pub const ERROR_REGISTER: Object = Object::new(0x1001, 0);
    pub const MANUFACTURER_STATUS: Object = Object::new(0x1002, 0);
    pub const ERROR_COUNT: Object = Object::new(0x1003, 0);
    pub const LAST_ERROR: Object = Object::new(0x1003, 1);
    pub const DEVICE_NAME: Object = Object::new(0x1008, 0);
    pub const OUTPUT_CYCLE: Object = Object::new(0x1C32, 2);
    pub const INPUT_CYCLE: Object = Object::new(0x1C33, 2);
    pub const POSITION_2: Object = Object::new(0x2050, 0);
    pub const INCREMENTAL_SPEED: Object = Object::new(0x2070, 2);
    pub const CYCLE_TIME: Object = Object::new(0x35D5, 1);
    pub const ERROR_CODE: Object = Object::new(0x603F, 0);
    pub const CONTROL_WORD: Object = Object::new(0x6040, 0);
    pub const STATUS_WORD: Object = Object::new(0x6041, 0);
    pub const MODE: Object = Object::new(0x6060, 0);
    pub const MODE_DISPLAY: Object = Object::new(0x6061, 0);
    pub const INCREMENTS: Object = Object::new(0x6063, 0);
    pub const POSITION: Object = Object::new(0x6064, 0);
    pub const FOLLOWING_WINDOW: Object = Object::new(0x6065, 0);
    pub const VELOCITY_SETPOINT: Object = Object::new(0x606B, 0);
    pub const VELOCITY: Object = Object::new(0x606C, 0);
    pub const TARGET_TORQUE: Object = Object::new(0x6071, 0);
    pub const MAXIMUM_TORQUE: Object = Object::new(0x6072, 0);
    pub const CURRENT_SETPOINT: Object = Object::new(0x6074, 0);
    pub const TORQUE: Object = Object::new(0x6077, 0);
    pub const TARGET_POSITION: Object = Object::new(0x607A, 0);
    pub const HOME_OFFSET: Object = Object::new(0x607C, 0);
    pub const MAXIMUM_VELOCITY: Object = Object::new(0x607F, 0);
    pub const MAXIMUM_SPEED: Object = Object::new(0x6080, 0);
    pub const PROFILE_VELOCITY: Object = Object::new(0x6081, 0);
    pub const ACCELERATION: Object = Object::new(0x6083, 0);
    pub const DECELERATION: Object = Object::new(0x6084, 0);
    pub const FEED: Object = Object::new(0x6092, 1);
    pub const FEED_TURNS: Object = Object::new(0x6092, 2);
    pub const FACTOR: Object = Object::new(0x6093, 1);
    pub const DIVISOR: Object = Object::new(0x6093, 2);
    pub const HOMING_METHOD: Object = Object::new(0x6098, 0);
    pub const HOMING_SPEED: Object = Object::new(0x6099, 1);
    pub const HOMING_ACCELERATION: Object = Object::new(0x609A, 0);
    pub const INTERPOLATION: Object = Object::new(0x60C1, 1);
    pub const CYCLE_UNITS: Object = Object::new(0x60C2, 1);
    pub const CYCLE_POWER: Object = Object::new(0x60C2, 2);
    pub const POSITIVE_TORQUE: Object = Object::new(0x60E0, 0);
    pub const NEGATIVE_TORQUE: Object = Object::new(0x60E1, 0);
    pub const FOLLOWING_ERROR: Object = Object::new(0x60F4, 0);
    pub const TARGET_VELOCITY: Object = Object::new(0x60FF, 0);
}

/// The type of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs)]
pub enum Type {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    /// Four characters.
    Text,
}

impl Type {
    /// Its size.
    pub fn bytes(self) -> usize {
        match self {
            Type::I8 | Type::U8 => 1,
            Type::I16 | Type::U16 => 2,
            Type::I32 | Type::U32 | Type::Text => 4,
        }
    }

    /// The number whose low bits these are.
    pub fn number(self, raw: i64) -> i64 {
        match self {
            Type::I8 => (raw as i8).into(),
            Type::U8 => (raw as u8).into(),
            Type::I16 => (raw as i16).into(),
            Type::U16 => (raw as u16).into(),
            Type::I32 => (raw as i32).into(),
            Type::U32 | Type::Text => (raw as u32).into(),
        }
    }

    /// The number in these bytes.
    pub fn read(self, bytes: &[u8]) -> i64 {
        self.number(bytes.iter().rev().fold(0, |raw, byte| raw << 8 | i64::from(*byte)))
    }
}

/// When an object may be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Never.
    Read,
    /// In PREOP.
    PreOp,
    /// Always.
    Write,
}

/// An object of the dictionary: its type, when it may be written, and the values that it may have.
pub type Row = (Object, Type, Access, (i64, i64));

/// The dictionary of a drive family, in order. Where the manuals are silent, type, rights and range are assumed.
pub fn dictionary(family: Family) -> Vec<Row> {
    use Access::{PreOp, Read, Write};
    use Type::{I8, I16, I32, Text, U8, U16, U32};
    let row = |(index, sub, kind, access): (u16, u8, Type, Access)| {
        let range = match kind {
            I8 => (i8::MIN.into(), i8::MAX.into()),
            U8 => (0, u8::MAX.into()),
            I16 => (i16::MIN.into(), i16::MAX.into()),
            U16 => (0, u16::MAX.into()),
            I32 => (i32::MIN.into(), i32::MAX.into()),
            U32 | Text => (0, u32::MAX.into()),
        };
        let range = match (index, sub) {
            (OUTPUT_PDO | INPUT_PDO, 0) => (0, 1),
            (0x35D5, 1) => (1, 127),
            (0x6092 | 0x6093, 1 | 2) | (0x60C2, 1) => (1, range.1),
            (0x6098, 0) => (range.0, 35),
            (0x60C2, 2) => (-6, 0),
            _ => range,
        };
        (Object::new(index, sub), kind, access, range)
    };
    let both = [
        (0x1000, 0, U32, Read),
        (0x1001, 0, U8, Read),
        (0x1002, 0, U32, Read),
        (0x1003, 0, U8, Read),
        (0x1003, 1, U32, Read),
        (0x1008, 0, Text, Read),
        (0x1009, 0, Text, Read),
        (0x100A, 0, Text, Read),
        (0x1018, 0, U8, Read),
        (0x1018, 1, U32, Read),
        (0x1018, 2, U32, Read),
        (0x1018, 3, U32, Read),
        (0x1018, 4, U32, Read),
        (0x1C00, 0, U8, Read),
        (0x1C00, 1, U8, Read),
        (0x1C00, 2, U8, Read),
        (0x1C00, 3, U8, Read),
        (0x1C00, 4, U8, Read),
        (OUTPUT_PDO, 0, U8, PreOp),
        (OUTPUT_PDO, 1, U16, PreOp),
        (INPUT_PDO, 0, U8, PreOp),
        (INPUT_PDO, 1, U16, PreOp),
        (0x1C32, 0, U8, Read),
        (0x1C32, 1, U16, Write),
        (0x1C32, 2, U32, Read),
        (0x1C33, 0, U8, Read),
        (0x1C33, 1, U16, Write),
        (0x1C33, 2, U32, Read),
        (0x6040, 0, U16, Write),
        (0x6041, 0, U16, Read),
        (0x6060, 0, I8, Write),
        (0x6061, 0, I8, Read),
        (0x6063, 0, I32, Read),
        (0x6064, 0, I32, Read),
        (0x6065, 0, U32, Write),
        (0x606C, 0, I32, Read),
        (0x6071, 0, I16, Write),
        (0x6072, 0, U16, Write),
        (0x6077, 0, I16, Read),
        (0x607A, 0, I32, Write),
        (0x607C, 0, I32, Write),
        (0x6081, 0, U32, Write),
        (0x6083, 0, U32, Write),
        (0x6084, 0, U32, Write),
        (0x608F, 0, U8, Read),
        (0x608F, 1, U32, Read),
        (0x608F, 2, U32, Read),
        (0x6092, 0, U8, Read),
        (0x6092, 1, U32, Write),
        (0x6092, 2, U32, Write),
        (0x6093, 0, U8, Read),
        (0x6093, 1, U32, Write),
        (0x6093, 2, U32, Write),
        (0x6098, 0, I8, Write),
        (0x6099, 0, U8, Read),
        (0x6099, 1, U32, Write),
        (0x6099, 2, U32, Write),
        (0x609A, 0, U32, Write),
        (0x60C1, 0, U8, Read),
        (0x60C1, 1, I32, Write),
        (0x60C2, 0, U8, Read),
        (0x60C2, 1, U8, Write),
        (0x60C2, 2, I8, Write),
        (0x60FD, 0, U32, Read),
        (0x60FF, 0, I32, Write),
    ];
    let own: &[_] = match family {
        Family::S700 => &[
            (0x2070, 2, I32, Read),
            (0x35D5, 1, I32, Write),
            (0x606B, 0, I32, Write),
            (0x6074, 0, I16, Write),
        ],
        Family::Akd => &[
            (0x2050, 0, I32, Read),
            (0x20A0, 0, I32, Read),
            (0x20A4, 0, U16, Write),
            (0x20A5, 0, U16, Read),
            (0x3470, 3, I16, Write),
            (0x3470, 4, I16, Read),
            (0x60B2, 0, I16, Write),
            (0x603F, 0, U16, Read),
            (0x607F, 0, U32, Write),
            (0x6080, 0, U32, Write),
            (0x60E0, 0, U16, Write),
            (0x60E1, 0, U16, Write),
            (0x60F4, 0, I32, Read),
            (0x60FE, 0, U8, Read),
            (0x60FE, 1, U32, Write),
        ],
    };
    let mut all: Vec<Row> = both.iter().chain(own).copied().map(row).collect();
    all.sort_by_key(|(object, ..)| *object);
    all
}

/// A PDO: its index, and the objects in it with their bits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pdo {
    /// Its own object.
    pub index: u16,
    /// Objects and their bits, one behind the other.
    pub entries: Vec<(Object, u8)>,
}

impl Pdo {
    /// The master writes it.
    pub fn is_output(&self) -> bool {
        self.index < 0x1800
    }

    /// Its bytes.
    pub fn size(&self) -> usize {
        self.entries.iter().map(|(_, bits)| usize::from(*bits) / 8).sum()
    }

    /// Its objects, and where their bytes are.
    pub fn places(&self) -> impl Iterator<Item = (Object, std::ops::Range<usize>)> {
        self.entries.iter().scan(0, |next, (object, bits)| {
            let at = *next;
            *next += usize::from(*bits) / 8;
            Some((*object, at..*next))
        })
    }

    /// Where an object is.
    pub fn place(&self, object: Object) -> Option<std::ops::Range<usize>> {
        self.places().find(|(own, _)| *own == object).map(|(_, place)| place)
    }
}

/// The PDOs that a drive family has from delivery. That of 1704h, and those of 1701h and 1B01h in an S700, are assumed.
pub fn fixed_pdos(family: Family) -> Vec<Pdo> {
    let pdo = |(index, entries): &(u16, &[(u16, u8, u8)])| Pdo {
        index: *index,
        entries: entries.iter().map(|(index, sub, bits)| (Object::new(*index, *sub), *bits)).collect(),
    };
    let (word, state) = ((0x6040, 0, 16), (0x6041, 0, 16));
    let interpolation = (0x60C1, 1, 32);
    match family {
        Family::S700 => [
            (0x1701, &[interpolation, word][..]),
            (0x1702, &[(0x606B, 0, 32), word]),
            (0x1703, &[(0x6074, 0, 16), word]),
            (0x1704, &[(0x607A, 0, 32), word]),
            (0x1B01, &[(0x6063, 0, 32), state]),
            (0x1B03, &[(0x6064, 0, 32), (0x6077, 0, 16), state]),
        ]
        .iter()
        .map(pdo)
        .collect(),
        Family::Akd => {
            let (offset, outputs) = ((0x60B2, 0, 16), (0x60FE, 1, 32));
            [
                (0x1701, &[interpolation, word][..]),
                (0x1702, &[(0x60FF, 0, 32), word]),
                (0x1720, &[word, interpolation, (0x20A4, 0, 16), offset, outputs]),
                (0x1721, &[interpolation, word, offset]),
                (0x1724, &[(0x607A, 0, 32), word, offset]),
                (0x1725, &[word, (0x607A, 0, 32), outputs, offset, (0x3470, 3, 16), (0x6072, 0, 16)]),
                (0x1B01, &[(0x6063, 0, 32), state]),
                (
                    0x1B20,
                    &[
                        (0x6063, 0, 32),
                        (0x2050, 0, 32),
                        (0x606C, 0, 32),
                        (0x60FD, 0, 32),
                        (0x60F4, 0, 32),
                        (0x20A0, 0, 32),
                        state,
                        (0x6077, 0, 16),
                        (0x20A5, 0, 16),
                        (0x3470, 4, 16),
                    ],
                ),
                (0x1B24, &[(0x6064, 0, 32), state]),
                (
                    0x1B26,
                    &[
                        state,
                        (0x6064, 0, 32),
                        (0x6077, 0, 16),
                        (0x60FD, 0, 32),
                        (0x3470, 4, 16),
                        (0x60F4, 0, 32),
                    ],
                ),
            ]
            .iter()
            .map(pdo)
            .collect()
        }
    }
}

/// Modes of operation, 6060h.
#[expect(missing_docs)]
pub mod mode {
    pub const PROFILE_POSITION: i8 = 1;
    pub const PROFILE_VELOCITY: i8 = 3;
    pub const TORQUE: i8 = 4;
    pub const HOMING: i8 = 6;
    pub const INTERPOLATED: i8 = 7;
    pub const CYCLIC_POSITION: i8 = 8;
    /// 80h and an OPMODE.
    pub const DIGITAL_VELOCITY: i8 = -128;
    pub const DIGITAL_CURRENT: i8 = -126;
    pub const TRAJECTORY: i8 = -123;
}

/// Whether a drive family has a mode.
pub fn has_mode(family: Family, mode: i8) -> bool {
    match family {
        Family::S700 => matches!(mode, 1 | 3 | 4 | 6 | 7 | -128..=-120),
        Family::Akd => matches!(mode, 1 | 3 | 4 | 6 | 7 | 8),
    }
}

/// Codes of faults that a drive has by itself.
pub mod fault {
    /// F28: the cycle is not regular. The code is assumed (CiA 301: a synchronisation).
    pub const SYNCHRONISATION: u16 = 0x8700;
    /// F03: too far behind a setpoint.
    pub const FOLLOWING: u16 = 0x8611;
}

/// The category of a fault, the first byte of the vendor's in its emergency: a cold start clears it.
pub const COLD_START: u8 = 1;
/// The same: bit 7 of the control word clears it.
pub const RESET: u8 = 2;

/// The category of the fault with a code.
pub fn category(code: u16) -> u8 {
    if matches!(code, 0x2330 | 0x2380) { COLD_START } else { RESET }
}

/// The bits of the error register that the fault with a code sets besides bit 0: current, voltage, temperature,
/// communication, profile (CiA 301).
pub fn error_register(code: u16) -> u8 {
    match code {
        0x2000..0x3000 => 0x02,
        0x3000..0x4000 => 0x04,
        0x4000..0x5000 => 0x08,
        fault::FOLLOWING => 0x20,
        0x8000..0x9000 => 0x10,
        _ => 0x00,
    }
}
