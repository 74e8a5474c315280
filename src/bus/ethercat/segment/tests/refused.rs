//! Slaves that are refused again and again, and such that take their time.

use super::*;

/// A drive of another product than the configured one, behind another drive.
fn other() -> Rig {
    let mut plan = drives(2);
    plan.drives[1].slave.identity.product = Some(7);
    Rig::on(&plan, drives(2))
}

impl Rig {
    /// Whether its SII is taken in this cycle, as each attempt begins.
    fn begins(&mut self) -> bool {
        let before = self.line.slaves[1].at().contains("SiiForce");
        self.run(1);
        !before && self.line.slaves[1].at().contains("SiiForce")
    }

    fn attempts(&mut self, cycles: usize) -> usize {
        (0..cycles).filter(|_| self.begins()).count()
    }
}

#[test]
fn the_pauses_of_a_slave_that_is_refused_grow_to_half_a_minute() {
    let mut rig = other();
    let begins: Vec<u64> = (0..100_000).filter(|_| rig.begins()).collect();
    let pauses: Vec<u64> = begins.windows(2).map(|pair| (pair[1] - pair[0]) / 1_000).collect();
    assert_eq!(pauses, [1, 2, 4, 8, 16, 30, 30]);
    assert!(matches!(rig.note(1), Note::Product(_)));
}

#[test]
fn a_refused_slave_that_was_away_or_looks_otherwise_is_tried_at_once() {
    let mut rig = other();
    rig.attempts(40_000);
    assert_eq!(rig.attempts(5_000), 0, "it waits for half a minute");
    rig.sim.cut(Some(1));
    rig.run(500);
    assert_eq!(rig.note(1), Note::Absent);
    rig.sim.cut(None);
    assert_eq!(rig.attempts(500), 1);
    // The pauses are short again.
    assert_eq!(rig.attempts(3_500), 2);
    rig.attempts(40_000);
    rig.poke(1, address::STATION, &[9, 0]);
    assert_eq!(rig.attempts(300), 1);
}

#[test]
fn a_slow_slave_has_the_time_of_its_description() {
    // It takes a request after that time only, and the first one is for INIT, where it is.
    for (takes, limit, within_ms) in
        [(2 * S, 5 * S, 0), (3 * S, 5 * S, 5_000), (3 * S, 7 * S, 0), (S, 500 * MS, 500)]
    {
        let mut plan = drives(0);
        plan.devices = vec![coupler(0)];
        plan.devices[0].slave.inputs[0].start = 0x1100;
        plan.devices[0].slave.state_timeout_ns = limit;
        let mut rig = Rig::new(&plan);
        let settings = Settings { features: Features(0x0180), reaction_ns: takes, ..Settings::default() };
        let io = Coupler::of(&plan.devices[0]).slave(
            "I/O",
            Identity { vendor: 2, ..Identity::default() },
            settings,
        );
        *rig.sim.segment() = ethercat::Segment::new(vec![io]);
        if within_ms == 0 {
            rig.all_up(40_000);
        } else {
            rig.until("named", 40_000, |rig| matches!(rig.note(0), Note::Slow { .. }));
            assert_eq!(rig.note(0), Note::Slow { to: AlState::PreOp, within_ms });
        }
    }
}

#[test]
fn a_slave_that_is_gone_does_not_hold_up_the_end() {
    let mut rig = Rig::new(&drives(2));
    rig.all_up(4_000);
    // Too late to be noticed before.
    rig.sim.deafen(1, true);
    let done = |rig: &mut Rig| {
        let now = rig.cycle.grid;
        rig.line.shut_down(now)
    };
    rig.until("down", 100, done);
    assert_eq!([rig.al(0), rig.al(1)], [AlState::Init, AlState::Op]);
}
