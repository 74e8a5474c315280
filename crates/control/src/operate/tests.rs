//! The rules of operation in virtual time, on the drives of the sample configurations.

use super::operated::Operated;
use super::operation::Operation;
use super::*;
use fieldbeat_core::axis::Link;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::time::{MS, Time};
use fieldbeat_master::Master;
use fieldbeat_master::simulation::Simulation;
use fieldbeat_sim::WorldOptions;

/// The operator, and somebody else.
const ONE: u64 = 1;
const OTHER: u64 = 2;

/// Who only looks on.
const WATCHER: u64 = 3;

/// How often the operation looks, ms.
const LOOK_MS: u64 = 5;

/// A machine whose axes are operated.
struct Bench {
    machine: Simulation,
    operation: Operation,
    axes: usize,
    /// The next beat of the operator.
    beat: u64,
    /// The thread that looks lives.
    looks: bool,
    /// The time of each axis' ramp from its velocity to standstill, its drive's delay and its settling included, ms.
    ramp_ms: u64,
    period_ns: u64,
}

impl Bench {
    /// The machine of a sample configuration, changed like this, with all axes online.
    fn of(sample: &str, change: impl FnOnce(&mut String)) -> Bench {
        let mut text = std::fs::read_to_string(format!("../../rt-config/{sample}.toml")).unwrap();
        if sample == "linmot" {
            text = text
                .replace("# no_drive_watchdog = \"refuse\"", "no_drive_watchdog = \"accept\"\nleash = 10");
        }
        change(&mut text);
        let read = fieldbeat_config::parse(&text, sample).unwrap();
        let plan: Plan = read.plan;
        let period_ns = plan.cycle.period_ns;
        let axes: Vec<_> = plan.axes().into_iter().cloned().collect();
        let ramp_ms = axes.iter().map(|axis| axis.profile.velocity / axis.profile.deceleration * 1e3);
        let ramp_ms = ramp_ms.fold(0.0, f64::max) as u64 + 250;
        let setup = Master::from_plan(plan).with_simulation(read.simulation);
        let mut machine = setup.simulate(WorldOptions::default()).unwrap();
        let all = axes.len();
        let online = |machine: &Simulation| (0..all).all(|axis| machine.feedback(axis).link == Link::Online);
        assert!(machine.run_until(60_000, online), "{sample}: not online");
        let axes = (0..all).map(|index| Operated::new(machine.take_axis(index), Vec::new()));
        let operation = Operation::new(axes.collect());
        Bench { machine, operation, axes: all, beat: 0, looks: true, ramp_ms, period_ns }
    }

    fn linmot() -> Bench {
        Bench::of("linmot", |_| {})
    }

    /// With an operator, and axis 0 in operation.
    fn enabled(mut self) -> Bench {
        self.must(Request::Take { name: "one".into() });
        self.command(Order::Enable);
        let enabled = |state: &AxisState| state.operational && state.commands.is_empty();
        assert!(self.run_until(20_000, enabled), "{:?}", self.axis());
        self
    }

    /// The same, and homed.
    fn ready(self) -> Bench {
        let mut this = self.enabled();
        let facts = this.operation.request(this.now(), WATCHER, 0, &Request::Axes).1.unwrap();
        let Reply::Axes(facts) = facts else { panic!("{facts:?}") };
        if facts[0].lacks.home.is_none() {
            this.command(Order::Home);
            assert!(
                this.run_until(60_000, |state| state.commands.is_empty() && state.homed),
                "{:?}",
                this.axis()
            );
        }
        this
    }

    fn now(&self) -> Time {
        self.machine.world().now()
    }

    fn request(&mut self, request: Request) -> Result<Reply, String> {
        let (beat, answer) = self.operation.request(self.now(), ONE, self.beat, &request);
        self.beat = beat;
        answer
    }

    fn must(&mut self, request: Request) -> Reply {
        self.request(request).unwrap()
    }

    fn command(&mut self, command: Order) {
        self.must(Request::Act(Act::Command { axis: 0, command }));
    }

    fn jog(&mut self, velocity: f64) -> u64 {
        match self.must(Request::Act(Act::Jog { axis: 0, velocity })) {
            Reply::Jogs(number) => number,
            other => panic!("{other:?}"),
        }
    }

