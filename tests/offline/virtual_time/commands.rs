//! The commands of an application, and how they end.

use fieldbeat::axis::{
    Abort, Command, EventKind, Failure, Link, NativeOwner, State, StopCause, StopHow, StopThen, Target,
};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, MainState, Native, NativeOutput, StatusWord};
use fieldbeat::time::US;
use fieldbeat_linudp::wire::{Request, ResponseView, RtcBlock, RtcCommand};

use crate::virtual_time::faults::inject;
use crate::virtual_time::support::*;

const STOP: Command = Command::Stop { deceleration: None };

/// The control words that the drive received, each once in a row.
fn controls(b: &Bench, index: usize) -> Vec<u16> {
    let mut words: Vec<u16> =
        b.tape(index).received.iter().filter_map(|received| received.request.control).map(|c| c.0).collect();
    words.dedup();
    words
}

#[test]
fn enable_goes_low_then_high_and_home_holds_its_bit() {
    let mut b = Rig::new(1).online();
    b.done(0, Command::Enable);
    assert_eq!(controls(&b, 0), [0x3E, 0x3F]);
    assert!(b.feedback(0).is_operational() && !b.feedback(0).status.homed);
    let states: Vec<_> = (b.kinds(0).into_iter())
        .filter_map(|kind| if let EventKind::State(state) = kind { Some(state) } else { None })
        .collect();
    let expected =
        [State::SwitchOnDisabled, State::ReadyToSwitchOn, State::SwitchedOn, State::OperationEnabled];
    assert_eq!(states[states.len() - 4..], expected);
    b.done(0, Command::Home);
    assert_eq!(controls(&b, 0), [0x3E, 0x3F, 0x83F, 0x3F]);
    assert!(b.feedback(0).status.homed);
    assert_near(b.feedback(0).status.position, 0.0, 0.01);
    // Enabled already: nothing is switched off on the way.
    b.done(0, Command::Enable);
    b.done(0, Command::Disable);
    assert_eq!(controls(&b, 0), [0x3E, 0x3F, 0x83F, 0x3F, 0x3E]);
    assert_eq!(b.failed(0, to(10.0)), Failure::WrongState(State::ReadyToSwitchOn));
    b.done(0, Command::Enable);
    assert!(b.feedback(0).status.homed, "homed survives power off");
}

#[test]
fn motions_need_operation_and_an_enable() {
    let mut b = Rig::new(1).each(|_, drive| drive.axis.stop.then = StopThen::Hold).online();
    for command in [to(10.0), jog(10.0), Command::Follow, Command::Home] {
        assert_eq!(b.failed(0, command), Failure::WrongState(State::SwitchOnDisabled));
    }
    b.ready();
    // A stop that holds leaves the drive in operation; reset alone does not give it back to motions.
    b.tape(0).mute = true;
    assert_eq!(b.stopped(0, 10), StopCause::LinkLost);
    b.tape(0).mute = false;
    b.online();
    b.done(0, Command::Reset);
    assert!(b.feedback(0).is_operational());
    let native = Command::Native(NativeOwner::Master);
    for command in [to(10.0), by(1.0), jog(10.0), Command::Follow, Command::Home, native] {
        assert_eq!(b.failed(0, command), Failure::NotEnabled);
    }
    b.done(0, Command::Enable);
    b.done(0, to(10.0));
}

#[test]
fn reset_fault_acknowledges_with_an_edge_and_ends_powered_off() {
    let mut b = Rig::new(1).ready();
    b.done(0, Command::ResetFault);
    b.tape(0).provoke = Some(ErrorCode(0x0003));
    assert_eq!(b.stopped(0, 10), StopCause::DriveFault);
    assert_eq!((b.feedback(0).status.state, b.feedback(0).status.fault), (State::Fault, 3));
    b.run(50);
    b.tape(0).received.clear();
    b.done(0, Command::ResetFault);
    assert_eq!(controls(&b, 0), [0x3E, 0xBE, 0x3E]);
    assert_eq!(b.feedback(0).status.fault, 0);
    assert!(!b.feedback(0).status.state.is_powered());
    assert_eq!(b.failed(0, Command::Enable), Failure::Latched(StopCause::DriveFault));
    b.done(0, Command::Reset);
    b.done(0, Command::Enable);
    assert!(b.feedback(0).status.homed);
    b.done(0, to(5.0));
}

fn go_to(position: i32) -> MotionCommand {
    let ramp = Acceleration(500_000);
    MotionCommand::vai_go_to(Position(position), Velocity(200_000), ramp, ramp)
}

#[test]
fn native_mode_hands_the_motion_channel_over_and_keeps_the_drive_enabled() {
    let mut b = Rig::new(1).ready();
    let mut native: Box<Native> = b.sim.axis(0).native().unwrap();
    assert!(b.sim.axis(0).native::<Native>().is_none(), "taken once");
    let id = b.post(0, Command::Native(NativeOwner::Master));
    b.run(3);
    let output = NativeOutput {
        control: Some(ControlWord::BASE),
        motion: Some(go_to(250_000)),
        ..NativeOutput::default()
    };
    native.write(output).unwrap();
    b.run(400);
    assert_eq!(native.inputs().response.demand, Some(250_000));
    assert_eq!(native.inputs().response.state.unwrap().main(), MainState::OPERATION_ENABLED);
    assert_eq!(b.outcome(0, id), None);
    let stop = b.post(0, STOP);
    assert_eq!(b.aborted(0, id), Abort::Replaced(stop));
    // What is written now belongs to no mode, and to none that comes later.
    native.write(output).unwrap();
    b.done(0, to(10.0));
    b.run(10);
    b.post(0, Command::Native(NativeOwner::Master));
    b.run(100);
    assert_eq!(b.feedback(0).status.demand, 10.0);
    assert_eq!(b.feedback(0).link, Link::Online);
}

