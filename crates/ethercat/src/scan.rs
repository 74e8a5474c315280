//! Lists the slaves of a segment for people, on a normal thread. It leaves the segment as it is.
//!
//! | file | what |
//! |---|---|
//! | `exchange` | a frame out and back, distinguished from those of other masters |
//! | `information` | the SII |
//!
//! Registers are only read, and slaves are addressed by their positions: no station address, no state and no
//! process data is touched. Reading the SII takes writes to its own registers. Below SAFEOP this disturbs nobody,
//! unless the slave's processor uses the SII; above it, or if the processor uses it, the SII is read only on
//! request ([`Options::sii`]). One that was given to the processor is given back.

mod exchange;
pub mod information;

use std::fmt;

use thiserror::Error;

use self::exchange::{Ask, Exchange};
pub use self::information::{Information, Unread};
use super::wire::frame::{Command, Mac, position};
use super::wire::registers::{AlCode, AlState, AlStatus, Features, Fmmu, Links, SyncManager, address};
use super::wire::sii;
use fieldbeat_core::net::Frames;
use fieldbeat_core::net::frames::Unsent;

/// SyncManagers and FMMUs in the address space of a slave.
const UNITS_MAX: u8 = 32;
/// From AL status to the bit of device emulation.
const EMULATION_AT: usize = (address::EMULATION - address::AL_STATUS) as usize;
/// Bytes from the first error counter to the last one.
/// Bytes of the error counters.
pub const ERRORS: usize = 0x14;

/// How to scan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Options {
    /// The SII of every slave, whatever its state is and whoever owns it.
    pub sii: bool,
}

/// A slave as it was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Slave {
    /// The position on the segment: 0 is next to the master.
    pub place: u16,
    /// The station address; 0: none was given.
    pub station: u16,
    /// The alias; 0: none.
    pub alias: u16,
    /// The state, and whether it reports an error.
    pub status: AlStatus,
    /// The AL status code of the error.
    pub code: AlCode,
    /// Device emulation: its status is what a master requested last, an acknowledgement included.
    pub emulated: bool,
    /// The features of its controller.
    pub features: Features,
    /// The ports.
    pub links: Links,
    /// Bits 2n and 2n + 1: the type of port n.
    pub ports: u8,
    /// The error counters of its ports.
    pub errors: Errors,
    /// The SyncManagers as they are set.
    pub managers: Vec<SyncManager>,
    /// The FMMUs as they are set.
    pub fmmus: Vec<Fmmu>,
    /// Cycle of SYNC0, ns, if it is on.
    pub sync0_ns: Option<u32>,
    /// The content of its SII, or why that was not read.
    pub sii: Result<Information, Unread>,
}

/// The counters of a slave's controller since it was powered on, or since a master cleared them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Errors {
    /// Frames with a wrong check sequence, by port.
    pub invalid: [u8; 4],
    /// Errors of the physical layer, by port.
    pub physical: [u8; 4],
    /// Frames that a slave before this one had marked as wrong, by port.
    pub forwarded: [u8; 4],
    /// Frames with a wrong EtherCAT header or datagram.
    pub processing: u8,
    /// Errors of the slave's processor.
    pub processor: u8,
    /// Lost links, by port.
    pub lost_links: [u8; 4],
}

impl Errors {
    /// Of these registers.
    pub fn new(bytes: &[u8; ERRORS]) -> Errors {
        let four = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        let pairs = |odd: usize| [bytes[odd], bytes[2 + odd], bytes[4 + odd], bytes[6 + odd]];
        Errors {
            invalid: pairs(0),
            physical: pairs(1),
            forwarded: four(0x08),
            processing: bytes[0x0C],
            processor: bytes[0x0D],
            lost_links: four(0x10),
        }
    }
}

impl Slave {
    /// Bytes of process data as its SyncManagers are set now: outputs, inputs.
    pub fn process_data(&self) -> (usize, usize) {
        let is_on = |manager: &&SyncManager| manager.activate & 1 != 0 && !manager.is_mailbox();
        let (outputs, inputs): (Vec<&SyncManager>, Vec<_>) =
            self.managers.iter().filter(is_on).partition(|manager| manager.is_output());
        let bytes = |managers: Vec<&SyncManager>| managers.iter().map(|m| usize::from(m.length)).sum();
        (bytes(outputs), bytes(inputs))
    }

    /// It reports an error: one that is only mirrored has no code.
    pub fn has_error(&self) -> bool {
        self.status.error() && !(self.emulated && self.code == AlCode::NONE)
    }

    /// Whether its SII may be read without a request: then no master works with it.
    fn is_idle(&self) -> bool {
        matches!(self.status.state(), Some(AlState::Init | AlState::PreOp))
    }
}

