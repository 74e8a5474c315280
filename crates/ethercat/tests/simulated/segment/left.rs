//! Segments that another master has left behind: its station addresses, FMMUs, SyncManagers, clocks and states.

use super::*;
use fieldbeat_ethercat::wire::registers::{Fmmu, SyncManager};
use fieldbeat_sim::ethercat::{ClockKind, SlaveSettings};

/// Drives, and terminals behind them.
fn plan() -> EthercatPlan {
    EthercatPlan { devices: vec![coupler(3)], ..drives(3) }
}

/// Numbers without a pattern, the same in each run.
struct Any(u64);

impl Any {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % end
    }

    fn of<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.below(all.len() as u64) as usize]
    }
}

impl Rig {
    /// Nothing comes for so long.
    fn silence(&mut self, ms: u64) {
        for _ in 0..ms {
            self.cycle.grid = self.cycle.grid + MS;
            let now = self.cycle.grid;
            self.sim.advance(now);
        }
    }

    /// A state, by whoever is there.
    fn request_al(&mut self, place: u16, control: u8) {
        self.poke(place, address::AL_CONTROL, &[control, 0]);
        self.silence(2);
    }

    /// Another master comes, whose grid began elsewhere.
    fn next_master(&mut self, plan: &EthercatPlan) {
        let next = Rig::based(plan, plan, 0x2000_0000);
        (self.line, self.image, self.reported) = (next.line, next.image, Reports::default());
        self.cycle.index = 0;
    }

    /// Leaves this slave in a state of before; whether that is more than a state.
    fn leave(&mut self, any: &mut Any, place: u16) {
        for fmmu in 0..8 {
            if any.below(3) == 0 {
                // Somewhere in the image of the next master.
                let start = 0x2000_0000 + any.below(40) as u32;
                let (length, at) = (any.of(&[1, 2, 6, 40]), any.of(&[0x1000, 0x1100, 0x0130]));
                let bytes = Fmmu::bytes(start, length, at, any.below(2) == 0).to_bytes();
                self.poke(place, address::fmmu(fmmu), &bytes);
            }
        }
        for manager in 0..8 {
            if any.below(3) == 0 {
                let control = any.of(&[0x24, 0x64, 0x26, 0x22, 0x20]);
                let start = any.of(&[0x1000, 0x1100, 0x1800, 0x1C00]);
                let length = any.of(&[1, 6, 16, 1024]);
                let bytes = SyncManager { start, length, control, activate: 1 }.to_bytes();
                self.poke(place, address::sync_manager(manager), &bytes);
            }
        }
        let station = any.of(&[0, 1, 0x1000, 0x1001, 0x1002, 0x1003, 0x1004, 0x1005, 0xFFFF]);
        self.poke(place, address::STATION, &u16::to_le_bytes(station));
        self.poke(place, address::SII_OWNER, &[any.below(2) as u8]);
        self.poke(place, address::ALIAS_ENABLE, &[any.below(2) as u8]);
        self.poke(place, address::EVENT_MASK, &[0xFF, 0xFF]);
        for register in [address::WATCHDOG_DIVIDER, address::WATCHDOG] {
            self.poke(place, register, &u16::to_le_bytes(any.of(&[0, 1, 0xFFFF])));
        }
        if any.below(2) == 0 {
            self.poke(place, address::DC_OFFSET, &any.below(u64::MAX).wrapping_mul(0x1_0001).to_le_bytes());
            self.poke(place, address::DC_ACTIVATION, &[any.below(4) as u8]);
        }
        if any.below(3) == 0 {
            self.poke(place, address::SII_CONTROL, &[0, 1, 0x40, 0, 0, 0]);
        }
    }
}

/// The states that a slave is left in: by requests from OP.
const LEFT: [&[u8]; 8] = [
    // OP, SAFEOP, PREOP, INIT; INIT, PREOP and SAFEOP with an error; what a silent master leads to.
    &[],
    &[4],
    &[2],
    &[1],
    &[1, 8],
    &[2, 8],
    &[4, 3],
    &[1, 3],
];

