//! What the loop counts stays true whatever becomes of its records.

use std::time::Duration;

use fieldbeat::axis::{Command, EventKind, Move, Profile, Target};

use fieldbeat::bus::linudp::{LinUdpPlan, MonitorPlan};
use fieldbeat::sim::{FaultPlan, SimPlan, Simulated, World, WorldOptions};
use fieldbeat::telemetry::{Cause, Extent, Measured, Numbers, Quantiles, Stage};
use fieldbeat::time::{MS, US};
use fieldbeat::{CyclePlan, Plan};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::cycle::engine::Control;
use fieldbeat_core::cycle::record::{Record, Reply};
use fieldbeat_core::cycle::ring::{Kept, RecordReader};
use fieldbeat_core::rt::Wires;
use fieldbeat_linudp::upid::Upid;
use fieldbeat_master::{Assembly, assemble};
use fieldbeat_sim::linudp::{LinMotSettings, LinMots};
use fieldbeat_telemetry::TelemetryThread;

use super::support::{Rig, drive, simulated};

const CYCLES: u64 = 5_000;

/// Three drives, disturbed by seeds; the second one shows two variables besides.
fn plan() -> Plan {
    let drives = (0..3).map(|index| {
        let mut drive = drive(index);
        if index == 1 {
            drive.monitor = MonitorPlan::Sources([
                None,
                Upid::parse("drive-timer"),
                None,
                Upid::parse("core-temperature"),
            ]);
        }
        drive
    });
    let bus = LinUdpPlan::new([127, 0, 0, 1].into(), drives.collect());
    Plan { cycle: cycle(), buses: vec![Box::new(bus)], ..Plan::default() }
}

/// Its drives.
fn drives() -> Simulated {
    let settings = |index| LinMotSettings {
        faults: FaultPlan { seed: index as u64, drop: 0.02, delay: 0.02, ..FaultPlan::default() },
        ..simulated(&drive(index))
    };
    SimPlan::from(LinMots((0..3).map(settings).collect())).build()
}

/// A machine whose sleeps are disturbed too; `telemetry` may take the records after each step.
fn run(plan: &Plan, mut telemetry: impl FnMut(&mut RecordReader)) -> Numbers {
    let options = WorldOptions { seed: 7, wake_ns: 260 * US, ..WorldOptions::default() };
    let world = World::new(drives(), options).unwrap();
    let Assembly { mut engine, mut records, .. } =
        assemble(plan, world.clock(), &world, None, Control::default(), Wires::default(), Kept::default())
            .unwrap();
    engine.begin();
    while engine.status().planned < CYCLES {
        engine.step();
        telemetry(&mut records);
    }
    engine.finish()
}

/// All that `records` holds.
fn reported(records: &mut RecordReader) -> impl Iterator<Item = Record> {
    std::iter::from_fn(|| records.pop())
}

fn cycle() -> CyclePlan {
    CyclePlan { late_ns: Some(100 * US), receive_deadline: 0.4, ..CyclePlan::default() }
}

