//! Drives that change their places while the master runs: some are taken out, others put in, cables cut and repaired,
//! at any time. Whatever comes of it, an axis moves its own drive, or none.

use fastrand::Rng;
use fieldbeat::CyclePlan;
use fieldbeat::axis::{Command, Link, StopCause};
use fieldbeat::bus::ethercat::{EthercatPlan, Expected, Family, Watchdog};
use fieldbeat::sim::{SimPlan, SimSegment, WorldOptions};
use fieldbeat_ethercat::wire::frame::{Command as Frame, position};
use fieldbeat_ethercat::wire::registers::address;
use fieldbeat_sim::ethercat::EthercatSegment;

use super::{LINE, Machine, drive, jog, plan};

const DRIVES: usize = 4;
const AXES: usize = 3;

/// Drives, and a master that knows of the first ones that are there.
fn machine(absent: usize, watched: bool) -> Machine {
    let drives = (0..DRIVES as u16).map(|place| {
        let mut drive = drive(place, Family::S700);
        if !watched {
            (drive.slave.watchdog, drive.accept_no_watchdog) = (Watchdog::Off, true);
        }
        drive
    });
    let whole = EthercatPlan::new(LINE, drives.collect());
    let plan = EthercatPlan { drives: whole.drives[..AXES].to_vec(), ..whole.clone() };
    let segment = SimPlan::from(EthercatSegment::from(&whole)).build();
    let machine = Machine::on(Box::new(plan), segment, CyclePlan::default(), WorldOptions::default());
    machine.look(|line| line.deafen(absent, true));
    machine
}

/// The drives that turn while this axis alone shall turn.
fn turning(machine: &mut Machine, axis: usize, drives: usize) -> Vec<usize> {
    for command in [Command::Reset, Command::Enable] {
        machine.post(axis, command);
        machine.run(400);
    }
    // It is refused if the axis is not in operation.
    let _ = machine.sim.axis(axis).post(jog(1.0));
    machine.run(150);
    let turns = |place: &usize| machine.drive(*place, |drive| drive.rpm().abs() > 20.0);
    let turning = (0..drives).filter(turns).collect();
    let _ = machine.sim.axis(axis).post(super::STOP);
    machine.run(100);
    machine.post(axis, Command::Disable);
    machine.run(50);
    turning
}

#[test]
fn an_axis_moves_its_own_drive_or_none_when_slaves_are_removed_or_added() {
    for seed in 0..5 {
        let mut random = Rng::with_seed(seed);
        let absent = random.usize(..DRIVES);
        let mut machine = machine(absent, random.bool());
        machine.online();
        machine.each(Command::Enable);
        let own: Vec<_> = (0..DRIVES).filter(|place| *place != absent).collect();
        for round in 0..3 {
            // The cable is out for so long, while one is taken out or put in; or it is so without that.
            if random.u8(..4) > 0 {
                let cut = random.usize(..DRIVES);
                machine.look(|line| line.cut(Some(cut)));
                machine.run([5, 50, 300][random.usize(..3)]);
            }
            let (place, deaf) = (random.usize(..DRIVES), random.bool());
            let place = if round == 0 { absent } else { place };
            machine.look(|line| line.deafen(place, deaf && round > 0));
            machine.look(|line| line.cut(None));
            machine.run(random.u64(..4_000));
            let mut moved = Vec::new();
            for axis in 0..AXES {
                let turning = turning(&mut machine, axis, DRIVES);
                assert!(turning.len() <= 1, "seed {seed}, round {round}: axis {axis} turns {turning:?}");
                // One that had no axis may have one now.
                let is_own = turning.iter().all(|one| *one == own[axis] || *one == absent);
                assert!(is_own || round > 0, "seed {seed}: axis {axis} of {own:?} turns {turning:?}");
                moved.extend(turning);
            }
            let once = (0..DRIVES).all(|place| moved.iter().filter(|one| **one == place).count() <= 1);
            assert!(once, "seed {seed}, round {round}: {moved:?}");
        }
        machine.look(|line| (0..DRIVES).for_each(|place| line.deafen(place, place == absent)));
        machine.run(500);
        machine.until("as it was", 70_000, |machine| {
            (0..AXES).all(|axis| machine.feedback(axis).link == Link::Online)
        });
        for (axis, place) in own.into_iter().enumerate() {
            machine.recover(axis);
            assert_eq!(
                turning(&mut machine, axis, DRIVES),
                [place],
                "seed {seed}: {:?}",
                machine.feedback(axis)
            );
        }
    }
}

