//! Who writes what is in the outputs of a drive: targets that its mode does not follow, its mode, its limits.

use fieldbeat::axis::{Command, Move, NativeOwner, Outcome, Profile, State, Target};
use fieldbeat::bus::ethercat::{Native, Object};
use fieldbeat_ethercat::mode::Mode;

use super::foreign::machine_of;
use super::{Machine, jog};

const ACTUAL: Object = Object::new(0x6064, 0);
const TARGET: Object = Object::new(0x607A, 0);
const INTERPOLATION: Object = Object::new(0x60C1, 1);

/// A drive with these outputs and keys that stands at 3 turns.
fn machine(outputs: &str, keys: &str) -> Machine {
    let mut machine = machine_of(&format!(
        "[[bus.drive]]\nname = \"k\"\ntype = \"akd\"\nwatchdog = \"100ms\"\npdo.outputs = [{outputs}]\n\
         pdo.inputs = [\"0x6041:0\", \"0x6064:0\"]\nlimits = {{ velocity = 50, acceleration = 500 }}\n\
         profile = {{ velocity = 2, acceleration = 20, deceleration = 20 }}\n\
         stop = {{ how = \"ramp\", deceleration = 100 }}\njog_deadman = \"off\"\nsimulate.start = 3.0\n{keys}\n"
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

/// Before it is enabled, while it turns by another target, and after a stop.
#[test]
fn a_target_that_the_mode_does_not_follow_is_the_actual_position() {
    let mut machine = machine(
        "\"0x6040:0\", \"0x60FF:0\", \"0x607A:0\", \"0x60C1:1\"",
        "mode = 3\nno_drive_watchdog = \"accept\"",
    );
    // A cycle or two old.
    let follows = |machine: &Machine, most: i64, when: &str| {
        for target in [TARGET, INTERPOLATION] {
            let behind = value(machine, ACTUAL) - value(machine, target);
            assert!(behind.abs() <= most, "{when}: {target} is {behind} counts behind");
        }
    };
    machine.run(20);
    follows(&machine, 50, "before it is enabled");
    machine.done(0, Command::Enable);
    machine.post(0, jog(2.0));
    machine.run(500);
    // 2 turns/s are 2097 counts a cycle.
    follows(&machine, 4 * 2_200, "while it turns");
    machine.assert_turns(0, 2.0);
    machine.done(0, super::STOP);
    machine.run(500);
    follows(&machine, 50, "after a stop");
    machine.done(0, Command::Disable);
    machine.run(100);
    follows(&machine, 50, "disabled");
}

#[test]
fn mapped_limits_are_those_of_the_drive_or_configured_ones() {
    let limits = [(0x6072, 3_000), (0x60E0, 3_000), (0x60E1, 3_000), (0x607F, 6_000_000), (0x6080, 6_000)];
    let outputs: Vec<String> = [0x6040, 0x607A]
        .into_iter()
        .chain(limits.map(|(index, _)| index))
        .map(|index| format!("\"{index:#06x}:0\""))
        .collect();
    let outputs = outputs.join(", ");
    let moves = |machine: &mut Machine| {
        machine.done(0, Command::Enable);
        machine.ended(0, go_to(3.5))
    };
    let mut own = machine(&outputs, "");
    assert_eq!(moves(&mut own), Outcome::Done);
    for (index, delivered) in limits {
        assert_eq!(value(&own, Object::new(index, 0)), delivered, "{index:#06x}");
    }
    let mut configured = machine(&outputs, "start_up = [{ object = \"0x60E0:0\", value = 700 }]");
    assert_eq!(moves(&mut configured), Outcome::Done);
    assert_eq!(value(&configured, Object::new(0x60E0, 0)), 700);
    assert_eq!(value(&configured, Object::new(0x60E1, 0)), 3_000);
    // The simulated drive obeys them: with one of 0 it does not move.
    for index in [0x6072, 0x60E1, 0x607F, 0x6080] {
        let zero = format!("start_up = [{{ object = \"{index:#06x}:0\", value = 0 }}]");
        let mut still = machine(&outputs, &zero);
        let _ = moves(&mut still);
        assert!((turns(&still) - 3.0).abs() < 0.01, "{index:#06x}: {}", turns(&still));
    }
}

#[test]
fn a_mode_in_the_outputs_is_that_of_homing_for_a_homing_only() {
    let mut machine = machine("\"0x6040:0\", \"0x607A:0\", \"0x6060:0\"", "home_method = 35");
    let mode = |machine: &Machine| machine.drive(0, |drive| drive.mode());
    machine.done(0, Command::Enable);
    assert_eq!(mode(&machine), Mode::CYCLIC_POSITION);
    machine.post(0, Command::Home);
    machine.until("the mode of homing", 1_000, |machine| mode(machine) == Mode::HOMING);
    machine.until("home", 2_000, |machine| machine.feedback(0).status.homed);
    machine.until("its own mode", 1_000, |machine| mode(machine) == Mode::CYCLIC_POSITION);
    machine.done(0, go_to(0.25));
    machine.run(200);
    assert!((turns(&machine) - 0.25).abs() < 1e-3, "{}", turns(&machine));
    machine.end_well();
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
