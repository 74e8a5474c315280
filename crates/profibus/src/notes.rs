//! Why a drive is not in Data_Exchange, for normal threads: written by the cycle without a lock, made text by the
//! reader.

use std::sync::Arc;

use crossbeam::atomic::AtomicCell;

use super::wire::fc;
use fieldbeat_core::bus;
use fieldbeat_core::net::LinkNotes;
use fieldbeat_core::rt::Regions;

/// Why a drive is not in Data_Exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(align(4))] // A word is written without a lock.
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
    /// The wire is never silent for long enough to be claimed, and what is received on it is no telegram.
    Noisy,
}

const _: () = assert!(AtomicCell::<Note>::is_lock_free());

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
    /// The address of this master.
    own: u8,
    drives: Vec<(Known, AtomicCell<Note>)>,
    /// That of the wire: another master has it, it is noisy, or none.
    wire: AtomicCell<Note>,
}

impl WireNotes {
    pub(super) fn new(device: &str, own: u8, drives: Vec<Known>, port: LinkNotes) -> WireNotes {
        let drives = drives.into_iter().map(|known| (known, AtomicCell::default())).collect();
        let shared = Shared { device: device.to_owned(), own, drives, wire: AtomicCell::default() };
        WireNotes { shared: Arc::new(shared), port }
    }

    /// Adds what the cycle writes, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.shared);
        regions.add(&*self.shared.drives);
    }

    pub(super) fn set(&self, index: usize, note: Note) {
        if let Some((_, place)) = self.shared.drives.get(index) {
            place.store(note);
        }
    }

    /// Another master is on the wire, or not any more.
    pub(super) fn set_other(&self, master: Option<u8>) {
        self.shared.wire.store(master.map_or(Note::None, Note::Locked));
    }

    /// The wire is never silent for long enough to be claimed.
    pub(super) fn set_noisy(&self) {
        // Another master says more.
        let _ = self.shared.wire.compare_exchange(Note::None, Note::Noisy);
    }
}

impl bus::Notes for WireNotes {
    fn get(&self, index: usize) -> Option<String> {
        if let Some(note) = self.port.get(0) {
            return Some(note);
        }
        let device = &self.shared.device;
        match self.shared.wire.load() {
            Note::Locked(master) => {
                let own = if master == self.shared.own { " as this one" } else { "" };
                return Some(format!(
                    "another master, address {master}{own}, sends on {device}: end it, or look where the \
                     cable leads"
                ));
            }
            Note::Noisy => {
                return Some(format!(
                    "the wire at {device} is not silent, and what is received on it is no telegram: look at \
                     the rate, at termination and shield"
                ));
            }
            _ => {}
        }
        let (Known { address, ident, configuration }, place) = self.shared.drives.get(index)?;
        Some(match place.load() {
            Note::None | Note::Unwatched | Note::Noisy => return None,
            Note::Absent => format!(
                "nobody answers at address {address} on {device}: look at its power, its cable and \
                 terminators, its address and the rate"
            ),
            Note::Ident(found) => format!(
                "the slave at address {address} has ident number {found:#06x}, not {ident:#06x}: look \
                 whether it is the drive that is meant, and set ident"
            ),
            Note::Locked(master) => format!(
                "it is locked by another master, address {master}: end that one, or let it unlock the drive"
            ),
            Note::Parameters => {
                "it refuses its parametrisation (Prm_Fault): look at ident and user_prm, its GSD \
                 file has them"
                    .into()
            }
            Note::Configuration => format!(
                "it refuses its configuration {configuration:02X?} (Cfg_Fault): look at configuration, and \
                 at the process data that the drive is set to"
            ),
            Note::Refused { sap, function } => format!(
                "it refuses service access point {sap} ({}): look whether it is a DP slave, and restart it",
                fc::refusal(function)
            ),
            Note::NotReady => "it is parametrised and configured, and does not become ready: look at its \
                 diagnosis"
                .into(),
        })
    }

    fn remark(&self, index: usize) -> Option<String> {
        let (_, place) = self.shared.drives.get(index)?;
        let why = "its diagnosis does not report its watchdog as on, although it was set: it is not enabled";
        (place.load() == Note::Unwatched).then(|| why.to_owned())
    }
}
