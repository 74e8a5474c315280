//! When a process dies in mid-motion: a controller that is told to end or killed, and the master that comes after.
//! What became of the axes is asked of the drives themselves.

use std::path::Path;

use libc::{SIGINT, SIGTERM};

use super::support::controller::{self, RAMP, TARGET, Way, config, summary};
use super::support::onlooker::Onlooker;
use super::support::{Machine, Program, drive, role};
use super::{assert_left, online, simulation};

/// The test that plays the controllers of all others.
const CONTROLLER: &str = "deaths::a_controller_that_is_told_to_end_ramps_down_and_powers_off";

fn controller(way: Way, config: &Path) -> Program {
    controller::start(&mut controller::child(CONTROLLER, way, config))
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
    let ended = next.end_by(SIGINT);
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
fn what_a_killed_controller_left_moving_can_be_left_alone_and_is_named_at_the_end() {
    let machine = Machine::new(27);
    let config = config(&machine, "m.toml", 2, "", "on_found_running = \"refuse\"");
    let _sim = simulation(&config);
    let onlooker = Onlooker::new(&machine);
    controller(Way::Move, &config).kill();
    let left = onlooker.look(machine.drive(0));
    let next = online(&config, &["--json"]);
    let found = onlooker.look(machine.drive(0));
    let ended = next.end_by(SIGINT);
    assert_left(
        &ended,
        &["drive d0 still moves at the end", "drive d1 still moves", "on_found_running = \"refuse\""],
    );
    let alone = onlooker.look(machine.drive(0));
    let sights = [left, found, alone];
    assert!(sights.iter().all(|sight| sight.operating && sight.moving), "{sights:?}");
    assert!(sights.is_sorted_by(|a, b| a.position < b.position), "{sights:?}");
    let summary = ended.json();
    assert_eq!(
        (&drive(&summary, "d0")["stopped"], &drive(&summary, "d0")["link"]),
        (&"found running".into(), &"online".into())
    );
}
