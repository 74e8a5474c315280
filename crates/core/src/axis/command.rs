//! The commands that an application gives to an axis, their ids, and how they end.
//!
//! Every accepted command ends in exactly one of Done, Failed or Aborted, reported by an
//! [`Event`](crate::axis::Event). A command waits until the one before it has ended, with two exceptions: a motion
//! replaces a running motion at once (PLCopen's "aborting" mode), and Stop, QuickStop and Disable act at once and
//! abort everything queued before them.

use std::fmt;

use thiserror::Error;

use super::feedback::{Fault, State, StopCause};
use super::units::RangeError;

/// The id of one accepted command of one axis. Ids grow by one; 0 is never used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub struct CommandId(pub u64);

/// Ids of commands from the in-loop task have this bit, so that they never collide with those of an
/// [`Axis`](crate::Axis).
const OF_TASK: u64 = 1 << 63;

impl CommandId {
    /// Of no command: the setpoint with it says that the application has dropped the axis.
    pub(crate) const NO_OWNER: CommandId = CommandId(u64::MAX);

    /// The `number`-th command of the in-loop task.
    pub fn of_task(number: u64) -> CommandId {
        CommandId(number | OF_TASK)
    }

    /// Whether the in-loop task has given it.
    pub fn is_of_task(self) -> bool {
        self.0 & OF_TASK != 0
    }
}

/// One command on its way to the loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QueuedCommand {
    /// The id, assigned on submission.
    pub id: CommandId,
    /// The place of its axis in the machine.
    pub member: u32,
    /// The command itself.
    pub command: Command,
    /// For [`Command::Follow`]: which stream.
    pub stream: u32,
    /// Of a command to a [`Group`](crate::axis::Group): what it has in common with those of the other members.
    pub call: Option<GroupCall>,
}

/// A call to a group: one command to each member, one after the other in the queue of the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroupCall {
    /// How many commands there are.
    pub parts: u32,
    /// How many of them begin together: all but the stops, which wait for no other member.
    pub together: u32,
    /// The place of the first of these members, which stands for the group ...
    pub lead: u32,
    /// ... and the id of its command, which stands for the call.
    pub id: CommandId,
}

/// A row on its way to the loop, and its stream: a follow runs the rows of its own stream only, and ignores
/// leftovers of earlier streams.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StreamRow {
    /// Streams are counted up.
    pub stream: u32,
    /// The place of the axis in the machine.
    pub member: u32,
    /// How many members have a part in the row, one after the other in the queue of the first; 1 = the axis alone.
    pub parts: u32,
    /// The row.
    pub row: Row,
}

/// One velocity or torque on its way to the loop, alone or as one axis' part of those of a group.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Setpoint {
    /// The place of its axis in the machine.
    pub member: u32,
    /// How many members have a part in the set; 1 = the axis alone.
    pub parts: u32,
    /// Counts the setpoints of the axis up: of two that come by different ways, the later one counts.
    pub number: u64,
    /// The [`Command::Jog`], [`Command::Velocity`] or [`Command::Torque`] that it belongs to.
    pub of: CommandId,
    /// User units/s, or per cent of the rated torque.
    pub value: f64,
}

/// A command to an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// Power on, up to `OperationEnabled`. Refused while the axis is latched as stopped. It waits, no longer than its
    /// own time-out, for the write of a parameter that may command the drive.
    Enable,
    /// Power off at once. Ends a motion without a ramp; use [`Command::Stop`] first where the load matters.
    Disable,
    /// Run the drive's own homing.
    Home,
    /// A profile move.
    Move(Move),
    /// Constant velocity until another command replaces it, or until it is not renewed within the axis' dead-man
    /// time.
    Jog(Jog),
    /// Follow the axis' cyclic velocity setpoints. A setpoint older than the axis allows stops the axis.
    Velocity {
        /// User units/s², towards each new setpoint.
        acceleration: f64,
    },
    /// Follow the rows of the axis' stream (or of the in-loop task), one an exchange.
    Follow,
    /// Follow the axis' cyclic torque setpoints, 0 until the first one comes. A setpoint older than the axis allows
    /// stops the axis.
    ///
    /// Torques are in per cent of the motor's rated torque, as CiA 402 drives count them (6071h, in per mille);
    /// above 0 they accelerate towards higher positions. The motion depends on the load: the axis stops at its
    /// velocity limit, without which the command is refused, and where it could no longer stop inside its position
    /// limits. A vertical load would drop, and is refused.
    Torque {
        /// Per cent of the rated torque a second, towards each new setpoint (CiA 402: 6087h).
        slope: f64,
    },
    /// Ramp down and stay enabled.
    Stop {
        /// Deceleration in user units/s²; `None` takes that of the axis' profile.
        deceleration: Option<f64>,
    },
    /// The drive's fastest controlled stop; the drive stays enabled if it can.
    QuickStop,
    /// Acknowledge a fault of the drive. Ends with power off.
    ResetFault,
    /// Clear the stop latch of the axis, so that Enable is accepted again. Moves nothing.
    Reset,
    /// Give the application control of the drive's native process data; see the protocol's own types.
    Native(NativeOwner),
}

