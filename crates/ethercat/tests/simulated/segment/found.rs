//! Drives and devices that are in OP already when the master comes.

use super::*;
use fieldbeat_ethercat::wire::registers::Fmmu;

/// Drives of which those at these places run as another master has left them, and the first so many of them.
fn running(count: u16, places: &[usize], known: usize) -> (EthercatPlan, EthercatSegment) {
    let plan = drives(count);
    let mut whole = EthercatSegment::from(&plan);
    places.iter().for_each(|place| whole.drives[*place].running_rpm = Some(60.0));
    (EthercatPlan { drives: plan.drives[..known].to_vec(), ..plan }, whole)
}

/// A clock that runs is not adjusted to the grid, only kept where it is.
const KEPT_NS: i64 = 2_000;
/// Times of others are told from each other by this, ns: whole periods, so that SYNC0 comes where it came.
const APART: u64 = 123 * MS;

impl Rig {
    /// The slave there gets another time, by its offset.
    fn set_apart(&mut self, place: u16) {
        self.run(1);
        let offset = self.peek(place, address::DC_OFFSET, 8);
        let start = self.peek(place, address::DC_START, 8);
        let later = |time: Vec<u8>| {
            let time = u64::from_le_bytes(time.try_into().unwrap());
            time.wrapping_add(APART).to_le_bytes()
        };
        self.poke(place, address::DC_ACTIVATION, &[0]);
        self.poke(place, address::DC_OFFSET, &later(offset));
        self.poke(place, address::DC_START, &later(start));
        self.poke(place, address::DC_ACTIVATION, &[3]);
    }
}

#[test]
fn the_time_of_the_segment_goes_to_nobody_while_a_drive_that_is_left_alone_runs_on_another() {
    let (mut plan, whole) = running(3, &[1, 2], 3);
    plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = FoundRunning::Refuse);
    let mut rig = Rig::on(&plan, whole);
    rig.set_apart(2);
    let before = [rig.time_off(1), rig.time_off(2)];
    rig.run(3_000);
    assert_eq!([0, 2].map(|index| rig.note(index)), [Note::OtherTime(2), Note::None]);
    assert_eq!([rig.time_off(1), rig.time_off(2)], before);
    assert_eq!([rig.al(1), rig.al(2)], [AlState::Op; 2]);
    // It is switched off and on, and has none then.
    let now = rig.cycle.grid;
    rig.sim.restart(now, 2);
    rig.all_up(4_000);
    rig.run(1_500);
    let off = rig.time_off(1) - before[0];
    assert!(off.abs() < KEPT_NS, "the other one keeps its time: {off} ns");
}

#[test]
fn a_drive_that_is_refused_and_runs_keeps_its_time() {
    let (mut plan, whole) = running(3, &[1], 3);
    plan.drives[1].slave.identity.product = Some(7);
    let mut rig = Rig::on(&plan, whole);
    let before = rig.time_off(1);
    rig.until("the others in OP", 4_000, |rig| rig.line.is_operational(0) && rig.line.is_operational(2));
    assert!(matches!(rig.note(1), Note::Product(_)), "{:?}", rig.note(1));
    rig.run(1_500);
    assert!((rig.time_off(1) - before).abs() < KEPT_NS);
    assert_eq!(rig.al(1), AlState::Op);
}

#[test]
fn the_time_of_a_drive_that_is_refused_stays_the_segments_though_another_one_is_joined() {
    let (mut plan, whole) = running(3, &[0, 1], 3);
    plan.drives[0].slave.identity.product = Some(7);
    let mut rig = Rig::on(&plan, whole);
    rig.set_apart(1);
    let before = [rig.time_off(0), rig.time_off(1)];
    rig.run(2_000);
    assert!(matches!(rig.note(0), Note::Product(_)), "{:?}", rig.note(0));
    assert_eq!([1, 2].map(|index| rig.note(index)), [Note::None, Note::OtherTime(1)]);
    for (place, before) in before.into_iter().enumerate() {
        let off = rig.time_off(place) - before;
        assert!(off.abs() < KEPT_NS, "{place} by {off} ns");
    }
}

