//! `[soak]`: how a soak test moves the axes, and what it has to keep to.

use fieldbeat_core::axis::limits::{check_command, check_row};
use fieldbeat_core::axis::{AxisPlan, Command, Failure, Jog, Lacks, Move, Profile, Row, Target, Unit};
use fieldbeat_core::bus::facts::of_drives;
use fieldbeat_core::cycle::{CyclePlan, Plan};
use fieldbeat_core::time::{MS, Ns, S, nanos};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::{POSITIVE, Table, list, number, set};

keys! {
    AXIS "axis" = "none": "how an axis moves: one `[[soak.axis]]` each";
    DRIVE "drive" = "-": "name of the drive";
    MOVE "move" = "true": "`false`: the axis stays where it is, and is not enabled";
    TARGETS "targets" = "(40 % and 60 % of `limits.position`)": "positions, one after the other, again and "
        "again";
    VELOCITIES "velocities" = "(10 % of `limits.velocity` both ways, of an axis without moves)":
        "velocities, one after the other, again and again; `jog_deadman` has to be 300 ms or more, or off";
    VELOCITY "velocity" = "(`profile.velocity`)": "velocity of these moves";
    ACCELERATION "acceleration" = "(`profile.acceleration`)": "acceleration and deceleration of these moves";
    PAUSE "pause" = "500ms": "time between two of these moves";
    HOLD "hold" = "2s": "each of the velocities is held for so long";
    FOLLOWING_ERROR "following_error" = "none": "largest following error that is good, in user units";
    CENTRE "centre" = "-": "middle of a sine that is streamed row by row: `sine = { centre = 50.0, "
        "amplitude = 10.0, period = \"2s\" }`";
    AMPLITUDE "amplitude" = "-": "largest distance from `centre`: `sine = { centre = 50.0, amplitude = "
        "10.0, period = \"2s\" }`";
    PERIOD "period" = "-": "time of one swing: `sine = { centre = 50.0, amplitude = 10.0, period = \"2s\" "
        "}`. The sine grows within its first two; its largest velocity is 2 pi `amplitude` / `period` "
        "meanwhile, too, and its largest acceleration 1.5 % above that of the whole sine";
    LATE_SHARE "late_share" = "0.001": "largest share that is good of skipped slots, and late cycles that "
        "skipped none, in all slots; `0.001` is one in a thousand";
    MISSED_SHARE "missed_share" = "0.001": "largest share that is good of missed exchanges of each drive "
        "in those that were sent";
    LOST_LINKS "lost_links" = "0": "most lost links of all drives that are good";
    FAULTS "faults" = "0": "most faults of all drives that are good";
    STOPS "stops" = "0": "most stops of all axes that are good, but for the end";
    MEMORY_GROWTH "memory_growth" = "8": "largest growth that is good of the memory of a process after its "
        "warm-up, MB";
    DESCRIPTOR_GROWTH "descriptor_growth" = "0": "largest growth that is good of the number of descriptors "
        "of a process";
    DRIFT "drift" = "0.5": "largest growth that is good of a p99 from the first quarter of the test to the "
        "last, as a share of the first";
    TELEMETRY_LOST "telemetry_lost" = "0": "most telemetry records that may be lost";
    FILES_LOST "files_lost" = "0": "most checkpoints that may not be written";
    WARM_UP "warm_up" = "10min": "memory and descriptors of a process are judged from then on";
}

/// A soak test as configured and checked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SoakPlan {
    /// The axes, in the order of the plan.
    pub axes: Vec<AxisSoak>,
    /// What it has to keep to.
    pub criteria: Criteria,
    /// The cycle, and what of it is tolerated.
    pub cycle: CyclePlan,
}

/// What becomes of one axis.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisSoak {
    /// Its name.
    pub name: String,
    /// How it moves.
    pub pattern: Pattern,
    /// The largest following error, in its units; `None`: it is shown and not judged.
    pub following_error: Option<f64>,
}

/// A sine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Swing {
    /// Its middle, user units.
    pub centre: f64,
    /// To each side of it.
    pub amplitude: f64,
    /// Time of one swing, s.
    pub period_s: f64,
}

impl Swing {
    /// Its amplitude rises within so many periods. No velocity is above that of the whole sine meanwhile, and no
    /// acceleration above so many times that of it.
    pub const FADE: f64 = 2.0;
    const ACCELERATION: f64 = 1.015;
}