    fn hold(&mut self, jog: u64) -> Result<Reply, String> {
        self.request(Request::Act(Act::Hold { jog }))
    }

    /// How axis 0 is, as anybody may see it.
    fn axis(&mut self) -> AxisState {
        self.state().axes.swap_remove(0)
    }

    fn state(&mut self) -> OperationState {
        match self.operation.request(self.now(), WATCHER, 0, &Request::State { since: 0 }).1 {
            Ok(Reply::State(state)) => *state,
            other => panic!("{other:?}"),
        }
    }

    /// Lets so many ms pass, in which nobody requests anything.
    fn silence(&mut self, ms: u64) {
        let until = self.now() + ms * MS;
        while self.now() < until {
            let next = self.now() + LOOK_MS * MS;
            while self.now() < next {
                self.machine.step();
            }
            if self.looks {
                let now = self.now();
                self.operation.tick(now);
            }
        }
    }

    /// The same, and the operator is alive.
    fn pass(&mut self, ms: u64) {
        let mut left = ms;
        while left > 0 {
            let now = left.min(50);
            self.silence(now);
            self.must(Request::State { since: u64::MAX });
            left -= now;
        }
    }

    /// Lets time pass until axis 0 is so, at most so many ms.
    fn run_until(&mut self, ms: u64, is: impl Fn(&AxisState) -> bool) -> bool {
        (0..ms.div_ceil(50)).any(|_| {
            self.pass(50);
            is(&self.axis())
        })
    }

    /// Holds a jog for so many ms; whether it went on all the time.
    fn hold_for(&mut self, jog: u64, ms: u64) -> bool {
        (0..ms / 60).all(|_| {
            self.silence(60);
            self.hold(jog).is_ok()
        })
    }

    /// All axes stand, as far as the noise of their encoders allows to say.
    fn stands(&self) -> bool {
        (0..self.axes).all(|axis| self.machine.feedback(axis).status.velocity.abs() < 0.3 * SPEED)
    }

    /// Axis 0 stands within the limits of a hold and of its ramp.
    fn comes_to_rest(&mut self) {
        self.silence(HOLD_LIMIT / MS + LOOK_MS + self.ramp_ms);
        assert!(self.stands(), "{:?}", self.axis());
    }
}

/// Of the jogs here, in the unit of each axis.
const SPEED: f64 = 4.0;

#[test]
fn a_drive_that_has_not_answered_stands_nowhere() {
    let text = std::fs::read_to_string("../../rt-config/linmot.toml").unwrap();
    let plan: Plan = fieldbeat_config::parse(&text, "linmot").unwrap().plan;
    let mut machine = Master::from_plan(plan).simulate(WorldOptions::default()).unwrap();
    let state = Operated::new(machine.take_axis(0), Vec::new()).state();
    assert_eq!(state.link, Link::Unseen.to_string());
    assert_eq!([state.position, state.demand, state.velocity, state.current], [None; 4]);
}

#[test]
fn every_drive_jogs_while_it_is_held_and_stops_when_it_is_not() {
    for sample in ["linmot", "unidrive", "kollmorgen", "moons", "lenze"] {
        let mut bench = Bench::of(sample, |_| {}).ready();
        let jog = bench.jog(SPEED);
        assert!(bench.hold_for(jog, 1_500), "{sample}: {:?}", bench.state().notices);
        let velocity = bench.axis().velocity.unwrap();
        assert!((velocity - SPEED).abs() < 0.2 * SPEED, "{sample}: {velocity}");
        // Let go.
        bench.must(Request::Act(Act::Release { jog }));
        bench.pass(bench.ramp_ms);
        assert!(bench.stands(), "{sample}: {:?}", bench.axis());
        assert!(bench.axis().operational, "{sample}");
        // And the other way, up to a hold that does not come.
        let jog = bench.jog(-SPEED);
        assert!(bench.hold_for(jog, 1_500), "{sample}");
        assert!(bench.axis().velocity.unwrap() < -0.8 * SPEED, "{sample}");
        bench.comes_to_rest();
        assert_eq!(
            bench.axis().stopped,
            None,
            "{sample}: stopped by the jog's rule, sooner than by the loop's"
        );
        // Nothing at all from the operator: power off.
        bench.silence(OPERATOR_LIMIT / MS + 3_000);
        assert!(!bench.axis().powered, "{sample}: {:?}", bench.axis());
        assert_eq!(bench.state().operator, None, "{sample}");
    }
}

