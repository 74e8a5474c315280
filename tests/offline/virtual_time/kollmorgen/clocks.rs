//! The clocks of a segment: while the host of its master is busy, behind another master, and of several kinds.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::{Area, Device, SlavePlan};
use fieldbeat::sim::{FaultPlan, WorldOptions};
use fieldbeat::time::{MS, S, US};
use fieldbeat_sim::ethercat::{ClockKind, EthercatSegment, SlaveSettings};

use super::{LINE, Machine, jog, plan};

/// One of four cycles of a busy host is stolen, in bursts of two to five: they are late, or their frames are, after
/// they were stamped.
fn stolen(turn: u64) -> Option<u64> {
    let burst = turn / 12;
    let length = 2 + burst % 3;
    (turn % 12 < length).then(|| (200 + turn * 7_919 % 700) * US)
}

/// Cycles of a busy host until this is so.
fn busy_until(machine: &mut Machine, most: u64, done: impl Fn(&Machine) -> bool) {
    let mut turn = 0;
    while !done(machine) {
        assert!(turn < most, "{:?}", machine.feedback(0));
        let late_ns = stolen(turn);
        let delay = if late_ns.is_some() { 1.0 } else { 0.0 };
        let faults = FaultPlan { delay, delay_ns: late_ns.unwrap_or(0), ..FaultPlan::default() };
        assert!(machine.sim.world().set_segment_faults(LINE, faults));
        if let Some(late_ns) = late_ns.filter(|_| turn % 2 == 0) {
            machine.sim.world().delay_next_wake(late_ns / 2);
        }
        machine.run(1);
        turn += 1;
    }
}

#[test]
fn a_segment_that_was_switched_off_and_on_locks_again_on_a_busy_host() {
    // How long it was off, ms: at 0 the master does not notice before the slaves are back. Meanwhile the clocks drift
    // apart.
    for (leads, settling, off_ms, most) in [
        (false, 32, 0, 3_000),
        (true, 32, 0, 3_000),
        (false, 1_024, 0, 8_000),
        (true, 1_024, 0, 8_000),
        (false, 32, 3_000, 2_000),
        (true, 32, 3_000, 2_000),
        (false, 1_024, 3_000, 8_000),
        (true, 1_024, 3_000, 8_000),
    ] {
        let mut segment = EthercatSegment::from(plan(3));
        segment.settings.settling = settling;
        segment.settings.drift_ppm = vec![40.0, -30.0, 10.0];
        let mut machine = Machine::with(segment, leads, WorldOptions::default());
        let online = |machine: &Machine| (0..3).all(|n| machine.feedback(n).link == Link::Online);
        machine.until("online", 20_000, online);
        if off_ms > 0 {
            machine.sim.world().cut(LINE, Some(0));
            let until = machine.sim.world().now() + off_ms * MS;
            busy_until(&mut machine, 2 * off_ms, |machine| machine.sim.world().now() >= until);
            assert!(!online(&machine));
        }
        for place in 0..3 {
            machine.sim.world().restart_slave(LINE, place);
        }
        machine.sim.world().cut(LINE, None);
        if off_ms == 0 {
            busy_until(&mut machine, 100, |machine| !online(machine));
        }
        let begun = machine.sim.world().now();
        busy_until(&mut machine, most, online);
        let took_ms = machine.sim.world().now().since(begun) / MS;
        let clock = machine.sim.finish().clocks[0].expect("the segment has a clock");
        assert!(clock.locked, "{clock:?}");
        eprintln!("leads: {leads}, settling {settling}, {off_ms} ms off: {took_ms} ms");
    }
}

/// 2024-01-01, when the clock of each world is 0, ns since 2000-01-01.
const BEGUN_NS: u64 = 757_382_400 * S;

#[test]
fn clocks_of_64_and_32_bits_and_none_have_one_time_and_it_is_the_date() {
    let mut segment = EthercatSegment::from(plan(4));
    let mut terminals = SlavePlan::new(4);
    terminals.inputs = vec![Area { start: 0x1000, length: 1 }];
    segment.plan.devices.push(Device { name: "io".into(), slave: terminals });
    let mut segment = EthercatSegment::from(segment.plan);
    segment.settings.drift_ppm = vec![40.0, -30.0, 10.0, 0.0, 20.0];
    let kinds = [ClockKind::Short, ClockKind::Long, ClockKind::Short, ClockKind::Long, ClockKind::None];
    let others = [ClockKind::Long, ClockKind::Short, ClockKind::Long, ClockKind::Long, ClockKind::None];
    for (kinds, leads) in [(kinds, false), (others, false), (kinds, true)] {
        for (place, kind) in (0..).zip(kinds) {
            let slave = SlaveSettings { clock: Some(kind), ..SlaveSettings::default() };
            segment.settings.slaves.insert(place, slave);
        }
        let mut machine = Machine::with(segment.clone(), leads, WorldOptions::default());
        machine.online();
        // Clocks of 32 bits go round meanwhile.
        machine.run(9_000);
        let now = machine.sim.world().now();
        let times =
            machine.look(|line| [0, 1, 2, 3].map(|place| line.slave(place).unwrap().system_time(now)));
        for (time, kind) in times.into_iter().zip(kinds) {
            let date = BEGUN_NS + now.0;
            if kind == ClockKind::Long {
                assert!(time.abs_diff(date) < S / 10, "{time}, and it is {date}");
            } else {
                assert_eq!(time >> 32, 0);
            }
            assert!((time as u32).wrapping_sub(times[0] as u32).cast_signed().abs() < 1_000, "{times:?}");
        }
        machine.each(Command::Enable);
        machine.post(3, jog(2.0));
        machine.run(300);
        machine.assert_turns(3, 2.0);
    }
}
