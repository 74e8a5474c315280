//! How the axes moved: position, demand, following error and velocity over the time of a run, as the extremes of each
//! stretch of cycles, and what happened to each axis meanwhile.

use super::stretches::{Merge, Stretches};
use fieldbeat_core::axis::{Command, Link, State, StopCause, Units};
use fieldbeat_core::drive::record::DriveRecord;

/// The smallest and the largest value of a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(from = "(f32, f32)", into = "(f32, f32)"))]
pub struct Band {
    /// The smallest.
    pub low: f32,
    /// The largest.
    pub high: f32,
}

impl From<(f32, f32)> for Band {
    fn from((low, high): (f32, f32)) -> Band {
        Band { low, high }
    }
}

impl From<Band> for (f32, f32) {
    fn from(Band { low, high }: Band) -> (f32, f32) {
        (low, high)
    }
}

impl Band {
    /// Of no value: any value is lower, and higher.
    const NONE: Band = Band { low: f32::INFINITY, high: f32::NEG_INFINITY };

    /// Takes one more value in; a drive that reports none has none.
    #[inline]
    fn see(&mut self, value: f64) {
        let value = value as f32;
        self.low = if value < self.low { value } else { self.low };
        self.high = if value > self.high { value } else { self.high };
    }

    fn known(self) -> Option<Band> {
        (self.low <= self.high && self.low.is_finite() && self.high.is_finite()).then_some(self)
    }
}

/// How an axis moved in one stretch, in its units.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(from = "[Option<Band>; 4]", into = "[Option<Band>; 4]"))]
pub struct Moved([Band; 4]);

const POSITION: usize = 0;
const DEMAND: usize = 1;
const ERROR: usize = 2;
const VELOCITY: usize = 3;

impl Moved {
    /// Actual position; `None`: nothing was reported.
    pub fn position(&self) -> Option<Band> {
        self.0[POSITION].known()
    }

    /// Demand position while it is enabled.
    pub fn demand(&self) -> Option<Band> {
        self.0[DEMAND].known()
    }

    /// Demand less actual position while it is enabled and not homing.
    pub fn error(&self) -> Option<Band> {
        self.0[ERROR].known()
    }

    /// Actual velocity.
    pub fn velocity(&self) -> Option<Band> {
        self.0[VELOCITY].known()
    }
}

impl Default for Moved {
    fn default() -> Moved {
        Moved([Band::NONE; 4])
    }
}

/// In files a stretch is a list: its names would take more room than its numbers.
impl From<Moved> for [Option<Band>; 4] {
    fn from(Moved(bands): Moved) -> [Option<Band>; 4] {
        bands.map(Band::known)
    }
}

impl From<[Option<Band>; 4]> for Moved {
    fn from(bands: [Option<Band>; 4]) -> Moved {
        Moved(bands.map(|band| band.unwrap_or(Band::NONE)))
    }
}

impl Merge for Moved {
    fn merge(&mut self, Moved(others): Moved) {
        for (band, other) in self.0.iter_mut().zip(others) {
            *band = Band { low: band.low.min(other.low), high: band.high.max(other.high) };
        }
    }
}

/// The events of an axis.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Mark {
    /// The cycle in which it was noticed.
    pub cycle: u64,
    /// The event.
    pub what: Happened,
}

/// Something that happens to an axis.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Happened {
    /// The link came up.
    Online,
    /// The link was lost.
    Lost,
    /// The drive reports this state.
    State(String),
    /// The drive reports this fault.
    Fault(u32),
    /// The master stopped the axis, for this reason.
    Stopped(String),
}

impl Happened {
    /// Whether a run without trouble does not have it.
    pub fn is_trouble(&self) -> bool {
        match self {
            Happened::Lost | Happened::Fault(_) => true,
            // What was before the run, or is its end.
            Happened::Stopped(cause) => ![StopCause::Shutdown, StopCause::FoundRunning]
                .iter()
                .any(|usual| usual.to_string() == *cause),
            Happened::Online | Happened::State(_) => false,
        }
    }
}

/// The number of marks of an axis that are kept at each end: the first ones show where it began.
const KEPT: usize = 64;

