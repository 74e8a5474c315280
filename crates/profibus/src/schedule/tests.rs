//! Turns on the grid, against the table of the sheet (7) and by hand.

use super::*;
use crate::ParameterPath;
use fieldbeat_core::time::{MS, S, US};

const USUAL: Grid = Grid { period_ns: MS, deadline_ns: MS / 2 };
const WIDE: Grid = Grid { period_ns: MS, deadline_ns: 800 * US };

fn wire(rate: u32, drives: u8) -> ProfibusPlan {
    let drive = |index| LenzeDrive::new(format!("l{index}"), 3 + index);
    ProfibusPlan::new("/dev/ttyS1", rate, (0..drives).map(drive).collect())
}

/// The longest record of MSAC1 may come between.
fn by_records(drive: &mut LenzeDrive) {
    drive.parameters = ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Default::default() };
}

#[test]
fn a_turn_takes_what_the_sheet_says_and_begins_inside_the_windows() {
    // At 45.45 kbit/s with a MaxTsdr of 250 bits.
    let sheet_us = [57_800, 28_900, 16_400, 5_920, 2_960, 1_190, 430, 250, 160, 110];
    for (rate, us) in RATES.into_iter().zip(sheet_us) {
        let turn_us = wire(rate, 1).usual_turn_ns(0) as f64 / 1e3;
        assert!((turn_us / f64::from(us) - 1.0).abs() < 0.03, "{rate}: {turn_us} us");
    }
    // 42 bytes of 11 bits, MaxTsdr, Tsyn.
    assert_eq!(wire(1_500_000, 1).usual_turn_ns(0), 645 * 2_000 / 3);
    // Whole turns begin inside the windows.
    for (rate, drives, within, grid, exchanges) in [
        // At 500 kbit/s a turn takes 1.19 ms. It begins 0, 1.19, 2.38 ... 4.76 ms after a slot, and then in the next.
        (500_000, 3, 6 * MS, WIDE, 5),
        (500_000, 3, S, WIDE, 166 * 5 + 4),
        // With half of the cycle: 0, 1.19, 2.38, and at 3.57 the window is over.
        (500_000, 1, S, USUAL, 250 * 3),
        // At 1.5 Mbit/s 0, 0.43; 0.86 is behind either deadline.
        (1_500_000, 1, S, USUAL, 2_000),
        // At 12 Mbit/s 107.9 us.
        (12_000_000, 4, S, WIDE, 8_000),
        (12_000_000, 0, S, WIDE, 0),
    ] {
        assert_eq!(wire(rate, drives).exchanges_within(within, grid), exchanges, "{rate} {drives}");
    }
}

#[test]
fn twelve_megabit_carry_four_drives_in_every_cycle_with_room() {
    let mut plan = wire(12_000_000, 4);
    assert_eq!(plan.schedule_faults(WIDE), []);
    plan.drives.iter_mut().for_each(by_records);
    assert_eq!(plan.schedule_faults(WIDE), []);
    assert!(!wire(12_000_000, 7).schedule_faults(WIDE).is_empty());
    assert!(!wire(12_000_000, 4).schedule_faults(USUAL).is_empty());
    // A watchdog outlasts the wait for a turn.
    let mut plan = wire(1_500_000, 2).in_turn(2);
    plan.drives[0].watchdog.timeout_ns = Some(10 * MS);
    assert_eq!(plan.schedule_faults(USUAL), []);
    plan.drives[0].user_prm[0] |= 1 << 2;
    plan.drives[0].watchdog.timeout_ns = Some(4 * MS);
    let said = plan.schedule_faults(USUAL);
    assert!(matches!(&said[..], [(0, PlanFault { key: "watchdog", .. })]), "{said:?}");
}

#[test]
fn a_schedule_that_does_not_fit_is_refused_with_one_that_does() {
    // Two turns begin in a window, but nothing is left for a slot time.
    let said = wire(1_500_000, 2).schedule_faults(USUAL);
    let [(0 | 1, PlanFault { key: "divisor", message })] = &said[..] else { panic!("{said:?}") };
    let expected = "asks for an exchange every 1 ms, which is over ";
    assert!(message.starts_with(expected), "{message}");
    assert!(message.ends_with("; use divisor 2 and phases in turn, or rate 6000000"), "{message}");
    assert_eq!(wire(1_500_000, 2).in_turn(2).schedule_faults(USUAL), []);
    assert_eq!(wire(6_000_000, 2).schedule_faults(USUAL), []);
    assert!(!wire(3_000_000, 2).schedule_faults(USUAL).is_empty());
    for (rate, drives) in [(500_000, 1), (500_000, 4), (1_500_000, 31), (93_750, 2)] {
        let plan = wire(rate, drives);
        let divisor = plan.least_divisor(USUAL).unwrap();
        assert!(plan.in_turn(divisor).lay(USUAL).is_ok());
        assert!(plan.in_turn(divisor - 1).lay(USUAL).is_err(), "{rate}, {drives}: {divisor}");
        // The wire carries so many.
        let due = S / MS * u64::from(drives) / u64::from(divisor);
        assert!(due <= plan.exchanges_within(S, USUAL), "{rate}, {drives}: {divisor}");
    }
    assert!(wire(9_600, 120).least_divisor(USUAL).is_none());
    // What fits with the MaxTsdr of 60 bits that was usual before is named with it.
    let mut plan = wire(45_450, 1).in_turn(23);
    let said = plan.schedule_faults(USUAL);
    let [(0, PlanFault { key: "divisor", message })] = &said[..] else { panic!("{said:?}") };
    assert!(message.contains("; or bits = { max_tsdr = 60, slot = 100 } if the GSD"), "{message}");
    (plan.bits.max_tsdr, plan.bits.slot, plan.bits.idle_unanswered) = (60, 100, 60);
    assert_eq!(plan.schedule_faults(USUAL), []);
}

