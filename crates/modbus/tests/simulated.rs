//! The watchdogs of simulated drives, in virtual time.

use std::time::Duration;

use fieldbeat_core::axis::{Command, Jog, Link, Outcome};
use fieldbeat_core::cycle::{CyclePlan, Plan};
use fieldbeat_core::time::MS;
use fieldbeat_master::Master;
use fieldbeat_master::simulation::Simulation;
use fieldbeat_modbus::{ModbusPlan, UnidriveDrive, Watchdog};
use fieldbeat_sim::WorldOptions;

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
