//! What the segment has to know of every slave, drive or not.

use crate::object::{Object, Type, long};
use crate::wire::sii::Identity;
use fieldbeat_core::time::S;

/// The most areas of outputs of a slave, and of inputs.
pub const MOST_AREAS: usize = 4;
/// The usual time for an answer to an SDO in descriptions of slaves (ETG.2000, `ResponseTimeout`).
const SDO_TIMEOUT_NS: u64 = 2 * S;
/// Longer than what they usually give a change of state: 3 s, and 10 s into SAFEOP and OP together (ETG.2000).
const STATE_TIMEOUT_NS: u64 = 5 * S;

/// The segment's settings of a slave, drive or not.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SlavePlan {
    /// The position in the segment: 0 is next to the master.
    pub place: u16,
    /// Who it has to be; a number that is left out may be any.
    pub identity: Expected,
    /// Where the mailbox is that the master writes, and the one that it reads; `None`: it has none.
    pub mailbox: Option<[Area; 2]>,
    /// Where its outputs are, and its inputs: an area for each SyncManager, in the order in which they stand in the
    /// process data; at most [`MOST_AREAS`].
    pub outputs: Vec<Area>,
    /// See `outputs`.
    pub inputs: Vec<Area>,
    /// The watchdog that makes it fall back by itself when no outputs come any more.
    pub watchdog: Watchdog,
    /// It has a clock, and makes SYNC0 of it.
    pub sync: bool,
    /// Compares all this with its SII, as far as that says anything.
    pub check_sii: bool,
    /// The time that it may take to answer an SDO, ns: the mailbox time-out of its description (ESI).
    pub sdo_timeout_ns: u64,
    /// The time that it may take to enter a state, ns, and twice that into OP, where a drive synchronises: the state
    /// machine time-outs of its description (ESI).
    pub state_timeout_ns: u64,
    /// Objects that are written in PREOP, in this order, behind those that select the PDOs.
    pub start_up: Vec<Start>,
    /// Objects that are read behind them, and have to be so. One that is a [factor](Start::factor) may be anything: the
    /// next one has to be that many times its value.
    pub verify: Vec<Start>,
    /// Objects that have to be so in a drive that is found in OP, or it is not taken over as it is.
    pub verify_found: Vec<Start>,
}

/// The SyncManager watchdog of a slave: without outputs for its time it falls back by itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Watchdog {
    /// As its SII has it: the control byte of its SyncManagers stands. If that arms a watchdog, its time is that of
    /// power-on, 100 ms. Without an SII, or without [`check_sii`](SlavePlan::check_sii), it is not armed.
    #[default]
    AsDelivered,
    /// It is armed with this time, ns, whatever the SII has. Some slaves accept the control byte of their SII only.
    After(u64),
    /// It is not armed, whatever the SII has.
    Off,
}

impl Watchdog {
    /// The time of one that the master arms, ns: of no other is it known.
    pub const fn ns(self) -> Option<u64> {
        match self {
            Watchdog::After(ns) => Some(ns),
            Watchdog::AsDelivered | Watchdog::Off => None,
        }
    }
}

/// Who a slave has to be. What is left out may be any.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Expected {
    /// The maker.
    pub vendor: Option<u32>,
    /// The product code.
    pub product: Option<u32>,
    /// Which form of it.
    pub revision: Option<u32>,
    /// Which one of them: the serial number in its SII.
    pub serial: Option<u32>,
    /// The configured station alias, as register 0012h has it since its power-on.
    pub alias: Option<u16>,
    /// The answer to a request for its identification: its selectors, or what was stored in it (ETG.1020).
    pub identification: Option<u16>,
}

/// A piece of a slave's memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Area {
    /// Where it begins.
    pub start: u16,
    /// Bytes.
    pub length: u16,
}

