//! The objects of a drive: their values, and their access rights.
//!
//! Knows nothing of an object's effect.

use super::settings::DriveSettings;
use fieldbeat_ethercat::object::pdo::Layout;
use fieldbeat_ethercat::object::{Access, Drives, Family, Known, Object, Type, catalogue};
use fieldbeat_ethercat::wire::registers::AlState;
use fieldbeat_ethercat::wire::sdo::AbortCode;

/// Abort codes of a drive besides those that have a name everywhere (CAN manual).
pub(super) mod abort {
    use super::AbortCode;

    pub const NOT_ZERO: AbortCode = AbortCode(0x0601_0003);
    pub const NOT_MAPPABLE: AbortCode = AbortCode(0x0604_0041);
    pub const MAPPED: AbortCode = AbortCode(0x0601_0006);
    pub const INCOMPATIBLE: AbortCode = AbortCode(0x0604_0043);
    pub const HIGH: AbortCode = AbortCode(0x0609_0031);
    pub const LOW: AbortCode = AbortCode(0x0609_0032);
}

/// Bytes of a text: those of an expedited SDO.
const TEXT: usize = 4;

#[derive(Debug)]
struct Row {
    /// See [`key`]: here, so that a search stays within the rows.
    key: u32,
    known: &'static Known,
    /// Of a text, its characters.
    value: i64,
}

/// All objects of a drive, by index and subindex.
#[derive(Debug)]
pub(super) struct Objects {
    rows: Vec<Row>,
    /// The contents of its fixed PDOs, read only: each is an object with its own number (ETG.1000.6, 5.6.7.4).
    /// Masters read them to learn sizes.
    fixed: Vec<(Object, Vec<u8>)>,
    /// These can only be read, by their index.
    read_only: Vec<u16>,
}

impl Objects {
    /// As delivered.
    pub(super) fn new(settings: &DriveSettings) -> Objects {
        let has = |known: &&Known| match known.drives {
            Drives::All => true,
            Drives::S700 => settings.family == Family::S700,
            Drives::Akd => settings.family == Family::Akd,
        };
        let rows = catalogue::all()
            .filter(has)
            .filter(|known| !settings.without.contains(&known.object.index))
            .map(|known| Row { key: known.object.key(), known, value: 0 })
            .collect();
        let fixed = settings.layouts.iter().flat_map(mapping).collect();
        let mut objects = Objects { rows, fixed, read_only: settings.read_only.clone() };
        settings.delivered().into_iter().for_each(|(object, value)| objects.set(object, value));
        objects
    }

    fn find(&self, object: Object) -> Option<usize> {
        self.rows.binary_search_by_key(&object.key(), |row| row.key).ok()
    }

    /// The value of an object; 0 if it does not exist.
    pub(super) fn get(&self, object: Object) -> i64 {
        self.find(object).map_or(0, |place| self.rows[place].value)
    }

    /// It exists.
    pub(super) fn has(&self, object: Object) -> bool {
        self.find(object).is_some()
    }

    /// It exists, and may be written in some state.
    pub(super) fn is_settable(&self, object: Object) -> bool {
        self.has(object) && !self.read_only.contains(&object.index)
    }

    /// Sets a value that was checked, or that is the drive's own. Bits beyond its type are cut off.
    pub(super) fn set(&mut self, object: Object, value: i64) {
        if let Some(place) = self.find(object) {
            let kind = self.rows[place].known.kind;
            self.rows[place].value = kind.number(kind.raw(value));
        }
    }

    /// The entry of a fixed PDO.
    fn mapping(&self, object: Object) -> Option<&[u8]> {
        self.fixed.iter().find(|(own, _)| *own == object).map(|(_, bytes)| &bytes[..])
    }

    /// What is known of an existing object.
    fn known(&self, object: Object) -> Result<&'static Known, AbortCode> {
        match self.find(object) {
            Some(place) => Ok(self.rows[place].known),
            None => {
                let fixed = self.fixed.iter().map(|(own, _)| own);
                let mut all = self.rows.iter().map(|row| &row.known.object).chain(fixed);
                let is_there = all.any(|own| own.index == object.index);
                Err(if is_there { AbortCode::NO_SUB } else { AbortCode::NO_OBJECT })
            }
        }
    }

    /// Its bytes for an SDO.
    pub(super) fn read(&self, object: Object) -> Result<Vec<u8>, AbortCode> {
        if let Some(bytes) = self.mapping(object) {
            return Ok(bytes.to_vec());
        }
        let known = self.known(object)?;
        let raw = known.kind.raw(self.get(object)).to_le_bytes();
        Ok(raw[..length(known.kind)].to_vec())
    }

    /// Its size in an SDO, bytes.
    pub(super) fn size(&self, object: Object) -> Result<usize, AbortCode> {
        self.known(object).map(|known| length(known.kind))
    }

    /// The subindices of an object, in order.
    pub(super) fn subs(&self, index: u16) -> impl Iterator<Item = u8> {
        self.rows
            .iter()
            .map(|row| row.known.object)
            .filter(move |object| object.index == index)
            .map(|o| o.sub)
    }

    /// The type of an object that may be mapped to outputs, or to inputs.
    pub(super) fn mappable(&self, object: Object, output: bool) -> Option<Type> {
        let known = self.known(object).ok().filter(|known| !known.kind.is_string())?;
        (!output || known.access == Access::ReadWrite).then_some(known.kind)
    }

    /// The value that an SDO would write to it, if it may in this state.
    pub(super) fn written(&self, object: Object, data: &[u8], state: AlState) -> Result<i64, AbortCode> {
        if self.mapping(object).is_some() {
            return Err(AbortCode::READ_ONLY);
        }
        let known = self.known(object)?;
        match known.access {
            _ if self.read_only.contains(&object.index) => return Err(AbortCode::READ_ONLY),
            Access::ReadOnly => return Err(AbortCode::READ_ONLY),
            Access::PreOp if state != AlState::PreOp => return Err(AbortCode::STATE),
            Access::PreOp | Access::ReadWrite => {}
        }
        if data.len() != length(known.kind) {
            return Err(AbortCode::LENGTH);
        }
        let raw = data.iter().rev().fold(0_u64, |raw, byte| raw << 8 | u64::from(*byte));
        match known.kind.number(raw) {
            value if value > known.max => Err(abort::HIGH),
            value if value < known.min => Err(abort::LOW),
            value => Ok(value),
        }
    }
}

/// The objects of a fixed PDO: the number of entries, and index, subindex and bits of each.
fn mapping(layout: &Layout) -> Vec<(Object, Vec<u8>)> {
    let count = (Object::new(layout.pdo, 0), vec![layout.entries.len() as u8]);
    let entries = (1..).zip(&layout.entries).map(|(sub, entry)| {
        let [low, high] = entry.object.index.to_le_bytes();
        (Object::new(layout.pdo, sub), vec![8 * entry.kind.bytes() as u8, entry.object.sub, low, high])
    });
    std::iter::once(count).chain(entries).collect()
}

fn length(kind: Type) -> usize {
    if kind == Type::Text { TEXT } else { kind.bytes() }
}
