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

/// As a program has it: blocking, while the machine runs in the background.
#[test]
fn several_parameters_are_written_and_read_by_one_call_each() {
    let mut machine = machine(Watchdog { timeout_ns: None, keypad: true, accept_none: false });
    let axis = machine.take_axis(0);
    let _master = machine.into_master(f64::INFINITY).unwrap();
    let parameters = axis.parameter();
    parameters.write_several("20.021", &[12_345, -5, i32::MIN]).unwrap();
    assert_eq!(parameters.read_several::<i32>("20.021", 3), Ok(vec![12_345, -5, i32::MIN]));
    parameters.write_several("20.001", &[-1_i16, 2]).unwrap();
    assert_eq!(parameters.read_several::<i16>("20.001", 2), Ok(vec![-1, 2]));
    // All of a menu that the drive has with 32 bits.
    let many: Vec<i32> = (0..20).collect();
    parameters.write_several("20.021", &many).unwrap();
    assert_eq!(parameters.read_several("20.021", 20), Ok(many));
    let refused = parameters.write_several("01.022", &[1, 600_000]).unwrap_err().to_string();
    assert!(refused.starts_with("drive u: write 01.023 = 60000.0 rpm "), "{refused}");
    assert!(parameters.read_several::<u32>("20.021", 61).is_err());
}
