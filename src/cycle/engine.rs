//! One cycle after the other: send, receive, evaluate, commands, prepare, publish.
//!
//! The engine is generic over its clock, and its buses bring their carriers, so that the same code runs on a pinned
//! SCHED_FIFO thread and in virtual time.

mod panics;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use crossbeam::utils::CachePadded;
use rtrb::Producer;

pub use self::panics::LoopPanic;
use self::panics::Panics;
use super::grid::Grid;
use super::heartbeat::Heartbeat;
use super::plan::{CyclePlan, Guard, Overrun};
use super::record::{CycleRecord, Look, Record, Reply, SkippedRecord, Stage, short};
use super::reference::Reference;
use super::skips::Skips;
use super::status::{AxisInfo, DriveNumbers, Numbers, Status};
use super::task::{Axes, Task};
use super::window::{OpenBus, Window};
use crate::axis::cell::Writer;
use crate::axis::doorbell::Bells;
use crate::axis::{Link, Pulse, StopCause};
use crate::bus::{Cycle, Slot};
use crate::drive::controller::{DriveController, take_calls, take_commands, take_rows};
use crate::drive::groups::GroupSync;
use crate::rt::{Clock, GuardTuner, Regions};
use crate::time::{MS, Time, nanos};

/// Requests to the loop from other threads.
#[derive(Clone, Debug, Default)]
pub struct Control(Arc<CachePadded<AtomicU8>>);

const RUN: u8 = 0;
const STOP: u8 = 1;
const HURRY: u8 = 2;

impl Control {
    /// Requests the orderly end: all axes ramp down and are powered off. A second request shortens the waits.
    pub fn stop(&self) {
        let _ = self
            .0
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |requested| Some((requested + 1).min(HURRY)));
    }

    /// Whether the end was requested.
    pub fn is_stopping(&self) -> bool {
        self.0.load(Ordering::Relaxed) != RUN
    }

    fn requested(&self) -> u8 {
        self.0.load(Ordering::Relaxed)
    }
}

/// What the loop itself shares with other threads.
#[derive(Debug)]
pub struct Channels {
    /// Their requests.
    pub control: Control,
    /// The application's sign of life.
    pub pulse: Pulse,
    /// The axes that it has given something.
    pub bells: Bells,
    /// Records to the telemetry thread.
    pub records: Producer<Record>,
    /// The numbers of the loop, newest only.
    pub status: Writer<Status>,
}

/// One axis, as the loop takes it.
#[derive(Debug)]
pub struct AxisEntry {
    /// The loop's side of its drive.
    pub controller: DriveController,
    /// The rest.
    pub outlet: AxisOutlet,
}

/// What the loop keeps of an axis apart from what it touches in every cycle.
#[derive(Debug)]
pub struct AxisOutlet {
    /// What stays the same of it.
    pub info: AxisInfo,
    /// Its numbers.
    pub numbers: Writer<DriveNumbers>,
}

impl Channels {
    /// Sends a record to the telemetry, or counts it as lost.
    fn record(&mut self, record: Record, lost: &mut u64) {
        *lost += u64::from(self.records.push(record).is_err());
    }
}

/// The loop.
pub struct Engine<C> {
    clock: C,
    plan: CyclePlan,
    deadline_ns: u64,
    late_ns: u64,
    numbers_every: u64,
    longest_end_ns: u64,
    grid: Grid,
    reference: Option<Reference>,
    guard: GuardTuner,
    window: Window,
    buses: Vec<OpenBus>,
    /// The buses in the order of their sends.
    send_order: Box<[usize]>,
    slots: Vec<Slot>,
    controllers: Vec<DriveController>,
    axes: Vec<AxisOutlet>,
    task: Option<Task>,
    task_id: u64,
    groups: GroupSync,
    heartbeat: Heartbeat,
    channels: Channels,
    status: Status,
    /// More of it than its counts has changed since it was published.
    changed: bool,
    /// A drive has reported monitored variables in this cycle.
    shows: bool,
    /// The loop was awake before the grid point of this slot.
    spun: bool,
    /// The previous executed cycle was late.
    was_late: bool,
    /// How late the previous executed cycle began.
    wake_before_ns: Option<u64>,
    /// Slots passed over since the last executed one, and among the last ones.
    skipped_in_a_row: u64,
    skips: Skips,
    /// For how long the computer was suspended so far, ns.
    suspended_ns: u64,
    /// The shutdown: when it began, and how many times it was requested.
    ending: Option<(Time, u8)>,
    /// When the orderly end of the buses began.
    buses_ending: Option<Time>,
    buses_down: bool,
    panics: Panics,
}

