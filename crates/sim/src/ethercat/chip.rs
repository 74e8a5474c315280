//! Registers and memory of a slave controller: access rights, and the effects of an access.
//!
//! | file | what |
//! |---|---|
//! | `chip` | the controller as its firmware has it, and its time |
//! | `access` | what a master may read and write |
//! | `fmmu` | the same by logical addresses |
//! | `effects` | the effects of a write |
//! | `misuse` | counts what a master should not do |
//! | `met` | counts what a master met |

mod access;
mod effects;
mod fmmu;
mod met;
mod misuse;
#[cfg(test)]
mod tests;

use std::ops::Range;

pub use self::met::Met;
pub use self::misuse::Misuse;
use super::clock::Clock;
use super::codec::registers::{AlState, Fmmu, SyncManager, address, al, code, feature, links};
use super::codec::sii::{FORCED, SLAVE_OWNS, bit};
use super::hardware::Settings;
use super::manager::Manager;
use super::sii::Eeprom;
use fieldbeat_core::time::Time;

/// Memory that a master may use freely; digital outputs of small slaves begin here.
const USER: usize = 0x0F00;
const PROCESS: usize = 0x1000;
/// Type, revision and build, SyncManagers and memory, as a real Kollmorgen drive (AKD) has them.
const KIND: [u8; 4] = [0x04, 0x02, 0x00, 0x00];
const SYNC_MANAGERS: usize = 8;
const RAM_KIB: u8 = 8;
/// The end of the memory.
pub(super) const END: usize = PROCESS + 1024 * RAM_KIB as usize;
/// Events for the master: links and state have changed.
const LINKS_CHANGED: u16 = 1 << 2;
const STATE_CHANGED: u16 = 1 << 3;
/// PDI control: digital inputs and outputs with device emulation, or a microcontroller.
const EMULATED: [u8; 2] = [0x04, 0x01];
const PROCESSOR: [u8; 2] = [0x08, 0x00];
/// The watchdog's divider and time as delivered: 100 us, 100 ms.
const DIVIDER: u16 = 0x09C2;
const TICKS: u16 = 1_000;
/// SYNC0: cyclic operation and the pulse itself.
const SYNC0: u8 = 0b11;
const CYCLIC: u8 = 0b01;

/// When a frame is at a slave.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Passage {
    /// On its way out.
    pub(super) at: Time,
    /// Back at each port; `None`: nothing is behind that.
    pub(super) back: [Option<Time>; 4],
}

/// A slave controller without its firmware.
#[derive(Debug, Default)]
pub(super) struct Chip {
    memory: Vec<u8>,
    pub(super) settings: Settings,
    /// Identification is requested.
    pub(super) identifies: bool,
    pub(super) managers: Vec<Manager>,
    fmmus: Vec<Fmmu>,
    pub(super) eeprom: Eeprom,
    pub(super) clock: Clock,
    passage: Passage,
    /// AL control was written, and when.
    pub(super) requested: Option<Time>,
    /// When the mailbox was filled.
    pub(super) filled: Option<Time>,
    /// Outputs were written.
    pub(super) outputs: bool,
    events: u16,
    /// The watchdog was last fed; `None`: never.
    fed: Option<Time>,
    expired: bool,
    pub(super) misuse: Misuse,
    pub(super) met: Met,
}

impl Chip {
    pub(super) fn new(settings: Settings, sii: Vec<u16>) -> Chip {
        let is_long = settings.features & feature::LONG_CLOCK != 0;
        let mut chip = Chip {
            memory: vec![0; END],
            managers: vec![Manager::default(); SYNC_MANAGERS],
            fmmus: vec![Fmmu::default(); settings.fmmus.min(32).into()],
            eeprom: Eeprom::new(sii, settings.sii_access),
            clock: Clock::new(is_long, settings.clock_ns, settings.drift_ppm, settings.settling),
            settings,
            ..Chip::default()
        };
        chip.describe();
        chip
    }

    /// Writes the descriptive registers.
    fn describe(&mut self) {
        let [features, divider, ticks] = [self.settings.features, DIVIDER, TICKS].map(u16::to_le_bytes);
        self.put(address::TYPE, &KIND);
        let (fmmus, managers) = (self.fmmus.len() as u8, self.managers.len() as u8);
        self.put(address::RESOURCES, &[fmmus, managers, RAM_KIB, self.settings.ports]);
        self.put(address::FEATURES, &features);
        self.put(address::WATCHDOG_DIVIDER, &divider);
        self.put(address::PDI_CONTROL, if self.settings.emulated { &EMULATED } else { &PROCESSOR });
        self.put(address::PDI_WATCHDOG, &ticks);
        self.put(address::WATCHDOG, &ticks);
        self.put(address::DC_SPEED, &[0x00, 0x10, 0, 0, 0x00, 0x0C]);
        let alias = self.eeprom.alias();
        self.put(address::ALIAS, &alias.to_le_bytes());
        if self.settings.sii_access.owned_by_slave {
            self.give_sii();
        }
        self.show_state(AlState::Init, false, code::NONE);
        self.events = 0;
    }

