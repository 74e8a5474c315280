//! PDOs that the master makes of the drive's objects: 1600h ... 1603h and 1A00h ... 1A03h (CiA 301, 7.4).
//!
//! Knows which entries are where, not whether an object may be mapped.

use super::codec::mailbox::abort;
use super::codec::objects::{Object, Pdo, Type};

/// PDOs in each direction, and entries of each (assumed).
const PDOS: u16 = 4;
pub(super) const ENTRIES: usize = 8;
const OUTPUTS: u16 = 0x1600;
const INPUTS: u16 = 0x1A00;

/// All of them: the entries, and the PDO of those that its count activates.
#[derive(Debug)]
pub(super) struct Mapping(Vec<([u32; ENTRIES], Pdo)>);

impl Mapping {
    /// As delivered: none has an entry (assumed).
    pub(super) fn new() -> Mapping {
        let empty = |index| ([0; ENTRIES], Pdo { index, entries: Vec::new() });
        Mapping((OUTPUTS..OUTPUTS + PDOS).chain(INPUTS..INPUTS + PDOS).map(empty).collect())
    }

    /// Those that have entries.
    pub(super) fn pdos(&self) -> impl Iterator<Item = &Pdo> {
        self.0.iter().map(|(_, pdo)| pdo).filter(|pdo| !pdo.entries.is_empty())
    }

    /// Whether an object is one of theirs.
    pub(super) fn has(&self, object: Object) -> bool {
        self.0.iter().any(|(_, pdo)| pdo.index == object.index)
    }

    pub(super) fn read(&self, object: Object) -> Result<Vec<u8>, u32> {
        let pdo = self.0.iter().find(|(_, pdo)| pdo.index == object.index);
        let (entries, pdo) = pdo.ok_or(abort::NO_OBJECT)?;
        match usize::from(object.sub).checked_sub(1) {
            None => Ok(vec![pdo.entries.len() as u8]),
            Some(place) => entries.get(place).map(|entry| entry.to_le_bytes().to_vec()).ok_or(abort::NO_SUB),
        }
    }

    /// Writes the count, or an entry while the count is 0. `kind` returns the type of an object that may be mapped
    /// that way.
    pub(super) fn write(
        &mut self,
        object: Object,
        data: &[u8],
        kind: impl Fn(Object) -> Option<Type>,
    ) -> Result<(), u32> {
        let pdo = self.0.iter_mut().find(|(_, pdo)| pdo.index == object.index);
        let (entries, pdo) = pdo.ok_or(abort::NO_OBJECT)?;
        let entry = |raw: u32| {
            let (object, bits) = (Object::of(raw >> 8), raw as u8);
            let fits = kind(object).is_some_and(|kind| 8 * kind.bytes() == usize::from(bits));
            if fits { Ok((object, bits)) } else { Err(abort::NOT_MAPPABLE) }
        };
        let Some(place) = usize::from(object.sub).checked_sub(1) else {
            let &[count] = data else { return Err(abort::LENGTH) };
            let wanted = entries.get(..count.into()).ok_or(abort::HIGH)?;
            pdo.entries = wanted.iter().map(|raw| entry(*raw)).collect::<Result<_, _>>()?;
            return Ok(());
        };
        let slot = entries.get_mut(place).ok_or(abort::NO_SUB)?;
        let raw = u32::from_le_bytes(data.try_into().map_err(|_| abort::LENGTH)?);
        if !pdo.entries.is_empty() {
            return Err(abort::NOT_ZERO);
        }
        if raw != 0 {
            entry(raw)?;
        }
        *slot = raw;
        Ok(())
    }
}
