//! The services of DP-V0: what is in their data (sheet, 6). Data_Exchange has process data, and nothing of its own.

use super::words::bits;
use super::{Reader, Writer};

/// The answer to Slave_Diag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Diagnosis<'a> {
    /// What the slave says of itself.
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
            ident: reader.word()?,
            extended: reader.0,
        })
    }

    /// The blocks of the extended diagnosis.
    pub fn blocks(&self) -> Blocks<'a> {
        Blocks(Reader(self.extended))
    }

    /// The DRIVECOM fault code (603Fh) in the extended diagnosis of a Lenze drive: a device-related block of three
    /// bytes (2130IB manual). 0 is no fault. Blocks of DP-V1, an alarm or a status, are longer.
    pub fn fault(&self) -> Option<u16> {
        self.blocks().find_map(|block| match block {
            Block::Device(&[high, low]) => Some(u16::from_be_bytes([high, low])),
            _ => None,
        })
    }
}

bits! {
    /// The first three bytes of a diagnosis; bit 8 is bit 0 of the second byte.
    pub struct DiagnosisStatus(u32) {
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
}

/// A block of the extended diagnosis (IEC 61158-6-3), without its header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Block<'a> {
    /// Of the device.
    Device(&'a [u8]),
    /// Of its modules: a bit each.
    Modules(&'a [u8]),
    /// Of one channel: module, channel, kind of fault.
    Channel([u8; 3]),
    /// The revision of the device's description.
    Revision(u8),
}

/// The blocks of an extended diagnosis. A block that passes the end is none, and ends them.
#[derive(Clone, Debug)]
pub struct Blocks<'a>(Reader<'a>);

impl<'a> Iterator for Blocks<'a> {
    type Item = Block<'a>;

    fn next(&mut self) -> Option<Block<'a>> {
        let header = self.0.byte()?;
        // The size in a header includes the header.
        let size = usize::from(header & 0x3F).checked_sub(1);
        match header >> 6 {
            0 => Some(Block::Device(self.0.bytes(size?)?)),
            1 => Some(Block::Modules(self.0.bytes(size?)?)),
            2 => self.0.array().map(|[channel, kind]| Block::Channel([header & 0x3F, channel, kind])),
            _ => Some(Block::Revision(header & 0x3F)),
        }
    }
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
    /// It is to support sync.
    pub const SYNC: u8 = 1 << 5;
    /// It is to support freeze.
    pub const FREEZE: u8 = 1 << 4;
    /// Its watchdog is on.
    pub const WATCHDOG: u8 = 1 << 3;
}

/// Bits of the first user parameter of Set_Prm.
pub mod dpv1 {
    /// Acyclic access by MSAC1.
    pub const ENABLE: u8 = 1 << 7;
    /// Outputs of length 0 are the fail-safe ones.
    pub const FAIL_SAFE: u8 = 1 << 6;
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

    /// Its time in units.
    pub fn units(&self) -> u32 {
        self.factors.map(u32::from).into_iter().product()
    }
}

/// The bytes of Chk_Cfg and of the answer to Get_Cfg: the modules of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Configuration<'a>(pub &'a [u8]);

/// The data of a module.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Module {
    /// Bytes from the slave.
    pub inputs: u8,
    /// Bytes to the slave.
    pub outputs: u8,
    /// The whole data belong together, not each byte or word alone.
    pub consistent: bool,
}

impl Configuration<'_> {
    /// The modules; `None` ends them: the bytes of one pass the end.
    pub fn modules(&self) -> impl Iterator<Item = Option<Module>> {
        let mut reader = Reader(self.0);
        std::iter::from_fn(move || {
            let identifier = reader.byte()?;
            let plain = (identifier & 0x30 != 0).then(|| plain(identifier));
            let module = plain.or_else(|| special(identifier, &mut reader));
            if module.is_none() {
                reader.0 = &[];
            }
            Some(module)
        })
    }

    /// Bytes of inputs and outputs of all modules; `None` if the last one passes the end.
    pub fn sizes(&self) -> Option<(usize, usize)> {
        self.modules().try_fold((0, 0), |(inputs, outputs), module| {
            let module = module?;
            Some((inputs + usize::from(module.inputs), outputs + usize::from(module.outputs)))
        })
    }
}

/// An identifier byte: bit 7 consistent, bit 6 words, bits 5 and 4 outputs and inputs, bits 3 ... 0 the length - 1.
fn plain(identifier: u8) -> Module {
    let bytes = ((identifier & 0x0F) + 1) << (identifier >> 6 & 1);
    let when = |bit: u8| if identifier & bit == 0 { 0 } else { bytes };
    Module { inputs: when(0x10), outputs: when(0x20), consistent: identifier & 0x80 != 0 }
}

/// The special format (IEC 61158-6-3): bits 7 and 6 say that a length byte of outputs, of inputs, or both follow, bits
/// 3 ... 0 how many bytes of the manufacturer follow those; 15 is none.
fn special(identifier: u8, reader: &mut Reader<'_>) -> Option<Module> {
    let mut module = Module::default();
    let mut length = |bit: u8| {
        if identifier & bit == 0 {
            return Some(0);
        }
        // Bit 7 consistent, bit 6 words, bits 5 ... 0 the length - 1.
        let length = reader.byte()?;
        module.consistent |= length & 0x80 != 0;
        Some(((length & 0x3F) + 1) << (length >> 6 & 1))
    };
    let (outputs, inputs) = (length(0x80)?, length(0x40)?);
    let of_manufacturer = identifier & 0x0F;
    reader.bytes(if of_manufacturer == 15 { 0 } else { of_manufacturer.into() })?;
    Some(Module { inputs, outputs, ..module })
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
    /// Inputs change again.
    pub const UNFREEZE: u8 = 1 << 2;
    /// Inputs stay as they are now.
    pub const FREEZE: u8 = 1 << 3;
    /// Outputs change again.
    pub const UNSYNC: u8 = 1 << 4;
    /// Outputs stay as they are, until the next sync.
    pub const SYNC: u8 = 1 << 5;

    /// Its data.
    pub const fn data(self) -> [u8; 2] {
        [self.command, self.groups]
    }
}
