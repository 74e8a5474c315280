//! The settings of a simulated segment and of its Lenze drives: what the module's firmware decides, process data,
//! parameters, motor.

use crate::FaultPlan;
use fieldbeat_core::net::{Parity, Rs485, SerialLine};
use fieldbeat_core::time::{MS, S};
use fieldbeat_profibus::{DriveProfile, Numbers};

/// A wire with its drives. Where no document says what a drive does, the default is the strict side, and assumed.
#[derive(Clone, Debug, PartialEq)]
pub struct ProfibusSegment {
    /// The master's port, as its bus names it.
    pub port: String,
    /// The port at this end of the cable, where the master's is a real one.
    pub own_port: Option<String>,
    /// Bits/s.
    pub rate: u32,
    /// The master receives what it sends itself.
    pub echo: bool,
    /// The faults of its telegrams.
    pub faults: FaultPlan,
    /// The drives.
    pub drives: Vec<LenzeSettings>,
    /// Another master on the wire.
    pub foreign: Option<ForeignSettings>,
    /// Bytes that nobody sent.
    pub noise: Option<NoiseSettings>,
}

impl ProfibusSegment {
    /// A wire without faults.
    pub fn new(port: impl Into<String>, rate: u32, drives: Vec<LenzeSettings>) -> ProfibusSegment {
        ProfibusSegment {
            port: port.into(),
            own_port: None,
            rate,
            echo: false,
            faults: FaultPlan::default(),
            drives,
            foreign: None,
            noise: None,
        }
    }

    /// How bytes are sent on it.
    pub fn line(&self) -> SerialLine {
        SerialLine { rate: self.rate, parity: Parity::Even, rs485: Rs485::Adapter }
    }
}

/// A simulated drive with its PROFIBUS module.
#[derive(Clone, Debug, PartialEq)]
pub struct LenzeSettings {
    /// Its address.
    pub address: u8,
    /// Its ident number. Default 0x0082, a placeholder: that of the 2130IB.
    pub ident: u16,
    /// The identifier bytes that Chk_Cfg has to have, all of them. Default F3 F1.
    pub configuration: Vec<u8>,
    /// The link layer.
    pub link: LinkSettings,
    /// Parametrisation and states.
    pub dp: DpSettings,
    /// What the first 8 bytes of the process data are.
    pub channel: Channel,
    /// The acyclic side.
    pub acyclic: AcyclicSettings,
    /// The time that a parameter job takes in the channel, ns. At least until the next exchange. Default 2 ms.
    pub job_ns: u64,
    /// The words of the outputs behind the channel.
    pub outputs: Vec<OutputWord>,
    /// The words of the inputs behind the channel.
    pub inputs: Vec<InputWord>,
    /// Control word, status word, faults.
    pub power: PowerSettings,
    /// The motor.
    pub motor: LenzeMotorSettings,
    /// From power-on until it receives, ns. Default 500 ms.
    pub boot_ns: u64,
    /// Comes up enabled and running at this speed, rpm, as if another master had died.
    pub running: Option<f64>,
    /// The address of that master. Default 2.
    pub last_master: u8,
}

impl LenzeSettings {
    /// A drive at rest with the DRIVECOM channel and two words, that does everything as the defaults say.
    pub fn new(address: u8) -> LenzeSettings {
        LenzeSettings {
            address,
            ident: 0x0082,
            configuration: vec![0xF3, 0xF1],
            link: LinkSettings::default(),
            dp: DpSettings::default(),
            channel: Channel::Drivecom,
            acyclic: AcyclicSettings::default(),
            job_ns: 2 * MS,
            outputs: vec![OutputWord::Control, OutputWord::SetPoint],
            inputs: vec![InputWord::Status, InputWord::Speed],
            power: PowerSettings::default(),
            motor: LenzeMotorSettings::default(),
            boot_ns: 500 * MS,
            running: None,
            last_master: 2,
        }
    }
}

/// The link layer of a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkSettings {
    /// The time from a request to its answer, bits: at least min Tsdr, at most MaxTsdr. Default: min Tsdr.
    pub answer_bits: Option<u16>,
    /// MaxTsdr, bits. Default: that of an SPC3 at this rate (GSD files).
    pub max_tsdr: Option<u16>,
    /// 8 bytes leave as SD3, not as SD2.
    pub sd3: bool,
}

