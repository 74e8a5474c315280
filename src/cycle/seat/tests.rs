//! One axis without a bus: the tests write what its drive reports, and when an order is done.

use std::time::Duration;

use super::*;
use crate::axis::newest::{NewestIn, newest};
use crate::axis::{Emergency, Failure, HeldBy, Load, Units, cell};
use crate::bus::Progress;
use crate::rt::ring;
use crate::time::MS;

/// An axis, its slot, and the application's ends of its queues. A cycle takes 1 ms.
pub(in crate::cycle) struct Alone {
    pub seat: Seat,
    pub slot: Slot,
    pub commands: Producer<Command>,
    pub rows: Producer<StreamRow>,
    _setpoints: NewestIn,
    events: Consumer<Event>,
    index: u64,
    id: u64,
}

pub(in crate::cycle) fn cycle(index: u64) -> Cycle {
    let grid = Time(index * MS);
    Cycle { index, grid, period_ns: MS, deadline: grid + MS / 2 }
}

pub(in crate::cycle) fn plan() -> AxisPlan {
    AxisPlan::new("x", Units::millimetres(1_000.0))
}

impl Alone {
    pub fn new(plan: AxisPlan) -> Alone {
        let mut regions = Regions::default();
        let (commands, command_out) = ring(8, &mut regions);
        let (rows, row_out) = ring(8, &mut regions);
        let (setpoints, setpoint_out) = newest();
        let (event_in, events) = ring(64, &mut regions);
        let (feedback, _) = cell::cell(Feedback::default());
        let queues = Queues {
            commands: command_out,
            rows: row_out,
            setpoints: setpoint_out,
            events: event_in,
            room_for_ends: 8,
            feedback,
            samples: None,
        };
        let seat = Seat::new(plan, queues, MS, 0, 100);
        let slot = Slot::default();
        Alone { seat, slot, commands, rows, _setpoints: setpoints, events, index: 0, id: 0 }
    }

    /// One cycle up to the commands. The drive answers with the report in the slot.
    pub fn turn(&mut self) {
        self.slot.report.fresh = true;
        self.miss();
    }

    /// One cycle up to the commands, in which the report in the slot is not new unless it says so.
    pub fn miss(&mut self) {
        self.index += 1;
        let cycle = cycle(self.index);
        let now = cycle.grid;
        let (seat, slot) = (&mut self.seat, &mut self.slot);
        slot.exchange = match slot.report.fresh {
            true => Exchange::Answered { sent_at: now, at: now, suspect: slot.report.suspect },
            false => Exchange::Absent,
        };
        slot.report.at = now;
        seat.judge(&cycle, now, slot);
        seat.watch(&cycle, now, slot);
        seat.exchange(&cycle, now, slot);
    }

    pub fn turns(&mut self, count: u32) {
        (0..count).for_each(|_| self.turn());
    }

    pub fn post(&mut self, verb: Verb) -> u64 {
        self.id += 1;
        self.commands.push(Command { id: CommandId(self.id), verb, stream: 0, ticket: None }).unwrap();
        self.id
    }

    /// The bus ends the order; the loop looks at it in the same cycle.
    pub fn ends(&mut self, end: Result<(), Failure>) {
        self.slot.progress = Progress { serial: self.slot.order.serial, end: Some(end) };
        self.turn();
    }

    /// The command is done, and the drive reports this state from then on.
    pub fn done(&mut self, verb: Verb, state: State) {
        let id = self.post(verb);
        self.turn();
        self.slot.report.state = state;
        self.ends(Ok(()));
        assert_eq!(self.ended(), [(id, Outcome::Done)]);
    }

    /// Online, and homed as it says.
    pub fn online(mut self) -> Alone {
        (self.slot.report.state, self.slot.report.homed) = (State::ReadyToSwitchOn, true);
        self.turns(10);
        assert_eq!(self.seat.feedback().link, Link::Online);
        self
    }

    /// In operation.
    pub fn enabled(self) -> Alone {
        let mut alone = self.online();
        alone.done(Verb::Enable, State::OperationEnabled);
        alone
    }

    /// The commands that have ended since the last look.
    pub fn ended(&mut self) -> Vec<(u64, Outcome)> {
        (self.told().into_iter())
            .filter_map(|kind| match kind {
                EventKind::Ended { id, outcome, .. } => Some((id.0, outcome)),
                _ => None,
            })
            .collect()
    }

    /// All events since the last look.
    pub fn told(&mut self) -> Vec<EventKind> {
        std::iter::from_fn(|| self.events.pop().ok()).map(|event| event.kind).collect()
    }
}

#[test]
fn an_enable_that_failed_may_bring_power_on_until_four_clean_reports_without_it() {
    let mut x = Alone::new(plan()).online();
    assert!(!x.seat.is_guarded());
    x.post(Verb::Enable);
    x.turn();
    assert!(x.seat.is_guarded());
    x.ends(Err(Failure::TimedOut(State::ReadyToSwitchOn)));
    // The report of the cycle in which it failed came while it ran.
    x.turns(3);
    assert!(x.seat.is_guarded());
    x.slot.report.suspect = true;
    x.turns(9);
    assert!(x.seat.is_guarded(), "a report that may be an old one shows nothing");
    x.slot.report.suspect = false;
    x.turn();
    assert!(!x.seat.is_guarded());
}

