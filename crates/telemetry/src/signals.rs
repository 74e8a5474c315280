//! What is measured, in one list: its name for people, its names in files and metrics, its unit with the scale, and
//! where a record has the value. Texts, plots, pages and metrics take all of that from here.

use std::num::NonZeroU32;

use super::histograms::{DriveHistograms, Quantity};
use fieldbeat_core::axis::Link;
use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, ReferenceRecord, Stage};
use fieldbeat_core::drive::numbers::{Peak, Peaks};
use fieldbeat_core::time::US;

/// The unit in which times are shown.
pub const TIME: &str = "us";

/// The ns of that unit.
pub const TIME_NS: f64 = US as f64;

/// A time in that unit.
pub fn shown(ns: impl Into<f64>) -> f64 {
    ns.into() / TIME_NS
}

fn measured(ns: Option<NonZeroU32>) -> f64 {
    ns.map_or(f64::NAN, |ns| shown(ns.get()))
}

/// A signal with a value in each record `R`.
#[derive(Clone, Copy, Debug)]
pub struct Signal<R> {
    /// As people read it. Fields of a recording have it with underscores, but for times.
    pub name: &'static str,
    /// The unit, `{}` for that of the axis; empty for a number.
    unit: &'static str,
    /// The value in that unit, not a number where it was not reported; of a rotary axis with the length of a turn.
    pub value: fn(&R, Option<f64>) -> f64,
}

impl<R> Signal<R> {
    const fn new(name: &'static str, unit: &'static str, value: fn(&R, Option<f64>) -> f64) -> Signal<R> {
        Signal { name, unit, value }
    }

    /// The unit, of an axis with this one; empty for a number.
    pub fn unit(&self, of_axis: &str) -> String {
        self.unit.replace("{}", of_axis)
    }

    /// The name with the unit.
    pub fn title(&self, of_axis: &str) -> String {
        format!("{} ({})", self.name, self.unit(of_axis))
    }
}

/// When the last stage ended, after the grid point.
pub const END: Signal<CycleRecord> =
    Signal::new("end", TIME, |of, _| of.stages_ns.iter().fold(shown(of.wake_ns), |end, ns| end + shown(*ns)));

/// Signals of the loop.
pub const OF_CYCLE: [Signal<CycleRecord>; 10] = [
    Signal::new(WAKE.name, TIME, |of, _| shown(of.wake_ns)),
    Signal::new(JITTER.name, TIME, |of, _| shown(of.jitter_ns)),
    Signal::new(Stage::Send.name(), TIME, |of, _| shown(of.stages_ns[0])),
    Signal::new(Stage::Receive.name(), TIME, |of, _| shown(of.stages_ns[1])),
    Signal::new(Stage::Evaluate.name(), TIME, |of, _| shown(of.stages_ns[2])),
    Signal::new(Stage::Commands.name(), TIME, |of, _| shown(of.stages_ns[3])),
    Signal::new(Stage::Prepare.name(), TIME, |of, _| shown(of.stages_ns[4])),
    Signal::new(Stage::Publish.name(), TIME, |of, _| shown(of.stages_ns[5])),
    END,
    Signal::new("missed", "", |of, _| of.missed.into()),
];

/// The signal of the clock that leads the grid.
pub const OF_REFERENCE: Signal<ReferenceRecord> =
    Signal::new(PHASE_ERROR.name, TIME, |of, _| of.error_ns.map_or(f64::NAN, shown));

/// The demand position.
pub const DEMAND: Signal<DriveRecord> = Signal::new("demand", "{}", |of, _| of.reported(of.demand));

/// The actual position.
pub const POSITION: Signal<DriveRecord> = Signal::new("position", "{}", |of, _| of.reported(of.position));

/// From the position to the demand.
pub const FOLLOWING_ERROR: Signal<DriveRecord> =
    Signal::new("following error", "{}", DriveRecord::following_error);

/// The actual velocity.
pub const VELOCITY: Signal<DriveRecord> =
    Signal::new("velocity", "{}/s", |of, _| of.reported(of.velocity.into()));

/// The current of the motor.
pub const CURRENT: Signal<DriveRecord> = Signal::new("current", "A", |of, _| of.reported(of.current.into()));

/// The state of the drive, by its number.
pub const STATE: Signal<DriveRecord> = Signal::new("state", "", |of, _| (of.state as u8).into());

/// The command that the axis runs, by its number.
pub const COMMAND: Signal<DriveRecord> = Signal::new("command", "", |of, _| of.command.into());

