//! Settings of a single slave of a simulated segment.

use super::codec::registers::{Fmmu, SyncManager};
use super::models::Model;
use super::topology::Behind;

/// Where most masters begin with station addresses.
const FIRST_STATION: u16 = 0x1001;

/// The settings of the slave at one position. With the defaults it is a slave that fits the plan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SlaveSettings {
    /// The device that it is, whatever the plan expects there. Default: one that the plan describes.
    pub model: Option<Model>,
    /// The serial number of a device that is no drive. Default: the expected one, else 0.
    pub serial: Option<u32>,
    /// The station alias. Default: the expected one, else none.
    pub alias: Option<u16>,
    /// The identification on request. Default: the expected one, else none.
    pub identification: Option<u16>,
    /// Device emulation: AL status is a copy of AL control, bit 4 included. Default: that of the
    /// model; a device without mailboxes has none.
    pub emulated: Option<bool>,
    /// The firmware compares the SyncManagers with the SII byte by byte: with others it refuses PREOP with 0016h,
    /// SAFEOP with 001Dh or 001Eh.
    pub exact_managers: bool,
    /// The control byte of its outputs in its SII. Default: 64h, of an AKD 24h, of a digital terminal 44h.
    pub output_control: Option<u8>,
    /// The distributed clock. Default: as the plan expects it and the segment has it.
    pub clock: Option<ClockKind>,
    /// The number of FMMUs. Default: 8. Small couplers have 2 or 3, and none to spare for their state.
    pub fmmus: Option<u8>,
    /// The SII.
    pub sii: SiiSettings,
    /// The mailbox.
    pub mailbox: MailboxSettings,
    /// The slave in front of it, and the port there. Default: port 1 of the slave before it.
    pub behind: Option<Behind>,
    /// The position of the input terminal that its outputs are wired to. Default: none.
    pub wired_to: Option<u16>,
    /// How another master has left it. Default: it was just switched on.
    pub left: Option<Left>,
}

/// The clock of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockKind {
    /// No clock and no receive times.
    None,
    /// 32 bits: it wraps around every 4.3 s.
    Short,
    /// 64 bits.
    Long,
}

/// The SII of a slave: who has it, and how well it can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SiiSettings {
    /// After power-on its processor has it: a master has to take it by force.
    pub owned_by_slave: bool,
    /// The firmware reads it on the way to PREOP, and refuses PREOP with 0050h while a master has it.
    pub read_in_preop: bool,
    /// A read returns eight bytes, otherwise four.
    pub eight: bool,
    /// The time of each command, ns. Default 100 us (assumed).
    pub busy_ns: u64,
    /// After power-on it is busy for so long, ns. Default 0.
    pub loading_ns: u64,
    /// The first read returns another address, and the words there.
    pub slips: bool,
    /// Every so many reads one fails, and shows that until it is acknowledged. Default 0: none.
    pub fails_every: u32,
    /// The firmware emulates it, and its status shows that, as that of an AKD does.
    pub emulated: bool,
    /// The content.
    pub content: SiiContent,
}

impl Default for SiiSettings {
    fn default() -> SiiSettings {
        SiiSettings {
            owned_by_slave: false,
            read_in_preop: false,
            eight: false,
            busy_ns: 100_000,
            loading_ns: 0,
            slips: false,
            fails_every: 0,
            emulated: false,
            content: SiiContent::default(),
        }
    }
}

/// The content of an SII.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SiiContent {
    /// The description of the slave.
    #[default]
    Sound,
    /// The description of the slave with a wrong checksum.
    WrongCheck,
    /// Identity and mailboxes, and noise in place of the categories.
    Garbage,
    /// Nothing was loaded: no read succeeds.
    Unloaded,
}

impl SiiContent {
    /// The words of an image with this content.
    pub(super) fn of(self, mut words: Vec<u16>) -> Vec<u16> {
        const CHECK: usize = 7;
        const CATEGORIES: usize = 0x40;
        match self {
            SiiContent::Sound | SiiContent::Unloaded => {}
            SiiContent::WrongCheck => words.iter_mut().skip(CHECK).take(1).for_each(|check| *check ^= 0x55),
            // A linear congruential generator: the same noise each time.
            SiiContent::Garbage => {
                words.resize(words.len().max(0x400), 0);
                words.iter_mut().skip(CATEGORIES).fold(0x2545_u16, |noise, word| {
                    *word = noise;
                    noise.wrapping_mul(0x6255).wrapping_add(0x3619)
                });
            }
        }
        words
    }
}

/// The answers of a slave's mailbox: slow, late or lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MailboxSettings {
    /// Some answers come later by this, ns.
    pub delay_ns: u64,
    /// Every so many answers one is delayed. Default 1: each.
    pub delay_every: u32,
    /// Every so many answers one is lost. Default 0: none.
    pub lose_every: u32,
    /// A repeat request is answered by the last message; otherwise it is only acknowledged.
    pub resends: bool,
}

impl Default for MailboxSettings {
    fn default() -> MailboxSettings {
        MailboxSettings { delay_ns: 0, delay_every: 1, lose_every: 0, resends: true }
    }
}

/// How another master has left a slave.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Left {
    /// The station address.
    pub station: u16,
    /// AL status and AL status code.
    pub al: (u16, u16),
    /// The FMMUs from the first one on.
    pub fmmus: Vec<[u8; Fmmu::SIZE]>,
    /// The SyncManagers from the first one on.
    pub managers: Vec<[u8; SyncManager::SIZE]>,
    /// The watchdog of its outputs is switched off.
    pub unwatched: bool,
    /// SYNC0 goes on with this cycle, ns.
    pub sync0_ns: Option<u32>,
    /// The SII belongs to the firmware.
    pub sii_given: bool,
    /// A command of its SII has failed, and nobody has acknowledged that.
    pub sii_failed: bool,
}

impl Left {
    /// The slave at `place` as a master that was killed has left it, with this AL status and code: with the station
    /// address of its neighbour, an FMMU in the way of others', SYNC0 that goes on, and its SII given away
    /// after a command that failed.
    pub fn by_another(place: u16, al: (u16, u16)) -> Left {
        let stray = Fmmu::bytes(0x0001_0000, 16, 0x1000, Fmmu::READ);
        Left {
            station: FIRST_STATION.wrapping_add(place + 1),
            al,
            fmmus: vec![Fmmu::default().to_bytes(), Fmmu::default().to_bytes(), stray.to_bytes()],
            sync0_ns: Some(1_000_000),
            sii_given: true,
            sii_failed: true,
            ..Left::default()
        }
    }
}