impl LinkSettings {
    /// MaxTsdr at this rate, bits.
    pub fn max_tsdr(&self, rate: u32) -> u16 {
        let usual = match rate {
            45_450 => 250,
            0..=45_449 | 45_451..=187_500 => 60,
            187_501..=500_000 => 100,
            500_001..=1_500_000 => 150,
            1_500_001..=3_000_000 => 250,
            3_000_001..=6_000_000 => 450,
            _ => 800,
        };
        self.max_tsdr.unwrap_or(usual)
    }
}

/// Parametrisation and states of a slave.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DpSettings {
    /// The User_Prm that it takes.
    pub user_prm: UserPrm,
    /// It knows DP-V1. Default true.
    pub dpv1: bool,
    /// It knows Sync and Freeze. It does nothing for them; without, a Set_Prm that asks for them is refused. Default
    /// false.
    pub sync_freeze: bool,
    /// Outputs count only behind a Global_Control with Operate. False: from the first Data_Exchange on. Default true.
    pub needs_operate: bool,
    /// From a right Chk_Cfg until Data_Exchange, ns. Default 1 ms.
    pub ready_ns: u64,
    /// The diagnosis shows Master_Lock to a master that is not its own. Default true.
    pub shows_lock: bool,
    /// What the drive does when the outputs go to the safe state.
    pub safe: Safe,
}

impl Default for DpSettings {
    fn default() -> DpSettings {
        DpSettings {
            user_prm: UserPrm::Any,
            dpv1: true,
            sync_freeze: false,
            needs_operate: true,
            ready_ns: MS,
            shows_lock: true,
            safe: Safe::Inhibit,
        }
    }
}

/// The User_Prm that a slave takes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum UserPrm {
    /// Any one whose first byte has no reserved bit.
    #[default]
    Any,
    /// One of so many bytes.
    Length(usize),
    /// This one.
    Exactly(Vec<u8>),
}

/// What the drive does while its outputs are safe: none came yet, they were cleared, or the master is gone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Safe {
    /// What outputs of zero mean: power off, it coasts.
    #[default]
    Inhibit,
    /// Quick stop.
    QuickStop,
    /// Its fault "communication lost", if it was running.
    Fault,
}

/// The first 8 bytes of the process data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    /// Process data begins at once.
    None,
    /// A: jobs and response ids.
    Pkw,
    /// B: service, subindex, index; replies of write jobs have length bits (30, 70).
    Drivecom,
    /// B, with replies that have neither length nor service (00, 40).
    DrivecomBare,
}

/// The acyclic side (MSAC1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AcyclicSettings {
    /// So many requests are acknowledged without an answer before it comes; 0: the first request gets it. Default 1.
    pub delay: u16,
    /// The time that a parameter request takes, ns; meanwhile a read is answered "state conflict". Default 5 ms.
    pub busy_ns: u64,
    /// The slot of the parameter access. Default 0.
    pub slot: u8,
    /// Its index. Default 47.
    pub index: u8,
    /// How an index becomes a code.
    pub numbers: Numbers,
    /// The most characters of a text in one response. Default 32.
    pub text: usize,
}

impl Default for AcyclicSettings {
    fn default() -> AcyclicSettings {
        AcyclicSettings { delay: 1, busy_ns: 5 * MS, slot: 0, index: 47, numbers: Numbers::FromTop, text: 32 }
    }
}

/// A word of the outputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputWord {
    /// The control word.
    Control,
    /// The set point of the speed.
    SetPoint,
    /// One that an [`InputWord::Echo`] may show.
    Further,
}

/// A word of the inputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputWord {
    /// The status word.
    Status,
    /// The actual speed, scaled like the set point.
    Speed,
    /// Torque, 0x4000 = 100 %.
    Torque,
    /// The code of the fault.
    Fault,
    /// The word of the outputs at this place.
    Echo(u8),
}

/// Control word, status word, faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PowerSettings {
    /// The state machine.
    pub profile: DriveProfile,
    /// Bits 4 to 6 of the control word command the ramp generator (DRIVECOM). False: they are ignored. Default true.
    pub ramp_bits: bool,
    /// The bit of the status word that shows the hardware enable, and its value while that is closed (DRIVECOM).
    /// Default: bit 4, set.
    pub enable_bit: Option<(u8, bool)>,
    /// It slows down before a fault takes the power. False: it coasts. Default false.
    pub brakes_on_fault: bool,
    /// A fault whose cause does not go away: it comes back at each reset and each start.
    pub persistent_fault: Option<u16>,
    /// The code of "communication lost". Default 0x8130.
    pub lost_fault: u16,
    /// A fault of the firmware: no control word takes it out of OPERATION ENABLED. It follows its set point, and safe
    /// outputs, faults and the hardware enable act. Default false.
    pub ignores_stops: bool,
}