/// The meaning of cyclic setpoints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Velocities, user units/s.
    Velocity,
    /// Torques, per cent of the rated torque.
    Torque,
}

impl Level {
    /// All of them.
    pub const ALL: [Level; 2] = [Level::Velocity, Level::Torque];

    /// The name in messages.
    pub fn name(self) -> &'static str {
        if self == Level::Velocity { "velocity" } else { "torque" }
    }

    /// Whether `command` takes them.
    pub fn is_of(self, command: &Command) -> bool {
        match self {
            Level::Velocity => command.takes_velocities(),
            Level::Torque => command.takes_torques(),
        }
    }
}

/// Who owns the control word in native mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NativeOwner {
    /// The master keeps the drive enabled; the application writes motion data only.
    Master,
    /// The application writes everything; the master only stops the axis.
    Application,
}

/// A move along a profile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// The target.
    pub target: Target,
    /// The profile.
    pub profile: Profile,
}

/// The target of a move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// A position, user units.
    Absolute(f64),
    /// A distance from the demand position at the moment the move starts, user units.
    Relative(f64),
}

/// A constant velocity, to be renewed by new velocity setpoints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jog {
    /// Signed, user units/s.
    pub velocity: f64,
    /// User units/s², also used to brake.
    pub acceleration: f64,
}

/// Velocity, acceleration and deceleration of a move, in user units and seconds. All positive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    /// User units/s.
    pub velocity: f64,
    /// User units/s².
    pub acceleration: f64,
    /// User units/s².
    pub deceleration: f64,
}

/// One row of a stream: the demand at one exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Row {
    /// User units.
    pub position: f64,
    /// User units/s. Used where the drive's streaming command carries it.
    pub velocity: f64,
    /// User units/s². Used where the drive's streaming command carries it.
    pub acceleration: f64,
    /// The last row: after it the stream ends and the command is Done at standstill.
    pub last: bool,
}

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outcome {
    /// It was carried out.
    Done,
    /// It was not carried out.
    Failed(Failure),
    /// Another command or a stop took precedence.
    Aborted(Abort),
}

/// Why a command was aborted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Abort {
    /// A later command of the application took its place.
    Replaced(CommandId),
    /// The axis was stopped.
    Stopped(StopCause),
}