/// The marks of an axis, in bounded memory.
#[derive(Clone, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Marks {
    first: Vec<Mark>,
    newest: std::collections::VecDeque<Mark>,
    /// Those between.
    dropped: u64,
    /// All faults that came, those dropped included.
    faults: u64,
    /// All stops that are trouble.
    stops: u64,
}

impl Marks {
    /// Those that were kept, in their order.
    pub fn iter(&self) -> impl Iterator<Item = &Mark> {
        self.first.iter().chain(&self.newest)
    }

    /// How many were not kept, between the first and the newest ones.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// How many faults there were.
    pub fn faults(&self) -> u64 {
        self.faults
    }

    /// How many stops there were, without those at the end of a run, and of drives that were found running at its
    /// start.
    pub fn stops(&self) -> u64 {
        self.stops
    }

    fn add(&mut self, cycle: u64, what: Happened) {
        self.faults += u64::from(matches!(what, Happened::Fault(_)));
        self.stops += u64::from(matches!(what, Happened::Stopped(_)) && what.is_trouble());
        self.keep(Mark { cycle, what });
    }

    fn keep(&mut self, mark: Mark) {
        if self.first.len() < KEPT {
            return self.first.push(mark);
        }
        if self.newest.len() == KEPT {
            self.newest.pop_front();
            self.dropped += 1;
        }
        self.newest.push_back(mark);
    }

    /// Appends those of a later run, whose cycle 0 was at `begin`.
    fn append(&mut self, begin: u64, later: &Marks) {
        for mark in later.iter() {
            self.keep(Mark { cycle: begin + mark.cycle, what: mark.what.clone() });
        }
        self.dropped += later.dropped;
        self.faults += later.faults;
        self.stops += later.stops;
    }
}

/// A value without its sign, and its cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Largest {
    /// The value.
    pub value: f64,
    /// The cycle.
    pub cycle: u64,
}

/// How one axis moved.
#[derive(Clone, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct AxisMotion {
    course: Stretches<Moved>,
    /// The largest following error, exactly; `None`: none was reported.
    pub error_max: Option<Largest>,
    /// The marks of events.
    pub marks: Marks,
}

impl AxisMotion {
    /// How many cycles a stretch is long.
    pub fn width(&self) -> u64 {
        self.course.width()
    }

    /// The stretches from cycle 0 on.
    pub fn stretches(&self) -> &[Moved] {
        self.course.list()
    }

    /// Appends those of a later run, whose cycle 0 was at `begin`.
    #[doc(hidden)]
    pub fn append(&mut self, begin: u64, later: &AxisMotion) {
        self.course.append(begin, &later.course);
        if let Some(Largest { value, cycle }) = later.error_max
            && self.error_max.is_none_or(|largest| value > largest.value)
        {
            self.error_max = Some(Largest { value, cycle: begin + cycle });
        }
        self.marks.append(begin, &later.marks);
    }
}

/// How the axes moved, in the order of the plan.
#[derive(Clone, Debug)]
pub struct Motion {
    axes: Vec<(AxisMotion, LastRecord)>,
}

/// The state of an axis in its record before.
#[derive(Clone, Debug, Default)]
struct LastRecord {
    modulo: Option<f64>,
    link: Link,
    state: State,
    fault: u32,
    stopped: Option<StopCause>,
}

impl Motion {
    /// Axes with these units.
    #[doc(hidden)]
    pub fn new(units: &[Units]) -> Motion {
        let axis = |units: &Units| {
            (AxisMotion::default(), LastRecord { modulo: units.modulo, ..LastRecord::default() })
        };
        Motion { axes: units.iter().map(axis).collect() }
    }

    /// The axes.
    pub fn axes(&self) -> impl ExactSizeIterator<Item = &AxisMotion> {
        self.axes.iter().map(|(motion, _)| motion)
    }

