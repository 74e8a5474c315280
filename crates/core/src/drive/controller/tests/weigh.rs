//! Reports that one alone does not prove.

use super::*;
use crate::axis::{DriveStatus, StopHow};

/// 500 mm/s at most.
fn limited() -> AxisPlan {
    let mut plan = plan();
    plan.limits.velocity = Some(500.0);
    plan
}

/// Enabled, with a drive whose reports may be older than the last one, or not.
fn enabled(proof: u8) -> Alone {
    Alone::of(limited(), Capabilities { power_reports: proof, ..can() }).enabled()
}

/// The same in motion.
fn moving(proof: u8) -> Alone {
    let mut x = enabled(proof);
    x.post(Command::Follow);
    x.turns(3);
    x.reported();
    x
}

impl Alone {
    /// A report of this, and of nothing else than before.
    fn reports(&mut self, change: impl Fn(&mut DriveStatus)) {
        let before = self.slot.status;
        change(&mut self.slot.status);
        self.turn();
        self.slot.status = before;
    }

    /// It is there, as each report says from now on.
    fn at(&mut self, position: f64) {
        (self.slot.status.position, self.slot.evidence.position) = (position, position);
        self.turn();
    }
}

/// The losses that an old report may state.
const LOSSES: [fn(&mut DriveStatus); 7] = [
    |status| status.state = State::SwitchOnDisabled,
    |status| status.state = State::SwitchedOn,
    |status| (status.state, status.fault) = (State::Fault, 5),
    |status| status.state = State::FaultReactionActive,
    |status| status.state = State::NotReadyToSwitchOn,
    |status| status.sto_open = true,
    |status| status.homed = false,
];

#[test]
fn one_report_of_a_loss_is_not_shown_and_stops_nothing_where_it_may_be_an_older_one() {
    for loss in LOSSES {
        let mut x = moving(2);
        for round in 1..5 {
            let before = x.controller.feedback().status;
            x.reports(loss);
            let Feedback { status, age, stopped, .. } = *x.controller.feedback();
            assert_eq!((DriveStatus { at: before.at, ..status }, age, stopped), (before, 1, None));
            x.turn();
            assert_eq!((x.controller.feedback().age, x.slot.counters.implausible), (0, round));
        }
        assert_eq!((x.stopped(), x.reported()), (None, vec![]));
    }
}

#[test]
fn a_second_report_of_a_loss_proves_it_and_where_none_is_older_the_first_one_does() {
    let causes = [
        StopCause::DriveDropped,
        StopCause::DriveDropped,
        StopCause::DriveFault,
        StopCause::DriveFault,
        StopCause::DriveDropped,
    ];
    for (loss, cause) in LOSSES.into_iter().zip(causes) {
        for proof in [1, 2] {
            let mut x = moving(proof);
            loss(&mut x.slot.status);
            let lost = x.slot.status;
            for report in 1..=proof {
                assert_eq!(x.stopped(), None);
                x.slot.status = lost;
                x.turn();
                assert_eq!(x.slot.anew, report < proof, "what was taken back is written again");
            }
            assert_eq!((x.stopped(), x.slot.counters.implausible), (Some(cause), 0));
        }
    }
}

#[test]
fn two_reports_of_different_losses_prove_neither() {
    let [.., unhomed] = LOSSES;
    for power in &LOSSES[..6] {
        for [first, second] in [[&unhomed, power], [power, &unhomed]] {
            let mut x = moving(2);
            let before = x.controller.feedback().status;
            x.reports(first);
            x.reports(second);
            let Feedback { status, age, stopped, .. } = *x.controller.feedback();
            assert_eq!((DriveStatus { at: before.at, ..status }, age, stopped), (before, 2, None));
            x.turn();
            assert_eq!((x.controller.feedback().age, x.slot.counters.implausible), (0, 2));
            assert_eq!((x.stopped(), x.reported()), (None, vec![]));
        }
    }
    // A loss of power takes the reference along.
    let mut x = moving(2);
    x.reports(|status| status.state = State::SwitchedOn);
    x.reports(|status| (status.state, status.homed) = (State::SwitchedOn, false));
    assert_eq!(x.stopped(), Some(StopCause::DriveDropped));
}

#[test]
fn a_place_out_of_reach_is_not_shown_and_bounds_nothing() {
    for proof in [1, 2] {
        let mut x = moving(proof);
        x.at(1.0);
        // 339 mm and 339 m/s off, again and again.
        for round in 1..9 {
            x.reports(|status| (status.position, status.velocity) = (340.0, 339_000.0));
            assert_eq!(x.controller.feedback().age, 0, "the place is that of the evidence");
            let before = (x.slot.evidence.position, x.slot.evidence.demand);
            (x.slot.evidence.position, x.slot.evidence.demand) = (340.0, 340.0);
            x.reports(|status| (status.position, status.velocity) = (340.0, 339_000.0));
            let Feedback { status, age, stopped, .. } = *x.controller.feedback();
            assert_eq!((age, stopped, x.slot.counters.implausible), (1, None, round));
            assert_eq!((x.slot.evidence.position, x.slot.evidence.demand), before);
            assert_eq!(status.position, 340.0, "as the report before");
            x.turn();
        }
        assert_eq!(x.stopped(), None);
    }
}

