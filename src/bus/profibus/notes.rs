//! Why a drive is not in Data_Exchange, for normal threads: written by the cycle without a lock, made text by the
//! reader.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::bus;
use crate::net::LinkNotes;
use crate::rt::Regions;

/// Why a drive is not in Data_Exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Note {
    /// It is, or nothing is known yet.
    #[default]
    None,
    /// Nobody answers at its address.
    Absent,
    /// It has another ident number.
    Ident(u16),
    /// Another master has it.
    Locked(u8),
    /// It refuses its parametrisation.
    Parameters,
    /// It refuses its configuration.
    Configuration,
    /// It does not take a service, with this function of its answer.
    Refused {
        /// The service access point.
        sap: u8,
        /// UE, RR or RS.
        function: u8,
    },
    /// It does not become ready after its parametrisation and configuration.
    NotReady,
    /// Its watchdog is not on although it was set.
    Unwatched,
}

impl Note {
    fn pack(self) -> u64 {
        let (number, value) = match self {
            Note::None => (0, 0),
            Note::Absent => (1, 0),
            Note::Ident(ident) => (2, ident.into()),
            Note::Locked(master) => (3, master.into()),
            Note::Parameters => (4, 0),
            Note::Configuration => (5, 0),
            Note::Refused { sap, function } => (6, u64::from(sap) << 8 | u64::from(function)),
            Note::NotReady => (7, 0),
            Note::Unwatched => (8, 0),
        };
        number << 32 | value
    }

    fn unpack(packed: u64) -> Note {
        match packed >> 32 {
            1 => Note::Absent,
            2 => Note::Ident(packed as u16),
            3 => Note::Locked(packed as u8),
            4 => Note::Parameters,
            5 => Note::Configuration,
            6 => Note::Refused { sap: (packed >> 8) as u8, function: packed as u8 },
            7 => Note::NotReady,
            8 => Note::Unwatched,
            _ => Note::None,
        }
    }
}

/// What the reader knows of a drive by itself.
#[derive(Debug)]
pub(super) struct Known {
    pub address: u8,
    pub ident: u16,
    pub configuration: Vec<u8>,
}

/// The notes of the drives of a bus, and of its wire. Clones are the same notes.
#[derive(Clone, Debug)]
pub(super) struct WireNotes {
    shared: Arc<Shared>,
    port: LinkNotes,
}

#[derive(Debug)]
struct Shared {
    device: String,
    drives: Vec<(Known, AtomicU64)>,
    /// The address of another master + 1; 0: there is none.
    other: AtomicU64,
}

impl WireNotes {
    pub(super) fn new(device: &str, drives: Vec<Known>, port: LinkNotes) -> WireNotes {
        let drives = drives.into_iter().map(|known| (known, AtomicU64::new(0))).collect();
        WireNotes {
            shared: Arc::new(Shared { device: device.to_owned(), drives, other: AtomicU64::new(0) }),
            port,
        }
    }

    /// Adds what the cycle writes, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.shared);
        regions.add(&*self.shared.drives);
    }

    pub(super) fn set(&self, index: usize, note: Note) {
        if let Some((_, place)) = self.shared.drives.get(index) {
            place.store(note.pack(), Ordering::Relaxed);
        }
    }

    /// Another master is on the wire, or not any more.
    pub(super) fn set_other(&self, master: Option<u8>) {
        self.shared.other.store(master.map_or(0, |address| u64::from(address) + 1), Ordering::Relaxed);
    }
}

impl bus::Notes for WireNotes {
    fn get(&self, index: usize) -> Option<String> {
        if let Some(note) = self.port.get(0) {
            return Some(note);
        }
        let device = &self.shared.device;
        if let Some(master) = self.shared.other.load(Ordering::Relaxed).checked_sub(1) {
            return Some(format!(
                "another master, address {master}, sends on {device}: end it, or look where the cable leads"
            ));
        }
        let (Known { address, ident, configuration }, place) = self.shared.drives.get(index)?;
        Some(match Note::unpack(place.load(Ordering::Relaxed)) {
            Note::None | Note::Unwatched => return None,
            Note::Absent => format!(
                "nobody answers at address {address} on {device}: look at its power, its cable and terminators, its \
                 address and the rate"
            ),
            Note::Ident(found) => format!(
                "the slave at address {address} has ident number {found:#06x}, not {ident:#06x}: look whether it is \
                 the drive that is meant, and set ident"
            ),
            Note::Locked(master) => {
                format!(
                    "it is locked by another master, address {master}: end that one, or let it unlock the drive"
                )
            }
            Note::Parameters => {
                "it refuses its parametrisation (Prm_Fault): look at ident and user_prm, its GSD file \
                has them"
                    .to_owned()
            }
            Note::Configuration => format!(
                "it refuses its configuration {configuration:02X?} (Cfg_Fault): look at configuration, and at the \
                 process data that the drive is set to"
            ),
            Note::Refused { sap, function } => {
                let why = match function {
                    1 => "UE, user error",
                    2 => "RR, no resource",
                    _ => "RS, service not active",
                };
                format!(
                    "it refuses service access point {sap} ({why}): look whether it is a DP slave, and restart it"
                )
            }
            Note::NotReady => {
                "it is parametrised and configured, and does not become ready: look at its diagnosis"
                    .to_owned()
            }
        })
    }

    fn remark(&self, index: usize) -> Option<String> {
        let (_, place) = self.shared.drives.get(index)?;
        (Note::unpack(place.load(Ordering::Relaxed)) == Note::Unwatched).then(|| {
            "its diagnosis does not report its watchdog as on, although it was set: it is not enabled"
                .to_owned()
        })
    }
}