/// In cycles, where the master makes the setpoints: the last one that is as fast as the jog.
#[test]
fn a_stop_is_on_the_wire_within_the_limit_of_a_hold() {
    let mut bench = Bench::of("kollmorgen", |_| {}).ready();
    let jog = bench.jog(SPEED);
    assert!(bench.hold_for(jog, 600));
    let (begun, mut last) = (bench.now(), bench.now());
    let (mut demand, mut fast) = (bench.machine.feedback(0).status.demand, 0.0);
    let until = begun + 2 * HOLD_LIMIT;
    while bench.now() < until {
        let before = bench.now();
        bench.machine.step();
        let now = bench.now();
        // The thread looks once in so many ms.
        if now.0 / (LOOK_MS * MS) != before.0 / (LOOK_MS * MS) {
            bench.operation.tick(now);
        }
        let next = bench.machine.feedback(0).status.demand;
        let way = std::mem::replace(&mut demand, next);
        fast = f64::max(fast, next - way);
        if next - way > 0.999 * fast {
            last = now;
        }
    }
    let (after, period) = (last.since(begun), bench.period_ns);
    // One cycle until the loop takes the stop, one until it leaves, and two until the drive's report shows it.
    let most = HOLD_LIMIT + LOOK_MS * MS + 4 * period;
    assert!((HOLD_LIMIT..=most).contains(&after), "{after} ns, {period} ns a cycle");
}

#[test]
fn holds_that_come_late_or_in_a_burst_do_not_move_again() {
    let mut bench = Bench::linmot().ready();
    let jog = bench.jog(SPEED);
    assert!(bench.hold_for(jog, 600));
    // A pause that the operator's limit allows, and then what was meant for it, answered one by one.
    bench.silence(HOLD_LIMIT / MS + 50);
    for _ in 0..20 {
        assert!(bench.hold(jog).is_err());
    }
    bench.comes_to_rest();
    // The number of a jog is never used again.
    assert_eq!(bench.jog(SPEED), jog + 1);
    assert!(bench.hold(jog).unwrap_err().contains("has ended"));
    bench.comes_to_rest();
    // A burst that does not wait for the answers: its first one counts, its second one stops.
    let jog = bench.jog(SPEED);
    assert!(bench.hold_for(jog, 600));
    let beat = bench.beat;
    let hold = Request::Act(Act::Hold { jog });
    let burst: Vec<_> = (0..10).map(|_| bench.operation.request(bench.now(), ONE, beat, &hold).1).collect();
    assert!(burst[0].is_ok() && burst[1].as_ref().unwrap_err().contains("out of turn"), "{burst:?}");
    assert!(burst[2..].iter().all(Result::is_err));
    assert_eq!(bench.state().jog, None);
    bench.silence(bench.ramp_ms);
    assert!(bench.stands());
}

#[test]
fn there_is_one_operator_and_the_next_one_comes_when_all_stands() {
    let mut bench = Bench::linmot().ready();
    let take = Request::Take { name: "the\x1b other".into() };
    let other =
        |bench: &mut Bench, request: &Request| bench.operation.request(bench.now(), OTHER, 0, request).1;
    assert_eq!(other(&mut bench, &take).unwrap_err(), "one operates this master: end that first");
    for act in [
        Act::Command { axis: 0, command: Order::Home },
        Act::Jog { axis: 0, velocity: SPEED },
        Act::Hold { jog: 1 },
        Act::Release { jog: 1 },
    ] {
        let refused = other(&mut bench, &Request::Act(act)).unwrap_err();
        assert_eq!(refused, "one operates this master: end that first");
    }
    // What is refused to somebody else stops nobody; a stop is everybody's.
    let jog = bench.jog(SPEED);
    assert!(other(&mut bench, &Request::Act(Act::Hold { jog: 7 })).is_err());
    assert!(bench.hold_for(jog, 300));
    other(&mut bench, &Request::Stop).unwrap();
    assert!(bench.hold(jog).is_err());
    bench.pass(bench.ramp_ms);
    assert!(bench.stands());
    let jog = bench.jog(SPEED);
    assert!(bench.hold_for(jog, 300));
    bench.operation.leave(ONE);
    assert!(other(&mut bench, &take).unwrap_err().contains("still being stopped"));
    bench.silence(bench.ramp_ms + 1_000);
    assert!(bench.stands() && !bench.axis().powered, "{:?}", bench.axis());
    other(&mut bench, &take).unwrap();
    assert_eq!(bench.state().operator.as_deref(), Some("the other"));
    assert_eq!(
        bench.request(Request::Act(Act::Hold { jog })).unwrap_err(),
        "the other operates this master: end that first"
    );
}

