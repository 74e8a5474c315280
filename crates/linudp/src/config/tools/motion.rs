//! `fieldbeat linmot command`: one motion command, by a master of its own: switch on, run it, ramp down, switch off.

use std::time::Duration;

use clap::Args;

use crate::motion::{CATALOGUE, CommandInfo, Field, Kind, Mark, MotionCommand};
use crate::native::{Native, NativeInputs, NativeOutput};
use crate::wire::StateVar;
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::axis::limits::{check_acceleration, check_position, check_velocity};
use fieldbeat_core::axis::{Axis, AxisPlan, Command, EventKind, Failure};
use fieldbeat_core::time::{Time, nanos};
use fieldbeat_tools::{Drive, Pause, Program, Stop};

/// Arguments of `linmot command`.
#[derive(Debug, Args)]
pub struct MotionArguments {
    #[command(flatten)]
    drive: Drive,
    /// Without a guardian, the process that stops the drive if this one is killed or hangs.
    #[arg(long)]
    no_guardian: bool,
    /// Its name, as `linmot commands` lists it, or its number as 0x010.
    command: String,
    /// Its fields in their units, as position=12.5; for a number its words, as words=0x1,0x2.
    #[arg(value_name = "FIELD=VALUE")]
    fields: Vec<String>,
    /// Acknowledge a fault of the drive first.
    #[arg(long)]
    reset: bool,
    /// Home the drive first, unless it is homed.
    #[arg(long)]
    home: bool,
}

/// Arguments of `linmot commands`.
#[derive(Debug, Args)]
pub struct Commands {
    /// List only the commands with this in their names.
    part: Option<String>,
}

/// Standing for so long, the motion has ended: a command of the command table may pause ...
const STANDS_FOR: Duration = Duration::from_millis(150);
/// ... and in so many of the drive's replies, however rare they are.
const STANDS_FOR_REPLIES: u32 = 3;

impl Commands {
    /// Lists all motion commands, with their fields.
    pub fn run(self, program: &dyn Program) -> Result<(), Stop> {
        let part = self.part.unwrap_or_default();
        for info in CATALOGUE.iter().filter(|info| info.name.contains(&part)) {
            let field = |field: &Field| match field.kind.unit() {
                "" => format!(" {}", field.name),
                unit => format!(" {} [{unit}]", field.name),
            };
            let fields: String = info.fields.iter().map(field).collect();
            let marks: Vec<&str> = info.marks.iter().map(|mark| words(*mark)).collect();
            let marks = if marks.is_empty() { String::new() } else { format!("  ({})", marks.join(", ")) };
            program.print(&format_args!("{:03X}  {}{fields}{marks}", info.id, info.name))?;
        }
        Ok(())
    }
}

fn words(mark: Mark) -> &'static str {
    match mark {
        Mark::TableOnly => "in the command table only",
        Mark::SoftwareKey => "needs a software key",
        Mark::Newer => "newer firmware",
        Mark::Assumed => "not certain",
    }
}

impl MotionArguments {
    /// Does it.
    pub fn run(self, program: &dyn Program) -> Result<(), Stop> {
        let command = parse(&self.command, &self.fields).map_err(Stop::usage)?;
        let name = &self.drive.drive;
        let foreign = || Stop::usage(format!("drive {name} is not a LinMot drive"));
        let mut own = program.own(&self.drive, self.no_guardian, &|axis, notation| {
            if notation.protocol() != crate::PROTOCOL {
                return Err(foreign());
            }
            check(axis, &command, None).map_err(|why| Stop::usage(format!("drive {name}: {why}")))
        })?;
        let mut native = own.axis().native::<Native>().ok_or_else(foreign)?;
        own.run(&mut |axis, pause| self.execute(axis, &mut native, command, pause))
    }

