//! The clocks of slaves on their way up, and their delays.

use super::*;

/// Drives with clocks as slow as real ones.
fn slow(count: u16) -> Rig {
    let plan = drives(count);
    let mut whole = EthercatSegment::from(&plan);
    whole.settings.settling = 1_024;
    whole.settings.drift_ppm = vec![20.0, -30.0, 40.0];
    Rig::on(&plan, whole)
}

#[test]
fn a_slave_whose_time_leaps_while_it_settles_is_set_anew() {
    let mut rig = slow(2);
    rig.until("set", 2_000, |rig| rig.line.slaves[1].clock_set);
    rig.run(500);
    // Another master has moved it by a second.
    let offset = rig.peek(1, address::DC_OFFSET, 8);
    let offset = u64::from_le_bytes(offset.try_into().unwrap()).wrapping_add(S);
    rig.poke(1, address::DC_OFFSET, &offset.to_le_bytes());
    rig.all_up(8_000);
    assert!((rig.time_off(1) - rig.time_off(0)).abs() <= 10_000);
}

#[test]
fn clocks_settle_while_their_slaves_are_set_up() {
    let mut rig = slow(3);
    rig.until("all set", 400, |rig| rig.line.slaves.iter().all(|slave| slave.clock_set));
    assert_eq!([0, 1, 2].map(|place| rig.al(place)), [AlState::Init; 3]);
    rig.run(2);
    let times = [0, 1, 2].map(|place| rig.time_off(place));
    assert!(times.iter().all(|time| (time - times[0]).abs() <= 5_000), "{times:?}");
    assert_eq!([0, 1, 2].map(|index| rig.line.slaves[index].delay_ns), [Some(0), Some(500), Some(1_000)]);
}
