//! A PROFIBUS DP bus as configured and checked: one master of class 1, and its drives.
//!
//! What differs between installations, or is not known for sure of a drive, is a setting with the fact sheet's default:
//! times in bits of the wire, ident number, parametrisation, configuration, bits of the status word, scales.

use super::wire::dp::{self, dpv1};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, MonitorChannel, Units};
pub use fieldbeat_core::net::Rs485;
use fieldbeat_core::net::{Parity, SerialLine};
use fieldbeat_core::time::MS;

/// The rates of PROFIBUS (IEC 61158-2), bits/s.
pub const RATES: [u32; 10] =
    [9_600, 19_200, 45_450, 93_750, 187_500, 500_000, 1_500_000, 3_000_000, 6_000_000, 12_000_000];
/// The least slot time of each, bits.
pub const LEAST_SLOT_BITS: [u32; 10] = [100, 100, 100, 100, 100, 200, 300, 400, 600, 1_000];
/// The usual slot time of each, bits: longer than the least one where MaxTsdr is.
const USUAL_SLOT_BITS: [u32; 10] = [100, 100, 640, 100, 100, 200, 300, 400, 600, 1_000];
/// The usual MaxTsdr of slaves with an SPC3 at each, bits (MaxTsdr_ of their GSD files).
pub const USUAL_MAX_TSDR: [u32; 10] = [60, 60, 250, 60, 60, 100, 150, 250, 450, 800];
/// The slot time is longer than MaxTsdr by at least so many bits.
pub const SLOT_MARGIN_BITS: u32 = 15;
/// The highest address of a station.
pub const ADDRESS_MAX: u8 = 125;
/// The most bytes of process data in one direction, and of parametrisation and configuration.
pub const DATA_MAX: usize = 244;
/// The parameter channel in the process data, bytes.
pub const CHANNEL: usize = 8;
/// The most times that a request is repeated.
pub const RETRIES_MAX: u8 = 15;

/// One wire, its only master, and its drives.
#[derive(Clone, Debug, PartialEq)]
pub struct ProfibusPlan {
    /// The name in messages.
    pub name: String,
    /// The serial port, like "/dev/ttyS1", or "local:NAME", a simulated wire on this host.
    pub device: String,
    /// One of the [`RATES`].
    pub rate: u32,
    /// The address of the master, 0 ..= 125.
    pub address: u8,
    /// The times of the wire, in its bits.
    pub bits: Bits,
    /// A request without a correct answer is repeated so many times, at most 15. A file has 1 at least.
    pub retries: u8,
    /// The master sends a token to itself in each round, as a bus monitor expects. It claims the token in any case.
    pub token: bool,
    /// After so many rounds it looks for a master at the next address of its GAP; `None`: never.
    pub gap: Option<u32>,
    /// The highest address at which it looks for one.
    pub highest_address: u8,
    /// Global_Control is sent again after so long, ns.
    pub global_control_ns: u64,
    /// The adapter returns what the master sends: that is skipped.
    pub echo: bool,
    /// Who switches the direction of the wire.
    pub rs485: Rs485,
    /// The drives; one address each.
    pub drives: Vec<LenzeDrive>,
}

/// The times of the wire, in its bits (IEC 61158-4-3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bits {
    /// Tsl: an answer has begun by then.
    pub slot: u32,
    /// MaxTsdr: the slowest station begins to answer within this time.
    pub max_tsdr: u32,
    /// Tsyn: a station takes only what comes after so much silence for the begin of a request.
    pub sync: u32,
    /// Tid1: the master is silent for so long after an answer, or after its token.
    pub idle: u32,
    /// Tid2: the same after a request that nobody answers.
    pub idle_unanswered: u32,
    /// The most that the driver of a port adds between a byte on the wire and its reading: it extends the slot time.
    /// In ns, since it has nothing to do with the rate.
    pub latency_ns: u64,
}

