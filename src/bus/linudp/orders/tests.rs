//! Orders, step by step, without a wire.

use std::net::Ipv4Addr;

use super::super::native::{Native, native};
use super::*;
use crate::bus::Order;
use crate::bus::linudp::motion::Acceleration;
use crate::bus::linudp::wire::RtcCommand;

/// What a drive in `state` says.
fn says(state: MainState, sub: u8) -> Inputs {
    let (state, status) = (StateVar::new(state, sub), StatusWord::default());
    Inputs { seen: true, fresh: true, clean: true, status, state, ..Inputs::default() }
}

/// Orders that are about `verb`, told by a drive in operation whose count is 3.
fn about(verb: Command) -> (Orders, Slot, Native, NativePort) {
    let mut orders = Orders::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
    let (native, mut port) = native();
    let mut slot = Slot { order: Order { serial: 1, verb: Some(verb) }, ..Slot::default() };
    orders.advance(Time(0), &says(MainState::OPERATION_ENABLED, 3), &mut slot, &mut port);
    orders.sent();
    (orders, slot, native, port)
}

/// What a drive with an error says.
fn fails(state: MainState, status: u16) -> Inputs {
    let status = StatusWord(StatusWord::ERROR | StatusWord::SWITCH_ON_ACTIVE | status);
    Inputs { status, fault: ErrorCode(0x0B), ..says(state, 0) }
}

#[test]
fn a_stop_lets_no_drive_rise_into_operation() {
    let held = ControlWord(ControlWord::ON.0 & !ControlWord::ENABLE_OPERATION);
    for (state, control) in [
        // Somebody has switched the drive off, and the word of the motion has switched it on again.
        (MainState::READY_TO_SWITCH_ON, ControlWord::BASE),
        (MainState::HW_TESTS, ControlWord::BASE),
        (MainState::READY_TO_OPERATE, held),
        (MainState::OPERATION_ENABLED, ControlWord::ON),
    ] {
        let (mut orders, mut slot, _native, mut port) = about(Command::Native(NativeOwner::Master));
        slot.order = Order { serial: 2, verb: Some(Command::Stop { deceleration: None }) };
        let status = StatusWord(StatusWord::SWITCH_ON_ACTIVE | StatusWord::ENABLE_OPERATION);
        let inputs = Inputs { status, ..says(state, 0) };
        let outputs = orders.advance(Time(0), &inputs, &mut slot, &mut port);
        assert_eq!(outputs.control, Some(control), "{state:?}");
    }
}

#[test]
fn an_error_is_acknowledged_only_when_the_drive_has_braked() {
    let (mut orders, mut slot, _native, mut port) = about(Command::Native(NativeOwner::Master));
    slot.order = Order { serial: 2, verb: Some(Command::ResetFault) };
    let mut exchange = |inputs: Inputs| {
        let control = orders.advance(Time(0), &inputs, &mut slot, &mut port).control;
        orders.sent();
        (control, slot.progress.end)
    };
    // It brakes on its own: bit 0 low would cut its power.
    for _ in 0..3 {
        assert_eq!(exchange(fails(MainState::QUICK_STOP, 0)), (Some(ControlWord::ON), None));
    }
    let error = fails(MainState::ERROR, 0);
    assert_eq!(exchange(error), (Some(ControlWord::BASE), None));
    assert_eq!(exchange(error), (Some(ControlWord::ACKNOWLEDGE), None));
    let off = says(MainState::NOT_READY, 0);
    for _ in 0..2 {
        assert_eq!(exchange(off), (Some(ControlWord::BASE), None));
    }
    // Two replies say so.
    assert_eq!(exchange(off), (Some(ControlWord::BASE), Some(Ok(()))));
}

#[test]
fn a_fatal_error_is_told_when_the_drive_has_braked() {
    let (mut orders, mut slot, _native, mut port) = about(Command::Native(NativeOwner::Master));
    slot.order = Order { serial: 2, verb: Some(Command::ResetFault) };
    for (state, control, end) in [
        (MainState::QUICK_STOP, ControlWord::ON, None),
        (MainState::ERROR, ControlWord::BASE, Some(Err(Failure::DriveFault(0x0B)))),
    ] {
        let inputs = fails(state, StatusWord::FATAL_ERROR);
        assert_eq!(orders.advance(Time(0), &inputs, &mut slot, &mut port).control, Some(control));
        orders.sent();
        assert_eq!(slot.progress.end, end);
    }
}

