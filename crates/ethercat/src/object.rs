//! How people write objects of a drive and their values, and the calls made from them.
//!
//! | address | access |
//! |---|---|
//! | `0x6041:0`, `6041h:0`, or a name of the [`catalogue`] | in its own type if it is known here; else read as it comes |
//! | `0x6041` | subindex 0 |
//! | `0x6041:0.u16`, `status-word.u16` | in this type: `i8`, `u8`, `i16`, `u16`, `i32`, `u32`, `text`, `octets` |
//! | `0x1C12:ca` | all subindices together (complete access), as bytes, to read only; a Kollmorgen drive refuses it |
//!
//! | value | means |
//! |---|---|
//! | `-15000` | a count, as sent on the wire |
//! | `0x3A98` | the bits of a count |
//! | `S700` | of a text, up to 128 characters |
//! | `01 A0 FF` | of octets, up to 128 of them |
//!
//! In a [`Call`] the service is [`READ`] or [`WRITE`], the address a packed [`Target`], the value the raw bits of a
//! count, or the characters of a text, the first in the lowest byte. The status of its answer is 0 or the drive's
//! abort code, or one of the [statuses](NO_MAILBOX) of the master.
//!
//! An object that is longer than the value of a call is read by a series of calls: [`READ`], followed by [`SIZE`]
//! and [`PART`]s of the data read. [`long::read`] does it. A longer value is written by [`LOAD`]s, followed by a
//! [`STORE`]: [`long::write`].

pub mod catalogue;
mod notation;
pub mod number;
pub mod pdo;

use fieldbeat_core::axis::acyclic::{Call, CallError, Commanding, Integer, decimal, hexadecimal};

pub use fieldbeat_core::axis::acyclic::long;
pub use fieldbeat_core::axis::acyclic::long::{LOAD, PART, READ, SIZE, STORE, Service, WRITE};
use fieldbeat_core::named;

pub use super::wire::sdo::Object;
pub use catalogue::{Access, Drives, ObjectInfo};
pub use notation::Objects;
pub use notation::string;

/// Status of a call: the slave has no mailbox. This status and those below are the master's own; abort codes begin far
/// above.
pub const NO_MAILBOX: u32 = 0x01;
/// Status of a call: there is no such call.
pub const NO_CALL: u32 = 0x02;
/// Status of a call: the slave did not take the previous message out of its mailbox.
pub const FULL: u32 = 0x03;
/// Status of a call: the slave's answer is not an SDO.
pub const BROKEN: u32 = 0x04;
/// Status of a call: a segment came twice, or one is missing.
pub const TOGGLE: u32 = 0x05;
/// Status of a call: the object ended before the size that the slave had announced.
pub const TRUNCATED: u32 = 0x06;
/// Status of a call: the object does not end.
pub const ENDLESS: u32 = 0x07;
/// Status of a call: there is no such part of the data read before it in its series.
pub const NOT_READ: u32 = 0x08;
/// Status of a call: the value to be written was not handed over whole before it in its series.
pub const NOT_LOADED: u32 = 0x09;
/// Status of a call: the value is longer than the drive's mailbox can take.
pub const EXPEDITED: u32 = 0x0A;
/// Status of a call: the answer to what it writes was lost, and the slave does not send it again: it may have been
/// written.
pub const UNCERTAIN: u32 = 0x0B;
/// Status of a call: the slave could not use the mailbox message; its [error](super::wire::mailbox::MailboxError) is
/// added.
pub const MAILBOX: u32 = 0x1_0000;

/// The meaning of a status of the master's own.
fn own_reason(status: u32) -> Option<&'static str> {
    Some(match status {
        NO_MAILBOX => "the slave has no mailbox",
        NO_CALL => "there is no such call",
        FULL => "the slave does not empty its mailbox",
        BROKEN => "the slave's answer is not an SDO",
        TOGGLE => "a segment of the answer came twice, or one is missing",
        TRUNCATED => "the answer is shorter than the slave announced",
        ENDLESS => "the answer is longer than the slave announced, or has no end",
        NOT_READ => "there is no such part of the data read before",
        NOT_LOADED => "the value was not handed over whole; raise parameter_queue",
        UNCERTAIN => "its answer was lost, and it may have been written: read it back, or write it again",
        EXPEDITED => "its mailbox of 16 bytes takes values of at most 4 bytes",
        _ => return None,
    })
}