/// How an axis moves.
#[derive(Clone, Debug, PartialEq)]
pub enum Pattern {
    /// Not at all, for this reason: it is not even enabled.
    Still(String),
    /// From target to target.
    Moves {
        /// Positions, one after the other, again and again.
        targets: Vec<f64>,
        /// Of each move.
        profile: Profile,
        /// Between two moves, ns.
        pause_ns: u64,
    },
    /// At one velocity after the other.
    Velocities {
        /// User units/s.
        velocities: Vec<f64>,
        /// Each for so long, ns.
        hold_ns: u64,
    },
    /// Along a sine, streamed row by row.
    Sine(Swing),
}

impl Pattern {
    /// In words, of an axis with this unit.
    pub fn describe(&self, unit: Unit) -> String {
        let list = |values: &[f64]| {
            let shown = values.iter().take(4).map(f64::to_string).collect::<Vec<_>>().join(", ");
            if values.len() > 4 { format!("{shown} ... ({} of them)", values.len()) } else { shown }
        };
        match self {
            Pattern::Still(why) => format!("stays where it is: {why}"),
            Pattern::Moves { targets, profile, pause_ns } => format!(
                "moves to {} {unit} at {} {unit}/s, with pauses of {}",
                list(targets),
                profile.velocity,
                Ns(*pause_ns)
            ),
            Pattern::Velocities { velocities, hold_ns } => {
                format!("turns at {} {unit}/s, each for {}", list(velocities), Ns(*hold_ns))
            }
            Pattern::Sine(Swing { centre, amplitude, period_s }) => {
                format!("swings {amplitude} {unit} around {centre} {unit} in {period_s} s")
            }
        }
    }
}

/// What a soak test has to keep to. Shares are of 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Criteria {
    /// Skipped slots, and late cycles that skipped none, of all slots.
    pub late_share: f64,
    /// Missed exchanges of each drive, of those that were sent.
    pub missed_share: f64,
    /// Lost links of all drives.
    pub lost_links: u64,
    /// Faults of all drives.
    pub faults: u64,
    /// Stops of all axes, but for the end.
    pub stops: u64,
    /// Growth of the memory of a process after its warm-up, MB.
    pub memory_growth: f64,
    /// Growth of the number of its descriptors.
    pub descriptor_growth: f64,
    /// How much larger a p99 is in the last quarter than in the first, of the first.
    pub drift: f64,
    /// Telemetry records lost.
    pub telemetry_lost: u64,
    /// Checkpoints that could not be written.
    pub files_lost: u64,
    /// A process has grown to its size by then, ns.
    pub warm_up_ns: u64,
}

impl Default for Criteria {
    fn default() -> Criteria {
        Criteria {
            late_share: 0.001,
            missed_share: 0.001,
            lost_links: 0,
            faults: 0,
            stops: 0,
            memory_growth: 8.0,
            descriptor_growth: 0.0,
            drift: 0.5,
            telemetry_lost: 0,
            files_lost: 0,
            warm_up_ns: 600 * S,
        }
    }
}

/// Defaults keep to this share of a range around its middle, and of a largest velocity.
const SHARE: f64 = 0.1;

/// A velocity is held for so long by default, and axes pause for so long.
const HOLD_NS: u64 = 2 * S;
const PAUSE_NS: u64 = 500 * MS;

/// A velocity is renewed this often: a jog has its dead-man time.
pub const RENEW_EVERY_NS: u64 = 100 * MS;

/// A jog with a shorter dead-man time could end between two renewals.
const LEAST_DEAD_MAN_NS: u64 = 3 * RENEW_EVERY_NS;

/// Reads `[soak]` of a machine that is `plan`.
pub(super) fn soak(table: &mut Table<'_>, plan: &Plan) -> SoakPlan {
    let known = known(plan);
    let mut axes: Vec<AxisSoak> = known
        .iter()
        .map(|(axis, lacks)| AxisSoak {
            name: axis.name.clone(),
            pattern: usual(axis, lacks),
            following_error: None,
        })
        .collect();
    let mut named: Vec<usize> = Vec::new();
    for mut table in table.tables(AXIS) {
        let name = table.text(DRIVE, None, "the name of a drive", |name| Some(name.to_owned()));
        let given = Given::read(&mut table);
        let place = name.as_ref().and_then(|name| axes.iter().position(|axis| axis.name == *name));
        match (name, place.and_then(|place| Some((place, known.get(place)?)))) {
            (Some(_), Some((place, (axis, lacks)))) => {
                if named.contains(&place) {
                    table.fault("drive", "has its pattern already: each axis has one [[soak.axis]]");
                }
                named.push(place);
                given.apply(&table, &mut axes[place], axis, lacks);
            }
            (Some(_), None) => {
                let names: Vec<&str> = axes.iter().map(|axis| axis.name.as_str()).collect();
                table.fault("drive", format!("is no drive of this machine; there are: {}", names.join(", ")));
            }
            (None, _) => {}
        }
        table.finish();
    }
    let criteria = table.table("criteria", criteria);
    SoakPlan { axes, criteria, cycle: plan.cycle.clone() }
}

