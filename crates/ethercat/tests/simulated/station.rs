//! The station against the simulated drive, cycle by cycle, in virtual time: outputs, the drive, inputs, and its
//! mailbox.

mod rig;

use self::rig::{Rig, planned, planned_for, position, velocity};
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::axis::{Command, Failure, Profile, State};
use fieldbeat_core::bus::{Exchange, Slot};
use fieldbeat_core::time::{MS, Time};
use fieldbeat_ethercat::faults::Fault;
use fieldbeat_ethercat::mode::Mode;
use fieldbeat_ethercat::native::Native;
use fieldbeat_ethercat::object::number::{CONTROL_WORD, STATUS_WORD};
use fieldbeat_ethercat::object::pdo::{Entry, Layout};
use fieldbeat_ethercat::object::{Family, Object, Type, pdo};
use fieldbeat_ethercat::plan::{KollmorgenDrive, Mapping, Watchdog};
use fieldbeat_ethercat::profile::capabilities;
use fieldbeat_ethercat::station::*;
use fieldbeat_ethercat::wire::registers::AlState;
use fieldbeat_sim::ethercat::{self as sim, Application};

const PERIOD: u64 = MS;
const STOP: Command = Command::Stop { deceleration: None };
const PROFILE: Profile = Profile { velocity: 1.0, acceleration: 10.0, deceleration: 10.0 };

#[test]
fn outputs_stay_neutral_before_the_first_command() {
    let mut rig = Rig::new(position());
    assert!(!rig.station.profile.writes());
    rig.turns(100);
    assert_eq!((rig.control(), rig.setpoint()), (0, 123_456));
    assert_eq!(rig.state(), State::SwitchOnDisabled);
    let report = rig.slot.status;
    let place = 123_456.0 / f64::from(1 << 20);
    assert!((report.position - place).abs() < 1e-9 && !report.moving && report.velocity == 0.0);
    assert!(report.current.is_nan(), "its rated current is not known");
    rig.order(None);
    rig.turn();
    assert_eq!((rig.end(), rig.control(), rig.station.profile.writes()), (Some(Ok(())), 0, true));
}

#[test]
fn enable_goes_from_state_to_state_each_seen() {
    for plan in [velocity(), position(), planned(0x1703, 0x1B03)] {
        let mut rig = Rig::new(plan);
        rig.order(Command::Enable);
        let mut sent = vec![];
        while rig.end().is_none() {
            rig.turn();
            if sent.last() != Some(&rig.control()) {
                sent.push(rig.control());
            }
        }
        assert_eq!(rig.end(), Some(Ok(())));
        assert_eq!(sent, [6, 7, 0x0F]);
        assert_eq!((rig.state(), rig.drive.axis_state()), (State::OperationEnabled, State::OperationEnabled));
        rig.assert_standing();
        rig.order(Command::Enable);
        for _ in 0..4 {
            rig.turn();
            assert_eq!(rig.control(), 0x0F, "it is on already");
        }
        assert_eq!(rig.end(), Some(Ok(())));
        rig.done(Command::Disable);
        assert_eq!((rig.control(), rig.drive.axis_state()), (0, State::SwitchOnDisabled));
    }
}

#[test]
fn unsupported_commands_are_refused_at_once_by_name() {
    let unsupported = |rig: &mut Rig, command| {
        rig.order(command);
        rig.prepare();
        matches!(rig.end(), Some(Err(Failure::Unsupported(_))))
    };
    let mut rig = Rig::enabled(velocity());
    assert!(unsupported(&mut rig, Rig::by(1.0)) && unsupported(&mut rig, Command::Follow));
    rig.drive.provoke(Fault::MOTOR_PHASE.code);
    rig.turns(200);
    let reset = rig.run(Command::ResetFault);
    assert!(matches!(reset, Err(Failure::Unsupported(why)) if why.contains("cold start")));
    let mut rig = Rig::enabled(planned(0x1703, 0x1B03));
    assert!(unsupported(&mut rig, Rig::jog(1.0)) && unsupported(&mut rig, Rig::by(1.0)));
    let mut plan = velocity();
    plan.slave.watchdog = Watchdog::Off;
    let mut rig = Rig::enabled(plan);
    assert!(unsupported(&mut rig, Rig::jog(1.0)));
    rig.assert_standing();
    // A position is held, and a velocity may be accepted.
    for mut plan in [position(), velocity()] {
        plan.slave.watchdog = Watchdog::Off;
        plan.accept_no_watchdog = plan.setpoint() != position().setpoint();
        let mut rig = Rig::enabled(plan);
        rig.order(Rig::jog(1.0));
        rig.turns(300);
        assert!((rig.slot.status.velocity - 1.0).abs() < 0.02);
    }
    let mut plan = velocity();
    plan.outputs.entries.retain(|entry| entry.object != CONTROL_WORD);
    let refused = capabilities(&plan, PERIOD).lacks.refuses(&Command::Enable);
    assert!(matches!(refused, Some(Failure::Unsupported(_))));
}

