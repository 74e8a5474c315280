//! Soak tests in virtual time: axes that move by their patterns, drives that are lost, and a day of it all.

mod random;

use std::path::Path;

use fieldbeat::axis::{Link, StopCause};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::Summary;
use fieldbeat::time::{MS, S};
use fieldbeat::{Master, Simulation};
use fieldbeat_config::soak::SoakPlan;
use fieldbeat_record::archive::Archive;
use fieldbeat_sim::modbus::{Start, UnidriveSettings, UnidriveSim};
use fieldbeat_soak::Soak;
use fieldbeat_soak::criteria::{Judged, judge};
use fieldbeat_soak::directory::page;
use fieldbeat_soak::progress::{AxisProgress, Progress};

/// Two LinMots, one of which follows a sine, and a Unidrive; so many ms a cycle.
fn machine(period_ms: u64, soak: &str) -> String {
    format!(
        r#"
[cycle]
period = "{period_ms}ms"
[[bus]]
protocol = "linudp-v2"
bind = "127.0.0.1"
[[bus.drive]]
name = "x"
address = "127.0.0.10"
limits = {{ position = [0, 400], velocity = 500, acceleration = 5000 }}
[[bus.drive]]
name = "y"
address = "127.0.0.11"
limits = {{ position = [0, 400], velocity = 500, acceleration = 5000 }}
[[bus]]
protocol = "modbus-tcp"
[[bus.drive]]
name = "u"
address = "127.0.0.20"
limits = {{ velocity = 20 }}
{soak}
"#
    )
}

const SINE: &str = r#"
[[soak.axis]]
drive = "y"
sine = { centre = 100, amplitude = 40, period = "2s" }
following_error = 5
"#;

/// A test on a machine in virtual time.
struct Test {
    machine: Simulation,
    plan: SoakPlan,
    soak: Soak,
    progress: Progress,
    period_ns: u64,
}

impl Test {
    fn begin(text: &str, progress: Progress) -> Test {
        Test::tripped(text, progress, None)
    }

    /// The Unidrive has this trip.
    fn tripped(text: &str, progress: Progress, trip: Option<u16>) -> Test {
        Test::started(text, progress, trip.map(Start::Tripped))
    }

    /// The Unidrive is found so.
    fn started(text: &str, progress: Progress, start: Option<Start>) -> Test {
        let Configuration { plan, simulation, soak: soaked } = parse(text, "soak.toml").unwrap();
        let period_ns = plan.cycle.period_ns;
        let setup = Master::from_plan(plan).with_simulation(simulation);
        let mut simulated = setup.simulation().build();
        if let (Some(start), Some(drive)) = (start, simulated.drives.last_mut()) {
            // Its master had set it up.
            let commissioned = vec![([6, 43], 1)];
            let settings = UnidriveSettings::new(drive.address());
            *drive = Box::new(UnidriveSim::new(UnidriveSettings { commissioned, start, ..settings }));
        }
        let mut machine = setup.simulate_with(simulated, WorldOptions::default()).unwrap();
        let axes = (0..soaked.axes.len()).map(|index| machine.take_axis(index)).collect();
        let mut soak = Soak::new(&soaked, axes, period_ns);
        if !progress.processes.is_empty() {
            soak = soak.after_pause(&progress, machine.plan().silence_faults());
        }
        let mut test = Test { machine, plan: soaked, soak, progress, period_ns };
        test.progress.begin();
        test
    }

    fn new(text: &str, length_ns: u64) -> Test {
        Test::begin(text, Progress::new(text.to_owned(), length_ns))
    }

    fn now(&self) -> u64 {
        self.machine.status().planned * self.period_ns
    }

    /// Lets so much machine time pass. Looks after the axes fifty times a second.
    fn run(&mut self, ns: u64) -> Vec<String> {
        let (end, mut lines) = (self.now() + ns, Vec::new());
        while self.now() < end {
            self.machine.run((20 * MS / self.period_ns).max(1));
            lines.extend(self.soak.step(self.now()));
        }
        lines
    }

    fn checkpoint(&mut self) -> Progress {
        self.progress.sample(self.now());
        self.progress.with(&archive(&self.machine), &self.soak)
    }

    fn finish(mut self) -> (Progress, Vec<Judged>) {
        self.soak.end();
        for _ in 0..60 {
            self.run(S);
            if self.soak.has_ended() {
                break;
            }
        }
        assert!(self.soak.has_ended());
        for index in 0..self.plan.axes.len() {
            assert!(!self.machine.feedback(index).status.state.is_powered(), "axis {index}");
        }
        let progress = self.checkpoint();
        let judged = judge(&self.plan, &progress, true);
        (progress, judged)
    }
}

