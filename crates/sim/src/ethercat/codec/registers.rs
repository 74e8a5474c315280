//! Registers of a slave controller.

use super::{u16_at, u32_at};

/// Addresses.
pub mod address {
    constants! { u16:
        TYPE = 0x0000; RESOURCES = 0x0004; FEATURES = 0x0008; STATION = 0x0010; ALIAS = 0x0012;
        FIFO_SIZE = 0x0102; ALIAS_ENABLE = 0x0103; LINKS = 0x0110; AL_CONTROL = 0x0120; AL_STATUS = 0x0130;
        AL_CODE = 0x0134; PDI_CONTROL = 0x0140; EVENT_MASK = 0x0200; EVENTS = 0x0210; REQUESTS = 0x0220;
        ERRORS = 0x0300; WATCHDOG_DIVIDER = 0x0400; PDI_WATCHDOG = 0x0410; WATCHDOG = 0x0420;
        WATCHDOG_STATUS = 0x0440; WATCHDOG_COUNTER = 0x0442; SII_OWNER = 0x0500; SII_CONTROL = 0x0502;
        SII_ADDRESS = 0x0504; SII_DATA = 0x0508; FMMU = 0x0600; SYNC_MANAGER = 0x0800; DC_PORTS = 0x0900;
        DC_TIME = 0x0910; DC_RECEIVED = 0x0918; DC_OFFSET = 0x0920; DC_DELAY = 0x0928;
        DC_DIFFERENCE = 0x092C; DC_SPEED = 0x0930; DC_FILTER = 0x0934; DC_CONTROL = 0x0980;
        DC_ACTIVATION = 0x0981; DC_START = 0x0990; DC_CYCLE = 0x09A0;
    }

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
    constants! { u16:
        CLOCK = 1 << 2; LONG_CLOCK = 1 << 3; NO_LRW = 1 << 9; NO_READ_WRITE = 1 << 10;
    }
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
    constants! { u16:
        ERROR = 1 << 4; IDENTIFICATION = 1 << 5;
    }
}

/// AL status codes.
pub mod code {
    constants! { u16:
        NONE = 0x0000; INVALID_REQUEST = 0x0011; UNKNOWN_STATE = 0x0012; NO_BOOT = 0x0013; MAILBOX = 0x0016;
        SYNC_MANAGER = 0x0017; SYNCHRONISATION = 0x001A; WATCHDOG = 0x001B; OUTPUTS = 0x001D;
        INPUTS = 0x001E; NO_SII = 0x0050;
    }
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
    // Offsets of the status, of the activate register and of the PDI control.
    constants! { u16: STATUS = 5; ACTIVATE = 6; PDI_CONTROL = 7; }
    // Usual control bytes, and the bit in them by which a write feeds the watchdog.
    constants! { u8:
        MAILBOX_OUT = 0x26; MAILBOX_IN = 0x22; OUTPUTS = 0x24; INPUTS = 0x20; WATCHDOG = 1 << 6;
    }
    // Status: written, read, mailbox full. Activate: on, repeat request. PDI control: locked, repeat acknowledged.
    constants! { u8: WRITTEN = 1 << 0; READ = 1 << 1; FULL = 1 << 3; ON = 1 << 0; REPEAT = 1 << 1; LOCKED = 1 << 0; }

    /// Switched on.
    pub const fn on(start: u16, length: u16, control: u8) -> SyncManager {
        SyncManager { start, length, control, activate: SyncManager::ON }
    }

    /// From its registers.
    pub fn new(bytes: [u8; SyncManager::SIZE]) -> SyncManager {
        let [.., control, _, activate, _] = bytes;
        SyncManager { start: u16_at(&bytes, 0), length: u16_at(&bytes, 2), control, activate }
    }

    /// The registers as written by a master: those of the slave are 0.
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

    /// The type in the SII: 1 mailbox out, 2 mailbox in, 3 outputs, 4 inputs.
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
    /// Bit 0 of the activate register.
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

    /// The registers.
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