/// Signals of an axis without its monitored variables.
pub const OF_AXIS: [Signal<DriveRecord>; 11] = [
    DEMAND,
    POSITION,
    FOLLOWING_ERROR,
    VELOCITY,
    CURRENT,
    STATE,
    COMMAND,
    Signal::new(ROUND_TRIP.name, TIME, |of, _| measured(of.rtt_ns)),
    Signal::new(AGE.name, TIME, |of, _| measured(of.age_ns)),
    Signal::new("sent", TIME, |of, _| measured(of.phase_ns)),
    Signal::new("online", "", |of, _| u8::from(of.link == Link::Online).into()),
];

/// A time whose values are kept as a histogram, with the exact maximum.
#[derive(Clone, Copy, Debug)]
pub struct Kept {
    /// As people read it.
    pub name: &'static str,
    /// Of its file; with underscores and `_ns` also of fields and keys.
    pub file: &'static str,
    /// Of the metric with the histogram; that with the maximum has `_max` behind it.
    pub metric: &'static str,
    /// The description of the one.
    pub about: &'static str,
    /// The description of the other.
    pub largest: &'static str,
}

/// Begin of a cycle after its grid point.
pub const WAKE: Kept = Kept {
    name: "wake-up latency",
    file: "wake",
    metric: "wake_up",
    about: "Wake-up latency: start of the cycles after their grid points; skipped slots count as late.",
    largest: "Largest wake-up latency: start of a cycle after its grid point.",
};

/// Difference between the distance of two begins and that of their grid points.
pub const JITTER: Kept = Kept {
    name: "cycle jitter",
    file: "jitter",
    metric: "cycle_jitter",
    about: "Differences between the distance of two starts and that of their grid points.",
    largest: "Largest jitter of the cycle.",
};

/// How far a slot is from where the clock that leads the grid wants it.
pub const PHASE_ERROR: Kept = Kept {
    name: "phase error",
    file: "reference",
    metric: "reference_error",
    about: "Phase errors of the grid, late or early, since its first lock.",
    largest: "Largest phase error of the grid since its first lock.",
};

/// How long a stage takes; its own name comes behind.
pub const STAGE: Kept = Kept {
    name: "stage",
    file: "stage",
    metric: "stage",
    about: "Time of each stage of a cycle.",
    largest: "The longest time of each stage.",
};

/// From a request to its reply.
pub const ROUND_TRIP: Kept = Kept {
    name: "round trip",
    file: "rtt",
    metric: "drive_round_trip",
    about: "Round trips.",
    largest: "The longest round trip.",
};

/// Difference between the distance of two requests and that of their grid points.
pub const SEND_JITTER: Kept = Kept {
    name: "send jitter",
    file: "send-jitter",
    metric: "drive_send_jitter",
    about: "Differences between the distance of two requests and that of their grid points.",
    largest: "The largest jitter of the requests.",
};

/// Age of the values of a drive when its window closes.
pub const AGE: Kept = Kept {
    name: "age",
    file: "age",
    metric: "drive_value_age",
    about: "Age of the feedback at the receive deadline.",
    largest: "Largest age of the feedback at the receive deadline.",
};

type OfDrive = (Kept, fn(&DriveHistograms) -> &Quantity, fn(&Peaks) -> Peak);

/// The kept quantities of each drive, and where their histogram and their maximum are.
pub const KEPT_OF_DRIVE: [OfDrive; 3] = [
    (ROUND_TRIP, |of| &of.rtt, |of| of.rtt),
    (SEND_JITTER, |of| &of.send_jitter, |of| of.send_jitter),
    (AGE, |of| &of.age, |of| of.age),
];

/// The kept quantities of the loop, in the order of texts: with the name of the stage, and what `T` has of each.
pub fn kept_of_loop<T>(
    [wake, jitter]: [T; 2],
    phase_error: Option<T>,
    stages: impl IntoIterator<Item = T>,
) -> impl Iterator<Item = (Kept, &'static str, T)> {
    let stages = Stage::ALL.map(Stage::name).into_iter().zip(stages);
    [(WAKE, "", wake), (JITTER, "", jitter)]
        .into_iter()
        .chain(phase_error.map(|error| (PHASE_ERROR, "", error)))
        .chain(stages.map(|(stage, of)| (STAGE, stage, of)))
}

impl Kept {
    /// As people read it, with the stage; empty: it has none.
    pub fn title(&self, stage: &str) -> String {
        format!("{} {stage}", self.name).trim_end().to_owned()
    }

    /// The name of its file, of this stage or drive; empty: there is only one.
    pub fn file(&self, of: &str) -> String {
        let between = if of.is_empty() { "" } else { "-" };
        format!("{}{between}{of}.hgrm", self.file)
    }
}
