//! What the drives of a segment do, and what befalls them.

use std::time::Duration;

use fieldbeat::CyclePlan;
use fieldbeat::axis::{
    Abort, Call, CallError, CallTicket, Command, Emergency, Event, EventKind, Failure, FoundRunning, Link,
    Move, NativeOwner, Outcome, Profile, Row, State, StopCause, Target,
};
use fieldbeat::bus::ethercat::{
    Area, Device, EthercatPlan, Family, KollmorgenDrive, Layout, Mapping, Native, Object, SlavePlan,
    Terminals, Type, Watchdog,
};
use fieldbeat::sim::ethercat::{EthercatSegment, EthercatSim};
use fieldbeat::sim::{FaultPlan, Simulated, WorldOptions};
use fieldbeat::time::MS;
use fieldbeat_ethercat::counters::Own;
use fieldbeat_ethercat::faults::Fault;
use fieldbeat_ethercat::object;
use fieldbeat_ethercat::wire::registers::AlState;

use super::{LINE, Machine, STOP, drive, jog, plan, with};

const CONTROL_WORD: Object = Object::new(0x6040, 0);
const VELOCITY_SETPOINT: Object = Object::new(0x606B, 0);
const POSITION: Object = Object::new(0x6064, 0);
const INCREMENTS: f64 = (1 << 20) as f64;

fn line(drives: Vec<KollmorgenDrive>) -> EthercatPlan {
    EthercatPlan::new(LINE, drives)
}

fn go(target: Target) -> Command {
    Command::Move(Move { target, profile: Profile { velocity: 5.0, acceleration: 50.0, deceleration: 50.0 } })
}

/// Drives that take positions: of an S700, and of an AKD in both of its modes.
fn positions() -> Vec<KollmorgenDrive> {
    vec![
        with(0, Family::S700, 0x1701, 0x1B03),
        with(1, Family::Akd, 0x1701, 0x1B01),
        with(2, Family::Akd, 0x1724, 0x1B24),
    ]
}

/// A drive that takes torques, with a limit that ends a runaway.
pub fn torque(place: u16) -> KollmorgenDrive {
    let mut drive = with(place, Family::S700, 0x1703, 0x1B03);
    drive.axis.limits.velocity = Some(20.0);
    drive.axis.limits.torque = Some(150.0);
    drive
}

/// Gives a torque anew in each of so many cycles.
pub fn press(machine: &mut Machine, index: usize, torque: f64, cycles: u64) {
    for _ in 0..cycles {
        machine.sim.axis(index).set_torque(torque).unwrap();
        machine.run(1);
    }
}

#[test]
fn positions_are_moved_to_and_streams_followed() {
    let mut machine = Machine::enabled(line(positions()));
    for index in 0..3 {
        let at = machine.feedback(index).status.demand;
        for (target, place) in [
            (Target::Absolute(at + 2.5), at + 2.5),
            (Target::Relative(-4.0), at - 1.5),
            (Target::Absolute(at), at),
        ] {
            machine.done(index, go(target));
            machine.run(100);
            let feedback = machine.feedback(index);
            assert!((feedback.status.position - place).abs() < 1e-3, "{index}: not at {place}: {feedback:?}");
            assert!(feedback.status.in_target && !feedback.status.moving, "{feedback:?}");
        }
        let from = machine.feedback(index).status.demand;
        let id = machine.sim.axis(index).follow().unwrap();
        for n in 1..=400_u32 {
            let phase = f64::from(n) / 400.0;
            let position = from + phase * phase * (3.0 - 2.0 * phase);
            let row = Row { position, last: n == 400, ..Row::default() };
            machine.sim.axis(index).push_row(row).unwrap();
            machine.run(1);
        }
        assert_eq!(machine.sim.run_command(index, id, 500), Some(Outcome::Done));
        machine.run(100);
        let feedback = machine.feedback(index);
        assert!((feedback.status.position - from - 1.0).abs() < 1e-3, "{feedback:?}");
        assert_eq!(machine.drive(index, |drive| drive.fault()), None);
    }
}

