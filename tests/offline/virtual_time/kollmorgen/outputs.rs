//! Who writes what is in the outputs of a drive: targets that its mode does not follow, its mode, its limits.

use fieldbeat::axis::{Command, Move, NativeOwner, Profile, State, Target};
use fieldbeat::bus::ethercat::{Native, Object};

use super::{Machine, machine_of};

const ACTUAL: Object = Object::new(0x6064, 0);
const TARGET: Object = Object::new(0x607A, 0);

/// A drive with these outputs and keys that stands at 3 turns.
fn machine(outputs: &str, keys: &str) -> Machine {
    let mut machine = machine_of(&format!(
        "[[bus.drive]]\nname = \"k\"\ntype = \"akd\"\nwatchdog = \"100ms\"\npdo.outputs = \
         [{outputs}]\npdo.inputs = [\"0x6041:0\", \"0x6064:0\"]\nlimits = {{ velocity = 50, acceleration = \
         500 }}\nprofile = {{ velocity = 2, acceleration = 20, deceleration = 20 }}\nstop = {{ how = \
         \"ramp\", deceleration = 100 }}\njog_deadman = \"off\"\nsimulate.start = 3.0\n{keys}\n"
    ));
    machine.online();
    machine
}

fn turns(machine: &Machine) -> f64 {
    machine.drive(0, |drive| drive.position()) as f64 / f64::from(1 << 20)
}

fn value(machine: &Machine, object: Object) -> i64 {
    machine.drive(0, |drive| drive.value(object))
}

fn go_to(position: f64) -> Command {
    let profile = Profile { velocity: 2.0, acceleration: 20.0, deceleration: 20.0 };
    Command::Move(Move { target: Target::Absolute(position), profile })
}

/// The drive follows what its mode follows, whatever else is mapped, and in which order.
#[test]
fn a_drive_stays_where_it_is_when_it_is_enabled_and_moves_by_the_target_of_its_mode() {
    for (outputs, mode) in [
        ("\"0x6040:0\", \"0x6071:0\", \"0x607A:0\"", 8),
        ("\"0x6040:0\", \"0x60C1:1\", \"0x607A:0\"", 8),
        ("\"0x6040:0\", \"0x607A:0\", \"0x60C1:1\"", 7),
        ("\"0x6040:0\", \"0x60FF:0\", \"0x6071:0\", \"0x607A:0\", \"0x6060:0\"", 8),
    ] {
        let mut machine = machine(outputs, &format!("mode = {mode}"));
        machine.done(0, Command::Enable);
        for _ in 0..500 {
            machine.run(1);
            assert!((turns(&machine) - 3.0).abs() < 1e-3, "{outputs} {mode}: {}", turns(&machine));
        }
        assert_eq!(machine.feedback(0).status.state, State::OperationEnabled);
        machine.done(0, go_to(3.5));
        machine.run(200);
        assert!((turns(&machine) - 3.5).abs() < 1e-3, "{outputs} {mode}: {}", turns(&machine));
        machine.end_well();
    }
}

/// The targets are the application's: nothing moves until it writes one, and then the drive follows that.
#[test]
fn a_drive_follows_what_the_application_writes_and_stays_where_it_is_before_and_after() {
    const CONTROL: Object = Object::new(0x6040, 0);
    const HALF: i64 = 1 << 19;
    for (mode, owner) in [(8, NativeOwner::Master), (1, NativeOwner::Application)] {
        let mut machine =
            machine("\"0x6040:0\", \"0x607A:0\"", &format!("mode = {mode}\nsetpoints = \"native\""));
        let mut native: Box<Native> = machine.sim.axis(0).native().unwrap();
        machine.done(0, Command::Enable);
        let refused = machine.sim.axis(0).post(go_to(3.5)).map_err(|why| why.to_string());
        assert!(refused.as_ref().is_err_and(|why| why.contains("no position")), "{refused:?}");
        machine.run(200);
        machine.post(0, Command::Native(owner));
        machine.until("native", 100, |_| native.inputs().running);
        machine.run(200);
        assert!((turns(&machine) - 3.0).abs() < 1e-3, "{mode}: {}", turns(&machine));
        assert!((value(&machine, TARGET) - value(&machine, ACTUAL)).abs() < 50, "{mode}");
        let begin = value(&machine, ACTUAL);
        let mut write = |machine: &mut Machine, control: i64, target: i64| {
            let output = native.output(&[(CONTROL, control), (TARGET, target)]).unwrap();
            native.write(output).unwrap();
            machine.run(1);
        };
        if mode == 8 {
            // A turn a second; the control word is the master's.
            (1..=500).for_each(|step| write(&mut machine, 0, begin + HALF * step / 500));
        } else {
            // The handshake of profile position: a new target, and an edge of bit 4.
            [0x0F, 0x1F].into_iter().for_each(|control| write(&mut machine, control, begin + HALF));
        }
        machine.run(1_000);
        assert!((turns(&machine) - 3.5).abs() < 1e-3, "{mode}: {}", turns(&machine));
        machine.done(0, Command::Disable);
        machine.run(200);
        assert!((turns(&machine) - 3.5).abs() < 0.01, "{mode}: {}", turns(&machine));
        assert!((value(&machine, TARGET) - value(&machine, ACTUAL)).abs() < 50, "{mode}");
        machine.end_well();
    }
}