/// Why a scan did not complete. Nothing was changed.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum ScanError {
    /// The caller interrupted it.
    #[error("interrupted")]
    Interrupted,
    /// The interface does not send.
    #[error("{}", unsent(.0))]
    Unsent(Unsent),
    /// Nothing came back.
    #[error("no slave answers; check power and cable, and whether the segment is at this interface")]
    Silent,
    /// A frame came back as it was sent.
    #[error("frames come back, but no slave has processed them; look for a loop behind this interface")]
    Loop,
    /// A slave was there, and no longer is.
    #[error(
        "the slave at place {place} of {count} has stopped answering; look at its power and the cable in \
         front of it"
    )]
    Lost {
        /// The position.
        place: u16,
        /// How many slaves there were.
        count: u16,
    },
    /// Slaves came or went meanwhile.
    #[error(
        "the segment changed from {before} to {after} slaves during the scan; scan again when it is stable"
    )]
    Changed {
        /// How many there were.
        before: u16,
        /// How many there are.
        after: u16,
    },
    /// Another master works here.
    #[error("another master ({}) has frames on this interface; end it, or read its slaves from it", Shown(.0))]
    Foreign(Mac),
}
fieldbeat_core::debug_as_display!(ScanError);

fn unsent(unsent: &Unsent) -> String {
    match unsent {
        Unsent::Down => "the interface is down, or has no cable; look at both".to_owned(),
        Unsent::Full => {
            "the interface takes no more frames; look at its cable, and what else sends there".to_owned()
        }
        Unsent::Failed(errno) => {
            format!("cannot send: {}; look at the interface", std::io::Error::from_raw_os_error(*errno))
        }
    }
}

/// An Ethernet address as people write it.
pub(super) struct Shown<'a>(pub(super) &'a Mac);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e, g] = self.0;
        write!(f, "{a:02x}:{b:02x}:{c:02x}:{d:02x}:{e:02x}:{g:02x}")
    }
}

/// Reads all slaves of the segment behind `frames`. Blocks as long as `go_on` holds.
pub fn scan(
    frames: &mut dyn Frames,
    options: Options,
    go_on: &dyn Fn() -> bool,
) -> Result<Vec<Slave>, ScanError> {
    let mut exchange = Exchange::new(frames, go_on);
    exchange.listen()?;
    let before = count(&mut exchange)?;
    let mut slaves = Vec::with_capacity(before.into());
    for place in 0..before {
        slaves.push(Visit { exchange: &mut exchange, place, count: before }.slave(options)?);
    }
    let after = count(&mut exchange)?;
    if after == before { Ok(slaves) } else { Err(ScanError::Changed { before, after }) }
}

/// Why a segment is not left to a master that comes for one drive only.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Busy {
    /// Another master has frames there.
    Other(Mac),
    /// A slave is in use, whoever brought it there.
    Running {
        /// The position.
        place: u16,
        /// The state.
        state: AlState,
    },
}

/// The number of requests, each with all its attempts, without an answer until a segment counts as silent.
const ROUNDS_OF_SILENCE: u32 = 5;

/// Whether a master may come to the segment behind `frames` for one drive only: no slave is in OP, nor in SAFEOP
/// without an error: that is one which its master is bringing up, while a drive whose watchdog has expired shows the
/// error. It only reads. A segment that does not answer for a while is idle: one whose answers are late is not, and a
/// drive in OP would be disturbed.
pub(super) fn require_idle(frames: &mut dyn Frames) -> Result<(), Busy> {
    let mut exchange = Exchange::new(frames, &|| true);
    let status = |exchange: &mut Exchange<'_>, command| match exchange.ask(&[Ask::read(command, 2)]) {
        Ok(answers) => {
            let answer = answers.and_then(|answers| answers.into_iter().next());
            Ok(answer.map_or((0, AlStatus(0)), |answer| (answer.count, AlStatus(word(&answer.data, 0)))))
        }
        Err(ScanError::Foreign(mac)) => Err(Busy::Other(mac)),
        Err(_) => Ok((0, AlStatus(0))),
    };
    // The states of all slaves, or-ed: each has a bit of its own but BOOT, which has those of INIT and PREOP.
    let mut found = (0, AlStatus(0));
    for _ in 0..ROUNDS_OF_SILENCE {
        found = status(&mut exchange, Command::Brd(address::AL_STATUS))?;
        if found.0 > 0 {
            break;
        }
    }
    let (count, all) = found;
    let used = u16::from(AlState::SafeOp.number() | AlState::Op.number());
    if all.0 & used == 0 {
        return Ok(());
    }
    for place in 0..count {
        let (_, status) = status(&mut exchange, Command::Aprd(position(place), address::AL_STATUS))?;
        match status.state() {
            Some(AlState::SafeOp) if status.error() => {}
            Some(state @ (AlState::SafeOp | AlState::Op)) => return Err(Busy::Running { place, state }),
            _ => {}
        }
    }
    Ok(())
}

