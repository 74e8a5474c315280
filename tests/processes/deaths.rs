//! When a process dies in mid-motion: a controller that is terminated or killed, and the master that comes after.
//! The state of the axes is read from the drives themselves.

use std::path::Path;
use std::thread::sleep;
use std::time::Duration;

use libc::{SIGINT, SIGKILL, SIGTERM};

use super::support::controller::{self, RAMP, TARGET, Way, config, summary};
use super::support::onlooker::Onlooker;
use super::support::{Ended, LONG, Machine, Program, drive, role, run, until};
use super::{assert_left, online, simulation};

/// The test that plays the controllers of all others.
const CONTROLLER: &str = "deaths::a_terminated_controller_ramps_down_and_powers_off";

fn controller(way: Way, config: &Path) -> Program {
    controller::start(&mut controller::child(CONTROLLER, way, config))
}

#[test]
fn a_terminated_controller_ramps_down_and_powers_off() {
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
fn the_next_master_stops_axes_that_a_killed_one_left_moving_even_if_it_ends_meanwhile() {
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
fn axes_that_a_killed_controller_left_moving_can_be_left_alone_and_are_named_at_the_end() {
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

/// The executed cycles of a recording, or of a black box, in the tables that `export` makes of it, and the first slot
/// there, executed or skipped; it ends with this code.
fn cycles(machine: &Machine, file: &str, code: i32) -> (Vec<u64>, Option<u64>) {
    let directory = machine.path("tables");
    let _ = std::fs::remove_dir_all(&directory);
    run(["export".as_ref(), machine.path(file).as_os_str(), "--csv".as_ref(), directory.as_os_str()])
        .expect(code);
    let cycle = |line: &str| line.split(',').find_map(|field| field.parse().ok()).unwrap();
    // What has no message has no table.
    let table = |name| std::fs::read_to_string(directory.join(name)).unwrap_or_default();
    let slots = |name| table(name).lines().skip(1).map(cycle).collect::<Vec<u64>>();
    let (executed, skipped) = (slots("cycle.csv"), slots("skipped.csv"));
    let first = executed.first().into_iter().chain(skipped.first()).min().copied();
    (executed, first)
}

/// Kills demos at random instants. Returns by how many cycles each recording ended before its memory.
fn killed_demos(machine: &Machine, count: u64) -> Vec<u64> {
    let kill = |seed| {
        let mut random = fastrand::Rng::with_seed(seed);
        let (recording, boxes) = (machine.path("run.mcap"), machine.path("boxes"));
        let _ = std::fs::remove_file(&recording);
        let _ = std::fs::remove_dir_all(&boxes);
        let arguments = ["demo", "--for", "60s", "--drives", "2", "--period", "2ms", "--record"];
        let arguments = arguments.map(std::ffi::OsString::from).into_iter();
        let arguments =
            arguments.chain([recording.into(), "--black-box".into(), boxes.as_os_str().to_owned()]);
        let demo = Program::start(arguments).leaving_memory();
        assert!(until(LONG, || demo.memory().is_some()), "{}", demo.err());
        sleep(Duration::from_millis(random.u64(100..1_500)));
        let process = demo.pid();
        assert_eq!(demo.end_by(SIGKILL).signal, Some(SIGKILL));
        let list = ["blackbox", "--list", "--json", "--black-box"].map(std::ffi::OsString::from).into_iter();
        let arguments: Vec<_> = list.chain([boxes.into_os_string()]).collect();
        let mut list = run(&arguments);
        // The drives have died, too: its guardian waits for them for some time.
        let is_kept = |list: &Ended| {
            list.err.contains(&format!("process {process} was killed, or crashed, and its guardian"))
        };
        assert!(until(LONG, || {
            list = run(&arguments);
            !is_kept(&list)
        }));
        let files = &list.expect(0).json()["files"];
        let why = format!("process {process} was killed, or crashed; its guardian stopped the drives");
        assert!(files.as_array().is_some_and(|files| files.len() == 1), "{list:?}");
        let is_why = files[0]["why"].as_str().is_some_and(|text| text.starts_with(&why));
        assert!(is_why && files[0]["error"].is_null(), "{list:?}");
        let file = format!("boxes/{}", files[0]["file"].as_str().unwrap());
        let (in_memory, first_in_memory) = cycles(machine, &file, 0);
        let (recorded, first_recorded) = cycles(machine, "run.mcap", 1);
        assert_eq!(files[0]["cycle"], *in_memory.last().unwrap());
        // The file begins with the run, and the memory has all that is not in it any more.
        let whole = [first_in_memory, first_recorded].contains(&Some(0));
        assert!(
            whole && first_in_memory <= Some(recorded.last().map_or(0, |last| last + 1)),
            "{in_memory:?} {recorded:?}"
        );
        in_memory.last().unwrap() - recorded.last().copied().unwrap_or(0)
    };
    (0..count).map(kill).collect()
}

#[test]
fn a_killed_program_has_every_cycle_in_its_recording_or_its_memory() {
    let machine = Machine::new(28);
    println!("cycles in memory only: {:?}", killed_demos(&machine, 4));
}

#[test]
#[ignore = "long, and asks for a host that lets normal threads run"]
fn fifty_killed_programs_leave_recordings_that_end_within_a_tenth_of_a_second() {
    let machine = Machine::new(28);
    let behind = killed_demos(&machine, 50);
    println!("cycles in memory only: {behind:?}");
    // Of 2 ms.
    assert!(behind.iter().all(|cycles| *cycles <= 50), "{behind:?}");
}
