//! What the loop counts of itself, exactly.

use std::sync::Arc;

use super::engine::LoopPanic;
use crate::axis::cell::Reader;
use crate::axis::{Feedback, Link, MONITOR_CHANNELS, Observer, Unit};
use crate::bus::diagnosis::{Row, Seen};
use crate::bus::{BusClock, BusNumbers, Counters, Notes, OwnCounter, ProtocolCounters, Unmatched};
pub use crate::drive::at_end::{AtEnd, Condition, StopRequest};
pub use crate::drive::numbers::{DriveNumbers, Extent, Peak, Peaks};
use crate::{packed, parts};

/// The loop in numbers, published every cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Slots that the grid has laid out so far, by its instants.
    pub planned: u64,
    /// Cycles executed, counted when their requests were sent.
    pub executed: u64,
    /// Slots passed over, counted when that was noticed.
    pub skipped: u64,
    /// Times that the work of a cycle passed the next grid point, or the loop woke too late to begin.
    pub overruns: u64,
    /// The longest row of skipped slots.
    pub longest_skip: u64,
    /// Cycles that were late, by the plan's threshold; slots that passed while the loop woke up count once.
    pub late: u64,
    /// Latest begin of a cycle after its grid point, skipped slots included.
    pub wake_max: Peak,
    /// Largest difference between the distance of two begins and that of their grid points.
    pub jitter_max: Peak,
    /// The longest time of each stage.
    pub stage_max: [Peak; 6],
    /// The orderly end of the buses did not complete in its time.
    pub cut_off: bool,
    /// Axes in operation now.
    pub operational: u32,
    /// Axes online now.
    pub online: u32,
    /// Exchanges missed by all drives.
    pub missed: u64,
    /// Records for which the telemetry ring had no room.
    pub lost_records: u64,
    /// Events and samples for which the application's queues had no room.
    pub lost_events: u64,
    /// The bus clock that leads the grid; `None`: ours leads.
    pub reference: Option<ReferenceStatus>,
}

/// How the grid follows the clock of the bus that the plan names as its reference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReferenceStatus {
    /// The grid is locked: 50 errors in a row were within a hundredth of the period, or 5 us if that is more, and
    /// since then neither were three in a row beyond four times that, nor were 100 executed cycles in a row without
    /// one.
    pub locked: bool,
    /// Times that the lock was lost.
    pub losses: u64,
    /// Executed cycles with a reported error.
    pub samples: u64,
    /// Executed cycles without one: they steered nothing.
    pub silent: u64,
    /// The last error, ns: positive is late.
    pub error_ns: i64,
    /// The largest error, late or early, since the grid was locked for the first time.
    pub error_max: Peak,
    /// The last step of the grid, ns: positive steps make the next slot later.
    pub step_ns: i64,
    /// The largest step, later or earlier.
    pub step_max: Peak,
}

parts! {
    Status {
        planned, executed, skipped, overruns, longest_skip, late, operational, online, missed, lost_records,
        lost_events, cut_off, wake_max, jitter_max, stage_max, reference
    }
    ReferenceStatus { locked, losses, samples, silent, error_ns, error_max, step_ns, step_max }
    BusNumbers { unmatched, clock }
    BusClock { error_ns, locked, error_max_ns, window_ns }
    Unmatched { datagrams, dropped, errors }
}
packed!(Status, BusNumbers);

impl Status {
    /// The counts, which are its first words: all that changes in a usual cycle.
    #[doc(hidden)]
    pub fn counts(&self) -> [u64; 11] {
        [
            self.planned,
            self.executed,
            self.skipped,
            self.overruns,
            self.longest_skip,
            self.late,
            self.operational.into(),
            self.online.into(),
            self.missed,
            self.lost_records,
            self.lost_events,
        ]
    }
}

/// The constants of an axis for the readers of its numbers.
#[derive(Clone, Debug)]
pub struct AxisInfo {
    /// The name.
    pub name: String,
    /// The protocol's name.
    pub protocol: &'static str,
    /// If it needs a connection: the notes of its bus, and its index there.
    pub connection: Option<(Arc<dyn Notes>, usize)>,
    /// The meaning of its counts if it is not online.
    pub diagnosis: &'static [Row],
    /// The link as it was seen so far.
    pub seen: Seen,
    /// The index of its bus.
    pub bus: usize,
}

