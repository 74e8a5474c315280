//! The registers of a slave controller that a master uses (ETG.1000.4, 6), and the values in them.

use std::fmt;

/// Addresses.
pub mod address {
    /// Type, revision, build.
    pub const TYPE: u16 = 0x0000;
    /// How many FMMUs, SyncManagers, KiB of memory; port types.
    pub const RESOURCES: u16 = 0x0004;
    /// [`Features`](super::Features).
    pub const FEATURES: u16 = 0x0008;
    /// Station address.
    pub const STATION: u16 = 0x0010;
    /// Alias, from the SII.
    pub const ALIAS: u16 = 0x0012;
    /// Loops of the ports; 0: each by itself. The register behind it is the size of the receive FIFO.
    pub const PORT_LOOPS: u16 = 0x0101;
    /// Bit 0: the slave answers to its alias too.
    pub const ALIAS_ENABLE: u16 = 0x0103;
    /// [`Links`](super::Links).
    pub const LINKS: u16 = 0x0110;
    /// The requested state.
    pub const AL_CONTROL: u16 = 0x0120;
    /// The state, and behind it from byte 4 on its [`AlCode`](super::AlCode).
    pub const AL_STATUS: u16 = 0x0130;
    /// Bit 0: device emulation. The controller of a slave without a processor copies AL control to AL status.
    pub const EMULATION: u16 = 0x0141;
    /// The events that a slave adds to each datagram.
    pub const EVENT_MASK: u16 = 0x0200;
    /// Error counters; a write clears them.
    pub const ERRORS: u16 = 0x0300;
    /// Divider of the watchdogs.
    pub const WATCHDOG_DIVIDER: u16 = 0x0400;
    /// Watchdog of the SyncManagers; 0: off.
    pub const WATCHDOG: u16 = 0x0420;
    /// Bit 0: that watchdog has not run out.
    pub const WATCHDOG_STATUS: u16 = 0x0440;
    /// Who owns the SII.
    pub const SII_OWNER: u16 = 0x0500;
    /// Control and status of the SII, and behind it the word address.
    pub const SII_CONTROL: u16 = 0x0502;
    /// The data read from the SII.
    pub const SII_DATA: u16 = 0x0508;
    /// The first [`Fmmu`](super::Fmmu).
    pub const FMMU: u16 = 0x0600;
    /// The first [`SyncManager`](super::SyncManager).
    pub const SYNC_MANAGER: u16 = 0x0800;
    /// When each port received; a write latches all of them.
    pub const DC_PORTS: u16 = 0x0900;
    /// The segment's time, ns.
    pub const DC_TIME: u16 = 0x0910;
    /// When the processing unit received, by the slave's own clock.
    pub const DC_RECEIVED: u16 = 0x0918;
    /// The segment's time less the slave's own.
    pub const DC_OFFSET: u16 = 0x0920;
    /// The slave's delay to the reference clock, ns.
    pub const DC_DELAY: u16 = 0x0928;
    /// [`Difference`](super::Difference).
    pub const DC_DIFFERENCE: u16 = 0x092C;
    /// Start of the drift compensation; a write resets its filter.
    pub const DC_SPEED: u16 = 0x0930;
    /// Depths of its filters.
    pub const DC_FILTER: u16 = 0x0934;
    /// The cyclic unit: who controls it, followed by what is active.
    pub const DC_CONTROL: u16 = 0x0980;
    /// Bit 0: cyclic operation, 1: SYNC0, 2: SYNC1.
    pub const DC_ACTIVATION: u16 = 0x0981;
    /// When SYNC0 begins, ns.
    pub const DC_START: u16 = 0x0990;
    /// Cycle of SYNC0, ns.
    pub const DC_CYCLE: u16 = 0x09A0;

    /// FMMU `n`.
    pub const fn fmmu(n: u16) -> u16 {
        FMMU + n * super::Fmmu::SIZE as u16
    }

    /// SyncManager `n`.
    pub const fn sync_manager(n: u16) -> u16 {
        SYNC_MANAGER + n * super::SyncManager::SIZE as u16
    }
}

/// A state of the EtherCAT state machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum AlState {
    /// No mailbox, no process data.
    #[default]
    Init = 1,
    /// Mailbox.
    PreOp = 2,
    /// Firmware download.
    Boot = 3,
    /// Mailbox, and inputs.
    SafeOp = 4,
    /// Mailbox, inputs and outputs.
    Op = 8,
}

impl AlState {
    /// The number on the wire.
    pub const fn number(self) -> u8 {
        self as u8
    }