#[test]
fn a_stop_under_torque_halts_the_drive_and_its_neighbour_has_none_of_it() {
    let mut machine = Machine::enabled(line(vec![torque(0), torque(1)]));
    machine.post(0, Command::Torque { slope: 20.0 });
    press(&mut machine, 0, 4.0, 400);
    assert!(machine.feedback(0).status.velocity > 1.8);
    assert!(machine.feedback(1).status.velocity.abs() < 0.05);
    machine.done(0, STOP);
    let feedback = machine.feedback(0);
    assert!(
        !feedback.status.moving && feedback.status.velocity.abs() < 0.05 && feedback.stopped.is_none(),
        "{feedback:?}"
    );
    assert_eq!(feedback.status.state, State::OperationEnabled);
    assert!(matches!(
        crate::virtual_time::support::refused(machine.sim.axis(1), jog(1.0)),
        Failure::Unsupported(_)
    ));
}

#[test]
fn pdos_are_mapped_freely_and_an_akd_takes_torques_by_one() {
    let layout = |pdo, objects: &[(u16, u8)]| {
        let objects: Vec<Object> = objects.iter().map(|(index, sub)| Object::new(*index, *sub)).collect();
        Layout::of_known(pdo, &objects).unwrap()
    };
    let mut turning = drive(0, Family::S700);
    turning.outputs = layout(0x1600, &[(0x6040, 0), (0x606B, 0)]);
    turning.inputs = layout(0x1A00, &[(0x6041, 0), (0x606C, 0), (0x6064, 0)]);
    let mut pressing = drive(1, Family::Akd);
    pressing.outputs = layout(0x1600, &[(0x6071, 0), (0x6040, 0), (0x6072, 0)]);
    pressing.inputs = layout(0x1A00, &[(0x6041, 0), (0x6063, 0), (0x6077, 0), (0x603F, 0)]);
    pressing.axis.limits.velocity = Some(20.0);
    pressing.scaling.rated_current = Some(6.0);
    for drive in [&mut turning, &mut pressing] {
        drive.mapping = Mapping::Free;
        drive.fit();
    }
    let mut machine = Machine::enabled(line(vec![turning, pressing]));
    machine.post(0, jog(3.0));
    machine.post(1, Command::Torque { slope: 1_000.0 });
    press(&mut machine, 1, -5.0, 300);
    machine.assert_turns(0, 3.0);
    let feedback = machine.feedback(1);
    assert!(feedback.status.velocity < -1.0 && (feedback.status.current + 0.3).abs() < 0.02, "{feedback:?}");
    machine.drive(1, |drive| drive.provoke(Fault::AMBIENT));
    machine.run(20);
    assert_eq!(machine.feedback(1).status.fault, 0x4110, "by 603Fh");
}

#[test]
fn a_fault_stops_the_axis_by_its_name_and_is_reset() {
    for (fault, heals) in [(Fault::MOTOR_TEMPERATURE, true), (Fault::FOLLOWING, true), (Fault::EARTH, false)]
    {
        let mut machine = Machine::enabled(plan(2));
        let id = machine.sim.axis(0).post(jog(5.0)).unwrap();
        machine.post(1, jog(-5.0));
        machine.run(300);
        machine.drive(0, |drive| drive.provoke(fault));
        let ended = machine.sim.run_command(0, id, 300);
        let stopped = Outcome::Aborted(Abort::Stopped(StopCause::DriveFault));
        let failed = Outcome::Failed(Failure::DriveFault(fault.code.into()));
        assert!(ended == Some(stopped) || ended == Some(failed), "{ended:?}");
        machine.run(500);
        let feedback = machine.feedback(0);
        assert_eq!((feedback.status.state, feedback.stopped), (State::Fault, Some(StopCause::DriveFault)));
        assert_eq!(feedback.status.fault, u32::from(fault.code));
        assert_eq!(machine.sim.axis(0).fault(feedback.status.fault).name, Some(fault.name));
        machine.assert_turns(1, -5.0);
        let reset = machine.ended(0, Command::ResetFault);
        if heals {
            assert_eq!(reset, Outcome::Done);
            assert_eq!(
                (machine.feedback(0).status.state, machine.feedback(0).status.fault),
                (State::SwitchOnDisabled, 0)
            );
            machine.recover(0);
            machine.post(0, jog(1.0));
            machine.run(300);
            machine.assert_turns(0, 1.0);
        } else {
            assert!(matches!(reset, Outcome::Failed(Failure::Unsupported(_))), "{reset:?}");
        }
        let reported = machine.end()[0].own[Own::Emergencies as usize];
        assert_eq!(reported, if heals { 2 } else { 1 }, "the fault, and the end of it");
    }
}

