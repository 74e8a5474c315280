//! What the loop wants of a drive, and what shows that the drive has it: the interface of IEC 61800-7. Desired state
//! goes down, status comes up. No protocol interprets a command of an application, and the loop knows no wire.
//!
//! Positions are user units, not folded into one turn.

use crate::axis::command::NativeOwner;
use crate::axis::{Cannot, Failure, Lacks, Profile};
use crate::time::Time;

/// The desired state of a drive from its next request on. It holds until it is replaced.
///
/// The serials are on one cache line: most cycles read no more of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Desired {
    /// The power.
    pub power: Intent<Power>,
    /// The mode of operation.
    pub mode: Intent<Mode>,
    /// The motion.
    pub motion: Intent<Motion>,
    /// The setpoint of the next send, with [`Motion::Follow`] and where the master makes all setpoints.
    pub setpoint: Setpoint,
}

impl Desired {
    /// The revision: the newest of its intents, whose serials all come from one count. Another one is another revision,
    /// setpoints are not.
    #[inline]
    pub fn revision(&self) -> u64 {
        self.power.serial.max(self.mode.serial).max(self.motion.serial)
    }
}

/// One part of what is desired. A new serial is a new intent, even with the same value: it is carried out once.
/// Setpoints are values, and have none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Intent<T> {
    /// Grows with each intent; 0 = none yet.
    pub serial: u64,
    /// The desired value.
    pub value: T,
}

/// The power of a drive, as the command of the one transition that is requested of it (CiA 402).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Power {
    /// As it was found: nothing is written.
    #[default]
    Untouched,
    /// Off, at once.
    Off,
    /// Off, and ready to switch on.
    Shutdown,
    /// On, out of operation.
    SwitchOn,
    /// In operation: it follows its motion.
    EnableOperation,
    /// Out of operation by the drive's own quick stop.
    QuickStop,
    /// Off, and the fault acknowledged. It comes after a request without it, since the drive waits for an edge.
    FaultReset,
}

impl Power {
    /// A drive that has it has no power.
    pub fn is_off(self) -> bool {
        matches!(self, Power::Off | Power::Shutdown | Power::FaultReset)
    }
}

/// The mode of operation of a drive that has several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mode {
    /// The one that it is in.
    #[default]
    AsIs,
    /// That of its setpoint.
    Own,
    /// Homing.
    Homing,
}

/// The motion of a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Motion {
    /// None of its own. Where the master makes the setpoints, it follows them.
    #[default]
    Hold,
    /// To a position, made by the drive.
    Move {
        /// The target.
        position: f64,
        /// The profile.
        profile: Profile,
    },
    /// At a velocity, made by the drive; another one is another intent.
    Velocity {
        /// Signed, user units/s; not 0.
        velocity: f64,
        /// User units/s², up and down.
        acceleration: f64,
    },
    /// To standstill along a ramp, made by the drive.
    Ramp {
        /// User units/s².
        deceleration: f64,
    },
    /// The rows of a stream, one an exchange.
    Follow,
    /// The end of a stream, on a drive that does not notice it.
    EndStream,
    /// The drive's fastest stop that keeps its power.
    Halt,
    /// The drive's homing.
    Home,
    /// Native process data of the application.
    Native(NativeOwner),
}

/// A setpoint: a value, good for one send.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Setpoint {
    /// User units.
    pub position: f64,
    /// User units/s.
    pub velocity: f64,
    /// User units/s²; 0 where it is not known.
    pub acceleration: f64,
    /// Per cent of the rated torque.
    pub torque: f64,
    /// The number of the row that it is, which grows by one a row; 0 = none.
    pub row: u64,
}

/// The parts of the desired state that have left, as the bus writes them when a request goes out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Gone {
    /// The slot of the grid that the request was built for; `None`: none has gone out since the loop last looked.
    pub grid: Option<Time>,
}