#[test]
fn a_drive_that_runs_and_cannot_be_used_keeps_a_time_that_is_not_read() {
    let (plan, mut whole) = running(2, &[1], 2);
    whole.settings.fmmus = vec![8, 1];
    let mut rig = Rig::on(&plan, whole);
    rig.run(1);
    let before = rig.time_off(1);
    rig.run(3_000);
    assert_eq!([rig.note(0), rig.note(1)], [Note::OtherTime(1), Note::Fmmus(1)]);
    assert_eq!((rig.time_off(1), rig.al(1)), (before, AlState::Op));
}

#[test]
fn two_drives_found_on_two_times_are_both_joined_and_neither_is_dragged() {
    for apart in [false, true] {
        let (mut plan, whole) = running(2, &[0, 1], 2);
        plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = FoundRunning::Refuse);
        let mut rig = Rig::on(&plan, whole);
        if apart {
            rig.set_apart(1);
        } else {
            rig.run(1);
        }
        let before = [rig.time_off(0), rig.time_off(1)];
        rig.run(2_000);
        assert_eq!([rig.note(0), rig.note(1)], [Note::None; 2], "apart: {apart}");
        assert_eq!(rig.line.timed, !apart);
        for (place, before) in before.into_iter().enumerate() {
            let off = rig.time_off(place) - before;
            assert!(off.abs() < KEPT_NS, "{place} by {off} ns");
        }
        assert_eq!([rig.al(0), rig.al(1)], [AlState::Op; 2]);
    }
}

#[test]
fn an_fmmu_by_which_another_master_writes_is_left_alone() {
    let (mut plan, whole) = running(1, &[0], 1);
    plan.drives[0].axis.on_found_running = FoundRunning::Refuse;
    let mut rig = Rig::on(&plan, whole);
    rig.run(1);
    let outputs = Fmmu::bytes(0x2_0000, 6, 0x1100, true).to_bytes();
    rig.poke(0, address::fmmu(1), &outputs);
    rig.run(3_000);
    assert_eq!((rig.note(0), rig.al(0)), (Note::FoundRunning, AlState::Op));
    assert_eq!(rig.peek(0, address::fmmu(1), 16), outputs);
}

#[test]
fn the_watchdog_of_a_drive_found_in_op_is_compared_with_what_its_sii_arms() {
    for (control, ticks, watched) in
        [(0x64, 1_000_u16, true), (0x64, 0, false), (0x64, 0xFFFF, false), (0x24, 1_000, false)]
    {
        let (plan, whole) = running(1, &[0], 1);
        let mut rig = Rig::on(&plan, whole);
        // What it has, with another control byte: one that is on does not take it.
        let mut manager = rig.peek(0, address::sync_manager(2), 8);
        rig.poke(0, address::sync_manager(2), &[0; 8]);
        manager[4] = control;
        rig.poke(0, address::sync_manager(2), &manager);
        rig.poke(0, address::WATCHDOG, &ticks.to_le_bytes());
        rig.until("joined", 500, |rig| rig.note(0) == Note::None);
        let slave = &rig.line.slaves[0];
        assert!(slave.way.joined, "{:?}", at(slave));
        assert_eq!(slave.watched, watched, "{control:#04x} {ticks}");
    }
}

#[test]
fn a_device_found_in_op_is_set_up_from_init() {
    let mut plan = drives(0);
    plan.devices = vec![coupler(0)];
    let mut rig = Rig::new(&plan);
    rig.all_up(2_000);
    // Another master, with an image of its own.
    let next = Rig::based(&plan, &plan, 0x2000_0000);
    (rig.line, rig.image) = (next.line, next.image);
    rig.until("it leaves OP", 500, |rig| rig.al(0) == AlState::Init);
    rig.all_up(2_000);
    assert!(rig.line.outputs_count(0) && rig.line.slaves[0].wants_nothing());
}

#[test]
fn a_time_that_goes_to_nobody_is_still_known() {
    // The clocks of all are faster than the master's, and those that run stay together.
    let (mut plan, mut whole) = running(3, &[0, 1], 3);
    plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = FoundRunning::Refuse);
    whole.settings.drift_ppm = vec![100.0];
    let mut rig = Rig::on(&plan, whole);
    rig.set_apart(1);
    rig.run(5_000);
    assert_eq!([0, 1, 2].map(|index| rig.note(index)), [Note::None, Note::None, Note::OtherTime(1)]);
    let now = rig.cycle.grid;
    rig.sim.restart(now, 1);
    rig.all_up(6_000);
    assert_eq!(rig.al(0), AlState::Op, "the one that gave its time");
}
