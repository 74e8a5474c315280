//! Another master on the segment, and on a LinMot: named within a bound, its drives left alone, and no drive or host is
//! taken for one. Those of Unidrives are in `unidrive::others`.

use fieldbeat::axis::{FoundRunning, Link, StopCause};
use fieldbeat::bus::ethercat::{Family, Watchdog};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::sim::SimSegment;
use fieldbeat::telemetry::Condition;
use fieldbeat::time::{MS, Time};
use fieldbeat_core::net::frames::MAC;
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command, FRAME_MAX};
use fieldbeat_ethercat::wire::registers::address as register;
use fieldbeat_linudp::wire::Request;
use fieldbeat_sim::ethercat::{AlState, EthercatSim};

use super::faults::inject;
use super::kollmorgen::left::take_over;
use super::kollmorgen::{self, LINE, Machine, drive, jog};
use super::support::*;

/// A frame of another master, from this address.
pub fn frame(mac: [u8; 6], command: Command, data: &[u8]) -> Vec<u8> {
    let mut room = [0; FRAME_MAX];
    let mut frame = Builder::new(&mut room, BROADCAST, mac).unwrap();
    frame.push_with(command, 7, data).unwrap();
    let length = frame.finish();
    room[..length].to_vec()
}

/// A frame as another master has one in each cycle.
fn cyclic(mac: [u8; 6]) -> Vec<u8> {
    frame(mac, Command::Brd(register::AL_STATUS), &[0; 2])
}

/// It passes the slaves, and comes to this master, too.
fn pass(machine: &Machine, mut frame: Vec<u8>) {
    let world = machine.sim.world();
    world.look(LINE, |line: &mut EthercatSim, now: Time| line.pass(now, &mut frame)).unwrap();
    assert!(world.inject_frame(LINE, &frame, world.now()));
}

#[test]
fn frames_of_another_master_stop_all_axes_of_the_segment_and_no_slave_is_brought_up_meanwhile() {
    // A master elsewhere, and another program on the same interface.
    for mac in [[0x30; 6], MAC] {
        let mut machine = Machine::enabled(kollmorgen::plan(2));
        machine.post(0, jog(5.0));
        machine.run(300);
        let mut cycles = 0;
        while machine.feedback(0).stopped.is_none() {
            pass(&machine, cyclic(mac));
            machine.run(1);
            cycles += 1;
            assert!(cycles <= 12, "its third frame, 5 ms after the second");
        }
        assert_eq!([0, 1].map(|index| machine.feedback(index).stopped), [Some(StopCause::OtherMaster); 2]);
        machine.until("standstill", 1_000, |machine| machine.drive(0, |drive| drive.rpm().abs() < 1.0));
        // A slave that falls now is left as it is.
        assert!(machine.sim.world().restart_slave(LINE, 1));
        for _ in 0..3_000 {
            pass(&machine, cyclic(mac));
            machine.run(1);
        }
        let state = |machine: &Machine| machine.look(|line| line.slave(1).unwrap().state());
        assert_eq!(state(&machine), AlState::Init);
        // The other one is gone.
        machine.online();
        assert_eq!(state(&machine), AlState::Op);
        for index in 0..2 {
            machine.recover(index);
        }
        machine.post(0, jog(1.0));
        machine.run(300);
        machine.assert_turns(0, 1.0);
    }
}

#[test]
fn slaves_of_a_living_master_are_left_as_they_run() {
    // Watched by its own master, which is of another kind: it cannot be joined, and would be stopped.
    let mut plan = kollmorgen::plan(1);
    plan.drives[0].slave.watchdog = Watchdog::Off;
    plan.drives[0].accept_no_watchdog = true;
    let mut first = Machine::enabled(plan.clone());
    first.post(0, jog(1.0));
    first.run(500);
    let mut found = kollmorgen::plan(1);
    found.drives[0] = drive(0, Family::Akd);
    let mut machine = take_over(first, &found, FoundRunning::Stop);
    for _ in 0..2_000 {
        pass(&machine, cyclic([0x30; 6]));
        machine.run(1);
    }
    let rpm = machine.drive(0, |drive| drive.rpm());
    assert!((rpm - 60.0).abs() < 3.0, "{rpm} rpm");
    assert_eq!(machine.look(|line| line.slave(0).unwrap().state()), AlState::Op);
    assert_eq!(machine.feedback(0).stopped, Some(StopCause::OtherMaster));
}

/// The requests to a LinMot.
pub fn go_to(position: i32) -> MotionCommand {
    let (velocity, acceleration) = (Velocity(10_000), Acceleration(100_000));
    MotionCommand::vai_go_to(Position(position), velocity, acceleration, acceleration)
}

#[test]
fn a_linmot_that_a_living_master_moves_is_not_taken_over() {
    let mut b = Rig::new(1).each(|_, drive| drive.simulate.start_running = true).start();
    for n in 0..200_i32 {
        inject(&b, Request { motion: Some(go_to(1_000 * n).block((n % 16) as u8)), ..Request::default() });
        b.run(1);
    }
    assert_eq!((b.feedback(0).link, b.feedback(0).stopped), (Link::Online, Some(StopCause::OtherMaster)));
    let written = |received: &Delivery| received.request.control.is_some();
    assert!(!b.tape(0).received.iter().any(written), "nothing was written");
    assert!(b.feedback(0).status.moving);
    assert!(b.world().now() > Time(200 * MS));
    // It is left to its master, and named.
    b.shut_down(100);
    let left = b.finish().drives[0].at_end.clone().unwrap();
    assert!(matches!(left.condition, Condition::Moving | Condition::Powered), "{left:?}");
    assert_eq!(left.requested, []);
}