#[test]
fn a_torque_follows_its_slope_and_its_side() {
    for side in [1, -1] {
        let mut plan = planned(0x1703, 0x1B03);
        plan.axis.units.counts_per_unit *= f64::from(side);
        plan.axis.limits.torque = Some(8.0);
        plan.scaling.permille_per_count = 0.5;
        let mut rig = Rig::enabled(plan);
        assert_eq!((rig.setpoint(), rig.control()), (0, 0x0F), "it is enabled without a torque");
        rig.steepest = 0;
        rig.order(Command::Torque { slope: 50.0 });
        rig.machine.input.level = 2.0;
        rig.turns(10);
        assert_eq!(rig.setpoint(), side * 10, "a count is half a per mille");
        rig.turns(100);
        assert_eq!((rig.setpoint(), rig.end()), (side * 40, None));
        assert!(rig.slot.status.moving);
        rig.machine.input.level = -30.0;
        rig.turns(500);
        assert_eq!((rig.setpoint(), rig.steepest), (side * -160, 1), "its limit");
        rig.machine.input.level = f64::NAN;
        rig.turn();
        assert_eq!(rig.end(), Some(Err(Failure::NotFinite)));
    }
}

#[test]
fn a_stop_takes_the_torque_away_and_halts_what_turns() {
    let turning = |slope: f64| {
        let mut rig = Rig::enabled(planned(0x1703, 0x1B03));
        rig.order(Command::Torque { slope });
        rig.machine.input.level = 5.0;
        rig.turns((5_000.0 / slope) as u64 + 200);
        assert!(rig.slot.status.velocity > 1.0 && rig.setpoint() == 50, "{:?}", rig.slot.status);
        rig
    };
    // Along its slope, but not for longer than 100 ms.
    for (slope, most) in [(100.0, 50), (10.0, 100)] {
        let mut rig = turning(slope);
        rig.steepest = 0;
        rig.order(STOP);
        let took = rig.until("no torque", 200, |rig| rig.setpoint() == 0);
        assert!((most - 2..=most + 2).contains(&took), "{took}");
        assert_eq!((rig.steepest, rig.end()), (1, None));
        rig.until("a halt", 5, |rig| rig.control() == 0x10F);
        rig.until("the end", 500, |rig| rig.end().is_some());
        assert_eq!((rig.end(), rig.slot.status.moving), (Some(Ok(())), false));
        rig.turn();
        assert_eq!((rig.setpoint(), rig.control()), (0, 0x0F), "then it is free");
        rig.assert_standing();
    }
    let mut rig = turning(100.0);
    rig.order(Command::QuickStop);
    rig.prepare();
    assert_eq!((rig.setpoint(), rig.control()), (0, 0x10F), "at once");
    rig.done(Command::QuickStop);
    rig.assert_standing();
    // What it cannot do does not let it turn on, and the next torque ends the halt.
    let mut rig = turning(100.0);
    assert!(matches!(rig.run(Rig::jog(1.0)), Err(Failure::Unsupported(_))));
    rig.turns(500);
    assert!(!rig.slot.status.moving && rig.drive.rpm().abs() < 1.0);
    rig.order(Command::Torque { slope: 100.0 });
    rig.machine.input.level = 5.0;
    rig.turns(300);
    assert!(rig.slot.status.velocity > 1.0 && rig.control() == 0x0F);
    rig.done(Command::Home);
    assert!(rig.drive.is_homed());
    rig.assert_standing();
    let mut rig = turning(100.0);
    rig.done(Command::Disable);
    assert_eq!((rig.setpoint(), rig.control()), (0, 0));
}