impl Default for PowerSettings {
    fn default() -> PowerSettings {
        PowerSettings {
            profile: DriveProfile::Drivecom,
            ramp_bits: true,
            enable_bit: Some((4, true)),
            brakes_on_fault: false,
            persistent_fault: None,
            lost_fault: 0x8130,
            ignores_stops: false,
        }
    }
}

/// The motor and its load.
#[derive(Clone, Debug, PartialEq)]
pub struct LenzeMotorSettings {
    /// The set point at 100 % of C0011. Default 0x4000.
    pub full_count: i16,
    /// C0011 as delivered, rpm. Default 1500.
    pub full_rpm: f64,
    /// C0012, C0013, C0105 as delivered: s from standstill to C0011 and back, and for a quick stop. Default 0.5, 0.5,
    /// 0.1.
    pub ramps_s: (f64, f64, f64),
    /// Rated torque, N m, over 0: 100 %. Default 5.
    pub rated_nm: f64,
    /// Largest torque, N m. Default 12.
    pub peak_nm: f64,
    /// Inertia of everything that turns, kg m², over 0. Default 0.005.
    pub inertia_kgm2: f64,
    /// Friction without power, N m. Default 0.5.
    pub friction_nm: f64,
    /// C0061, °C. Default 43.
    pub temperature: f64,
    /// The hardware enable (CINH) is wired and closed. Default true.
    pub hardware_enable: bool,
}

impl Default for LenzeMotorSettings {
    fn default() -> LenzeMotorSettings {
        LenzeMotorSettings {
            full_count: 0x4000,
            full_rpm: 1_500.0,
            ramps_s: (0.5, 0.5, 0.1),
            rated_nm: 5.0,
            peak_nm: 12.0,
            inertia_kgm2: 0.005,
            friction_nm: 0.5,
            temperature: 43.0,
            hardware_enable: true,
        }
    }
}

/// A second master: a device that sends what the wire's own master does not expect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ForeignSettings {
    /// Its address.
    pub address: u8,
    /// It keeps to the rules of the link layer: it listens, answers a search, claims a wire that is silent, and gives
    /// way to another master. Behind each of `telegrams` it waits a slot time then, whatever `every_ns` is. False: it
    /// sends at its own times, whatever is on the wire. Default false.
    pub listens: bool,
    /// When it begins, ns after the wire's first moment. Default 0.
    pub after_ns: u64,
    /// The time from one telegram to the next, ns. Default 10 ms.
    pub every_ns: u64,
    /// What it sends, in turn, as bytes. Default: a token to itself.
    pub telegrams: Vec<Vec<u8>>,
    /// It sends so many telegrams; `None`: it does not end.
    pub count: Option<u64>,
}

impl ForeignSettings {
    /// One that circles its token.
    pub fn new(address: u8) -> ForeignSettings {
        let token = vec![0xDC, address, address];
        ForeignSettings {
            address,
            listens: false,
            after_ns: 0,
            every_ns: 10 * MS,
            telegrams: vec![token],
            count: None,
        }
    }

    /// One that keeps to the rules: it searches for a master at the next address, and passes the token to itself.
    pub fn listening(address: u8) -> ForeignSettings {
        let next = (address + 1) % 126;
        let sum = next.wrapping_add(address).wrapping_add(0x49);
        let search = vec![0x10, next, address, 0x49, sum, 0x16];
        let token = vec![0xDC, address, address];
        ForeignSettings { listens: true, telegrams: vec![search, token], ..ForeignSettings::new(address) }
    }
}

/// Bytes that nobody sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoiseSettings {
    /// Seed of the random numbers.
    pub seed: u64,
    /// The mean time from one burst to the next, ns. Default 1 s.
    pub every_ns: u64,
    /// The most bytes of a burst. Default 8.
    pub bytes: u8,
}

impl Default for NoiseSettings {
    fn default() -> NoiseSettings {
        NoiseSettings { seed: 0, every_ns: S, bytes: 8 }
    }
}