/// The axes, and what their drives do not do.
fn known(plan: &Plan) -> Vec<(&AxisPlan, Lacks)> {
    let facts = plan.facts();
    let lacks = of_drives(&facts).map(|(_, drive)| drive.capabilities.lacks);
    plan.axes().into_iter().zip(lacks).collect()
}

/// How an axis moves of which nothing is said: well inside its limits, or not at all.
fn usual(axis: &AxisPlan, lacks: &Lacks) -> Pattern {
    if let Some(why) = lacks.control.or(lacks.enable) {
        return Pattern::Still(why.to_owned());
    }
    match (lacks.moves, axis.limits.position, axis.limits.velocity) {
        (None, Some((low, high)), _) => {
            let (middle, reach) = ((low + high) / 2.0, (high - low) * SHARE);
            Pattern::Moves {
                targets: vec![middle - reach, middle + reach],
                profile: axis.profile,
                pause_ns: PAUSE_NS,
            }
        }
        (None, None, _) => Pattern::Still("it has no limits.position; give it targets".into()),
        (Some(_), _, Some(most)) if lacks.velocities.is_none() => match ends_between_renewals(axis) {
            Some(why) => Pattern::Still(why),
            None => Pattern::Velocities { velocities: vec![most * SHARE, -most * SHARE], hold_ns: HOLD_NS },
        },
        (Some(_), _, _) => Pattern::Still("it has no limits.velocity; give it velocities".into()),
    }
}

/// Why the axis cannot turn at velocities for long, if its dead-man time is too short for that.
fn ends_between_renewals(axis: &AxisPlan) -> Option<String> {
    let dead_man_ns = axis.jog_deadman.map(nanos).filter(|ns| *ns < LEAST_DEAD_MAN_NS)?;
    Some(format!(
        "its jog_deadman of {} is too short, since a velocity is renewed each {}: make it {} or more",
        Ns(dead_man_ns),
        Ns(RENEW_EVERY_NS),
        Ns(LEAST_DEAD_MAN_NS)
    ))
}

/// What `[[soak.axis]]` says of one axis.
struct Given {
    moves: bool,
    targets: Option<Vec<f64>>,
    velocities: Option<Vec<f64>>,
    sine: Option<Swing>,
    velocity: Option<f64>,
    acceleration: Option<f64>,
    pause_ns: u64,
    hold_ns: u64,
    following_error: Option<f64>,
}

impl Given {
    fn read(table: &mut Table<'_>) -> Given {
        Given {
            moves: table.flag(MOVE).unwrap_or(true),
            targets: numbers(table, TARGETS, "positions, like [10.0, 90.0]"),
            velocities: numbers(table, VELOCITIES, "velocities, like [1.0, 0.0, -1.0]"),
            sine: table.optional("sine", sine),
            velocity: table.number(VELOCITY, POSITIVE),
            acceleration: table.number(ACCELERATION, POSITIVE),
            pause_ns: table.time(PAUSE, ..=3600 * S).unwrap_or(PAUSE_NS),
            hold_ns: table.time(HOLD, 10 * MS..=3600 * S).unwrap_or(HOLD_NS),
            following_error: table.number(FOLLOWING_ERROR, POSITIVE),
        }
    }

    /// Makes `soak` of it, if the axis and its drive can do that.
    fn apply(self, table: &Table<'_>, soak: &mut AxisSoak, axis: &AxisPlan, lacks: &Lacks) {
        soak.following_error = self.following_error;
        let patterns = [self.targets.is_some(), self.velocities.is_some(), self.sine.is_some()];
        if patterns.iter().filter(|given| **given).count() > 1 {
            return table.fault("drive", "has several patterns: give one of targets, velocities and sine");
        }
        if !self.moves {
            soak.pattern = Pattern::Still("move = false".into());
            return;
        }
        let mut profile = axis.profile;
        set(&mut profile.velocity, self.velocity);
        set(&mut profile.acceleration, self.acceleration);
        set(&mut profile.deceleration, self.acceleration);
        let pattern = match (self.targets, self.velocities, self.sine, soak.pattern.clone()) {
            (Some(targets), ..) => Pattern::Moves { targets, profile, pause_ns: self.pause_ns },
            (_, Some(velocities), ..) => Pattern::Velocities { velocities, hold_ns: self.hold_ns },
            (.., Some(sine), _) => Pattern::Sine(sine),
            (.., Pattern::Moves { targets, .. }) => {
                Pattern::Moves { targets, profile, pause_ns: self.pause_ns }
            }
            (.., Pattern::Velocities { velocities, .. }) => {
                Pattern::Velocities { velocities, hold_ns: self.hold_ns }
            }
            (.., still) => still,
        };
        if let (Pattern::Velocities { .. }, Some(why)) = (&pattern, ends_between_renewals(axis)) {
            return table.fault("velocities", why);
        }
        match pattern.refused(axis, lacks) {
            None => soak.pattern = pattern,
            Some((key, why)) => {
                // Where the pattern is not given, it can only be the profile of its moves.
                let key = [key, "velocity", "acceleration"].into_iter().find(|key| table.gives(key));
                table.fault(key.unwrap_or("drive"), why.to_string());
            }
        }
    }
}