/// Until a drive that was switched off and on has its station address again.
const ADDRESSED: u64 = 170;

#[test]
fn a_drive_that_is_absent_for_one_frame_while_it_is_set_up_gives_its_axis_no_other_drive() {
    let mut machine = Machine::new(plan(AXES as u16));
    machine.online();
    for turns in 0..ADDRESSED {
        machine.sim.world().restart_slave(LINE, 0);
        machine.run(turns);
        machine.look(|line| line.deafen(0, true));
        machine.run(1);
        machine.look(|line| line.deafen(0, false));
        // It may have been lost, or not yet.
        machine.run(200);
        machine.online();
        for axis in 0..AXES {
            machine.recover(axis);
            let powered = |place: &usize| machine.drive(*place, |drive| drive.axis_state()).is_powered();
            let powered: Vec<_> = (0..AXES).filter(powered).collect();
            assert_eq!(powered, [axis], "absent after {turns} turns");
            machine.done(axis, Command::Disable);
        }
    }
}

/// A slave behind the configured ones, with the address that an earlier master has left, moves up to the place of one
/// that is taken out.
#[test]
fn a_removed_drive_is_no_sign_of_another_master() {
    let mut whole = plan(DRIVES as u16);
    let segment = SimPlan::from(EthercatSegment::from(&whole)).build();
    whole.drives.truncate(AXES);
    let mut machine = Machine::on(Box::new(whole), segment, CyclePlan::default(), WorldOptions::default());
    machine.pass(Frame::Apwr(position(AXES as u16), address::STATION), &[0x34, 0x12]);
    machine.online();
    machine.each(Command::Enable);
    machine.post(0, jog(1.0));
    machine.run(300);
    machine.look(|line| line.deafen(AXES - 1, true));
    machine.run(1_000);
    assert_eq!([0, 1].map(|axis| machine.feedback(axis).stopped), [None; 2]);
    assert_eq!(machine.feedback(AXES - 1).stopped, Some(StopCause::LinkLost));
    machine.assert_turns(0, 1.0);
    machine.look(|line| line.deafen(AXES - 1, false));
    machine.online();
    let remarks = machine.sim.remarks();
    assert!(!remarks.iter().any(|remark| remark.contains("another master")), "{remarks:?}");
    machine.recover(AXES - 1);
}

/// The cables of two drives are mixed up, or the drives are, while they or the master are off.
#[test]
fn two_equal_drives_that_were_exchanged_while_they_were_off_move_neither_axis() {
    type Expect = fn(&mut Expected, u16);
    let by: [(&str, Expect); 3] = [
        ("serial number", |own, place| own.serial = Some(0x100 + u32::from(place))),
        ("alias", |own, place| own.alias = Some(place)),
        ("identification", |own, place| own.identification = Some(place)),
    ];
    for (what, known) in by {
        let mut plan = plan(AXES as u16);
        plan.drives.iter_mut().for_each(|drive| known(&mut drive.slave.identity, 1 + drive.slave.place));
        let exchange = |machine: &Machine| {
            machine.look(|line| line.segment().exchange(0, 1));
            [0, 1].into_iter().for_each(|place| assert!(machine.sim.world().restart_slave(LINE, place)));
        };
        let mut machine = Machine::new(plan.clone());
        machine.online();
        machine.each(Command::Enable);
        exchange(&machine);
        machine.run(8_000);
        for (axis, own) in [(0, &[][..]), (1, &[]), (2, &[2])] {
            assert_eq!(turning(&mut machine, axis, AXES), own, "{what}: axis {axis}");
        }
        exchange(&machine);
        machine.run(500);
        machine.until("put back", 70_000, |machine| {
            (0..AXES).all(|axis| machine.feedback(axis).link == Link::Online)
        });
        for axis in 0..AXES {
            machine.recover(axis);
            assert_eq!(turning(&mut machine, axis, AXES), [axis], "{what}");
        }
        // Before this master begins.
        let mut machine = Machine::new(plan);
        exchange(&machine);
        machine.run(8_000);
        for axis in 0..2 {
            assert!(turning(&mut machine, axis, AXES).is_empty(), "{what}: axis {axis}");
        }
        let end = machine.sim.finish();
        for (axis, drive) in end.drives.iter().enumerate().take(2) {
            let why = drive.not_connected.clone().unwrap_or_default();
            let is_said = why.starts_with(&format!("place {axis}: its ")) && why.contains(what);
            assert!(is_said && why.contains("drives or cables are exchanged"), "{why}");
        }
        assert_eq!(end.drives[2].not_connected, None);
    }
}