/// The emergencies that the application received, and of which axis.
fn emergencies(machine: &mut Machine) -> Vec<(usize, Emergency)> {
    let mut all = std::mem::take(&mut machine.sim.events);
    for index in 0..machine.count {
        all.extend(std::iter::from_fn(|| machine.sim.axis(index).event()).map(|event| (index, event)));
    }
    let reported = all.into_iter().filter_map(|(index, event)| match event.kind {
        EventKind::Emergency(emergency) => Some((index, emergency)),
        _ => None,
    });
    reported.collect()
}

#[test]
fn an_emergency_is_an_event_with_code_and_register_and_so_is_its_end() {
    let mut machine = Machine::enabled(plan(2));
    assert_eq!(emergencies(&mut machine), []);
    machine.drive(1, |drive| drive.provoke(Fault::MOTOR_TEMPERATURE));
    machine.run(100);
    let reported = Emergency { code: 0x4310, register: 8 };
    assert_eq!(emergencies(&mut machine), [(1, reported)]);
    assert_eq!(machine.sim.axis(1).fault(reported.code.into()).name, Some("motor temperature"));
    assert_eq!(machine.ended(1, Command::ResetFault), Outcome::Done);
    machine.run(100);
    let over = emergencies(&mut machine);
    assert!(matches!(over[..], [(1, Emergency { code: 0, .. })]), "{over:?}");
    // The telemetry has the same.
    let kept: Vec<_> =
        machine.sim.measured().emergencies.iter().map(|one| (one.axis, one.emergency)).collect();
    assert_eq!(kept, [(1, reported), over[0]]);
}

#[test]
fn an_emergency_before_the_first_exchange_is_an_event_too() {
    let mut machine = Machine::new(plan(1));
    machine.until("PREOP", 2_000, |machine| {
        machine.look(|line| line.slave(0).unwrap().state() == AlState::PreOp)
    });
    machine.drive(0, |drive| drive.provoke(Fault::OVERVOLTAGE));
    let mut reported = Vec::new();
    for _ in 0..500 {
        machine.run(1);
        reported.extend(emergencies(&mut machine));
        if !reported.is_empty() {
            break;
        }
    }
    assert_eq!(reported, [(0, Emergency { code: 0x3110, register: 4 })]);
    assert_eq!(machine.feedback(0).link, Link::Unseen);
}

/// The frames go out in each cycle, whether an exchange is due or not: what is in them must not stay as it was when the
/// link was lost.
#[test]
fn the_stop_of_a_lost_link_goes_on_in_each_frame() {
    let mut machine = Machine::enabled(plan(1));
    machine.post(0, jog(10.0));
    machine.run(500);
    machine.assert_turns(0, 10.0);
    assert!(machine.sim.world().set_segment_faults(LINE, FaultPlan { drop: 1.0, ..FaultPlan::default() }));
    machine.until("lost", 100, |machine| machine.feedback(0).link == Link::Lost);
    // What is requested of a lost link at once is lost too.
    machine.run(3);
    assert!(machine.sim.world().set_segment_faults(LINE, FaultPlan::default()));
    machine.run(30);
    // 200 rev/s² for 30 ms are 360 rpm.
    let rpm = machine.drive(0, |drive| drive.rpm());
    assert!(rpm < 400.0, "still at {rpm} rpm");
    machine.until("it stands", 500, |machine| machine.drive(0, |drive| drive.rpm()).abs() < 1.0);
}

/// A segment that is there already.
pub fn left(line: EthercatSim) -> Simulated {
    Simulated { segments: vec![Box::new(line)], ..Simulated::default() }
}

/// Another master for a segment that the first one has brought up and left.
pub fn take_over(first: Machine, plan: &EthercatPlan, found: FoundRunning) -> Machine {
    let mut plan = plan.clone();
    plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = found);
    let line = first.look(|line| std::mem::replace(line, EthercatSim::of(&plan)));
    let options = WorldOptions { start: first.sim.world().now(), ..WorldOptions::default() };
    Machine::on(Box::new(plan), left(line), CyclePlan::default(), options)
}

/// Speeds of the motors, rpm.
fn rpm<const N: usize>(machine: &Machine) -> [f64; N] {
    std::array::from_fn(|place| machine.drive(place, |drive| drive.rpm()))
}