#[test]
fn only_a_power_off_is_accepted_while_an_axis_is_being_stopped() {
    let mut bench = Bench::linmot().ready();
    let step = Order::step(1.0, SPEED);
    for order in [step, Order::Home, Order::Enable, Order::Reset, Order::ResetFault, Order::Disable] {
        let jog = bench.jog(SPEED);
        assert!(bench.hold_for(jog, 300));
        bench.must(Request::Stop);
        let answer = bench.request(Request::Act(Act::Command { axis: 0, command: order }));
        match order {
            Order::Disable => assert!(answer.is_ok(), "{answer:?}"),
            _ => assert!(answer.unwrap_err().contains("is being stopped: wait until it stands"), "{order:?}"),
        }
        bench.pass(bench.ramp_ms);
        assert!(bench.stands());
    }
}

#[test]
fn a_refused_request_stops_what_moves() {
    let refused: [fn(u64) -> Request; 6] = [
        |_| Request::Act(Act::Command { axis: 0, command: Order::Enable }),
        |_| Request::Act(Act::Command { axis: 99, command: Order::Enable }),
        |_| Request::Act(Act::Jog { axis: 0, velocity: SPEED }),
        |_| Request::Act(Act::Jog { axis: 0, velocity: f64::NAN }),
        |jog| Request::Act(Act::Hold { jog: jog + 1 }),
        |jog| Request::Act(Act::Release { jog: jog + 1 }),
    ];
    let mut bench = Bench::linmot().ready();
    for request in refused {
        let jog = bench.jog(SPEED);
        assert!(bench.hold_for(jog, 300));
        let request = request(jog);
        assert!(bench.request(request.clone()).is_err(), "{request:?}");
        assert_eq!(bench.state().jog, None, "{request:?}");
        bench.pass(bench.ramp_ms);
        assert!(bench.stands() && bench.axis().operational, "{request:?}: {:?}", bench.axis());
    }
    // A power off is not taken back by a stop, and one is enough.
    for _ in 0..10 {
        bench.command(Order::Disable);
    }
    bench.must(Request::Stop);
    bench.pass(1_000);
    assert!(!bench.axis().powered && bench.axis().commands.is_empty(), "{:?}", bench.axis());
    bench = bench.enabled();
    // So it does while a step runs.
    bench.command(Order::step(20.0, SPEED));
    bench.pass(500);
    assert!(!bench.stands());
    assert!(bench.request(Request::Act(Act::Jog { axis: 0, velocity: f64::INFINITY })).is_err());
    bench.pass(bench.ramp_ms);
    assert!(bench.stands(), "{:?}", bench.axis());
}

#[test]
fn a_step_and_a_homing_end_when_their_operator_goes_away() {
    for silent in [true, false] {
        for command in [Order::step(20.0, SPEED), Order::Home] {
            let bench = Bench::linmot();
            let mut bench = if command == Order::Home { bench.enabled() } else { bench.ready() };
            bench.command(command);
            bench.pass(100);
            assert_eq!(bench.axis().commands.len(), 1, "{command:?}");
            if silent {
                bench.silence(OPERATOR_LIMIT / MS + LOOK_MS);
            } else {
                bench.operation.leave(ONE);
            }
            bench.silence(bench.ramp_ms + 1_000);
            assert!(bench.stands() && !bench.axis().powered, "{command:?}: {:?}", bench.axis());
            let ends: Vec<_> = bench.state().notices.into_iter().filter_map(|notice| notice.end).collect();
            // It, the stop and the power off.
            let how: Vec<_> = ends[ends.len() - 3..].iter().map(|end| end.how).collect();
            assert_eq!(how, [Ended::Aborted, Ended::Done, Ended::Done], "{command:?}");
        }
    }
}