/// One drive with a PROFIBUS module: Lenze EMF2133IB, and what behaves like it.
#[derive(Clone, Debug, PartialEq)]
pub struct LenzeDrive {
    /// The settings of every protocol's axis. The drive counts revolutions of the motor: `scale` says how many are one
    /// unit.
    pub axis: AxisPlan,
    /// The address, 0 ..= 125.
    pub address: u8,
    /// The ident number: the drive refuses parametrisation with another one. The default is that of the module before
    /// (2130IB), since that of the EMF2133IB is not known.
    pub ident: u16,
    /// User_Prm, as it is sent. The first byte has the bits of DP-V1.
    pub user_prm: Vec<u8>,
    /// The identifier bytes of Chk_Cfg.
    pub configuration: Vec<u8>,
    /// The drive's own watchdog, which stops it if the master dies.
    pub watchdog: Watchdog,
    /// MinTsdr, bits; 0: the drive keeps what it has.
    pub min_tsdr: u8,
    /// From the begin of one of its turns to that of the next one, at least, ns: Min_Slave_Intervall of its GSD, in
    /// units of 100 us there. 0: as soon as its turn comes.
    pub min_slave_interval_ns: u64,
    /// The groups of Global_Control that it belongs to.
    pub group: u8,
    /// The state machine of its control word and status word.
    pub profile: DriveProfile,
    /// The process data begin with a parameter channel of 8 bytes, whether that is used or not.
    pub channel: bool,
    /// By which way its parameters are read and written.
    pub parameters: ParameterPath,
    /// The control word has the bits of the ramp generator set while it runs (0x007F, not 0x000F).
    pub ramp_bits: bool,
    /// The bit of the status word that shows its hardware enable (CINH, voltage inhibit); `None`: none does.
    pub enable_bit: Option<StatusBit>,
    /// The meaning of set point and actual value.
    pub scale: Scale,
    /// The further words of the outputs, behind control word and set point, as they are sent until the application
    /// writes others in native mode. Those that are not here are 0.
    pub further: Vec<u16>,
    /// The words of the inputs that it shows besides.
    pub show: [Option<ShownWord>; MONITOR_CHANNELS],
    /// The code of a fault is the word at this place of the extended diagnosis, counted from 0 at its header; `None`:
    /// there is none.
    pub fault_at: Option<u8>,
    /// The extended diagnosis has at most so many bytes (Max_Diag_Data_Len of its GSD, less 6): for the time of a turn.
    pub extended_diagnosis: u8,
}

/// The state machine of a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DriveProfile {
    /// DRIVECOM, profile 21.
    #[default]
    Drivecom,
    /// PROFIdrive: STW1 and ZSW1.
    Profidrive,
}

/// By which way parameters are read and written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ParameterPath {
    /// None.
    #[default]
    None,
    /// A: the PKW channel in the process data.
    Pkw {
        /// Between any two jobs there is none, until the drive shows that; else between two of the same code only.
        pause: bool,
    },
    /// B: the DRIVECOM channel in the process data.
    Drivecom,
    /// C: DB47 by MSAC1 of DP-V1.
    Msac1 {
        /// The slot of the module.
        slot: u8,
        /// The index of the data block.
        index: u8,
        /// The axis in a parameter request: 0 or 1.
        axis: u8,
        /// How a code becomes an index.
        numbers: Numbers,
    },
}

impl ParameterPath {
    /// It is in the process data.
    pub(crate) fn is_channel(self) -> bool {
        matches!(self, ParameterPath::Pkw { .. } | ParameterPath::Drivecom)
    }
}

/// How the code of a Lenze parameter becomes the index of a parameter request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Numbers {
    /// 24575 - code.
    #[default]
    FromTop,
    /// The code itself.
    Code,
}

/// A bit of the status word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusBit {
    /// 0 ..= 15.
    pub bit: u8,
    /// The drive is enabled while the bit is set, else while it is clear.
    pub set: bool,
}

/// The meaning of a count of set point and actual value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    /// The word of the outputs, behind the parameter channel, that is the set point; the control word is word 0.
    pub set_point: u8,
    /// The word of the inputs that is the actual value; the status word is word 0.
    pub actual: u8,
    /// The count of the full speed.
    pub full_count: i16,
    /// The full speed, revolutions of the motor a minute.
    pub full_rpm: f64,
}

/// A word of the inputs that is shown besides.
#[derive(Clone, Debug, PartialEq)]
pub struct ShownWord {
    /// The name.
    pub name: String,
    /// Which word, behind the parameter channel.
    pub word: u8,
    /// The value of a count, in `unit`.
    pub per_count: f64,
    /// It is signed.
    pub signed: bool,
    /// The unit of the value.
    pub unit: &'static str,
}

/// The watchdog that makes the drive stop by itself when no telegrams come any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Watchdog {
    /// The slave's watchdog, ns; `None`: it is off.
    pub timeout_ns: Option<u64>,
    /// Velocities are taken although there is none.
    pub accept_none: bool,
}

impl Default for Watchdog {
    fn default() -> Watchdog {
        Watchdog { timeout_ns: Some(100 * MS), accept_none: false }
    }
}

impl Default for Scale {
    /// 0x4000 is 1500 rpm.
    fn default() -> Scale {
        Scale { set_point: 1, actual: 1, full_count: 0x4000, full_rpm: 1_500.0 }
    }
}

impl Bits {
    /// The times of a wire of this rate whose slaves have the usual MaxTsdr.
    pub fn usual(rate: u32) -> Bits {
        let place = RATES.iter().position(|of| *of >= rate).unwrap_or(RATES.len() - 1);
        let max_tsdr = USUAL_MAX_TSDR[place];
        Bits {
            slot: USUAL_SLOT_BITS[place].max(max_tsdr + SLOT_MARGIN_BITS + 1),
            max_tsdr,
            sync: 33,
            idle: 33,
            idle_unanswered: max_tsdr.max(33),
            latency_ns: 0,
        }
    }
}