    /// Takes in what a drive did in a cycle.
    #[doc(hidden)]
    #[inline(always)] // Of nearly each record.
    pub fn enter(&mut self, record: &DriveRecord) {
        let Some((motion, known)) = self.axes.get_mut(usize::from(record.axis)) else { return };
        if known.differs(record) {
            known.notice(record, &mut motion.marks);
        }
        if record.link != Link::Online {
            return;
        }
        let enabled = record.state == State::OperationEnabled;
        let error = record.following_error(known.modulo);
        let counts = enabled && error.is_finite() && record.command != Command::Home.code();
        if counts && motion.error_max.is_none_or(|largest| error.abs() > largest.value) {
            motion.error_max = Some(Largest { value: error.abs(), cycle: record.index });
        }
        let Moved(bands) = motion.course.at(record.index);
        bands[POSITION].see(record.position);
        bands[VELOCITY].see(record.velocity.into());
        if enabled {
            bands[DEMAND].see(record.demand);
        }
        if counts {
            bands[ERROR].see(error);
        }
    }
}

impl LastRecord {
    /// Whether something is new in `record`.
    #[inline]
    fn differs(&self, record: &DriveRecord) -> bool {
        (self.link, self.state, self.fault, self.stopped)
            != (record.link, record.state, record.fault, record.stopped)
    }

    /// Marks what is new in `record`.
    #[cold]
    fn notice(&mut self, record: &DriveRecord, marks: &mut Marks) {
        let DriveRecord { index, link, state, fault, stopped, .. } = *record;
        if link != self.link {
            match link {
                Link::Online => marks.add(index, Happened::Online),
                Link::Lost => marks.add(index, Happened::Lost),
                Link::Unseen | Link::Qualifying => {}
            }
            self.link = link;
        }
        if state != self.state {
            marks.add(index, Happened::State(state.to_string()));
            self.state = state;
        }
        if fault != self.fault {
            if fault != 0 {
                marks.add(index, Happened::Fault(fault));
            }
            self.fault = fault;
        }
        if stopped != self.stopped {
            if let Some(cause) = stopped {
                marks.add(index, Happened::Stopped(cause.to_string()));
            }
            self.stopped = stopped;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(index: u64, position: f64, demand: f64) -> DriveRecord {
        let (link, state) = (Link::Online, State::OperationEnabled);
        DriveRecord { index, link, state, position, demand, ..DriveRecord::default() }
    }

    fn motion(modulo: Option<f64>) -> Motion {
        Motion::new(&[Units { modulo, ..Units::millimetres(1.0) }])
    }

    #[test]
    fn a_stretch_has_both_extremes_and_a_day_stays_bounded() {
        let mut all = motion(None);
        for index in 0..100_000_u64 {
            let position = if index == 77_777 { 9.0 } else { -(index as f64) };
            all.enter(&record(index, position, position + 0.5));
        }
        all.enter(&record(86_400_000, 1.0, 1.25));
        let axis = all.axes().next().unwrap();
        assert!(axis.stretches().len() <= super::super::stretches::MOST);
        let first = axis.stretches()[0];
        assert_eq!(first.position(), Some(Band { low: -99_999.0, high: 9.0 }));
        assert_eq!(first.error(), Some(Band { low: 0.5, high: 0.5 }));
        assert_eq!(axis.stretches().last().unwrap().error(), Some(Band { low: 0.25, high: 0.25 }));
        assert_eq!(axis.error_max, Some(Largest { value: 0.5, cycle: 0 }));
    }

    #[test]
    fn events_are_marked_once_and_counted_beyond_the_limit() {
        let mut all = motion(None);
        for index in 0..1_000 {
            let fault = u32::from(index % 2 == 1) * 7;
            all.enter(&DriveRecord { fault, ..record(index, 0.0, 0.0) });
        }
        let stopped = Some(StopCause::Shutdown);
        all.enter(&DriveRecord { link: Link::Lost, stopped, ..record(1_000, 0.0, 0.0) });
        let marks = &all.axes().next().unwrap().marks;
        let kept: Vec<&Mark> = marks.iter().collect();
        assert_eq!(*kept[0], Mark { cycle: 0, what: Happened::Online });
        assert_eq!(kept[1].what, Happened::State("OperationEnabled".into()));
        assert_eq!(*kept[2], Mark { cycle: 1, what: Happened::Fault(7) });
        assert_eq!((kept.len(), marks.dropped()), (2 * KEPT, 504 - 2 * KEPT as u64));
        // The end of a run is no trouble.
        assert_eq!((marks.faults(), marks.stops()), (500, 0));
        assert_eq!(kept.last().unwrap().what, Happened::Stopped("shutdown".into()));
    }
}