#[test]
fn a_stop_takes_no_power_off_back() {
    for verb in [Command::Stop { deceleration: None }, Command::QuickStop] {
        let (mut orders, mut slot, _native, mut port) = about(Command::Disable);
        slot.order = Order { serial: 2, verb: Some(verb) };
        let on = StatusWord(StatusWord::SWITCH_ON_ACTIVE);
        // What it said before it was told, what may be as old as that, and what it said before it did as told.
        let on = Inputs { status: on, ..says(MainState::OPERATION_ENABLED, 3) };
        for inputs in [Inputs { fresh: false, ..on }, Inputs { clean: false, ..on }, on] {
            let control = orders.advance(Time(0), &inputs, &mut slot, &mut port).control.unwrap();
            assert!(!control.has(ControlWord::SWITCH_ON), "{verb:?}: {control:?}");
            orders.sent();
        }
    }
}

#[test]
fn a_motion_that_has_failed_is_not_sent_any_more() {
    // The drive has begun a motion of its own before it heard the command.
    let profile = Profile { velocity: 1.0, acceleration: 1.0, deceleration: 1.0 };
    let verb = Command::Move(Move { target: Target::Absolute(1.0), profile });
    let (mut orders, mut slot, _native, mut port) = about(verb);
    let mut exchange = || {
        let inputs = says(MainState::CLEARANCE_CHECK, 0);
        let motion = orders.advance(Time(0), &inputs, &mut slot, &mut port).motion;
        orders.sent();
        (motion, slot.progress.end)
    };
    let failed = Some(Err(Failure::Dropped(State::Unknown)));
    assert_eq!([exchange(), exchange()], [(None, failed); 2]);
}

#[test]
fn a_step_may_last_for_more_than_fifty_days() {
    let (mut orders, mut slot, _native, mut port) = about(Command::Native(NativeOwner::Master));
    (orders.answers, orders.sent) = (u32::MAX, u32::MAX);
    orders.advance(Time(0), &says(MainState::OPERATION_ENABLED, 3), &mut slot, &mut port);
    orders.sent();
    assert_eq!((orders.answers, orders.sent, slot.progress.end), (u32::MAX, u32::MAX, None));
}

#[test]
fn a_suspect_reply_teaches_no_count() {
    let (mut orders, mut slot, mut native, mut port) = about(Command::Native(NativeOwner::Master));
    let older = Inputs { clean: false, ..says(MainState::OPERATION_ENABLED, 2) };
    orders.advance(Time(0), &older, &mut slot, &mut port);
    let motion = Some(MotionCommand::vai_stop(Acceleration(1)));
    native.write(NativeOutput { motion, ..NativeOutput::default() }).unwrap();
    orders.sent();
    // After 2 it would have been 3, which the drive has stored: it would not have run it.
    let outputs = orders.advance(Time(0), &older, &mut slot, &mut port);
    assert_eq!(outputs.motion, Some(MotionCommand::vai_stop(Acceleration(1)).block(4)));
}

#[test]
fn a_native_output_stays_until_it_has_gone_out() {
    let (mut orders, mut slot, mut native, mut port) = about(Command::Native(NativeOwner::Application));
    for count in 1..=3 {
        let control = Some(ControlWord(u16::from(count)));
        let config = Some(RtcBlock::command(count, RtcCommand::NO_OPERATION));
        native.write(NativeOutput { control, motion: None, config }).unwrap();
    }
    let inputs = says(MainState::OPERATION_ENABLED, 3);
    for count in 1..=3 {
        // Two slots are passed over, and a send fails.
        for _ in 0..4 {
            let outputs = orders.advance(Time(0), &inputs, &mut slot, &mut port);
            assert_eq!(outputs.config.map(|config| config.count()), Some(count));
            assert_eq!(outputs.control, Some(ControlWord(u16::from(count))));
        }
        orders.sent();
    }
    let outputs = orders.advance(Time(0), &inputs, &mut slot, &mut port);
    assert_eq!((outputs.control, outputs.config), (Some(ControlWord(3)), None));
}