#[test]
fn every_command_has_its_end() {
    let mut bench = Bench::linmot().ready();
    let last = |bench: &mut Bench| {
        bench.state().notices.into_iter().rev().find(|notice| notice.end.is_some()).unwrap()
    };
    bench.command(Order::step(3.0, SPEED));
    bench.pass(3_000);
    assert_eq!(last(&mut bench).text, "move done");
    bench.command(Order::step(1e6, SPEED));
    bench.pass(100);
    let failed = last(&mut bench);
    assert_eq!(failed.end.unwrap().how, Ended::Failed);
    assert!(failed.text.starts_with("move failed: position "), "{}", failed.text);
    bench.command(Order::Disable);
    bench.pass(500);
    assert_eq!(last(&mut bench).text, "disable done");
    bench.command(Order::Home);
    bench.pass(100);
    assert!(last(&mut bench).text.starts_with("home failed: the drive is in state "));
    assert!(bench.axis().commands.is_empty());
}

#[test]
fn an_axis_that_holds_after_a_stop_holds_when_its_operator_has_left() {
    let holds = |text: &mut String| *text = text.replace("# stop.then = \"disable\"", "stop.then = \"hold\"");
    for (change, powered) in [(&holds as &dyn Fn(&mut String), true), (&|_: &mut String| {}, false)] {
        let mut bench = Bench::of("linmot", change).ready();
        bench.command(Order::step(20.0, SPEED));
        bench.pass(300);
        bench.operation.leave(ONE);
        bench.silence(bench.ramp_ms + 1_000);
        assert!(bench.stands());
        assert_eq!(bench.axis().powered, powered);
        // The next operator may have it.
        bench.must(Request::Take { name: "two".into() });
    }
}

#[test]
fn an_idle_operator_that_leaves_keeps_power_on_and_the_next_one_takes_over() {
    for sample in ["linmot", "moons", "kollmorgen"] {
        let mut bench = Bench::of(sample, |_| {}).ready();
        bench.must(Request::Leave);
        assert_eq!((bench.beat, bench.state().operator), (0, None), "{sample}");
        // Whoever has left does not operate, and is missed by nobody.
        assert!(bench.request(Request::Act(Act::Jog { axis: 0, velocity: SPEED })).is_err());
        assert!(bench.request(Request::Leave).is_err());
        bench.silence(3 * OPERATOR_LIMIT / MS);
        bench.operation.leave(ONE);
        bench.silence(bench.ramp_ms + 1_000);
        assert!(bench.stands() && bench.axis().operational, "{sample}: {:?}", bench.axis());
        // The next one goes away in another way.
        let take = Request::Take { name: "other".into() };
        bench.operation.request(bench.now(), OTHER, 0, &take).1.unwrap();
        bench.operation.leave(OTHER);
        bench.silence(bench.ramp_ms + 1_000);
        assert!(bench.stands() && !bench.axis().powered, "{sample}: {:?}", bench.axis());
    }
}

#[test]
fn an_operator_stays_until_its_commands_have_ended() {
    for jogs in [true, false] {
        let mut bench = Bench::linmot().ready();
        if jogs {
            let jog = bench.jog(SPEED);
            assert!(bench.hold_for(jog, 300));
        } else {
            bench.command(Order::step(20.0, SPEED));
            bench.pass(300);
        }
        let refused = bench.request(Request::Leave).unwrap_err();
        assert!(refused.contains("has not ended what it does"), "{refused}");
        // It stops, and its operator is still the operator.
        bench.pass(bench.ramp_ms);
        assert!(bench.stands() && bench.axis().operational, "{:?}", bench.axis());
        bench.must(Request::Leave);
        bench.silence(2_000);
        assert!(bench.axis().operational);
    }
}