    /// The state of this number; `None`: none, or the bits of several slaves or-ed.
    pub const fn new(number: u8) -> Option<AlState> {
        Some(match number {
            1 => AlState::Init,
            2 => AlState::PreOp,
            3 => AlState::Boot,
            4 => AlState::SafeOp,
            8 => AlState::Op,
            _ => return None,
        })
    }
}

impl fmt::Display for AlState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            AlState::Init => "INIT",
            AlState::PreOp => "PREOP",
            AlState::Boot => "BOOT",
            AlState::SafeOp => "SAFEOP",
            AlState::Op => "OP",
        })
    }
}

/// AL status, and AL control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AlStatus(pub u16);

impl AlStatus {
    /// In the status: it refused, or fell back. In the control: that is acknowledged.
    pub const ERROR: u16 = 1 << 4;

    /// In the control: its identification is requested. In the status: the code is its identification (ETG.1020).
    pub const IDENTIFICATION: u16 = 1 << 5;

    /// State and error; other bits that some slaves show there are ignored.
    pub const SHOWN: u16 = 0x0F | Self::ERROR;

    /// The control word that requests `state`.
    pub const fn request(state: AlState) -> AlStatus {
        AlStatus(state.number() as u16)
    }

    /// The control word that acknowledges an error in the present state.
    pub const fn acknowledge(self) -> AlStatus {
        AlStatus(self.0 & 0x0F | Self::ERROR)
    }

    /// The state; `None`: not a valid one.
    pub const fn state(self) -> Option<AlState> {
        AlState::new((self.0 & 0x0F) as u8)
    }

    /// It refused, or fell back, and waits to be acknowledged.
    pub const fn error(self) -> bool {
        self.0 & Self::ERROR != 0
    }
}

/// Why a slave refused a state, or left one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AlCode(pub u16);

impl AlCode {
    /// No error.
    pub const NONE: AlCode = AlCode(0);
    /// No transition leads from its state to the requested one.
    pub const INVALID_REQUEST: AlCode = AlCode(0x0011);
    /// A SyncManager does not fit.
    pub const SYNC_MANAGER: AlCode = AlCode(0x0017);
    /// It is not, or no longer, synchronous to the cycle.
    pub const SYNCHRONISATION: AlCode = AlCode(0x001A);
    /// No outputs came in time.
    pub const WATCHDOG: AlCode = AlCode(0x001B);

    /// It concerns the setting of the SyncManagers, or of the watchdog.
    pub const fn is_of_managers(self) -> bool {
        matches!(self, AlCode::SYNC_MANAGER | AlCode(0x001D | 0x001F))
    }

    /// The meaning; `None`: a manufacturer's own.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x0000 => "no error",
            0x0001 => "unspecified error",
            0x0002 => "no memory",
            0x0011 => "invalid state change requested",
            0x0012 => "unknown state requested",
            0x0013 => "bootstrap not supported",
            0x0014 => "no valid firmware",
            0x0015 => "invalid mailbox configuration (BOOT)",
            0x0016 => "invalid mailbox configuration (PREOP)",
            0x0017 => "invalid SyncManager configuration",
            0x0018 => "no valid inputs",
            0x0019 => "no valid outputs",
            0x001A => "synchronisation error",
            0x001B => "SyncManager watchdog",
            0x001C => "invalid SyncManager types",
            0x001D => "invalid output configuration",
            0x001E => "invalid input configuration",
            0x001F => "invalid watchdog configuration",
            0x0020 => "cold start needed",
            0x0021 => "INIT needed",
            0x0022 => "PREOP needed",
            0x0023 => "SAFEOP needed",
            0x0024 => "invalid input mapping",
            0x0025 => "invalid output mapping",
            0x0026 => "inconsistent settings",
            0x0027 => "free run not supported",
            0x0028 => "synchronisation not supported",
            0x0029 => "free run needs three buffers",
            0x002A => "background watchdog",
            0x002B => "no valid inputs and outputs",
            0x002C => "fatal synchronisation error",
            0x002D => "no synchronisation signal",
            0x0030 => "invalid clock configuration",
            0x0031 => "invalid latch configuration",
            0x0032 => "clock not locked",
            0x0033 => "clock error of its inputs or outputs",
            0x0034 => "clock time-out",
            0x0035 => "invalid SYNC cycle time",
            0x0036 => "invalid SYNC0 cycle time",
            0x0037 => "invalid SYNC1 cycle time",
            0x0050 => "SII not accessible",
            0x0051 => "SII error",
            0x0060 => "restarted by itself",
            _ => return None,
        })
    }
}

