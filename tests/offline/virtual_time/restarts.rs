//! A drive that restarts, in every state that its master can be in: what was under way ends, nothing goes on by itself,
//! and whatever was known of the drive is read again.

use std::time::Duration;

use fieldbeat::Flow;
use fieldbeat::axis::{
    Abort, Command, CommandId, EventKind, Failure, FoundRunning, Link, NativeOwner, Outcome, State,
    StopCause, StopHow, StopThen, Target, Underrun,
};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, MainState};
use fieldbeat::sim::FaultPlan;

use crate::virtual_time::support::*;

/// One state of the master.
struct Case {
    name: &'static str,
    plan: fn(&mut RigDrive),
    /// Leads into it; the command that runs there, if one does.
    lead: fn(&mut Bench) -> Option<CommandId>,
    /// How long it lasts at least, cycles.
    lasts: u64,
    /// How the command ends.
    ends: Option<Outcome>,
    /// The latch afterwards.
    stopped: Option<StopCause>,
    /// The drive had replied before, so that the restart is seen and reported.
    reported: bool,
}

const STOPPED_BY_DROP: Option<Outcome> = Some(Outcome::Aborted(Abort::Stopped(StopCause::DriveDropped)));

/// A motion that is cut off.
const MOVING: Case = Case {
    name: "",
    plan: |_| {},
    lead: |_| None,
    lasts: 100,
    ends: STOPPED_BY_DROP,
    stopped: Some(StopCause::DriveDropped),
    reported: true,
};

/// No command, no latch.
const CALM: Case = Case { ends: None, stopped: None, ..MOVING };

/// Stopped already, since another axis of the group was.
const STOPPED: Case = Case { ends: None, stopped: Some(StopCause::Group), ..MOVING };

const CASES: [Case; 24] = [
    Case {
        name: "unseen",
        lead: |b| {
            b.tape(0).mute = true;
            b.run(50);
            None
        },
        reported: false,
        ..CALM
    },
    Case {
        name: "qualifying",
        plan: |drive| drive.axis.health.gate = 200,
        lead: |b| {
            b.until("an answer", 20, |b| b.feedback(0).link == Link::Qualifying);
            None
        },
        ..CALM
    },
    Case { name: "online, only read", lead: online, ..CALM },
    Case {
        name: "enabling",
        lead: |b| {
            b.online();
            let id = b.post(0, Command::Enable);
            b.step();
            Some(id)
        },
        lasts: 290,
        ends: Some(Outcome::Failed(Failure::Dropped(State::NotReadyToSwitchOn))),
        ..CALM
    },
    Case {
        name: "enabled, standing",
        lead: |b| {
            b.ready();
            None
        },
        ends: None,
        ..MOVING
    },
    Case {
        name: "homing",
        lead: |b| {
            b.ready().done(0, to(50.0));
            Some(b.post(0, Command::Home))
        },
        ..MOVING
    },
    Case { name: "moving", lead: |b| runs(b, slowly_to(100.0)), ..MOVING },
    Case { name: "jogging", lead: |b| runs(b, jog(20.0)), ..MOVING },
    Case {
        name: "streaming",
        lead: |b| {
            b.ready();
            stream(b, 300)
        },
        ..MOVING
    },
    Case {
        name: "holding an empty stream",
        plan: |drive| drive.axis.underrun = Underrun::Hold,
        lead: |b| {
            b.ready();
            let id = stream(b, 10);
            b.until("the underrun", 200, |b| b.kinds(0).contains(&EventKind::Underrun));
            id
        },
        ..MOVING
    },
    Case {
        name: "native, the master keeps the control word",
        lead: |b| runs(b, Command::Native(NativeOwner::Master)),
        ..MOVING
    },
    Case {
        name: "native, the application owns the control word",
        lead: |b| runs(b, Command::Native(NativeOwner::Application)),
        ..MOVING
    },
    Case {
        name: "stopping along a ramp",
        plan: |drive| {
            drive.axis.stop.how = StopHow::Ramp;
            weak_ramp(drive, 200.0);
        },
        lead: |b| stop(b, 100.0),
        ..STOPPED
    },
    Case {
        name: "stopping quickly",
        plan: |drive| drive.axis.stop.how = StopHow::Quick,
        lead: |b| stop(b, 1_000.0),
        lasts: 30,
        ..STOPPED
    },
    Case {
        name: "coasting",
        plan: |drive| drive.axis.stop.how = StopHow::Coast,
        lead: |b| stop(b, 500.0),
        lasts: 60,
        ..STOPPED
    },
    Case {
        name: "latched, holding",
        plan: |drive| drive.axis.stop.then = StopThen::Hold,
        lead: |b| {
            stop(b, 100.0);
            b.run(100);
            assert_eq!(b.feedback(0).status.state, State::OperationEnabled);
            None
        },
        ..STOPPED
    },
    Case {
        name: "latched, powered off",
        lead: |b| {
            stop(b, 100.0);
            b.run(100);
            assert!(!b.feedback(0).status.state.is_powered());
            None
        },
        ..STOPPED
    },
    Case {
        // In operation, but not enabled by the application.
        name: "reset while it holds",
        plan: |drive| drive.axis.stop.then = StopThen::Hold,
        lead: |b| {
            stop(b, 100.0);
            b.run(100);
            b.done(0, Command::Reset);
            None
        },
        ..CALM
    },
    Case {
        name: "resetting, before the axis is down",
        plan: |drive| weak_ramp(drive, 200.0),
        lead: |b| {
            stop(b, 100.0);
            Some(b.post(0, Command::Reset))
        },
        ends: Some(Outcome::Done),
        stopped: None,
        ..STOPPED
    },
    Case {
        name: "acknowledging a fault",
        lead: |b| {
            b.ready();
            b.tape(0).provoke = Some(ErrorCode(0x03));
            b.stopped(0, 10);
            b.run(20);
            Some(b.post(0, Command::ResetFault))
        },
        lasts: 4,
        ends: Some(Outcome::Done),
        stopped: Some(StopCause::DriveFault),
        ..MOVING
    },
    Case {
        name: "found running and stopped",
        plan: |drive| {
            drive.simulate.start_running = true;
            weak_ramp(drive, 100.0);
        },
        lead: online,
        ends: None,
        stopped: Some(StopCause::FoundRunning),
        ..MOVING
    },
    Case {
        name: "found running and refused",
        plan: |drive| {
            (drive.simulate.start_running, drive.axis.on_found_running) = (true, FoundRunning::Refuse);
        },
        lead: online,
        ends: None,
        stopped: Some(StopCause::FoundRunning),
        ..MOVING
    },
    Case {
        name: "lost, receiving nothing",
        lead: |b| lost(b, |b| assert!(b.world().unplug(address(0)))),
        ends: Some(Outcome::Aborted(Abort::Stopped(StopCause::LinkLost))),
        stopped: Some(StopCause::LinkLost),
        ..MOVING
    },
    Case {
        name: "lost, receiving the probes",
        lead: |b| lost(b, |b| b.tape(0).mute = true),
        lasts: 500,
        ends: Some(Outcome::Aborted(Abort::Stopped(StopCause::LinkLost))),
        stopped: Some(StopCause::LinkLost),
        ..MOVING
    },
];