#[test]
fn native_outputs_survive_slots_passed_over_and_lost_requests() {
    let mut b = Rig::new(1).ready();
    let mut native: Box<Native> = b.sim.axis(0).native().unwrap();
    let id = b.post(0, Command::Native(NativeOwner::Master));
    b.run(3);
    b.tape(0).received.clear();
    for count in 1..=12 {
        let config = Some(RtcBlock::command(count, RtcCommand::NO_OPERATION));
        native.write(NativeOutput { config, ..NativeOutput::default() }).unwrap();
    }
    for late_ns in [1_500 * US, 0, 3_200 * US, 0] {
        b.world().delay_next_wake(late_ns);
        b.step();
    }
    b.run(20);
    assert!(b.status().skipped >= 4);
    let counts: Vec<_> =
        (b.tape(0).received.iter()).filter_map(|h| Some(h.request.config?.count())).collect();
    assert!(counts.into_iter().eq(1..=12));

    b.tape(0).received.clear();
    for position in [100_000, 150_000, 120_000] {
        let motion = Some(go_to(position));
        native.write(NativeOutput { motion, ..NativeOutput::default() }).unwrap();
        // The request that carries it first is lost.
        b.step();
        b.world().unplug(address(0));
        b.step();
        b.world().plug(address(0));
    }
    b.run(500);
    let mut motions: Vec<_> = (b.tape(0).received.iter())
        .filter_map(|received| received.request.motion)
        .map(|motion| motion.parameters)
        .collect();
    motions.dedup();
    assert_eq!(motions, [100_000, 150_000, 120_000].map(|to| go_to(to).block(0).parameters));
    assert_eq!(native.inputs().response.demand, Some(120_000));
    assert_eq!(b.outcome(0, id), None);
}

#[test]
fn the_stop_plan_chooses_the_way_down() {
    for (how, then, off) in [
        (StopHow::Ramp, StopThen::Disable, true),
        (StopHow::Quick, StopThen::Disable, true),
        (StopHow::Coast, StopThen::Disable, true),
        (StopHow::Ramp, StopThen::Hold, false),
        (StopHow::Quick, StopThen::Hold, false),
    ] {
        let mut b = Rig::new(2)
            .each(|_, drive| {
                (drive.axis.stop.how, drive.axis.stop.then, drive.axis.stop.group) = (how, then, Some(3))
            })
            .ready();
        b.post(0, with(Target::Absolute(190.0), 200.0, 5_000.0));
        b.run(100);
        b.world().unplug(address(1));
        b.run(2);
        b.tape(0).received.clear();
        assert_eq!(b.stopped(0, 10), StopCause::Group);
        b.run(400);
        assert_eq!(b.feedback(0).status.state.is_powered(), !off, "{how:?} {then:?}");
        assert!(!b.feedback(0).status.moving);
        let words = controls(&b, 0);
        let expected: &[u16] = match (how, off) {
            (StopHow::Coast, _) => &[0x3F, 0x3E],
            (StopHow::Ramp, true) => &[0x3F, 0x3E],
            (StopHow::Ramp, false) => &[0x3F],
            (StopHow::Quick, true) => &[0x3F, 0x2F, 0x3F, 0x3E],
            (StopHow::Quick, false) => &[0x3F, 0x2F, 0x3F],
        };
        assert_eq!(words, expected, "{how:?} {then:?}");
        // Power went off while it still moved only where it should.
        let tape = b.tape(0);
        let off_at =
            tape.received.iter().position(|received| received.request.control == Some(ControlWord::BASE));
        if let Some(at) = off_at {
            let moving = tape.received[at - 1].reply.unwrap().status.unwrap().has(StatusWord::MOTION_ACTIVE);
            assert_eq!(moving, how == StopHow::Coast, "{how:?}");
        }
    }
}

/// The count in the state variable of a reply in operation.
fn count(reply: &mut [u8]) -> Option<&mut u8> {
    let in_operation = ResponseView::new(reply).ok()?.state()?.count().is_some();
    in_operation.then(|| &mut reply[10])
}

#[test]
fn an_echo_that_hides_the_stored_count_costs_a_few_cycles_and_no_motion() {
    // Seen on real hardware: the echo was 0 while the drive had stored 1, and the first command was not taken.
    let mut b = Rig::new(1).ready();
    inject(&b, Request { motion: Some(MotionCommand::no_operation().block(1)), ..Request::default() });
    b.tape(0).tamper = Some(Box::new(|reply| {
        if let Some(byte) = count(reply)
            && *byte & 0xF == 1
        {
            *byte &= 0xF0;
        }
    }));
    b.run(5);
    b.tape(0).received.clear();
    b.done(0, by(7.0));
    assert_eq!(b.tape(0).last().demand, Some(70_000));
    let first = b.tape(0).received.iter().find_map(|received| received.request.motion).unwrap();
    assert_eq!(first.header & 0xF, 1, "the count that the drive had stored already");
}