/// Turning, and left by its master.
fn running(plan: &EthercatPlan, found: FoundRunning) -> Machine {
    let mut first = Machine::enabled(plan.clone());
    first.post(0, jog(1.0));
    first.post(1, jog(1.0));
    first.run(500);
    take_over(first, plan, found)
}

#[test]
fn drives_found_running_without_a_watchdog_are_stopped_along_a_ramp_or_left_alone() {
    let mut drives =
        vec![drive(0, Family::S700), with(1, Family::S700, 0x1701, 0x1B03), drive(2, Family::S700)];
    for drive in &mut drives {
        drive.slave.watchdog = Watchdog::Off;
        drive.accept_no_watchdog = true;
        (drive.axis.stop.deceleration, drive.axis.profile.velocity) = (2.0, 2.0);
    }
    let plan = line(drives);
    let mut machine = running(&plan, FoundRunning::Stop);
    let mut before = 60.0;
    let mut ramp = 0;
    while machine.feedback(0).stopped.is_none() || machine.feedback(0).status.state.is_powered() {
        machine.run(1);
        let [now, ..] = rpm::<3>(&machine);
        assert!((now - before).abs() < 1.0, "{now} behind {before}");
        assert!(machine.sim.status().planned < 8_000, "{:?}", machine.feedback(0));
        ramp += u32::from(now < 55.0 && now > 5.0);
        before = now;
    }
    // From 55 to 5 rpm with 120 rpm a second.
    assert!((380..450).contains(&ramp), "{ramp}");
    machine.online();
    machine.run(3_000);
    for index in 0..3 {
        let feedback = machine.feedback(index);
        assert_eq!(feedback.stopped, Some(StopCause::FoundRunning), "{index}: {feedback:?}");
        assert!(!feedback.status.state.is_powered(), "{feedback:?}");
        machine.recover(index);
        machine.post(index, jog(2.0));
        machine.run(500);
        machine.assert_turns(index, 2.0);
    }
}

#[test]
fn drives_found_running_that_their_watchdog_stops_are_set_up_anew() {
    let drives = vec![drive(0, Family::S700), with(1, Family::S700, 0x1701, 0x1B03)];
    for found in [FoundRunning::Stop, FoundRunning::Refuse] {
        let mut machine = running(&line(drives.clone()), found);
        machine.run(300);
        assert!(rpm::<2>(&machine).iter().all(|rpm| rpm.abs() < 3.0));
        machine.run(5_000);
        for index in 0..2 {
            assert_eq!(machine.feedback(index).link, Link::Online);
            machine.recover(index);
            machine.post(index, jog(2.0));
            machine.run(500);
            machine.assert_turns(index, 2.0);
        }
        let numbers = machine.end();
        assert!(numbers.iter().all(|counters| counters.own[Own::AlErrors as usize] <= 1), "{numbers:?}");
    }
}

#[test]
fn native_process_data_are_the_applications() {
    for owner in [NativeOwner::Master, NativeOwner::Application] {
        let mut machine = Machine::enabled(plan(1));
        let mut native = machine.sim.axis(0).native::<Native>().expect("the first to ask");
        assert!(machine.sim.axis(0).native::<Native>().is_none(), "there is one");
        machine.post(0, Command::Native(owner));
        machine.run(5);
        assert!(native.inputs().running);
        let place = native.inputs().get(POSITION).unwrap();
        // 2 rev/s in increments per 250 us.
        let velocity = (2.0 * INCREMENTS / 4_000.0) as i64;
        let control = if owner == NativeOwner::Master { 0 } else { 0x0F };
        let output = native.output(&[(VELOCITY_SETPOINT, velocity), (CONTROL_WORD, control)]).unwrap();
        native.write(output).unwrap();
        machine.run(1_000);
        machine.assert_turns(0, 2.0);
        assert!(native.inputs().get(POSITION).unwrap() - place > INCREMENTS as i64);
        assert_eq!(native.output(&[(POSITION, 0)]), None, "it is no output");
        machine.done(0, STOP);
        machine.run(100);
        assert!(machine.drive(0, |drive| drive.rpm()).abs() < 3.0);
    }
}