impl fmt::Display for AlCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        super::write_code(f, self.0.into(), 6, self.name())
    }
}

/// The features of a slave controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Features(pub u16);

impl Features {
    /// It has a distributed clock.
    pub const fn has_clock(self) -> bool {
        self.0 & 1 << 2 != 0
    }

    /// That clock has 64 bits; otherwise it wraps around every 4.3 s.
    pub const fn has_long_clock(self) -> bool {
        self.0 & 1 << 3 != 0
    }

    /// It has no LRW: outputs and inputs need a datagram each.
    pub const fn lacks_lrw(self) -> bool {
        self.0 & 1 << 9 != 0
    }
}

/// The ports of a slave: which have a link, and which are open.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Links(pub u16);

impl Links {
    /// There is a link at port 0 ... 3.
    pub const fn link(self, port: u8) -> bool {
        port < 4 && self.0 >> (4 + port) & 1 != 0
    }

    /// Frames go out at port 0 ... 3; otherwise they turn there.
    pub const fn open(self, port: u8) -> bool {
        port < 4 && self.0 >> (8 + 2 * port) & 1 == 0
    }
}

/// The difference of a slave's clock to that of the segment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Difference(pub u32);

impl Difference {
    /// In ns; positive: its own clock is ahead, or level.
    pub const fn ns(self) -> i64 {
        let magnitude = (self.0 & !(1 << 31)) as i64;
        if self.0 >> 31 != 0 { magnitude } else { -magnitude }
    }
}

/// A buffer that a SyncManager guards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SyncManager {
    /// Where it begins.
    pub start: u16,
    /// The bytes.
    pub length: u16,
    /// Mode, direction, interrupts, watchdog.
    pub control: u8,
    /// Bit 0: it is on.
    pub activate: u8,
}

impl SyncManager {
    /// Bytes on the wire.
    pub const SIZE: usize = 8;
    /// The bit of `control` that arms the watchdog by each write.
    pub const WATCHDOG: u8 = 1 << 6;
    /// A mailbox that the master writes, as it is usually set.
    pub const MAILBOX_OUT: u8 = 0x26;
    /// A mailbox that the master reads.
    pub const MAILBOX_IN: u8 = 0x22;
    /// Outputs.
    pub const OUTPUTS: u8 = 0x24;
    /// Inputs.
    pub const INPUTS: u8 = 0x20;
    /// The offset of the status.
    pub const STATUS: u16 = 5;
    /// In the status: the mailbox is full.
    pub const FULL: u8 = 1 << 3;

    /// As it is written: the status belongs to the slave.
    pub const fn to_bytes(self) -> [u8; Self::SIZE] {
        let ([a, b], [c, d]) = (self.start.to_le_bytes(), self.length.to_le_bytes());
        [a, b, c, d, self.control, 0, self.activate, 0]
    }

    /// As it was read.
    pub const fn new(bytes: [u8; Self::SIZE]) -> SyncManager {
        let [a, b, c, d, control, _, activate, _] = bytes;
        SyncManager {
            start: u16::from_le_bytes([a, b]),
            length: u16::from_le_bytes([c, d]),
            control,
            activate,
        }
    }

    /// The same, whether it arms a watchdog or not.
    pub const fn unwatched(self) -> SyncManager {
        SyncManager { control: self.control & !SyncManager::WATCHDOG, ..self }
    }

    /// The master writes it.
    pub const fn is_output(self) -> bool {
        self.control >> 2 & 3 == 1
    }

    /// A mailbox: written and read in turns.
    pub const fn is_mailbox(self) -> bool {
        self.control & 3 == 2
    }
}

/// A piece of the logical address space, and its address in a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fmmu {
    /// Where it begins in the logical space.
    pub logical: u32,
    /// The bytes.
    pub length: u16,
    /// The first bit of the first byte, and the last one of the last byte.
    pub bits: (u8, u8),
    /// Where it begins in the slave, and with which bit.
    pub physical: (u16, u8),
    /// The master writes it; otherwise the master reads it.
    pub output: bool,
    /// It is on.
    pub active: bool,
}

impl Fmmu {
    /// Bytes on the wire.
    pub const SIZE: usize = 16;

    /// Whole bytes.
    pub const fn bytes(logical: u32, length: u16, physical: u16, output: bool) -> Fmmu {
        Fmmu { logical, length, bits: (0, 7), physical: (physical, 0), output, active: true }
    }