/// What a machine has done so far.
fn archive(machine: &Simulation) -> Archive {
    Archive::of(machine.plan(), &machine.numbers(), machine.measured(), &Summary::from(machine))
}

fn failed(judged: &[Judged]) -> Vec<String> {
    judged.iter().filter(|one| !one.passed).map(Judged::line).collect()
}

/// Descriptors and memory of the test program are those of its other tests too.
const ALONE: &str = "[soak.criteria]\nmemory_growth = 1e9\ndescriptor_growth = 1e9\n";

#[test]
fn axes_move_by_their_patterns_and_a_test_that_goes_on_adds_up() {
    let text = machine(4, &format!("{SINE}{ALONE}"));
    let mut test = Test::new(&text, 120 * S);
    assert_eq!(test.run(60 * S), Vec::<String>::new());
    let killed = test.checkpoint();
    let moves: Vec<u64> = killed.axes.iter().map(|axis| axis.cycles).collect();
    // x: 80 mm at 100 mm/s and a pause of half a second; y: a swing in 2 s; u: a velocity each 2 s.
    assert!((30..=45).contains(&moves[0]) && moves[1] > 20 && moves[2] > 20, "{moves:?}");
    let positions = |of: usize| {
        let stretches = killed.run.as_ref().unwrap().drives[of].motion.stretches().iter();
        let bands = stretches.filter_map(|moved| moved.position()).skip(400);
        bands.fold((f32::MAX, f32::MIN), |(low, high), band| (low.min(band.low), high.max(band.high)))
    };
    let ((x_low, x_high), (y_low, y_high)) = (positions(0), positions(1));
    assert!((159.0..161.0).contains(&x_low) && (239.0..241.0).contains(&x_high), "{x_low} {x_high}");
    assert!((59.0..62.0).contains(&y_low) && (138.0..141.0).contains(&y_high), "{y_low} {y_high}");

    // Killed there, and resumed from what was written.
    let written = serde_json::to_string(&killed).unwrap();
    let read: Progress = serde_json::from_str(&written).unwrap();
    assert_eq!(read.left_ns(), 60 * S);
    let mut test = Test::begin(&text, read);
    assert_eq!(test.run(60 * S), Vec::<String>::new());
    let (progress, judged) = test.finish();
    assert_eq!(failed(&judged), Vec::<String>::new());
    let run = progress.run.as_ref().unwrap();
    assert!(run.length_ns() >= 120 * S && run.wake.bins.count() == run.counts.planned);
    assert_eq!(progress.processes.len(), 2);
    assert_eq!(progress.processes[1].from_ns, 60 * S);
    assert!(progress.axes[0].cycles >= 2 * moves[0] - 2, "{:?}", progress.axes);
    // The page and the file that a later test is compared with.
    let html = page(&progress, &judged, &[("before".to_owned(), run.clone())], &[], None);
    assert!(html.contains("in 2 processes") && html.contains("Compared with before"));
    Archive::parse(&run.to_json(), Path::new("run.json")).unwrap();
}

#[test]
fn a_trip_of_a_pause_is_reset_but_no_other_one_and_an_axis_that_was_given_up_stays_as_it_is() {
    let text = machine(4, ALONE);
    let silent = "axis u: resets what the pause caused: 0x00fc";
    let gives_up = "axis u: moves no longer: axis u: enable failed: the drive reports fault ";
    let stays = "axis u: moves no longer, as before the pause: stopped: drive fault";
    let left = Some("stopped: drive fault");
    for (trip, given_up, line) in
        [(252, None, silent), (20, None, gives_up), (252, left, stays), (0, left, stays)]
    {
        let mut before = Progress::new(text.clone(), 60 * S);
        before.begin();
        before.axes = vec![AxisProgress { moves: true, ..AxisProgress::default() }; 3];
        before.axes[2].given_up = given_up.map(str::to_owned);
        let mut test = Test::tripped(&text, before, Some(trip).filter(|trip| *trip > 0));
        let lines = test.run(20 * S);
        assert!(matches!(&lines[..], [only] if only.starts_with(line)), "{trip}: {lines:?}");
        let is_reset = line == silent;
        let fault = test.machine.feedback(2).status.fault;
        assert_eq!(fault, if is_reset { 0 } else { u32::from(trip) });
        let u = &test.checkpoint().axes[2];
        assert_eq!((u.cycles > 2, u.faults_of_pauses), (is_reset, u64::from(is_reset)), "{trip}: {u:?}");
    }
}

