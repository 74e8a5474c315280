//! A panic of the loop, in every stage, once and for ever: all axes that can be stopped are stopped in order, the loop
//! ends by itself, and its end says where it was.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use fieldbeat::axis::{Abort, Axis, Command, EventKind, Link, Outcome, StopCause};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::sim::{SimPlan, Simulated, World, WorldOptions};
use fieldbeat::telemetry::Numbers;
use fieldbeat::time::Time;
use fieldbeat::{CyclePlan, Flow, Plan};
use fieldbeat_core::cycle::engine::{Control, Engine};
use fieldbeat_core::cycle::ring::Kept;
use fieldbeat_core::rt::{Clock, PollSet, Wires};
use fieldbeat_master::{Assembly, assemble};
use fieldbeat_sim::profibus::{LenzeSim, ProfibusSegment};
use fieldbeat_sim::world::WorldClock;

use super::fuse::{Call, Fused};
use super::lenze;
use crate::virtual_time::support::{all_simulated, drive, jog};

/// A clock that panics at its n-th call from now, and at some more from there.
#[derive(Clone, Debug)]
struct FusedClock {
    clock: WorldClock,
    /// Calls until the first panic; below 0: none.
    left: Arc<AtomicI64>,
    /// Panics to come.
    panics: Arc<AtomicI64>,
}

impl FusedClock {
    fn burn(&self) {
        if self.panics.load(Ordering::Relaxed) > 0 && self.left.fetch_sub(1, Ordering::Relaxed) <= 0 {
            self.panics.fetch_sub(1, Ordering::Relaxed);
            std::panic::resume_unwind(Box::new("on purpose"));
        }
    }
}

impl Clock for FusedClock {
    fn now(&mut self) -> Time {
        self.burn();
        self.clock.now()
    }

    fn sleep_until(&mut self, at: Time) {
        self.burn();
        self.clock.sleep_until(at);
    }

    fn wait(&mut self, set: &mut PollSet, until: Time) -> bool {
        self.burn();
        self.clock.wait(set, until)
    }

    fn spin(&mut self) {
        self.clock.spin();
    }
}

/// Two buses of one drive each.
struct Machine {
    engine: Engine<FusedClock>,
    axes: Vec<Axis>,
    buses: Vec<Fused>,
    clock: FusedClock,
    control: Control,
}

impl Machine {
    fn new() -> Machine {
        let bus = |index: usize| {
            let drives = vec![drive(index)];
            let bind = std::net::SocketAddrV4::new([127, 0, 1 + index as u8, 1].into(), 41136);
            let name = format!("bus{index}");
            let plan = LinUdpPlan { name, bind, drives };
            Fused::new(plan)
        };
        let buses = vec![bus(0), bus(1)];
        let drives =
            SimPlan { buses: buses.iter().map(|bus| Box::new(all_simulated(&bus.plan)) as _).collect() };
        let plans = buses.iter().map(|bus| Box::new(bus.clone()) as Box<dyn BusPlan>);
        let plan = Plan { buses: plans.collect(), ..Plan::default() };
        Machine { buses, ..Machine::of(&plan, drives.build()).0 }
    }

    /// A machine whose clock has a fuse, and its world.
    fn of(plan: &Plan, drives: Simulated) -> (Machine, World) {
        plan.check().unwrap();
        let world = World::new(drives, WorldOptions::default()).unwrap();
        let (left, panics) = (Arc::new(AtomicI64::new(0)), Arc::new(AtomicI64::new(0)));
        let clock = FusedClock { clock: world.clock(), left, panics };
        let control = Control::default();
        let Assembly { mut engine, axes, .. } =
            assemble(plan, clock.clone(), &world, None, control.clone(), Wires::default(), Kept::default())
                .unwrap();
        engine.begin();
        (Machine { engine, axes, buses: Vec::new(), clock, control }, world)
    }

    fn until(&mut self, what: &str, done: impl Fn(&[Axis]) -> bool) {
        for _ in 0..40_000 {
            if done(&self.axes) {
                return;
            }
            assert_eq!(self.engine.step(), Flow::Continue, "{what}");
        }
        panic!("never: {what}");
    }

    /// Both axes jog at 100 mm/s.
    fn moving() -> Machine {
        let mut machine = Machine::new();
        machine.until("online", |axes| axes.iter().all(|axis| axis.feedback().link == Link::Online));
        for command in [Command::Enable, Command::Home] {
            for axis in 0..2 {
                let id = machine.axes[axis].post(command).unwrap();
                let mut outcome = None;
                while outcome.is_none() {
                    machine.engine.step();
                    while let Some(event) = machine.axes[axis].event() {
                        match event.kind {
                            EventKind::Ended { id: ended, outcome: how, .. } if ended == id => {
                                outcome = Some(how)
                            }
                            _ => {}
                        }
                    }
                }
                assert_eq!(outcome, Some(Outcome::Done));
            }
        }
        for axis in &mut machine.axes {
            axis.post(jog(100.0)).unwrap();
        }
        machine.until("moving", |axes| axes.iter().all(|axis| axis.feedback().status.velocity > 95.0));
        machine
    }