#[test]
fn a_full_record_queue_loses_detail_and_no_counts() {
    let plan = plan();
    let mut measured = Measured::new(&plan.units(), &plan.cycle, false);
    let mut shown = [None; MONITOR_CHANNELS];
    let mut taken = run(&plan, |records| {
        for record in reported(records) {
            measured.enter(&record);
            let Record::Monitor(record) = record else { continue };
            for (extent, value) in shown.iter_mut().zip(record.shown.values()) {
                value.into_iter().for_each(|value| Extent::see(extent, value));
            }
        }
    });
    let mut lost = run(&plan, |_| {});
    assert_eq!(taken.status.lost_records, 0);
    // A ring for a second of five: most of them found no room.
    assert!(lost.status.lost_records > 10_000, "{:?}", lost.status);
    (taken.status.lost_records, lost.status.lost_records) = (0, 0);
    assert_eq!(taken, lost);

    // And what the loop counted is what the records say.
    let (status, histograms) = (&taken.status, &measured.histograms);
    assert_eq!(status.planned, histograms.wake.len());
    assert!(status.skipped > 0 && status.late > 100 && status.wake_max.ns > 200 * US, "{status:?}");
    for (stage, peak) in Stage::ALL.into_iter().zip(status.stage_max) {
        assert_eq!(histograms.stage(stage).len(), status.executed);
        // A bin of three digits holds its largest value.
        let max = histograms.stage(stage).max();
        assert!(peak.ns <= max && max - peak.ns <= max / 1_000 + 1, "{stage:?}: {peak:?} {max}");
    }
    for (drive, measured) in taken.drives.iter().zip(&histograms.drives) {
        let quantiles = Quantiles::of(&measured.rtt, drive.peaks.rtt);
        assert_eq!(quantiles.count, drive.counters.answered - drive.counters.suspect);
        assert!(drive.counters.missed > 50 && drive.peaks.age.ns > MS, "{drive:?}");
        assert_eq!(measured.send_jitter.len() + 1, drive.counters.sent);
    }
    let [none, Some(timer), nothing, temperature] = shown else { panic!("{shown:?}") };
    assert_eq!((none, nothing), (None, None));
    assert!(timer.value == timer.max && timer.max - timer.min > 1e6, "microseconds: {timer:?}");
    assert_eq!(temperature, Some(Extent { value: 40.0, min: 40.0, max: 40.0 }));
    let ends: Vec<_> = taken.drives.iter().map(|drive| drive.monitor).collect();
    assert_eq!(ends, [[None; MONITOR_CHANNELS], shown, [None; MONITOR_CHANNELS]]);
    let causes = measured.causes.ranked();
    assert_eq!(causes.iter().map(|tally| tally.count).sum::<u64>(), status.late);
    assert!(
        causes.iter().any(|tally| matches!(tally.cause, Cause::Drive(_)) && tally.count > 10),
        "{causes:?}"
    );
}

#[test]
fn each_drive_has_a_record_in_each_cycle_and_its_cycle_comes_last() {
    let bus = LinUdpPlan::new([127, 0, 0, 1].into(), (0..3).map(drive).collect());
    let plan = Plan { cycle: cycle(), buses: vec![Box::new(bus)], ..Plan::default() };
    let world = World::new(drives(), WorldOptions::default()).unwrap();
    let Assembly { mut engine, mut records, .. } =
        assemble(&plan, world.clock(), &world, None, Control::default(), Wires::default(), Kept::default())
            .unwrap();
    engine.begin();
    for index in 0..50 {
        engine.step();
        let reported: Vec<Record> = reported(&mut records).collect();
        let [Record::Drive(a), Record::Drive(b), Record::Drive(c), ref events @ .., Record::Cycle(cycle)] =
            reported[..]
        else {
            panic!("{reported:?}")
        };
        assert!(events.iter().all(|event| matches!(event, Record::Event(_))), "{reported:?}");
        assert_eq!([a.index, b.index, c.index, cycle.index], [index; 4]);
        assert_eq!([a.axis, b.axis, c.axis], [0, 1, 2]);
    }
}

#[test]
fn monitored_values_are_reported_when_new_and_for_their_drive_only() {
    let plan = plan();
    let (mut drive, mut at, mut fresh, mut silent) = (None, 0.0, 0, 0);
    let end = run(&plan, |records| {
        for record in reported(records) {
            match record {
                Record::Drive(record) => {
                    silent += u64::from(record.axis == 1 && record.rtt_ns.is_some());
                    drive = Some(record);
                }
                Record::Monitor(record) => {
                    // Behind that of its drive, and of the same reply.
                    let Some(of) = drive.take() else { panic!("{record:?}") };
                    assert_eq!((record.axis, record.index), (1, of.index));
                    // The exchange before may have been missed in the same cycle.
                    assert!(of.rtt_ns.is_some() || of.reply == Reply::Suspect, "{of:?}");
                    // The drive's own clock: no value is reported twice.
                    let [None, Some(timer), None, _] = record.shown.values() else { panic!("{record:?}") };
                    assert!(timer > at, "{timer} after {at}");
                    (at, fresh) = (timer, fresh + 1);
                }
                _ => {}
            }
        }
    });
    // Some replies say nothing of it: those before the drive is set up. No link is lost by so few misses.
    silent -= fresh;
    let missed = end.drives[1].counters.missed;
    assert!(fresh > CYCLES / 2 && (1..20).contains(&silent) && missed > 50, "{fresh} {silent} {missed}");
}