#[test]
fn terminals_between_drives_exchange_in_the_same_cycle() {
    let area = |start, length| Area { start, length };
    let slave =
        SlavePlan { outputs: vec![area(0x1000, 4)], inputs: vec![area(0x1100, 4)], ..SlavePlan::new(1) };
    let terminals = fieldbeat_sim::ethercat::coupler::Terminals { digital: 16, analogue: 1 };
    let coupler = fieldbeat::sim::ethercat::Coupler { outputs: terminals, inputs: terminals };
    let io = Device { name: "io".into(), slave };
    let drives = vec![drive(0, Family::S700), drive(2, Family::S700)];
    let segment = EthercatSegment::from(EthercatPlan { devices: vec![io], ..line(drives) });
    let mut machine = Machine::new(EthercatSegment { devices: vec![coupler], ..segment });
    let mut io = machine.sim.device::<Terminals>("io").unwrap();
    assert!(machine.sim.device::<Terminals>("io").is_err(), "taken once");
    machine.online();
    for index in 0..2 {
        machine.done(index, Command::Enable);
        machine.post(index, jog(1.0));
    }
    assert_eq!(io.sizes(), (4, 4));
    for _ in 0..3_000 {
        if !io.inputs().operational {
            machine.run(1);
        }
    }
    for n in 0..200_u8 {
        let outputs = [n, 0x55, 0x34, n];
        io.write(&outputs).unwrap();
        machine.run(4);
        let inputs = io.inputs();
        assert!(inputs.operational, "{:?}", machine.look(|line| line.slave(1).unwrap().state()));
        assert_eq!(inputs.bytes(), outputs);
    }
    for (index, place) in [(0, 0), (1, 2)] {
        assert!((machine.feedback(index).status.velocity - 1.0).abs() < 0.1);
        assert!((machine.drive(place, |drive| drive.rpm()) - 60.0).abs() < 3.0);
    }
}

/// Lets the loop turn until a call has ended.
pub fn answer(machine: &mut Machine, mut ticket: CallTicket) -> Result<u64, CallError> {
    for _ in 0..2_000 {
        if let Some(end) = ticket.poll() {
            return end.map(|answer| answer.value);
        }
        machine.run(1);
    }
    panic!("no answer");
}

#[test]
fn objects_are_read_and_written_while_the_axis_moves() {
    let mut machine = Machine::enabled(line(vec![drive(0, Family::S700), drive(1, Family::Akd)]));
    let limit = Duration::from_secs(2);
    for index in 0..2 {
        machine.post(index, jog(3.0));
        machine.run(200);
        let acyclic = machine.sim.axis(index).acyclic().clone();
        let mut call = |call: Call| {
            let ticket = acyclic.post(call, limit).unwrap();
            let end = answer(&mut machine, ticket);
            assert_eq!(machine.feedback(index).age, 0, "the cycle goes on");
            end
        };
        let target = |text| object::Target::parse(text).unwrap();
        assert_eq!(call(target("0x1018:1").read()), Ok(0x6A));
        assert_eq!(call(target("profile-acceleration").write(7_000)), Ok(7_000));
        assert_eq!(call(target("0x6083:0").read()), Ok(7_000));
        // Out of its range, and not there.
        assert_eq!(call(target("homing-method").write(36)), Err(CallError::Refused(0x0609_0031)));
        assert_eq!(call(target("0x5FFF:0").read()), Err(CallError::Refused(0x0602_0000)));
        machine.assert_turns(index, 3.0);
    }
    // Forty characters, in segments.
    let acyclic = machine.sim.axis(1).acyclic().clone();
    let target = object::Target::parse("0x1008:0").unwrap();
    let parts = (1..5).map(|part| (object::PART, 8 * part));
    let calls: Vec<Call> = [(object::READ, 0), (object::SIZE, 0)]
        .into_iter()
        .chain(parts)
        .map(|(service, value)| Call { service, address: target.pack(), value })
        .collect();
    let tickets = acyclic.post_series(&calls, limit).unwrap();
    let values: Vec<u64> =
        tickets.into_iter().map(|ticket| answer(&mut machine, ticket).expect("an answer")).collect();
    assert_eq!(values[1], 40);
    let bytes: Vec<u8> =
        [0, 2, 3, 4, 5].iter().flat_map(|place| values[*place as usize].to_le_bytes()).collect();
    assert_eq!(String::from_utf8(bytes).unwrap(), "AKD-P00306-NBEC-0000 (a simulated drive)");
    machine.assert_turns(1, 3.0);
    assert_eq!(machine.end()[1].own[Own::Aborts as usize], 2);
}

