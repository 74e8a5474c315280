//! The settings of one slave: its controller, its EEPROM, its clock, its reaction time.

use super::codec::registers::SyncManager;
use super::slave::{MailboxSettings, SiiSettings};

/// The settings of a slave.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The features of its controller.
    pub features: u16,
    /// Receive times exist, even without a clock: enough to measure delays.
    pub receive_times: bool,
    /// The number of its FMMUs, at most 32.
    pub fmmus: u8,
    /// Port types, two bits each from port 0 on: 0 none, 2 EBUS, 3 MII.
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
    /// Device emulation (0141h, bit 0): AL status is a copy of AL control, bit 4 included, and nothing checks
    /// a state or locks a buffer.
    pub emulated: bool,
    /// The SyncManagers that its processor wants, byte by byte; a state is refused with others. Empty: their number
    /// and sizes only, as its application checks them.
    pub managers: Vec<SyncManager>,
    /// How its mailbox answers.
    pub mailbox: MailboxSettings,
    /// How long its firmware takes to read AL control or the mailbox.
    pub reaction_ns: u64,
    /// The device id, shown by bit 5 of AL status and the code register while there is no error.
    /// Default: none.
    pub device_id: Option<u16>,
    /// The device id that is shown on request only (AL control bit 5). Default: none.
    pub identification: Option<u16>,
    /// The delay from the slave before it to this one, each way.
    pub delay_ns: u64,
}

/// Like a real Kollmorgen drive (AKD): a 32-bit clock. The EEPROM is blank, nothing takes time.
impl Default for Settings {
    fn default() -> Settings {
        Settings {
            features: 0x0184,
            receive_times: true,
            fmmus: 8,
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
            delay_ns: 0,
        }
    }
}