impl Pattern {
    /// Why the axis cannot move so, with the key that says it.
    fn refused(&self, axis: &AxisPlan, lacks: &Lacks) -> Option<(&'static str, Failure)> {
        let check = |command: Command| check_command(axis, lacks, &command).err();
        match self {
            Pattern::Still(_) => None,
            Pattern::Moves { targets, profile, .. } => targets.iter().find_map(|target| {
                let target = Target::Absolute(*target);
                Some(("targets", check(Command::Move(Move { target, profile: *profile }))?))
            }),
            Pattern::Velocities { velocities, .. } => velocities.iter().find_map(|velocity| {
                let jog = Jog { velocity: *velocity, acceleration: axis.profile.acceleration };
                Some(("velocities", check(Command::Jog(jog))?))
            }),
            Pattern::Sine(swing) => {
                let row = |row: &Row| check_row(axis, row, None).err();
                let failure = check(Command::Follow).or_else(|| extremes(swing).iter().find_map(row))?;
                Some(("sine", failure))
            }
        }
    }
}

/// Where the values of a sine are largest.
fn extremes(swing: &Swing) -> [Row; 4] {
    let Swing { centre, amplitude, period_s } = *swing;
    let w = std::f64::consts::TAU / period_s;
    let row = |position, velocity, acceleration| Row { position, velocity, acceleration, last: false };
    [
        row(centre + amplitude, 0.0, 0.0),
        row(centre - amplitude, 0.0, 0.0),
        row(centre, amplitude * w, 0.0),
        row(centre, 0.0, amplitude * w * w * Swing::ACCELERATION),
    ]
}

fn sine(table: &mut Table<'_>) -> Option<Swing> {
    let centre = table.number(CENTRE, ..);
    let amplitude = table.number(AMPLITUDE, POSITIVE);
    let period_ns = table.time(PERIOD, 100 * MS..=3600 * S);
    Some(Swing { centre: centre?, amplitude: amplitude?, period_s: period_ns? as f64 / S as f64 })
}

/// A list of at least one number.
fn numbers(table: &mut Table<'_>, key: Key, what: &str) -> Option<Vec<f64>> {
    table.read(key, Form::number(..).list(1, 1000), |value| {
        list(value, 1..=1000, number).ok_or_else(|| format!("must be a list of 1 to 1000 {what}"))
    })
}

/// No count of a test comes so far.
const MOST_COUNT: i128 = 1_000_000_000_000;

fn criteria(table: &mut Table<'_>) -> Criteria {
    let mut all = Criteria::default();
    set(&mut all.late_share, table.number(LATE_SHARE, 0.0..=1.0));
    set(&mut all.missed_share, table.number(MISSED_SHARE, 0.0..=1.0));
    set(&mut all.lost_links, table.integer(LOST_LINKS, 0..=MOST_COUNT));
    set(&mut all.faults, table.integer(FAULTS, 0..=MOST_COUNT));
    set(&mut all.stops, table.integer(STOPS, 0..=MOST_COUNT));
    set(&mut all.memory_growth, table.number(MEMORY_GROWTH, 0.0..));
    set(&mut all.descriptor_growth, table.number(DESCRIPTOR_GROWTH, 0.0..));
    set(&mut all.drift, table.number(DRIFT, 0.0..));
    set(&mut all.telemetry_lost, table.integer(TELEMETRY_LOST, 0..=MOST_COUNT));
    set(&mut all.files_lost, table.integer(FILES_LOST, 0..=MOST_COUNT));
    set(&mut all.warm_up_ns, table.time(WARM_UP, ..));
    all
}
