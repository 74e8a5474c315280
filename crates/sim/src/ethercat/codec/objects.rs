//! The dictionary of a drive, its fixed PDOs, its modes and its faults.

use fieldbeat_ethercat::Family;

/// An object.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Object {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
}

impl Object {
    /// The object with these numbers.
    pub const fn new(index: u16, sub: u8) -> Object {
        Object { index, sub }
    }

    /// The object with these numbers in one, as in the entry of a PDO: the subindex is the low byte.
    pub const fn of(number: u32) -> Object {
        Object { index: (number >> 8) as u16, sub: number as u8 }
    }
}

/// The assignment of output PDOs, and of input PDOs.
pub const OUTPUT_PDO: u16 = 0x1C12;
/// See [`OUTPUT_PDO`].
pub const INPUT_PDO: u16 = 0x1C13;

/// Objects that a drive evaluates or shows.
pub mod number {
    use super::Object;

    constants! { Object:
        ERROR_REGISTER = Object::of(0x100100); MANUFACTURER_STATUS = Object::of(0x100200);
        ERROR_COUNT = Object::of(0x100300); LAST_ERROR = Object::of(0x100301);
        DEVICE_NAME = Object::of(0x100800); OUTPUT_CYCLE = Object::of(0x1C3202);
        INPUT_CYCLE = Object::of(0x1C3302); POSITION_2 = Object::of(0x205000);
        INCREMENTAL_SPEED = Object::of(0x207002); CYCLE_TIME = Object::of(0x35D501);
        ERROR_CODE = Object::of(0x603F00); CONTROL_WORD = Object::of(0x604000);
        STATUS_WORD = Object::of(0x604100); MODE = Object::of(0x606000);
        MODE_DISPLAY = Object::of(0x606100); INCREMENTS = Object::of(0x606300);
        POSITION = Object::of(0x606400); FOLLOWING_WINDOW = Object::of(0x606500);
        VELOCITY_SETPOINT = Object::of(0x606B00); VELOCITY = Object::of(0x606C00);
        TARGET_TORQUE = Object::of(0x607100); MAXIMUM_TORQUE = Object::of(0x607200);
        CURRENT_SETPOINT = Object::of(0x607400); TORQUE = Object::of(0x607700);
        TARGET_POSITION = Object::of(0x607A00); HOME_OFFSET = Object::of(0x607C00);
        MAXIMUM_VELOCITY = Object::of(0x607F00); MAXIMUM_SPEED = Object::of(0x608000);
        PROFILE_VELOCITY = Object::of(0x608100); ACCELERATION = Object::of(0x608300);
        DECELERATION = Object::of(0x608400); FEED = Object::of(0x609201); FEED_TURNS = Object::of(0x609202);
        FACTOR = Object::of(0x609301); DIVISOR = Object::of(0x609302); HOMING_METHOD = Object::of(0x609800);
        HOMING_SPEED = Object::of(0x609901); HOMING_ACCELERATION = Object::of(0x609A00);
        INTERPOLATION = Object::of(0x60C101); CYCLE_UNITS = Object::of(0x60C201);
        CYCLE_POWER = Object::of(0x60C202); POSITIVE_TORQUE = Object::of(0x60E000);
        NEGATIVE_TORQUE = Object::of(0x60E100); FOLLOWING_ERROR = Object::of(0x60F400);
        TARGET_VELOCITY = Object::of(0x60FF00);
    }
}