fn online(b: &mut Bench) -> Option<CommandId> {
    b.online();
    None
}

/// Ready, and with this command under way.
fn runs(b: &mut Bench, command: Command) -> Option<CommandId> {
    b.ready();
    Some(b.post(0, command))
}

/// Its link is lost in motion.
fn lost(b: &mut Bench, silence: fn(&mut Bench)) -> Option<CommandId> {
    let id = runs(b, slowly_to(100.0));
    b.run(100);
    silence(b);
    b.stopped(0, 40);
    id
}

/// Follows so many rows.
fn stream(b: &mut Bench, rows: u32) -> Option<CommandId> {
    for n in 0..rows {
        b.sim.axis(0).push_row(row(f64::from(n) * 0.01)).unwrap();
    }
    Some(b.post(0, Command::Follow))
}

/// In a motion of this speed when the other axis of the group fails.
fn stop(b: &mut Bench, velocity: f64) -> Option<CommandId> {
    b.ready();
    b.post(0, with(Target::Absolute(190.0), velocity, 10_000.0));
    b.run(150);
    b.tape(1).provoke = Some(ErrorCode(0x0B));
    assert_eq!(b.stopped(0, 20), StopCause::Group);
    None
}

/// The two ways in which it may come: between two requests, or at a request, which is lost.
#[derive(Clone, Copy, Debug)]
enum RestartAt {
    Between,
    AtRequest,
}

fn restart(b: &mut Bench, blow: RestartAt) {
    b.tape(0).received.clear();
    let reached = b.world().set_faults(address(0), FaultPlan { restart: 1.0, ..FaultPlan::default() });
    assert!(reached);
    let mut hit = false;
    // Behind a pulled plug no request comes.
    for _ in 0..if matches!(blow, RestartAt::AtRequest) { 150 } else { 0 } {
        b.step();
        hit = b.world().injected(address(0)).unwrap().restarts > 0;
        if hit {
            break;
        }
    }
    b.world().set_faults(address(0), FaultPlan::default());
    if !hit {
        b.world().restart(address(0));
    }
}

