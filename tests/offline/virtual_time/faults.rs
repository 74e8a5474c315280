//! When something breaks: the link, the drive, the application's code. How far it may go, and how it comes back.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use fieldbeat::axis::{Abort, Command, EventKind, Failure, Link, Outcome, Row, State, StopCause, StopThen};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, MainState, StatusWord};
use fieldbeat::sim::WorldOptions;
use fieldbeat::time::Time;
use fieldbeat::{DriveEvent, Master, Simulation};
use fieldbeat_linudp::wire::{Request, ResponseDef};

use crate::virtual_time::support::*;

#[test]
fn a_link_lost_behind_a_power_off_switches_nothing_on_again() {
    // The drive has received the power off, its answer is lost. The stop that follows must not take what the drive said
    // before for what it finds.
    let mut b = Rig::new(1).each(|_, drive| drive.axis.stop.then = StopThen::Hold).ready();
    b.tape(0).mute = true;
    b.post(0, Command::Disable);
    assert_eq!(b.stopped(0, 10), StopCause::LinkLost);
    b.run(1_000);
    b.tape(0).mute = false;
    b.online().run(1_000);
    let on =
        |received: &Delivery| received.request.control.is_some_and(|word| word.has(ControlWord::SWITCH_ON));
    let tape = b.tape(0);
    let off = tape.received.iter().rposition(on).unwrap() + 1;
    let state = |received: &Delivery| received.reply.unwrap().state.unwrap().main();
    assert!(state(&tape.received[off - 1]) == MainState::OPERATION_ENABLED, "it was switched on again");
    assert_eq!(state(tape.received.last().unwrap()), MainState::READY_TO_SWITCH_ON);
}

#[test]
fn a_fault_of_the_drive_latches_and_its_own_stop_is_never_cut_short() {
    // While the drive brakes on its own, a control word with bit 0 low would let the axis coast.
    for code in [0x0003, 0x0086, 0x000B, 0x0023] {
        let mut b = Rig::new(1).ready();
        let id = b.post(0, with(fieldbeat::axis::Target::Absolute(190.0), 500.0, 5_000.0));
        b.run(200);
        b.tape(0).received.clear();
        b.tape(0).provoke = Some(ErrorCode(code));
        assert_eq!(b.stopped(0, 5), StopCause::DriveFault);
        assert_eq!(b.aborted(0, id), Abort::Stopped(StopCause::DriveFault));
        assert_eq!(
            (b.feedback(0).status.state, b.feedback(0).status.fault),
            (State::FaultReactionActive, u32::from(code))
        );
        b.run(200);
        assert_eq!(b.feedback(0).status.state, State::Fault);
        let braking: Vec<_> = (b.tape(0).received.iter())
            .filter(|received| received.reply.unwrap().state.unwrap().main() == MainState::QUICK_STOP)
            .map(|received| received.request.control.unwrap())
            .collect();
        // 500 mm/s at 20 m/s² take 25 ms.
        assert!((20..=30).contains(&braking.len()), "{} cycles of braking", braking.len());
        assert!(braking.iter().all(|word| word.has(0xF)), "{braking:?}");
        assert!(b.kinds(0).contains(&EventKind::Fault(u32::from(code))));
        for command in [Command::Enable, to(1.0)] {
            assert_eq!(b.failed(0, command), Failure::Latched(StopCause::DriveFault));
        }
        b.recover(0);
        b.done(0, to(5.0));
        assert!(b.kinds(0).contains(&EventKind::Fault(0)));
    }
}

/// A telegram of another master reaches the drive now.
pub fn inject(b: &Bench, request: Request) {
    b.inject_request(0, Request { response_def: ResponseDef::CYCLIC, ..request }, Time(0));
}