/// The drive family: objects, PDOs and modes differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Family {
    /// S300, S400, S600, S700.
    #[default]
    S700,
    /// AKD.
    Akd,
}

named! {
    /// The type of an object. Its number is that in the address of a call.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    pub enum Type {
        /// INTEGER8.
        I8 = 1: "i8",
        /// UNSIGNED8.
        U8 = 2: "u8",
        /// INTEGER16.
        I16 = 3: "i16",
        /// UNSIGNED16.
        U16 = 4: "u16",
        /// INTEGER32.
        I32 = 5: "i32",
        /// UNSIGNED32.
        U32 = 6: "u32",
        /// VISIBLE_STRING: a call has eight characters of it, a series of calls more.
        Text = 7: "text",
        /// OCTET_STRING: the same of any bytes.
        Octets = 8: "octets",
    }
}

impl Type {
    /// It is a string: as long as it is, and no number.
    pub const fn is_string(self) -> bool {
        matches!(self, Type::Text | Type::Octets)
    }

    /// Bytes of a value; of a string, the most that a call has.
    pub const fn bytes(self) -> usize {
        match self {
            Type::I8 | Type::U8 => 1,
            Type::I16 | Type::U16 => 2,
            Type::I32 | Type::U32 => 4,
            Type::Text | Type::Octets => 8,
        }
    }

    pub(super) const fn is_signed(self) -> bool {
        matches!(self, Type::I8 | Type::I16 | Type::I32)
    }

    const fn integer(self) -> Integer {
        Integer { bits: 8 * self.bytes() as u32, signed: self.is_signed() }
    }

    /// The lowest and the highest value; meaningless for a string.
    pub const fn range(self) -> (i64, i64) {
        self.integer().range()
    }

    /// The value of raw bits. Higher bits are ignored.
    pub const fn number(self, raw: u64) -> i64 {
        self.integer().number(raw)
    }

    /// The raw bits of a value, 0 above them.
    pub const fn raw(self, number: i64) -> u64 {
        self.integer().raw(number)
    }
}

impl Object {
    /// `0x6041:0`, `6041h:0`, or without subindex for 0.
    pub fn parse(text: &str) -> Option<Object> {
        let (index, sub) = match text.split_once(':') {
            Some((index, sub)) => (index, subindex(sub)?),
            None => (text, 0),
        };
        let digits = index.strip_prefix("0x").or_else(|| index.strip_suffix('h'))?;
        let index = u16::try_from(hexadecimal(digits)?).ok().filter(|_| digits.len() == 4)?;
        Some(Object { index, sub })
    }

    /// The catalogue's entry.
    pub fn known(self) -> Option<&'static ObjectInfo> {
        catalogue::find(self)
    }
}

/// A subindex, without signs and superfluous zeros.
fn subindex(text: &str) -> Option<u8> {
    decimal(text).filter(|_| text == "0" || !text.starts_with('0'))
}

/// The object that a call reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Target {
    /// The object.
    pub object: Object,
    /// The type; `None`: as it comes, to read only.
    pub kind: Option<Type>,
    /// All its subindices together, to read only. It has no type.
    pub complete: bool,
}

/// With the type of a packed target: complete access.
const COMPLETE: u8 = 1 << 7;
/// The suffix of the index, as people write it.
const ALL_SUBS: &str = ":ca";

/// Packed: the type (0 = none, 80h = complete access), the index, the subindex.
impl long::Target for Target {
    fn pack(self) -> u32 {
        let [high, low] = self.object.index.to_be_bytes();
        let kind = if self.complete { COMPLETE } else { self.kind.map_or(0, |kind| kind as u8) };
        u32::from_be_bytes([kind, high, low, self.object.sub])
    }