#[test]
fn a_halt_that_is_not_over_ends_with_the_next_motion() {
    for plan in [velocity(), position()] {
        let mut rig = Rig::enabled(plan);
        rig.order(Rig::jog(3.0));
        rig.turns(600);
        rig.order(Command::QuickStop);
        rig.turns(5);
        assert_eq!(rig.control(), 0x10F);
        rig.order(Rig::jog(2.0));
        for _ in 0..500 {
            rig.turn();
            assert!(rig.drive.rpm().abs() < 3.1 * 60.0, "it does not make up for what it was held up");
        }
        assert!((rig.slot.status.velocity - 2.0).abs() < 0.02 && rig.control() == 0x0F);
    }
}

#[test]
fn homing_is_done_by_the_drive_in_its_own_mode_and_without_a_leap_of_the_velocity() {
    for plan in [position(), velocity()] {
        let mut rig = Rig::enabled(plan);
        assert!(!rig.slot.status.homed);
        rig.order(Command::Home);
        rig.until("home", 20_000, |rig| {
            assert!(rig.slot.status.velocity.abs() < 2.0, "{:?}", rig.slot.status);
            assert!(rig.drive.rpm().abs() < 90.0, "the motor leaps: {}", rig.drive.rpm());
            rig.end().is_some()
        });
        assert_eq!(rig.end(), Some(Ok(())));
        rig.turns(50);
        assert!(rig.slot.status.homed && rig.drive.is_homed());
        assert!(rig.slot.status.position.abs() < 1e-2, "{:?}", rig.slot.status);
        rig.assert_standing();
        rig.order(Rig::jog(1.0));
        rig.turns(500);
        assert!((rig.slot.status.velocity - 1.0).abs() < 0.02, "{:?}", rig.slot.status);
        rig.done(STOP);
    }
}

#[test]
fn an_akd_interpolates_with_its_bit_and_homes_by_an_edge_of_it() {
    let mut plan = planned_for(Family::Akd, 0x1701, 0x1B01);
    plan.slave.mailbox = position().slave.mailbox;
    let mut rig = Rig::enabled(plan);
    assert_eq!(rig.control(), 0x1F);
    rig.done(Rig::by(0.5));
    rig.done(Command::Home);
    rig.turns(50);
    assert!(rig.slot.status.homed && rig.slot.status.position.abs() < 1e-2);
    rig.done(Rig::to(1.0));
    rig.assert_standing();
    assert!((rig.slot.status.position - 1.0).abs() < 1e-4);
}

/// An AKD in this mode, with these outputs behind its control word.
fn akd(mode: Mode, outputs: &[(u16, u8)]) -> KollmorgenDrive {
    let mut plan = KollmorgenDrive::new("x", 0, Family::Akd);
    let layout = |pdo, first, others: &[(u16, u8)]| {
        let objects: Vec<_> =
            [&[first], others].concat().iter().map(|(index, sub)| Object::new(*index, *sub)).collect();
        Layout::of_known(pdo, &objects).unwrap()
    };
    plan.outputs = layout(0x1600, (0x6040, 0), outputs);
    plan.inputs = layout(0x1A00, (0x6041, 0), &[(0x6064, 0)]);
    (plan.mapping, plan.mode) = (Mapping::Free, Some(mode));
    plan.fit();
    plan.slave.watchdog = Watchdog::After(100 * MS);
    plan.slave.mailbox = position().slave.mailbox;
    plan
}

/// One that interpolates, whose outputs carry its mode; it changes that late.
fn late_akd() -> Rig {
    let mut plan = akd(Mode::INTERPOLATED, &[(0x6060, 0), (0x60C1, 1)]);
    plan.home_method = Some(2);
    let mut rig = Rig::with(plan, |settings| settings.mode_delay_ns = 5 * MS);
    rig.done(Command::Enable);
    rig
}

