//! Segments that another master left behind, taken over by the whole loop.

use fieldbeat::CyclePlan;
use fieldbeat::axis::{FoundRunning, Link};
use fieldbeat::bus::ethercat::{EthercatPlan, Family, Watchdog};
use fieldbeat::internals::bus::ethercat::wire::frame::{Builder, Command, position};
use fieldbeat::internals::bus::ethercat::wire::registers::AlState;
use fieldbeat::sim::ethercat::EthercatSim;
use fieldbeat::sim::{SimSegment, WorldOptions};
use fieldbeat::time::{MS, Time};

use super::drives::left;
use super::{LINE, Machine, UP, drive, jog};

/// Three drives that go on without a master, or fall back by their watchdogs.
fn plan(watched: bool) -> EthercatPlan {
    let drives = (0..3).map(|place| {
        let mut drive = drive(place, Family::S700);
        if !watched {
            drive.slave.watchdog = Watchdog::Off;
            drive.accept_no_watchdog = true;
        }
        drive
    });
    EthercatPlan::new(LINE, drives.collect())
}

impl Machine {
    /// Its master is gone for so long, and another one comes.
    fn left_for(self, plan: &EthercatPlan, ns: u64, change: impl FnOnce(&mut Left)) -> Machine {
        let segment = self.look(|line| std::mem::replace(line, EthercatSim::of(plan)));
        let now = self.sim.world().now() + ns;
        let mut of = Left { segment, now };
        of.segment.advance(now);
        change(&mut of);
        let options = WorldOptions { start: now, ..WorldOptions::default() };
        Machine::on(Box::new(plan.clone()), left(of.segment), CyclePlan::default(), options)
    }

    fn cycles_to_online(&mut self) -> u64 {
        let count = self.count;
        self.until("online", UP, |machine| {
            (0..count).all(|index| machine.feedback(index).link == Link::Online)
        })
    }
}

/// A segment without a master.
struct Left {
    segment: EthercatSim,
    now: Time,
}

impl Left {
    fn write(&mut self, place: u16, register: u16, data: &[u8]) {
        let mut frame = vec![0; 64];
        let mut builder = Builder::new(&mut frame, [0xFF; 6], [0; 6]).unwrap();
        builder.push_with(Command::Apwr(position(place), register), 0, data).unwrap();
        builder.finish();
        self.segment.pass(self.now, &mut frame);
    }

    /// As a master leaves it that numbers stations from 1000h on, and gives the SII to the processor.
    fn numbered_otherwise(&mut self) {
        for place in 0..3 {
            self.write(place, 0x0010, &(0x1000 + place).to_le_bytes());
            self.write(place, 0x0500, &[1]);
        }
    }
}

#[test]
fn a_segment_whose_master_was_killed_in_op_is_online_in_the_time_of_a_fresh_one() {
    let plan = plan(true);
    let fresh = Machine::new(plan.clone()).cycles_to_online();
    for silent in [50 * MS, 500 * MS, 3_000 * MS] {
        let mut first = Machine::enabled(plan.clone());
        first.post(0, jog(1.0));
        first.run(300);
        let mut machine = first.left_for(&plan, silent, Left::numbered_otherwise);
        let cycles = machine.cycles_to_online();
        if silent > 100 * MS {
            assert!(cycles <= fresh + fresh / 10, "{silent}: {cycles} cycles, and {fresh} of a fresh one");
        }
        machine.run(1_000);
        machine.recover(0);
        machine.post(0, jog(1.0));
        machine.run(300);
        machine.assert_turns(0, 1.0);
    }
}

#[test]
fn a_drive_that_still_turns_is_joined_by_its_place_whatever_its_address_and_the_owner_of_its_sii() {
    let plan = plan(false);
    let mut first = Machine::enabled(plan.clone());
    first.post(1, jog(1.0));
    first.run(500);
    let mut refusing = plan.clone();
    refusing.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = FoundRunning::Refuse);
    let mut machine = first.left_for(&refusing, MS, Left::numbered_otherwise);
    for _ in 0..1_000 {
        machine.run(1);
        let al = machine.look(|line| line.slave(1).unwrap().state());
        assert_eq!(al, AlState::Op, "it never leaves OP: {:?}", machine.feedback(1));
    }
    machine.online();
}