    fn unpack(address: u32) -> Option<Target> {
        let [code, high, low, sub] = address.to_be_bytes();
        let kind = Type::ALL.into_iter().find(|kind| *kind as u8 == code);
        let object = Object::new(u16::from_be_bytes([high, low]), sub);
        let is_one = matches!(code, 0 | COMPLETE) || kind.is_some();
        is_one.then_some(Target { object, kind, complete: code == COMPLETE })
    }
}

impl Target {
    /// As people write it.
    pub fn parse(text: &str) -> Option<Target> {
        if let Some(index) = text.strip_suffix(ALL_SUBS).filter(|index| !index.contains(':')) {
            return Object::parse(index).map(|object| Target { object, kind: None, complete: true });
        }
        let (text, kind) = match text.rsplit_once('.') {
            Some((text, name)) => (text, Some(*Type::ALL.iter().find(|kind| kind.name() == name)?)),
            None => (text, None),
        };
        let object = Object::parse(text).or_else(|| catalogue::named(text).map(|known| known.object))?;
        let own = || object.known().map(|known| known.kind);
        Some(Target { object, kind: kind.or_else(own), complete: false })
    }
}

/// The calls that command a drive whose cyclic outputs are `mapped`.
pub fn commanding(mapped: impl IntoIterator<Item = Object>) -> Commanding {
    Commanding::new(refusal, mapped.into_iter().map(Object::key))
}

/// Why a call of the application is refused while the power of its drive is on: it writes an object that is exchanged,
/// or none that is known to be harmless.
fn refusal(call: &Call, mapped: &[u32]) -> Option<CallError> {
    let object = Service::<Target>::written(call)?.object;
    (mapped.contains(&object.key()) || !is_harmless(object.index)).then_some(CallError::Commands)
}

