//! The services of DP-V0: what is in their data (sheet, 6). Data_Exchange has process data, and nothing of its own.

use super::{Reader, Writer};

/// The answer to Slave_Diag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Diagnosis<'a> {
    /// The status that the slave reports.
    pub status: DiagnosisStatus,
    /// The master that has parametrised it.
    pub master: Option<u8>,
    /// The ident number of its type.
    pub ident: u16,
    /// The extended diagnosis.
    pub extended: &'a [u8],
}

impl<'a> Diagnosis<'a> {
    /// Station address of no master.
    const NO_MASTER: u8 = 255;

    /// `None` if the data are shorter than a diagnosis.
    pub fn parse(data: &'a [u8]) -> Option<Diagnosis<'a>> {
        let mut reader = Reader(data);
        let [first, second, third, master] = reader.array()?;
        Some(Diagnosis {
            status: DiagnosisStatus(u32::from_le_bytes([first, second, third, 0])),
            master: (master != Diagnosis::NO_MASTER).then_some(master),
            ident: reader.word_be()?,
            extended: reader.0,
        })
    }

    /// The DRIVECOM fault code (603Fh) in the extended diagnosis of a Lenze drive: a device-related block of three
    /// bytes (2130IB manual). 0 is no fault. Blocks of DP-V1, an alarm or a status, are longer. A block that passes the
    /// end is none, and ends them (IEC 61158-6-3).
    pub fn fault(&self) -> Option<u16> {
        let mut blocks = Reader(self.extended);
        loop {
            let header = blocks.byte()?;
            // The size includes the header: of the device, its modules, one channel, the revision of its description.
            let size = [header & 0x3F, header & 0x3F, 3, 1][usize::from(header >> 6)];
            let block = blocks.bytes(usize::from(size).checked_sub(1)?)?;
            if let (0, &[high, low]) = (header >> 6, block) {
                return Some(u16::from_be_bytes([high, low]));
            }
        }
    }
}

/// Defines the bits of a diagnosis, each with its number and its name.
macro_rules! bits {
    ($($BIT:ident = $bit:literal: $name:literal $(, $more:literal)?;)+) => {
        impl DiagnosisStatus {
            $(
                #[doc = concat!("Bit ", $bit, ": ", $name, ".", $(" ", $more)?)]
                pub const $BIT: u32 = 1 << $bit;
            )+

            /// The names of the bits that are 1. Reserved ones have none.
            pub fn names(self) -> impl Iterator<Item = &'static str> {
                let names = [$((DiagnosisStatus::$BIT, $name)),+];
                names.into_iter().filter(move |(bit, _)| self.has(*bit)).map(|(_, name)| name)
            }
        }
    };
}

/// The first three bytes of a diagnosis; bit 8 is bit 0 of the second byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct DiagnosisStatus(pub u32);

impl DiagnosisStatus {
    /// All of `bits` are 1.
    pub const fn has(self, bits: u32) -> bool {
        self.0 & bits == bits
    }

    /// One of `bits` is 1.
    pub const fn has_any(self, bits: u32) -> bool {
        self.0 & bits != 0
    }

    /// With `bits` as 0.
    pub const fn without(self, bits: u32) -> DiagnosisStatus {
        DiagnosisStatus(self.0 & !bits)
    }
}

bits! {
    NON_EXISTENT = 0: "non-existent", "Set by a master.";
    NOT_READY = 1: "not ready", "For Data_Exchange.";
    CFG_FAULT = 2: "configuration fault", "That of Chk_Cfg is not its own.";
    EXT_DIAG = 3: "extended diagnosis", "It is one of a fault.";
    NOT_SUPPORTED = 4: "not supported";
    INVALID_REPLY = 5: "invalid reply", "Set by a master.";
    PRM_FAULT = 6: "parametrisation fault", "Ident number, length or values of the last Set_Prm.";
    MASTER_LOCK = 7: "locked by another master";
    PRM_REQ = 8: "parametrisation requested";
    STAT_DIAG = 9: "static diagnosis", "Its inputs are not valid; the diagnosis is read until this ends.";
    ALWAYS = 10: "slave", "Always 1.";
    WD_ON = 11: "watchdog on";
    FREEZE = 12: "freeze";
    SYNC = 13: "sync";
    DEACTIVATED = 15: "deactivated", "Set by a master.";
    OVERFLOW = 23: "overflow", "There is more diagnosis than fits.";
}