impl ProfibusPlan {
    /// The usual rate.
    pub const RATE: u32 = 1_500_000;

    /// A wire of this rate with these drives, with the master at address 2.
    pub fn new(device: impl Into<String>, rate: u32, drives: Vec<LenzeDrive>) -> ProfibusPlan {
        ProfibusPlan {
            name: super::PROTOCOL.into(),
            device: device.into(),
            rate,
            address: 2,
            bits: Bits::usual(rate),
            retries: 1,
            token: true,
            gap: Some(100),
            highest_address: 126,
            global_control_ns: 100 * MS,
            echo: false,
            rs485: Rs485::default(),
            drives,
        }
    }

    /// How bytes are sent.
    pub fn line(&self) -> SerialLine {
        SerialLine { rate: self.rate, parity: Parity::Even, rs485: self.rs485 }
    }

    /// The slot time: from the last byte of a request to the first one of its answer, ns.
    pub fn slot_ns(&self) -> u64 {
        self.line().bits_ns(self.bits.slot.into()).saturating_add(self.bits.latency_ns)
    }

    /// From the end of a request to the end of its answer of so many bytes, at most, ns.
    pub fn answer_ns(&self, bytes: usize) -> u64 {
        self.slot_ns().saturating_add(self.line().span_ns(bytes))
    }
}

impl LenzeDrive {
    /// The ident number of the module 2130IB.
    pub const IDENT: u16 = 0x0082;

    /// A drive at this address with two words of process data and the DRIVECOM channel, in revolutions of its motor,
    /// with everything else as it is when a configuration says nothing of it.
    pub fn new(name: impl Into<String>, address: u8) -> LenzeDrive {
        LenzeDrive {
            axis: AxisPlan::new(name, Units::revolutions(1.0)),
            address,
            ident: LenzeDrive::IDENT,
            user_prm: vec![dpv1::ENABLE, 0, 0],
            configuration: vec![0xF3, 0xF1],
            watchdog: Watchdog::default(),
            min_tsdr: 11,
            min_slave_interval_ns: 0,
            group: 0,
            profile: DriveProfile::default(),
            channel: true,
            parameters: ParameterPath::Drivecom,
            ramp_bits: true,
            enable_bit: DriveProfile::Drivecom.usual_enable_bit(),
            scale: Scale::default(),
            further: Vec::new(),
            show: [const { None }; MONITOR_CHANNELS],
            fault_at: Some(1),
            extended_diagnosis: 3,
        }
    }

    /// DP-V1 is enabled with its parametrisation.
    pub fn has_dpv1(&self) -> bool {
        self.user_prm.first().is_some_and(|first| first & dpv1::ENABLE != 0)
    }

    /// The unit of its watchdog, ns.
    pub fn watchdog_unit_ns(&self) -> u64 {
        if self.user_prm.first().is_some_and(|first| first & dpv1::WATCHDOG_1_MS != 0) { MS } else { 10 * MS }
    }

    /// The watchdog as it is set; `None`: it is off, or cannot be so long.
    #[doc(hidden)]
    pub fn watchdog(&self) -> Option<dp::Watchdog> {
        let units = self.watchdog.timeout_ns?.div_ceil(self.watchdog_unit_ns());
        dp::Watchdog::at_least(u32::try_from(units).ok()?)
    }

    /// The time of its watchdog as it is set, ns.
    pub fn watchdog_ns(&self) -> Option<u64> {
        self.watchdog().map(|watchdog| u64::from(watchdog.units()) * self.watchdog_unit_ns())
    }

    /// The bytes of its process data: outputs and inputs. `None`: its configuration is none, or has too many.
    pub fn lengths(&self) -> Option<(usize, usize)> {
        let (inputs, outputs) = dp::Configuration(&self.configuration).sizes()?;
        (outputs <= DATA_MAX && inputs <= DATA_MAX).then_some((outputs, inputs))
    }

    /// The additional values that it shows.
    pub(super) fn shown(&self) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        let channel = |word: &ShownWord| MonitorChannel { name: word.name.clone(), unit: word.unit };
        self.show.each_ref().map(|word| word.as_ref().map(channel))
    }

    /// Where control word and status word are.
    pub fn process_at(&self) -> usize {
        if self.channel { CHANNEL } else { 0 }
    }

    /// Counts of the set point for one user unit/s; negative if the axis is inverted.
    pub fn counts_per_velocity(&self) -> f64 {
        let Scale { full_count, full_rpm, .. } = self.scale;
        self.axis.units.counts_per_unit * 60.0 / full_rpm * f64::from(full_count)
    }
}

impl DriveProfile {
    /// DRIVECOM shows in bit 4 that its voltage is not inhibited; PROFIdrive has no such bit.
    pub fn usual_enable_bit(self) -> Option<StatusBit> {
        (self == DriveProfile::Drivecom).then_some(StatusBit { bit: 4, set: true })
    }
}
