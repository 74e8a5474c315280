//! A LinUDP bus as configured and checked.

use std::net::SocketAddrV4;

use crate::axis::AxisPlan;
use crate::net::SendMode;
use crate::sim::FaultPlan;

/// The master's port, source and destination of everything (manual, 4.3).
pub const MASTER_PORT: u16 = 41136;
/// The drives' port (manual, 4.3).
pub const DRIVE_PORT: u16 = 49360;

/// One master socket and its drives.
#[derive(Clone, Debug, PartialEq)]
pub struct LinUdpPlan {
    /// Its name in messages.
    pub name: String,
    /// Where the master listens and sends from.
    pub bind: SocketAddrV4,
    /// One system call for all requests, or one each.
    pub send: SendMode,
    /// The drives; one address each.
    pub drives: Vec<LinUdpDrive>,
}

/// One LinMot drive.
#[derive(Clone, Debug, PartialEq)]
pub struct LinUdpDrive {
    /// What every protocol's axis has. Counts are 0.1 um: 10 000 a millimetre.
    pub axis: AxisPlan,
    /// Where the drive listens.
    pub address: SocketAddrV4,
    /// The streaming command that Follow uses.
    pub stream: StreamCommand,
    /// Ask for the four monitoring channels too.
    pub monitor: bool,
    /// Carry a real-time-config NOP with a new count in each request: its echo tells which request a reply answers.
    pub reply_tag: bool,
    /// How far a jog runs ahead at most, user units. A LinUDP drive has no watchdog, so a jog is a target that rolls
    /// ahead of the axis; if the master dies the axis runs this far. `None`: jogs are refused (`no_drive_watchdog`).
    pub leash: Option<f64>,
    /// The drive when it is simulated.
    pub simulate: SimPlan,
}

/// The streaming commands of the motion command interface (SG5 manual, 030x ... 035x).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamCommand {
    /// 030x: position; the drive's receive time is the time base. 2 ... 5 ms.
    P,
    /// 031x: position, velocity; receive time. 2 ... 5 ms.
    Pv,
    /// 032x: position; the period configured in the drive (UPID 14E6h). 2 ... 5 ms.
    PConfigured,
    /// 033x: position, velocity; configured period. 0.4 ... 10 ms.
    PvConfigured,
    /// 034x: position, velocity, acceleration; receive time. 0.4 ... 10 ms.
    Pva,
    /// 035x: position, velocity, acceleration; configured period. 0.4 ... 10 ms.
    PvaConfigured,
}

/// A simulated LinMot drive.
#[derive(Clone, Debug, PartialEq)]
pub struct SimPlan {
    /// Faults on its wire.
    pub faults: FaultPlan,
    /// The shortest payload that the drive sends, filled up behind the blocks: 0, 14 or 64 (sheet, 1.1).
    pub padding: usize,
    /// Which masters it answers.
    pub filter: MasterFilter,
    /// The position at power-on, 0.1 um.
    pub start_position: i32,
    /// Mechanical range, 0.1 um.
    pub range: (i32, i32),
    /// Moving mass, kg.
    pub mass_kg: f64,
    /// Where the home switch is, 0.1 um.
    pub home_position: i32,
    /// Period expected by the commands with configured period (UPID 14E6h), ns.
    pub stream_period_ns: u64,
    /// Bits 1-5 of the control word are forced to 1, as commonly parameterised.
    pub force_enable_bits: bool,
    /// Comes up with its motor enabled and a motion running, as if another master had died.
    pub start_running: bool,
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
