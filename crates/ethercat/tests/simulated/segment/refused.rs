//! Slaves that are refused again and again, and such that take their time.

use super::*;
use fieldbeat_ethercat::wire::registers::AlCode;
use fieldbeat_sim::ethercat::Application;

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

/// Terminals that enter a state never, or stay in OP for so long only.
#[derive(Debug, Default)]
pub(super) struct Unwilling {
    pub(super) refuses: Option<AlState>,
    pub(super) stays_ns: Option<u64>,
    pub(super) code: AlCode,
    /// When they came to OP, and whether that is over.
    pub(super) up: Option<Time>,
    pub(super) falls: bool,
}

impl Application for Unwilling {
    fn mailbox(&mut self, _request: &[u8], _reply: &mut Vec<u8>) -> bool {
        false
    }

    fn may_enter(&mut self, now: Time, state: ethercat::AlState) -> Result<(), u16> {
        if self.refuses.is_some_and(|refused| refused as u8 == state as u8) {
            return Err(self.code.0);
        }
        (self.up, self.falls) = ((state == ethercat::AlState::Op).then_some(now), false);
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        self.falls = self.up.zip(self.stays_ns).is_some_and(|(up, stays)| now.since(up) > stays);
    }

    fn dropped(&mut self) -> Option<u16> {
        std::mem::take(&mut self.falls).then_some(self.code.0)
    }

    fn process(&mut self, _now: Time, _outputs: &[u8], _inputs: &mut [u8]) {}
}

fn unwilling(refuses: Option<AlState>, stays_ns: Option<u64>, code: AlCode) -> Rig {
    let plan = terminals();
    let sii = Coupler::of(&plan.devices[0]).contents("I/O", IO).image();
    let settings = Settings { features: 0x0180, sii, ..Settings::default() };
    let unwilling = Unwilling { refuses, stays_ns, code, ..Unwilling::default() };
    Rig::of(&plan, vec![Esc::new(settings, Box::new(unwilling))])
}

/// The seconds between the attempts of the last slave, how often it came to OP, and what was said of it, in a row.
fn attempts(rig: &mut Rig, cycles: u64) -> (Vec<u64>, usize, Vec<Note>) {
    let last = rig.line.slaves.len() - 1;
    let (mut begins, mut ups, mut was_up, mut notes) = (Vec::new(), 0, false, Vec::new());
    for cycle in 0..cycles {
        if rig.begins() {
            begins.push(cycle);
        }
        let is_up = rig.al(last) == AlState::Op;
        ups += usize::from(is_up && !std::mem::replace(&mut was_up, is_up));
        was_up = is_up;
        if notes.last() != Some(&rig.note(last)) {
            notes.push(rig.note(last));
        }
    }
    (begins.windows(2).map(|pair| (pair[1] - pair[0]) / 1_000).collect(), ups, notes)
}

#[test]
fn the_pauses_of_a_slave_that_is_refused_grow_to_half_a_minute_and_its_reason_is_named_once() {
    let states = [(AlState::PreOp, 0x16), (AlState::SafeOp, 0x1D), (AlState::Op, 0x30)].map(|(to, code)| {
        let code = AlCode(code);
        (unwilling(Some(to), None, code), Note::State { to, code })
    });
    for (mut rig, named) in [(Rig::with_other(2, 1), Note::Product(8))].into_iter().chain(states) {
        let (pauses, _, notes) = attempts(&mut rig, 100_000);
        assert_eq!(pauses, [1, 2, 4, 8, 16, 30, 30], "{named:?}");
        assert_eq!(notes, [Note::Starting, named]);
    }
}

#[test]
fn a_slave_that_falls_right_after_op_again_and_again_has_to_wait() {
    let (to, code) = (AlState::Op, AlCode(0x1A));
    let mut rig = unwilling(None, Some(100 * MS), code);
    let (pauses, ups, notes) = attempts(&mut rig, 100_000);
    // The first time it is brought back at once, by way of SAFEOP; each further one begins with its SII.
    assert_eq!((pauses, ups), (vec![2, 4, 8, 16, 30, 30], 8));
    let is_known =
        |note: &Note| matches!(note, Note::Starting | Note::None) || *note == Note::State { to, code };
    assert!(notes.contains(&Note::State { to, code }) && notes.iter().all(is_known), "{notes:?}");
}

#[test]
fn a_slave_that_falls_now_and_then_is_brought_back_at_once() {
    let mut rig = unwilling(None, Some(2_500 * MS), AlCode(0x1A));
    let (pauses, ups, _) = attempts(&mut rig, 40_000);
    // From SAFEOP on: its SII is not read again.
    assert!(pauses.is_empty() && (12..=16).contains(&ups), "{pauses:?}, {ups} times");
}

#[test]
fn a_refused_slave_that_was_away_or_looks_otherwise_is_tried_at_once() {
    let mut rig = Rig::with_other(2, 1);
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
        let mut plan = terminals();
        plan.devices[0].slave.state_timeout_ns = limit;
        let mut rig = Rig::io(&plan, Settings { reaction_ns: takes, ..Settings::default() });
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
    rig.down(100);
    assert_eq!([rig.al(0), rig.al(1)], [AlState::Init, AlState::Op]);
}
