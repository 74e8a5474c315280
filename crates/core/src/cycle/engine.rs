//! One cycle after the other: send, receive, evaluate, commands, prepare, publish.
//!
//! | file | what |
//! |---|---|
//! | `engine` | the grid: which slot is executed, and its stages in their order |
//! | `stages` | evaluate, commands, prepare |
//! | `report` | what a cycle publishes |
//! | `native` | native process data for a recording |
//! | `panics` | what follows from a panic on the loop's thread, and when the wires were taken from it |
//!
//! The engine is generic over its clock, and its buses bring their carriers, so that the same code runs on a pinned
//! SCHED_FIFO thread and in virtual time.

mod native;
mod panics;
mod report;
mod stages;

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering, fence};

use crossbeam::utils::CachePadded;

use self::native::{Moment, Natives};
pub use self::panics::LoopPanic;
use self::panics::Panics;
use super::grid::Grid;
use super::heartbeat::Heartbeat;
use super::plan::{CyclePlan, Guard, Overrun};
use super::record::{CycleRecord, Record, SkippedRecord, Stage, short};
use super::reference::Reference;
use super::ring::RecordWriter;
use super::skips::Skips;
use super::status::{AxisInfo, DriveNumbers, Numbers, Status};
use super::task::Task;
use super::window::{Gate, OpenBus, Window};
use crate::axis::cell::Writer;
use crate::axis::doorbell::Bells;
use crate::axis::{Pulse, StopCause};
use crate::bus::{BusNumbers, Cycle, Slot};
use crate::drive::controller::DriveController;
use crate::drive::groups::{GroupSync, StopGroups};
use crate::inputs::InputLog;
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

    /// Requests nothing any more. False if others have handles of it, and nothing is changed.
    pub fn renew(&self) -> bool {
        let free = Arc::strong_count(&self.0) == 1;
        if free {
            // Behind what the last of the others has requested.
            fence(Ordering::Acquire);
            self.0.store(RUN, Ordering::Relaxed);
        }
        free
    }

    fn requested(&self) -> u8 {
        self.0.load(Ordering::Relaxed)
    }
}

/// The state that the loop itself shares with other threads.
#[derive(Debug)]
pub struct Channels {
    /// Their requests.
    pub control: Control,
    /// The application's sign of life.
    pub pulse: Pulse,
    /// The axes that it has given something.
    pub bells: Bells,
    /// Records to the telemetry thread.
    pub records: RecordWriter,
    /// The numbers of the loop, newest only.
    pub status: Writer<Status>,
    /// All that it takes from outside.
    pub log: InputLog,
    /// Whether the wires are still its own.
    pub gate: Gate,
}

impl Channels {
    /// The requests of the control.
    fn requested(&self) -> u8 {
        self.log.value(RUN.into(), self.control.requested().into()) as u8
    }
}

/// One axis, as the loop takes it.
#[derive(Debug)]
pub struct AxisEntry {
    /// The loop's side of its drive.
    pub controller: DriveController,
    /// The rest.
    pub outlet: AxisOutlet,
}

/// The state of an axis that the loop does not touch in every cycle.
#[derive(Debug)]
pub struct AxisOutlet {
    /// The constants of the axis.
    pub info: AxisInfo,
    /// The numbers.
    pub numbers: Writer<DriveNumbers>,
}