#[test]
fn a_segment_left_in_any_state_is_taken_over_as_fast_as_a_fresh_one() {
    let plan = plan();
    let fresh = Rig::new(&plan).all_up(5_000);
    let mut worst = 0;
    for seed in 0..60 {
        let mut any = Any(seed);
        let mut rig = Rig::new(&plan);
        rig.all_up(5_000);
        // The master is gone: the drives fall back by their watchdogs, as the terminals do.
        rig.silence(any.of(&[1, 300, 1_000]));
        for place in 0..4 {
            // A drive that is left in OP may move: it is another test's.
            let is_drive = place < 3 && rig.al(place.into()) == AlState::Op;
            let all = if is_drive { &LEFT[1..] } else { &LEFT[..] };
            if rig.slave(place.into()).error().is_none() || any.below(2) == 0 {
                for control in any.of(all) {
                    rig.request_al(place, *control);
                }
            }
            rig.leave(&mut any, place);
        }
        rig.next_master(&plan);
        // Old FMMUs reach into its frames at first, while no slave is in operation.
        rig.run(20);
        let wrong = rig.reported.wrong_counts;
        let cycles = 20 + rig.all_up(5_000);
        worst = worst.max(cycles);
        assert_eq!((rig.receive(100), rig.reported.wrong_counts), (vec![100; 3], wrong), "seed {seed}");
        rig.assert_own_addresses();
        for place in 0..4 {
            assert_eq!(rig.peek(place, address::SII_OWNER, 1), [1], "seed {seed}: it is given back");
            let used = rig.peek(place, address::fmmu(3), 32);
            assert_eq!(used, [0; 32], "seed {seed}: FMMUs of others");
            let watchdog = [address::WATCHDOG_DIVIDER, address::WATCHDOG].map(|at| rig.peek(place, at, 2));
            assert_eq!(watchdog, [0x09C2, 1_000].map(|word| u16::to_le_bytes(word).to_vec()), "seed {seed}");
        }
    }
    assert!(worst <= fresh + fresh / 10, "{worst} cycles, and {fresh} of a fresh one");
}

#[test]
fn the_sync0_that_was_left_on_is_off_where_none_is_configured() {
    let mut segment = EthercatSegment::from(&plan());
    let clock = SlaveSettings { clock: Some(ClockKind::Long), ..SlaveSettings::default() };
    segment.settings.slaves.insert(3, clock);
    let mut rig = Rig::on(&plan(), segment);
    assert!(!rig.line.slaves[3].plan.sync);
    rig.poke(3, address::DC_CYCLE, &1_000_000_u32.to_le_bytes());
    rig.poke(3, address::DC_ACTIVATION, &[3]);
    assert_eq!(rig.peek(3, address::DC_ACTIVATION, 1), [3]);
    rig.all_up(5_000);
    assert_eq!(rig.peek(3, address::DC_ACTIVATION, 1), [0]);
    let now = rig.cycle.grid;
    assert_eq!(rig.slave(3).sync0_in_ns(now), None);
}

#[test]
fn two_slaves_with_one_alias_answer_to_their_own_addresses_only() {
    const ALIAS_WORD: u8 = 4;
    let plan = plan();
    let mut rig = Rig::new(&plan);
    for place in 1..3 {
        // The alias that both have is the station address of the first slave.
        rig.poke(place, address::SII_DATA, &FIRST_STATION.to_le_bytes());
        rig.poke(place, address::SII_CONTROL, &[0x01, 0x02, ALIAS_WORD, 0, 0, 0]);
        rig.silence(2);
        rig.poke(place, address::ALIAS_ENABLE, &[1]);
        assert_eq!(rig.peek(place, address::ALIAS, 2), FIRST_STATION.to_le_bytes());
    }
    rig.poke(0, 0x0100, &[1, 0x04, 0x07, 0x01]);
    rig.all_up(4_000);
    assert_eq!(rig.receive(100), [100; 3]);
    rig.assert_own_addresses();
    assert_eq!(rig.peek(0, 0x0100, 4), [1, 0, 7, 0], "the size of the receive FIFO stays");
    for place in 0..4 {
        assert_eq!(rig.peek(place, address::ALIAS_ENABLE, 1), [0]);
    }
}