#[test]
fn two_reports_that_agree_become_the_place_and_the_axis_stops_without_its_reference() {
    for proof in [1, 2] {
        let mut x = moving(proof);
        x.at(1.0);
        x.slot.status.velocity = 20.0;
        x.at(340.0);
        assert_eq!((x.stopped(), x.controller.feedback().age), (None, 1));
        x.slot.status.velocity = 339_000.0;
        x.at(340.1);
        let Feedback { status, stopped, .. } = *x.controller.feedback();
        assert_eq!((status.position, status.homed, stopped), (340.1, false, Some(StopCause::PositionJump)));
        assert!((status.velocity - 100.0).abs() < 1e-6, "{}", status.velocity);
        let kinds = x.reported();
        let is_jump = |kind: &EventKind| *kind == EventKind::PositionJump(340.1 - 1.0);
        assert_eq!(kinds.iter().filter(|kind| is_jump(kind)).count(), 1, "{kinds:?}");
        assert_eq!(x.controller.newest(), Some(Command::QuickStop), "no setpoint leads it from there");
        // Whatever the drive says, until it homes.
        for _ in 0..20 {
            x.slot.status.homed = true;
            x.turn();
            assert!(!x.controller.feedback().status.homed && x.slot.anew);
        }
    }
}

#[test]
fn a_homing_or_a_restart_makes_the_word_of_the_drive_count_again_and_a_lost_link_does_not() {
    let jumped = || {
        let mut x = moving(1);
        x.homed = Some(true);
        x.at(340.0);
        x.at(340.0);
        assert_eq!(x.stopped(), Some(StopCause::PositionJump));
        x
    };
    let is_homed = |x: &mut Alone| {
        x.turns(20);
        x.controller.feedback().status.homed
    };
    let mut x = jumped();
    x.slot.status.velocity = 0.0;
    x.ends(Ok(()));
    x.turns(30);
    x.slot.status.state = State::ReadyToSwitchOn;
    x.ends(Ok(()));
    x.turns(3);
    x.done_at_once(Command::Reset);
    x.done(Command::Enable, State::OperationEnabled);
    assert!(!is_homed(&mut x), "a reset is no homing");
    x.ended();
    let id = x.begin(Command::Home);
    x.at(0.0);
    x.ends(Ok(()));
    assert_eq!(x.ended(), [(id, Outcome::Done)]);
    assert!(is_homed(&mut x) && x.stopped().is_none());
    let mut x = jumped();
    x.slot.notices.restarted = true;
    x.turn();
    assert!(is_homed(&mut x));
    let mut x = jumped();
    x.misses(40);
    assert_eq!(x.link(), Link::Lost);
    assert!(!is_homed(&mut x), "the drive has not started again: it counts from the same wrong place");
    assert_eq!(x.link(), Link::Online);
}

#[test]
fn an_axis_whose_place_jumps_in_its_stop_or_while_it_is_held_is_stopped_by_its_drive() {
    let stopped = |then: StopThen| {
        let mut plan = limited();
        (plan.stop.how, plan.stop.then) = (StopHow::Ramp, then);
        let mut x = Alone::of(plan, Capabilities { power_reports: 1, ..can() }).enabled();
        x.at(1.0);
        x.slot.status.velocity = 20.0;
        x.controller.stop(&cycle(x.index), Time(x.index * MS), StopCause::Overrun);
        assert!(matches!(x.controller.newest(), Some(Command::Stop { .. })));
        x
    };
    let jump = |x: &mut Alone| {
        [340.0, 340.1].into_iter().for_each(|place| x.at(place));
        x.controller.newest()
    };
    // On the ramp.
    let mut x = stopped(StopThen::Hold);
    assert_eq!(jump(&mut x), Some(Command::QuickStop));
    assert_eq!(x.stopped(), Some(StopCause::Overrun), "the first cause stays");
    // Held after it, and after its reset.
    for reset in [false, true] {
        let mut x = stopped(StopThen::Hold);
        x.slot.status.velocity = 0.0;
        x.turns(30);
        if reset {
            x.done_at_once(Command::Reset);
        }
        x.reported();
        assert_eq!(jump(&mut x), Some(Command::QuickStop));
        assert!(x.reported().contains(&EventKind::Stopped(StopCause::PositionJump)));
    }
    // One without power is moved by anything.
    let mut x = stopped(StopThen::Disable);
    x.slot.status.velocity = 0.0;
    x.turns(30);
    x.slot.status.state = State::ReadyToSwitchOn;
    x.ends(Ok(()));
    x.turns(3);
    [340.0, 340.1].into_iter().for_each(|place| x.at(place));
    assert_eq!(x.controller.newest(), Some(Command::Disable));
}

#[test]
fn a_restart_is_known_from_its_notice_and_leaves_no_speed_for_the_stop() {
    let stop = |restarted: bool| {
        let mut x = moving(2);
        for step in 1..4 {
            x.slot.status.demand = f64::from(step) * 0.4;
            x.turn();
        }
        assert!((x.controller.speed() - 400.0).abs() < 5.0);
        x.slot.status.state = State::SwitchOnDisabled;
        x.slot.notices.restarted = restarted;
        let lost = x.slot.status;
        x.turn();
        if !restarted {
            x.slot.status = lost;
            x.turn();
        }
        assert_eq!(x.stopped(), Some(StopCause::DriveDropped));
        x.controller.speed()
    };
    assert_eq!(stop(true), 0.0);
    assert_eq!(stop(false), 0.0, "it stood in the last report");
}
