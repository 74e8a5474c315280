//! Who writes what is in the outputs of a drive: targets that its mode does not follow, its mode, its limits.

use fieldbeat::axis::{Command, Move, Profile, State, Target};

use super::{Machine, machine_of};

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