    fn execute(
        &self,
        axis: &mut Axis,
        native: &mut Native,
        command: MotionCommand,
        pause: Pause<'_>,
    ) -> Result<(), Stop> {
        if self.reset && axis.feedback().status.fault != 0 {
            axis.reset_fault().map_err(Stop::failed)?;
        }
        let found = axis.feedback().status;
        if found.homed {
            check(axis.plan(), &command, Some(found.position))
                .map_err(|why| Stop::usage(format!("drive {}: {why}", axis.name())))?;
        }
        axis.enable().map_err(Stop::failed)?;
        if self.home && !axis.feedback().status.homed {
            axis.home().map_err(Stop::failed)?;
        }
        let mode = axis.post(Command::Native(NativeOwner::Master)).map_err(Stop::failed)?;
        let mut motion = Motion::Waiting;
        while motion != Motion::Ended {
            pause()?;
            let inputs = native.inputs();
            let output = NativeOutput { motion: Some(command), ..NativeOutput::default() };
            motion = match motion {
                // What is written before the mode runs is dropped.
                Motion::Waiting if inputs.running && native.write(output).is_ok() => {
                    Motion::Written(inputs.response.state.and_then(StateVar::count))
                }
                motion => motion.after(&inputs),
            };
            while let Some(event) = axis.event() {
                match event.kind {
                    EventKind::Ended { id, outcome, .. } if id == mode => {
                        let name = outcome.fault().and_then(|code| axis.fault(code).name);
                        return Err(Stop::failed(format!(
                            "drive {}: {}",
                            axis.name(),
                            outcome.described(name)
                        )));
                    }
                    EventKind::Stopped(cause) => {
                        let fault = axis.feedback().status.fault;
                        let why = match fault {
                            0 => cause.to_string(),
                            code => format!("{cause} {}", axis.fault(code)),
                        };
                        return Err(Stop::failed(format!("drive {} was stopped: {why}", axis.name())));
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }
}

/// How far the command is, by nothing but what the drive says.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Motion {
    /// Native mode does not run yet.
    Waiting,
    /// It was written, when the drive had this count.
    Written(Option<u8>),
    /// The drive has stored it.
    Taken(Standing),
    /// It has stood for long enough since.
    Ended,
}

/// How long the drive has been saying that it stands.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Standing {
    since: Time,
    /// The newest reply that says so.
    newest: Time,
    /// How many different ones were seen.
    replies: u32,
}

impl Motion {
    /// After the newest of the drive's replies. The count and whether it moves are sampled together (sheet, 3.4).
    fn after(self, inputs: &NativeInputs) -> Motion {
        let state = inputs.response.state.unwrap_or_default();
        match self {
            Motion::Written(before) if state.count().is_none() || state.count() == before => self,
            Motion::Waiting | Motion::Ended => self,
            Motion::Written(_) => Motion::Taken(Standing::default()).after(inputs),
            Motion::Taken(_) if state.motion_active() != Some(false) => Motion::Taken(Standing::default()),
            Motion::Taken(standing) if standing.newest == inputs.at => self,
            Motion::Taken(Standing { since, replies, .. }) => {
                let since = if replies == 0 { inputs.at } else { since };
                let replies = replies + 1;
                match replies >= STANDS_FOR_REPLIES && inputs.at.since(since) >= nanos(STANDS_FOR) {
                    true => Motion::Ended,
                    false => Motion::Taken(Standing { since, newest: inputs.at, replies }),
                }
            }
        }
    }
}

/// The command of a name and its fields, or of a number and its words.
fn parse(name: &str, fields: &[String]) -> Result<MotionCommand, String> {
    let pairs: Vec<(&str, &str)> = fields
        .iter()
        .map(|field| field.split_once('=').ok_or_else(|| format!("{field}: write FIELD=VALUE")))
        .collect::<Result<_, _>>()?;
    if let Some(digits) = name.strip_prefix("0x") {
        let id = u16::from_str_radix(digits, 16).ok().filter(|id| *id <= 0xFFF);
        let id = id.ok_or_else(|| format!("{name}: not the number of a command, 0x000 ... 0xFFF"))?;
        return raw(id, &pairs).and_then(allowed);
    }
    let Some(info) = CommandInfo::named(name) else {
        return Err(format!("{name}: not a motion command; `fieldbeat linmot commands` lists them"));
    };
    if info.is(Mark::TableOnly) {
        return Err(format!("{name} works in the command table only; put it into an entry"));
    }
    let mut values = Vec::new();
    for field in info.fields {
        let given = pairs.iter().find(|(known, _)| *known == field.name).map(|(_, value)| *value);
        let unit = field.kind.unit();
        let unit = if unit.is_empty() { "a number".to_owned() } else { format!("in {unit}") };
        let text = given.ok_or_else(|| format!("{name}: {} is missing; {unit}", field.name))?;
        values.push(match text.strip_prefix("0x") {
            Some(digits) => i64::from_str_radix(digits, 16).map_err(|_| format!("{text}: no number"))?,
            None => {
                let number: f64 =
                    text.parse().map_err(|_| format!("{}={text}: no number; {unit}", field.name))?;
                field.kind.wire(number).map_err(|error| format!("{}: {error}", field.name))?
            }
        });
    }
    if let Some((unknown, _)) = pairs.iter().find(|(known, _)| info.fields.iter().all(|f| f.name != *known)) {
        let known: Vec<&str> = info.fields.iter().map(|field| field.name).collect();
        return Err(format!("{name}: there is no field {unknown}; it has {}", known.join(", ")));
    }
    info.command(&values).map_err(|(field, error)| format!("{}: {error}", field.name)).and_then(allowed)
}

/// Whether the axis may get where the command leads, as far as that is known: the loop would stop it on its way.
/// `from`: where it stands, if that counts. What the drive alone knows (its scaled values, curves, tables, variables, a
/// trigger) is left to the loop.
fn check(axis: &AxisPlan, command: &MotionCommand, from: Option<f64>) -> Result<(), Failure> {
    let Some(info) = CommandInfo::of(command.id) else { return Ok(()) };
    let units = &axis.units;
    // Of those the position is no target.
    let is_target = !matches!(
        info.name,
        "master-homing" | "vai-change-on-positive-transition" | "vai-change-on-negative-transition"
    );
    for (field, wire) in info.fields.iter().zip(info.values(&command.parameters)) {
        // All of them are counted as a position is, but for a power of ten.
        let finer = Kind::Position.decimals() as i32 - field.kind.decimals() as i32;
        let counts = wire as f64 * 10_f64.powi(finer);
        match (field.kind, field.name) {
            (Kind::Position, "position" | "target" | "start_position") if is_target => {
                check_position(&axis.limits, counts / units.counts_per_unit + units.offset)?;
            }
            (Kind::Position, "distance") => check_distance(axis, units.distance(counts), from)?,
            (Kind::Velocity | Kind::SignedVelocity, _) => check_velocity(axis, units.distance(counts))?,
            (Kind::Acceleration | Kind::SignedAcceleration, _) if !command.is_stop() => {
                check_acceleration(axis, units.distance(counts))?;
            }
            _ => {}
        }
    }
    Ok(())
}

/// Whether a way so long fits into the range of the axis: from where it stands, or from any place.
fn check_distance(axis: &AxisPlan, distance: f64, from: Option<f64>) -> Result<(), Failure> {
    let Some((low, high)) = axis.limits.position else { return Ok(()) };
    // The way begins where the drive wants the axis, which is as near as that.
    let near = axis.in_position.window.unwrap_or(0.0);
    let (low, high) = match from {
        Some(from) => (low - from - near, high - from + near),
        None => (low - high, high - low),
    };
    match (low..=high).contains(&distance) {
        true => Ok(()),
        false => Err(Failure::Limit { what: "distance", value: distance, low, high }),
    }
}

/// Native mode refuses it as well; here the remedy has a name.
fn allowed(command: MotionCommand) -> Result<MotionCommand, String> {
    match command.id == MotionCommand::reset_firmware().id {
        true => Err("the drive would restart again and again; use `fieldbeat linmot restart`".to_owned()),
        false => Ok(command),
    }
}

fn raw(id: u16, pairs: &[(&str, &str)]) -> Result<MotionCommand, String> {
    let mut command = MotionCommand::new(id);
    let words = match pairs {
        [] => return Ok(command),
        [("words", words)] => *words,
        _ => return Err("a command by its number takes words=0x1,0x2 and nothing else".to_owned()),
    };
    let mut room = command.parameters.chunks_exact_mut(2);
    for word in words.split(',') {
        let value = match word.strip_prefix("0x") {
            Some(digits) => u16::from_str_radix(digits, 16).ok(),
            None => word.parse().ok(),
        };
        let value = value.ok_or_else(|| format!("{word}: not a word of 16 bits"))?;
        let place = room.next().ok_or("a command has 15 words at most")?;
        place.copy_from_slice(&value.to_le_bytes());
    }
    Ok(command)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{MainState, Response};
    use fieldbeat_core::axis::{Limits, Units};

    fn of(name: &str, fields: &[&str]) -> Result<MotionCommand, String> {
        parse(name, &fields.iter().map(|field| (*field).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn a_command_is_written_in_units_or_as_words() {
        let go = ["position=10", "velocity=1000", "acceleration=10000", "deceleration=10000"];
        let named = of("vai-go-to", &go).unwrap();
        let words = of("0x010", &["words=0x86A0,1,0x4240,0xF,0x4240,0xF,0x4240,0xF"]).unwrap();
        assert_eq!(named, words);
        assert_eq!(of("no-operation", &[]), Ok(MotionCommand::new(0)));
    }

    #[test]
    fn what_leads_out_of_the_limits_is_refused() {
        let mut axis = AxisPlan::new("x", Units { offset: 100.0, ..Units::millimetres(-10_000.0) });
        axis.limits = Limits {
            position: Some((-50.0, 400.0)),
            velocity: Some(1_000.0),
            acceleration: Some(20_000.0),
            ..Limits::default()
        };
        let profile = ["velocity=1000", "acceleration=20000", "deceleration=20000"];
        let go = |field| [&[field], &profile[..]].concat();
        let faster = ["position=0", "velocity=1001", "acceleration=1", "deceleration=1"];
        let sharper = ["position=0", "velocity=1", "acceleration=1", "deceleration=20001"];
        // The axis counts down from 100 where the drive counts up from 0.
        for (name, fields, from, what) in [
            ("vai-go-to", &go("position=-300")[..], None, None),
            ("vai-go-to", &go("position=-300.001"), None, Some("position")),
            ("vai-go-to", &go("position=150"), None, None),
            ("vai-go-to", &go("position=150.001"), None, Some("position")),
            ("vai-go-to", &faster, None, Some("velocity")),
            ("vai-go-to", &sharper, None, Some("acceleration")),
            ("vai-increment-demand", &go("distance=450"), None, None),
            ("vai-increment-demand", &go("distance=451"), None, Some("distance")),
            ("vai-increment-demand", &go("distance=-300"), Some(100.0), None),
            ("vai-increment-demand", &go("distance=-301"), Some(100.0), Some("distance")),
            ("curve-start-to-target", &["curve=1", "target=500"], None, Some("position")),
            ("stream-pv", &["position=0", "velocity=-2000"], None, Some("velocity")),
            ("0x010", &["words=0x0,0xF000"], None, Some("position")),
            // Not known here, or no target.
            ("0x3FF", &["words=0x0,0xF000"], None, None),
            (
                "vai-16bit-go-to",
                &["position=9999", "velocity=1", "acceleration=1", "deceleration=1"],
                None,
                None,
            ),
            ("master-homing", &["position=5000"], None, None),
            ("vai-change-on-positive-transition", &go("position=5000"), None, None),
            ("vai-stop", &["deceleration=90000"], None, None),
        ] {
            let refused = check(&axis, &of(name, fields).unwrap(), from).err();
            let refused = refused.map(|failure| match failure {
                Failure::Limit { what, .. } => what,
                other => panic!("{name} {fields:?}: {other}"),
            });
            assert_eq!(refused, what, "{name} {fields:?}");
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (name, fields, why) in [
            ("vai-go", &[][..], "not a motion command"),
            ("wait-time", &["time=1"], "in the command table only"),
            ("vai-stop", &[], "deceleration is missing; in mm/s²"),
            ("vai-stop", &["deceleration=1", "speed=2"], "there is no field speed; it has deceleration"),
            ("vai-stop", &["deceleration=fast"], "no number"),
            ("vai-stop", &["deceleration=1e12"], "deceleration"),
            ("vai-stop", &["deceleration"], "write FIELD=VALUE"),
            ("0x1234", &[], "0x000 ... 0xFFF"),
            ("reset-firmware", &[], "use `fieldbeat linmot restart`"),
            ("0x00F", &[], "use `fieldbeat linmot restart`"),
            ("0x010", &["words=70000"], "not a word of 16 bits"),
            ("0x010", &["words=0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0"], "15 words"),
        ] {
            let error = of(name, fields).unwrap_err();
            assert!(error.contains(why), "{name} {fields:?}: {error}");
        }
    }
    /// What the drive says `ms` after the start: its count, and whether it moves.
    fn says(ms: u64, count: u8, moving: bool) -> NativeInputs {
        let state = StateVar::new(MainState::OPERATION_ENABLED, count | u8::from(moving) << 5);
        let response = Response { state: Some(state), ..Response::default() };
        NativeInputs { at: Time(1_000_000 * ms), running: true, response }
    }

    #[test]
    fn a_motion_ends_by_what_the_drive_says_of_it_and_by_no_silence() {
        let mut motion = Motion::Written(Some(3));
        let mut after = |inputs| {
            motion = motion.after(&inputs);
            motion
        };
        // It stands because it has not received it.
        for ms in [200, 400, 600, 800] {
            assert_eq!(after(says(ms, 3, false)), Motion::Written(Some(3)));
        }
        assert_eq!(after(says(1_000, 4, true)), Motion::Taken(Standing::default()));
        // One reply is one, however often it is looked at.
        let stands = Standing { since: Time(1_200_000_000), newest: Time(1_200_000_000), replies: 1 };
        for _ in 0..10 {
            assert_eq!(after(says(1_200, 4, false)), Motion::Taken(stands));
        }
        // A pause is no end.
        assert_eq!(after(says(1_300, 4, true)), Motion::Taken(Standing::default()));
        for ms in [1_400, 1_420, 1_440, 1_549] {
            assert!(matches!(after(says(ms, 4, false)), Motion::Taken(_)), "{ms}");
        }
        assert_eq!(after(says(1_550, 4, false)), Motion::Ended);
    }

    #[test]
    fn a_command_that_moves_nothing_ends_when_the_drive_has_it() {
        let mut motion = Motion::Written(Some(15));
        for (ms, count, ended) in [(0, 15, false), (50, 0, false), (250, 0, false), (450, 0, true)] {
            motion = motion.after(&says(ms, count, false));
            assert_eq!(motion == Motion::Ended, ended, "{ms}");
        }
    }
}