    fn has_clock(&self) -> bool {
        self.settings.features & feature::CLOCK != 0
    }

    // What the slave's firmware does with it.

    fn put(&mut self, at: u16, bytes: &[u8]) {
        let at = usize::from(at);
        if let Some(place) = self.memory.get_mut(at..at + bytes.len()) {
            place.copy_from_slice(bytes);
        }
    }

    fn bytes<const N: usize>(&self, at: impl Into<usize>) -> [u8; N] {
        self.memory.get(at.into()..).and_then(<[u8]>::first_chunk).copied().unwrap_or([0; N])
    }

    fn word(&self, at: u16) -> u16 {
        u16::from_le_bytes(self.bytes(at))
    }

    fn quad(&self, at: u16) -> u64 {
        u64::from_le_bytes(self.bytes(at))
    }

    /// Shows the links of its ports; a port without one is closed.
    pub(super) fn link(&mut self, ports: [bool; 4]) {
        let links = links(ports);
        if links != self.word(address::LINKS) {
            self.put(address::LINKS, &links.to_le_bytes());
            self.events |= LINKS_CHANGED;
        }
    }

    /// Shows a state, and locks the parts that it does not use.
    pub(super) fn show_state(&mut self, state: AlState, error: bool, code: u16) {
        let requested = self.settings.identification.filter(|_| self.identifies);
        let own = self.settings.device_id.or(requested).filter(|_| !error);
        let status = state as u16
            | if error { al::ERROR } else { 0 }
            | if own.is_some() { al::IDENTIFICATION } else { 0 };
        self.put(address::AL_STATUS, &status.to_le_bytes());
        self.put(address::AL_CODE, &own.unwrap_or(code).to_le_bytes());
        self.events |= STATE_CHANGED;
        // What locks buffers is a processor.
        let unlocked = if self.settings.emulated { AlState::Op } else { state };
        self.managers.iter_mut().for_each(|manager| manager.enter(unlocked));
        if state == AlState::Init {
            self.filled = None;
        }
        self.show();
    }

    /// The state in device emulation: the one requested last.
    pub(super) fn emulated_state(&self) -> Option<AlState> {
        AlState::of(self.word(address::AL_STATUS)).filter(|_| self.settings.emulated)
    }

    /// Whether its processor may read the SII: the master has given it.
    pub(super) fn has_sii(&self) -> bool {
        self.memory[usize::from(address::SII_OWNER)] & SLAVE_OWNS != 0
    }

    /// The processor has the SII now, and keeps it until it is taken by force.
    pub(super) fn give_sii(&mut self) {
        self.put(address::SII_OWNER, &[SLAVE_OWNS; 2]);
    }

    /// Reads AL control.
    pub(super) fn take_request(&mut self) -> u16 {
        self.requested = None;
        self.word(address::AL_CONTROL)
    }

    /// Takes what is in the mailbox that the master writes.
    pub(super) fn take_message(&mut self) -> Vec<u8> {
        self.filled = None;
        let Some(manager) = self.managers.first_mut() else { return Vec::new() };
        manager.take();
        let message = self.memory.get(manager.area()).unwrap_or_default().to_vec();
        self.show();
        message
    }

    /// Whether the mailbox that the master reads is on and empty.
    pub(super) fn has_room(&self) -> bool {
        self.managers.get(1).is_some_and(|manager| manager.is_mailbox(false) && !manager.is_full())
    }

    /// Puts a message there; the old bytes after it stay.
    pub(super) fn put_message(&mut self, message: &[u8]) {
        let Some(manager) = self.managers.get_mut(1) else { return };
        manager.put();
        if let Some(place) = self.memory.get_mut(manager.area()) {
            let size = message.len().min(place.len());
            place[..size].copy_from_slice(&message[..size]);
        }
        self.show();
    }

    /// The master requests the last message again; returned once.
    pub(super) fn takes_repeat(&mut self) -> bool {
        let requested = self.managers.get_mut(1).is_some_and(Manager::takes_repeat);
        if requested {
            self.show();
        }
        requested
    }

    /// The outputs of all SyncManagers, in order; zeros of one that was not written yet, nothing if none was.
    pub(super) fn outputs(&self) -> impl Iterator<Item = u8> {
        let managers = || self.managers.iter().filter(|manager| manager.is_process(true));
        let any = managers().any(|manager| !manager.taken.is_empty());
        managers().filter(move |_| any).flat_map(|manager| {
            let taken = &manager.taken;
            (0..manager.area().len()).map(move |at| taken.get(at).copied().unwrap_or(0))
        })
    }

