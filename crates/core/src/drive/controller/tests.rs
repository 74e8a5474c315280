//! One axis without a bus: the tests write what its drive reports, and when an order is done.

mod exchanges;
mod stopping;
mod weigh;

use std::slice::{from_mut, from_ref};
use std::time::Duration;

use rtrb::Consumer;

use super::*;
use crate::axis::command::NativeOwner;
use crate::axis::doorbell::Bells;
use crate::axis::newest::{NewestIn, newest};
use crate::axis::{
    Emergency, Failure, FoundRunning, HeldBy, Link, Load, Move, State, StopCause, StopThen, Target, Underrun,
    Units, cell,
};
use crate::bus::Exchange;
use crate::bus::desired::{Generator, Velocities};
use crate::drive::record::measured;
use crate::rt::{Regions, ring};
use crate::time::MS;

/// An axis, its slot, and the application's ends of its queues. A cycle takes 1 ms.
pub(in crate::drive) struct Alone {
    pub controller: DriveController,
    pub slot: Slot,
    pub commands: Producer<QueuedCommand>,
    pub rows: Producer<StreamRow>,
    pub setpoints: NewestIn,
    bells: Bells,
    pub events: Consumer<Event>,
    index: u64,
    id: u64,
    /// The reference that the drive reports each time, whatever the loop has made of the last report.
    homed: Option<bool>,
}

pub(in crate::drive) fn cycle(index: u64) -> Cycle {
    let grid = Time(index * MS);
    Cycle { index, grid, period_ns: MS, deadline: grid + MS / 2 }
}

pub(in crate::drive) fn plan() -> AxisPlan {
    AxisPlan::new("x", Units::millimetres(1_000.0))
}

/// The capabilities of a drive that makes its own setpoints.
fn can() -> Capabilities {
    Capabilities::of(Generator::Drive { velocities: Some(Velocities::Leash(1.0)) })
}

impl DriveController {
    /// The newest command of its drive machine.
    pub(in crate::drive) fn newest(&self) -> Option<Command> {
        self.machine.command()
    }

    /// The velocity or torque that its drive machine goes for.
    pub(in crate::drive) fn level(&self) -> f64 {
        self.machine.input.level
    }

    /// It has a row for the next send.
    pub(in crate::drive) fn has_next_row(&self) -> bool {
        self.machine.input.row.is_some()
    }

    /// It ends like this.
    pub(in crate::drive) fn end_with(&mut self, end: Result<(), Failure>) {
        self.machine.end_with(end);
        self.called = true;
    }
}

/// The commands whose ends are among these events.
pub(in crate::drive) fn ended(events: &mut Consumer<Event>) -> Vec<(u64, Outcome)> {
    std::iter::from_fn(|| events.pop().ok())
        .filter_map(|event| match event.kind {
            EventKind::Ended { id, outcome, .. } => Some((id.0, outcome)),
            _ => None,
        })
        .collect()
}

impl Alone {
    pub fn new(plan: AxisPlan) -> Alone {
        Alone::of(plan, can())
    }

    /// With a drive that can do this.
    pub fn of(plan: AxisPlan, can: Capabilities) -> Alone {
        let mut regions = Regions::default();
        let (commands, posted) = ring(8, &mut regions);
        let (rows, row_out) = ring(8, &mut regions);
        let (setpoints, setpoint_out) = newest(4);
        let (event_in, events) = ring(64, &mut regions);
        let (feedback, _) = cell::cell(Feedback::default());
        let queues = Queues {
            posted: Inlet::new(posted),
            commands: VecDeque::with_capacity(8),
            rows: Inlet::new(row_out),
            setpoints: setpoint_out,
            events: event_in,
            room_for_ends: 8,
            samples: None,
            log: InputLog::default(),
            journal: Journal::new(8, &mut Regions::default()),
        };
        let controller = DriveController::new(plan, can, (feedback, queues), MS, 0, 100, Probes::Spaced);
        let slot = Slot::default();
        Alone {
            controller,
            slot,
            commands,
            rows,
            setpoints,
            bells: Bells::new(1),
            events,
            index: 0,
            id: 0,
            homed: None,
        }
    }

    /// One cycle up to the commands. The drive answers with the report in the slot.
    pub fn turn(&mut self) {
        self.slot.notices.fresh = true;
        self.miss();
    }