/// It stands through the pause: nobody has reset it.
#[test]
fn a_fault_that_a_test_goes_on_with_counts_once_and_so_does_its_stop() {
    let text = machine(4, ALONE);
    let mut test = Test::tripped(&text, Progress::new(text.clone(), 60 * S), Some(20));
    assert_eq!(test.run(20 * S).len(), 1);
    let mut progress = test.checkpoint();
    let of = |test: &Test, progress: &Progress| {
        let judged = judge(&test.plan, progress, false);
        let counts = judged.iter().filter(|one| ["faults", "stops", "given_up"].contains(&one.criterion));
        counts.map(Judged::line).collect::<Vec<_>>()
    };
    let first = of(&test, &progress);
    assert!(first.contains(&"faults: 1, at most 0; u".to_owned()), "{first:?}");
    for _ in 0..2 {
        let mut test = Test::tripped(&text, progress, Some(20));
        let lines = test.run(20 * S);
        assert!(matches!(&lines[..], [only] if only.contains("as before the pause")), "{lines:?}");
        progress = test.checkpoint();
        assert_eq!(of(&test, &progress), first);
    }
    // Another one is a fault of the test, whoever it stops.
    let mut test = Test::tripped(&text, progress, Some(21));
    test.run(20 * S);
    let progress = test.checkpoint();
    let other = of(&test, &progress);
    assert!(other.contains(&"faults: 2, at most 0; u".to_owned()), "{other:?}");
}

/// A killed test leaves its drives running, and the first of them to be seen so stops its group. A stop in motion is
/// one of the test.
#[test]
fn a_group_moves_in_spite_of_a_drive_that_is_found_running_and_not_after_one_was_lost() {
    let grouped = machine(4, ALONE).replace("limits =", "stop.group = \"all\"\nlimits =");
    let mut before = Progress::new(grouped.clone(), 60 * S);
    before.begin();
    before.axes = vec![AxisProgress { moves: true, ..AxisProgress::default() }; 3];
    let mut test = Test::started(&grouped, before, Some(Start::Running(60.0)));
    assert_eq!(test.run(30 * S), Vec::<String>::new());
    let progress = test.checkpoint();
    assert_eq!(failed(&judge(&test.plan, &progress, false)), Vec::<String>::new());
    assert!(progress.axes.iter().all(|axis| axis.cycles > 0));
    assert!(progress.axes.iter().any(|axis| axis.stops_of_pauses == 1), "the group was stopped");

    let address = test.machine.plan().facts()[0].addresses()[1];
    assert!(test.machine.world().unplug(address));
    let lines = test.run(10 * S);
    assert_eq!(lines.len(), 3, "{lines:?}");
    assert!(
        lines.contains(&"axis x: moves no longer: stopped: stop group, begun by y: link lost".to_owned()),
        "{lines:?}"
    );
    let stopped = test.checkpoint();
    assert!(test.machine.world().plug(address));
    assert_eq!(test.run(20 * S), Vec::<String>::new());
    let (progress, judged) = test.finish();
    for (axis, before) in progress.axes.iter().zip(&stopped.axes) {
        assert_eq!((axis.cycles, axis.stops_of_pauses), (before.cycles, before.stops_of_pauses));
    }
    assert!(failed(&judged).contains(&"stops: 3, at most 0; x, y, u".to_owned()), "{:?}", failed(&judged));
}

/// Before its axes are enabled, too: what stopped them is not reset.
#[test]
fn axes_that_are_stopped_before_they_move_are_left_as_they_are() {
    let text = machine(4, ALONE).replace("[cycle]\n", "[cycle]\noverrun = \"stop\"\n");
    let mut test = Test::new(&text, 60 * S);
    let online = |machine: &Simulation| (0..3).all(|axis| machine.feedback(axis).link == Link::Online);
    assert!(test.machine.run_until(5_000, online));
    test.machine.world().delay_next_wake(12 * MS);
    test.machine.run(1);
    let lines = ["x", "y", "u"].map(|axis| format!("axis {axis}: moves no longer: stopped: overrun"));
    assert_eq!(test.run(5 * S), lines);
    for axis in 0..3 {
        assert_eq!(test.machine.feedback(axis).stopped, Some(StopCause::Overrun));
    }
}

#[test]
fn a_lost_drive_is_an_event_that_fails_by_name_and_the_others_go_on() {
    let mut test = Test::new(&machine(4, ALONE), 60 * S);
    test.run(20 * S);
    let address = test.machine.plan().facts()[0].addresses()[1];
    assert!(test.machine.world().unplug(address));
    let lines = test.run(10 * S);
    assert!(lines == ["axis y: moves no longer: stopped: link lost"], "{lines:?}");
    let before = test.checkpoint();
    assert!(test.machine.world().plug(address));
    test.run(30 * S);
    let (progress, judged) = test.finish();
    let lines = failed(&judged);
    assert!(lines.iter().any(|line| line == "lost_links: 1, at most 0; y"), "{lines:?}");
    assert!(lines.iter().any(|line| line == "stops: 1, at most 0; y"), "{lines:?}");
    assert!(!lines.iter().any(|line| line.contains("offline") || line.contains("unmoved")), "{lines:?}");
    let [x, y, u] = &progress.axes[..] else { panic!() };
    assert!(x.cycles > before.axes[0].cycles + 10 && u.cycles > before.axes[2].cycles + 5);
    // What the master stopped is not moved again by itself.
    assert_eq!((y.cycles, y.given_up.as_deref()), (before.axes[1].cycles, Some("stopped: link lost")));
}