/// It stays off, it gets the power off request, and it has lost its reference.
fn assert_lies_still(b: &Bench, what: &str) {
    let tape = b.tape(0);
    for (n, received) in tape.received.iter().enumerate() {
        let Some(reply) = received.reply else { continue };
        assert!(reply.state.unwrap().main() < MainState::HW_TESTS, "{what}: power in answer {n}");
        assert!(!reply.status.unwrap().homed(), "{what}: homed in answer {n}");
    }
    // A reply from before the first send answers none of the first requests.
    let learned = tape.received.iter().skip(3);
    let go = learned.filter(|received| {
        received.request.control.is_some_and(|word| word.has(ControlWord::SWITCH_ON))
            || received.request.motion.is_some_and(|motion| motion.header >> 4 != 0)
    });
    assert_eq!(go.count(), 0, "{what}");
    drop(tape);
    let feedback = b.feedback(0);
    assert!(
        !feedback.status.homed && !feedback.status.moving && !feedback.status.state.is_powered(),
        "{what}: {feedback:?}"
    );
}

fn try_case(case: &Case, divisor: u32, after: u64, blow: RestartAt) {
    let what = format!("{}, divisor {divisor}, {blow:?} after {after}", case.name);
    let mut b = Rig::new(2)
        .each(|index, drive| {
            drive.axis.stop.group = Some(1);
            // A boot takes longer: none is slept through.
            drive.axis.health.probe_interval = Duration::from_millis(30);
            if index == 0 {
                drive.axis.divisor = divisor;
                drive.simulate.stream_period_ns *= u64::from(divisor);
                drive.simulate.start_position = 200_000;
                (case.plan)(drive);
            }
        })
        .start();
    let command = (case.lead)(&mut b);
    b.run(after);
    if let (Some(id), Some(Outcome::Done | Outcome::Failed(_)) | None) = (command, case.ends) {
        assert_eq!(b.outcome(0, id), None, "{what}: too late");
    }
    restart(&mut b, blow);
    // Whatever else is wrong with it has an end.
    b.run(20);
    b.tape(0).mute = false;
    b.world().plug(address(0));
    b.online().run(400);
    assert_eq!(b.feedback(0).stopped, case.stopped, "{what}");
    assert_eq!(command.and_then(|id| b.outcome(0, id)), case.ends, "{what}");
    let reported = b.kinds(0).iter().filter(|kind| **kind == EventKind::Restarted).count();
    assert_eq!(reported, usize::from(case.reported), "{what}");
    assert_lies_still(&b, &what);

    // The way back, step by step, and no other.
    if let Some(cause) = case.stopped {
        for command in [Command::Enable, Command::Home, to(10.0)] {
            assert_eq!(b.failed(0, command), Failure::Latched(cause), "{what}");
        }
        b.done(0, Command::Reset);
    }
    b.run(400);
    assert_lies_still(&b, &what);
    b.done(0, Command::Enable);
    assert_eq!(b.failed(0, to(10.0)), Failure::NotHomed, "{what}");
    b.done(0, Command::Home);
    b.done(0, to(10.0));
    assert!(b.feedback(0).status.homed && b.feedback(0).stopped.is_none(), "{what}");
    let last = b.post(0, Command::Reset);
    b.ended(0, last);
    let ends = b.ends.keys().filter(|(axis, _)| *axis == 0).count() as u64;
    assert_eq!(ends, last.0, "{what}: not every command has ended");
}

#[test]
fn a_restart_in_any_state_ends_what_was_under_way_and_starts_nothing() {
    for case in &CASES {
        for (divisor, blow) in [(1, RestartAt::Between), (3, RestartAt::AtRequest)] {
            for after in [0, 1, case.lasts / 3, case.lasts] {
                try_case(case, divisor, after, blow);
            }
        }
    }
}

#[test]
fn a_restart_while_the_master_ends_does_not_delay_the_end() {
    // The ramp takes 200 ms, then it stands for 20 exchanges.
    for after in [1, 2, 5, 100, 190, 215] {
        let mut b = Rig::new(2).each(|_, drive| weak_ramp(drive, 500.0)).ready();
        let ids = [0, 1].map(|index| b.post(index, with(Target::Absolute(190.0), 100.0, 5_000.0)));
        b.run(200);
        b.sim.stop();
        b.run(after);
        b.tape(0).received.clear();
        b.world().restart(address(0));
        let took = (after..1_000).find(|_| b.step() == Flow::End).expect("an end");
        assert!((215..=240).contains(&took), "{took} cycles, restarted after {after}");
        assert_lies_still(&b, &format!("restarted after {after}"));
        for (index, id) in ids.into_iter().enumerate() {
            assert_eq!(b.aborted(index, id), Abort::Stopped(StopCause::Shutdown));
            assert!(!b.feedback(index).status.state.is_powered());
        }
    }
}