    /// One cycle up to the commands, in which the report in the slot is not new unless it says so.
    pub fn miss(&mut self) {
        self.index += 1;
        let cycle = cycle(self.index);
        let now = cycle.grid;
        let (controller, slot) = (&mut self.controller, &mut self.slot);
        slot.exchange = match slot.notices.fresh {
            true => Exchange::Answered { sent_at: now, at: now, suspect: slot.status.suspect },
            false => Exchange::Absent { sent_at: now },
        };
        slot.status.at = now;
        slot.status.homed = self.homed.unwrap_or(slot.status.homed);
        controller.evaluate_received(&cycle, now, slot);
        assert!(matches!(slot.exchange, Exchange::Idle | Exchange::Missed), "taken once");
        take_commands(from_mut(controller), &mut self.bells);
        controller.exchange(&cycle, now, slot);
    }

    pub fn turns(&mut self, count: u32) {
        (0..count).for_each(|_| self.turn());
    }

    fn misses(&mut self, count: u32) {
        (0..count).for_each(|_| self.miss());
    }

    fn stopped(&self) -> Option<StopCause> {
        self.controller.feedback().stopped
    }

    fn link(&self) -> Link {
        self.controller.feedback().link
    }

    pub fn post(&mut self, command: Command) -> u64 {
        self.id += 1;
        self.commands
            .push(QueuedCommand { id: CommandId(self.id), member: 0, command, stream: 0, call: None })
            .unwrap();
        self.bells.bell(0).ring();
        self.id
    }

    /// Posts it, and a cycle passes.
    fn begin(&mut self, command: Command) -> u64 {
        let id = self.post(command);
        self.turn();
        id
    }

    /// The bus ends the order; the loop looks at it in the same cycle.
    pub fn ends(&mut self, end: Result<(), Failure>) {
        self.controller.end_with(end);
        self.turn();
    }

    /// The command is done, and the drive reports this state from then on.
    pub fn done(&mut self, command: Command, state: State) {
        let id = self.begin(command);
        self.slot.status.state = state;
        self.ends(Ok(()));
        assert_eq!(self.ended(), [(id, Outcome::Done)]);
    }

    /// The command ends in the cycle in which it begins.
    fn done_at_once(&mut self, command: Command) {
        let id = self.post(command);
        self.ended();
        self.miss();
        assert_eq!(self.ended(), [(id, Outcome::Done)]);
    }

    /// Online, and homed as it says.
    pub fn online(mut self) -> Alone {
        (self.slot.status.state, self.slot.status.homed) = (State::ReadyToSwitchOn, true);
        self.turns(10);
        assert_eq!(self.controller.feedback().link, Link::Online);
        self
    }

    /// In operation.
    pub fn enabled(self) -> Alone {
        let mut alone = self.online();
        alone.done(Command::Enable, State::OperationEnabled);
        alone
    }

    /// The commands that have ended since the last look.
    pub fn ended(&mut self) -> Vec<(u64, Outcome)> {
        ended(&mut self.events)
    }

    /// All events since the last look.
    pub fn reported(&mut self) -> Vec<EventKind> {
        std::iter::from_fn(|| self.events.pop().ok()).map(|event| event.kind).collect()
    }
}

#[test]
fn an_enable_that_failed_may_bring_power_on_until_four_clean_reports_without_it() {
    let off = State::ReadyToSwitchOn;
    let mut x = Alone::new(plan()).online();
    assert!(!x.controller.is_guarded());
    x.begin(Command::Enable);
    assert!(x.controller.is_guarded());
    // The report of the cycle in which it failed came while it ran.
    x.ends(Err(Failure::TimedOut(off)));
    for (what, reports, suspect, state, guarded) in [
        ("three are not enough", 3, false, off, true),
        ("one that may be an old one shows nothing", 9, true, off, true),
        ("nor does one with power", 9, false, State::SwitchedOn, true),
        ("the first one without it", 1, true, off, true),
        ("the fourth clean one", 1, false, off, false),
    ] {
        (x.slot.status.suspect, x.slot.status.state) = (suspect, state);
        x.turns(reports);
        assert_eq!(x.controller.is_guarded(), guarded, "{what}");
    }
    // Nor does the end of another command.
    x.begin(Command::Enable);
    x.ends(Err(Failure::TimedOut(off)));
    x.slot.status.suspect = true;
    x.begin(Command::ResetFault);
    x.ends(Ok(()));
    assert!(x.controller.is_guarded());
    x.slot.status.suspect = false;
    // With a fault there was no power, and no other command brings it.
    x.begin(Command::Enable);
    x.ends(Err(Failure::DriveFault(7)));
    assert!(!x.controller.is_guarded());
    x.begin(Command::ResetFault);
    assert!(!x.controller.is_guarded());
}

