//! Long segments: all slaves come up by the one slot of the first frame, a step of one of them at a time.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::{Area, Device, EthercatPlan, Family, SlavePlan};
use fieldbeat::sim::ethercat::{EthercatSegment, MailboxSettings, Model, SiiSettings, SlaveSettings};
use fieldbeat::time::MS;
use fieldbeat_ethercat::wire::registers::AlState;

use super::{LINE, Machine, jog, plan, with};

/// Slots that a slave takes until its clock is set: its EEPROM, changes of state, start-up objects.
const SLOTS_EACH: u64 = 130;
/// Clocks are set one after the other, each in so many steps. Between two steps of one slave each other one may have a
/// turn: all have mailboxes to be looked at by then.
const CLOCK_STEPS: u64 = 3;
/// What comes once and for all: SYNC0 begins, the grid locks, the last drive synchronises, the gate of its link.
const ONCE: u64 = 2_000;

/// The segment comes up whole, within its bound.
fn up(plan: EthercatPlan) -> Machine {
    let count = plan.drives.len() as u64;
    up_within(SLOTS_EACH * count + CLOCK_STEPS * count * count + ONCE, plan)
}

/// The same within so many cycles.
fn up_within(most: u64, segment: impl Into<EthercatSegment>) -> Machine {
    let mut machine = Machine::new(segment);
    let count = machine.count as u64;
    let all = |machine: &Machine| (0..machine.count).all(|n| machine.feedback(n).link == Link::Online);
    let took = machine.until("all up", most, all);
    eprintln!("{count} drives: {took} cycles");
    machine.look(|line| {
        for place in 0..count as usize {
            let slave = line.slave(place).unwrap();
            assert_eq!((slave.state(), slave.error()), (AlState::Op, None), "at place {place}");
        }
    });
    machine
}

/// So many frames a cycle are sent, and come back.
fn assert_frames(machine: &mut Machine, frames: u64) {
    const CYCLES: u64 = 100;
    let before = machine.sim.world().delivered();
    machine.run(CYCLES);
    assert_eq!(machine.sim.world().delivered() - before, 2 * frames * CYCLES);
}

/// An EEPROM and a mailbox as slow as real ones.
fn slow() -> SlaveSettings {
    let sii = SiiSettings { busy_ns: 2 * MS, loading_ns: 100 * MS, ..SiiSettings::default() };
    let mailbox = MailboxSettings { delay_ns: 20 * MS, ..MailboxSettings::default() };
    SlaveSettings { sii, mailbox, ..SlaveSettings::default() }
}

/// Their clocks run apart, and settle as slowly as real ones.
fn slow_clocks(segment: &mut EthercatSegment) {
    segment.settings.settling = 1_024;
    segment.settings.drift_ppm = (0..64).map(|place| f64::from(place * 37 % 101) - 50.0).collect();
}

#[test]
fn a_segment_of_64_drives_with_clocks_as_slow_as_real_ones_is_up_within_15_seconds() {
    let mut segment = EthercatSegment::from(plan(64));
    slow_clocks(&mut segment);
    segment.settings.slaves.extend((0..64).map(|place| (place, slow())));
    up_within(15_000, segment).end_well();
}

#[test]
fn a_segment_of_64_drives_comes_up_whole_in_one_frame_and_its_last_one_turns() {
    let mut machine = up_within(10_000, plan(64));
    assert_frames(&mut machine, 1);
    machine.done(63, Command::Enable);
    machine.post(63, jog(3.0));
    machine.run(300);
    machine.assert_turns(63, 3.0);
    machine.end_well();
}

/// Of AKD drives with all that they can report, 40 bytes each, no frame has room for 40.
#[test]
fn a_segment_whose_process_data_take_more_than_one_frame_comes_up_whole() {
    let wide = |place| with(place, Family::Akd, 0x1702, 0x1B20);
    let mut machine = up(EthercatPlan::new(LINE, (0..40).map(wide).collect()));
    assert_frames(&mut machine, 2);
    machine.done(39, Command::Enable);
    machine.post(39, jog(3.0));
    machine.run(300);
    machine.assert_turns(39, 3.0);
    machine.end_well();
}

/// 8 drives among 56 terminals, with EEPROMs, mailboxes and clocks as slow as real ones.
#[test]
fn a_segment_of_64_slaves_as_slow_as_real_ones_is_up_within_10_seconds() {
    let mut plan = plan(64);
    plan.drives.retain(|drive| drive.slave.place % 8 == 1);
    // A coupler, then outputs and inputs in turns.
    let model = |place: u16| match place {
        0 => Model::Ek1100,
        place if place % 2 == 0 => Model::El2008,
        _ => Model::El1008,
    };
    for place in (0..64).filter(|place| place % 8 != 1) {
        let area = |start| vec![Area { start, length: 1 }];
        let (outputs, inputs) = match model(place) {
            Model::El2008 => (area(0x0F00), Vec::new()),
            Model::El1008 => (Vec::new(), area(0x1000)),
            _ => (Vec::new(), Vec::new()),
        };
        let slave = SlavePlan { outputs, inputs, ..SlavePlan::new(place) };
        plan.devices.push(Device { name: format!("io{place}"), slave });
    }
    let mut segment = EthercatSegment::from(plan);
    slow_clocks(&mut segment);
    for place in 0..64 {
        let model = (place % 8 != 1).then(|| model(place));
        segment.settings.slaves.insert(place, SlaveSettings { model, ..slow() });
    }
    let mut machine = Machine::new(segment);
    let all = |machine: &Machine| {
        machine.look(|line| (0..64).all(|place| line.slave(place).unwrap().state() == AlState::Op))
    };
    machine.until("all up", 8_000, all);
    let online = |machine: &Machine| (0..8).all(|n| machine.feedback(n).link == Link::Online);
    machine.until("online", 1_000, online);
    assert_frames(&mut machine, 1);
    machine.end_well();
}