#[test]
fn anybody_may_stop_one_axis_and_the_others_go_on() {
    let mut bench = Bench::linmot().ready();
    bench.must(Request::Act(Act::Command { axis: 1, command: Order::Enable }));
    bench.pass(2_000);
    bench.must(Request::Act(Act::Command { axis: 1, command: Order::Home }));
    bench.pass(20_000);
    let stop =
        |bench: &mut Bench, axis| bench.operation.request(bench.now(), OTHER, 0, &Request::StopAxis(axis)).1;
    let jog = bench.jog(SPEED);
    assert!(bench.hold_for(jog, 300));
    bench.must(Request::State { since: 0 });
    assert!(matches!(stop(&mut bench, 1), Ok(Reply::Commanded(_))));
    assert!(bench.hold_for(jog, 300) && !bench.stands(), "{:?}", bench.state());
    assert!(stop(&mut bench, 9).unwrap_err().contains("there is no axis 9"));
    assert!(bench.hold_for(jog, 300), "a refusal to somebody else stops nothing");
    let Ok(Reply::Commanded(id)) = stop(&mut bench, 0) else { panic!("there is something to be stopped") };
    assert!(bench.state().jog.is_none() && bench.hold(jog).is_err());
    bench.pass(bench.ramp_ms);
    assert!(bench.stands() && bench.axis().operational);
    let end = CommandEnd { command: id, how: Ended::Done };
    let is_end = |notice: &Notice| notice.axis == Some(0) && notice.end.as_ref() == Some(&end);
    assert!(bench.state().notices.iter().any(is_end), "{:?}", bench.state().notices);
    // One without power has nothing to be stopped.
    bench.command(Order::Disable);
    bench.pass(1_000);
    assert_eq!(stop(&mut bench, 0), Ok(Reply::Done));
}

#[test]
fn missing_capabilities_are_listed_before_any_command() {
    let mut bench = Bench::linmot();
    let request =
        |bench: &mut Bench, act| bench.operation.request(bench.now(), WATCHER, 0, &Request::Check(act)).1;
    let check = |bench: &mut Bench, axis, command| request(bench, Act::Command { axis, command });
    let to = |place| Order::Move { target: Goal::To(place), velocity: None, acceleration: None };
    assert_eq!(check(&mut bench, 0, to(10.0)), Ok(Reply::Done));
    let refused = check(&mut bench, 0, to(1e6)).unwrap_err();
    assert!(refused.contains("move refused: position 1000000 is outside its limit"), "{refused}");
    assert!(check(&mut bench, 0, Order::step(1.0, 1e9)).unwrap_err().contains("velocity 1000000000 "));
    assert!(check(&mut bench, 9, to(10.0)).unwrap_err().contains("there is no axis 9"));
    assert_eq!(request(&mut bench, Act::Jog { axis: 0, velocity: SPEED }), Ok(Reply::Done));
    let refused = request(&mut bench, Act::Jog { axis: 0, velocity: 1e9 }).unwrap_err();
    assert!(refused.contains("jog refused: velocity 1000000000 is outside its limit"), "{refused}");
    let mut other = Bench::of("unidrive", |_| {});
    let refused = check(&mut other, 0, to(1.0)).unwrap_err();
    assert!(refused.contains("this drive cannot do that"), "{refused}");
    assert_eq!(bench.state().operator, None, "a client that only reads operates nothing");
}

#[test]
fn a_move_goes_to_a_place_along_the_ramps_that_it_names() {
    let mut bench = Bench::linmot().ready();
    let from = bench.axis().position.unwrap();
    let to = |place, velocity, acceleration| Order::Move { target: Goal::To(place), velocity, acceleration };
    bench.command(to(from + 5.0, None, None));
    bench.pass(2_000);
    assert!((bench.axis().position.unwrap() - from - 5.0).abs() < 0.1, "{:?}", bench.axis());
    // 10 mm/s² up to 4 mm/s: it is under way for longer than its usual ramps would take.
    bench.command(to(from, Some(4.0), Some(10.0)));
    bench.pass(200);
    let velocity = bench.axis().velocity.unwrap();
    assert!((-2.6..-1.0).contains(&velocity), "{velocity}");
    bench.pass(3_000);
    assert!((bench.axis().position.unwrap() - from).abs() < 0.1 && bench.axis().commands.is_empty());
}