/// Why a command failed.
#[derive(Clone, Copy, PartialEq, Error)]
#[non_exhaustive]
pub enum Failure {
    /// The drive is in a state in which this cannot start.
    #[error("the drive is in state {0}: bring it to OperationEnabled first (enable)")]
    WrongState(State),
    /// The axis was not enabled since it was stopped or taken over, whatever state its drive is in.
    #[error("the axis was not enabled since its last stop: enable it first")]
    NotEnabled,
    /// The drive reports a fault.
    #[error("{}", reports(Fault { code: *.0, name: None }))]
    DriveFault(u32),
    /// The drive did not finish in time.
    #[error(
        "the drive did not finish in time (state {0}): look at its state and enables, or raise the time-out"
    )]
    TimedOut(State),
    /// The drive accepted none of the repeated motion commands, or none for long.
    #[error(
        "the drive did not take the motion command, or each time it was lost on the way or replaced: look at \
         `missed`, at the drive's own mode (of a LinMot: run mode motion command interface) and at what else \
         commands it, then repeat it"
    )]
    NotTaken,
    /// The drive has ended the motion at another position.
    #[error(
        "the drive ended the motion elsewhere: look at the limits in the drive, and whether something else \
         moves it"
    )]
    NotArrived,
    /// The demand has arrived, and the actual position has not.
    #[error(
        "the axis did not come to rest at its target, it is {distance} away and in_position.window is \
         {window}: look at what holds it and at its controller, or widen the window (\"off\": a move ends \
         with its demand)"
    )]
    OutOfPosition {
        /// From the target to the actual position, user units.
        distance: f64,
        /// The largest distance that counts as arrived.
        window: f64,
    },
    /// The motor turns although the setpoint is zero.
    #[error(
        "the drive moves at a setpoint of zero: look at its own references (presets, hard or jog speed, \
         inputs)"
    )]
    StillMoves,
    /// The axis is latched as stopped.
    #[error("the axis is stopped ({0}): reset, then enable")]
    Latched(StopCause),
    /// The link is not up.
    #[error("the drive is not online: `fieldbeat status` and Master::wait_online say why")]
    NotOnline,
    /// A value outside the configured limits.
    #[error(
        "{what} {value} is outside its limit ({low} ... {high}): change the command or limits in the \
         configuration"
    )]
    Limit {
        /// The limited quantity.
        what: &'static str,
        /// The requested value.
        value: f64,
        /// The lower limit.
        low: f64,
        /// The upper limit.
        high: f64,
    },
    /// A value has to be above zero and is not.
    #[error("{what} {value} must be above 0")]
    NotPositive {
        /// The quantity.
        what: &'static str,
        /// The requested value.
        value: f64,
    },
    /// Power cannot come on.
    #[error("the drive's hardware enable (STO) is missing: close it, then enable")]
    StoOpen,
    /// Power off in motion would let the load drop.
    #[error("the axis moves a vertical load: stop it first, power goes off at standstill")]
    LoadInMotion,
    /// Another member of the group could not begin, so that no member does.
    #[error("another axis of the group could not do it: look at its outcome")]
    GroupRefused,
    /// Position limits mean nothing before homing.
    #[error("the axis has position limits and is not homed: home it first")]
    NotHomed,
    /// A parameter that may command the drive is being written: it must not arrive with power on.
    #[error("a write of a parameter that may command the drive has not ended: wait for its end, then enable")]
    BeingWritten,
    /// A value that the wire cannot carry.
    #[error(transparent)]
    Range(#[from] RangeError),
    /// Not a finite number.
    #[error("a value is not a finite number: look at its computation")]
    NotFinite,
    /// This drive or its configuration cannot do it.
    #[error("this drive cannot do that: {0}")]
    Unsupported(&'static str),
    /// The stream ran out of rows and its policy is to stop.
    #[error("the stream ran empty: queue more rows or choose another underrun policy")]
    Underrun,
    /// The drive left the state that the command needs while the command ran.
    #[error("the drive left operation (state {0})")]
    Dropped(State),
}
crate::debug_as_display!(Failure);

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Outcome::Done => f.write_str("done"),
            Outcome::Failed(why) => write!(f, "failed: {why}"),
            Outcome::Aborted(Abort::Replaced(by)) => write!(f, "aborted: replaced by command {}", by.0),
            Outcome::Aborted(Abort::Stopped(cause)) => write!(f, "aborted: {cause}"),
        }
    }
}

impl Outcome {
    /// The fault code of the drive, if that is why it failed.
    pub fn fault(&self) -> Option<u32> {
        match *self {
            Outcome::Failed(Failure::DriveFault(code)) => Some(code),
            _ => None,
        }
    }

    /// In words, with the protocol's name for the fault of the drive if that is why it failed.
    pub fn described(&self, name: Option<&str>) -> String {
        match self.fault() {
            Some(code) => format!("failed: {}", reports(Fault { code, name })),
            None => self.to_string(),
        }
    }
}

fn reports(fault: Fault<'_>) -> String {
    format!("the drive reports fault {fault}: remove its cause, then reset_fault")
}

impl Command {
    /// It acts at once and aborts everything before it.
    pub fn is_urgent(&self) -> bool {
        self.is_stop() || matches!(self, Command::Disable)
    }

