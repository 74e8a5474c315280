//! What the loop counts stays true whatever becomes of its records.

use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::cycle::engine::Control;
use fieldbeat::cycle::record::{Record, Stage};
use fieldbeat::cycle::status::Numbers;
use fieldbeat::cycle::{CyclePlan, Plan};
use fieldbeat::master::{Assembly, assemble};
use fieldbeat::sim::FaultPlan;
use fieldbeat::sim::world::{World, WorldOptions};
use fieldbeat::telemetry::causes::Cause;
use fieldbeat::telemetry::{Measured, Quantiles};
use fieldbeat::time::{MS, US};

use super::support::{Rig, drive};

const CYCLES: u64 = 5_000;

/// A machine whose drives and sleeps are disturbed by seeds; `telemetry` gets the records, or nobody does.
fn run(mut telemetry: Option<&mut Measured>) -> Numbers {
    let drives = (0..3).map(|index| {
        let mut drive = drive(index);
        drive.simulate.faults =
            FaultPlan { seed: index as u64, drop: 0.02, delay: 0.02, ..FaultPlan::default() };
        drive
    });
    let bus = LinUdpPlan::new([127, 0, 0, 1].into(), drives.collect());
    let plan = Plan {
        source: None,
        cycle: cycle(),
        buses: vec![Box::new(bus) as Box<dyn BusPlan>],
        groups: Vec::new(),
    };
    let options = WorldOptions { seed: 7, wake_ns: 260 * US, ..WorldOptions::default() };
    let world = World::new(plan.simulate(), options).unwrap();
    let Assembly { mut engine, mut records, .. } =
        assemble(&plan, world.clock(), &world, None, Control::default()).unwrap();
    engine.begin();
    while engine.status().planned < CYCLES {
        engine.step();
        if let Some(measured) = &mut telemetry {
            while let Ok(record) = records.pop() {
                measured.enter(&record);
            }
        }
    }
    engine.finish()
}

fn cycle() -> CyclePlan {
    CyclePlan { late_ns: Some(100 * US), receive_deadline: 0.4, ..CyclePlan::default() }
}

#[test]
fn records_that_nobody_takes_cost_detail_and_no_truth() {
    let mut measured = Measured::new(3, &cycle(), false);
    let mut taken = run(Some(&mut measured));
    let mut lost = run(None);
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
    let causes = measured.causes.ranked();
    assert_eq!(causes.iter().map(|tally| tally.count).sum::<u64>(), status.late);
    assert!(
        causes.iter().any(|tally| matches!(tally.cause, Cause::Drive(_)) && tally.count > 10),
        "{causes:?}"
    );
}

#[test]
fn a_cycle_is_late_by_its_own_threshold_and_an_in_loop_task_by_its_stage() {
    let mut rig = Rig::new(1).cycle(|cycle| cycle.late_ns = Some(100 * US));
    rig.options.wake_ns = 0;
    let world = std::sync::Arc::new(std::sync::Mutex::new(None::<World>));
    let inside = std::sync::Arc::clone(&world);
    let rig = rig.task(move |cycle, _| {
        let ns = match cycle.index {
            200 => 90 * US,
            300 => 110 * US,
            _ => return,
        };
        inside.lock().unwrap().as_ref().unwrap().advance(ns);
    });
    let mut b = rig.start();
    *world.lock().unwrap() = Some(b.world());
    b.run(400);
    assert_eq!(b.status().late, 1);
    let peak = b.status().stage_max[Stage::Exchange as usize];
    assert!(peak.index == 300 && peak.ns >= 110 * US, "{peak:?}");
}

#[test]
fn each_drive_has_a_record_in_each_cycle_and_its_cycle_comes_last() {
    let bus = LinUdpPlan::new([127, 0, 0, 1].into(), (0..3).map(drive).collect());
    let plan = Plan {
        source: None,
        cycle: cycle(),
        buses: vec![Box::new(bus) as Box<dyn BusPlan>],
        groups: Vec::new(),
    };
    let world = World::new(plan.simulate(), WorldOptions::default()).unwrap();
    let Assembly { mut engine, mut records, .. } =
        assemble(&plan, world.clock(), &world, None, Control::default()).unwrap();
    engine.begin();
    for index in 0..50 {
        engine.step();
        let told: Vec<Record> = std::iter::from_fn(|| records.pop().ok()).collect();
        let [Record::Drive(a), Record::Drive(b), Record::Drive(c), Record::Cycle(cycle)] = told[..] else {
            panic!("{told:?}")
        };
        assert_eq!([a.index, b.index, c.index, cycle.index], [index; 4]);
        assert_eq!([a.axis, b.axis, c.axis], [0, 1, 2]);
    }
}