/// The data of Set_Prm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SetPrm<'a> {
    /// Bits of [`station_status`]; that of the watchdog is set by [`SetPrm::watchdog`].
    pub status: u8,
    /// The watchdog of the slave; `None`: off.
    pub watchdog: Option<Watchdog>,
    /// The shortest time until the slave replies, bits; 0: as it was.
    pub min_tsdr: u8,
    /// The ident number that the slave has to have.
    pub ident: u16,
    /// The groups of Global_Control that it is in, a bit each.
    pub groups: u8,
    /// Of the device. With DP-V1 the first three bytes are the standard's, see [`dpv1`].
    pub user: &'a [u8],
}

/// Bits of the first byte of Set_Prm.
pub mod station_status {
    /// The slave is this master's.
    pub const LOCK: u8 = 1 << 7;
    /// It is any master's.
    pub const UNLOCK: u8 = 1 << 6;
    /// The watchdog is on.
    pub const WATCHDOG: u8 = 1 << 3;
}

/// Bits of the first user parameter of Set_Prm.
pub mod dpv1 {
    /// Acyclic access by MSAC1.
    pub const ENABLE: u8 = 1 << 7;
    /// The watchdog counts in 1 ms instead of 10 ms.
    pub const WATCHDOG_1_MS: u8 = 1 << 2;
}

impl SetPrm<'_> {
    /// Writes it.
    pub fn put(&self, out: &mut Writer<'_>) {
        let (bit, factors) = match self.watchdog {
            Some(watchdog) => (station_status::WATCHDOG, watchdog.factors),
            None => (0, [0, 0]),
        };
        let status = self.status & !station_status::WATCHDOG | bit;
        out.bytes(&[status, factors[0], factors[1], self.min_tsdr]);
        out.word(self.ident);
        out.bytes(&[self.groups]);
        out.bytes(self.user);
    }
}

/// The time after which a slave that is not addressed drops its outputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Watchdog {
    /// The factors, 1 ... 255 each. Their product, times the base, is the time.
    pub factors: [u8; 2],
}

impl Watchdog {
    /// The shortest one of at least `units`: 10 ms each, or 1 ms with [`dpv1::WATCHDOG_1_MS`]. `None`: more than 65025.
    pub fn at_least(units: u32) -> Option<Watchdog> {
        let units = units.max(1);
        let with = |first: u8| {
            let second = u8::try_from(units.div_ceil(first.into())).ok()?;
            Some(Watchdog { factors: [first, second] })
        };
        (1..=u8::MAX).filter_map(with).min_by_key(|watchdog| watchdog.units())
    }

    /// The time in units.
    pub fn units(&self) -> u32 {
        self.factors.map(u32::from).into_iter().product()
    }
}

/// The bytes of Chk_Cfg and of the answer to Get_Cfg: the modules of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Configuration<'a>(pub &'a [u8]);

impl Configuration<'_> {
    /// Bytes of inputs and outputs of all modules; `None` if the last one passes the end.
    pub fn sizes(&self) -> Option<(usize, usize)> {
        // Bit 7 consistent, bit 6 words, the lower ones the length - 1.
        let size = |byte: u8, length: u8| usize::from((byte & length) + 1) << (byte >> 6 & 1);
        let mut reader = Reader(self.0);
        let (mut inputs, mut outputs) = (0, 0);
        while let Some(identifier) = reader.byte() {
            let is = |bit: u8| identifier & bit != 0;
            if is(0x30) {
                inputs += if is(0x10) { size(identifier, 0x0F) } else { 0 };
                outputs += if is(0x20) { size(identifier, 0x0F) } else { 0 };
                continue;
            }
            // The special format (IEC 61158-6-3): bits 7 and 6 say that a length byte of outputs, of inputs, or both
            // follow, bits 3 ... 0 how many bytes of the manufacturer follow those; 15 is none.
            outputs += if is(0x80) { size(reader.byte()?, 0x3F) } else { 0 };
            inputs += if is(0x40) { size(reader.byte()?, 0x3F) } else { 0 };
            reader.bytes(if identifier & 0x0F == 15 { 0 } else { usize::from(identifier & 0x0F) })?;
        }
        Some((inputs, outputs))
    }
}

/// The data of Global_Control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GlobalControl {
    /// The bits below; 0: operate.
    pub command: u8,
    /// Which groups, a bit each; 0: all slaves.
    pub groups: u8,
}

impl GlobalControl {
    /// The slaves use what Data_Exchange brings.
    pub const OPERATE: u8 = 0;
    /// The slaves set their outputs to 0 or to their fail-safe values.
    pub const CLEAR: u8 = 1 << 1;
    /// Outputs stay as they are, until the next sync.
    pub const SYNC: u8 = 1 << 5;

    /// The data.
    pub const fn data(self) -> [u8; 2] {
        [self.command, self.groups]
    }
}