#[test]
fn a_busy_drive_gets_fewer_requests_and_a_longer_timeout() {
    let mut plan = wire(12_000_000, 2);
    plan.drives[1].min_slave_interval_ns = 2_500 * US;
    let said = plan.schedule_faults(WIDE);
    let [(1, PlanFault { key: "divisor", message })] = &said[..] else { panic!("{said:?}") };
    assert!(message.contains("more often than min_slave_interval = 2.5 ms allows; use divisor 3 or more"));
    assert_eq!(plan.least_divisor(WIDE), Some(3));
    let before = plan.turns(WIDE)[0][1];
    plan.drives.iter_mut().for_each(|drive| drive.axis.divisor = 3);
    assert_eq!(plan.schedule_faults(WIDE), []);
    let waits = |plan: &ProfibusPlan| [0, 1].map(|index| plan.turns(WIDE)[index][1]);
    let [one, other] = waits(&plan);
    assert!(one <= before && other >= 2_500 * US, "{one} {other}");
    plan.drives[1].min_slave_interval_ns = 0;
    assert_eq!(waits(&plan), [one, other - 2_500 * US]);
    // Alone, and always waiting: one in so long.
    let mut plan = wire(12_000_000, 1);
    plan.drives[0].min_slave_interval_ns = 2 * MS;
    assert_eq!(plan.exchanges_within(S, WIDE), 500);
}

#[test]
fn the_latency_of_a_port_is_no_time_on_the_wire() {
    let mut plan = wire(1_500_000, 1).in_turn(30);
    let loads = plan.loads(USUAL);
    assert!((loads[0] - 100.0 * 430e3 / 30e6).abs() < 0.01, "{loads:?}");
    plan.bits.latency_ns = 5 * MS;
    assert_eq!(plan.loads(USUAL), loads);
    assert_eq!((plan.usual_turn_ns(0), plan.wire_ns(0)), (5_430 * US, 430 * US));
}

#[test]
fn phases_count() {
    // One in every cycle, and one of two others in each.
    let mut plan = wire(12_000_000, 9);
    let grid = Grid { period_ns: MS, deadline_ns: 450 * US };
    for (index, drive) in plan.drives.iter_mut().enumerate().skip(1) {
        (drive.axis.divisor, drive.axis.phase) = (8, index as u32 - 1);
    }
    assert_eq!(plan.schedule_faults(grid), []);
    plan.drives.iter_mut().for_each(|drive| drive.axis.phase = 0);
    let said = plan.schedule_faults(grid);
    assert!(matches!(&said[..], [(0, _)]), "that of every cycle waits for eight others: {said:?}");
    // Divisors without a common round: as if all were due at once.
    for (drive, divisor) in plan.drives.iter_mut().zip([991, 997, 983, 977, 971, 967, 953, 947, 941]) {
        (drive.axis.divisor, drive.axis.phase) = (divisor, 5);
    }
    assert_eq!(plan.lay(grid), Ok(()));
}

#[test]
fn global_control_is_ahead_of_no_drive_of_a_wire_that_catches_up() {
    let mut plan = wire(1_500_000, 2);
    let (bit, byte) = (2_000.0 / 3.0, 22_000.0 / 3.0);
    let (once, control) = (42.0 * byte + 183.0 * bit, 13.0 * byte + 150.0 * bit);
    let within = |plan: &ProfibusPlan| plan.turns(WIDE)[1];
    let close = |within: [u64; 2], expected: [f64; 2]| {
        let is_close = within.iter().zip(expected).all(|(ns, expected)| (*ns as f64 - expected).abs() < 10.0);
        assert!(is_close, "{within:?}, {expected:?}");
    };
    (plan.token, plan.gap) = (false, None);
    // Two tries begin in a window. In each cycle there is no room for both drives with all their repetitions, and
    // Global_Control may come between them.
    close(within(&plan), [1e6 + control, 1e6 + control + 2.0 * once]);
    plan.drives.iter_mut().for_each(|drive| drive.axis.divisor = 3);
    close(within(&plan), [2.0 * once, 1e6 + 2.0 * once]);
    // One that is due so often becomes late, and comes more than once.
    plan.global_control_ns = 2 * MS;
    close(within(&plan), [1e6 + control, 2e6 + control + 2.0 * once]);
    // Alone on its wire it follows the own telegrams of the master only.
    let mut plan = wire(500_000, 1);
    plan.drives[0].axis.divisor = 3;
    let [[request_ns, _]] = plan.turns(USUAL)[..] else { panic!("one drive") };
    assert_eq!(request_ns, 32 * US);
}