/// The number of slaves.
fn count(exchange: &mut Exchange) -> Result<u16, ScanError> {
    let answers = exchange.ask(&[Ask::read(Command::Brd(address::TYPE), 2)])?.ok_or(ScanError::Silent)?;
    match answers.first().map_or(0, |answer| answer.count) {
        0 => Err(ScanError::Loop),
        count => Ok(count),
    }
}

/// The slave that is being read.
struct Visit<'e, 'a> {
    exchange: &'e mut Exchange<'a>,
    place: u16,
    count: u16,
}

impl Visit<'_, '_> {
    fn lost(&self) -> ScanError {
        ScanError::Lost { place: self.place, count: self.count }
    }

    /// The contents of these registers, in one frame; zero for those that it does not have. It must have the first
    /// one.
    fn read<const N: usize>(&mut self, registers: [(u16, usize); N]) -> Result<[Vec<u8>; N], ScanError> {
        let requests = registers
            .map(|(register, length)| Ask::read(Command::Aprd(position(self.place), register), length));
        let answers =
            self.exchange.ask_until(&requests, |answers| answers.first().is_some_and(|a| a.count > 0))?;
        let mut answers = answers.ok_or_else(|| self.lost())?.into_iter();
        Ok(registers.map(|(_, length)| {
            answers.next().filter(|answer| answer.count > 0).map_or_else(|| vec![0; length], |a| a.data)
        }))
    }

    fn slave(&mut self, options: Options) -> Result<Slave, ScanError> {
        let [head, station, links, status, errors, owner] = self.read([
            (address::TYPE, 10),
            (address::STATION, 4),
            (address::LINKS, 2),
            (address::AL_STATUS, EMULATION_AT + 1),
            (address::ERRORS, ERRORS),
            (address::SII_OWNER, 2),
        ])?;
        let features = Features(word(&head, 8));
        let (fmmus, managers) = (byte(&head, 4), byte(&head, 5));
        let (fmmus, managers) = self.units(fmmus.min(UNITS_MAX), managers.min(UNITS_MAX))?;
        let mut slave = Slave {
            place: self.place,
            station: word(&station, 0),
            alias: word(&station, 2),
            status: AlStatus(word(&status, 0)),
            code: AlCode(word(&status, 4)),
            emulated: byte(&status, EMULATION_AT) & 1 != 0,
            features,
            links: Links(word(&links, 0)),
            ports: byte(&head, 7),
            errors: errors.first_chunk().map(Errors::new).unwrap_or_default(),
            managers,
            fmmus,
            sync0_ns: if features.has_clock() { self.sync0()? } else { None },
            sii: Err(Unread::InUse),
        };
        // Given to the processor, or in use there.
        let (is_owned, is_used) = (sii::is_processors(&owner), byte(&owner, 1) & 1 != 0);
        slave.sii = match (options.sii, slave.is_idle(), is_used) {
            (true, ..) | (false, true, false) => self.information(is_owned)?,
            (false, false, _) => Err(Unread::InUse),
            (false, true, true) => Err(Unread::Owned),
        };
        Ok(slave)
    }

    /// FMMUs and SyncManagers as they are set.
    fn units(&mut self, fmmus: u8, managers: u8) -> Result<(Vec<Fmmu>, Vec<SyncManager>), ScanError> {
        let [_, first, second] = self.read([
            (address::TYPE, 1),
            (address::FMMU, usize::from(fmmus.max(1)) * Fmmu::SIZE),
            (address::SYNC_MANAGER, usize::from(managers.max(1)) * SyncManager::SIZE),
        ])?;
        let fmmus = first.as_chunks().0.iter().take(fmmus.into()).map(|unit| Fmmu::new(*unit));
        let managers = second.as_chunks().0.iter().take(managers.into()).map(|unit| SyncManager::new(*unit));
        Ok((fmmus.collect(), managers.collect()))
    }

    fn sync0(&mut self) -> Result<Option<u32>, ScanError> {
        let [_, active, cycle] =
            self.read([(address::TYPE, 1), (address::DC_ACTIVATION, 1), (address::DC_CYCLE, 4)])?;
        let is_on = byte(&active, 0) & 0b11 == 0b11;
        Ok(cycle.first_chunk().map(|cycle| u32::from_le_bytes(*cycle)).filter(|_| is_on))
    }
}

fn byte(bytes: &[u8], at: usize) -> u8 {
    bytes.get(at).copied().unwrap_or(0)
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([byte(bytes, at), byte(bytes, at + 1)])
}