/// The loop.
pub struct Engine<C> {
    clock: C,
    plan: CyclePlan,
    deadline_ns: u64,
    late_ns: u64,
    numbers_every: usize,
    /// The axis whose numbers were published last.
    numbers_turn: usize,
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
    stop_groups: StopGroups,
    heartbeat: Heartbeat,
    channels: Channels,
    status: Status,
    natives: Natives,
    /// More of it than its counts has changed since it was published. It saves 360 instructions a cycle.
    changed: bool,
    /// A drive has reported monitored variables in this cycle.
    shows: bool,
    /// No axis has anything to begin or to plan in this cycle: each was armed as it was evaluated, and nothing has
    /// stopped one since, nor has the task run. It saves a pass over all of them: 14 instructions and two to six misses
    /// of the first-level cache a drive.
    armed: bool,
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

/// The part of the desired state that is left to be written, once each axis was looked at alone.
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
        let leads = |open: &OpenBus| plan.reference.as_ref() == Some(&open.info.name);
        let reference = buses.iter().position(leads).map(|place| Reference::new(place, plan.period_ns));
        if let Some(reference) = &reference {
            buses[reference.bus()].bus.lead();
        }
        let send_order = send_order(buses.iter().map(|open| open.is_one_frame));
        Engine {
            longest_end_ns: stops.saturating_mul(4).saturating_add(END_MARGIN_NS),
            deadline_ns: plan.deadline_ns(),
            late_ns: plan.late_ns(),
            numbers_every: (NUMBERS_EVERY_NS / plan.period_ns.max(1)).clamp(1, NUMBERS_EVERY) as usize,
            numbers_turn: 0,
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
            stop_groups: StopGroups::new(&controllers),
            heartbeat: Heartbeat::new(
                channels.pulse.clone(),
                channels.log.source(),
                plan.heartbeat_ns,
                plan.period_ns,
            ),
            controllers,
            channels,
            status: Status { reference: reference.as_ref().map(Reference::status), ..Status::default() },
            natives: Natives::default(),
            changed: true,
            reference,
            shows: false,
            armed: false,
            spun: false,
            was_late: false,
            wake_before_ns: None,
            skipped_in_a_row: 0,
            skips: Skips::new(plan.max_skip_rate),
            suspended_ns: 0,
            ending: None,
            buses_ending: None,
            buses_down: false,
            panics: Panics::default(),
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
        self.stop_groups.memory(regions);
        self.heartbeat.memory(regions);
        regions.add(&*self.channels.control.0);
        self.channels.bells.memory(regions);
        regions.add(&*self.buses);
        regions.add(&*self.send_order);
        self.natives.memory(regions);
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
        self.panics.slot = self.grid.index();
        self.channels.log.cycle(self.panics.slot);
        self.channels.gate.wires().turn();
        let flow = if self.panics.any() { self.stop_slot() } else { self.guarded(Engine::turn) };
        let is_taken = match flow {
            Flow::Continue => self.channels.gate.is_closed(),
            // Whoever finds the wires without an end stops the drives that it leaves behind.
            Flow::End => !self.panics.leaves_drives() && !self.channels.gate.end(),
        };
        let flow = if is_taken { self.give_way() } else { flow };
        self.channels.log.whole();
        flow
    }

    fn turn(&mut self) -> Flow {
        self.panics.stage = None;
        let guard_ns = self.guard.guard_ns();
        self.clock.sleep_until(self.grid.at() - guard_ns);
        let mut now = self.clock.now();
        self.guard.observe(now.since(self.grid.at() - guard_ns));
        self.spun = now < self.grid.at();
        // The final spin, bounded by the guard.
        if self.spun {
            now = self.clock.spin_until(self.grid.at());
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
            self.stop_axes(|axis| axis.stop(&cycle, now, StopCause::Suspended));
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
            self.buses[*place].exchange(&mut self.slots, |bus, slots| bus.send(cycle, slots));
        }
        self.status.executed += 1;
        self.skipped_in_a_row = 0;
        self.skips.executed();
        if !self.natives.are_none() {
            self.report_native(cycle, Moment::Sent);
        }
        let sent = self.clock.now();

        // 2 receive
        self.panics.stage = Some(Stage::Receive);
        if !self.window.run(&mut self.clock, cycle, sent, &mut self.buses, &mut self.slots) {
            // Of a cycle without replies nothing is concluded: the step ends the loop.
            return (Flow::Continue, sent);
        }
        let received = self.clock.now();

        // 3 evaluate, what was sent included
        self.panics.stage = Some(Stage::Evaluate);
        if !self.natives.are_none() {
            self.report_native(cycle, Moment::Received);
        }
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
            self.stop_axes(|axis| axis.stop(&cycle, now, StopCause::Overrun));
        }
        // The requests were built for another slot: other drives may be due, and a stop may have come.
        self.arm(&cycle, now);
    }

    /// The slot of the next step.
    pub fn slot(&self) -> u64 {
        self.grid.index()
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
        if let Some(recording) = self.channels.log.as_recording() {
            recording.end();
        }
        let panic = self.loop_panic();
        let status = Status { planned: self.grid.planned(), ..self.status };
        let of_buses: Vec<BusNumbers> = self.buses.iter().map(|open| open.bus.numbers()).collect();
        let drives = (self.axes.iter().zip(&self.controllers).zip(&self.slots))
            .map(|((axis, controller), slot)| {
                let unmatched = of_buses.get(axis.info.bus).map(|numbers| numbers.unmatched);
                let (feedback, numbers) = (*controller.feedback(), controller.numbers(slot));
                let mut end = axis.info.with(feedback, numbers, &unmatched.unwrap_or_default());
                end.at_end = controller.at_end();
                end
            })
            .collect();
        let buses = self.buses.iter().map(|open| &open.info).zip(of_buses);
        Numbers { panic, ..Numbers::of(status, drives, buses) }
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
