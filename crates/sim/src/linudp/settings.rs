//! The settings of a simulated LinMot drive.

use std::net::SocketAddrV4;

use crate::FaultPlan;
use fieldbeat_core::time::MS;

/// A simulated LinMot drive. Where no document says what it does, the default is the strict side, and assumed.
#[derive(Clone, Debug, PartialEq)]
pub struct LinMotSettings {
    /// The address that it listens at.
    pub address: SocketAddrV4,
    /// The serial number, and the parameter that has it. Default: no parameter.
    pub serial: Option<(u16, u32)>,
    /// Faults on its wire.
    pub faults: FaultPlan,
    /// The shortest payload that the drive sends, filled up behind the blocks: 0, 14 or 64 (sheet, 1.1).
    pub padding: usize,
    /// Which masters it answers.
    pub filter: MasterFilter,
    /// The position at power-on, 0.1 um.
    pub start_position: i32,
    /// Mechanical range, and the minimum and maximum position in ROM (UPIDs 146Eh and 146Fh), 0.1 um. All counts: an
    /// axis that turns without end, whose position count wraps around.
    pub range: (i32, i32),
    /// Moving mass, kg.
    pub mass_kg: f64,
    /// Where the home switch is, and what the position is there (UPIDs 13CAh and 13C7h in ROM), 0.1 um.
    pub home_position: i32,
    /// Period expected by the commands with configured period (UPID 14E6h in ROM, whole us), ns.
    pub stream_period_ns: u64,
    /// A stream without a setpoint for so many periods ends in error 0083h. How patient a real drive is, is not
    /// documented; 2.5 is a strict guess.
    pub stream_patience: f64,
    /// Setpoints that a stream holds ahead of its output; one more ends in error 0082h. Not documented either.
    pub stream_depth: usize,
    /// The drive's report of its control word, in the status word, is so old, ns.
    pub status_lag_ns: u64,
    /// Bits 1-5 of the control word are forced to 1, as commonly parameterised.
    pub force_enable_bits: bool,
    /// Comes up with its motor enabled and a motion running, as if another master had died.
    pub start_running: bool,
    /// How long a command on the real-time-config channel takes, ns; "busy" is answered meanwhile.
    pub config_time_ns: u64,
    /// How long a save into flash takes, ns. Real drives took 39 ... 75 s and more.
    pub flash_time_ns: u64,
    /// Its answers meanwhile.
    pub flash: FlashMode,
    /// Its reaction to motion commands that it cannot run.
    pub unknown_commands: UnknownCommands,
    /// Values of less than 32 bits carry their sign in the bits above, when they are read or monitored; else these are
    /// 0.
    pub extend_sign: bool,
}

impl LinMotSettings {
    /// A kilogram on two metres of track with the home switch in its middle, answering any master, 1 ms streams.
    pub fn new(address: SocketAddrV4) -> LinMotSettings {
        LinMotSettings {
            address,
            serial: None,
            faults: FaultPlan::default(),
            padding: 14,
            filter: MasterFilter::None,
            start_position: 0,
            range: (-10_000_000, 10_000_000),
            mass_kg: 1.0,
            home_position: 0,
            stream_period_ns: MS,
            stream_patience: 2.5,
            stream_depth: 8,
            status_lag_ns: 0,
            force_enable_bits: false,
            start_running: false,
            config_time_ns: 0,
            flash_time_ns: 500 * MS,
            flash: FlashMode::default(),
            unknown_commands: UnknownCommands::default(),
            extend_sign: false,
        }
    }

    /// The range of an axis that turns without end.
    pub const ENDLESS: (i32, i32) = (i32::MIN, i32::MAX);

    /// The axis turns without end.
    pub fn is_endless(&self) -> bool {
        self.range == LinMotSettings::ENDLESS
    }
}

/// The answers of a drive while it writes into its flash. The manual says that the interface stays active; masters in
/// the field saw it fall silent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FlashMode {
    /// Nothing, but for the telegram that began it; and afterwards how it went.
    #[default]
    Silent,
    /// Nothing at all, and afterwards nothing of it: its channel has not stored the command. So a C1250 was seen to
    /// behave.
    Mute,
    /// Everything; on the real-time-config channel that it is busy.
    Busy,
}

/// The reaction to a motion command that is unknown, or that needs hardware or a software key the drive does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UnknownCommands {
    /// Error 0081h.
    #[default]
    Refuse,
    /// Nothing.
    Ignore,
}

/// The drive's master configuration (manual, 5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MasterFilter {
    /// Answers every sender.
    #[default]
    None,
    /// Latches the first sender's address after start.
    Single,
    /// Answers this address only.
    Fixed(std::net::Ipv4Addr),
}
