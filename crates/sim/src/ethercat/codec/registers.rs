//! Registers of a slave controller.

use super::{u16_at, u32_at};

/// Addresses.
pub mod address {
    pub const TYPE: u16 = 0x0000;
    /// FMMUs, SyncManagers, KiB of memory, port types.
    pub const RESOURCES: u16 = 0x0004;
    pub const FEATURES: u16 = 0x0008;
    pub const STATION: u16 = 0x0010;
    pub const ALIAS: u16 = 0x0012;
    /// The size of the receive FIFO.
    pub const FIFO_SIZE: u16 = 0x0102;
    pub const ALIAS_ENABLE: u16 = 0x0103;
    pub const LINKS: u16 = 0x0110;
    pub const AL_CONTROL: u16 = 0x0120;
    pub const AL_STATUS: u16 = 0x0130;
    pub const AL_CODE: u16 = 0x0134;
    /// What is behind the controller; the next byte's bit 0 is device emulation.
    pub const PDI_CONTROL: u16 = 0x0140;
    pub const EVENT_MASK: u16 = 0x0200;
    /// Events for the master.
    pub const EVENTS: u16 = 0x0210;
    /// Events for the firmware.
    pub const REQUESTS: u16 = 0x0220;
    pub const ERRORS: u16 = 0x0300;
    pub const WATCHDOG_DIVIDER: u16 = 0x0400;
    pub const PDI_WATCHDOG: u16 = 0x0410;
    pub const WATCHDOG: u16 = 0x0420;
    pub const WATCHDOG_STATUS: u16 = 0x0440;
    pub const WATCHDOG_COUNTER: u16 = 0x0442;
    pub const SII_OWNER: u16 = 0x0500;
    pub const SII_CONTROL: u16 = 0x0502;
    pub const SII_ADDRESS: u16 = 0x0504;
    pub const SII_DATA: u16 = 0x0508;
    pub const FMMU: u16 = 0x0600;
    pub const SYNC_MANAGER: u16 = 0x0800;
    pub const DC_PORTS: u16 = 0x0900;
    pub const DC_TIME: u16 = 0x0910;
    pub const DC_RECEIVED: u16 = 0x0918;
    pub const DC_OFFSET: u16 = 0x0920;
    pub const DC_DELAY: u16 = 0x0928;
    pub const DC_DIFFERENCE: u16 = 0x092C;
    pub const DC_SPEED: u16 = 0x0930;
    pub const DC_FILTER: u16 = 0x0934;
    pub const DC_CONTROL: u16 = 0x0980;
    pub const DC_ACTIVATION: u16 = 0x0981;
    pub const DC_START: u16 = 0x0990;
    pub const DC_CYCLE: u16 = 0x09A0;

    /// FMMU `n`.
    pub const fn fmmu(n: u16) -> u16 {
        FMMU + 16 * n
    }

    /// SyncManager `n`.
    pub const fn sync_manager(n: u16) -> u16 {
        SYNC_MANAGER + 8 * n
    }
}

/// Bits of the features.
pub mod feature {
    pub const CLOCK: u16 = 1 << 2;
    pub const LONG_CLOCK: u16 = 1 << 3;
    pub const NO_LRW: u16 = 1 << 9;
    /// BRW, APRW and FPRW are missing.
    pub const NO_READ_WRITE: u16 = 1 << 10;
}

/// A state of the EtherCAT state machine; ordered as they are entered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum AlState {
    /// Nothing but registers.
    #[default]
    Init = 1,
    /// Mailbox.
    PreOp = 2,
    /// Firmware download.
    Boot = 3,
    /// Mailbox and inputs.
    SafeOp = 4,
    /// Mailbox, inputs and outputs.
    Op = 8,
}

impl AlState {
    /// The state in the low four bits of AL control or AL status.
    pub fn of(word: u16) -> Option<AlState> {
        use AlState::*;
        [Init, PreOp, Boot, SafeOp, Op].into_iter().find(|state| *state as u16 == word & 0x0F)
    }
}

/// Bits of AL control and AL status above the state.
pub mod al {
    /// In AL control: acknowledges; in AL status: there is an error.
    pub const ERROR: u16 = 1 << 4;
    /// In AL control: identification is requested; in AL status: the code is the identification (ETG.1020).
    pub const IDENTIFICATION: u16 = 1 << 5;
}

/// AL status codes.
pub mod code {
    pub const NONE: u16 = 0x0000;
    pub const INVALID_REQUEST: u16 = 0x0011;
    pub const UNKNOWN_STATE: u16 = 0x0012;
    pub const NO_BOOT: u16 = 0x0013;
    pub const MAILBOX: u16 = 0x0016;
    pub const SYNC_MANAGER: u16 = 0x0017;
    pub const SYNCHRONISATION: u16 = 0x001A;
    pub const WATCHDOG: u16 = 0x001B;
    pub const OUTPUTS: u16 = 0x001D;
    pub const INPUTS: u16 = 0x001E;
    pub const NO_SII: u16 = 0x0050;
}

/// A SyncManager as the master sets it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SyncManager {
    pub start: u16,
    pub length: u16,
    pub control: u8,
    pub activate: u8,
}

