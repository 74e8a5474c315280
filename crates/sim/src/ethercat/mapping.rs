//! PDOs that the master makes of the drive's objects: 1600h ... 1603h and 1A00h ... 1A03h (CiA 301, 7.4).
//!
//! Knows which entries are where, not whether an object may be mapped.

use super::objects::abort;
use fieldbeat_ethercat::object::pdo::{Entry, Layout};
use fieldbeat_ethercat::object::{Object, Type};
use fieldbeat_ethercat::wire::sdo::AbortCode;

/// PDOs in each direction, and entries of each (assumed).
const PDOS: u16 = 4;
const ENTRIES: usize = 8;
const OUTPUTS: u16 = 0x1600;
const INPUTS: u16 = 0x1A00;

/// One of them.
#[derive(Debug)]
struct Pdo {
    entries: [u32; ENTRIES],
    /// The entries that its count activates.
    layout: Layout,
}

/// All of them.
#[derive(Debug)]
pub(super) struct Mapping(Vec<Pdo>);

impl Mapping {
    /// As delivered: none has an entry (assumed).
    pub(super) fn new() -> Mapping {
        let empty = |pdo| Pdo { entries: [0; ENTRIES], layout: Layout { pdo, entries: Vec::new() } };
        Mapping((OUTPUTS..OUTPUTS + PDOS).chain(INPUTS..INPUTS + PDOS).map(empty).collect())
    }

    /// Those that have entries.
    pub(super) fn layouts(&self) -> impl Iterator<Item = &Layout> {
        self.0.iter().map(|pdo| &pdo.layout).filter(|layout| !layout.entries.is_empty())
    }

    /// Whether an object is one of theirs.
    pub(super) fn has(&self, object: Object) -> bool {
        self.0.iter().any(|pdo| pdo.layout.pdo == object.index)
    }

    /// The number of subindices after the count.
    pub(super) fn subs(&self) -> u8 {
        ENTRIES as u8
    }

    pub(super) fn read(&self, object: Object) -> Result<Vec<u8>, AbortCode> {
        let pdo = self.0.iter().find(|pdo| pdo.layout.pdo == object.index).ok_or(AbortCode::NO_OBJECT)?;
        match usize::from(object.sub).checked_sub(1) {
            None => Ok(vec![pdo.layout.entries.len() as u8]),
            Some(place) => {
                pdo.entries.get(place).map(|entry| entry.to_le_bytes().to_vec()).ok_or(AbortCode::NO_SUB)
            }
        }
    }

    /// Writes the count, or an entry while the count is 0. `kind` returns the type of an object that may be mapped
    /// that way.
    pub(super) fn write(
        &mut self,
        object: Object,
        data: &[u8],
        kind: impl Fn(Object) -> Option<Type>,
    ) -> Result<(), AbortCode> {
        let pdo = self.0.iter_mut().find(|pdo| pdo.layout.pdo == object.index).ok_or(AbortCode::NO_OBJECT)?;
        let entry = |raw: u32| {
            let object = Object::new((raw >> 16) as u16, (raw >> 8) as u8);
            let kind = kind(object).filter(|kind| 8 * kind.bytes() == (raw & 0xFF) as usize);
            kind.map(|kind| Entry { object, kind }).ok_or(abort::NOT_MAPPABLE)
        };
        let Some(place) = usize::from(object.sub).checked_sub(1) else {
            let &[count] = data else { return Err(AbortCode::LENGTH) };
            let wanted = pdo.entries.get(..count.into()).ok_or(abort::HIGH)?;
            pdo.layout.entries = wanted.iter().map(|raw| entry(*raw)).collect::<Result<_, _>>()?;
            return Ok(());
        };
        let slot = pdo.entries.get_mut(place).ok_or(AbortCode::NO_SUB)?;
        let &[a, b, c, d] = data else { return Err(AbortCode::LENGTH) };
        if !pdo.layout.entries.is_empty() {
            return Err(abort::NOT_ZERO);
        }
        let raw = u32::from_le_bytes([a, b, c, d]);
        if raw != 0 {
            entry(raw)?;
        }
        *slot = raw;
        Ok(())
    }
}