impl<C> std::fmt::Debug for Engine<C> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Engine")
            .field("grid", &self.grid)
            .field("status", &self.status)
            .finish_non_exhaustive()
    }
}

/// Whether the loop continues.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// It continues.
    Continue,
    /// The shutdown is complete.
    End,
}

/// What is left to be written of what is desired, once each axis was looked at alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Left {
    Nothing,
    /// That of the axes that follow rows.
    Rows,
    /// Something has begun or stopped: all of it is written again.
    All,
}

/// Wake-ups measured before the first cycle to choose the guard.
const CALIBRATION_SLEEPS: u32 = 200;

/// The numbers of drives and buses are published once in so many executed cycles, the drives in turns: nobody reads
/// them faster. With long periods the interval is a fixed time.
const NUMBERS_EVERY: u64 = 64;
const NUMBERS_EVERY_NS: u64 = 100 * MS;

/// The time limit of a shutdown beyond the time-outs of its axes.
const END_MARGIN_NS: u64 = 1_000 * MS;

/// The time limit of the orderly end of the buses, ns. Their own are shorter: a state of an EtherCAT segment takes 5 s
/// at most (ETG.1020).
const BUSES_END_NS: u64 = 10_000 * MS;

/// A computer that was suspended for longer has left its drives alone, ns.
const SUSPENDED_NS: u64 = MS;

/// A frame that serves a whole bus leaves first: it is under way while the requests of the others are sent. Otherwise
/// the order is that of the configuration.
fn send_order(are_one_frame: impl Iterator<Item = bool>) -> Box<[usize]> {
    let mut order: Vec<(bool, usize)> = are_one_frame.map(|is_one_frame| !is_one_frame).zip(0..).collect();
    order.sort();
    order.into_iter().map(|(_, place)| place).collect()
}

impl<C: Clock> Engine<C> {
    /// An engine over axes, in slot order, and their open buses, one of which leads the grid if the plan names it.
    pub fn new(
        clock: C,
        plan: CyclePlan,
        axes: Vec<AxisEntry>,
        mut buses: Vec<OpenBus>,
        task: Option<Task>,
        channels: Channels,
    ) -> Engine<C> {
        let (controllers, axes): (Vec<_>, Vec<_>) =
            axes.into_iter().map(|AxisEntry { controller, outlet }| (controller, outlet)).unzip();
        let window = Window::new(plan.wait, &buses);
        // The ramp, the quick stop and power off have a time-out each, and a hold may have to be left first.
        let stops = controllers
            .iter()
            .map(|axis: &DriveController| nanos(axis.plan().stop.timeout))
            .max()
            .unwrap_or(0);
        let leads = |open: &OpenBus| plan.reference.as_deref() == Some(open.bus.name());
        let reference = buses.iter().position(leads).map(|place| Reference::new(place, plan.period_ns));
        if let Some(reference) = &reference {
            buses[reference.bus()].bus.lead();
        }
        let panics = Panics::new(buses.len(), controllers.len());
        let send_order = send_order(buses.iter().map(|open| open.bus.is_one_frame()));
        Engine {
            longest_end_ns: stops.saturating_mul(4).saturating_add(END_MARGIN_NS),
            deadline_ns: plan.deadline_ns(),
            late_ns: plan.late_ns(),
            numbers_every: (NUMBERS_EVERY_NS / plan.period_ns.max(1)).clamp(1, NUMBERS_EVERY),
            grid: Grid::new(Time(0), plan.period_ns),
            guard: match plan.guard {
                Guard::Off => GuardTuner::fixed(0),
                Guard::Fixed(ns) => GuardTuner::fixed(ns),
                Guard::Auto => GuardTuner::auto(plan.period_ns),
            },
            window,
            buses,
            send_order,
            slots: vec![Slot::default(); controllers.len()],
            axes,
            task,
            task_id: 1,
            groups: GroupSync::new(controllers.len()),
            heartbeat: Heartbeat::new(channels.pulse.clone(), plan.heartbeat_ns, plan.period_ns),
            controllers,
            channels,
            status: Status { reference: reference.as_ref().map(Reference::status), ..Status::default() },
            changed: true,
            reference,
            shows: false,
            spun: false,
            was_late: false,
            wake_before_ns: None,
            skipped_in_a_row: 0,
            skips: Skips::new(plan.max_skip_rate),
            suspended_ns: 0,
            ending: None,
            buses_ending: None,
            buses_down: false,
            panics,
            clock,
            plan,
        }
    }

