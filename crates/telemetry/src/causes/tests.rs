//! Each cause from what is seen of it, and nothing from what only looks like it.

use super::*;
use fieldbeat_core::cycle::record::{DriveFlags, short};
use fieldbeat_core::time::{MS, US};

/// A loop of 1 kHz, replies until its half, that is sampled every 5 ms and usually runs 50 us a cycle.
struct Loop {
    causes: Causes,
    sample: ThreadSample,
    index: u64,
    late: u64,
    /// Involuntary switches since the sample.
    switches: u32,
    /// The counts are not read with the next samples.
    times_only: bool,
}

const LATE_NS: u64 = 100 * US;

impl Loop {
    fn new() -> Loop {
        let mut causes = Causes::new(&CyclePlan::default(), true);
        let sample = ThreadSample::default();
        causes.sample(sample);
        let mut one = Loop { causes, sample, index: 0, late: 0, switches: 0, times_only: false };
        one.quiet(20);
        one
    }

    fn grid(&self) -> Time {
        Time(self.index * MS)
    }

    fn cycle(&self) -> CycleRecord {
        let stages_ns = [30, 20, 1, 1, 2, 1].map(|us| us * US as u32);
        CycleRecord { index: self.index, grid: self.grid(), wake_ns: 5_000, stages_ns, ..Default::default() }
    }

    fn enter(&mut self, mut record: CycleRecord, faults: u32) {
        if record.lateness(LATE_NS, 500 * US).is_some() {
            self.late += 1;
            let switches = self.sample.counts.switches + self.switches;
            record.look = Some(Look { faults: self.sample.counts.faults + faults, switches });
        }
        self.causes.record(&Record::Cycle(record));
        self.index += 1;
    }

    /// Enters `spans` spans of five cycles each, with nothing in them.
    fn quiet(&mut self, spans: u64) {
        for _ in 0..spans {
            for _ in 0..5 {
                self.enter(self.cycle(), 0);
            }
            self.tick(0, 0, 0, 0);
        }
    }

    /// The sample after five cycles, with this much more than usual.
    fn tick(&mut self, run_ns: u64, delay_ns: u64, faults: u32, steal_ms: u64) {
        let before = self.sample.counts;
        self.sample = ThreadSample {
            at: self.grid(),
            run_ns: self.sample.run_ns + 5 * 50 * US + run_ns,
            delay_ns: self.sample.delay_ns + 2 * US + delay_ns,
            counts: ThreadCounts {
                at: self.grid(),
                faults: before.faults + faults,
                switches: before.switches + std::mem::take(&mut self.switches),
                steal_ms: before.steal_ms + steal_ms,
            },
        };
        if self.times_only {
            self.sample.counts = before;
        }
        self.causes.sample(self.sample);
    }

    fn found(mut self) -> Vec<(Cause, u64)> {
        self.causes.finish(self.late);
        let ranked = self.causes.ranked();
        assert_eq!(ranked.iter().map(|tally| tally.count).sum::<u64>(), self.late);
        ranked.iter().map(|tally| (tally.cause, tally.count)).collect()
    }
}

fn woke(one: &Loop, us: u64) -> CycleRecord {
    CycleRecord { wake_ns: short(us * US), ..one.cycle() }
}

fn took(one: &Loop, stage: Stage, us: u64) -> CycleRecord {
    let mut record = one.cycle();
    record.stages_ns[stage as usize] = short(us * US);
    record
}

#[test]
fn a_run_delay_of_others_or_the_usual_one_is_none() {
    let mut one = Loop::new();
    // Awake all the while, and never taken from its core: the delay was another one's.
    one.enter(took(&one, Stage::Commands, 300), 0);
    (0..4).for_each(|_| one.enter(one.cycle(), 0));
    one.tick(300 * US, 200 * US, 0, 0);
    // A hundred cycles between two samples wait a little each.
    one.enter(woke(&one, 101), 0);
    (0..99).for_each(|_| one.enter(one.cycle(), 0));
    one.tick(95 * 50 * US, 38 * US, 0, 0);
    // In a span this long, what is more than that may be anybody's.
    one.enter(woke(&one, 300), 0);
    (0..99).for_each(|_| one.enter(one.cycle(), 0));
    one.tick(95 * 50 * US, 338 * US, 0, 0);
    assert_eq!(one.found(), [(Cause::Work(Stage::Commands), 1), (Cause::Unknown, 1), (Cause::Timer, 1)]);
}

#[test]
fn an_overrun_without_a_late_stage_is_its_longest_one_or_the_gap_behind() {
    for (given_up_ns, cause) in [(50 * US, Cause::Work(Stage::Commands)), (900 * US, Cause::Host)] {
        let mut one = Loop::new();
        let (mut cycle, us) = (one.cycle(), 90_000);
        cycle.stages_ns = [us, us, us, us + 1, us, us];
        // Half a millisecond of work, begun late: none of it is late by itself.
        (cycle.wake_ns, cycle.grid) = (90_000, Time(one.grid().0 - 400 * US));
        one.enter(cycle, 0);
        one.late += 1;
        let skipped = SkippedRecord {
            first: one.index,
            grid: Time(cycle.grid.0 + 580 * US),
            count: 1,
            given_up_ns,
            late: true,
            look: Some(Look { faults: one.sample.counts.faults, switches: one.sample.counts.switches }),
            ..SkippedRecord::default()
        };
        one.causes.record(&Record::Skipped(skipped));
        (0..4).for_each(|_| one.enter(one.cycle(), 0));
        one.tick(400 * US, 0, 0, 0);
        assert_eq!(one.found(), [(cause, 1)]);
    }
}