#[test]
fn a_report_has_an_age_while_the_link_is_up_and_a_suspect_one_that_from_the_exchange_before() {
    let mut x = Alone::new(plan()).online();
    x.miss();
    assert_eq!(x.controller.feedback().age, 1);
    x.slot.status.suspect = true;
    x.turn();
    assert_eq!(x.controller.feedback().age, 1);
    x.miss();
    assert_eq!(x.controller.feedback().age, 2);
    let mut x = Alone::new(plan()).online();
    let oldest = |x: &Alone| x.controller.numbers(&x.slot).peaks.age.ns;
    x.misses(5);
    assert_eq!((x.link(), oldest(&x)), (Link::Lost, 4 * MS));
    x.misses(50);
    assert_eq!(oldest(&x), 4 * MS);
}

#[test]
fn a_restart_an_emergency_and_a_refused_variable_in_one_report_are_all_reported() {
    for reported in 1..8 {
        let [restarted, refused, emergency] = [1, 2, 4].map(|bit| reported & bit != 0);
        let mut x = Alone::new(plan()).online();
        x.reported();
        let notices = &mut x.slot.notices;
        notices.restarted = restarted;
        if refused {
            notices.refuse_monitor(2, 7);
        }
        if emergency {
            notices.report(Emergency { code: 1, register: 0 });
        }
        x.turn();
        let events = x.reported();
        let holds = |kind| events.contains(&kind);
        assert_eq!(holds(EventKind::Restarted), restarted, "{events:?}");
        assert_eq!(holds(EventKind::MonitorRefused { channel: 2, status: 7 }), refused, "{events:?}");
        assert_eq!(holds(EventKind::Emergency(Emergency { code: 1, register: 0 })), emergency, "{events:?}");
    }
}