impl AxisInfo {
    /// The symptom of its link, now or when it was lost, and whether it is now; `None`: nothing is wrong, or nothing is
    /// known yet.
    fn diagnosis(&self, link: Link, numbers: &DriveNumbers, unmatched: &Unmatched) -> Option<(String, bool)> {
        let noted = self.connection.as_ref();
        let noted = noted.and_then(|(notes, at)| Some((notes.get(*at)?, notes.is_vague(*at))));
        let is_now = link != Link::Online || matches!(noted, Some((_, false)));
        let counted = (&numbers.counters, unmatched);
        let why = self.seen.diagnose(self.diagnosis, (link, numbers.losses), counted, noted);
        why.map(|why| (why, is_now))
    }

    /// The remark on the drive although it is in operation.
    fn remark(&self) -> Option<String> {
        let (notes, index) = self.connection.as_ref()?;
        notes.remark(*index).map(|remark| format!("drive {}: {remark}", self.name))
    }

    /// The axis in numbers.
    pub fn with(&self, feedback: Feedback, numbers: DriveNumbers, unmatched: &Unmatched) -> DriveEnd {
        let diagnosis = self.diagnosis(feedback.link, &numbers, unmatched);
        let not_connected = diagnosis.clone().filter(|(_, is_now)| *is_now).map(|(why, _)| why);
        let DriveNumbers { counters, losses, peaks, monitor } = numbers;
        DriveEnd {
            name: self.name.clone(),
            diagnosis: diagnosis.map(|(why, _)| why),
            protocol: self.protocol,
            feedback,
            not_connected,
            counters,
            losses,
            peaks,
            monitor,
            at_end: None,
        }
    }
}

/// The constants of a bus for the readers of its numbers.
#[derive(Clone, Debug)]
pub struct BusInfo {
    /// The name.
    pub name: String,
    /// The names of its devices that are not drives.
    pub devices: Vec<String>,
    /// The counts of its protocol for each.
    pub own_counters: &'static [OwnCounter],
    /// The additional notes of the bus.
    pub notes: Option<Arc<dyn Notes>>,
}

impl BusInfo {
    /// The name and its counts, with those that only a normal thread may read from the kernel.
    pub fn with(&self, unmatched: Unmatched) -> (String, Unmatched) {
        let dropped = self.notes.as_ref().map_or(0, |notes| notes.dropped());
        (self.name.clone(), Unmatched { dropped: unmatched.dropped + dropped, ..unmatched })
    }

    /// The remarks on its devices although they are in operation.
    fn remarks(&self) -> impl Iterator<Item = String> {
        self.devices.iter().enumerate().filter_map(|(index, name)| {
            let remark = self.notes.as_ref()?.device_remark(index)?;
            Some(format!("device {name}: {remark}"))
        })
    }

    /// The devices that are not drives.
    pub fn devices(&self) -> impl Iterator<Item = DeviceEnd> {
        self.devices.iter().enumerate().map(|(index, name)| DeviceEnd {
            name: name.clone(),
            not_operational: self.notes.as_ref().and_then(|notes| notes.device(index)),
            protocol_counters: self.notes.as_ref().map_or_else(ProtocolCounters::default, |notes| {
                ProtocolCounters::of(self.own_counters, notes.device_counters(index))
            }),
        })
    }
}

/// Readers of the loop's counts, for any thread.
#[derive(Debug)]
pub struct Gauges {
    /// The numbers of the loop, newest.
    pub status: Reader<Status>,
    /// Those of the axes, in the order of the plan.
    pub axes: Vec<AxisGauge>,
    /// Those of the buses, in the order of the plan.
    pub buses: Vec<BusGauge>,
}

impl Gauges {
    /// The loop and all drives in numbers. Those of a drive are at most 64 cycles or 100 ms old.
    pub fn numbers(&self) -> Numbers {
        let drives = self.axes.iter().map(|axis| self.drive(axis)).collect();
        Numbers::of(self.status.read(), drives, self.buses.iter().map(|bus| (&bus.info, bus.numbers.read())))
    }