#[test]
fn objects_are_shown_beside_the_process_data() {
    let mut plan = plan(1);
    let shown = |index| Some((Object::new(index, 0), Type::I8));
    plan.drives[0].show[0] = shown(0x6061);
    plan.drives[0].show[2] = Some((Object::new(0x6064, 0), Type::I32));
    plan.drives[0].show[3] = shown(0x5FFF);
    let mut machine = Machine::enabled(plan);
    machine.post(0, jog(1.0));
    machine.run(500);
    let feedback = machine.feedback(0);
    assert_eq!(
        (feedback.status.monitor[0], feedback.status.monitor[1], feedback.status.monitor[3]),
        (Some(-128.0), None, None)
    );
    let place = feedback.status.monitor[2].expect("it is shown") / INCREMENTS;
    assert!((place - feedback.status.position).abs() < 0.1, "plain counts, of not long ago: {place}");
    let mut events = std::mem::take(&mut machine.sim.events);
    events.extend(std::iter::from_fn(|| machine.sim.axis(0).event()).map(|event| (0, event)));
    let is_refusal =
        |(_, event): &&(usize, Event)| matches!(event.kind, EventKind::MonitorRefused { channel: 3, .. });
    assert_eq!(events.iter().filter(is_refusal).count(), 1, "reported once: {events:?}");
}

#[test]
fn without_its_master_each_drive_stops_within_its_watchdog() {
    let mut drives = vec![drive(0, Family::S700), with(1, Family::S700, 0x1701, 0x1B03), torque(2)];
    drives.push(drive(3, Family::Akd));
    drives[3].slave.watchdog = Watchdog::After(20 * MS);
    let mut machine = Machine::enabled(line(drives));
    for index in [0, 1, 3] {
        machine.post(index, jog(2.0));
    }
    machine.post(2, Command::Torque { slope: 100.0 });
    press(&mut machine, 2, 3.0, 500);
    let rpm = |machine: &Machine| rpm::<4>(machine).map(f64::abs);
    assert!(rpm(&machine).iter().all(|rpm| *rpm > 50.0));
    let world = machine.sim.world().clone();
    world.advance(15 * MS);
    let [velocity, _, torque, short] = rpm(&machine);
    assert!(velocity > 100.0 && torque > 50.0 && short > 100.0, "nothing has stopped them yet");
    world.advance(60 * MS);
    let [velocity, _, _, short] = rpm(&machine);
    assert!(velocity > 100.0 && short < 3.0, "{velocity} {short}");
    world.advance(80 * MS);
    assert!(rpm(&machine).iter().all(|rpm| *rpm < 3.0), "{:?}", rpm(&machine));
    for place in 0..4 {
        assert_eq!(machine.look(|line| line.slave(place).unwrap().state()), AlState::SafeOp);
        assert_eq!(machine.drive(place, |drive| drive.axis_state()), State::SwitchOnDisabled);
    }
    // It lives again: nothing moves by itself.
    machine.run(3_000);
    assert!(rpm(&machine).iter().all(|rpm| *rpm < 3.0));
    assert!((0..4).all(|index| machine.feedback(index).stopped.is_some()));
}

#[test]
fn clocks_of_32_bits_that_go_round_are_noticed_by_nobody() {
    for leads in [false, true] {
        let drives = vec![with(0, Family::Akd, 0x1701, 0x1B01), with(1, Family::Akd, 0x1701, 0x1B01)];
        let mut segment = EthercatSegment::from(line(drives));
        segment.settings.short_clocks = true;
        segment.settings.drift_ppm = vec![80.0, -40.0];
        let mut machine = Machine::with(segment, leads, WorldOptions::default());
        machine.online();
        machine.each(Command::Enable);
        for index in 0..2 {
            machine.post(index, jog(2.0));
        }
        machine.run(500);
        for _ in 0..9_000 {
            machine.run(1);
            for index in 0..2 {
                let feedback = machine.feedback(index);
                assert!(feedback.age == 0 && (feedback.status.velocity - 2.0).abs() < 0.1, "{feedback:?}");
            }
        }
        assert!((0..2).all(|place| machine.drive(place, |drive| drive.is_synchronous())));
        let counters = machine.end();
        assert!(counters.iter().all(|counters| counters.own[Own::AlErrors as usize] == 0));
    }
}