#[test]
fn a_homing_that_is_left_before_its_mode_is_there_starts_none_then_or_later() {
    // Behind the control word.
    let place = 2;
    let mut rig = late_akd();
    rig.order(Command::Home);
    let until_home =
        rig.until("home", 200, |rig| rig.control() & 0x10 != 0 && rig.drive.mode() == Mode::HOMING.0);
    assert!(rig.outputs[place] == 6 && until_home > 10, "{until_home}");
    for command in [STOP, Command::QuickStop, Command::Disable] {
        for turns in 1..until_home - 3 {
            let mut rig = late_akd();
            let stood = rig.drive.position();
            rig.order(Command::Home);
            rig.turns(turns);
            rig.order(command);
            let step = |rig: &mut Rig, turns| {
                for _ in 0..turns {
                    rig.turn();
                    let starts = rig.control() & 0x10 != 0;
                    assert!(
                        !(starts && (rig.drive.mode() == Mode::HOMING.0 || rig.outputs[place] == 6)),
                        "{command:?} after {turns}"
                    );
                    let moved = rig.drive.position() - stood;
                    assert!(moved.abs() < 1_000, "{command:?} after {turns}: {moved} counts");
                }
            };
            step(&mut rig, 300);
            assert_eq!(rig.outputs[place], 7, "{command:?} after {turns}");
            rig.order(Command::ResetFault);
            step(&mut rig, 100);
            rig.order(Command::Enable);
            step(&mut rig, 500);
            assert_eq!(
                (rig.control(), rig.drive.mode()),
                (0x1F, Mode::INTERPOLATED.0),
                "{command:?} after {turns}"
            );
            rig.done(Rig::by(0.1));
        }
    }
    rig.until("its end", 20_000, |rig| rig.end().is_some());
    assert_eq!(rig.end(), Some(Ok(())));
    rig.done(Rig::to(1.0));
}

/// The application's targets, before it writes one: the drive holds its load where it came into operation.
#[test]
fn an_axis_whose_targets_are_the_applications_does_not_sink_under_its_load() {
    for (mode, target) in [(Mode::CYCLIC_POSITION, (0x607A, 0)), (Mode::INTERPOLATED, (0x60C1, 1))] {
        let mut plan = akd(mode, &[target]);
        plan.native = true;
        let mut rig = Rig::with(plan, |settings| settings.motor.load_nm = 2.0);
        let stood = rig.drive.position();
        rig.done(Command::Enable);
        rig.turns(20);
        // 2 N m by a stiffness of 284 N m a rad are 1174 counts, once in each cycle until it shows its state.
        let held = rig.drive.position();
        assert!((500..5_000).contains(&(stood - held)), "{mode:?}: {}", stood - held);
        for _ in 0..2_000 {
            rig.turn();
            assert!((rig.drive.position() - held).abs() < 10, "{mode:?}: {}", rig.drive.position() - held);
        }
        // Nor does it before the application has written.
        rig.order(Command::Native(NativeOwner::Master));
        for _ in 0..500 {
            rig.turn();
            assert!((rig.drive.position() - held).abs() < 10, "{mode:?}: {}", rig.drive.position() - held);
        }
        // Without power it may be moved: from then on it is held there.
        rig.done(Command::Disable);
        let target_at = rig.plan.outputs.place(Object::new(target.0, target.1)).unwrap();
        let target = |rig: &Rig| {
            let bytes = rig.outputs[target_at..].first_chunk::<4>().unwrap();
            i64::from(i32::from_le_bytes(*bytes))
        };
        rig.turns(5);
        assert!((target(&rig) - rig.drive.position()).abs() < 10, "{mode:?}");
    }
}

#[test]
fn a_drive_found_with_another_watchdog_is_not_enabled_unless_it_is_to_have_none() {
    for (watchdog, takes) in
        [(Watchdog::AsDelivered, false), (Watchdog::After(100 * MS), false), (Watchdog::Off, true)]
    {
        let mut plan = position();
        plan.slave.watchdog = watchdog;
        let mut rig = Rig::new(plan);
        rig.station.profile.found_otherwise = true;
        rig.station.unsettle();
        rig.turns(2);
        match rig.run(Command::Enable) {
            Ok(()) => assert!(takes, "{watchdog:?}"),
            Err(Failure::Unsupported(why)) => assert!(why.contains("another watchdog") && !takes, "{why}"),
            Err(other) => panic!("{watchdog:?}: {other:?}"),
        }
    }
}

#[test]
fn a_homing_that_is_stopped_or_fails_leads_back_to_its_own_mode() {
    for stop in [STOP, Command::QuickStop] {
        let mut rig = Rig::enabled(position());
        rig.order(Command::Home);
        rig.turns(200);
        assert!(rig.slot.status.moving, "{:?}", rig.machine);
        rig.done(stop);
        rig.assert_standing();
        assert!(!rig.slot.status.homed);
        rig.done(Rig::by(0.1));
    }
    let mut plan = position();
    plan.home_method = Some(1);
    let mut rig = Rig::with(plan, |settings| settings.home_turns = None);
    rig.done(Command::Enable);
    assert!(matches!(rig.run(Command::Home), Err(Failure::Unsupported(why)) if why.contains("homing error")));
    rig.assert_standing();
    rig.done(Rig::by(0.1));
}