    fn drive(&self, axis: &AxisGauge) -> DriveEnd {
        let of_bus = self.buses.get(axis.info.bus).map(|bus| bus.numbers.read()).unwrap_or_default();
        axis.info.with(axis.observer.feedback(), axis.numbers.read(), &of_bus.unmatched)
    }

    /// Why drive `index` is not online, and what to do; `None`: it is, or nothing is known yet.
    pub fn not_connected(&self, index: usize) -> Option<String> {
        self.drive(self.axes.get(index)?).not_connected
    }

    /// The devices that are no drives, in the order of the plan.
    pub fn devices(&self) -> Vec<DeviceEnd> {
        self.buses.iter().flat_map(|bus| bus.info.devices()).collect()
    }

    /// The remarks on drives and devices although they are in operation, a line each.
    pub fn remarks(&self) -> Vec<String> {
        let drives = self.axes.iter().filter_map(|axis| axis.info.remark());
        drives.chain(self.buses.iter().flat_map(|bus| bus.info.remarks())).collect()
    }
}

/// Readers of one axis.
#[derive(Debug)]
pub struct AxisGauge {
    /// The constants of the axis.
    pub info: AxisInfo,
    /// The newest feedback.
    pub observer: Observer,
    /// The numbers; at most 64 cycles or 100 ms old.
    pub numbers: Reader<DriveNumbers>,
}

/// Readers of one bus; at most 64 cycles or 100 ms old.
#[derive(Debug)]
pub struct BusGauge {
    /// The constants of the bus.
    pub info: BusInfo,
    /// The numbers.
    pub numbers: Reader<BusNumbers>,
}

/// A device that takes part in the cycle and is not a drive.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct DeviceEnd {
    /// The name.
    pub name: String,
    /// Why it is not in operation; `None`: it is, or was until the orderly end.
    pub not_operational: Option<String>,
    /// The counts that only its protocol has, by their keys.
    pub protocol_counters: ProtocolCounters,
}

/// One drive in numbers.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct DriveEnd {
    /// The axis' name.
    pub name: String,
    /// The protocol's name.
    pub protocol: &'static str,
    /// The last feedback.
    pub feedback: Feedback,
    /// Why it is not online, and what to do; `None`: it is, or nothing is known yet.
    pub not_connected: Option<String>,
    /// The same, and also of a drive that was lost and is back: why it was.
    pub diagnosis: Option<String>,
    /// The exchanges.
    pub counters: Counters,
    /// Times that the link was lost.
    pub losses: u64,
    /// The largest times.
    pub peaks: Peaks,
    /// The monitored variables, in the order of its channels; `None` = not seen yet.
    pub monitor: [Option<Extent>; MONITOR_CHANNELS],
    /// How it was left; `None` before the end of the run, and for a drive that has never reported its state and of
    /// which nothing was requested.
    pub at_end: Option<AtEnd>,
}

impl DriveEnd {
    /// In words, with the `unit` of its axis: how it was left, what was tried, and what to do; nothing of a drive that
    /// is off.
    pub fn left(&self, unit: Unit) -> Option<String> {
        self.at_end.as_ref()?.line(&self.feedback, unit)
    }
}

/// A run in numbers, at its end or meanwhile: exact, whatever the rings lost.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Numbers {
    /// The loop.
    pub status: Status,
    /// The drives, in the order of the plan.
    pub drives: Vec<DriveEnd>,
    /// The buses: name, and unmatched counters.
    pub buses: Vec<(String, Unmatched)>,
    /// Their clocks, in the same order; `None`: no clock.
    pub clocks: Vec<Option<BusClock>>,
    /// The devices that are not drives, in the order of the plan.
    pub devices: Vec<DeviceEnd>,
    /// The loop panicked, and ended for that reason.
    pub panic: Option<LoopPanic>,
    /// Page faults and involuntary switches of the loop's thread while it ran; `None` before its end, and in virtual
    /// time.
    pub page_faults: Option<u64>,
    /// See `page_faults`.
    pub involuntary_switches: Option<u64>,
}

