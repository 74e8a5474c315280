//! Drives and devices that are in OP already when the master comes.

use super::*;
use fieldbeat_ethercat::wire::registers::Fmmu;

/// Drives of which those at these places run as another master has left them.
fn running(count: u16, places: &[usize]) -> (EthercatPlan, EthercatSegment) {
    let plan = drives(count);
    let mut whole = EthercatSegment::from(&plan);
    places.iter().for_each(|place| whole.drives[*place].running_rpm = Some(60.0));
    (plan, whole)
}

/// A clock that runs is not adjusted to the grid, only kept where it is.
const KEPT_NS: i64 = 2_000;
/// Times of others are distinguished by this, ns: whole periods, so that SYNC0 comes where it came.
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

/// Whatever is done with those that run, they stay in OP and keep their time.
#[test]
fn the_times_of_drives_found_running_are_kept_and_the_others_wait_where_they_are_not_one() {
    let refuse: fn(&mut EthercatPlan, &mut EthercatSegment) =
        |plan, _| plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = FoundRunning::Refuse);
    let other_product = Note::Product(0x0300_0600);
    // Those that run, the one of them on another time, what the drives are said to be, and whether the time goes to
    // all or to nobody.
    for (what, places, apart, change, notes, goes) in [
        (
            "left alone on another time",
            &[1, 2][..],
            Some(2),
            refuse,
            &[Note::OtherTime(2), Note::None, Note::None][..],
            false,
        ),
        (
            "refused",
            &[1],
            None,
            |plan, _| plan.drives[1].slave.identity.product = Some(7),
            &[Note::None, other_product, Note::None],
            true,
        ),
        (
            "another one of its kind by its serial number",
            &[1],
            None,
            |plan, _| plan.drives[1].slave.identity.serial = Some(7),
            &[Note::None, Note::Serial(0), Note::None],
            true,
        ),
        (
            "by its alias",
            &[1],
            None,
            |plan, _| plan.drives[1].slave.identity.alias = Some(7),
            &[Note::None, Note::Alias { found: 0, wanted: 7 }, Note::None],
            true,
        ),
        (
            "by its identification",
            &[1],
            None,
            |plan, whole| {
                plan.drives[1].slave.identity.identification = Some(7);
                whole.plan.drives[1].slave.identity.identification = Some(8);
            },
            &[Note::None, Note::Identification { found: 8, wanted: 7 }, Note::None],
            true,
        ),
        (
            "refused, and another one joined on another time",
            &[0, 1],
            Some(1),
            |plan, _| plan.drives[0].slave.identity.product = Some(7),
            &[other_product, Note::None, Note::OtherTime(1)],
            true,
        ),
        (
            "of no use, so that its time is not read",
            &[1],
            None,
            |_, whole| whole.settings.slaves.entry(1).or_default().fmmus = Some(1),
            &[Note::OtherTime(1), Note::Fmmus(1)],
            false,
        ),
        ("both joined on two times", &[0, 1], Some(1), refuse, &[Note::None; 2], true),
        ("both joined on one time", &[0, 1], None, refuse, &[Note::None; 2], true),
    ] {
        let (mut plan, mut whole) = running(notes.len() as u16, places);
        change(&mut plan, &mut whole);
        let mut rig = Rig::on(&plan, whole);
        match apart {
            Some(place) => rig.set_apart(place),
            None => rig.run(1),
        }
        let before: Vec<_> = places.iter().map(|place| rig.time_off(*place)).collect();
        rig.run(4_000);
        let said: Vec<_> = (0..notes.len()).map(|index| rig.note(index)).collect();
        assert_eq!(said, notes, "{what}");
        for (place, before) in places.iter().zip(before) {
            let off = rig.time_off(*place) - before;
            assert!(off.abs() < if goes { KEPT_NS } else { 1 }, "{what}: {place} by {off} ns");
            assert_eq!(rig.al(*place), AlState::Op, "{what}");
        }
        let waits = notes.iter().any(|note| matches!(note, Note::OtherTime(_)));
        assert_eq!(rig.line.timed, apart.is_none() && !waits, "{what}");
    }
}

#[test]
fn a_drive_that_waits_for_one_time_comes_up_once_the_other_one_is_switched_off_and_on() {
    // The clocks of all are as fast as the master's, or faster; those that run stay together.
    for (places, apart, drift, waits) in [([1, 2], 2, 0.0, 0), ([0, 1], 1, 100.0, 2)] {
        let (mut plan, mut whole) = running(3, &places);
        plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = FoundRunning::Refuse);
        whole.settings.drift_ppm = vec![drift];
        let mut rig = Rig::on(&plan, whole);
        rig.set_apart(apart);
        let gives = places[0];
        let before = rig.time_off(gives);
        rig.run(5_000);
        let note = |index| if index == waits { Note::OtherTime(apart) } else { Note::None };
        assert_eq!([0, 1, 2].map(|index| rig.note(index)), [0, 1, 2].map(note));
        // It has no time then.
        let now = rig.cycle.grid;
        rig.sim.restart(now, apart.into());
        rig.all_up(6_000);
        rig.run(1_500);
        assert_eq!(rig.al(gives), AlState::Op, "the one that gave its time");
        let off = rig.time_off(gives) - before;
        assert!(off.abs() < KEPT_NS || drift > 0.0, "the other one keeps its time: {off} ns");
    }
}

#[test]
fn an_fmmu_by_which_another_master_writes_is_left_alone() {
    let (mut plan, whole) = running(1, &[0]);
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
        let (plan, whole) = running(1, &[0]);
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
    let plan = terminals();
    let mut rig = Rig::new(&plan);
    rig.all_up(2_000);
    // Another master, with an image of its own.
    let next = Rig::based(&plan, &plan, 0x2000_0000);
    (rig.line, rig.image) = (next.line, next.image);
    rig.until("it leaves OP", 500, |rig| rig.al(0) == AlState::Init);
    rig.all_up(2_000);
    assert!(rig.line.outputs_count(0) && rig.line.slaves[0].wants_nothing());
}