    /// To the end of the loop, which it reaches by itself; `stopped`: these axes go down their ramps and are off then.
    #[track_caller]
    fn ends(mut self, what: &str, stopped: &[usize]) -> Numbers {
        let mut ramp = vec![0; self.axes.len()];
        let mut turns = 0;
        loop {
            let flow = self.engine.step();
            for axis in stopped {
                let seen = self.axes[*axis].feedback().status;
                // 100 mm/s at 5000 mm/s² take 20 ms.
                ramp[*axis] += u32::from(seen.velocity > 5.0 && seen.velocity < 95.0);
                assert!(
                    seen.state.is_powered() || seen.velocity.abs() < 5.0,
                    "{what}: powered off in motion"
                );
            }
            turns += 1;
            if flow == Flow::End {
                break;
            }
            assert!(turns < 20_000, "{what}: no end");
        }
        for axis in stopped {
            let seen = self.axes[*axis].feedback();
            assert_eq!(seen.stopped, Some(StopCause::Panic), "{what}: axis {axis}");
            assert!(!seen.status.state.is_powered() && seen.status.velocity.abs() < 1.0, "{what}: {seen:?}");
            assert!(ramp[*axis] > 10, "{what}: {} cycles of a ramp", ramp[*axis]);
        }
        assert!(self.control.is_stopping(), "{what}");
        let end = self.engine.finish();
        assert_eq!(end.status.planned, end.status.executed + end.status.skipped, "{what}");
        end
    }
}

/// A panic in motion is a place in the end of the run, and nothing else is.
#[test]
fn a_panic_at_any_call_of_the_clock_stops_all_axes_in_order() {
    let mut places = Vec::new();
    for call in 0..14 {
        let machine = Machine::moving();
        machine.clock.left.store(call, Ordering::Relaxed);
        machine.clock.panics.store(1, Ordering::Relaxed);
        let panic = machine.ends(&format!("call {call}"), &[0, 1]).panic.unwrap();
        assert_eq!((panic.count, panic.left_out.len(), panic.cut_short), (1, 0, false), "{panic:?}");
        assert!(panic.to_string().starts_with("internal error: the loop panicked "), "{panic}");
        places.push(panic.place);
    }
    let stages = ["send", "receive", "evaluate", "commands", "prepare", "publish"];
    for place in
        stages.map(|stage| format!("in stage {stage}")).iter().chain([&"between two cycles".to_owned()])
    {
        assert!(places.contains(place), "{place}: {places:?}");
    }
}

#[test]
fn a_panic_in_any_call_of_a_bus_stops_the_axes_of_all_buses_in_order() {
    for (call, place) in [
        (Call::Send, "in stage send, bus bus0"),
        (Call::Receive, "in stage receive, bus bus0"),
        (Call::HelperEnded, "in stage evaluate"),
        (Call::Prepare, "in stage prepare, bus bus0"),
        (Call::Numbers, "in stage publish"),
    ] {
        let machine = Machine::moving();
        machine.buses[0].light(call, 1);
        let panic = machine.ends(&format!("{call:?}"), &[0, 1]).panic.unwrap();
        assert_eq!((&*panic.place, panic.count, panic.left_out.len()), (place, 1, 0), "{call:?}");
    }
}

#[test]
fn a_permanently_panicking_bus_is_left_out_and_the_other_one_stops_in_order() {
    for call in [Call::Send, Call::Receive, Call::Prepare] {
        for (broken, healthy) in [(0, 1), (1, 0)] {
            let machine = Machine::moving();
            machine.buses[broken].light(call, u32::MAX);
            let panic = machine.ends(&format!("{call:?} of bus {broken}"), &[healthy]).panic.unwrap();
            assert_eq!((panic.count, &*panic.left_out), (2, &[format!("bus bus{broken}")][..]), "{call:?}");
            assert!(!panic.cut_short && panic.to_string().contains("without a stop by the master: bus bus"));
        }
    }
}

#[test]
fn a_command_posted_after_a_panic_ends() {
    let mut machine = Machine::moving();
    machine.clock.panics.store(1, Ordering::Relaxed);
    machine.engine.step();
    let id = machine.axes[0].post(Command::Reset).unwrap();
    machine.engine.step();
    let events = std::iter::from_fn(|| machine.axes[0].event());
    let aborted = Outcome::Aborted(Abort::Stopped(StopCause::Shutdown));
    let end = EventKind::Ended { id, command: "reset", outcome: aborted };
    assert!(events.map(|event| event.kind).any(|kind| kind == end));
}

/// The end that an application requested panics: it is completed all the same.
#[test]
fn a_bus_that_panics_in_its_own_end_holds_up_no_end() {
    let machine = Machine::moving();
    machine.buses[0].light(Call::ShutDown, u32::MAX);
    machine.control.stop();
    let Machine { mut engine, axes, .. } = machine;
    assert!((0..20_000).any(|_| engine.step() == Flow::End));
    assert!(axes.iter().all(|axis| !axis.feedback().status.state.is_powered()));
    let panic = engine.finish().panic.unwrap();
    assert_eq!(panic.left_out, ["bus bus0"]);
}