impl Numbers {
    /// Those of the loop, its drives and its buses.
    pub(super) fn of<'a>(
        status: Status,
        drives: Vec<DriveEnd>,
        of_buses: impl Iterator<Item = (&'a BusInfo, BusNumbers)>,
    ) -> Numbers {
        let mut numbers = Numbers { status, drives, ..Numbers::default() };
        for (info, BusNumbers { unmatched, clock }) in of_buses {
            numbers.buses.push(info.with(unmatched));
            numbers.clocks.push(clock);
            numbers.devices.extend(info.devices());
        }
        numbers
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::cell::Packed;
    use crate::net::LinkNotes;

    #[test]
    fn a_drive_without_a_connection_says_why_and_one_that_needs_none_says_nothing() {
        let notes = LinkNotes::new(2);
        notes.set(1, Some("refused".to_owned()));
        let why = |index: Option<usize>| {
            let connection = index.map(|index| (Arc::new(notes.clone()) as Arc<dyn Notes>, index));
            let info = AxisInfo {
                name: "x".to_owned(),
                protocol: "modbus-tcp",
                connection,
                diagnosis: &[],
                seen: Seen::default(),
                bus: 0,
            };
            let end = info.with(Feedback::default(), DriveNumbers::default(), &Unmatched::default());
            assert_eq!(end.diagnosis, end.not_connected);
            end.not_connected
        };
        assert_eq!([None, Some(0), Some(1)].map(why), [None, None, Some("refused".to_owned())]);
        notes.set(1, None);
        assert_eq!([None, Some(0), Some(1)].map(why), [None, None, None]);
    }

    #[test]
    fn published_counters_equal_the_counted_ones() {
        let reference =
            ReferenceStatus { locked: true, error_ns: -31, step_ns: 34, ..ReferenceStatus::default() };
        for reference in [None, Some(reference)] {
            let peak = Peak { ns: 7, index: 8 };
            let stage_max = std::array::from_fn(|stage| Peak { ns: stage as u64, ..peak });
            let counted = Status {
                executed: 2,
                wake_max: peak,
                stage_max,
                cut_off: true,
                online: 24,
                ..Status::default()
            };
            let counted = Status { planned: 1, skipped: 3, overruns: 4, longest_skip: 5, late: 6, ..counted };
            let counted = Status { operational: 23, missed: 25, lost_records: 26, ..counted };
            let status = Status { lost_events: 27, reference, ..counted };
            assert_eq!(Status::unpack(&status.pack()), status);
            assert_eq!(status.pack()[..11], status.counts(), "a write of the counts alone");
        }
        let extent = |value: f64| Some(Extent { value, min: value - 1.0, max: value + 1.0 });
        let counters =
            Counters { own: std::array::from_fn(|count| 100 + count as u64), ..Counters::default() };
        let all = [17.5, -20.5, 0.0, 1e300].map(extent);
        for monitor in [[None; MONITOR_CHANNELS], [None, extent(0.0), None, extent(-1.5)], all] {
            let drive = DriveNumbers { counters, losses: 10, monitor, ..DriveNumbers::default() };
            assert_eq!(DriveNumbers::unpack(&drive.pack()), drive);
        }
        let clock = BusClock { error_ns: Some(-7), locked: true, error_max_ns: 8, window_ns: 9 };
        for clock in [None, Some(clock), Some(BusClock { error_ns: None, locked: false, ..clock })] {
            let numbers = BusNumbers { unmatched: Unmatched { datagrams: 1, dropped: 2, errors: 3 }, clock };
            assert_eq!(BusNumbers::unpack(&numbers.pack()), numbers);
        }
    }

    #[test]
    fn an_extent_has_the_newest_value_and_both_ends_and_a_peak_is_the_first_of_the_largest() {
        let mut extent = None;
        for (value, min, max) in [(2.0, 2.0, 2.0), (-3.0, -3.0, 2.0), (7.0, -3.0, 7.0), (0.0, -3.0, 7.0)] {
            Extent::see(&mut extent, value);
            assert_eq!(extent, Some(Extent { value, min, max }));
        }
        let mut peak = Peak::default();
        for (index, ns) in [(3, 10), (4, 12), (5, 12), (6, 1)] {
            peak.see(ns, index);
        }
        assert_eq!(peak, Peak { ns: 12, index: 4 });
    }
}
