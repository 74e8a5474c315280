//! Slaves that are refused again and again, and such that take their time.

use super::*;
use fieldbeat_ethercat::wire::registers::AlCode;
use fieldbeat_sim::ethercat::Application;

/// A drive of another product than the configured one, behind another drive.
fn other() -> Rig {
    let mut plan = drives(2);
    plan.drives[1].slave.identity.product = Some(7);
    Rig::on(&plan, drives(2))
}

impl Rig {
    /// Whether the SII of the last slave is taken in this cycle, as each attempt begins.
    fn begins(&mut self) -> bool {
        let is_taken = |rig: &Rig| rig.line.slaves.last().is_some_and(|slave| at(slave).contains("SiiForce"));
        let before = is_taken(self);
        self.run(1);
        !before && is_taken(self)
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

/// Terminals that enter a state never, or stay in OP for so long only.
#[derive(Debug)]
struct Unwilling {
    refuses: Option<AlState>,
    stays_ns: u64,
    code: AlCode,
    /// When they came to OP, and whether that is over.
    up: Option<Time>,
    falls: bool,
}

impl Application for Unwilling {
    fn mailbox(&mut self, _request: &[u8], _reply: &mut Vec<u8>) -> bool {
        false
    }

    fn may_enter(&mut self, now: Time, state: AlState) -> Result<(), AlCode> {
        if self.refuses == Some(state) {
            return Err(self.code);
        }
        (self.up, self.falls) = ((state == AlState::Op).then_some(now), false);
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        self.falls = self.up.is_some_and(|up| now.since(up) > self.stays_ns);
    }

    fn dropped(&mut self) -> Option<AlCode> {
        std::mem::take(&mut self.falls).then_some(self.code)
    }

    fn process(&mut self, _now: Time, _outputs: &[u8], _inputs: &mut [u8]) {}
}

fn unwilling(refuses: Option<AlState>, stays_ns: u64, code: AlCode) -> Rig {
    let mut plan = drives(0);
    plan.devices = vec![coupler(0)];
    plan.devices[0].slave.inputs[0].start = 0x1100;
    let identity = Identity { vendor: 2, ..Identity::default() };
    let sii = Coupler::of(&plan.devices[0]).contents("I/O", identity).image();
    let settings = Settings { features: Features(0x0180), sii, ..Settings::default() };
    let mut rig = Rig::new(&plan);
    let terminals = Unwilling { refuses, stays_ns, code, up: None, falls: false };
    *rig.sim.segment() = ethercat::Segment::new(vec![Esc::new(settings, Box::new(terminals))]);
    rig
}

/// The seconds between the attempts, how often it came to OP, and what was said of it, in a row.
fn attempts(rig: &mut Rig, cycles: u64) -> (Vec<u64>, usize, Vec<Note>) {
    let (mut begins, mut ups, mut was_up, mut notes) = (Vec::new(), 0, false, Vec::new());
    for cycle in 0..cycles {
        if rig.begins() {
            begins.push(cycle);
        }
        let is_up = rig.al(0) == AlState::Op;
        ups += usize::from(is_up && !std::mem::replace(&mut was_up, is_up));
        was_up = is_up;
        let note = rig.note(0);
        if notes.last() != Some(&note) {
            notes.push(note);
        }
    }
    (begins.windows(2).map(|pair| (pair[1] - pair[0]) / 1_000).collect(), ups, notes)
}

#[test]
fn the_pauses_grow_whichever_state_is_refused_and_its_reason_is_named_once() {
    for (to, code) in [(AlState::PreOp, 0x16), (AlState::SafeOp, 0x1D), (AlState::Op, 0x30)] {
        let code = AlCode(code);
        let mut rig = unwilling(Some(to), 0, code);
        let (pauses, _, notes) = attempts(&mut rig, 100_000);
        assert_eq!(pauses, [1, 2, 4, 8, 16, 30, 30], "{to}");
        assert_eq!(notes, [Note::Starting, Note::State { to, code }], "{to}");
    }
}

#[test]
fn a_slave_that_falls_right_after_op_again_and_again_has_to_wait() {
    let (to, code) = (AlState::Op, AlCode(0x1A));
    let mut rig = unwilling(None, 100 * MS, code);
    let (pauses, ups, notes) = attempts(&mut rig, 100_000);
    // The first time it is brought back at once, by way of SAFEOP; each further one begins with its SII.
    assert_eq!((pauses, ups), (vec![2, 4, 8, 16, 30, 30], 8));
    let is_known =
        |note: &Note| matches!(note, Note::Starting | Note::None) || *note == Note::State { to, code };
    assert!(notes.contains(&Note::State { to, code }) && notes.iter().all(is_known), "{notes:?}");
}

#[test]
fn a_slave_that_falls_now_and_then_is_brought_back_at_once() {
    let mut rig = unwilling(None, 2_500 * MS, AlCode(0x1A));
    let (pauses, ups, _) = attempts(&mut rig, 40_000);
    // From SAFEOP on: its SII is not read again.
    assert!(pauses.is_empty() && (12..=16).contains(&ups), "{pauses:?}, {ups} times");
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