#[test]
fn only_drives_with_monitored_values_take_room() {
    let with = plan();
    assert_eq!(with.records_a_cycle(), 3 + 1 + 1);
    let axes: Vec<_> = with
        .monitored()
        .into_iter()
        .map(|axis| axis.map(|channel| channel.map(|one| (one.name, one.unit))))
        .collect();
    let named = |name: &str, unit| Some((name.to_owned(), unit));
    let shown = [None, named("drive-timer", "us"), None, named("core-temperature", "C")];
    assert_eq!(axes, [[const { None }; 4], shown, [const { None }; 4]]);
    let bus = LinUdpPlan::new([127, 0, 0, 1].into(), (0..3).map(drive).collect());
    let without = Plan { buses: vec![Box::new(bus)], ..plan() };
    assert_eq!(without.records_a_cycle(), 3 + 1);
    for (plan, records) in [(with, 5), (without, 4)] {
        let room = TelemetryThread::ring_size(plan.records_a_cycle(), 100 * US);
        assert_eq!((room, plan.black_box_records()), (records * 10_000, records * 2_000));
    }
}

/// The commands and events among records, in words.
fn notes(records: impl Iterator<Item = Record>) -> Vec<(u64, String)> {
    records
        .filter_map(|record| match record {
            Record::Command(of) => {
                let group = of.group().map_or(String::new(), |lead| format!(" in the group of {lead}"));
                let text = format!("{}: {} {} {}{group}", of.axis(), of.command().name(), of.id.0, of.step());
                Some((of.index, text))
            }
            Record::Event(event) => match event.kind().unwrap() {
                EventKind::Ended { id, command, outcome } => {
                    Some((event.index, format!("{}: {command} {} {outcome}", event.axis, id.0)))
                }
                EventKind::Stopped(cause) => Some((event.index, format!("{}: {cause}", event.axis))),
                _ => None,
            },
            _ => None,
        })
        .collect()
}

#[test]
fn commands_and_their_ends_reach_the_telemetry_in_their_order() {
    let mut b = Rig::new(2).ready();
    let tap = b.sim.tap(100_000);
    let profile = Profile { velocity: 50.0, acceleration: 500.0, deceleration: 500.0 };
    let target = Target::Relative(5.0);
    let first = b.sim.axis(0).post(Command::Move(Move { target, profile })).unwrap();
    b.step();
    let second = b.sim.axis(0).post(Command::Enable).unwrap();
    b.step();
    let third = b.sim.axis(0).post(Command::QuickStop).unwrap();
    let other = b.sim.axis(1).post(Command::Move(Move { target, profile })).unwrap();
    b.run(1_000);
    let records = std::iter::from_fn(|| tap.next(Duration::ZERO).ok());
    let records: Vec<Record> = records.flat_map(|batch| batch.to_vec()).collect();
    // Each has the slot of the cycle that it stands in.
    let mut ended = 0;
    for record in records.iter().rev() {
        match record {
            Record::Cycle(cycle) => ended = cycle.index,
            other => assert_eq!(other.index(), ended, "{other:?}"),
        }
    }
    let notes = notes(records.into_iter());
    assert!(notes.is_sorted_by_key(|(index, _)| *index), "{notes:?}");
    let of = |axis: &str| -> Vec<&str> {
        notes.iter().map(|(_, note)| &**note).filter(|note| note.starts_with(axis)).collect()
    };
    let [first, second, third, other] = [first, second, third, other].map(|id| id.0);
    assert_eq!(
        of("0: "),
        [
            format!("0: move {first} taken"),
            format!("0: move {first} begun"),
            format!("0: enable {second} taken"),
            format!("0: quick stop {third} taken"),
            format!("0: enable {second} aborted: replaced by command {third}"),
            format!("0: move {first} aborted: replaced by command {third}"),
            format!("0: quick stop {third} begun"),
            format!("0: quick stop {third} done"),
        ]
    );
    let expected = ["taken", "begun", "done"].map(|step| format!("1: move {other} {step}"));
    assert_eq!(of("1: "), expected);
}
