//! What can be shown of a cycle: signals of the loop and of each axis, by number.

use serde::Serialize;

use fieldbeat_core::axis::{Link, MONITOR_CHANNELS};
use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, MonitorRecord, ReferenceRecord, Stage};
use fieldbeat_record::blackbox::file::{Axis, Header};

/// A signal. Its number is its place in the list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Signal {
    /// The axis, in the order of the plan; `None` = the loop.
    pub axis: Option<usize>,
    /// Its name.
    pub name: String,
    /// Of its values; empty for a plain number.
    pub unit: String,
}

/// Signals of the loop: wake-up latency, jitter, the stages, their end, missed replies, and the phase of the reference.
const OF_LOOP: usize = 5 + Stage::ALL.len();
const PHASE: usize = OF_LOOP - 1;

/// Signals of an axis without its monitored variables.
const OF_DRIVE: usize = 11;
const OF_AXIS: usize = OF_DRIVE + MONITOR_CHANNELS;

/// All signals of a machine.
pub fn signals(header: &Header) -> Vec<Signal> {
    let of_loop = |name: &str, unit: &str| Signal { axis: None, name: name.into(), unit: unit.into() };
    let mut all = vec![of_loop("wake-up", "us"), of_loop("jitter", "us")];
    all.extend(Stage::ALL.map(|stage| of_loop(stage.name(), "us")));
    all.extend([of_loop("end", "us"), of_loop("missed", ""), of_loop("reference", "us")]);
    for (axis, of) in header.axes.iter().enumerate() {
        let signal = |name: &str, unit: String| Signal { axis: Some(axis), name: name.to_owned(), unit };
        let (unit, us) = (&of.unit, || "us".to_owned());
        all.extend([
            signal("demand", unit.clone()),
            signal("position", unit.clone()),
            signal("following error", unit.clone()),
            signal("velocity", format!("{unit}/s")),
            signal("current", "A".to_owned()),
            signal("state", String::new()),
            signal("command", String::new()),
            signal("round trip", us()),
            signal("age", us()),
            signal("sent", us()),
            signal("online", String::new()),
        ]);
        let first = all.len() - OF_DRIVE;
        for channel in &of.monitor {
            let Some(of) = channel else {
                // It keeps its number, and has no name.
                all.push(signal("", String::new()));
                continue;
            };
            let mut one = signal(&of.name, of.unit.clone());
            // The page and its files know a signal by its name.
            while all[first..].iter().any(|other| parts(&other.name).eq(parts(&one.name))) {
                one.name.push_str(" 2");
            }
            all.push(one);
        }
    }
    all
}

/// A name but for what keeps its parts apart, which a file has as underscores.
fn parts(name: &str) -> impl Iterator<Item = &str> {
    name.split(|letter: char| !letter.is_ascii_alphanumeric()).filter(|part| !part.is_empty())
}

/// How many signals a machine of so many axes has.
pub fn count(axes: usize) -> usize {
    OF_LOOP + axes * OF_AXIS
}

/// The axis of a signal; `None` = the loop.
pub fn axis_of(signal: usize) -> Option<usize> {
    signal.checked_sub(OF_LOOP).map(|place| place / OF_AXIS)
}

fn us(ns: u32) -> f64 {
    f64::from(ns) / 1e3
}

/// The values of a cycle's signals, all of them NaN before.
#[derive(Debug)]
pub struct Values {
    all: Vec<f64>,
    /// The length of a turn of each rotary axis.
    modulos: Vec<Option<f64>>,
}

impl Values {
    /// For these axes.
    pub fn new(axes: &[Axis]) -> Values {
        let modulos = axes.iter().map(|axis| axis.modulo).collect();
        Values { all: vec![f64::NAN; count(axes.len())], modulos }
    }

    /// Forgets the cycle before.
    pub fn clear(&mut self) {
        self.all.fill(f64::NAN);
    }

    /// The values, by the numbers of their signals.
    pub fn all(&self) -> &[f64] {
        &self.all
    }

    /// Those of the loop.
    pub fn cycle(&mut self, record: &CycleRecord) {
        let end = record.stages_ns.iter().fold(us(record.wake_ns), |end, ns| end + us(*ns));
        let stages = record.stages_ns.map(us);
        let values = [us(record.wake_ns), us(record.jitter_ns)].into_iter().chain(stages);
        let values = values.chain([end, f64::from(record.missed)]);
        self.all.iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }

    /// That of the clock that leads the grid.
    pub fn reference(&mut self, record: &ReferenceRecord) {
        self.all[PHASE] = record.error_ns.map_or(f64::NAN, |ns| f64::from(ns) / 1e3);
    }

