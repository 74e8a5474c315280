//! What is known of single objects, by index.
//!
//! Facts: CAN manual of the S300 and S700, EtherCAT manuals of this family and of the AKD, CiA 301 and 402. Types
//! and ranges that are in none of them are marked [`assumed`](ObjectInfo::assumed). A drive has many more objects, and
//! checks every value itself.
//!
//! Differences of an AKD:
//!
//! | object | S300 ... S700 | AKD |
//! |---|---|---|
//! | 6060h, 6061h | 1, 3, 4, 6, 7, 80h ... 88h | 8 (cyclic position) besides; no 80h ... 88h |
//! | 606Bh | the velocity setpoint of PDO 1702h | a demand, to read; its 1702h has 60FFh |
//! | 6074h | the current setpoint of PDO 1703h | a demand, to read |
//! | 60FFh | scaling assumed | 0.001 rpm (assumed) |
//! | texts | four characters, what an expedited SDO holds (assumed) | longer, in segments |

use super::Type::{I8, I16, I32, Text, U8, U16, U32};
use super::{Object, Type};
pub use fieldbeat_core::axis::acyclic::Rights as Access;

/// The drives that have an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drives {
    /// All of them.
    All,
    /// S300, S400, S600, S700.
    S700,
    /// AKD.
    Akd,
}

/// An entry of the catalogue of objects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectInfo {
    /// The object.
    pub object: Object,
    /// The name here.
    pub name: &'static str,
    /// The type.
    pub kind: Type,
    /// Whether it can be written.
    pub access: Access,
    /// The unit of a count; empty for a plain number, or where settings of the drive define it.
    pub unit: &'static str,
    /// The lowest count.
    pub min: i64,
    /// The highest count.
    pub max: i64,
    /// Which drives have it.
    pub drives: Drives,
    /// Type, access or range are not from a document.
    pub assumed: bool,
}

/// An object that can be read, of all drives.
const fn known(kind: Type, index: u16, sub: u8, name: &'static str) -> ObjectInfo {
    let (object, (min, max)) = (Object::new(index, sub), kind.range());
    let (access, drives) = (Access::ReadOnly, Drives::All);
    ObjectInfo { object, name, kind, access, unit: "", min, max, drives, assumed: false }
}

impl ObjectInfo {
    const fn writable(self) -> ObjectInfo {
        ObjectInfo { access: Access::ReadWrite, ..self }
    }

    const fn in_pre_op(self) -> ObjectInfo {
        ObjectInfo { access: Access::PreOp, ..self }
    }

    const fn unit(self, unit: &'static str) -> ObjectInfo {
        ObjectInfo { unit, ..self }
    }

    const fn within(self, min: i64, max: i64) -> ObjectInfo {
        ObjectInfo { min, max, ..self }
    }

    const fn s700(self) -> ObjectInfo {
        ObjectInfo { drives: Drives::S700, ..self }
    }

    const fn akd(self) -> ObjectInfo {
        ObjectInfo { drives: Drives::Akd, ..self }
    }

    const fn assume(self) -> ObjectInfo {
        ObjectInfo { assumed: true, ..self }
    }
}