impl SyncManager {
    /// Bytes of its registers.
    pub const SIZE: usize = 8;
    /// Offsets of its status, of `activate` and of the slave's control.
    pub const STATUS: u16 = 5;
    /// See [`STATUS`](Self::STATUS).
    pub const ACTIVATE: u16 = 6;
    /// See [`STATUS`](Self::STATUS).
    pub const PDI_CONTROL: u16 = 7;
    /// Usual control bytes, with an interrupt for the slave.
    pub const MAILBOX_OUT: u8 = 0x26;
    /// See [`MAILBOX_OUT`](Self::MAILBOX_OUT).
    pub const MAILBOX_IN: u8 = 0x22;
    /// See [`MAILBOX_OUT`](Self::MAILBOX_OUT).
    pub const OUTPUTS: u8 = 0x24;
    /// See [`MAILBOX_OUT`](Self::MAILBOX_OUT).
    pub const INPUTS: u8 = 0x20;
    /// In the control byte: writing feeds the watchdog.
    pub const WATCHDOG: u8 = 1 << 6;
    /// In the status: written, read, the mailbox is full.
    pub const WRITTEN: u8 = 1 << 0;
    /// See [`WRITTEN`](Self::WRITTEN).
    pub const READ: u8 = 1 << 1;
    /// See [`WRITTEN`](Self::WRITTEN).
    pub const FULL: u8 = 1 << 3;
    /// In `activate`: it is on.
    pub const ON: u8 = 1 << 0;
    /// In `activate`: toggled, it requests the last message again; in the slave's control: the acknowledgement.
    pub const REPEAT: u8 = 1 << 1;
    /// In the slave's control: the slave has locked it.
    pub const LOCKED: u8 = 1 << 0;

    /// Switched on.
    pub const fn on(start: u16, length: u16, control: u8) -> SyncManager {
        SyncManager { start, length, control, activate: SyncManager::ON }
    }

    /// From its registers.
    pub fn new(bytes: [u8; SyncManager::SIZE]) -> SyncManager {
        let [.., control, _, activate, _] = bytes;
        SyncManager { start: u16_at(&bytes, 0), length: u16_at(&bytes, 2), control, activate }
    }

    /// Its registers, with the slave's at 0.
    pub fn to_bytes(self) -> [u8; SyncManager::SIZE] {
        let ([s0, s1], [l0, l1]) = (self.start.to_le_bytes(), self.length.to_le_bytes());
        [s0, s1, l0, l1, self.control, 0, self.activate, 0]
    }

    /// A mailbox, and no buffer of process data.
    pub fn is_mailbox(self) -> bool {
        self.control & 0b11 == 0b10
    }

    /// The master writes it.
    pub fn is_output(self) -> bool {
        self.control >> 2 & 0b11 == 0b01
    }

    /// Its use in the SII: 1 and 2 mailboxes, 3 outputs, 4 inputs.
    pub fn usage(self) -> u8 {
        match (self.is_mailbox(), self.is_output()) {
            (true, true) => 1,
            (true, false) => 2,
            (false, true) => 3,
            (false, false) => 4,
        }
    }
}

/// An FMMU: which logical bits are which bits of the memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fmmu {
    /// The logical address of its first byte.
    pub logical: u32,
    /// Logical bytes that it touches.
    pub length: u16,
    /// The first and the last bit, in the first and the last byte.
    pub bits: (u8, u8),
    /// The address in the memory, and the first bit there.
    pub physical: (u16, u8),
    /// [`READ`](Self::READ) or [`WRITE`](Self::WRITE).
    pub kind: u8,
    /// It is on.
    pub active: bool,
}

impl Fmmu {
    /// Bytes of its registers.
    pub const SIZE: usize = 16;
    /// The master reads.
    pub const READ: u8 = 1;
    /// The master writes.
    pub const WRITE: u8 = 2;

    /// Whole bytes, switched on.
    pub const fn bytes(logical: u32, length: u16, physical: u16, kind: u8) -> Fmmu {
        Fmmu { logical, length, bits: (0, 7), physical: (physical, 0), kind, active: true }
    }

    /// From its registers.
    pub fn new(bytes: [u8; Fmmu::SIZE]) -> Fmmu {
        Fmmu {
            logical: u32_at(&bytes, 0),
            length: u16_at(&bytes, 4),
            bits: (bytes[6] & 7, bytes[7] & 7),
            physical: (u16_at(&bytes, 8), bytes[10] & 7),
            kind: bytes[11],
            active: bytes[12] & 1 != 0,
        }
    }

    /// Its registers.
    pub fn to_bytes(self) -> [u8; Fmmu::SIZE] {
        let [a, b, c, d] = self.logical.to_le_bytes();
        let ([l0, l1], [p0, p1]) = (self.length.to_le_bytes(), self.physical.0.to_le_bytes());
        let (bits, active) = (self.bits, self.active.into());
        [a, b, c, d, l0, l1, bits.0, bits.1, p0, p1, self.physical.1, self.kind, active, 0, 0, 0]
    }
}

/// A clock's difference as its register has it: a magnitude, and bit 31 if it is ahead of the reference, or level.
pub fn difference(ns: f64) -> u32 {
    let magnitude = ns.abs() as u32 & !(1 << 31);
    if ns >= 0.0 { magnitude | 1 << 31 } else { magnitude }
}

/// The ports in DL status: their links, and which of them are closed, as those without a link are.
pub fn links(up: [bool; 4]) -> u16 {
    (0..).zip(up).fold(0, |links, (port, up)| {
        links | if up { 1 << (4 + port) | 1 << (9 + 2 * port) } else { 1 << (8 + 2 * port) }
    })
}