    /// As it is written.
    pub const fn to_bytes(self) -> [u8; Self::SIZE] {
        let [a, b, c, d] = self.logical.to_le_bytes();
        let ([e, f], [g, h]) = (self.length.to_le_bytes(), self.physical.0.to_le_bytes());
        let (first, last) = self.bits;
        let kind = if self.output { 2 } else { 1 };
        [a, b, c, d, e, f, first, last, g, h, self.physical.1, kind, self.active as u8, 0, 0, 0]
    }

    /// As it was read.
    pub const fn new(bytes: [u8; Self::SIZE]) -> Fmmu {
        let [a, b, c, d, e, f, first, last, g, h, bit, kind, active, ..] = bytes;
        Fmmu {
            logical: u32::from_le_bytes([a, b, c, d]),
            length: u16::from_le_bytes([e, f]),
            bits: (first & 7, last & 7),
            physical: (u16::from_le_bytes([g, h]), bit & 7),
            output: kind & 2 != 0,
            active: active & 1 != 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_are_themselves_again_and_or_ed_ones_are_none() {
        for state in [AlState::Init, AlState::PreOp, AlState::Boot, AlState::SafeOp, AlState::Op] {
            assert_eq!(AlState::new(state.number()), Some(state));
        }
        assert_eq!(AlStatus(0x0C).state(), None, "two slaves in SAFEOP and OP");
        let refused = AlStatus(0x12);
        assert_eq!((refused.state(), refused.error()), (Some(AlState::PreOp), true));
        assert_eq!(refused.acknowledge(), AlStatus(0x12));
        assert_eq!(AlStatus::request(AlState::Op), AlStatus(8));
        assert_eq!(AlCode(0x1A).to_string(), "0x001a synchronisation error");
        assert_eq!(AlCode(0x8001).to_string(), "0x8001");
    }

    #[test]
    fn sync_managers_stand_as_a_real_master_wrote_them() {
        let outputs = SyncManager { start: 0x1100, length: 6, control: SyncManager::OUTPUTS, activate: 1 };
        assert_eq!(outputs.to_bytes(), [0x00, 0x11, 6, 0, 0x24, 0, 1, 0]);
        assert_eq!(SyncManager::new(outputs.to_bytes()), outputs);
        assert!(outputs.is_output() && !outputs.is_mailbox());
        let mailbox = SyncManager::new([0x00, 0x1C, 0x00, 0x04, 0x22, 0x09, 1, 0]);
        assert_eq!((mailbox.start, mailbox.length), (0x1C00, 0x0400));
        assert!(mailbox.is_mailbox() && !mailbox.is_output());
        assert_eq!([0, 3].map(address::sync_manager), [0x0800, 0x0818]);
    }

    #[test]
    fn fmmus_stand_as_real_masters_wrote_them() {
        let outputs = Fmmu::bytes(0, 17, 0x1100, true);
        assert_eq!(outputs.to_bytes(), [0, 0, 0, 0, 17, 0, 0, 7, 0, 0x11, 0, 2, 1, 0, 0, 0]);
        let full = Fmmu { bits: (0, 0), ..Fmmu::bytes(0x0900_0000, 1, 0x080D, false) };
        assert_eq!(full.to_bytes(), [0, 0, 0, 9, 1, 0, 0, 0, 0x0D, 8, 0, 1, 1, 0, 0, 0]);
        for fmmu in [outputs, full, Fmmu::bytes(17, 17, 0x1140, false)] {
            assert_eq!(Fmmu::new(fmmu.to_bytes()), fmmu);
        }
        assert_eq!(address::fmmu(2), 0x0620);
    }

    #[test]
    fn features_links_and_differences_are_read() {
        // An AKD, and a software slave.
        let (drive, soft) = (Features(0x0184), Features(0x01CC));
        assert!(drive.has_clock() && !drive.has_long_clock() && !drive.lacks_lrw());
        assert!(soft.has_clock() && soft.has_long_clock());
        assert!(Features(0x0200).lacks_lrw());
        // Links at ports 0 and 1, both open, the others closed.
        let links = Links(0b0101_1010_0011_0000);
        assert_eq!([0, 1, 2, 3].map(|port| links.link(port)), [true, true, false, false]);
        assert_eq!([0, 1, 2, 3].map(|port| links.open(port)), [true, true, false, false]);
        assert_eq!([Difference(5), Difference(1 << 31 | 7)].map(Difference::ns), [-5, 7]);
    }
}
