//! What an operator and a master say to each other.

use serde::{Deserialize, Serialize};

/// A request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Request {
    /// The facts of the axes. For everybody, like the next one.
    Axes,
    /// How the axes are, and the notices after this number.
    State {
        /// The number of the last notice that is known.
        since: u64,
    },
    /// Become the operator, under this name.
    Take {
        /// The name, for others that want to be it.
        name: String,
    },
    /// Stop all axes. For everybody.
    Stop,
    /// Stop the axis with this index. For everybody.
    StopAxis(usize),
    /// Whether the axis does that, and within its limits, whatever state it is in. For everybody.
    Check(Act),
    /// Operate no more, and leave the axes as they are, powered ones too. Refused while anything is under way.
    Leave,
    /// A request for the operator only.
    Act(Act),
}

/// The requests for the operator only.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Act {
    /// A command to the axis with this index.
    Command {
        /// The index.
        axis: usize,
        /// The command.
        command: Order,
    },
    /// Begin to jog the axis with this index.
    Jog {
        /// The index.
        axis: usize,
        /// Signed, user units/s.
        velocity: f64,
    },
    /// Go on with the jog of this number.
    Hold {
        /// The number.
        jog: u64,
    },
    /// End the jog of this number.
    Release {
        /// The number.
        jog: u64,
    },
}

/// The commands of an operator to an axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// Power on.
    Enable,
    /// Power off at once.
    Disable,
    /// The drive's own homing.
    Home,
    /// A move.
    Move {
        /// The target.
        target: Goal,
        /// User units/s; `None`: that of its profile.
        #[serde(default)]
        velocity: Option<f64>,
        /// User units/s², of both ramps; `None`: those of its profile.
        #[serde(default)]
        acceleration: Option<f64>,
    },
    /// Acknowledge a fault of the drive.
    ResetFault,
    /// Clear the stop latch.
    Reset,
}

/// The target of a move, user units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    /// A position.
    To(f64),
    /// A distance from the demand position.
    By(f64),
}

impl Order {
    /// A move by this distance, at this velocity.
    pub fn step(distance: f64, velocity: f64) -> Order {
        Order::Move { target: Goal::By(distance), velocity: Some(velocity), acceleration: None }
    }
}

/// The answer to a request that was not refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    /// To `Axes`.
    Axes(Vec<AxisFacts>),
    /// To `State`.
    State(Box<OperationState>),
    /// To `Command`, and to `StopAxis` where there is something to be stopped: the id of the command, whose end is a
    /// notice.
    Commanded(u64),
    /// To `Jog`: the number of the jog.
    Jogs(u64),
    /// To all others.
    Done,
}

/// The facts of an axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AxisFacts {
    /// The name.
    pub name: String,
    /// The protocol of its drive.
    pub protocol: String,
    /// The user unit.
    pub unit: String,
    /// Smallest and largest position.
    pub position_limits: Option<(f64, f64)>,
    /// Largest speed, user units/s.
    pub velocity_limit: Option<f64>,
    /// The velocity of its profile, user units/s.
    pub velocity: f64,
    /// Power stays on after a stop.
    pub holds: bool,
    /// The capabilities that it lacks.
    pub lacks: AxisLacks,
    /// Name and unit of the variables that its drive reports in addition.
    pub monitors: Vec<(String, String)>,
}

/// Why an axis does not do something; `None`: it does.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AxisLacks {
    /// Be enabled.
    pub enable: Option<String>,
    /// Home.
    pub home: Option<String>,
    /// Step.
    pub step: Option<String>,
    /// Jog.
    pub jog: Option<String>,
}

/// How the axes are.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OperationState {
    /// In the order of the plan.
    pub axes: Vec<AxisState>,
    /// The name of the operator.
    pub operator: Option<String>,
    /// Number and axis of the jog that runs.
    pub jog: Option<(u64, usize)>,
    /// The notices, oldest first.
    pub notices: Vec<Notice>,
}

/// How an axis is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AxisState {
    /// The cycle of this report.
    pub cycle: u64,
    /// Cycles since the status left the drive.
    pub age: u32,
    /// The link.
    pub link: String,
    /// Why there is no connection.
    pub not_connected: Option<String>,
    /// The state of the power drive system.
    pub state: String,
    /// The power stage may be on.
    pub powered: bool,
    /// Ready for motion.
    pub operational: bool,
    /// Why the master has stopped it.
    pub stopped: Option<String>,
    /// The fault by its name.
    pub fault: Option<String>,
    /// The warning word.
    pub warning: u32,
    /// The drive's hardware enable (STO) is missing.
    pub sto_open: bool,
    /// Homed.
    pub homed: bool,
    /// The drive's setpoint generator is running.
    pub moving: bool,
    /// In the target window.
    pub in_target: bool,
    /// Actual position, user units.
    pub position: Option<f64>,
    /// Demand position, user units.
    pub demand: Option<f64>,
    /// Actual velocity, user units/s.
    pub velocity: Option<f64>,
    /// Motor current, A.
    pub current: Option<f64>,
    /// The variables of [`AxisFacts::monitors`].
    pub monitors: Vec<Option<f64>>,
    /// The names of the commands that have not ended yet.
    pub commands: Vec<String>,
    /// A stop has not ended yet: other commands are refused.
    pub stopping: bool,
}

/// Something that happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Notice {
    /// Counted up from 1.
    pub number: u64,
    /// The index of its axis.
    pub axis: Option<usize>,
    /// The notice in words.
    pub text: String,
    /// The end of a command.
    pub end: Option<CommandEnd>,
}

/// The end of a command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CommandEnd {
    /// The id.
    pub command: u64,
    /// How it ended.
    pub how: Ended,
}

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ended {
    /// It was carried out.
    Done,
    /// It was not.
    Failed,
    /// Another command or a stop took precedence.
    Aborted,
}
