//! Drives that report their speed and no position: what holds for them all the same, and what is reported of them.

use std::sync::atomic::{AtomicU64, Ordering};

use fieldbeat::Granted;
use fieldbeat::axis::{EventKind, Group, Move, Target};
use fieldbeat::sim::World;
use fieldbeat::telemetry::{Measured, Summary};
use fieldbeat_core::cycle::engine::Control;
use fieldbeat_master::{Assembly, assemble};
use serde_json::{Value, json};

use super::*;

fn bench(count: usize) -> Bench {
    Bench::new(count, VIAS[1], |_, drive| {
        drive.axis.limits.velocity = Some(10.0);
        drive.axis.stop.group = Some(0);
    })
}

fn go(target: Target) -> Command {
    Command::Move(Move { target, profile: drive(0, VIAS[1]).axis.profile })
}

fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: 80.0 })
}

#[test]
fn a_group_refuses_positions_to_all_its_members() {
    let mut b = bench(2);
    b.ready();
    let mut group = Group::new(vec![b.sim.take_axis(0), b.sim.take_axis(1)]).unwrap();
    let error = group.post(&[jog(1.0), go(Target::Relative(5.0))]).unwrap_err();
    assert!(error.to_string().contains("speeds"), "{error}");
    b.run(20);
    for place in 0..2 {
        let ended = std::iter::from_fn(|| group.event(place))
            .any(|event| matches!(event.kind, EventKind::Ended { .. }));
        assert!(!ended && !b.feedback(place).status.moving, "{place}");
    }
}

/// Each fifth reply is a refusal, once the drive is connected; how many there were.
fn refuse_some(tap: &Tap) -> Arc<AtomicU64> {
    let refusals = Arc::new(AtomicU64::new(0));
    let (mut replies, counted) = (0, refusals.clone());
    tap.lock().reply = Some(Box::new(move |reply| {
        replies += 1;
        if replies > 200 && replies % 5 == 0 {
            // It is busy.
            *reply = [&reply[..5], &[3, reply[6], reply[7] | function::EXCEPTION, 6]].concat();
            counted.fetch_add(1, Ordering::Relaxed);
        }
    }));
    refusals
}

fn plan(b: &Bench) -> Plan {
    let bus = Box::new(b.plan.clone());
    Plan { source: None, cycle: CyclePlan::default(), buses: vec![bus], groups: Vec::new() }
}

#[test]
fn what_a_protocol_counts_of_its_own_is_exact_without_any_telemetry() {
    let b = bench(3);
    let plan = plan(&b);
    let refusals: Vec<_> = b.taps[..2].iter().map(refuse_some).collect();
    let world = World::new(simulated(&b.taps), WorldOptions { seed: 3, ..WorldOptions::default() }).unwrap();
    let Assembly { mut engine, gauges, .. } =
        assemble(&plan, world.clock(), &world, None, Control::default()).unwrap();
    engine.begin();
    // Nobody takes the records: the ring is full after a second.
    while engine.status().planned < 3_000 {
        engine.step();
    }
    assert!(engine.status().lost_records > 5_000);
    let read: Vec<u64> = gauges.axes.iter().map(|gauge| gauge.numbers.read().counters.own[0]).collect();
    let end = engine.finish();
    for (index, drive) in end.drives.iter().enumerate() {
        let counted = drive.counters.own[Own::Exceptions as usize];
        let expected = refusals.get(index).map_or(0, |refusals| refusals.load(Ordering::Relaxed));
        // The last one may be on its way.
        assert!(expected >= counted && expected <= counted + 1, "{counted} of {expected}");
        assert!(read[index] <= counted && read[index] + 64 >= counted, "{read:?} {counted}");
        assert_eq!(expected > 500, index < 2);
    }
}

#[test]
fn the_summary_holds_what_there_is_and_makes_nothing_of_what_there_is_not() {
    let mut b = bench(2);
    assert!(b.sim.world().unplug(address(1)));
    b.until("online", 2_000, |b| b.feedback(0).link == Link::Online);
    refuse_some(&b.taps[0]);
    b.run(1_000);
    b.tap(0).drive.provoke(Trip::OVER_VOLTS);
    b.run(100);
    let plan = plan(&b);
    let mut end = b.finish();
    end.drives[1].feedback.status.fault = 0xABC;
    let granted =
        Granted { policy: "SCHED_OTHER", priority: 0, core: None, memory_locked: false, missing: Vec::new() };
    let summary = Summary::of(&plan, &end, &Measured::new(&plan.units(), &plan.cycle, false), &granted, None);
    let object = serde_json::to_value(&summary).unwrap();
    let of = |key: &str| [0, 1].map(|index: usize| object["drives"][index][key].clone());
    assert_eq!(of("position"), [Value::Null, Value::Null]);
    let refusals = end.drives[0].counters.own[Own::Exceptions as usize];
    assert!(refusals > 10);
    assert_eq!(of("protocol_counters").map(|own| own["exceptions"].clone()), [json!(refusals), json!(0)]);
    let why = end.drives[1].not_connected.clone().expect("nobody is there");
    assert_eq!(of("not_connected"), [Value::Null, json!(why)]);
    let (trip, name) = (Trip::OVER_VOLTS.0, Trip::OVER_VOLTS.name().unwrap());
    assert_eq!(of("fault"), [json!(trip), json!(2748)]);
    assert_eq!(of("fault_name"), [json!(name), Value::Null]);
    let text = summary.to_string();
    for part in [
        format!("\nu0    requests refused by an exception: {refusals}\n"),
        format!("  fault 0x{trip:04x} ({trip}, {name})\n"),
        format!("\n  fault 0x0abc (2748)\n  not connected: {why}\n"),
    ] {
        assert!(text.contains(&part), "no {part:?}: {text}");
    }
    assert!(!text.contains("NaN") && !object.to_string().contains("NaN"), "{text}");
}