/// Written while power is on, it moves nothing, and changes no state: windows, limits, profiles and the settings of the
/// next homing. All others may: control word and mode, targets, offsets and factors, digital outputs (a brake), option
/// codes, PDOs and their assignment (16xxh, 1Axxh, 1C1xh), stored and restored settings. Of the manufacturer's objects
/// the public manuals say little (2308h and 2355h are setpoints; from 3500h on there are parameters and commands of the
/// ASCII interface): those count as commanding, too.
const fn is_harmless(index: u16) -> bool {
    matches!(
        index,
        0x20A4 // Latch control.
            | 0x6065..=0x6068 // Windows of following error and position.
            | 0x6072 | 0x607D | 0x607F | 0x6080 | 0x60E0 | 0x60E1 // Limits of torque, position and velocity.
            | 0x6081..=0x6087 // Profiles, from the next motion on.
            | 0x6098 | 0x6099 | 0x609A // Method, velocities and acceleration of homing.
            | 0x60C5 | 0x60C6 // Limits of acceleration.
    )
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use fieldbeat_core::axis::acyclic::long::Target as _;
    use fieldbeat_core::axis::acyclic::{Notation, NotationError};

    #[test]
    fn a_call_carries_type_index_and_subindex() {
        let call = |service, address, value| Ok(Call { service, address, value });
        assert_eq!(Objects.read("0x6041:0"), call(READ, 0x0460_4100, 0));
        assert_eq!(Objects.read("0x2F00:3"), call(READ, 0x002F_0003, 0));
        assert_eq!(Objects.write("control-word", 0x0F), call(WRITE, 0x0460_4000, 0x0F));
        assert_eq!(Objects.write("0x6060:0", u64::MAX), call(WRITE, 0x0160_6000, 0xFF));
        assert_eq!(Objects.write("0x6060:0", 0xFFFF_FFFF), call(WRITE, 0x0160_6000, 0xFF));
    }

    #[test]
    fn values_go_both_ways_in_their_own_type() {
        for (address, text, raw, number) in [
            ("control-word", "15", 0x0F, 15),
            ("control-word", "0x000F", 0x0F, 15),
            ("0x60C2:2", "-3", 0xFD, -3),
            ("0x6060:0", "-123", 0x85, -123),
            ("0x6060:0", "0x85", 0x85, -123),
            ("target-velocity", "-100000", 0xFFFE_7960, -100_000),
            ("0x2F00:3.u32", "4294967295", 0xFFFF_FFFF, 4_294_967_295),
        ] {
            assert_eq!(Objects.value(address, text), Ok(raw), "{address} {text}");
            assert_eq!(Objects.number(address, raw), number);
        }
        assert_eq!(Objects.show("status-word", 0x0637), "1591 (0x637)");
        assert_eq!(Objects.show("0x6061:0", 0x85), "-123 (0x85)");
        assert_eq!(Objects.show("0x2F00:3", 7), "7 (0x7)");
        assert_eq!(Objects.show("device-name", u64::from(u32::from_le_bytes(*b"S700"))), "S700");
        assert_eq!(Objects.value("0x2F00:3.text", "S700"), Ok(u64::from(u32::from_le_bytes(*b"S700"))));
        let long = "a text that is longer than eight characters";
        assert_eq!(Objects.write_long("0x2F00:3.text", long).map(|calls| calls.len()), Some(7));
        assert_eq!(Objects.write_long("0x2F00:3.octets", "01 02 0a").unwrap()[0].value, 0x0A_0201);
        for (address, text) in
            [("0x2F00:3.text", ""), ("0x2F00:3.octets", "1"), ("0x2F00:3.text", &*"x".repeat(129))]
        {
            assert!(matches!(Objects.value(address, text), Err(NotationError::Value { .. })), "{text}");
            assert_eq!(Objects.write_long(address, text), None);
        }
        assert_eq!(Objects.write_long("control-word", "15"), None);
    }

    #[test]
    fn a_refusal_is_reported_by_its_name() {
        assert_eq!(Objects.reason(0x0602_0000), "0x06020000 no such object");
        assert_eq!(Objects.reason(FULL), "the slave does not empty its mailbox");
        let refused = "the slave cannot use the mailbox message: 0x0002 protocol not supported";
        assert_eq!(Objects.reason(MAILBOX + 2), refused);
        assert_eq!(Objects.reason(0x0001_2345), "the slave cannot use the mailbox message: 0x2345");
        for status in NO_MAILBOX..=EXPEDITED {
            assert!(own_reason(status).is_some(), "{status}");
        }
    }

    #[test]
    fn all_subindices_are_read_together_and_not_written() {
        let target = Target { object: Object::new(0x1C12, 0), kind: None, complete: true };
        for text in ["0x1C12:ca", "1C12h:ca"] {
            assert_eq!(Target::parse(text), Some(target), "{text}");
        }
        assert_eq!(Target::unpack(target.pack()), Some(target));
        assert_eq!(target.pack(), 0x801C_1200);
        assert!(matches!(Objects.value("0x1C12:ca", "1"), Err(NotationError::ReadOnly { .. })));
        assert_eq!(Objects.show("0x1C12:ca", 0x1704_0001), "01 00 04 17 00 00 00 00");
    }

    proptest! {
        #[test]
        fn every_object_is_read_back_from_its_own_text(index: u16, sub: u8) {
            let object = Object::new(index, sub);
            prop_assert_eq!(Object::parse(&object.to_string()), Some(object));
        }

        #[test]
        fn every_target_is_unpacked_as_it_was_packed(address: u32) {
            if let Some(target) = Target::unpack(address) {
                prop_assert_eq!(target.pack(), address);
            } else {
                let code = address >> 24;
                prop_assert!(code > Type::ALL.len() as u32 && code != u32::from(COMPLETE));
            }
        }

        #[test]
        fn no_text_panics(address: String, text: String, raw: u64) {
            let _ = (Objects.value(&address, &text), Objects.show(&address, raw), Objects.write(&address, raw));
        }

        #[test]
        fn every_value_of_a_type_is_its_bits_and_back(raw: u64) {
            for kind in Type::ALL {
                let number = kind.number(raw);
                prop_assert_eq!(kind.number(kind.raw(number)), number);
            }
        }
    }
}