#[test]
fn a_drive_that_falls_to_safeop_is_not_reported_as_enabled_and_does_not_come_back_by_itself() {
    let mut rig = Rig::enabled(velocity());
    rig.order(Rig::jog(1.0));
    rig.turns(200);
    rig.drive.may_enter(rig.now, sim::AlState::SafeOp).unwrap();
    rig.al = AlState::SafeOp;
    rig.turn();
    assert!(!matches!(rig.state(), State::OperationEnabled | State::QuickStopActive), "{:?}", rig.state());
    rig.turn();
    assert!(matches!(rig.end(), Some(Err(Failure::Dropped(_)))), "{:?}", rig.end());
    rig.turns(300);
    rig.drive.may_enter(rig.now, sim::AlState::Op).unwrap();
    rig.al = AlState::Op;
    rig.station.operational(Some(AlState::Op), &mut rig.slot);
    for _ in 0..300 {
        rig.turn();
        assert!(!rig.state().is_powered());
    }
    rig.done(Command::Enable);
    rig.assert_standing();
}

#[test]
fn native_outputs_go_out_as_they_are_and_the_master_keeps_its_control_word() {
    let mut rig = Rig::enabled(velocity());
    rig.order(Command::Native(NativeOwner::Master));
    rig.turns(5);
    assert!(rig.native.inputs().running);
    let rpm = 60.0;
    let count = (rpm / rig.plan.scaling.rpm_per_count) as i64;
    let output = rig.native.output(&[(Object::new(0x606B, 0), count)]).unwrap();
    rig.native.write(output).unwrap();
    rig.turns(500);
    assert_eq!(rig.control(), 0x0F);
    assert!((rig.drive.rpm() - rpm).abs() < 1.0, "{}", rig.drive.rpm());
    rig.done(STOP);
    rig.assert_standing();
    rig.order(Command::Native(NativeOwner::Application));
    rig.turns(5);
    let output = rig.native.output(&[(CONTROL_WORD, 7)]).unwrap();
    rig.native.write(output).unwrap();
    rig.turns(5);
    assert_eq!(rig.native.inputs().get(STATUS_WORD).unwrap() & 0x6F, 0x23);
    assert_eq!((rig.end(), rig.drive.axis_state()), (None, State::SwitchedOn));
    rig.done(Command::Disable);
}

#[test]
fn objects_are_shown_in_turns_and_a_refusal_is_reported_once() {
    let mut plan = velocity();
    plan.show[0] = Some(Entry { object: Object::new(0x6061, 0), kind: Type::I8 });
    plan.show[2] = Some(Entry { object: Object::new(0x5FFF, 0), kind: Type::I32 });
    plan.show[3] = Some(Entry { object: Object::new(0x1018, 1), kind: Type::U32 });
    let mut rig = Rig::new(plan);
    let (mut refusals, mut shown) = (0, 0);
    for _ in 0..1_000 {
        rig.turn();
        refusals += u32::from(rig.slot.notices.take_refused().is_some_and(|(channel, _)| channel == 2));
        shown += u32::from(std::mem::take(&mut rig.slot.notices.monitor_fresh));
    }
    let mode = f64::from(Mode::DIGITAL_VELOCITY.0);
    assert_eq!(rig.slot.status.monitor, [Some(mode), None, None, Some(106.0)]);
    assert_eq!(refusals, 1);
    assert!((20..=100).contains(&shown), "{shown}");
}

#[test]
fn a_slot_that_is_passed_over_is_made_up_for_but_a_pause_is_not() {
    let mut rig = Rig::enabled(position());
    rig.order(Rig::by(10.0));
    rig.turns(300);
    rig.steepest = 0;
    rig.turns(1);
    let usual = rig.steepest;
    for (passed, most) in [(1, 2), (50, 2)] {
        rig.now = rig.now + passed * PERIOD;
        let before = rig.setpoint();
        rig.prepare();
        let step = rig.setpoint() - before;
        assert!(step <= most * usual + 2 && step > usual, "{step} after {passed}");
        rig.send();
        rig.receive();
        rig.al = AlState::Op;
    }
}