    /// Those of a drive.
    pub fn drive(&mut self, record: &DriveRecord) {
        let short = |ns: Option<std::num::NonZeroU32>| ns.map_or(f64::NAN, |ns| us(ns.get()));
        let modulo = self.modulos.get(usize::from(record.axis)).copied().flatten();
        let values = [
            record.reported(record.demand),
            record.reported(record.position),
            record.following_error(modulo),
            record.reported(record.velocity.into()),
            record.reported(record.current.into()),
            f64::from(record.state as u8),
            f64::from(record.command),
            short(record.rtt_ns),
            short(record.age_ns),
            short(record.phase_ns),
            f64::from(u8::from(record.link == Link::Online)),
        ];
        self.of_axis(record.axis, 0).iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }

    /// Those of its monitored variables.
    pub fn monitor(&mut self, record: &MonitorRecord) {
        let values = record.shown.values().map(|value| value.unwrap_or(f64::NAN));
        self.of_axis(record.axis, OF_DRIVE).iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }

    fn of_axis(&mut self, axis: u16, from: usize) -> &mut [f64] {
        let begin = count(usize::from(axis));
        self.all.get_mut(begin + from..begin + OF_AXIS).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_record::blackbox::file::Channel;

    #[test]
    fn every_value_stands_at_the_number_of_its_signal() {
        let channel = |name: &str, unit: &str| Some(Channel { name: name.into(), unit: unit.into() });
        let monitor = [None, channel("load", "%"), channel("current", "A"), channel("Current 2", "A")];
        let axis = |name: &str| Axis { name: name.into(), unit: "mm".into(), ..Axis::default() };
        let header = Header { axes: vec![axis("x"), Axis { monitor, ..axis("y") }], ..Header::default() };
        let signals = signals(&header);
        assert_eq!(signals.len(), count(2));
        let second =
            |name: &str| signals.iter().filter(|one| (one.axis, &*one.name) == (Some(1), name)).count();
        assert_eq!(["current", "current 2", "Current 2"].map(second), [1; 3]);
        let mut values = Values::new(&header.axes);
        let stages_ns = [1_000, 2_000, 3_000, 4_000, 5_000, 6_000];
        values.cycle(&CycleRecord { wake_ns: 9_000, stages_ns, missed: 3, ..CycleRecord::default() });
        values.reference(&ReferenceRecord { error_ns: Some(-500), ..ReferenceRecord::default() });
        let drive = DriveRecord {
            axis: 1,
            link: Link::Online,
            demand: 5.0,
            position: 4.5,
            command: 4,
            ..DriveRecord::default()
        };
        values.drive(&drive);
        let shown = [None, Some(70.0), None, None].into();
        values.monitor(&MonitorRecord { axis: 1, shown, ..MonitorRecord::default() });
        // Of an axis that is not there: nowhere.
        values.drive(&DriveRecord { axis: 2, demand: 1.0, ..drive });
        let value = |axis, name: &str| {
            let place = signals.iter().position(|signal| signal.axis == axis && signal.name == name);
            let place = place.unwrap_or_else(|| panic!("no {name}"));
            assert_eq!(axis_of(place), axis);
            values.all()[place]
        };
        for (name, expected) in [
            ("wake-up", 9.0),
            ("send", 1.0),
            ("publish", 6.0),
            ("end", 30.0),
            ("missed", 3.0),
            ("reference", -0.5),
        ] {
            assert_eq!(value(None, name), expected, "{name}");
        }
        for (name, expected) in
            [("demand", 5.0), ("position", 4.5), ("following error", 0.5), ("command", 4.0), ("load", 70.0)]
        {
            assert_eq!(value(Some(1), name), expected, "{name}");
        }
        assert!(value(Some(0), "position").is_nan() && value(Some(1), "round trip").is_nan());
        values.clear();
        assert!(values.all().iter().all(|value| value.is_nan()));
    }

    #[test]
    fn a_rotary_axis_is_followed_by_the_shorter_way_and_one_that_never_answered_has_no_values() {
        let mut values = Values::new(&[Axis { modulo: Some(360.0), ..Axis::default() }, Axis::default()]);
        let drive =
            DriveRecord { demand: 1.0, position: 359.0, link: Link::Online, ..DriveRecord::default() };
        for (demand, position, error) in [(1.0, 359.0, 2.0), (359.0, 1.0, -2.0), (90.0, 80.0, 10.0)] {
            values.drive(&DriveRecord { demand, position, ..drive });
            assert_eq!(values.all()[count(0) + 2], error);
        }
        values.drive(&DriveRecord { axis: 1, ..drive });
        assert_eq!(values.all()[count(1) + 2], -358.0);
        values.drive(&DriveRecord { link: Link::Unseen, ..drive });
        let (reported, known) = values.all()[count(0)..].split_at(5);
        assert!(reported.iter().all(|value| value.is_nan()));
        // The state, and that no command runs.
        assert_eq!(known[..2], [0.0, 0.0]);
    }
}