#[test]
fn a_run_delay_explains_one_late_cycle_only() {
    let mut one = Loop::new();
    one.enter(woke(&one, 300), 0);
    one.enter(woke(&one, 300), 0);
    (0..3).for_each(|_| one.enter(one.cycle(), 0));
    one.tick(0, 310 * US, 0, 0);
    one.quiet(1);
    assert_eq!(one.found(), [(Cause::Preempted, 1), (Cause::Timer, 1)]);
}

#[test]
fn a_run_time_that_always_varies_as_much_shows_no_host() {
    for (varies_us, cause) in [(0, Cause::Host), (1, Cause::Host), (100, Cause::Unknown)] {
        let mut one = Loop::new();
        for span in 0..100 {
            (0..5).for_each(|_| one.enter(one.cycle(), 0));
            one.tick(span % 2 * varies_us * US, 0, 0, 0);
        }
        // The task took long, and as far as the kernel counts the thread did not run for it.
        one.enter(took(&one, Stage::Commands, 250), 0);
        (0..4).for_each(|_| one.enter(one.cycle(), 0));
        one.tick(varies_us / 2 * US, 0, 0, 0);
        assert_eq!(one.found(), [(cause, 1)], "{varies_us} us");
    }
}

#[test]
fn a_late_sleep_is_the_host_only_if_steal_rose_soon() {
    for (spans, steal_ms, cause) in
        [(0, 10, Cause::Host), (100, 10, Cause::Host), (100, 0, Cause::Timer), (300, 10, Cause::Timer)]
    {
        let mut one = Loop::new();
        one.enter(woke(&one, 400), 0);
        (0..4).for_each(|_| one.enter(one.cycle(), 0));
        one.tick(0, 0, 0, 0);
        one.quiet(spans);
        (0..5).for_each(|_| one.enter(one.cycle(), 0));
        one.tick(0, 0, 0, steal_ms);
        assert_eq!(one.found(), [(cause, 1)], "{spans} spans later");
    }
}

#[test]
fn a_drive_is_named() {
    let mut one = Loop::new();
    let miss = |one: &mut Loop, axis, was_online| {
        let (reply, flags) = (Reply::Missed, DriveFlags::new(false, false, was_online));
        let drive = DriveRecord { index: one.index, axis, reply, flags, ..Default::default() };
        one.causes.record(&Record::Drive(drive));
    };
    // A probe of one that never answered is no news.
    miss(&mut one, 2, false);
    miss(&mut one, 3, true);
    one.enter(CycleRecord { missed: 1, ..one.cycle() }, 0);
    miss(&mut one, 3, true);
    miss(&mut one, 5, true);
    one.enter(CycleRecord { missed: 2, ..one.cycle() }, 0);
    one.tick(0, 0, 0, 0);
    assert_eq!(one.found(), [(Cause::Drive(3), 1), (Cause::Drives, 1)]);
}

#[test]
fn lost_records_have_an_unknown_cause() {
    let mut one = Loop::new();
    one.late += 3;
    assert_eq!(one.found(), [(Cause::Unknown, 3)]);
}

#[test]
fn without_samples_the_looks_of_the_loop_count() {
    let mut causes = Causes::new(&CyclePlan::default(), false);
    for (index, faults, switches) in [(0, 5, 5), (1, 5, 5), (2, 6, 7), (3, 6, 8)] {
        let look = Some(Look { faults, switches });
        causes.record(&Record::Cycle(CycleRecord {
            index,
            wake_ns: 200_000,
            look,
            ..CycleRecord::default()
        }));
    }
    let found: Vec<Cause> = causes.newest(4).map(|late| late.cause).collect();
    assert_eq!(found, [Cause::Unknown, Cause::Unknown, Cause::PageFault, Cause::Preempted]);
}

#[test]
fn without_samples_all_but_the_drives_is_unknown() {
    let mut causes = Causes::new(&CyclePlan::default(), true);
    let record = CycleRecord { wake_ns: 200_000, ..CycleRecord::default() };
    causes.record(&Record::Cycle(record));
    let skipped = SkippedRecord { given_up_ns: MS, count: 1, woke_late: true, ..SkippedRecord::default() };
    causes.record(&Record::Skipped(skipped));
    // Not a late cycle of its own: the cycle before it was.
    causes.record(&Record::Skipped(SkippedRecord { woke_late: false, ..skipped }));
    causes.finish(2);
    let worst = Tally { cause: Cause::Unknown, count: 2, worst_ns: MS, worst_cycle: 0 };
    assert_eq!(causes.ranked(), [worst]);
}