/// As the page of the scope writes it.
#[test]
fn a_move_may_leave_its_ramps_out() {
    let step = serde_json::json!({ "move": { "target": { "by": -1.5 }, "velocity": 2.0 } });
    assert_eq!(serde_json::from_value::<Order>(step).unwrap(), Order::step(-1.5, 2.0));
    let to = serde_json::json!({ "move": { "target": { "to": 3.0 } } });
    let known = Order::Move { target: Goal::To(3.0), velocity: None, acceleration: None };
    assert_eq!(serde_json::from_value::<Order>(to).unwrap(), known);
    assert!(serde_json::from_value::<Order>(serde_json::json!({ "move": { "velocity": 2.0 } })).is_err());
}

#[test]
fn an_axis_without_a_dead_man_does_not_jog() {
    let without =
        |text: &mut String| *text = text.replace("# jog_deadman = \"500ms\"", "jog_deadman = \"off\"");
    let mut bench = Bench::of("linmot", without).ready();
    let refused = bench.request(Request::Act(Act::Jog { axis: 0, velocity: SPEED })).unwrap_err();
    assert!(refused.contains("its jog_deadman is off"), "{refused}");
}

/// Operators at random, who pause, request nonsense, repeat themselves and come back: nothing moves longer after the
/// last sign of life than the limits and the ramp allow, and nothing stays powered.
#[test]
fn random_operators_and_no_motion_without_an_operator() {
    let mut moved = 0;
    for (seed, sample) in (1..=6).zip(["linmot", "unidrive", "kollmorgen"].into_iter().cycle()) {
        let mut rng = fastrand::Rng::with_seed(seed);
        let mut bench = Bench::of(sample, |_| {}).ready();
        // The last request that was accepted, and the last one that held a jog; steps and homings may go on without.
        let (mut alive, mut held) = (bench.now(), bench.now());
        for _ in 0..100 {
            let jog = bench.state().jog.map_or(rng.u64(0..3), |(number, _)| number);
            let (operated, operational) = (bench.state().operator.is_some(), bench.axis().operational);
            let request = match rng.u32(0..20) {
                8.. if !operated => Request::Take { name: "one".into() },
                14.. if !operational => Request::Act(Act::Command { axis: 0, command: Order::Enable }),
                0 => Request::Take { name: "one".into() },
                1 => Request::Stop,
                2 => Request::Act(Act::Command { axis: 0, command: Order::Enable }),
                3 => Request::Act(Act::Command { axis: 0, command: Order::step(5.0, SPEED) }),
                4 => Request::Act(Act::Release { jog }),
                5 => Request::Act(Act::Command { axis: rng.usize(0..3), command: Order::Reset }),
                6 | 7 => Request::State { since: 0 },
                8..=11 => {
                    Request::Act(Act::Jog { axis: 0, velocity: if rng.bool() { SPEED } else { -SPEED } })
                }
                _ => Request::Act(Act::Hold { jog }),
            };
            let beat = if rng.u32(0..20) == 0 { rng.u64(0..50) } else { bench.beat };
            let (next, answer) = bench.operation.request(bench.now(), ONE, beat, &request);
            bench.beat = next;
            if answer.is_ok() && operated || matches!(request, Request::Take { .. }) {
                alive = bench.now();
                held = match request {
                    Request::Act(Act::Jog { .. } | Act::Hold { .. }) => alive,
                    _ => held,
                };
            }
            if rng.u32(0..60) == 0 {
                bench.operation.leave(ONE);
            }
            for _ in 0..if rng.u32(0..12) == 0 { rng.u64(0..1_000) } else { rng.u64(1..25) } {
                bench.silence(LOOK_MS);
                let (now, state) = (bench.now(), bench.axis());
                let steps = state.commands.iter().any(|name| name == "move");
                moved += u64::from(!bench.stands());
                let most_ms = if steps { OPERATOR_LIMIT } else { HOLD_LIMIT } / MS + LOOK_MS + bench.ramp_ms;
                let since = if steps { alive } else { held.max(if state.stopping { alive } else { held }) };
                assert!(
                    bench.stands() || now.since(since) <= most_ms * MS,
                    "{sample}, seed {seed}: moves {} ms after its last hold: {state:?}",
                    now.since(since) / MS
                );
                assert!(
                    !state.powered || now.since(alive) <= (OPERATOR_LIMIT / MS + bench.ramp_ms + 1_500) * MS,
                    "{sample}, seed {seed}: powered without an operator: {state:?}"
                );
            }
        }
    }
    assert!(moved > 500, "they hardly moved: {moved}");
}
