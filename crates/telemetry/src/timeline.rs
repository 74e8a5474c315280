//! The course of a run: the largest values of each stretch of cycles.

use super::stretches::{Merge, Stretches};
use fieldbeat_core::cycle::record::{DriveRecord, Record, Reply};

/// The largest values of one stretch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Stretch {
    /// Begin of a cycle after its grid point, skipped slots included, ns.
    pub wake_ns: u64,
    /// Round trip of any drive, ns.
    pub rtt_ns: u64,
    /// From the begin of a cycle to its end, ns.
    pub busy_ns: u64,
    /// Exchanges missed.
    pub missed: u64,
    /// Slots skipped.
    pub skipped: u64,
}

impl Merge for Stretch {
    fn merge(&mut self, other: Stretch) {
        self.wake_ns = self.wake_ns.max(other.wake_ns);
        self.rtt_ns = self.rtt_ns.max(other.rtt_ns);
        self.busy_ns = self.busy_ns.max(other.busy_ns);
        self.missed += other.missed;
        self.skipped += other.skipped;
    }
}

/// The course of a run.
#[derive(Clone, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(transparent))]
pub struct Timeline {
    all: Stretches<Stretch>,
    /// Of the cycle whose own record is still to come.
    #[cfg_attr(feature = "serde", serde(skip))]
    cycle: Stretch,
}

impl Timeline {
    /// How many cycles a stretch is long.
    pub fn width(&self) -> u64 {
        self.all.width()
    }

    /// The stretches from cycle 0 on.
    pub fn stretches(&self) -> &[Stretch] {
        self.all.list()
    }

    /// Enters one record.
    #[doc(hidden)]
    pub fn enter(&mut self, record: &Record) {
        match record {
            Record::Drive(drive) => self.drive(drive),
            Record::Monitor(_)
            | Record::Reference(_)
            | Record::Command(_)
            | Record::Event(_)
            | Record::Native(_) => {}
            Record::Cycle(record) => {
                let busy_ns = record.stages_ns.iter().map(|ns| u64::from(*ns)).sum();
                let wake_ns = u64::from(record.wake_ns);
                let cycle = Stretch { wake_ns, busy_ns, ..std::mem::take(&mut self.cycle) };
                self.all.at(record.index).merge(cycle);
            }
            Record::Skipped(record) => {
                let (wake_ns, skipped) = (record.late_ns, record.count);
                self.all.at(record.first).merge(Stretch { wake_ns, skipped, ..Stretch::default() });
            }
        }
    }

    /// Enters that of a drive.
    #[inline]
    pub(crate) fn drive(&mut self, DriveRecord { rtt_ns, reply, .. }: &DriveRecord) {
        self.cycle.rtt_ns = self.cycle.rtt_ns.max(rtt_ns.map_or(0, |ns| u64::from(ns.get())));
        self.cycle.missed += u64::from(*reply == Reply::Missed);
    }

    /// Appends the course of a later run, whose cycle 0 was at `begin`.
    #[doc(hidden)]
    pub fn append(&mut self, begin: u64, later: &Timeline) {
        self.all.append(begin, &later.all);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stretches::MOST;
    use fieldbeat_core::cycle::record::{CycleRecord, SkippedRecord, measured};

    #[test]
    fn the_largest_value_survives_every_merge() {
        let mut timeline = Timeline::default();
        for index in 0..100_000_u64 {
            let wake_ns = if index == 77_777 { 500_000 } else { 5_000 };
            timeline.enter(&Record::Cycle(CycleRecord { index, wake_ns, ..CycleRecord::default() }));
        }
        assert_eq!((timeline.width(), timeline.stretches().len()), (128, 782));
        for (place, stretch) in timeline.stretches().iter().enumerate() {
            let expected = if place == 77_777 / 128 { 500_000 } else { 5_000 };
            assert_eq!(stretch.wake_ns, expected, "{place}");
        }
    }

    #[test]
    fn counts_add_up_and_gaps_stay_empty() {
        let mut timeline = Timeline::default();
        let drive =
            |index, reply| DriveRecord { index, reply, rtt_ns: measured(7), ..DriveRecord::default() };
        timeline.enter(&Record::Drive(drive(3, Reply::Missed)));
        timeline.enter(&Record::Drive(drive(3, Reply::Answered)));
        timeline.enter(&Record::Cycle(CycleRecord { index: 3, ..CycleRecord::default() }));
        let skipped =
            SkippedRecord { first: 5_000_000_000, count: 9, late_ns: 11, ..SkippedRecord::default() };
        timeline.enter(&Record::Skipped(skipped));
        let first = timeline.stretches()[0];
        assert_eq!((first.missed, first.rtt_ns), (1, 7));
        let last = timeline.stretches().last().unwrap();
        assert_eq!((last.skipped, last.wake_ns), (9, 11));
        assert!(timeline.stretches().len() <= MOST);
        assert_eq!(
            timeline.stretches()[1..timeline.stretches().len() - 1],
            vec![Stretch::default(); timeline.stretches().len() - 2]
        );
    }
}