#[test]
fn a_quick_stop_from_elsewhere_ends_in_power_off_and_is_waited_for() {
    let mut b = Rig::new(1).ready();
    b.post(0, with(fieldbeat::axis::Target::Absolute(190.0), 500.0, 5_000.0));
    b.run(200);
    // OFF3 once; the master's own word does not bring the drive back.
    inject(&b, Request { control: Some(ControlWord::QUICK_STOP), ..Request::default() });
    b.run(3);
    assert_eq!(b.feedback(0).status.state, State::QuickStopActive);
    assert_eq!(b.stopped(0, 100), StopCause::DriveDropped);
    b.run(100);
    assert!(!b.feedback(0).status.state.is_powered());
    let tape = b.tape(0);
    let off = tape.received.iter().position(|received| {
        received.request.control == Some(ControlWord::BASE)
            && received.reply.unwrap().status.unwrap().has(StatusWord::MOTION_ACTIVE)
    });
    let ready =
        tape.received.iter().position(|received| received.reply.unwrap().status.unwrap().homed()).unwrap();
    assert!(off.is_none_or(|off| off < ready), "power was cut in the middle of braking");
}

#[test]
fn two_groups_may_stop_in_one_cycle_and_others_go_on() {
    let group = [Some(1), Some(1), Some(65), Some(65), Some(2), None];
    let mut b = Rig::new(6).each(|index, drive| drive.axis.stop.group = group[index]).ready();
    for index in 0..6 {
        b.post(index, slowly_to(100.0));
    }
    b.run(100);
    b.tape(0).mute = true;
    b.tape(2).mute = true;
    // A miss is known when its reply does not count any more.
    b.run(6);
    let stopped: Vec<_> = (0..6).map(|index| b.feedback(index).stopped).collect();
    let (lost, along) = (Some(StopCause::LinkLost), Some(StopCause::Group));
    assert_eq!(stopped, [lost, along, lost, along, None, None]);
}

#[test]
fn a_task_that_panics_stops_every_axis_and_the_loop_goes_on() {
    let runs = Arc::new(AtomicU64::new(0));
    let count = Arc::clone(&runs);
    let mut b = Rig::new(2)
        .task(move |cycle, _| {
            count.fetch_add(1, Ordering::Relaxed);
            // Quietly: the message of a panic is not this test's.
            if cycle.index == 900 {
                std::panic::resume_unwind(Box::new("on purpose"));
            }
        })
        .ready();
    let ids: Vec<_> = (0..2).map(|index| b.post(index, slowly_to(100.0))).collect();
    b.run(900 - b.feedback(0).cycle);
    for (index, id) in ids.into_iter().enumerate() {
        assert_eq!(b.aborted(index, id), Abort::Stopped(StopCause::Task));
        assert_eq!(b.feedback(index).stopped, Some(StopCause::Task));
        b.until("off", 500, |b| !b.feedback(index).status.state.is_powered());
    }
    assert_eq!(runs.load(Ordering::Relaxed), 901, "it is not called again");
    b.recover(0);
    b.done(0, to(5.0));
    b.assert_grid();
}

#[test]
fn a_task_over_its_budget_stops_every_axis() {
    for (work_ns, stopped) in [(90_000, None), (110_000, Some(StopCause::Task))] {
        let world = Arc::new(std::sync::Mutex::new(None::<fieldbeat::sim::World>));
        let inside = Arc::clone(&world);
        let mut b = Rig::new(2)
            .cycle(|cycle| cycle.task_budget_ns = Some(100_000))
            .task(move |cycle, _| {
                if cycle.index == 800 {
                    inside.lock().unwrap().as_ref().unwrap().advance(work_ns);
                }
            })
            .start();
        *world.lock().unwrap() = Some(b.world());
        b.ready();
        assert!(b.feedback(0).cycle < 800);
        b.run(801 - b.feedback(0).cycle);
        assert_eq!([0, 1].map(|index| b.feedback(index).stopped), [stopped; 2], "{work_ns} ns");
        b.run(100);
        assert_eq!(b.status().skipped, 0);
    }
}