#[test]
fn a_clock_that_panics_for_ever_ends_the_loop_after_the_stop_has_left() {
    let machine = Machine::moving();
    machine.clock.panics.store(i64::MAX, Ordering::Relaxed);
    let panic = machine.ends("no clock", &[]).panic.unwrap();
    assert!(panic.cut_short && panic.count < 10, "{panic:?}");
    assert!(panic.to_string().contains("the stop is not complete: look at the drives"), "{panic}");
}

#[test]
fn a_panic_before_the_first_cycle_is_an_end_like_any_other() {
    let mut machine = Machine::new();
    machine.clock.panics.store(1, Ordering::Relaxed);
    machine.engine.begin();
    assert!((0..20_000).any(|_| machine.engine.step() == Flow::End));
    let end = machine.engine.finish();
    assert!(end.panic.is_some() && end.status.planned < 20_000, "{end:?}");
}

/// The wire is polled after a panic as before it, so that every drive has its turn in each cycle: by `send` alone one
/// of them would have, and 31 drives would wait longer than their watchdogs.
#[test]
fn a_panic_leaves_the_drives_of_a_half_duplex_wire_their_turns() {
    const DRIVES: usize = 4;
    for call in [0, 1, 3, 5, 8] {
        let bus = lenze::wire(12_000_000, DRIVES);
        let mut segment = ProfibusSegment::of(&bus);
        segment.drives.iter_mut().for_each(|drive| drive.motor.ramps_s = (0.01, 0.01, 0.01));
        let cycle = CyclePlan { receive_deadline: 0.8, ..CyclePlan::default() };
        let plan = Plan { cycle, buses: vec![Box::new(bus)], ..Plan::default() };
        let (machine, world) = Machine::of(&plan, SimPlan::from(segment).build());
        let Machine { mut engine, mut axes, clock, control, .. } = machine;
        let mut until = |axes: &[Axis], what: &str, done: &dyn Fn(&Axis) -> bool| {
            assert!((0..40_000).any(|_| (engine.step(), axes.iter().all(done)).1), "never: {what}");
        };
        until(&axes, "online", &|axis| axis.feedback().link == Link::Online);
        for axis in &mut axes {
            axis.post(Command::Enable).unwrap();
        }
        until(&axes, "enabled", &|axis| axis.feedback().is_operational());
        for axis in &mut axes {
            axis.post(jog(8.0)).unwrap();
        }
        until(&axes, "turning", &|axis| axis.feedback().status.velocity > 7.9);
        clock.left.store(call, Ordering::Relaxed);
        clock.panics.store(1, Ordering::Relaxed);
        let drive = |index: usize| {
            let look = |drive: &mut LenzeSim, now| (drive.events().exchanges, drive.truth(now));
            world.look_on(lenze::PORT, index, look).unwrap()
        };
        while !control.is_stopping() {
            engine.step();
        }
        let before: Vec<u64> = (0..DRIVES).map(|index| drive(index).0).collect();
        let (mut steps, mut ramp) = (0, [0; DRIVES]);
        while axes.iter().any(|axis| axis.feedback().status.state.is_powered()) {
            engine.step();
            steps += 1;
            assert!(steps < 2_000, "call {call}: no end");
            for index in 0..DRIVES {
                let (exchanges, truth) = drive(index);
                let turns = exchanges - before[index];
                assert!(turns + 3 >= steps, "call {call}: drive {index} had {turns} turns in {steps} cycles");
                ramp[index] += u32::from(truth.powered && truth.velocity > 0.5 && truth.velocity < 7.5);
                assert!(truth.powered || truth.velocity.abs() < 0.5, "call {call}: off in motion: {truth:?}");
            }
        }
        assert!(ramp.iter().all(|cycles| *cycles > 5), "call {call}: {ramp:?} cycles of a ramp");
        assert!((0..20_000).any(|_| engine.step() == Flow::End), "call {call}: no end");
        let panic = engine.finish().panic.unwrap();
        assert_eq!((panic.count, panic.left_out.len(), panic.cut_short), (1, 0, false), "{panic:?}");
    }
}

/// The thread that opens the connections of a bus is gone: its axes stop, and no other.
#[test]
fn the_end_of_its_helper_stops_the_axes_of_a_bus_and_no_other() {
    let mut machine = Machine::moving();
    *machine.buses[1].helper_ended.lock().unwrap() = true;
    machine.until("a stop", |axes| axes[1].feedback().stopped.is_some());
    assert_eq!(machine.axes[1].feedback().stopped, Some(StopCause::LinkThread));
    machine.until("off", |axes| !axes[1].feedback().status.state.is_powered());
    let other = machine.axes[0].feedback();
    assert!(other.stopped.is_none() && other.status.velocity > 95.0, "{other:?}");
    assert!(machine.engine.finish().panic.is_none());
}