#[test]
fn a_native_motion_waits_for_the_echo_of_the_one_before_it() {
    let (mut orders, mut slot, mut native, mut port) = about(Command::Native(NativeOwner::Master));
    for increment in [1, 2] {
        let motion = Some(MotionCommand::vai_stop(Acceleration(increment)));
        native.write(NativeOutput { motion, ..NativeOutput::default() }).unwrap();
    }
    let mut exchange = |state, sub| {
        let outputs = orders.advance(Time(0), &says(state, sub), &mut slot, &mut port);
        orders.sent();
        (outputs.motion, slot.progress.end)
    };
    let block = |increment, count| Some(MotionCommand::vai_stop(Acceleration(increment)).block(count));
    for _ in 0..3 {
        assert_eq!(exchange(MainState::OPERATION_ENABLED, 3), (block(1, 4), None));
    }
    assert_eq!(exchange(MainState::OPERATION_ENABLED, 4), (block(2, 5), None));
    assert_eq!(exchange(MainState::OPERATION_ENABLED, 5), (None, None));
}

#[test]
fn a_native_motion_is_given_up_after_four_counts() {
    let (mut orders, mut slot, mut native, mut port) = about(Command::Native(NativeOwner::Master));
    let motion = Some(MotionCommand::vai_stop(Acceleration(1)));
    native.write(NativeOutput { motion, ..NativeOutput::default() }).unwrap();
    let mut counts = Vec::new();
    while slot.progress.end.is_none() && counts.len() < 100 {
        let inputs = says(MainState::OPERATION_ENABLED, 3);
        let outputs = orders.advance(Time(0), &inputs, &mut slot, &mut port);
        orders.sent();
        counts.extend(outputs.motion.map(|block| block.header & 0xF));
    }
    assert_eq!(slot.progress.end, Some(Err(Failure::NotTaken)));
    counts.dedup();
    assert_eq!(counts, [4, 5, 6, 7]);
}

#[test]
fn a_native_motion_outside_of_operation_holds_nothing_up() {
    let (mut orders, mut slot, mut native, mut port) = about(Command::Native(NativeOwner::Application));
    for increment in [1, 2] {
        let motion = Some(MotionCommand::vai_stop(Acceleration(increment)));
        native.write(NativeOutput { motion, ..NativeOutput::default() }).unwrap();
    }
    for increment in [1, 2] {
        let inputs = says(MainState::READY_TO_SWITCH_ON, 0);
        let motion = orders.advance(Time(0), &inputs, &mut slot, &mut port).motion.unwrap();
        assert_eq!(motion.parameters, MotionCommand::vai_stop(Acceleration(increment)).block(0).parameters);
        orders.sent();
    }
}

#[test]
fn the_firmware_is_not_reset_by_a_count_that_does_it_again_and_again() {
    let (mut orders, mut slot, mut native, mut port) = about(Command::Native(NativeOwner::Master));
    let motion = Some(MotionCommand::reset_firmware());
    native.write(NativeOutput { motion, ..NativeOutput::default() }).unwrap();
    for _ in 0..3 {
        let outputs = orders.advance(Time(0), &says(MainState::OPERATION_ENABLED, 3), &mut slot, &mut port);
        orders.sent();
        assert_eq!(outputs.motion, None);
    }
    assert!(matches!(slot.progress.end, Some(Err(Failure::Unsupported(_)))), "{:?}", slot.progress);
}

#[test]
fn the_application_is_told_when_native_mode_runs() {
    let (mut orders, mut slot, native, mut port) = about(Command::Stop { deceleration: None });
    let mut running = |serial, verb, state| {
        slot.order = Order { serial, verb: Some(verb) };
        orders.advance(Time(0), &says(state, 3), &mut slot, &mut port);
        orders.sent();
        port.publish(Time(1), &[]);
        native.inputs().running
    };
    let mode = Command::Native(NativeOwner::Master);
    assert!(!running(1, Command::Stop { deceleration: None }, MainState::OPERATION_ENABLED));
    assert!(running(2, mode, MainState::OPERATION_ENABLED));
    // It drops out of operation, and the mode with it.
    running(2, mode, MainState::READY_TO_OPERATE);
    assert!(!running(2, mode, MainState::READY_TO_OPERATE));
}
