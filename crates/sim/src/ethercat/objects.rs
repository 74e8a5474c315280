//! The objects of a drive: their values, and their access rights.
//!
//! Knows nothing of an object's effect.

use super::codec::mailbox::abort;
use super::codec::objects::number::ERROR_COUNT;
use super::codec::objects::{Access, Object, Pdo, Row, Type, dictionary};
use super::codec::registers::AlState;
use super::settings::DriveSettings;

/// All objects of a drive, by index and subindex.
#[derive(Debug)]
pub(super) struct Objects {
    rows: Vec<Row>,
    /// Their values; of a text, its characters.
    values: Vec<i64>,
    /// The contents of its fixed PDOs, read only: each is an object with its own number (ETG.1000.6, 5.6.7.4).
    /// Masters read them to learn sizes.
    fixed: Vec<Pdo>,
    /// These can only be read, by their index.
    read_only: Vec<u16>,
}

impl Objects {
    /// As delivered.
    pub(super) fn new(settings: &DriveSettings) -> Objects {
        let mut rows = dictionary(settings.family);
        rows.retain(|(object, ..)| !settings.without.contains(&object.index));
        let values = vec![0; rows.len()];
        let (fixed, read_only) = (settings.layouts.clone(), settings.read_only.clone());
        let mut objects = Objects { rows, values, fixed, read_only };
        for place in 1..objects.rows.len() {
            // Subindex 0 is the highest one; no fault is stored in 1003h.
            let (Object { index, sub }, ..) = objects.rows[place];
            if sub > 0 && index != ERROR_COUNT.index {
                objects.set(Object::new(index, 0), sub.into());
            }
        }
        settings.delivered().into_iter().for_each(|(object, value)| objects.set(object, value));
        objects
    }

    fn find(&self, object: Object) -> Option<usize> {
        self.rows.binary_search_by_key(&object, |(own, ..)| *own).ok()
    }

    /// The value of an object; 0 if it does not exist.
    pub(super) fn get(&self, object: Object) -> i64 {
        self.find(object).map_or(0, |place| self.values[place])
    }

    /// Whether an object exists.
    pub(super) fn has(&self, object: Object) -> bool {
        self.find(object).is_some()
    }

    /// Whether an object exists and may be written in some state.
    pub(super) fn is_settable(&self, object: Object) -> bool {
        self.has(object) && !self.read_only.contains(&object.index)
    }

    /// Sets a value that was checked, or that is the drive's own. Bits beyond its type are cut off.
    pub(super) fn set(&mut self, object: Object, value: i64) {
        if let Some(place) = self.find(object) {
            self.values[place] = self.rows[place].1.number(value);
        }
    }

    /// The value of an object that describes a fixed PDO.
    fn fixed(&self, object: Object) -> Option<Vec<u8>> {
        self.fixed.iter().find(|pdo| pdo.index == object.index)?.value(object.sub)
    }

    /// The row of an existing object.
    fn row(&self, object: Object) -> Result<Row, u32> {
        let place = self.find(object).ok_or_else(|| {
            let fixed = self.fixed.iter().map(|pdo| pdo.index);
            let mut all = self.rows.iter().map(|(own, ..)| own.index).chain(fixed);
            if all.any(|index| index == object.index) { abort::NO_SUB } else { abort::NO_OBJECT }
        })?;
        Ok(self.rows[place])
    }

    /// The bytes of an object for an SDO.
    pub(super) fn read(&self, object: Object) -> Result<Vec<u8>, u32> {
        if let Some(bytes) = self.fixed(object) {
            return Ok(bytes);
        }
        let (_, kind, ..) = self.row(object)?;
        Ok(self.get(object).to_le_bytes()[..kind.bytes()].to_vec())
    }

    /// The size of an object in an SDO, bytes.
    pub(super) fn size(&self, object: Object) -> Result<usize, u32> {
        self.row(object).map(|(_, kind, ..)| kind.bytes())
    }

    /// The subindices of an object, in order.
    pub(super) fn subs(&self, index: u16) -> impl Iterator<Item = u8> {
        self.rows.iter().filter(move |(object, ..)| object.index == index).map(|(object, ..)| object.sub)
    }

    /// The type of an object that may be mapped to outputs, or to inputs.
    pub(super) fn mappable(&self, object: Object, output: bool) -> Option<Type> {
        let (_, kind, access, _) = self.row(object).ok()?;
        (kind != Type::Text && (!output || access == Access::Write)).then_some(kind)
    }

    /// The value that an SDO would write to it, if it may in this state.
    pub(super) fn written(&self, object: Object, data: &[u8], state: AlState) -> Result<i64, u32> {
        if self.fixed(object).is_some() {
            return Err(abort::READ_ONLY);
        }
        let (_, kind, access, (low, high)) = self.row(object)?;
        match access {
            _ if self.read_only.contains(&object.index) => return Err(abort::READ_ONLY),
            Access::Read => return Err(abort::READ_ONLY),
            Access::PreOp if state != AlState::PreOp => return Err(abort::STATE),
            Access::PreOp | Access::Write => {}
        }
        if data.len() != kind.bytes() {
            return Err(abort::LENGTH);
        }
        match kind.read(data) {
            value if value > high => Err(abort::HIGH),
            value if value < low => Err(abort::LOW),
            value => Ok(value),
        }
    }
}
