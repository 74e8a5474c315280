//! Drives that report their speed and no position: what is reported of them.

use fieldbeat::Granted;
use fieldbeat::telemetry::Measured;
use serde_json::{Value, json};

use super::*;

#[test]
fn the_summary_holds_what_there_is_and_makes_nothing_of_what_there_is_not() {
    let mut b = Bench::new(2, VIAS[1], |_, _| {});
    assert!(b.sim.world().unplug(address(1)));
    b.until("online", 2_000, |b| b.feedback(0).link == Link::Online);
    // Each fifth reply is a refusal: it is busy.
    let mut replies = 0;
    b.tap(0).reply = Some(Box::new(move |reply| {
        replies += 1;
        if replies % 5 == 0 {
            refuse(reply, 6);
        }
    }));
    b.run(1_000);
    b.tap(0).drive.provoke(Trip::OVER_VOLTS);
    b.run(100);
    let buses: Vec<Box<dyn BusPlan>> = vec![Box::new(b.plan.clone())];
    let plan = Plan { source: None, cycle: CyclePlan::default(), buses, groups: Vec::new() };
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