    /// It stops the axis, which keeps its power.
    pub(crate) fn is_stop(&self) -> bool {
        matches!(self, Command::Stop { .. } | Command::QuickStop)
    }

    /// It moves the axis: a motion, or homing.
    pub(crate) fn moves(&self) -> bool {
        self.is_motion() || matches!(self, Command::Home)
    }

    /// It moves the axis, or makes it ready to be moved.
    pub(crate) fn acts(&self) -> bool {
        self.moves() || matches!(self, Command::Enable)
    }

    /// It is a motion: it may replace a running motion.
    pub fn is_motion(&self) -> bool {
        matches!(self, Command::Move(_) | Command::Follow | Command::Native(_))
            || self.takes_velocities()
            || self.takes_torques()
    }

    /// It follows velocity setpoints.
    pub fn takes_velocities(&self) -> bool {
        matches!(self, Command::Jog(_) | Command::Velocity { .. })
    }

    /// It follows torque setpoints.
    pub fn takes_torques(&self) -> bool {
        matches!(self, Command::Torque { .. })
    }

    /// The names, by [`code`](Command::code); 0 is no command.
    pub const NAMES: [&str; 14] = [
        "-",
        "enable",
        "disable",
        "home",
        "move",
        "jog",
        "velocity",
        "follow",
        "stop",
        "quick stop",
        "reset fault",
        "reset",
        "native",
        "torque",
    ];

    /// The number in records, from 1.
    pub fn code(&self) -> u8 {
        match self {
            Command::Enable => 1,
            Command::Disable => 2,
            Command::Home => 3,
            Command::Move(_) => 4,
            Command::Jog(_) => 5,
            Command::Velocity { .. } => 6,
            Command::Follow => 7,
            Command::Stop { .. } => 8,
            Command::QuickStop => 9,
            Command::ResetFault => 10,
            Command::Reset => 11,
            Command::Native(_) => 12,
            Command::Torque { .. } => 13,
        }
    }

    /// The name in events and messages.
    pub fn name(&self) -> &'static str {
        Command::NAMES[usize::from(self.code())]
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// One of each verb, with its name.
    pub(crate) fn all() -> [(Command, &'static str); 13] {
        let profile = Profile { velocity: 1.0, acceleration: 2.0, deceleration: 3.0 };
        [
            (Command::Enable, "enable"),
            (Command::Disable, "disable"),
            (Command::Home, "home"),
            (Command::Move(Move { target: Target::Absolute(-4.0), profile }), "move"),
            (Command::Jog(Jog { velocity: -1.5, acceleration: 9.0 }), "jog"),
            (Command::Velocity { acceleration: 8.0 }, "velocity"),
            (Command::Follow, "follow"),
            (Command::Stop { deceleration: None }, "stop"),
            (Command::QuickStop, "quick stop"),
            (Command::ResetFault, "reset fault"),
            (Command::Reset, "reset"),
            (Command::Native(NativeOwner::Master), "native"),
            (Command::Torque { slope: 6.0 }, "torque"),
        ]
    }

    #[test]
    fn old_records_keep_the_names_of_their_commands() {
        assert_eq!(all().len() + 1, Command::NAMES.len());
        for ((command, name), code) in all().into_iter().zip(1..) {
            assert_eq!((command.code(), command.name()), (code, name));
        }
    }

    #[test]
    fn a_command_that_failed_by_a_fault_names_it_and_any_other_reads_as_ever() {
        let failed = Outcome::Failed(Failure::DriveFault(30));
        let by =
            |fault| format!("failed: the drive reports fault {fault}: remove its cause, then reset_fault");
        assert_eq!(failed.to_string(), by("0x001e (30)"));
        assert_eq!(failed.described(None), failed.to_string());
        assert_eq!(failed.described(Some("watchdog")), by("0x001e (30, watchdog)"));
        for other in [
            Outcome::Done,
            Outcome::Failed(Failure::NotOnline),
            Outcome::Aborted(Abort::Replaced(CommandId(7))),
        ] {
            assert_eq!((other.fault(), other.described(Some("watchdog"))), (None, other.to_string()));
        }
    }
}
