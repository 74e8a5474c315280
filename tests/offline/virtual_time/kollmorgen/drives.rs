//! What the drives of a segment do, and what befalls them.

use fieldbeat::axis::{CallError, Command, Emergency, EventKind, Link, Outcome, State};
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive, Layout, Mapping, Object, Watchdog};
use fieldbeat::sim::{FaultPlan, Simulated};
use fieldbeat::time::MS;
use fieldbeat_core::axis::CallTicket;
use fieldbeat_ethercat::faults::Fault;
use fieldbeat_sim::ethercat::{AlState, EthercatSim};

use super::{LINE, Machine, drive, jog, plan, with};

fn line(drives: Vec<KollmorgenDrive>) -> EthercatPlan {
    EthercatPlan::new(LINE, drives)
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
    machine.drive(1, |drive| drive.provoke(Fault::AMBIENT.code));
    machine.run(20);
    assert_eq!(machine.feedback(1).status.fault, 0x4110, "by 603Fh");
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
    machine.drive(1, |drive| drive.provoke(Fault::MAINS.code));
    machine.run(100);
    let reported = Emergency { code: 0x3100, register: 4 };
    assert_eq!(emergencies(&mut machine), [(1, reported)]);
    assert_eq!(machine.sim.axis(1).fault(reported.code.into()).name, Some("mains"));
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
    machine.drive(0, |drive| drive.provoke(Fault::OVERVOLTAGE.code));
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
    let rpm = |machine: &Machine| [0, 1, 2, 3].map(|place| machine.drive(place, |drive| drive.rpm().abs()));
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
