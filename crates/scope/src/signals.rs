//! What can be shown of a cycle: signals of the loop and of each axis, by number.

use serde::Serialize;

use fieldbeat_core::axis::MONITOR_CHANNELS;
use fieldbeat_core::cycle::record::{MonitorRecord, Record};
use fieldbeat_record::blackbox::file::{Axis, Header};
use fieldbeat_telemetry::signals::{
    self, DEMAND, END, FOLLOWING_ERROR, OF_AXIS, OF_CYCLE, OF_REFERENCE, POSITION, VELOCITY, WAKE,
};

/// A signal. Its number is its place in the list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Signal {
    /// The axis, in the order of the plan; `None` = the loop.
    pub axis: Option<usize>,
    /// The name.
    pub name: String,
    /// Of its values; empty for a plain number.
    pub unit: String,
}

impl Signal {
    fn new<R>(axis: Option<usize>, of: &signals::Signal<R>, unit_of_axis: &str) -> Signal {
        Signal { axis, name: of.name.to_owned(), unit: of.unit(unit_of_axis) }
    }
}

/// The number of signals of the loop: those of a cycle, and that of the reference.
const OF_LOOP: usize = OF_CYCLE.len() + 1;

/// Signals of an axis, with its monitored variables.
const EACH: usize = OF_AXIS.len() + MONITOR_CHANNELS;

/// All signals of a machine.
pub fn signals(header: &Header) -> Vec<Signal> {
    let mut all: Vec<Signal> = OF_CYCLE.iter().map(|of| Signal::new(None, of, "")).collect();
    all.push(Signal::new(None, &OF_REFERENCE, ""));
    for (axis, of) in header.axes.iter().enumerate() {
        let first = all.len();
        all.extend(OF_AXIS.iter().map(|signal| Signal::new(Some(axis), signal, &of.unit)));
        let monitored =
            |name: &str, unit: &str| Signal { axis: Some(axis), name: name.into(), unit: unit.into() };
        for channel in &of.monitor {
            let Some(of) = channel else {
                // It keeps its number, and has no name.
                all.push(monitored("", ""));
                continue;
            };
            let mut one = monitored(&of.name, &of.unit);
            // The page and its files know a signal by its name.
            while all[first..].iter().any(|other| parts(&other.name).eq(parts(&one.name))) {
                one.name.push_str(" 2");
            }
            all.push(one);
        }
    }
    all
}

/// The plots of a browser that has kept none, each with the numbers of its signals: of the first axes, and of the loop.
pub fn plots(signals: &[Signal]) -> Vec<Vec<usize>> {
    let numbers = |axes: &[Option<usize>], names: &[&str]| -> Vec<usize> {
        let wanted = axes.iter().flat_map(|axis| names.iter().map(move |name| (*axis, *name)));
        let number = |(axis, name)| signals.iter().position(|of| of.axis == axis && of.name == name);
        wanted.filter_map(number).collect()
    };
    let of_axes = |names: &[&str]| numbers(&[Some(0), Some(1)], names);
    let of_axes = [&[DEMAND.name, POSITION.name][..], &[FOLLOWING_ERROR.name], &[VELOCITY.name]].map(of_axes);
    let of_loop = numbers(&[None], &[WAKE.name, END.name]);
    of_axes.into_iter().chain([of_loop]).filter(|plot| !plot.is_empty()).collect()
}

/// A name but for what keeps its parts apart, which a file has as underscores.
fn parts(name: &str) -> impl Iterator<Item = &str> {
    name.split(|letter: char| !letter.is_ascii_alphanumeric()).filter(|part| !part.is_empty())
}

/// How many signals a machine of so many axes has.
pub fn count(axes: usize) -> usize {
    OF_LOOP + axes * EACH
}