#[test]
fn the_age_of_a_suspect_report_counts_from_the_exchange_before() {
    let mut x = Alone::new(plan()).online();
    x.miss();
    assert_eq!(x.seat.feedback().age, 1);
    x.slot.report.suspect = true;
    x.turn();
    assert_eq!(x.seat.feedback().age, 1);
    x.miss();
    assert_eq!(x.seat.feedback().age, 2);
}

#[test]
fn a_restart_an_emergency_and_a_refused_variable_in_one_report_are_all_told() {
    for (restarted, refused, emergency) in [
        (true, false, false),
        (false, true, false),
        (false, false, true),
        (true, true, false),
        (true, false, true),
        (false, true, true),
        (true, true, true),
    ] {
        let mut x = Alone::new(plan()).online();
        x.told();
        let report = &mut x.slot.report;
        report.restarted = restarted;
        report.monitor_refused = refused.then_some((2, 7));
        report.emergency = emergency.then_some(Emergency { code: 1, register: 0 });
        x.turn();
        let told = x.told();
        let holds = |kind| told.contains(&kind);
        assert_eq!(holds(EventKind::Restarted), restarted, "{told:?}");
        assert_eq!(holds(EventKind::MonitorRefused { channel: 2, status: 7 }), refused, "{told:?}");
        assert_eq!(holds(EventKind::Emergency(Emergency { code: 1, register: 0 })), emergency, "{told:?}");
    }
}

#[test]
fn a_vertical_load_that_homes_or_whose_report_is_old_keeps_its_power() {
    let vertical = AxisPlan { load: Load::Vertical(HeldBy::Brake), ..plan() };
    let mut x = Alone::new(vertical.clone()).enabled();
    // Its first report after the order shows no motion yet.
    x.post(Verb::Home);
    x.turn();
    let off = x.post(Verb::Disable);
    x.turn();
    assert_eq!(x.ended(), [(off, Outcome::Failed(Failure::LoadInMotion))]);
    let mut x = Alone::new(vertical).enabled();
    let off = x.post(Verb::Disable);
    x.miss();
    assert_eq!(x.ended(), [(off, Outcome::Failed(Failure::LoadInMotion))]);
    let off = x.post(Verb::Disable);
    x.turn();
    x.ends(Ok(()));
    assert_eq!(x.ended(), [(off, Outcome::Done)]);
}

#[test]
fn a_drive_that_was_found_running_is_braked_at_the_end_once_a_reset_has_taken_it_over() {
    let plan = AxisPlan { on_found_running: FoundRunning::Refuse, ..plan() };
    for reset in [false, true] {
        let mut x = Alone::new(plan.clone());
        x.slot.report.state = State::OperationEnabled;
        x.turns(10);
        assert_eq!(x.seat.feedback().stopped, Some(StopCause::FoundRunning));
        if reset {
            let id = x.post(Verb::Reset);
            x.turn();
            assert_eq!(x.ended(), [(id, Outcome::Done)]);
        }
        let left = x.seat.shut_down(&cycle(99), Time(99 * MS), &mut x.slot, false);
        assert_eq!((left, x.slot.order.verb.is_some()), (!reset, reset));
    }
}

#[test]
fn a_task_command_needs_room_for_its_end_unless_it_is_a_stop() {
    let mut x = Alone::new(plan()).enabled();
    while x.seat.queues.events.slots() > x.seat.queues.room_for_ends {
        x.seat.tell(&cycle(50), Time(50 * MS), EventKind::Restarted);
    }
    let mut takes = |verb| {
        let command = Command { id: CommandId::of_task(1), verb, stream: 0, ticket: None };
        x.seat.command_from_task(&cycle(50), Time(50 * MS), command).is_ok()
    };
    assert!(!takes(Verb::Home));
    assert!(takes(Verb::QuickStop));
}

#[test]
fn a_quick_stop_takes_the_place_of_a_ramp_and_not_of_the_power_off_after_it() {
    let mut x = Alone::new(plan()).enabled();
    x.seat.stop(&cycle(50), Time(20 * MS), StopCause::Overrun, &mut x.slot);
    let ramp = x.post(Verb::QuickStop);
    x.turn();
    assert_eq!(x.slot.order.verb, Some(Verb::QuickStop));
    // At standstill; the drive reports its power later.
    let standstill = x.seat.plan().stop.standstill_for;
    x.turns(standstill);
    assert_eq!(x.slot.order.verb, Some(Verb::Disable));
    assert_eq!(x.ended(), [(ramp, Outcome::Aborted(Abort::Stopped(StopCause::Overrun)))]);
    let late = x.post(Verb::QuickStop);
    x.turn();
    assert_eq!(x.ended(), [(late, Outcome::Failed(Failure::Latched(StopCause::Overrun)))]);
    assert_eq!(x.slot.order.verb, Some(Verb::Disable));
}