    /// The inputs of all SyncManagers, in order.
    pub(super) fn inputs(&self) -> impl Iterator<Item = &u8> {
        let areas = self.managers.iter().filter(|manager| manager.is_process(false)).map(Manager::area);
        areas.flat_map(|area| self.memory.get(area).unwrap_or_default())
    }

    /// Writes them there.
    pub(super) fn put_inputs(&mut self, mut inputs: &[u8]) {
        for manager in self.managers.iter_mut().filter(|manager| manager.is_process(false)) {
            let Some(place) = self.memory.get_mut(manager.area()) else { continue };
            let Some((own, rest)) = inputs.split_at_checked(place.len()) else { break };
            place.copy_from_slice(own);
            manager.put();
            inputs = rest;
        }
        self.show();
    }

    // Time.

    /// Advances to `now`.
    pub(super) fn advance(&mut self, now: Time) {
        self.clock.advance(now);
        if self.eeprom.advance(now) {
            self.show_sii();
        }
    }

    /// The watchdog of the outputs: ns, and `None` if it is off.
    fn watchdog_ns(&self) -> Option<u64> {
        let tick_ns = (u64::from(self.word(address::WATCHDOG_DIVIDER)) + 2) * 40;
        Some(tick_ns * u64::from(self.word(address::WATCHDOG))).filter(|limit| *limit > 0)
    }

    /// Feeds the watchdog.
    pub(super) fn feed(&mut self, now: Time) {
        (self.fed, self.expired) = (Some(now), false);
    }

    /// Whether the watchdog is armed and has run out by `now`; that is counted.
    pub(super) fn watchdog_expired(&mut self, now: Time) -> bool {
        let Some(limit_ns) = self.watchdog_ns() else { return false };
        let is_late = self.fed.is_some_and(|fed| now.since(fed) >= limit_ns);
        if is_late && !self.expired {
            self.expired = true;
            let [count] = self.bytes(address::WATCHDOG_COUNTER);
            self.put(address::WATCHDOG_COUNTER, &[u8::saturating_add(count, 1)]);
        }
        let arms = |manager: &Manager| manager.setting.control & SyncManager::WATCHDOG != 0;
        self.expired && self.managers.iter().any(|manager| manager.is_process(true) && arms(manager))
    }

    /// A frame begins: registers that change by themselves are updated.
    pub(super) fn begin(&mut self, passage: Passage) {
        self.passage = passage;
        self.show();
    }

    /// Writes the values that change by themselves into its registers.
    fn show(&mut self) {
        for n in 0..self.managers.len() {
            let at = address::sync_manager(n as u16);
            let (status, control) = self.managers[n].registers();
            self.put(at + SyncManager::STATUS, &[status]);
            self.put(at + SyncManager::PDI_CONTROL, &[control]);
        }
        let [status, events] = [self.eeprom.status(), self.events].map(u16::to_le_bytes);
        self.put(address::SII_CONTROL, &status);
        self.put(address::EVENTS, &events);
        let requests = self.requests();
        self.put(address::REQUESTS, &requests.to_le_bytes());
        let runs = self.watchdog_ns().is_none() || (self.fed.is_some() && !self.expired);
        self.put(address::WATCHDOG_STATUS, &[u8::from(runs)]);
        if self.has_clock() {
            let (system_time, difference) = (self.clock.system_time(), self.clock.difference());
            self.put(address::DC_TIME, &system_time.to_le_bytes());
            self.put(address::DC_DIFFERENCE, &difference.to_le_bytes());
            if let Some(next) = self.clock.next_sync() {
                self.put(address::DC_START, &next.to_le_bytes());
            }
        }
    }

    fn requests(&self) -> u32 {
        let managers = self.managers.iter().take(16).enumerate();
        managers.fold(u32::from(self.requested.is_some()), |bits, (n, manager)| {
            bits | u32::from(manager.event()) << (8 + n)
        })
    }

    /// Shows the read data, and the alias if it was loaded again.
    fn show_sii(&mut self) {
        let (data, alias) = (self.eeprom.data, self.eeprom.alias());
        self.met.sii_failed += u32::from(self.eeprom.status() & (bit::REFUSED | bit::PROTECTED) != 0);
        self.put(address::SII_DATA, &data);
        if let Some(at) = self.eeprom.slipped.take() {
            self.met.sii_slipped += 1;
            self.put(address::SII_ADDRESS, &at.to_le_bytes());
        }
        self.put(address::ALIAS, &alias.to_le_bytes());
    }
}
