//! Long segments: all slaves come up by the one slot of the first frame, a step of one of them at a time.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::{EthercatPlan, Family};
use fieldbeat::time::MS;
use fieldbeat_sim::ethercat::{AlState, EthercatSegment, MailboxSettings, SiiSettings, SlaveSettings};

use super::{LINE, Machine, jog, plan, with};

/// The segment is up whole within so many cycles, in so many frames a cycle, and its last drive turns.
fn is_up_within(most: u64, frames: u64, segment: impl Into<EthercatSegment>) {
    const CYCLES: u64 = 100;
    let mut machine = Machine::new(segment);
    let count = machine.count;
    let all = |machine: &Machine| (0..count).all(|n| machine.feedback(n).link == Link::Online);
    let took = machine.until("all up", most, all);
    eprintln!("{count} drives: {took} cycles");
    machine.look(|line| {
        for place in 0..count {
            let slave = line.slave(place).unwrap();
            assert_eq!((slave.state(), slave.error()), (AlState::Op, None), "at place {place}");
        }
    });
    let before = machine.sim.world().delivered();
    machine.run(CYCLES);
    assert_eq!(machine.sim.world().delivered() - before, 2 * frames * CYCLES);
    machine.done(count - 1, Command::Enable);
    machine.post(count - 1, jog(3.0));
    machine.run(300);
    machine.assert_turns(count - 1, 3.0);
    machine.end_well();
}

#[test]
fn a_segment_of_64_drives_with_clocks_as_slow_as_real_ones_is_up_within_15_seconds() {
    let mut segment = EthercatSegment::from(plan(64));
    segment.settings.settling = 1_024;
    segment.settings.drift_ppm = (0..64).map(|place| f64::from(place * 37 % 101) - 50.0).collect();
    // An EEPROM and a mailbox as slow as real ones.
    let sii = SiiSettings { busy_ns: 2 * MS, loading_ns: 100 * MS, ..SiiSettings::default() };
    let mailbox = MailboxSettings { delay_ns: 20 * MS, ..MailboxSettings::default() };
    let slow = SlaveSettings { sii, mailbox, ..SlaveSettings::default() };
    segment.settings.slaves.extend((0..64).map(|place| (place, slow.clone())));
    is_up_within(15_000, 1, segment);
}

/// Of AKD drives with all that they can report, 40 bytes each, no frame has room for 40.
#[test]
fn a_segment_whose_process_data_take_more_than_one_frame_comes_up_whole() {
    let wide = |place| with(place, Family::Akd, 0x1702, 0x1B20);
    is_up_within(12_000, 2, EthercatPlan::new(LINE, (0..40).map(wide).collect()));
}