#[test]
fn a_command_that_is_refused_leaves_what_was_requested() {
    // Of a vertical load in operation; an enable is for one that is not.
    let vertical = |command| {
        let x = Alone::new(AxisPlan { load: Load::Vertical(HeldBy::Brake), ..plan() });
        if command == Command::Enable { x.online() } else { x.enabled() }
    };
    let stopped = |x: &mut Alone| {
        (x.slot.status.moving, x.slot.status.velocity) = (true, 50.0);
        x.controller.stop(&cycle(50), Time(20 * MS), StopCause::Overrun);
    };
    let (off, latched) = (Command::Disable, Failure::Latched(StopCause::Overrun));
    const QUICK: State = State::QuickStopActive;
    type Rows<const N: usize> = [(&'static str, fn(&mut Alone), Command, Failure); N];
    let rows: Rows<9> = [
        ("a stopped axis takes only a quick stop", stopped, off, latched),
        ("no ramp", stopped, Command::Stop { deceleration: None }, latched),
        ("no reset of the fault", stopped, Command::ResetFault, latched),
        // Its first report after the order shows no motion yet.
        ("homes", |x| _ = x.begin(Command::Home), off, Failure::LoadInMotion),
        ("old report", |_| (), off, Failure::LoadInMotion),
        ("a push is not yet a motion", |x| x.slot.status.velocity = 50.0, off, Failure::LoadInMotion),
        ("generator", |x| x.slot.status.moving = true, off, Failure::LoadInMotion),
        ("state", |x| x.slot.status.state = QUICK, Command::Home, Failure::WrongState(QUICK)),
        ("no hardware enable", |x| x.slot.status.sto_open = true, Command::Enable, Failure::StoOpen),
    ];
    for (what, prepare, command, failure) in rows {
        let mut x = vertical(command);
        prepare(&mut x);
        let order = x.controller.machine.newest();
        let id = x.post(command);
        if what == "old report" {
            x.miss()
        } else {
            x.turn()
        }
        assert_eq!(x.ended(), [(id, Outcome::Failed(failure))], "{what}");
        assert_eq!(x.controller.machine.newest(), order, "{what}");
    }
    vertical(off).done(off, State::ReadyToSwitchOn);
}

/// It was found running, and is to be read only.
fn found_running() -> Alone {
    let mut x = Alone::new(AxisPlan { on_found_running: FoundRunning::Refuse, ..plan() });
    x.slot.status.state = State::OperationEnabled;
    x.turns(10);
    assert_eq!(x.stopped(), Some(StopCause::FoundRunning));
    x
}

#[test]
fn a_drive_that_was_found_running_is_braked_at_the_end_once_a_reset_has_taken_it_over() {
    for reset in [false, true] {
        let mut x = found_running();
        assert!(x.controller.is_guarded());
        if reset {
            let id = x.begin(Command::Reset);
            assert_eq!(x.ended(), [(id, Outcome::Done)]);
        }
        let left = x.controller.shut_down(&cycle(99), Time(99 * MS), false);
        assert_eq!((left, x.controller.newest().is_some()), (!reset, reset));
    }
}

#[test]
fn a_quick_stop_takes_the_place_of_a_ramp_and_not_of_the_power_off_after_it() {
    let mut x = Alone::new(plan()).enabled();
    x.controller.stop(&cycle(50), Time(20 * MS), StopCause::Overrun);
    let ramp = x.begin(Command::QuickStop);
    assert_eq!(x.controller.newest(), Some(Command::QuickStop));
    // At standstill; the drive reports its power later.
    let standstill = x.controller.plan().stop.standstill_for;
    x.turns(standstill);
    assert_eq!(x.controller.newest(), Some(Command::Disable));
    assert_eq!(x.ended(), [(ramp, Outcome::Aborted(Abort::Stopped(StopCause::Overrun)))]);
    let late = x.begin(Command::QuickStop);
    assert_eq!(x.ended(), [(late, Outcome::Failed(Failure::Latched(StopCause::Overrun)))]);
    assert_eq!(x.controller.newest(), Some(Command::Disable));
}

/// Enabled, homed, between 0 and 100 mm; it brakes with 1000 mm/s².
fn ranged() -> Alone {
    let mut plan = plan();
    plan.limits.position = Some((0.0, 100.0));
    plan.limits.velocity = Some(500.0);
    plan.setpoint_age = 1_000;
    Alone::new(plan).enabled()
}

/// The position in mm at which it is stopped when its demand goes on by `step` a cycle, and by what.
fn stopped_at(x: &mut Alone, step: f64) -> (f64, StopCause) {
    for _ in 0..400 {
        let status = &mut x.slot.status;
        (status.moving, status.velocity) = (true, step * 1e3);
        status.demand += step;
        status.position = status.demand;
        x.turn();
        if let Some(cause) = x.stopped() {
            return (x.controller.feedback().status.demand, cause);
        }
    }
    panic!("not stopped");
}

#[test]
fn native_data_are_stopped_where_the_axis_can_still_brake_and_a_move_at_its_limit() {
    // 400 mm/s takes 80 mm to standstill.
    for (command, places) in [
        (Command::Native(NativeOwner::Master), 15.0..20.0),
        (Command::Native(NativeOwner::Application), 15.0..20.0),
        (Command::Torque { slope: 100.0 }, 15.0..20.0),
        (Command::Follow, 100.0..102.0),
    ] {
        let mut x = ranged();
        x.begin(command);
        let (at, cause) = stopped_at(&mut x, 0.4);
        assert!(places.contains(&at) && cause == StopCause::Limit, "{command:?} {at} {cause}");
    }
}

#[test]
fn motion_without_setpoints_is_stopped_by_its_drive_and_other_motion_by_a_ramp() {
    let by_drive = |x: &Alone| x.controller.newest() == Some(Command::QuickStop);
    for (command, step, cause, expected) in [
        // By itself.
        (None, 0.1, StopCause::Uncommanded, true),
        (None, 0.6, StopCause::Limit, true),
        // Faster than its limit: under a motion, and under a stop.
        (Some(Command::Follow), 0.6, StopCause::Limit, false),
        (Some(Command::Stop { deceleration: None }), 0.6, StopCause::Limit, true),
    ] {
        let mut x = ranged();
        match command {
            Some(command) => _ = x.begin(command),
            None => x.turns(100),
        }
        assert_eq!((stopped_at(&mut x, step).1, by_drive(&x)), (cause, expected), "{command:?} {step}");
    }
    // It has left operation.
    let mut x = ranged();
    x.slot.status.state = State::SwitchedOn;
    x.turn();
    assert_eq!(x.stopped(), Some(StopCause::DriveDropped));
    assert!(!by_drive(&x));
}

#[test]
fn a_stop_is_as_steep_as_the_faster_of_demand_and_motor_requires() {
    // In 80 % of 100 ms.
    for (step, velocity, deceleration) in [(0.0, 0.0, 1_000.0), (0.2, 0.0, 2_500.0), (0.2, 320.0, 4_000.0)] {
        let mut plan = plan();
        plan.stop.timeout = Duration::from_millis(100);
        let mut x = Alone::new(plan).enabled();
        x.post(Command::Follow);
        for _ in 0..3 {
            x.slot.status.demand += step;
            x.slot.status.velocity = velocity;
            x.turn();
        }
        x.controller.stop(&cycle(99), Time(99 * MS), StopCause::Overrun);
        let Some(Command::Stop { deceleration: Some(ordered) }) = x.controller.newest() else { panic!() };
        assert!((ordered / deceleration - 1.0).abs() < 0.01, "{ordered} at {step} and {velocity}");
    }
}

#[test]
fn an_axis_that_was_found_running_and_then_stopped_is_braked_when_it_moves_again() {
    let mut x = found_running();
    x.done(Command::Stop { deceleration: None }, State::OperationEnabled);
    x.turns(100);
    x.slot.status.velocity = 50.0;
    x.turns(3);
    assert_eq!(x.stopped(), Some(StopCause::FoundRunning));
    assert_eq!(x.controller.newest(), Some(Command::QuickStop));
}

#[test]
fn a_link_is_counted_as_lost_when_it_was_up_and_its_silence_was_not_requested() {
    let mut x = Alone::new(plan());
    let losses = |x: &Alone| x.controller.numbers(&x.slot).losses;
    for (expected_silence, expected) in [(false, 1), (true, 1), (false, 2)] {
        x.turns(10);
        x.slot.expected_silence = expected_silence;
        x.slot.notices.fresh = false;
        x.misses(9);
        assert_eq!((x.link(), losses(&x)), (Link::Lost, expected), "{expected_silence}");
        // A first answer, and silence again.
        x.turn();
        x.slot.notices.fresh = false;
        x.misses(9);
        assert_eq!((x.link(), losses(&x)), (Link::Lost, expected), "{expected_silence}");
    }
}

#[test]
fn an_expected_silence_spares_the_stop_group_only_while_the_axis_neither_is_in_operation_nor_is_to_be() {
    let lost = Along::All(StopCause::LinkLost);
    for (enabled, command, along) in [
        (false, None, Along::Nobody),
        (false, Some(Command::ResetFault), Along::Nobody),
        (false, Some(Command::Enable), lost),
        (true, None, lost),
        (true, Some(Command::Home), lost),
    ] {
        let mut x = Alone::new(plan());
        x = if enabled { x.enabled() } else { x.online() };
        if let Some(command) = command {
            x.begin(command);
        }
        assert_eq!(x.controller.take_along(), Along::Nobody);
        x.slot.expected_silence = true;
        x.slot.notices.fresh = false;
        x.misses(9);
        assert_eq!(x.stopped(), Some(StopCause::LinkLost));
        assert_eq!(x.controller.take_along(), along, "{enabled} {command:?}");
    }
}

/// An axis that follows, with these rows: the stream, the position, the velocity.
fn following(plan: AxisPlan, rows: &[(u32, f64, f64)]) -> Alone {
    let mut x = Alone::new(plan).enabled();
    x.post(Command::Follow);
    for &(stream, position, velocity) in rows {
        let row = Row { position, velocity, acceleration: 7.0, last: false };
        x.rows.push(StreamRow { stream, member: 0, parts: 1, row }).unwrap();
    }
    x.turn();
    x.slot.due = true;
    x
}

impl Alone {
    /// A row of the in-loop task.
    fn gives(&mut self, position: f64) {
        self.controller.row_from_task(Row { position, ..Row::default() });
    }

    /// A row of the application.
    fn push(&mut self) {
        self.rows.push(StreamRow { stream: 0, member: 0, parts: 1, row: Row::default() }).unwrap();
    }

    /// The row of the next send.
    fn fed_unsent(&mut self) -> Option<Row> {
        self.controller.machine.input.row = None;
        let cycle = cycle(self.index);
        take_rows(from_mut(&mut self.controller), from_ref(&self.slot));
        self.controller.feed(&cycle, cycle.grid, &self.slot);
        self.controller.machine.input.row.map(|row| row.row)
    }

    /// The row of the next send, which goes out.
    fn fed(&mut self) -> Option<Row> {
        let row = self.fed_unsent();
        self.controller.sent(&cycle(self.index), &mut self.slot);
        row
    }
}

#[test]
fn a_stream_that_runs_empty_holds_the_last_position_or_goes_on_at_its_last_speed_for_so_many_rows() {
    // It takes no row of the next one.
    let hold = AxisPlan { underrun: Underrun::Hold, ..plan() };
    let mut x = following(hold, &[(0, 0.01, 10.0), (1, 0.02, 10.0)]);
    assert_eq!(x.fed(), Some(Row { position: 0.01, velocity: 10.0, acceleration: 7.0, last: false }));
    assert_eq!(x.fed(), Some(Row { position: 0.01, velocity: 0.0, acceleration: 0.0, last: false }));
    let plan = AxisPlan { underrun: Underrun::Extrapolate(2), divisor: 1, ..plan() };
    let mut x = following(plan, &[(0, 0.01, 10.0)]);
    x.fed();
    for position in [0.02, 0.03] {
        let row = x.fed().unwrap();
        assert!((row.position - position).abs() < 1e-9, "{row:?}");
        assert_eq!((row.velocity, row.acceleration), (10.0, 0.0));
    }
    assert_eq!(x.fed(), None);
    assert_eq!(x.stopped(), Some(StopCause::Underrun));
}

#[test]
fn the_first_row_is_at_most_four_ways_of_a_row_away() {
    for (position, taken) in [(0.39, true), (-0.39, true), (0.41, false), (-0.41, false)] {
        let mut plan = plan();
        plan.limits.velocity = Some(100.0);
        assert_eq!(following(plan, &[(0, position, 0.0)]).fed().is_some(), taken, "{position}");
    }
}

#[test]
fn a_row_that_the_task_gave_for_no_stream_or_for_the_one_before_begins_none_later() {
    for before in [true, false] {
        let mut x = following(plan(), &[]);
        if before {
            x.gives(0.01);
        }
        x.ends(Ok(()));
        x.ended();
        // The order of the stream that has ended stands until there is another one.
        if !before {
            x.gives(0.03);
            assert_eq!(x.fed(), None);
        }
        x.push();
        x.begin(Command::Follow);
        assert_eq!(x.fed(), Some(Row::default()), "before its end: {before}");
    }
}

#[test]
fn a_row_is_for_a_send_that_is_due_and_its_number_is_never_given_again() {
    let rows = [(0, 0.01, 0.0), (0, 0.02, 0.0)];
    let mut x = following(plan(), &rows);
    x.slot.due = false;
    assert_eq!(x.fed(), None);
    x.gives(-0.01);
    assert_eq!(x.fed(), None);
    x.slot.due = true;
    assert_eq!(x.fed().map(|row| row.position), Some(-0.01), "that of the task first, when one is due");
    assert_eq!(x.fed().map(|row| row.position), Some(0.01));
    let number = x.controller.machine.input.row.unwrap().number;
    x.ends(Ok(()));
    x.ended();
    x.push();
    x.begin(Command::Home);
    assert_eq!((x.fed(), x.controller.queues.rows.slots()), (None, 1), "no row is for another motion");
    x.ends(Ok(()));
    x.ended();
    x.gives(0.03);
    assert_eq!(x.fed(), None, "nothing is followed");
    x.begin(Command::Follow);
    assert_eq!(x.fed(), Some(Row::default()), "not the one that the task gave for an earlier send");
    assert_eq!(x.controller.machine.input.row.unwrap().number, number + 1);
}

#[test]
fn a_motion_that_failed_may_brake_as_slowly_as_its_stop_and_not_speed_up() {
    for (end, trips) in [(Err(Failure::NotArrived), None), (Ok(()), Some(54))] {
        let mut x = Alone::new(plan()).enabled();
        x.begin(Command::Home);
        x.slot.status.velocity = 200.0;
        x.ends(end);
        let tripped = (1..180).find(|n| {
            x.slot.status.velocity = 200.0 - f64::from(*n);
            x.turn();
            x.stopped().is_some()
        });
        assert_eq!(tripped, trips, "{end:?}");
    }
}

#[test]
fn motion_under_a_command_that_moves_nothing_is_uncommanded() {
    for (command, state, stopped) in [
        (Command::ResetFault, State::OperationEnabled, Some(StopCause::Uncommanded)),
        (Command::Enable, State::OperationEnabled, Some(StopCause::Uncommanded)),
        // Its power comes on, and the motor may give way.
        (Command::Enable, State::SwitchedOn, None),
        (Command::Home, State::OperationEnabled, None),
    ] {
        let mut x = Alone::new(plan()).enabled();
        x.turns(100);
        x.begin(command);
        (x.slot.status.state, x.slot.status.velocity) = (state, 50.0);
        x.controller.duty.set_claim(Claim::Ours);
        x.turns(10);
        assert_eq!(x.stopped(), stopped, "{command:?} {state}");
    }
}

#[test]
fn a_reset_that_waits_for_a_stop_ends_when_the_link_is_lost() {
    let mut x = Alone::new(plan()).enabled();
    x.slot.status.velocity = 50.0;
    x.controller.stop(&cycle(50), Time(20 * MS), StopCause::Overrun);
    let id = x.post(Command::Reset);
    x.turns(3);
    assert_eq!(x.ended(), []);
    x.misses(5);
    assert_eq!(x.ended(), [(id, Outcome::Failed(Failure::NotOnline))]);
}

#[test]
fn an_application_with_the_control_word_loses_it_by_a_restart_or_its_own_silence() {
    let native = || {
        let mut x = Alone::new(plan()).online();
        x.begin(Command::Native(NativeOwner::Application));
        x
    };
    let mut x = native();
    x.slot.status.state = State::SwitchOnDisabled;
    x.turns(9);
    assert_eq!(x.stopped(), None, "the state is its own concern");
    x.slot.notices.restarted = true;
    x.turn();
    assert_eq!(x.stopped(), Some(StopCause::DriveDropped));
    let mut x = native();
    x.controller.stop_if_armed(&cycle(50), Time(50 * MS), StopCause::Heartbeat);
    assert_eq!(x.stopped(), Some(StopCause::Heartbeat));
    // Without power and without a command there is nothing to stop.
    let mut x = Alone::new(plan()).online();
    x.controller.stop_if_armed(&cycle(50), Time(50 * MS), StopCause::Heartbeat);
    assert_eq!(x.stopped(), None);
}

#[test]
fn a_stop_of_the_application_has_its_time_and_then_the_drive_stops() {
    let mut plan = plan();
    plan.stop.timeout = Duration::from_millis(100);
    let mut x = Alone::new(plan).enabled();
    x.slot.status.velocity = 50.0;
    x.post(Command::Stop { deceleration: None });
    x.turns(101);
    assert_eq!(x.stopped(), None);
    x.turn();
    assert_eq!(x.stopped(), Some(StopCause::StopTimeout));
    assert_eq!(x.controller.newest(), Some(Command::QuickStop));
    x.slot.status.velocity = 0.0;
    let standstill = x.controller.plan().stop.standstill_for;
    x.turns(standstill);
    assert_eq!(x.controller.newest(), Some(Command::Disable));
}

#[test]
fn a_ramp_that_the_drive_refuses_becomes_its_quick_stop_and_an_older_refusal_changes_nothing() {
    let mut x = Alone::new(plan()).enabled();
    x.slot.status.velocity = 50.0;
    x.controller.end_with(Err(Failure::NotTaken));
    x.controller.stop(&cycle(50), Time(20 * MS), StopCause::Overrun);
    x.turn();
    assert!(matches!(x.controller.newest(), Some(Command::Stop { .. })));
    x.ends(Err(Failure::NotTaken));
    assert_eq!(x.controller.newest(), Some(Command::QuickStop));
}

#[test]
fn a_link_that_never_came_back_stops_no_axis_once_more() {
    let mut x = Alone::new(plan()).online();
    x.misses(5);
    assert_eq!(x.stopped(), Some(StopCause::LinkLost));
    x.done_at_once(Command::Reset);
    x.turn();
    assert_eq!(x.link(), Link::Qualifying);
    x.miss();
    assert_eq!((x.link(), x.stopped()), (Link::Lost, None));
}

#[test]
fn a_request_that_could_not_be_sent_is_no_miss_only_once_the_bus_ends_the_link() {
    for (expected_silence, ends) in [(false, false), (true, false), (false, true), (true, true)] {
        let mut x = Alone::new(plan()).online();
        x.slot.expected_silence = expected_silence;
        if ends {
            x.controller.shut_down(&cycle(x.index), Time(x.index * MS), false);
        }
        for index in x.index + 1..x.index + 10 {
            x.slot.exchange = Exchange::Unsent;
            x.controller.judge(&cycle(index), Time(index * MS), &mut x.slot);
        }
        let link = if expected_silence && ends { Link::Online } else { Link::Lost };
        assert_eq!(x.link(), link, "expected_silence {expected_silence}, at the end {ends}");
    }
}

#[test]
fn each_change_of_the_drive_is_reported_once() {
    let mut x = Alone::new(plan()).online();
    x.reported();
    let status = &mut x.slot.status;
    (status.state, status.fault, status.warning, status.sto_open) = (State::Fault, 5, 6, true);
    x.turns(3);
    let changes = [EventKind::State(State::Fault), EventKind::Fault(5), EventKind::Warning(6)];
    let sto_open = EventKind::StoClosed(false);
    assert_eq!(x.reported(), [[sto_open].as_slice(), &changes].concat());
}

#[test]
fn a_drive_that_is_found_running_is_stopped_by_its_ramp_however_long_its_link_takes() {
    let running = |x: &mut Alone| {
        let status = &mut x.slot.status;
        (status.state, status.moving, status.velocity) = (State::OperationEnabled, true, 50.0);
    };
    // It runs for longer than a drive has to settle, and is not online in all that time.
    let mut x = Alone::new(plan());
    running(&mut x);
    x.turns(2);
    x.misses(80);
    x.turns(4);
    let feedback = *x.controller.feedback();
    assert_eq!((feedback.link, feedback.stopped), (Link::Qualifying, Some(StopCause::FoundRunning)));
    assert!(matches!(x.controller.newest(), Some(Command::Stop { .. })), "{:?}", x.controller.newest());
    // One that stood when it came online follows something else.
    let mut x = Alone::new(plan()).online();
    running(&mut x);
    x.turns(80);
    assert_eq!(x.stopped(), Some(StopCause::FoundRunning));
    assert_eq!(x.controller.newest(), Some(Command::QuickStop));
}

#[test]
fn native_motion_data_may_lead_out_of_a_quick_stop() {
    let mut x = Alone::new(plan()).enabled();
    x.slot.status.state = State::QuickStopActive;
    x.begin(Command::Native(NativeOwner::Master));
    assert_eq!((x.ended(), x.controller.newest()), (vec![], Some(Command::Native(NativeOwner::Master))));
}

impl Alone {
    /// The in-loop task gives a command.
    fn task(&mut self, id: u64, command: Command) -> Option<CommandId> {
        let id = CommandId::of_task(id);
        let cycle = cycle(self.index);
        let command = QueuedCommand { id, member: 0, command, stream: 0, call: None };
        self.controller.command_from_task(&cycle, cycle.grid, command, |room| room).ok().map(|_| id)
    }
}

#[test]
fn a_command_of_the_task_that_a_stop_overtakes_has_its_end_and_room_for_it_unless_it_is_a_stop() {
    let mut x = Alone::new(plan()).enabled();
    let [home, stop] = [(1, Command::Home), (2, Command::QuickStop)].map(|(id, it)| x.task(id, it).unwrap());
    assert_eq!(x.ended(), [(home.0, Outcome::Aborted(Abort::Replaced(stop)))]);
    x.controller.stop(&cycle(50), Time(50 * MS), StopCause::Overrun);
    assert_eq!(x.ended(), [(stop.0, Outcome::Aborted(Abort::Stopped(StopCause::Overrun)))]);
    let mut x = Alone::new(plan()).enabled();
    while x.controller.queues.events.slots() > x.controller.queues.room_for_ends {
        x.controller.emit(&cycle(50), Time(50 * MS), EventKind::Restarted);
    }
    assert_eq!(x.task(1, Command::Home), None);
    assert!(x.task(1, Command::QuickStop).is_some());
}

#[test]
fn power_that_no_command_has_switched_on_is_watched_from_its_first_report() {
    let mut x = Alone::new(plan()).enabled();
    x.done(Command::Disable, State::ReadyToSwitchOn);
    x.slot.status.velocity = 50.0;
    x.turns(9);
    assert_eq!(x.stopped(), None, "pushed by hand");
    x.slot.status.state = State::OperationEnabled;
    x.slot.status.suspect = true;
    x.turns(9);
    assert_eq!(x.stopped(), None, "it may be an old report");
    x.slot.status.suspect = false;
    x.turns(2);
    assert_eq!(x.stopped(), None);
    x.turn();
    assert_eq!(x.stopped(), Some(StopCause::Uncommanded));
}

#[test]
fn a_command_to_a_member_alone_stops_its_group_only_if_it_may_begin() {
    for (distance, stop) in [(200.0, None), (20.0, Some(StopCause::GroupFailed))] {
        let mut x = ranged();
        x.id += 1;
        let id = CommandId(x.id);
        let call = Some(GroupCall { parts: 1, together: 2, lead: 0, id });
        let native = Command::Native(NativeOwner::Master);
        x.commands.push(QueuedCommand { id, member: 0, command: native, stream: 0, call }).unwrap();
        x.bells.bell(0).ring();
        x.turn();
        x.controller.take_waiting(&cycle(x.index), Time(x.index * MS), false);
        let target = Target::Relative(distance);
        x.begin(Command::Move(Move { target, profile: x.controller.plan().profile }));
        assert_eq!(x.stopped(), stop, "{distance} mm");
    }
}