/// The evidence that a drive has its desired state, written by the bus with each report. The fields that most
/// reports touch are its first cache line.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Evidence {
    /// Outputs reach the drive and count there.
    pub outputs_count: bool,
    /// The power stays on, if it is on: the drive reports that it is commanded to be on.
    pub stays_on: bool,
    /// It can take the next motion.
    pub ready: bool,
    /// The settings are those of its plan; they are written before its power comes on.
    pub is_set_up: bool,
    /// The mode.
    pub mode: ModeIs,
    /// How far its homing is.
    pub homing: Homing,
    /// Whether it has its reference; `None`: not known since that may have changed.
    pub reference: Option<Reference>,
    /// The actual position, not folded into one turn.
    pub position: f64,
    /// The demand position, not folded into one turn.
    pub demand: f64,
    /// The velocity of the demand, user units/s.
    pub demand_velocity: f64,
    /// The newest serials that the drive has accepted, as far as its wire can prove.
    pub accepted: Accepted,
    /// It has refused the newest motion.
    pub refused: Option<Refused>,
    /// It follows what is written.
    pub follows: Follows,
    /// The knowledge of its fault.
    pub fault: FaultIs,
    /// Why it cannot be enabled or moved at present.
    pub obstacle: Cannot,
}

/// Why a drive has refused a motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// It has not taken it.
    NotTaken,
    /// It must not have it, for this reason.
    Because(&'static str),
}

#[doc(hidden)]
impl From<Refused> for Failure {
    fn from(refused: Refused) -> Failure {
        match refused {
            Refused::NotTaken => Failure::NotTaken,
            Refused::Because(why) => Failure::Unsupported(why),
        }
    }
}

/// A drive of which nothing is known, whose protocol proves nothing of these.
impl Default for Evidence {
    fn default() -> Evidence {
        Evidence {
            accepted: Accepted::default(),
            outputs_count: true,
            stays_on: true,
            ready: true,
            follows: Follows::Yes,
            is_set_up: true,
            mode: ModeIs::Own,
            homing: Homing::Open,
            reference: Some(Reference::Silent),
            fault: FaultIs::default(),
            obstacle: None,
            refused: None,
            position: 0.0,
            demand: 0.0,
            demand_velocity: 0.0,
        }
    }
}

/// The newest serial of each part that a drive has accepted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Accepted {
    /// Of its power.
    pub power: u64,
    /// Of its motion.
    pub motion: u64,
    /// The number of the newest row.
    pub row: u64,
}

/// Whether a drive follows what is written to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Follows {
    /// It does.
    #[default]
    Yes,
    /// It will: a setting is being written.
    NotYet,
    /// It does not, for this reason.
    Never(&'static str),
}

/// The mode of operation that a drive is in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ModeIs {
    /// That of its setpoint, or it has only one.
    #[default]
    Own,
    /// Homing.
    Homing,
    /// Another one, or on the way between two.
    Other,
}

/// How far a homing is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Homing {
    /// None runs, or it is not over.
    #[default]
    Open,
    /// It has found home.
    Attained,
    /// It has failed.
    Failed,
}

/// Whether a drive has its reference, as it reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reference {
    /// It has.
    Set,
    /// It has not.
    Lost,
    /// It does not report it.
    Silent,
}

/// The knowledge of a fault, besides its code.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FaultIs {
    /// There is one.
    pub active: bool,
    /// The code is known, as far as it will ever be.
    pub named: bool,
    /// When it can be acknowledged.
    pub resettable: Resettable,
}

/// When a fault can be acknowledged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Resettable {
    /// Now.
    #[default]
    Now,
    /// From this instant on; `Time(u64::MAX)`: its reaction is not over.
    At(Time),
    /// Never, for this reason; `None`: its code says it.
    Never(Cannot),
}