/// The type of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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
    /// The size in bytes.
    pub fn bytes(self) -> usize {
        match self {
            Type::I8 | Type::U8 => 1,
            Type::I16 | Type::U16 => 2,
            Type::I32 | Type::U32 | Type::Text => 4,
        }
    }

    /// The number whose low bits these are.
    pub fn number(self, raw: i64) -> i64 {
        let above = 64 - 8 * self.bytes();
        match self {
            Type::I8 | Type::I16 | Type::I32 => raw << above >> above,
            _ => (raw.cast_unsigned() << above >> above).cast_signed(),
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

/// Objects of one type with the same rights, each as index and subindex in one number.
type Group = (Type, Access, &'static [u32]);

macro_rules! groups {
    ($($kind:ident $access:ident: $($object:literal)*;)*) => {
        &[$((Type::$kind, Access::$access, &[$($object),*])),*]
    };
}

/// The dictionary of a drive family, in order. Where the manuals are silent, type, rights and range are assumed.
pub fn dictionary(family: Family) -> Vec<Row> {
    const BOTH: &[Group] = groups! {
        U32 Read: 0x100000 0x100200 0x100301 0x101801 0x101802 0x101803 0x101804 0x1C3202 0x1C3302 0x608F01
            0x608F02 0x60FD00;
        U8 Read: 0x100100 0x100300 0x101800 0x1C0000 0x1C0001 0x1C0002 0x1C0003 0x1C0004 0x1C3200 0x1C3300
            0x608F00 0x609200 0x609300 0x609900 0x60C100 0x60C200;
        Text Read: 0x100800 0x100900 0x100A00;
        U8 PreOp: 0x1C1200 0x1C1300;
        U16 PreOp: 0x1C1201 0x1C1301;
        U16 Write: 0x1C3201 0x1C3301 0x604000 0x607200;
        U16 Read: 0x604100;
        I8 Write: 0x606000 0x609800 0x60C202;
        I8 Read: 0x606100;
        I32 Read: 0x606300 0x606400 0x606C00;
        U32 Write: 0x606500 0x608100 0x608300 0x608400 0x609201 0x609202 0x609301 0x609302 0x609901 0x609902
            0x609A00;
        I16 Write: 0x607100;
        I16 Read: 0x607700;
        I32 Write: 0x607A00 0x607C00 0x60C101 0x60FF00;
        U8 Write: 0x60C201;
    };
    const S700: &[Group] = groups! {
        I32 Read: 0x207002;
        I32 Write: 0x35D501 0x606B00;
        I16 Write: 0x607400;
    };
    const AKD: &[Group] = groups! {
        I32 Read: 0x205000 0x20A000 0x60F400;
        U16 Write: 0x20A400 0x60E000 0x60E100;
        U16 Read: 0x20A500 0x603F00;
        I16 Write: 0x347003 0x60B200;
        I16 Read: 0x347004;
        U32 Write: 0x607F00 0x608000 0x60FE01;
        U8 Read: 0x60FE00;
    };
    let own = if family == Family::S700 { S700 } else { AKD };
    let each = |(kind, access, all): &Group| {
        let (kind, access) = (*kind, *access);
        all.iter().map(move |object| (Object::of(*object), kind, access, range(*object, kind)))
    };
    let mut all: Vec<Row> = BOTH.iter().chain(own).flat_map(each).collect();
    all.sort_by_key(|(object, ..)| *object);
    all
}

/// The values that an object may have: those of its type, with some exceptions.
fn range(object: u32, kind: Type) -> (i64, i64) {
    let all = match kind {
        Type::I8 | Type::I16 | Type::I32 => {
            let end = 1 << (8 * kind.bytes() - 1);
            (-end, end - 1)
        }
        _ => (0, (1 << (8 * kind.bytes())) - 1),
    };
    match object {
        0x1C1200 | 0x1C1300 => (0, 1),
        0x35D501 => (1, 127),
        0x609201 | 0x609202 | 0x609301 | 0x609302 | 0x60C201 => (1, all.1),
        0x609800 => (all.0, 35),
        0x60C202 => (-6, 0),
        _ => all,
    }
}

/// A PDO: its index, and the objects in it with their bits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pdo {
    /// The object of the PDO itself.
    pub index: u16,
    /// Objects and their bits, one behind the other.
    pub entries: Vec<(Object, u8)>,
}

impl Pdo {
    /// The master writes it.
    pub fn is_output(&self) -> bool {
        self.index < 0x1800
    }

    /// The value of a subindex of the PDO's own object: the number of entries, or one of them.
    pub fn value(&self, sub: u8) -> Option<Vec<u8>> {
        let Some(place) = usize::from(sub).checked_sub(1) else {
            return Some(vec![self.entries.len() as u8]);
        };
        self.entries.get(place).map(|(Object { index, sub }, bits)| {
            let [low, high] = index.to_le_bytes();
            vec![*bits, *sub, low, high]
        })
    }

    /// The size in bytes.
    pub fn size(&self) -> usize {
        self.entries.iter().map(|(_, bits)| usize::from(*bits) / 8).sum()
    }

    /// The objects, and where their bytes are.
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

/// The object of a PDO, and the objects in it.
type Content = (u16, &'static [u32]);

macro_rules! pdos {
    ($($pdo:literal: $($object:literal)*;)*) => {
        &[$(($pdo, &[$($object),*])),*]
    };
}

/// The PDOs that a drive family has from delivery. That of 1704h, and those of 1701h and 1B01h in an S700, are assumed.
pub fn fixed_pdos(family: Family) -> Vec<Pdo> {
    const S700: &[Content] = pdos! {
        0x1701: 0x60C101 0x604000;
        0x1702: 0x606B00 0x604000;
        0x1703: 0x607400 0x604000;
        0x1704: 0x607A00 0x604000;
        0x1B01: 0x606300 0x604100;
        0x1B03: 0x606400 0x607700 0x604100;
    };
    const AKD: &[Content] = pdos! {
        0x1701: 0x60C101 0x604000;
        0x1702: 0x60FF00 0x604000;
        0x1720: 0x604000 0x60C101 0x20A400 0x60B200 0x60FE01;
        0x1721: 0x60C101 0x604000 0x60B200;
        0x1724: 0x607A00 0x604000 0x60B200;
        0x1725: 0x604000 0x607A00 0x60FE01 0x60B200 0x347003 0x607200;
        0x1B01: 0x606300 0x604100;
        0x1B20: 0x606300 0x205000 0x606C00 0x60FD00 0x60F400 0x20A000 0x604100 0x607700 0x20A500 0x347004;
        0x1B24: 0x606400 0x604100;
        0x1B26: 0x604100 0x606400 0x607700 0x60FD00 0x347004 0x60F400;
    };
    let known = dictionary(family);
    let bits =
        |object: Object| known.iter().find(|(own, ..)| *own == object).map_or(0, |row| 8 * row.1.bytes());
    let entry = |object: &u32| (Object::of(*object), bits(Object::of(*object)) as u8);
    let all = if family == Family::S700 { S700 } else { AKD };
    all.iter()
        .map(|(index, objects)| Pdo { index: *index, entries: objects.iter().map(entry).collect() })
        .collect()
}

/// Bits of the manufacturer's status, 1002h (CAN manual).
pub mod manufacturer {
    constants! { u32:
        MOTION = 1 << 0; REFERENCE = 1 << 1; IN_POSITION = 1 << 3; POWER = 1 << 14;
        ERROR = 1 << 15; EMERGENCY_STOP = 1 << 19;
    }
}

/// Modes of operation, 6060h.
pub mod mode {
    constants! { i8:
        PROFILE_POSITION = 1; PROFILE_VELOCITY = 3; TORQUE = 4; HOMING = 6; INTERPOLATED = 7;
        CYCLIC_POSITION = 8; DIGITAL_VELOCITY = -128; DIGITAL_CURRENT = -126; TRAJECTORY = -123;
    }
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
/// The other category: bit 7 of the control word clears the fault.
pub const RESET: u8 = 2;

/// The category of the fault with a code (CAN manual).
pub fn category(code: u16) -> u8 {
    if matches!(code, 0x2380 | 0x4210 | 0x4310) { COLD_START } else { RESET }
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