/// The axis of a signal; `None` = the loop.
pub fn axis_of(signal: usize) -> Option<usize> {
    signal.checked_sub(OF_LOOP).map(|place| place / EACH)
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

    /// Takes in those of a record.
    pub fn enter(&mut self, record: &Record) {
        match record {
            Record::Cycle(record) => self.put(0, OF_CYCLE.map(|of| (of.value)(record, None))),
            Record::Reference(record) => self.put(OF_CYCLE.len(), [(OF_REFERENCE.value)(record, None)]),
            Record::Drive(record) => {
                let axis = usize::from(record.axis);
                let modulo = self.modulos.get(axis).copied().flatten();
                self.put(count(axis), OF_AXIS.map(|of| (of.value)(record, modulo)));
            }
            Record::Monitor(MonitorRecord { axis, shown, .. }) => {
                let values = shown.values().map(|value| value.unwrap_or(f64::NAN));
                self.put(count(usize::from(*axis)) + OF_AXIS.len(), values);
            }
            Record::Skipped(_) | Record::Command(_) | Record::Event(_) | Record::Native(_) => {}
        }
    }

    /// Those from a number on; of an axis that is not there, none.
    fn put(&mut self, first: usize, values: impl IntoIterator<Item = f64>) {
        let places = self.all.get_mut(first..).unwrap_or_default();
        places.iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::Link;
    use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, ReferenceRecord};
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
        let cycle = CycleRecord { wake_ns: 9_000, stages_ns, missed: 3, ..CycleRecord::default() };
        values.enter(&Record::Cycle(cycle));
        let reference = ReferenceRecord { error_ns: Some(-500), ..ReferenceRecord::default() };
        values.enter(&Record::Reference(reference));
        let drive = DriveRecord {
            axis: 1,
            link: Link::Online,
            demand: 5.0,
            position: 4.5,
            command: 4,
            ..DriveRecord::default()
        };
        values.enter(&Record::Drive(drive));
        let shown = [None, Some(70.0), None, None].into();
        values.enter(&Record::Monitor(MonitorRecord { axis: 1, shown, ..MonitorRecord::default() }));
        // Of an axis that is not there: nowhere.
        values.enter(&Record::Drive(DriveRecord { axis: 2, demand: 1.0, ..drive }));
        let value = |axis, name: &str| {
            let place = signals.iter().position(|signal| signal.axis == axis && signal.name == name);
            let place = place.unwrap_or_else(|| panic!("no {name}"));
            assert_eq!(axis_of(place), axis);
            values.all()[place]
        };
        for (name, expected) in [
            ("wake-up latency", 9.0),
            ("send", 1.0),
            ("publish", 6.0),
            ("end", 30.0),
            ("missed", 3.0),
            ("phase error", -0.5),
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
        let name = |place: &usize| (signals[*place].axis, &*signals[*place].name);
        let shown: Vec<Vec<_>> = plots(&signals).iter().map(|plot| plot.iter().map(name).collect()).collect();
        let pair = |name| vec![(Some(0), name), (Some(1), name)];
        let positions = [0, 1].map(|axis| [(Some(axis), "demand"), (Some(axis), "position")]).concat();
        let of_loop = vec![(None, "wake-up latency"), (None, "end")];
        assert_eq!(shown, [positions, pair("following error"), pair("velocity"), of_loop]);
        assert_eq!(plots(&signals[..OF_LOOP]), [[0, 8]]);
    }

    #[test]
    fn a_rotary_axis_is_followed_by_the_shorter_way_and_one_that_never_answered_has_no_values() {
        let mut values = Values::new(&[Axis { modulo: Some(360.0), ..Axis::default() }, Axis::default()]);
        let drive =
            DriveRecord { demand: 1.0, position: 359.0, link: Link::Online, ..DriveRecord::default() };
        for (demand, position, error) in [(1.0, 359.0, 2.0), (359.0, 1.0, -2.0), (90.0, 80.0, 10.0)] {
            values.enter(&Record::Drive(DriveRecord { demand, position, ..drive }));
            assert_eq!(values.all()[count(0) + 2], error);
        }
        values.enter(&Record::Drive(DriveRecord { axis: 1, ..drive }));
        assert_eq!(values.all()[count(1) + 2], -358.0);
        values.enter(&Record::Drive(DriveRecord { link: Link::Unseen, ..drive }));
        let (reported, known) = values.all()[count(0)..].split_at(5);
        assert!(reported.iter().all(|value| value.is_nan()));
        // The state, and that no command runs.
        assert_eq!(known[..2], [0.0, 0.0]);
    }
}