#[test]
fn a_slave_that_takes_no_station_address_is_not_called_absent() {
    let mut rig = Rig::new(&drives(1));
    for _ in 0..300 {
        rig.poke(0, address::STATION, &[7, 0]);
        rig.run(1);
        assert_ne!(rig.note(0), Note::Absent);
    }
}

/// Damage on the way: of all reads of the last slave, the ones by its position come back uncounted.
#[test]
fn a_slave_that_is_counted_and_not_read_is_named_as_such() {
    let mut rig = Rig::new(&drives(3));
    rig.mute = Some(2);
    rig.until("named", 500, |rig| rig.note(2) == Note::Unreachable(3));
    assert!(rig.note(2).text(2, &Expected::default()).is_some_and(|text| text.contains("the segment has 3")));
    // With nobody there the broadcast counts nobody.
    rig.sim.cut(Some(2));
    rig.until("absent", 500, |rig| rig.note(2) == Note::Absent);
    (rig.mute, _) = (None, rig.sim.cut(None));
    rig.all_up(5_000);
}

/// One that requests INIT is named, for this time. A processor that restarts is no such sign: its controller keeps its
/// power, and the state requested of it, 0120h, is still that of this master.
#[test]
fn a_master_that_requests_init_is_named_until_the_slave_is_set_up_the_next_time() {
    let mut rig = Rig::new(&drives(3));
    rig.all_up(5_000);
    rig.run(50);
    rig.request_al(1, 1);
    rig.until("named", 100, |rig| std::mem::take(&mut rig.line.lowered));
    rig.all_up(5_000);
    assert_eq!((rig.line.remarks.get(1), rig.note(1)), (Note::Intruded, Note::None));
    assert!(rig.reported.restarted.is_empty());
    let now = rig.cycle.grid;
    rig.run(50);
    rig.slave(1).restart_firmware(now);
    assert_eq!((rig.al(1), rig.peek(1, address::AL_CONTROL, 1)), (AlState::Init, vec![8]));
    rig.until("reported", 100, |rig| rig.reported.restarted == [Owner::Drive(1)]);
    rig.all_up(5_000);
    assert!(!rig.line.lowered && rig.line.remarks.get(1) == Note::None);
    assert_eq!(rig.receive(100), [100; 3]);
}

/// Behind those of the plan: whatever they map, it is carried out with the frames of this master.
#[test]
fn a_slave_with_a_foreign_fmmu_is_set_up_again_and_not_resumed() {
    for active in [false, true] {
        let mut rig = Rig::new(&drives(3));
        rig.all_up(5_000);
        rig.run(50);
        let foreign = Fmmu { active, ..Fmmu::bytes(0x2000_0000, 6, 0x1100, true) };
        rig.poke(1, address::fmmu(7), &foreign.to_bytes());
        // It was deaf for a while, and is resumed by what is read back.
        rig.sim.deafen(1, true);
        rig.run(20);
        rig.sim.deafen(1, false);
        rig.all_up(5_000);
        assert_eq!(std::mem::take(&mut rig.line.lowered), active);
        let left = if active { vec![0; Fmmu::SIZE] } else { foreign.to_bytes().to_vec() };
        assert_eq!(rig.peek(1, address::fmmu(7), Fmmu::SIZE), left);
        assert_eq!(rig.line.remarks.get(1) == Note::Intruded, active);
        assert_eq!(rig.receive(100), [100; 3]);
    }
}
