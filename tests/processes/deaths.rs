//! When somebody dies in mid-motion: a controller that is told to end, killed, or held up, and the master that comes
//! after. What became of the axes is asked of the drives themselves.

use std::path::Path;

use fieldbeat::Master;
use fieldbeat::axis::{AxisError, Failure, Outcome, StopCause};
use libc::{SIGCONT, SIGINT, SIGTERM};

use super::support::controller::{self, LEASH, RAMP, TARGET, VELOCITY, Way, config, summary};
use super::support::onlooker::Onlooker;
use super::support::{LONG, Machine, Program, drive, role};
use super::{assert_left, online, simulation};

/// The test that plays the controllers of all others.
const CONTROLLER: &str = "deaths::a_controller_that_is_told_to_end_ramps_down_and_powers_off";

fn controller(way: Way, config: &Path) -> Program {
    controller::start(&mut controller::child(CONTROLLER, way, config))
}

/// How a command ended that did not end well.
fn outcome(result: Result<(), AxisError>) -> Outcome {
    match result {
        Err(AxisError::Ended { outcome, .. }) => outcome,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_controller_that_is_told_to_end_ramps_down_and_powers_off() {
    if let Some(role) = role() {
        return controller::play(&role);
    }
    let machine = Machine::new(24);
    let config = config(&machine, "m.toml", 2, "", "");
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    for (signal, way) in [(SIGINT, Way::Move), (SIGTERM, Way::Jog)] {
        let controller = controller(way, &config);
        let before = [0, 1].map(|index| onlooker.look(machine.drive(index)));
        controller.signal(signal);
        let summary = summary(&controller.end());
        for (index, before) in before.into_iter().enumerate() {
            let after = onlooker.look(machine.drive(index));
            assert!(before.moving && before.operating && !after.moving && !after.powered, "{after:?}");
            // The whole ramp, and not to the end of the move.
            let way = after.position - before.position;
            assert!(way > 0.9 * RAMP && after.position < TARGET, "{way} mm: {before:?} {after:?}");
            assert_eq!(drive(&summary, &format!("d{index}"))["stopped"], "shutdown");
        }
    }
}

#[test]
fn what_a_killed_controller_left_moving_the_next_master_stops_even_if_it_is_ended_meanwhile() {
    let machine = Machine::new(25);
    let config = config(&machine, "m.toml", 2, "", "");
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    controller(Way::Move, &config).kill();
    let left = [0, 1].map(|index| onlooker.look(machine.drive(index)));
    onlooker.await_sight(machine.drive(0), |sight| sight.position > left[0].position + 10.0);
    let next = online(&config, &["--json"]);
    // Down its ramp, most likely.
    let found = [0, 1].map(|index| onlooker.look(machine.drive(index)));
    next.signal(SIGINT);
    let ended = next.end();
    ended.expect(0);
    for index in 0..2 {
        let (left, found) = (left[index], found[index]);
        assert!(left.operating && left.moving && found.position > left.position + 5.0, "{left:?} {found:?}");
        let after = onlooker.look(machine.drive(index));
        assert!(!after.moving && !after.powered, "{after:?}");
        assert!(after.position > left.position + 0.9 * RAMP && after.position < TARGET, "{left:?} {after:?}");
        let summary = ended.json();
        let drive = drive(&summary, &format!("d{index}"));
        assert_eq!(
            (&drive["stopped"], &drive["at_end"]["condition"]),
            (&"found running".into(), &"off".into())
        );
    }
}

#[test]
fn a_jog_of_a_killed_controller_ends_with_its_leash_and_the_next_master_powers_it_off_and_latches() {
    let machine = Machine::new(26);
    let config = config(&machine, "m.toml", 1, "", "");
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    controller(Way::Jog, &config).kill();
    let left = onlooker.look(machine.drive(0));
    let end = onlooker.await_sight(machine.drive(0), |sight| !sight.moving);
    // The actual position is behind the demand, from which the leash is measured.
    assert!(end.operating && end.position <= left.position + LEASH + 1.0, "{left:?} {end:?}");

    let next = Master::from_file(&config).unwrap().start().unwrap();
    next.wait_online(LONG).unwrap();
    let mut axis = next.axis("d0").unwrap();
    let latched = Outcome::Failed(Failure::Latched(StopCause::FoundRunning));
    assert_eq!(axis.feedback().stopped, Some(StopCause::FoundRunning));
    assert_eq!(outcome(axis.enable()), latched);
    onlooker.await_sight(machine.drive(0), |sight| !sight.powered);
    assert_eq!(outcome(axis.enable()), latched, "also when it is down");
    assert!(!onlooker.look(machine.drive(0)).powered);
    // Then it is an axis like any other; the drive has kept its reference.
    axis.reset().unwrap();
    axis.enable().unwrap();
    assert!(axis.feedback().status.homed);
    axis.move_to(end.position + 1.0, axis.profile()).unwrap();
}

#[test]
fn what_a_killed_controller_left_moving_can_be_left_alone_until_somebody_decides() {
    let machine = Machine::new(27);
    let config = config(&machine, "m.toml", 2, "", "on_found_running = \"refuse\"");
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    controller(Way::Move, &config).kill();
    let left = onlooker.look(machine.drive(0));

    // A master that comes and goes.
    let next = online(&config, &["--json"]);
    let found = onlooker.look(machine.drive(0));
    next.signal(SIGINT);
    let ended = next.end();
    assert_left(
        &ended,
        &["drive d0 still moves at the end", "drive d1 still moves", "on_found_running = \"refuse\""],
    );
    let alone = onlooker.look(machine.drive(0));
    for sight in [left, found, alone] {
        assert!(sight.operating && sight.moving, "{sight:?}");
    }
    assert!(
        left.position < found.position && found.position < alone.position,
        "{left:?} {found:?} {alone:?}"
    );
    let summary = ended.json();
    assert_eq!(
        (&drive(&summary, "d0")["stopped"], &drive(&summary, "d0")["link"]),
        (&"found running".into(), &"online".into())
    );

    // One whose application decides, for one of the two.
    let next = Master::from_file(&config).unwrap().start().unwrap();
    next.wait_online(LONG).unwrap();
    let mut axes = ["d0", "d1"].map(|name| next.axis(name).unwrap());
    let latched = Outcome::Failed(Failure::Latched(StopCause::FoundRunning));
    for axis in &mut axes {
        assert_eq!(outcome(axis.enable()), latched);
    }
    assert!(onlooker.look(machine.drive(0)).moving);
    axes[0].stop().unwrap();
    let stopped = onlooker.look(machine.drive(0));
    assert!(stopped.operating && !stopped.moving && stopped.position < TARGET, "{stopped:?}");
    axes[0].disable().unwrap();
    assert!(!onlooker.look(machine.drive(0)).powered);
    drop(next);
    let other = onlooker.look(machine.drive(1));
    assert!(other.operating && other.moving, "{other:?}");
}

/// Ctrl-Z, a debugger, a virtual machine that is moved: the drives run on meanwhile.
#[test]
fn a_controller_that_was_held_up_in_mid_motion_stops_its_axes_as_each_of_them_shall() {
    let machine = Machine::new(30);
    let config = config(&machine, "m.toml", 2, "max_skip = \"1s\"", "");
    let text = std::fs::read_to_string(&config).unwrap();
    let config =
        machine.write("m.toml", text.replace("name = \"d1\"", "name = \"d1\"\nstop.then = \"hold\""));
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    let mut controller = controller(Way::Move, &config);
    controller.hold();
    let before = [0, 1].map(|index| onlooker.look(machine.drive(index)));
    // The way of two seconds.
    let far = before[0].position + 2.0 * VELOCITY;
    onlooker.await_sight(machine.drive(0), |sight| sight.position > far);
    let meanwhile = [0, 1].map(|index| onlooker.look(machine.drive(index)));
    controller.signal(SIGCONT);
    for name in ["d0", "d1"] {
        controller.await_text(&format!("axis {name}: enable failed: the axis is stopped (overrun)"));
    }
    for index in 0..2 {
        let (before, meanwhile) = (before[index], meanwhile[index]);
        assert!(meanwhile.moving && meanwhile.position > before.position + 20.0, "{before:?} {meanwhile:?}");
        let after = onlooker
            .await_sight(machine.drive(index), |sight| !sight.moving && sight.powered == (index == 1));
        assert!(after.operating == (index == 1) && after.position < TARGET, "{after:?}");
        assert!(after.position > meanwhile.position + 0.9 * RAMP, "{meanwhile:?} {after:?}");
    }
    // Its end powers off what it held.
    controller.signal(SIGTERM);
    let summary = summary(&controller.end());
    for index in 0..2 {
        assert!(!onlooker.look(machine.drive(index)).powered);
        assert_eq!(drive(&summary, &format!("d{index}"))["stopped"], "overrun");
    }
}