#[test]
fn a_velocity_and_a_swing_longer_than_the_test_count_as_moved() {
    let long = "[[soak.axis]]\ndrive = \"u\"\nhold = \"1h\"\n";
    let text = machine(8, &format!("{}{long}{ALONE}", SINE.replace("2s", "1h")));
    let mut test = Test::new(&text, 30 * S);
    assert_eq!(test.run(30 * S), Vec::<String>::new());
    let (progress, judged) = test.finish();
    assert_eq!(failed(&judged), Vec::<String>::new());
    assert_eq!([1, 2].map(|axis| progress.axes[axis].cycles), [1, 1]);
}

#[test]
fn a_drive_that_never_comes_is_given_up_by_name() {
    let text = machine(8, "[[soak.axis]]\ndrive = \"x\"\nmove = false");
    let mut test = Test::new(&text, 120 * S);
    let address = test.machine.plan().facts()[0].addresses()[1];
    assert!(test.machine.world().unplug(address));
    let lines = test.run(70 * S);
    assert!(matches!(&lines[..], [line] if line.starts_with("axis y: moves no longer: ")), "{lines:?}");
    let (progress, judged) = test.finish();
    let lines = failed(&judged);
    assert!(lines.contains(&"offline: 1, at most 0; y".to_owned()), "{lines:?}");
    assert!(lines.contains(&"unmoved: 1, at most 0; y".to_owned()), "{lines:?}");
    assert!(lines.iter().any(|line| line.starts_with("given_up: 1, at most 0; y: ")), "{lines:?}");
    // An axis that is not to move is not even enabled.
    assert_eq!((progress.axes[0].cycles, progress.axes[0].moves), (0, false));
    let marks = &progress.run.as_ref().unwrap().drives[0].motion.marks;
    assert!(marks.iter().all(|mark| !format!("{:?}", mark.what).contains("OperationEnabled")));
}

#[test]
fn a_load_that_only_its_drive_holds_stays_powered_at_the_end() {
    let held = "address = \"127.0.0.11\"\nload = \"vertical\"\nheld_by = \"drive\"";
    let text = machine(8, "").replacen("address = \"127.0.0.11\"", held, 1);
    let mut test = Test::new(&text, 60 * S);
    assert_eq!(test.run(20 * S), Vec::<String>::new());
    test.soak.end();
    test.run(60 * S);
    assert!(test.soak.has_ended());
    let powered = |index: usize| test.machine.feedback(index).status.state.is_powered();
    assert_eq!([0, 1, 2].map(powered), [false, true, false]);
    assert!(test.machine.feedback(1).status.velocity.abs() < 0.1, "{:?}", test.machine.feedback(1));
}

/// A day of machine time: memory stays where it is, the files stay small, and nothing is lost.
#[test]
#[ignore = "a day of machine time: two minutes in a release build"]
fn a_day_of_machine_time() {
    let text = machine(8, SINE);
    let mut test = Test::new(&text, 86_400 * S);
    let mut largest = 0;
    for minute in 0..1_440 {
        assert_eq!(test.run(60 * S), Vec::<String>::new(), "minute {minute}");
        let progress = test.checkpoint();
        if minute % 60 == 59 {
            let judged = judge(&test.plan, &progress, false);
            assert_eq!(failed(&judged), Vec::<String>::new(), "minute {minute}");
            largest = largest.max(serde_json::to_string(&progress).unwrap().len());
        }
    }
    let (progress, judged) = test.finish();
    let growth = judged.iter().find(|one| one.criterion == "memory_growth").unwrap();
    let page = page(&progress, &judged, &[], &[], None).len();
    println!("memory_growth {:?} MB, checkpoint {largest} bytes, page {page} bytes", growth.value);
    assert_eq!(failed(&judged), Vec::<String>::new());
    assert!(growth.value.is_some() && largest < 1_000_000 && page < 400_000);
    let moves: Vec<u64> = progress.axes.iter().map(|axis| axis.cycles).collect();
    assert!(moves.iter().all(|moves| *moves > 40_000), "{moves:?}");
}
