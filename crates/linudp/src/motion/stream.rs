//! Which streaming commands there are: what their setpoints carry, and the periods that they take.

use super::CommandInfo;
use fieldbeat_core::time::{MS, US};

/// The streaming commands of the motion command interface (SG5 manual, 030x ... 035x).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamCommand {
    /// 030x: position; the drive's receive time is the time base. 2 ... 5 ms.
    P = 0x030,
    /// 031x: position, velocity; receive time. 2 ... 5 ms.
    Pv = 0x031,
    /// 032x: position; the period configured in the drive (UPID 14E6h). 2 ... 5 ms.
    PConfigured = 0x032,
    /// 033x: position, velocity; configured period. 0.4 ... 10 ms.
    PvConfigured = 0x033,
    /// 034x: position, velocity, acceleration; receive time. 0.4 ... 10 ms.
    Pva = 0x034,
    /// 035x: position, velocity, acceleration; configured period. 0.4 ... 10 ms.
    PvaConfigured = 0x035,
}

impl StreamCommand {
    /// All of them, in the order of their headers.
    pub const ALL: [StreamCommand; 6] = [
        StreamCommand::P,
        StreamCommand::Pv,
        StreamCommand::PConfigured,
        StreamCommand::PvConfigured,
        StreamCommand::Pva,
        StreamCommand::PvaConfigured,
    ];

    /// The word in the configuration: what is behind `stream-` in its name as a command.
    pub fn name(self) -> &'static str {
        CommandInfo::of(self.id()).and_then(|info| info.name.strip_prefix("stream-")).unwrap_or_default()
    }

    /// The shortest and the longest time between two setpoints that the drive takes, ns (SG5 manual, 030x ... 035x).
    pub const fn period_range_ns(self) -> (u64, u64) {
        match self {
            StreamCommand::P | StreamCommand::Pv | StreamCommand::PConfigured => (2 * MS, 5 * MS),
            _ => (400 * US, 10 * MS),
        }
    }

    /// Whether the drive takes a setpoint every `period_ns`.
    pub fn takes(self, period_ns: u64) -> bool {
        let (shortest, longest) = self.period_range_ns();
        (shortest..=longest).contains(&period_ns)
    }

    /// Master and sub id.
    pub const fn id(self) -> u16 {
        self as u16
    }

    /// The command of this id.
    pub fn from_id(id: u16) -> Option<StreamCommand> {
        StreamCommand::ALL.into_iter().find(|command| command.id() == id)
    }

    /// Setpoints carry a velocity.
    pub const fn has_velocity(self) -> bool {
        !matches!(self, StreamCommand::P | StreamCommand::PConfigured)
    }

    /// Setpoints carry an acceleration.
    pub const fn has_acceleration(self) -> bool {
        matches!(self, StreamCommand::Pva | StreamCommand::PvaConfigured)
    }

    /// The time base is the period configured in the drive (UPID 14E6h), not the instant at which it receives.
    pub const fn has_configured_period(self) -> bool {
        use StreamCommand::{PConfigured, PvConfigured, PvaConfigured};
        matches!(self, PConfigured | PvConfigured | PvaConfigured)
    }
}