#[test]
fn a_task_gives_one_command_a_cycle_and_rows_that_are_checked() {
    let reported = Arc::new(std::sync::Mutex::new(Vec::new()));
    let log = Arc::clone(&reported);
    let mut b = Rig::new(1)
        .each(|_, drive| drive.simulate.stream_patience = 20.0)
        .task(move |cycle, axes| {
            assert_eq!((axes.len(), axes.find("x0"), axes.find("y")), (1, Some(0), None));
            let position = 20.0 + (cycle.index as f64 - 2_000.0) * 0.02;
            match cycle.index {
                1_500 => {
                    let mut log = log.lock().unwrap();
                    log.push(axes.command(0, to(f64::NAN)));
                    log.push(axes.command(0, to(20.0)));
                    log.push(axes.command(0, to(30.0)));
                    log.push(axes.command(7, to(20.0)));
                }
                2_000 => {
                    log.lock().unwrap().push(axes.command(0, Command::Follow));
                    axes.follow(0, row(position));
                }
                2_001..3_000 => axes.follow(0, row(position)),
                3_000 => axes.follow(0, Row { last: true, ..row(position) }),
                3_500 => log.lock().unwrap().push(axes.command(0, Command::Follow)),
                3_501..3_600 => axes.follow(0, row(40.0)),
                3_600 => axes.follow(0, row(f64::NAN)),
                _ => {}
            }
        })
        .ready();
    b.until("the end of the stream", 4_000, |b| b.feedback(0).cycle == 3_400);
    let ids = reported.lock().unwrap().clone();
    assert_eq!(ids[0], Err(Failure::NotFinite));
    assert!(ids[1].is_ok() && ids[4].is_ok());
    assert!(matches!(ids[2], Err(Failure::Unsupported(_))));
    assert!(matches!(ids[3], Err(Failure::Unsupported(_))));
    for id in [ids[1], ids[4]] {
        assert_eq!(b.outcome(0, id.unwrap()), Some(Outcome::Done));
    }
    assert_near(b.feedback(0).status.demand, 40.0, 1e-4);
    assert_eq!(b.stopped(0, 300), StopCause::Limit);
    let last = reported.lock().unwrap()[5].unwrap();
    assert_eq!(b.outcome(0, last), Some(Outcome::Failed(Failure::NotFinite)));
    assert_eq!(b.feedback(0).cycle, 3_600, "reported in the cycle of the bad row");
}

/// One axis of each protocol.
#[test]
fn simulated_drive_events_are_addressed_by_axis_name() {
    let mut sim =
        Master::from_file("../../rt-config/demo.toml").unwrap().simulate(WorldOptions::default()).unwrap();
    let index =
        |sim: &Simulation, name: &str| sim.plan().axes().iter().position(|axis| axis.name == name).unwrap();
    let all =
        |sim: &Simulation| (0..sim.plan().axes().len()).all(|axis| sim.feedback(axis).link == Link::Online);
    assert!(sim.run_until(20_000, all));
    let enable = |sim: &mut Simulation, axis: usize| {
        let reset = [Command::ResetFault, Command::Reset].map(|command| sim.execute(axis, command, 5_000));
        assert_eq!(sim.execute(axis, Command::Enable, 20_000), Ok(Some(Outcome::Done)), "{axis}: {reset:?}");
    };
    for name in ["a3", "u2", "k2", "m2", "l2"] {
        let axis = index(&sim, name);
        let powered = |sim: &Simulation| sim.feedback(axis).status.state == State::OperationEnabled;
        sim.happen(name, DriveEvent::Unplug).unwrap();
        assert!(sim.run_until(20_000, |sim| sim.feedback(axis).link == Link::Lost), "{name}");
        sim.happen(name, DriveEvent::Plug).unwrap();
        assert!(sim.run_until(60_000, all), "{name}");
        // Some drives report it under power only.
        enable(&mut sim, axis);
        sim.happen(name, DriveEvent::OpenSto(Duration::from_secs(3))).unwrap();
        // A MOONS' reports it by a configured input only: it loses its power.
        assert!(sim.run_until(2_900, |sim| sim.feedback(axis).status.sto_open || !powered(sim)), "{name}");
        // The others are as they were.
        let mut others = (0..sim.plan().axes().len()).filter(|other| *other != axis);
        assert!(others.all(|other| !sim.feedback(other).status.sto_open), "{name}");
        sim.run(4_000);
        assert!(sim.run_until(20_000, |sim| !sim.feedback(axis).status.sto_open), "{name}");
        enable(&mut sim, axis);
        assert!(powered(&sim), "{name}");
        sim.happen(name, DriveEvent::Restart).unwrap();
        assert!(sim.run_until(20_000, |sim| !powered(sim)) && sim.run_until(60_000, all), "{name}");
    }
    let unknown = sim.happen("a99", DriveEvent::Restart).unwrap_err().to_string();
    assert!(unknown.starts_with("there is no simulated drive a99; there are: a1, a2, "), "{unknown}");
}