/// The capabilities of a drive, and the kinds of evidence: fixed by its plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Capabilities {
    /// The source of its setpoints.
    pub generator: Generator,
    /// The capabilities that it lacks.
    pub lacks: Lacks,
    /// Power comes on, and it goes into operation, with one command.
    pub switches_on_at_once: bool,
    /// It goes from its quick stop back into operation.
    pub leaves_quick_stop: bool,
    /// The number of reports in a row that say the same and prove a state of its power, and that it has lost its power,
    /// its reference or its hardware enable. One where a report is certainly newer than the one before: it has a
    /// number, a working counter or the wire to itself. Two where one that comes again may look like the newest ...
    pub power_reports: u8,
    /// ... and so many its standstill.
    pub still_reports: u8,
    /// A drive that is released after a halt has to stand for so long, ns.
    pub stands_ns: u64,
    /// The end of a move may be so far from its target, user units.
    pub arrival: f64,
    /// The actual position of a report has followed the demand until so long before the demand of the same report, ns.
    pub behind_ns: u64,
    /// The ranges of the wire.
    pub ranges: Ranges,
}

/// The source of the setpoints of a drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Generator {
    /// The drive, along profiles.
    Drive {
        /// How it comes to a velocity; `None`: it has none.
        velocities: Option<Velocities>,
    },
    /// The master: this quantity goes out in each request.
    Master(Quantity),
}

/// How a drive that makes its own setpoints comes to a velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Velocities {
    /// By moves to a target that rolls at most so far ahead, user units: the drive stands at the target if nothing
    /// comes any more.
    Leash(f64),
    /// By a motion of its own, [`Motion::Velocity`]. From the report of a place to the begin of a ramp that it causes
    /// there may be so much time, ns.
    Own {
        /// ns.
        reaction_ns: u64,
    },
}

/// The quantity of a setpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// A position.
    Position,
    /// A velocity.
    Velocity,
    /// A torque.
    Torque,
    /// Not known: it stays 0.
    Unknown,
}

/// The largest values that the wire carries, user units; the smallest step, where a smaller value would be nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ranges {
    /// How far a position may be from 0, or on a rotary axis from the demand.
    pub position: (f64, f64),
    /// Velocities of moves, user units/s.
    pub velocity: (f64, f64),
    /// Accelerations of moves, user units/s².
    pub acceleration: (f64, f64),
}

impl Ranges {
    /// Those of a drive whose setpoints wrap around or saturate.
    pub const UNLIMITED: Ranges = Ranges {
        position: (f64::NEG_INFINITY, f64::INFINITY),
        velocity: (0.0, f64::INFINITY),
        acceleration: (0.0, f64::INFINITY),
    };
}

impl Capabilities {
    /// A drive that can do all, in all ranges, and that says the truth in each report: none is older than the last.
    pub fn of(generator: Generator) -> Capabilities {
        Capabilities {
            generator,
            lacks: Lacks::default(),
            switches_on_at_once: true,
            leaves_quick_stop: true,
            power_reports: 1,
            still_reports: 1,
            stands_ns: 0,
            arrival: f64::INFINITY,
            behind_ns: 0,
            ranges: Ranges::UNLIMITED,
        }
    }
}

/// An intent that counts as accepted by its delivery: an exchange after the one that carried it was answered, while
/// outputs count.
#[derive(Clone, Copy, Debug, Default)]
pub struct Delivery {
    /// The serial.
    pub serial: u64,
    /// The number of exchanges that had been answered when the first one with it was sent.
    pub since: u64,
}

impl Delivery {
    /// The answer to the exchange that carried it, and to one after that.
    const ANSWERS: u64 = 2;

    /// An exchange with this serial was sent, behind so many answered ones.
    #[inline]
    pub fn sent(&mut self, serial: u64, answers: u64) {
        if serial != self.serial {
            *self = Delivery { serial, since: answers };
        }
    }

    /// It is delivered, with so many answered exchanges.
    #[inline]
    pub fn is_delivered(self, answers: u64) -> bool {
        answers - self.since >= Self::ANSWERS
    }

    /// The serial that is accepted, with so many answered exchanges: its own, or the one `so_far`.
    #[inline]
    pub fn accepted(self, answers: u64, so_far: u64) -> u64 {
        if self.is_delivered(answers) { self.serial } else { so_far }
    }
}