    /// Adds the memory that the loop touches besides its rings and the engine itself, to be locked. Memory captured
    /// by the in-loop task is for its owner to lock.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.slots);
        regions.add(&*self.controllers);
        self.groups.memory(regions);
        self.heartbeat.memory(regions);
        regions.add(&*self.channels.control.0);
        self.channels.bells.memory(regions);
        regions.add(&*self.buses);
        regions.add(&*self.send_order);
        self.window.memory(regions);
        self.channels.status.memory(regions);
        regions.add(&*self.axes);
        self.axes.iter().for_each(|axis| axis.numbers.memory(regions));
        self.controllers.iter().for_each(|controller| controller.memory(regions));
        self.buses.iter().for_each(|open| open.memory(regions));
    }

    /// Calibrates the guard, then starts the grid: the first slot is two periods from now.
    pub fn begin(&mut self) {
        self.guarded(|engine| {
            engine.guard.calibrate(&mut engine.clock, CALIBRATION_SLEEPS);
            engine.suspended_ns = engine.clock.suspended_ns();
            let now = engine.clock.now();
            engine.grid = Grid::new(now + 2 * engine.plan.period_ns, engine.plan.period_ns);
            let cycle = engine.cycle_at(engine.grid.index(), engine.grid.at());
            engine.arm(&cycle, now);
            Flow::Continue
        });
    }

    /// Runs until the shutdown is complete.
    pub fn run(&mut self) {
        self.begin();
        while self.step() == Flow::Continue {}
    }

    /// One slot of the grid: waits for it and executes it, or passes over slots that came too late. After a panic it
    /// only stops.
    pub fn step(&mut self) -> Flow {
        if self.panics.any() { self.stop_slot() } else { self.guarded(Engine::turn) }
    }

    fn turn(&mut self) -> Flow {
        self.panics.stage = None;
        let guard_ns = self.guard.guard_ns();
        self.clock.sleep_until(self.grid.at() - guard_ns);
        let mut now = self.clock.now();
        self.guard.observe(now.since(self.grid.at() - guard_ns));
        self.spun = now < self.grid.at();
        // The final spin, bounded by the guard.
        while now < self.grid.at() {
            self.clock.spin();
            now = self.clock.now();
        }
        // A slot may begin late by half of its receive window. Later, the drives would be charged for our own
        // delay.
        let late = self.grid.passed(now, self.deadline_ns / 2);
        if late > 0 {
            self.pass_over(now, late, true);
            return Flow::Continue;
        }
        let cycle = self.cycle_at(self.grid.index(), self.grid.at());
        if self.was_suspended() {
            self.stop_axes(&cycle, now, StopCause::Suspended, |_| true);
            // The requests were built before.
            self.arm(&cycle, now);
        }
        let (flow, now) = self.execute(&cycle, now);

        self.grid.advance(1);
        let passed = self.grid.passed(now, 0);
        if passed > 0 {
            self.pass_over(now, passed, false);
        }
        flow
    }

    /// Whether the computer was suspended since the last slot: its clock stood still, the drives did not.
    fn was_suspended(&mut self) -> bool {
        let before_ns = self.suspended_ns;
        self.suspended_ns = before_ns.max(self.clock.suspended_ns());
        self.suspended_ns - before_ns > SUSPENDED_NS
    }

    fn cycle_at(&self, index: u64, grid: Time) -> Cycle {
        Cycle { index, grid, period_ns: self.plan.period_ns, deadline: grid + self.deadline_ns }
    }

    /// Executes a cycle; returns when that was done.
    fn execute(&mut self, cycle: &Cycle, woke: Time) -> (Flow, Time) {
        let wake_ns = woke.since(cycle.grid);
        let jitter_ns = self.wake_before_ns.replace(wake_ns).map_or(0, |before| wake_ns.abs_diff(before));

        // 1 send
        self.panics.stage = Some(Stage::Send);
        for place in &self.send_order {
            self.buses[*place].work(&mut self.slots, |bus, slots| bus.send(cycle, slots));
        }
        self.status.executed += 1;
        self.skipped_in_a_row = 0;
        self.skips.executed();
        let sent = self.clock.now();

        // 2 receive
        self.panics.stage = Some(Stage::Receive);
        self.window.run(&mut self.clock, cycle, sent, &mut self.buses, &mut self.slots);
        let received = self.clock.now();

        // 3 evaluate, what was sent included
        self.panics.stage = Some(Stage::Evaluate);
        let missed = self.evaluate(cycle, received);
        self.steer(cycle);
        let evaluated = self.clock.now();

        // 4 commands, and what they desire of the drives. The task comes first: its commands leave with the next send.
        self.panics.stage = Some(Stage::Commands);
        let next = self.cycle_at(cycle.index + 1, self.grid.next_at());
        let ended = self.end(cycle, received);
        let left = match self.ending {
            Some(_) => Left::All,
            None => {
                self.run_task(cycle, received);
                self.command(cycle, &next, received)
            }
        };
        let commanded = self.clock.now();

        // 5 prepare
        self.panics.stage = Some(Stage::Prepare);
        match left {
            Left::Nothing => {}
            Left::Rows => self.feed(&next, received, false),
            Left::All => self.propose(&next, received),
        }
        self.build(&next);
        let prepared = self.clock.now();

        // 6 publish
        self.panics.stage = Some(Stage::Publish);
        self.publish();
        // What follows is the same in each cycle: the cycle ends here.
        let published = self.clock.now();
        let ends = [woke, sent, received, evaluated, commanded, prepared, published];
        let stages_ns: [u64; 6] = std::array::from_fn(|stage| ends[stage + 1].since(ends[stage]));
        let mut changed = self.status.wake_max.see(wake_ns, cycle.index);
        changed |= self.status.jitter_max.see(jitter_ns, cycle.index);
        for (peak, ns) in self.status.stage_max.iter_mut().zip(stages_ns) {
            changed |= peak.see(ns, cycle.index);
        }
        self.changed |= changed;
        let record = CycleRecord {
            index: cycle.index,
            grid: cycle.grid,
            wake_ns: short(wake_ns),
            spun: self.spun,
            jitter_ns: short(jitter_ns),
            stages_ns: stages_ns.map(short),
            missed,
            look: None,
        };
        self.account(record);
        (if ended { Flow::End } else { Flow::Continue }, published)
    }

    /// Reports an executed cycle. If it was late, it also reads, with a system call, what the kernel has counted
    /// against this thread.
    fn account(&mut self, mut record: CycleRecord) {
        self.was_late = record.lateness(self.late_ns, self.deadline_ns).is_some();
        if self.was_late {
            self.status.late += 1;
            record.look = Some(self.look());
        }
        self.record(Record::Cycle(record));
    }

    fn look(&mut self) -> Look {
        let usage = self.clock.usage();
        Look { faults: usage.page_faults() as u32, switches: usage.involuntary_switches as u32 }
    }

    /// Sets the next slot by the clock that leads.
    fn steer(&mut self, cycle: &Cycle) {
        let Some(reference) = &mut self.reference else { return };
        let error_ns = self.buses[reference.bus()].work(&mut self.slots, |bus, _| bus.phase_error());
        let record = reference.take(cycle.index, error_ns);
        self.status.reference = Some(reference.status());
        self.grid.steer(record.step_ns.into());
        self.record(Record::Reference(record));
    }

    /// Evaluates all exchanges. Returns how many drives that were online have not answered.
    fn evaluate(&mut self, cycle: &Cycle, now: Time) -> u16 {
        // What was posted before a stop ends with it.
        take_commands(&mut self.controllers, &mut self.channels.bells);
        let (mut missed, mut stopped) = (0_u16, false);
        let (mut operational, mut online, mut unanswered) = (0, 0, 0);
        self.shows = false;
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            let was_online = controller.feedback().link == Link::Online;
            let reply = controller.evaluate(cycle, now, slot);
            missed += u16::from(was_online && reply == Reply::Missed);
            unanswered += u64::from(matches!(reply, Reply::Missed | Reply::Unsent));
            stopped |= controller.just_stopped();
            self.shows |= controller.shows();
            let feedback = controller.feedback();
            operational += u32::from(feedback.is_operational());
            online += u32::from(feedback.link == Link::Online);
        }
        self.status.missed += unanswered;
        (self.status.operational, self.status.online) = (operational, online);
        for bus in &self.buses {
            if bus.bus.helper_ended() {
                for controller in &mut self.controllers[bus.first..bus.end] {
                    controller.stop(cycle, now, StopCause::LinkThread);
                }
                stopped = true;
            }
        }
        if self.heartbeat.is_silent(cycle) {
            for controller in &mut self.controllers {
                controller.stop_if_armed(cycle, now, StopCause::Heartbeat);
            }
            stopped = true;
        }
        self.groups.judge(&mut self.controllers);
        while let Some(lead) = self.groups.take_full() {
            for controller in &mut self.controllers {
                if controller.moves_in_group().is_some_and(|call| call.lead as usize == lead) {
                    controller.stop(cycle, now, StopCause::GroupLink);
                }
            }
            stopped = true;
        }
        if stopped {
            self.take_groups_along(cycle, now);
        }
        missed
    }

    /// Begins what may begin at each axis, and writes at once what is desired of it with the send of `next`. Returns
    /// what is left of that: rows come to all members of a group together, and what begins or stops at one axis may
    /// begin or stop others before it.
    fn command(&mut self, cycle: &Cycle, next: &Cycle, now: Time) -> Left {
        take_calls(&mut self.controllers, &mut self.channels.bells);
        let (mut calls, mut stops, mut rows) = (false, false, false);
        let with_task = self.task.is_some();
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            controller.exchange(cycle, now, slot);
            slot.due = controller.is_due(next.index);
            slot.guarded = controller.is_guarded();
            calls |= controller.waiting().is_some();
            stops |= controller.just_stopped();
            rows |= if with_task { controller.takes_rows() } else { controller.follows_rows() };
            if !controller.follows_rows() {
                controller.propose(next, slot);
            }
        }
        if calls {
            self.groups.open(cycle, now, &mut self.controllers);
        }
        match (calls || stops, rows) {
            (true, _) => Left::All,
            (false, true) => Left::Rows,
            (false, false) => Left::Nothing,
        }
    }

    /// An axis that was stopped stops its stop group.
    fn take_groups_along(&mut self, cycle: &Cycle, now: Time) {
        while let Some(group) = self.controllers.iter_mut().find_map(DriveController::take_group_stop) {
            self.stop_axes(cycle, now, StopCause::Group, |other| other == Some(group));
        }
    }

    /// Stops every axis whose stop group is `chosen`.
    fn stop_axes(
        &mut self,
        cycle: &Cycle,
        now: Time,
        cause: StopCause,
        chosen: impl Fn(Option<u16>) -> bool,
    ) {
        // What was posted before the stop ends with it.
        take_commands(&mut self.controllers, &mut self.channels.bells);
        for controller in &mut self.controllers {
            if chosen(controller.plan().stop.group) {
                controller.stop(cycle, now, cause);
                controller.take_group_stop();
            }
        }
    }

    /// The orderly end, once requested. True when it is complete.
    fn end(&mut self, cycle: &Cycle, now: Time) -> bool {
        let requested = self.channels.control.requested();
        if requested == RUN {
            return false;
        }
        let (since, before) = *self.ending.get_or_insert((now, STOP));
        let hurry = requested == HURRY && before == STOP;
        self.ending = Some((since, requested));
        let mut down = true;
        for controller in &mut self.controllers {
            down &= controller.shut_down(cycle, now, hurry);
        }
        if down || now.since(since) > self.longest_end_ns {
            let begun = *self.buses_ending.get_or_insert(now);
            let mut done = true;
            for open in &mut self.buses {
                done &= open.work(&mut self.slots, |bus, slots| bus.shut_down(cycle, slots));
            }
            self.status.cut_off = !done && now.since(begun) > BUSES_END_NS;
            self.buses_down = done || self.status.cut_off;
            self.changed = true;
        }
        self.buses_down
    }

    fn run_task(&mut self, cycle: &Cycle, before: Time) {
        let Some(task) = &mut self.task else { return };
        let mut axes = Axes::new(&mut self.controllers, &mut self.task_id, cycle, before);
        let result = catch_unwind(AssertUnwindSafe(|| task(cycle, &mut axes)));
        let panicked = result.is_err();
        // Neither the panic's payload nor the task is dropped: this thread must not free memory.
        std::mem::forget(result);
        let over = match self.plan.task_budget_ns {
            Some(budget) => self.clock.now().since(before) > budget,
            None => false,
        };
        if panicked {
            std::mem::forget(self.task.take());
        }
        if panicked || over {
            self.stop_axes(cycle, before, StopCause::Task, |_| true);
        }
        // The task may have run for long.
        take_commands(&mut self.controllers, &mut self.channels.bells);
    }

    /// Prepares the send of `next`: which drives are due, their rows, and their bytes.
    fn arm(&mut self, next: &Cycle, now: Time) {
        self.propose(next, now);
        self.build(next);
    }

    /// Writes what is desired of each drive with the send of `next`. It may be called again for the same send.
    #[inline(never)]
    fn propose(&mut self, next: &Cycle, now: Time) {
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            slot.due = controller.is_due(next.index);
            slot.guarded = controller.is_guarded();
        }
        self.feed(next, now, true);
    }

    /// Gives the axes that follow their rows, and writes what is desired of them, or of `all`.
    #[inline(never)]
    fn feed(&mut self, next: &Cycle, now: Time, all: bool) {
        take_rows(&mut self.controllers, &self.slots);
        let mut all = all;
        for (controller, slot) in self.controllers.iter_mut().zip(&self.slots) {
            controller.feed(next, now, slot);
            all |= controller.just_stopped();
        }
        if all {
            // What stopped since the evaluation leaves with the same send.
            self.take_groups_along(next, now);
        }
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            if all || controller.follows_rows() {
                controller.propose(next, slot);
            }
        }
    }

    fn build(&mut self, next: &Cycle) {
        for open in &mut self.buses {
            open.work(&mut self.slots, |bus, slots| bus.prepare(next, slots));
        }
    }

    /// Passes over slots that cannot be executed any more: the loop woke too late for them, or the previous cycle
    /// took too long.
    fn pass_over(&mut self, now: Time, count: u64, woke_late: bool) {
        // A reply owed to a skipped slot comes with the next executed one, at the earliest.
        let next_ns = count.saturating_mul(self.plan.period_ns);
        let (first, given_up_ns) = (self.grid.index(), now.since(self.grid.at()));
        let late_ns = given_up_ns.max(next_ns);
        self.status.overruns += 1;
        self.status.skipped += count;
        self.skipped_in_a_row += count;
        let too_many = self.skips.skipped(count);
        self.status.longest_skip = self.status.longest_skip.max(self.skipped_in_a_row);
        self.status.wake_max.see(late_ns, first);
        self.changed = true;
        // An overrun is late, but the previous cycle may have been counted for it already.
        let late = woke_late || !self.was_late;
        self.status.late += u64::from(late);
        let look = late.then(|| self.look());
        let grid = self.grid.at();
        self.record(Record::Skipped(SkippedRecord {
            first,
            grid,
            count,
            late_ns,
            given_up_ns,
            woke_late,
            late,
            spun: self.spun,
            look,
        }));
        self.grid.advance(count);
        self.status.planned = self.grid.planned();
        self.publish_status();
        let cycle = self.cycle_at(self.grid.index(), self.grid.at());
        let stop = match self.plan.overrun {
            Overrun::Stop => true,
            Overrun::Skip { max_skip } => self.skipped_in_a_row > max_skip || too_many,
        };
        if stop {
            self.stop_axes(&cycle, now, StopCause::Overrun, |_| true);
        }
        // The requests were built for another slot: other drives may be due, and a stop may have come.
        self.arm(&cycle, now);
    }

    fn publish(&mut self) {
        let turn = self.status.executed;
        // The records are built in the ring, if each drive has one and there is room for all of them.
        let axes = self.controllers.len();
        let room = if self.shows { None } else { self.channels.records.write_chunk_uninit(axes).ok() };
        let lost = match room {
            Some(room) => {
                let mut lost = 0;
                room.fill_from_iter(self.controllers.iter_mut().enumerate().map(|(axis, controller)| {
                    let record = controller.publish(axis as u16);
                    lost += controller.lost();
                    Record::Drive(record)
                }));
                lost
            }
            None => self.publish_each(),
        };
        // Those whose turn it is.
        let (axes, every) = (self.axes.len(), self.numbers_every);
        let first = (every - turn % every) % every;
        for axis in (first as usize..axes).step_by(every as usize) {
            self.axes[axis].numbers.write(&self.controllers[axis].numbers(&self.slots[axis]));
        }
        if first == 0 {
            self.buses.iter_mut().for_each(OpenBus::publish);
        }
        self.status.planned = self.grid.planned() + 1;
        self.status.lost_events = lost;
        self.publish_status();
    }

    /// Publishes one drive after the other, with the monitored variables that it has shown. Returns how many events and
    /// samples were lost so far.
    #[inline(never)]
    fn publish_each(&mut self) -> u64 {
        let mut lost = 0;
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            let lost_records = &mut self.status.lost_records;
            self.channels.record(Record::Drive(controller.publish(axis as u16)), lost_records);
            if let Some(record) = controller.take_shown(axis as u16) {
                self.channels.record(Record::Monitor(record), lost_records);
            }
            lost += controller.lost();
        }
        lost
    }

    /// Publishes the numbers of the loop; what changes only now and then, only if it has changed.
    fn publish_status(&mut self) {
        match std::mem::take(&mut self.changed) || self.status.reference.is_some() {
            true => self.channels.status.write(&self.status),
            false => self.channels.status.write_words(self.status.counts().into_iter()),
        }
    }

    fn record(&mut self, record: Record) {
        self.channels.record(record, &mut self.status.lost_records);
    }

    /// The clock, for a caller that steps the engine by hand.
    pub fn clock(&mut self) -> &mut C {
        &mut self.clock
    }

    /// The numbers of the loop so far.
    pub fn status(&self) -> &Status {
        &self.status
    }

    /// Ends the run and returns its exact numbers.
    pub fn finish(mut self) -> Numbers {
        let panic = self.loop_panic();
        let status = Status { planned: self.grid.planned(), ..self.status };
        let drives = (self.axes.iter().zip(&self.controllers).zip(&self.slots))
            .map(|((axis, controller), slot)| {
                axis.info.with(*controller.feedback(), controller.numbers(slot))
            })
            .collect();
        let buses = self.buses.iter().map(|open| open.info.with(open.bus.unmatched())).collect();
        let clocks = self.buses.iter().map(|open| open.bus.clock()).collect();
        let devices = self.buses.iter().flat_map(|open| open.info.devices()).collect();
        Numbers {
            status,
            drives,
            buses,
            clocks,
            devices,
            panic,
            page_faults: None,
            involuntary_switches: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_frame_for_a_whole_bus_leaves_before_the_requests_of_the_others() {
        assert_eq!(*send_order([false, true, false, true].into_iter()), [1, 3, 0, 2]);
        assert_eq!(*send_order([false; 3].into_iter()), [0, 1, 2]);
    }
}
