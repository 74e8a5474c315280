//! Long lines: all slaves come up by the one slot of the first frame, a step of one of them at a time.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::{EthercatPlan, Family};
use fieldbeat::internals::bus::ethercat::wire::registers::AlState;

use super::{LINE, Machine, jog, plan, with};

/// Slots that a slave takes until its clock is set: its EEPROM, changes of state, start-up objects.
const SLOTS_EACH: u64 = 130;
/// Clocks are set one after the other, each in so many steps. Between two steps of one slave each other one may have a
/// turn: all have mailboxes to be looked at by then.
const CLOCK_STEPS: u64 = 3;
/// What comes once and for all: SYNC0 begins, the grid locks, the last drive synchronises, the gate of its link.
const ONCE: u64 = 2_000;

/// The line comes up whole, within its bound.
fn up(plan: EthercatPlan) -> Machine {
    let mut machine = Machine::new(plan);
    let count = machine.count as u64;
    let most = SLOTS_EACH * count + CLOCK_STEPS * count * count + ONCE;
    let all = |machine: &Machine| (0..machine.count).all(|n| machine.feedback(n).link == Link::Online);
    machine.until("all up", most, all);
    machine.look(|line| {
        for place in 0..count as usize {
            let slave = line.slave(place).unwrap();
            assert_eq!((slave.state(), slave.error()), (AlState::Op, None), "at place {place}");
        }
    });
    machine
}

#[test]
fn a_line_of_64_drives_comes_up_whole_in_one_frame_and_its_last_one_turns() {
    let mut machine = up(plan(64));
    machine.done(63, Command::Enable);
    machine.post(63, jog(3.0));
    machine.run(300);
    machine.assert_turns(63, 3.0);
}

/// Of AKD drives with all that they can tell, 40 bytes each, no frame has room for 40.
#[test]
fn a_line_whose_process_data_take_more_than_one_frame_comes_up_whole() {
    let wide = |place| with(place, Family::Akd, 0x1702, 0x1B20);
    let mut machine = up(EthercatPlan::new(LINE, (0..40).map(wide).collect()));
    machine.done(39, Command::Enable);
    machine.post(39, jog(3.0));
    machine.run(300);
    machine.assert_turns(39, 3.0);
}
