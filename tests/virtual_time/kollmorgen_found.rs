//! Drives that another master has left in OP, and this one joins as they are, or does not.

use fieldbeat::axis::{Command, FoundRunning, Link, Outcome, StopCause};
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive, Layout, Mapping, Object, Watchdog};
use fieldbeat_ethercat::mode::Mode;
use fieldbeat_ethercat::wire::registers::AlState;

use super::kollmorgen::drives::take_over;
use super::kollmorgen::{LINE, Machine, drive, jog};

/// A drive that goes on by itself when its master is gone.
fn unwatched(mut drive: KollmorgenDrive) -> KollmorgenDrive {
    drive.slave.watchdog = Watchdog::Off;
    drive.accept_no_watchdog = true;
    (drive.axis.stop.deceleration, drive.axis.profile.velocity) = (2.0, 2.0);
    drive
}

fn line(drive: KollmorgenDrive) -> EthercatPlan {
    EthercatPlan::new(LINE, vec![drive])
}

/// Left as it turns by the master of one plan, and found by that of another.
fn left_turning(left: &EthercatPlan, found: &EthercatPlan, how: FoundRunning) -> Machine {
    let mut first = Machine::enabled(left.clone());
    first.post(0, jog(1.0));
    first.run(500);
    take_over(first, found, how)
}

fn rpm(machine: &Machine) -> f64 {
    machine.drive(0, |drive| drive.rpm())
}

fn free(outputs: &[u16], inputs: &[u16]) -> KollmorgenDrive {
    let objects = |indices: &[u16]| indices.iter().map(|index| Object::new(*index, 0)).collect::<Vec<_>>();
    let mut free = unwatched(drive(0, Family::S700));
    free.outputs = Layout::of_known(0x1600, &objects(outputs)).unwrap();
    free.inputs = Layout::of_known(0x1A00, &objects(inputs)).unwrap();
    free.mapping = Mapping::Free;
    free.fit();
    free
}

#[test]
fn a_drive_that_runs_with_other_objects_is_not_joined() {
    let plain = unwatched(drive(0, Family::S700));
    // As many bytes, in another order.
    let one = free(&[0x606B, 0x6040], &[0x6041, 0x6064, 0x606C]);
    let two = free(&[0x606B, 0x6040], &[0x6041, 0x606C, 0x6064]);
    let three = free(&[0x6040, 0x606B], &[0x6041, 0x6064, 0x606C]);
    for (left, found, joined) in
        [(&plain, &plain, true), (&one, &one, true), (&one, &two, false), (&one, &three, false)]
    {
        let mut machine = left_turning(&line(left.clone()), &line(found.clone()), FoundRunning::Refuse);
        machine.run(3_000);
        let feedback = machine.feedback(0);
        assert!((rpm(&machine) - 60.0).abs() < 3.0, "it is left alone: {} {feedback:?}", rpm(&machine));
        assert_eq!(feedback.link == Link::Online, joined, "{feedback:?}");
        let al = machine.look(|line| line.slave(0).unwrap().state());
        assert_eq!(al, AlState::Op);
        if joined {
            assert_eq!(feedback.stopped, Some(StopCause::FoundRunning));
            continue;
        }
        // By its own reaction to the end of OP, if it is to be stopped.
        let mut machine = left_turning(&line(left.clone()), &line(found.clone()), FoundRunning::Stop);
        machine.online();
        assert!(rpm(&machine).abs() < 3.0, "{}", rpm(&machine));
        machine.recover(0);
    }
}

#[test]
fn a_drive_that_runs_in_another_mode_is_halted_in_that() {
    let otherwise = free(&[0x60FF, 0x6040], &[0x6041, 0x6064, 0x606C]);
    let mut plain = otherwise.clone();
    plain.mode = Some(Mode::PROFILE_VELOCITY);
    let mut machine = left_turning(&line(plain), &line(otherwise), FoundRunning::Stop);
    let mode = |machine: &Machine| machine.drive(0, |drive| drive.mode());
    let mut turned = rpm(&machine);
    for _ in 0..3_000 {
        machine.run(1);
        let now = rpm(&machine);
        if now.abs() > 3.0 {
            assert_eq!(mode(&machine), Mode::PROFILE_VELOCITY, "at {now} rpm");
            let al = machine.look(|line| line.slave(0).unwrap().state());
            assert!(now < turned + 1.0 && al == AlState::Op, "{now} behind {turned}, {al}");
        }
        turned = now;
    }
    assert!(
        turned.abs() < 3.0 && !machine.feedback(0).status.state.is_powered(),
        "{:?}",
        machine.feedback(0)
    );
    machine.recover(0);
    assert_eq!(mode(&machine), Mode::DIGITAL_VELOCITY);
}

#[test]
fn a_drive_found_without_power_is_set_up_before_its_axis_hears_of_it() {
    let plan = line(unwatched(drive(0, Family::S700)));
    let mut first = Machine::new(plan.clone());
    first.online();
    let mut machine = take_over(first, &plan, FoundRunning::Stop);
    machine.online();
    let id = machine.sim.axis(0).post(Command::Enable).unwrap();
    let mut lowest = AlState::Op;
    for _ in 0..3_000 {
        machine.run(1);
        lowest = lowest.min(machine.look(|line| line.slave(0).unwrap().state()));
        assert_eq!((machine.feedback(0).link, machine.feedback(0).stopped), (Link::Online, None));
    }
    assert_eq!(lowest, AlState::Op, "all of that was over");
    assert_eq!(machine.sim.run_command(0, id, 1), Some(Outcome::Done));
}