const ALL: &[ObjectInfo] = &[
    // Communication.
    known(U32, 0x1000, 0, "device-type"),
    known(U8, 0x1001, 0, "error-register"),
    known(U32, 0x1002, 0, "manufacturer-status"),
    known(U8, 0x1003, 0, "error-count").assume(),
    known(U32, 0x1003, 1, "last-error").assume(),
    known(Text, 0x1008, 0, "device-name").assume(),
    known(Text, 0x1009, 0, "hardware-version").assume(),
    known(Text, 0x100A, 0, "software-version").assume(),
    known(U8, 0x1018, 0, "identity-count"),
    known(U32, 0x1018, 1, "vendor"),
    known(U32, 0x1018, 2, "product"),
    known(U32, 0x1018, 3, "revision"),
    known(U32, 0x1018, 4, "serial-number"),
    known(U8, 0x1C00, 0, "sync-manager-count"),
    known(U8, 0x1C00, 1, "sync-manager-0-type"),
    known(U8, 0x1C00, 2, "sync-manager-1-type"),
    known(U8, 0x1C00, 3, "sync-manager-2-type"),
    known(U8, 0x1C00, 4, "sync-manager-3-type"),
    known(U8, 0x1C12, 0, "output-pdo-count").within(0, 1).in_pre_op(),
    known(U16, 0x1C12, 1, "output-pdo").in_pre_op(),
    known(U8, 0x1C13, 0, "input-pdo-count").within(0, 1).in_pre_op(),
    known(U16, 0x1C13, 1, "input-pdo").in_pre_op(),
    known(U8, 0x1C32, 0, "output-sync-count").assume(),
    known(U16, 0x1C32, 1, "output-sync-type").writable().assume(),
    known(U32, 0x1C32, 2, "output-sync-cycle").unit("ns").assume(),
    known(U8, 0x1C33, 0, "input-sync-count").assume(),
    known(U16, 0x1C33, 1, "input-sync-type").writable().assume(),
    known(U32, 0x1C33, 2, "input-sync-cycle").unit("ns").assume(),
    // The manufacturer's.
    known(I32, 0x2050, 0, "position-2").akd(),
    known(I32, 0x2070, 2, "incremental-speed").s700().assume(),
    known(I32, 0x20A0, 0, "latch-position").akd().assume(),
    known(U16, 0x20A4, 0, "latch-control").writable().akd(),
    known(U16, 0x20A5, 0, "latch-status").akd(),
    known(I16, 0x3470, 3, "analogue-output").writable().akd().assume(),
    known(I16, 0x3470, 4, "analogue-input").akd().assume(),
    known(I32, 0x35D5, 1, "cycle-time").within(1, 127).unit("x 250 us").writable().s700().assume(),
    // CiA 402.
    known(U16, 0x603F, 0, "error-code").akd().assume(),
    known(U16, 0x6040, 0, "control-word").writable(),
    known(U16, 0x6041, 0, "status-word"),
    known(I8, 0x6060, 0, "mode").writable(),
    known(I8, 0x6061, 0, "mode-display"),
    known(I32, 0x6063, 0, "position-increments").unit("increments"),
    known(I32, 0x6064, 0, "position"),
    known(U32, 0x6065, 0, "following-error-window").writable().assume(),
    known(I32, 0x606B, 0, "velocity-setpoint").writable().s700(),
    known(I32, 0x606C, 0, "velocity"),
    known(I16, 0x6071, 0, "target-torque").unit("per mille").writable(),
    known(U16, 0x6072, 0, "maximum-torque").unit("per mille").writable().assume(),
    known(I16, 0x6074, 0, "current-setpoint").writable().s700(),
    known(I16, 0x6077, 0, "torque").unit("per mille"),
    known(I32, 0x607A, 0, "target-position").writable(),
    known(I32, 0x607C, 0, "home-offset").writable().assume(),
    known(U32, 0x607F, 0, "maximum-velocity").writable().akd().assume(),
    known(U32, 0x6080, 0, "maximum-speed").unit("rpm").writable().akd().assume(),
    known(U32, 0x6081, 0, "profile-velocity").writable(),
    known(U32, 0x6083, 0, "profile-acceleration").writable(),
    known(U32, 0x6084, 0, "profile-deceleration").writable(),
    known(U8, 0x608F, 0, "resolution-count"),
    known(U32, 0x608F, 1, "resolution-increments").unit("increments"),
    known(U32, 0x608F, 2, "resolution-turns"),
    known(U8, 0x6092, 0, "feed-count"),
    known(U32, 0x6092, 1, "feed").within(1, u32::MAX as i64).writable(),
    known(U32, 0x6092, 2, "feed-turns").within(1, u32::MAX as i64).writable(),
    known(U8, 0x6093, 0, "position-factor-count"),
    known(U32, 0x6093, 1, "position-factor").within(1, u32::MAX as i64).writable(),
    known(U32, 0x6093, 2, "position-factor-divisor").within(1, u32::MAX as i64).writable(),
    known(I8, 0x6098, 0, "homing-method").within(-128, 35).writable().assume(),
    known(U8, 0x6099, 0, "homing-speed-count").assume(),
    known(U32, 0x6099, 1, "homing-speed-switch").writable().assume(),
    known(U32, 0x6099, 2, "homing-speed-zero").writable().assume(),
    known(U32, 0x609A, 0, "homing-acceleration").writable().assume(),
    known(I16, 0x60B2, 0, "torque-feed-forward").writable().akd(),
    known(U8, 0x60C1, 0, "interpolation-count"),
    known(I32, 0x60C1, 1, "interpolation-position").writable(),
    known(U8, 0x60C2, 0, "interpolation-time-count"),
    known(U8, 0x60C2, 1, "interpolation-time").within(1, 255).writable(),
    known(I8, 0x60C2, 2, "interpolation-time-power").within(-6, 0).writable(),
    known(U16, 0x60E0, 0, "positive-torque-limit").unit("per mille").writable().akd().assume(),
    known(U16, 0x60E1, 0, "negative-torque-limit").unit("per mille").writable().akd().assume(),
    known(I32, 0x60F4, 0, "following-error").akd(),
    known(U32, 0x60FD, 0, "digital-inputs"),
    known(U8, 0x60FE, 0, "digital-outputs-count").akd(),
    known(U32, 0x60FE, 1, "digital-outputs").writable().akd(),
    known(I32, 0x60FF, 0, "target-velocity").writable(),
];