/// An object and what is written to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Start {
    /// Which.
    pub object: Object,
    /// The type: its size.
    pub kind: Type,
    /// The bits of its value.
    pub raw: u64,
    /// The bytes of a string, all of them; of others empty.
    pub string: Vec<u8>,
    /// A slave that does not have the object, or only lets it be read, comes up even so.
    pub optional: bool,
}

impl Start {
    /// An object with these raw bits.
    pub const fn new(object: Object, kind: Type, raw: u64) -> Start {
        Start { object, kind, raw, string: Vec::new(), optional: false }
    }

    /// A string of these bytes, at most 128: a text, or any.
    pub fn string(object: Object, kind: Type, string: Vec<u8>) -> Start {
        Start { object, kind, raw: long::raw(&string), string, optional: false }
    }

    /// An object that not every slave has: see [`optional`](Self::optional).
    pub const fn if_any(object: Object, kind: Type, raw: u64) -> Start {
        Start { object, kind, raw, string: Vec::new(), optional: true }
    }

    /// An object that is read, and not held against anything.
    const ANY: u64 = u64::MAX;

    /// In a list of objects that have to be so: the next one is to be as many times its value as this one says.
    pub const fn factor(object: Object, kind: Type) -> Start {
        Start::new(object, kind, Start::ANY)
    }

    /// See [`factor`](Self::factor).
    pub const fn is_factor(&self) -> bool {
        self.raw == Start::ANY
    }

    /// It selects process data, or maps them (CiA 301: 1600h ... 1BFFh, 1C10h ... 1C2Fh).
    #[doc(hidden)]
    pub const fn selects(&self) -> bool {
        matches!(self.object.index, 0x1600..=0x1BFF | 0x1C10..=0x1C2F)
    }

    /// Bytes that are written: of a string those that it has.
    pub const fn bytes(&self) -> usize {
        if self.string.is_empty() { self.kind.bytes() } else { self.string.len() }
    }
}

/// The station address of the slave next to the master.
pub const FIRST_STATION: u16 = 0x1001;

impl SlavePlan {
    /// The station address.
    pub fn station(&self) -> u16 {
        FIRST_STATION.wrapping_add(self.place)
    }

    /// Bytes of its outputs.
    pub fn output_bytes(&self) -> usize {
        bytes(&self.outputs)
    }

    /// Bytes of its inputs.
    pub fn input_bytes(&self) -> usize {
        bytes(&self.inputs)
    }

    /// A slave without a mailbox that exchanges nothing.
    pub fn new(place: u16) -> SlavePlan {
        SlavePlan {
            place,
            check_sii: true,
            sdo_timeout_ns: SDO_TIMEOUT_NS,
            state_timeout_ns: STATE_TIMEOUT_NS,
            ..SlavePlan::default()
        }
    }
}

fn bytes(areas: &[Area]) -> usize {
    areas.iter().map(|area| usize::from(area.length)).sum()
}

impl Area {
    /// Where it ends.
    #[doc(hidden)]
    pub const fn end(self) -> u32 {
        self.start as u32 + self.length as u32
    }

    /// The same areas with neighbours as one: each of these needs an FMMU.
    #[doc(hidden)]
    pub fn joined(areas: &[Area]) -> impl Iterator<Item = Area> {
        areas
            .chunk_by(|area, next| area.end() == u32::from(next.start))
            .filter_map(|all| Some(Area { start: all.first()?.start, length: bytes(all) as u16 }))
    }
}

impl Expected {
    /// The SII has a part of this.
    pub(crate) const fn is_in_sii(&self) -> bool {
        self.vendor.is_some() || self.product.is_some() || self.revision.is_some() || self.serial.is_some()
    }

    /// Whether a slave with this identity is of the expected kind.
    pub fn is(&self, found: Identity) -> bool {
        [(self.vendor, found.vendor), (self.product, found.product), (self.revision, found.revision)]
            .iter()
            .all(|(expected, found)| expected.is_none_or(|expected| expected == *found))
    }
}
