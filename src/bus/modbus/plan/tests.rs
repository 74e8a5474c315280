use std::time::Duration;

use super::*;
use crate::Master;
use crate::axis::{Command, Failure, Jog, Link, Outcome};
use crate::cycle::{CyclePlan, Plan};
use crate::sim::world::WorldOptions;
use crate::simulation::Simulation;

/// Online, with an exchange every eighth cycle of 1 ms.
fn machine(watchdog: Watchdog) -> Simulation {
    let mut drive = UnidriveDrive::new("u", [192, 168, 1, 21].into());
    (drive.axis.divisor, drive.watchdog) = (8, watchdog);
    drive.axis.jog_deadman = None;
    drive.axis.profile.velocity = 40.0;
    drive.axis.stop.timeout = Duration::from_secs(10);
    assert_eq!(drive.faults(8 * MS), []);
    let bus = ModbusPlan::new(vec![drive]);
    let plan =
        Plan { source: None, cycle: CyclePlan::default(), buses: vec![Box::new(bus)], groups: Vec::new() };
    let mut machine = Master::from_plan(plan).simulate(WorldOptions::default()).unwrap();
    assert!(machine.run_until(10_000, |machine| machine.feedback(0).link == Link::Online));
    machine
}

#[test]
fn what_nothing_would_stop_is_enabled_only_if_that_is_accepted() {
    let none = Watchdog { timeout_ns: None, keypad: false, accept_none: false };
    let enable = |watchdog| machine(watchdog).execute(0, Command::Enable, 5_000).unwrap();
    assert!(matches!(enable(none), Some(Outcome::Failed(Failure::Unsupported(_)))));
    assert_eq!(enable(Watchdog { accept_none: true, ..none }), Some(Outcome::Done));
    assert_eq!(enable(Watchdog { keypad: true, ..none }), Some(Outcome::Done));
    assert_eq!(enable(Watchdog::default()), Some(Outcome::Done));
}

/// For four seconds the reference changes with every exchange, and the keypad watchdog is as short as one.
#[test]
fn the_keypad_watchdog_is_served_on_a_long_ramp_too() {
    let mut machine = machine(Watchdog { timeout_ns: None, keypad: true, accept_none: false });
    assert_eq!(machine.execute(0, Command::Enable, 5_000).unwrap(), Some(Outcome::Done));
    machine.axis(0).post(Command::Jog(Jog { velocity: 40.0, acceleration: 10.0 })).unwrap();
    machine.run(5_000);
    let feedback = machine.feedback(0);
    assert_eq!((feedback.status.fault, feedback.stopped), (0, None), "{feedback:?}");
    assert!((feedback.status.velocity - 40.0).abs() < 1.0, "{feedback:?}");
}

#[test]
fn a_watchdog_shorter_than_the_silence_between_two_requests_is_a_fault() {
    let mut drive = UnidriveDrive::new("u", [192, 168, 1, 21].into());
    let keys = |drive: &UnidriveDrive, period_ns| {
        drive.faults(period_ns).into_iter().map(|fault| fault.key).collect::<Vec<_>>()
    };
    drive.watchdog.timeout_ns = Some(100 * MS);
    drive.reply_within_ns = 80 * MS;
    assert_eq!(keys(&drive, 20 * MS), [""; 0], "what a reply may take, and a period");
    assert_eq!(keys(&drive, 21 * MS), ["watchdog.timeout"]);
    drive.reply_within_ns = 10 * MS;
    assert_eq!(keys(&drive, 50 * MS), [""; 0], "twice a period");
    assert_eq!(keys(&drive, 51 * MS), ["watchdog.timeout"]);
    assert_eq!(keys(&drive, MS), [""; 0]);
    drive.watchdog.keypad = true;
    assert_eq!(keys(&drive, 20 * MS), ["watchdog.keypad"]);
    // In menu 0 control word and reference are one block, which is written with every request.
    drive.via = Via::Menu0 { first: 1 };
    assert_eq!(keys(&drive, 20 * MS), [""; 0]);
}

/// A reply counts for longer than TCP needs to repeat a lost frame, unless the watchdog must be shorter.
#[test]
fn the_usual_time_of_a_reply_follows_the_watchdog() {
    let usual = |timeout_ms: Option<u64>, period_ms: u64| {
        let timeout_ns = timeout_ms.map(|ms| ms * MS);
        let mut drive = UnidriveDrive::new("u", [192, 168, 1, 21].into());
        drive.watchdog.timeout_ns = timeout_ns;
        drive.reply_within_ns = UnidriveDrive::usual_reply_within(&drive.watchdog, period_ms * MS);
        assert_eq!(drive.faults(period_ms * MS), [], "{timeout_ms:?}, {period_ms}");
        (drive.reply_within_ns / MS, drive.describe_loss(period_ms * MS))
    };
    for (timeout_ms, period_ms, within_ms) in
        [(None, 8, 250), (Some(500), 8, 250), (Some(266), 8, 250), (Some(265), 8, 249), (Some(226), 8, 210)]
    {
        let (ms, line) = usual(timeout_ms, period_ms);
        assert_eq!(ms, within_ms, "{timeout_ms:?}");
        assert!(line.contains("the link stays up") && line.contains("leaves 218 ms later"), "{line}");
    }
    for (timeout_ms, period_ms, within_ms, costs) in [
        (
            225,
            8,
            209,
            "reply_within from 210 ms on would wait for it, with a watchdog.timeout from 226 ms on",
        ),
        (225, 8, 209, "one lost frame costs 1 exchange"),
        (170, 8, 154, "one lost frame costs the link"),
        (100, 50, 50, "one lost frame costs the link"),
        (40, 1, 38, "one lost frame costs the link"),
    ] {
        let (ms, line) = usual(Some(timeout_ms), period_ms);
        assert_eq!(ms, within_ms, "{timeout_ms}");
        assert!(line.contains(costs), "{line}");
    }
}
