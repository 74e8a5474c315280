//! Why a drive is not in Data_Exchange, for normal threads: written by the cycle without a lock, made text by the
//! reader.

use super::diagnosis::{LEFT, OVERLOADED};
use super::start_up::WANTED;
use super::wire::fc;
use fieldbeat_core::bus::{self, notes::NoteCells};
use fieldbeat_core::net::LinkNotes;
use fieldbeat_core::rt::Regions;

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
    /// It refuses its configuration, and wants one of so many identifier bytes; 0: that is not known.
    Configuration { wants: u8 },
    /// It does not take a service, with this function of its answer.
    Refused {
        /// The service access point.
        sap: u8,
        /// UE, RR or RS.
        function: u8,
    },
    /// It does not become ready after its parametrisation and configuration.
    NotReady,
    /// It does not stay in Data_Exchange, which it has answered with this function.
    Left { function: u8 },
    /// The diagnosis is none.
    Unreadable,
    /// The watchdog is not on although it was set.
    Unwatched,
    /// The wire is never silent for long enough to be claimed, and what is received on it is no telegram.
    Noisy,
}

/// The configured identity of a drive.
#[derive(Clone, Debug)]
pub(super) struct ExpectedDevice {
    pub address: u8,
    pub ident: u16,
    pub configuration: Vec<u8>,
}

/// Identifier bytes in a cell.
const CHUNK: usize = 8;

/// The notes of the drives of a bus, and of its wire. Clones are the same notes.
#[derive(Clone, Debug)]
pub(super) struct WireNotes {
    device: String,
    /// The address of this master.
    own: u8,
    known: Vec<ExpectedDevice>,
    drives: NoteCells<Note>,
    /// The first identifier bytes of the configuration that each drive wants.
    wanted: NoteCells<[u8; CHUNK]>,
    /// That of the wire: another master has it, it is noisy, or none.
    wire: NoteCells<Note>,
    /// The adapter returns what is sent, and nobody has said so.
    returns: NoteCells<bool>,
    port: LinkNotes,
}

impl WireNotes {
    pub(super) fn new(device: &str, own: u8, known: Vec<ExpectedDevice>, port: LinkNotes) -> WireNotes {
        let (drives, wanted) = (NoteCells::new(known.len()), NoteCells::new(known.len() * WANTED / CHUNK));
        let (wire, returns) = (NoteCells::new(1), NoteCells::new(1));
        WireNotes { device: device.to_owned(), own, known, drives, wanted, wire, returns, port }
    }

    /// Adds what the cycle writes, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.drives.memory(regions);
        self.wire.memory(regions);
        self.wanted.memory(regions);
        self.returns.memory(regions);
    }

    /// Why drive `index` is not in Data_Exchange, and the identifier bytes that it wants.
    pub(super) fn set(&self, index: usize, note: Note, wanted: &[u8; WANTED]) {
        if let Note::Configuration { .. } = note {
            let places = index * WANTED / CHUNK..;
            places.zip(wanted.as_chunks().0).for_each(|(place, bytes)| self.wanted.set(place, *bytes));
        }
        self.drives.set(index, note);
    }

    /// Another master is on the wire, or not any more.
    pub(super) fn set_other(&self, master: Option<u8>) {
        self.wire.set(0, master.map_or(Note::None, Note::Locked));
    }

    /// The adapter returns what is sent, and nobody has said so.
    pub(super) fn set_returns(&self) {
        self.returns.set(0, true);
    }

    /// The wire is never silent for long enough to be claimed.
    pub(super) fn set_noisy(&self) {
        // Another master says more.
        if self.wire.get(0) == Note::None {
            self.wire.set(0, Note::Noisy);
        }
    }
}

/// Behind what is known of a drive.
const RETURNS: &str = "; the adapter returns what is sent: set echo = true";

/// A drive refuses its configuration, and wants one of so many identifier bytes, of which these are the first.
fn refused(configuration: &[u8], wanted: &[u8], wants: usize) -> String {
    let why = format!("it refuses its configuration {configuration:02X?} (Cfg_Fault)");
    let set_to = "at the process data that the drive is set to";
    match wants {
        0 => format!(
            "{why}, and does not say by Get_Cfg which one it wants: look at configuration, and {set_to}"
        ),
        _ if wanted == configuration => {
            format!("{why}, although Get_Cfg reads the same: look {set_to}, and restart it")
        }
        _ => format!(
            "{why}, and wants {}: set configuration to that, or look {set_to}",
            identifiers(wanted, wants)
        ),
    }
}

/// The first of so many identifier bytes.
fn identifiers(bytes: &[u8], of: usize) -> String {
    let listed: Vec<String> = bytes.iter().map(|byte| format!("0x{byte:02X}")).collect();
    let more = if bytes.len() < of { format!(" ... ({of} bytes)") } else { String::new() };
    format!("[{}{more}]", listed.join(", "))
}

impl bus::Notes for WireNotes {
    fn get(&self, index: usize) -> Option<String> {
        if let Some(note) = self.port.get(0) {
            return Some(note);
        }
        let device = &self.device;
        match self.wire.get(0) {
            Note::Locked(master) => {
                let (own, echo) = match master == self.own {
                    true => (" as this one", "; or, if the adapter returns what is sent, set echo = true"),
                    false => ("", ""),
                };
                return Some(format!(
                    "another master, address {master}{own}, sends on {device}: end it, or look where the \
                     cable leads{echo}"
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
        let ExpectedDevice { address, ident, configuration } = self.known.get(index)?;
        Some(match self.drives.get(index) {
            Note::None | Note::Unwatched | Note::Noisy => return None,
            Note::Absent => format!(
                "nobody answers at address {address} on {device}: look at its power, its cable and \
                 terminators, its address and the rate{}",
                if self.returns.get(0) { RETURNS } else { "" }
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
            Note::Configuration { wants } => {
                let places = index * WANTED / CHUNK..(index + 1) * WANTED / CHUNK;
                let wanted = places.flat_map(|place| self.wanted.get(place));
                let wanted: Vec<u8> = wanted.take(wants.into()).collect();
                refused(configuration, &wanted, wants.into())
            }
            Note::Refused { sap, function } => format!(
                "it refuses service access point {sap} ({}): look whether it is a DP slave, and restart it",
                fc::refusal(function)
            ),
            Note::Left { function: fc::NOT_ACTIVE } => LEFT.to_string(),
            Note::Left { .. } => OVERLOADED.to_string(),
            Note::Unreadable => {
                "what it answers as its diagnosis is none: look whether it is a DP slave, and restart it"
                    .into()
            }
            Note::NotReady => "it is parametrised and configured, and does not become ready: look at its \
                 diagnosis"
                .into(),
        })
    }

    fn is_vague(&self, index: usize) -> bool {
        self.drives.get(index) == Note::Absent
            && self.wire.get(0) == Note::None
            && !self.returns.get(0)
            && self.port.get(0).is_none()
    }

    fn remark(&self, index: usize) -> Option<String> {
        let why = "its diagnosis does not report its watchdog as on, although it was set: it is not enabled";
        let unwatched = (self.drives.get(index) == Note::Unwatched).then(|| why.to_owned());
        // Of the wire: with the first drive.
        let returns = index == 0 && self.returns.get(0);
        let device = &self.device;
        unwatched.or_else(|| {
            returns
                .then(|| format!("the adapter of its wire, {device}, returns what is sent: set echo = true"))
        })
    }
}
