//! The settings of one slave: its controller, its EEPROM, its clock, its reaction time.

use super::codec::registers::{SyncManager, code};
use super::slave::{MailboxSettings, SiiSettings};

/// The settings of a slave.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Type, revision and build.
    pub kind: [u8; 4],
    /// The features of its controller.
    pub features: u16,
    /// It has receive times, even without a clock: enough to measure delays.
    pub receive_times: bool,
    /// The number of its FMMUs, at most 32.
    pub fmmus: u8,
    /// The number of its SyncManagers, at most 32.
    pub sync_managers: u8,
    /// Its process memory from 1000h on, KiB, at most 60.
    pub ram_kib: u8,
    /// What its ports are, two bits each from port 0 on: 0 there is none, 2 EBUS, 3 MII.
    pub ports: u8,
    /// The words of its EEPROM; [`sii::Contents`](super::sii::Contents) makes them.
    pub sii: Vec<u16>,
    /// The timing of EEPROM access.
    pub sii_access: SiiSettings,
    /// The time of its clock at its start, ns.
    pub clock_ns: u64,
    /// How much faster than ours its clock runs.
    pub drift_ppm: f64,
    /// Comparisons in which its clock removes most of a difference to the reference.
    pub settling: u16,
    /// It has no processor: its AL status is what AL control says, bit 4 included (0141h, bit 0), and nothing checks
    /// a state or locks a buffer.
    pub emulated: bool,
    /// The SyncManagers that its processor wants, byte by byte; a state is refused with others. Empty: their number
    /// and sizes only, as its application checks them.
    pub managers: Vec<SyncManager>,
    /// How its mailbox answers.
    pub mailbox: MailboxSettings,
    /// How long its firmware takes to read AL control or the mailbox.
    pub reaction_ns: u64,
    /// Its device id, if it shows one: bit 5 of its AL status, and the code register while there is no error.
    /// Default: none.
    pub device_id: Option<u16>,
    /// The same of one that shows it on request (AL control bit 5) only. Default: none.
    pub identification: Option<u16>,
    /// The code with which it falls back when outputs are missing. That of a Kollmorgen S300 ... S700 is not known;
    /// of those that its manual names only that of synchronisation would fit.
    pub watchdog_code: u16,
    /// The delay from the slave before it to this one, each way.
    pub delay_ns: u64,
}

/// Like a real Kollmorgen drive (AKD): a 32-bit clock. The EEPROM is blank, nothing takes time.
impl Default for Settings {
    fn default() -> Settings {
        Settings {
            kind: [0x04, 0x02, 0x00, 0x00],
            features: 0x0184,
            receive_times: true,
            fmmus: 8,
            sync_managers: 8,
            ram_kib: 8,
            ports: 0x0F,
            sii: Vec::new(),
            sii_access: SiiSettings { busy_ns: 0, ..SiiSettings::default() },
            clock_ns: 0,
            drift_ppm: 0.0,
            settling: 32,
            emulated: false,
            managers: Vec::new(),
            mailbox: MailboxSettings::default(),
            reaction_ns: 0,
            device_id: None,
            identification: None,
            watchdog_code: code::WATCHDOG,
            delay_ns: 0,
        }
    }
}