/// All of them, by index and subindex.
pub fn all() -> impl Iterator<Item = &'static ObjectInfo> {
    ALL.iter()
}

/// The catalogue's entry of an object.
pub fn find(object: Object) -> Option<&'static ObjectInfo> {
    ALL.binary_search_by_key(&object.key(), |known| known.object.key()).ok().map(|place| &ALL[place])
}

/// The one of this name.
pub fn named(name: &str) -> Option<&'static ObjectInfo> {
    all().find(|known| known.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_are_found_by_object_and_by_name_and_have_ranges_within_their_type() {
        for known in all() {
            assert_eq!(find(known.object), Some(known));
            assert_eq!(named(known.name), Some(known));
            assert_eq!(Object::parse(known.name), None, "{} is no address", known.name);
            let (low, high) = known.kind.range();
            assert!(low <= known.min && known.min <= known.max && known.max <= high, "{}", known.name);
        }
        assert_eq!(find(Object::new(0x6041, 1)), None);
        assert_eq!(named("6041"), None);
    }

    #[test]
    fn types_are_those_of_the_manuals() {
        for (kind, access, objects) in [
            (Type::U16, Access::ReadWrite, "0x6040:0"),
            (Type::U16, Access::ReadOnly, "0x6041:0"),
            (Type::I8, Access::ReadWrite, "0x6060:0 0x60C2:2"),
            (Type::I32, Access::ReadOnly, "0x6064:0"),
            (Type::I32, Access::ReadWrite, "0x606B:0 0x60C1:1"),
            (Type::I16, Access::ReadOnly, "0x6077:0"),
            (Type::U8, Access::ReadWrite, "0x60C2:1"),
            (Type::U32, Access::ReadOnly, "0x1002:0"),
            (Type::U16, Access::PreOp, "0x1C12:1"),
        ] {
            for known in objects.split(' ').map(|text| find(Object::parse(text).unwrap()).unwrap()) {
                assert_eq!((known.kind, known.access), (kind, access), "{}", known.name);
            }
        }
    }
}
