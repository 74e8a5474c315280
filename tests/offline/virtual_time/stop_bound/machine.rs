//! A machine of any shape: brought into motion, given a fault, looked at, and brought back for the next fault.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fastrand::Rng;
use fieldbeat::axis::{
    self, AxisPlan, Command, DriveStatus, EventKind, Health, Link, Outcome, Row, StopCause, StopHow,
    StopPlan, StopThen, Target,
};
use fieldbeat::bus::linudp::{ControlWord, ErrorCode, ReplyTag, StreamCommand};
use fieldbeat::sim::{FaultPlan, World, WorldOptions};
use fieldbeat::time::{MS, US};
use fieldbeat::{Axes, Cycle, Flow, Overrun};
use fieldbeat_core::cycle::bound::{Pace, Paced, bound};
use fieldbeat_core::cycle::record::{Record, Reply};
use fieldbeat_linudp::wire::{Request, ResponseDef};
use fieldbeat_telemetry::tap::Tap;

use super::Fault::{self, *};
use super::watch::{Stopped, Stream, Watch, says};
use super::{DRIVE, LINK, MACHINE, STREAM, Table};
use crate::virtual_time::support::*;

/// One fault and what has to come of it.
struct Injection {
    fault: Fault,
    /// Whom it befell; `None` = all.
    axis: Option<usize>,
    /// The axes that have to get a stop.
    axes: Vec<usize>,
    injected_at: u64,
    /// The cycle from which its bound counts, once that is known.
    from: Option<u64>,
}

/// Axes that stop together.
struct Lane {
    axes: Vec<usize>,
    state: State,
}

enum State {
    /// Out of the latch, without a fault.
    Clearing,
    /// Enabled and homed.
    Rising,
    /// In motion until that cycle; then this fault befalls this axis.
    Moving(u64, Fault, usize),
    Injected(Injection),
    /// Stopped, and left alone until that cycle.
    Resting(u64),
    /// Its fault went away: what was lost before is missed once its reply is overdue, by that cycle.
    Fixed(u64),
}

/// What the in-loop task shall do next, and when it did.
#[derive(Default)]
struct TaskPart {
    world: Option<World>,
    slow_ns: u64,
    panic: bool,
    rows: Vec<(usize, Row)>,
    acted_at: Option<u64>,
}

impl TaskPart {
    /// Says whether the task shall panic now.
    fn run(&mut self, cycle: &Cycle, axes: &mut Axes<'_>) -> bool {
        let (slow_ns, panic) = (std::mem::take(&mut self.slow_ns), std::mem::take(&mut self.panic));
        if slow_ns > 0 || panic || !self.rows.is_empty() {
            self.acted_at = Some(cycle.index);
        }
        self.rows.drain(..).for_each(|(axis, row)| axes.follow(axis, row));
        if let Some(world) = &self.world {
            world.advance(slow_ns);
        }
        panic
    }
}

const TASK_BUDGET_NS: u64 = 50 * US;

pub struct Machine {
    b: Bench,
    random: Rng,
    watches: Vec<Watch>,
    lanes: Vec<Lane>,
    /// What `check` states for each axis.
    stated: Vec<u64>,
    task: Arc<Mutex<TaskPart>>,
    max_skip: u64,
    /// No lane injects a fault by itself.
    quiet: bool,
    /// Every axis may be stopped.
    all: bool,
    table: Table,
    /// The records of each turn.
    tap: Tap,
}

impl Machine {
    /// A machine of any shape.
    pub fn new(seed: u64) -> Machine {
        let mut random = Rng::with_seed(seed);
        let period_ns = [MS, 2 * MS, 4 * MS][random.usize(..3)];
        let max_skip = random.u64(..5);
        let task = Arc::new(Mutex::new(TaskPart::default()));
        let inside = Arc::clone(&task);
        let mut rig = Rig::new(random.usize(1..=8))
            .cycle(|cycle| {
                cycle.period_ns = period_ns;
                cycle.task_budget_ns = Some(TASK_BUDGET_NS);
                cycle.overrun = match max_skip {
                    0 => Overrun::Stop,
                    max_skip => Overrun::Skip { max_skip },
                };
            })
            .task(move |cycle, axes| {
                let panics = inside.lock().unwrap().run(cycle, axes);
                if panics {
                    // Quietly: the message of a panic is not this test's.
                    std::panic::resume_unwind(Box::new("on purpose"));
                }
            });
        rig.options = WorldOptions {
            seed,
            wake_ns: random.u64(..period_ns / 10),
            latency_ns: random.u64(US..period_ns / 10),
            ..WorldOptions::default()
        };
        for drive in &mut rig.drives {
            let divisor = random.u32(1..=4);
            let every_ns = period_ns * u64::from(divisor);
            let axis = &mut drive.axis;
            (axis.divisor, axis.phase) = (divisor, random.u32(..divisor));
            axis.health = Health {
                bucket: random.u32(1..=8),
                leak: random.u32(1..30),
                gate: random.u32(1..8),
                probe_interval: Duration::from_millis(random.u64(10..60)),
            };
            axis.stop = StopPlan {
                how: pick(&mut random, &[StopHow::Ramp, StopHow::Ramp, StopHow::Quick, StopHow::Coast]),
                then: pick(&mut random, &[StopThen::Hold, StopThen::Hold, StopThen::Disable]),
                deceleration: random.f64() * 9_000.0 + 1_000.0,
                standstill_for: random.u32(1..10),
                group: pick(&mut random, &[None, Some(1), Some(2), Some(3), Some(4)]),
                ..axis.stop
            };
            drive.reply_tag = pick(&mut random, &ReplyTag::WORDS).1;
            let most = if drive.reply_tag == ReplyTag::Off { 1 } else { 4 };
            if drive.reply_tag == ReplyTag::Off {
                // Of replies that are always one behind every second one passes for the newest.
                drive.axis.health.leak = drive.axis.health.leak.max(2);
            }
            drive.reply_within = pick(&mut random, &[None, Some(1), Some(most)]);
            drive.stream = Some(pick(&mut random, &[StreamCommand::Pva, StreamCommand::PvConfigured]))
                .filter(|command| command.takes(every_ns));
            drive.simulate.stream_period_ns = every_ns;
            drive.simulate.start_running = random.u8(..4) == 0;
        }
        let b = rig.start();
        task.lock().unwrap().world = Some(b.world());
        let plans: Vec<&AxisPlan> = b.drives.iter().map(|drive| &drive.axis).collect();
        let paced = b.drives.iter().map(|drive| {
            let pace = Pace::Cycle(u64::from(drive.replies_within().saturating_sub(1)));
            Paced { axis: &drive.axis, pace, before_stop: 0 }
        });
        let paced: Vec<Paced<'_>> = paced.collect();
        let stated = paced.iter().map(|drive| bound(drive, &paced)).collect();
        let mut groups: BTreeMap<(Option<u16>, usize), Vec<usize>> = BTreeMap::new();
        for (index, axis) in plans.iter().enumerate() {
            let alone = if axis.stop.group.is_none() { index } else { 0 };
            groups.entry((axis.stop.group, alone)).or_default().push(index);
            b.tape(index).wire = Some(Vec::new());
        }
        Machine {
            watches: plans.iter().map(|_| Watch::default()).collect(),
            lanes: groups.into_values().map(|axes| Lane { axes, state: State::Clearing }).collect(),
            stated,
            random,
            task,
            max_skip,
            quiet: true,
            all: true,
            table: Table::default(),
            tap: b.sim.tap(16),
            b,
        }
    }

    /// What came of its faults. A task that panicked is never dropped: it must not keep the world.
    pub fn into_table(self) -> Table {
        self.task.lock().unwrap().world = None;
        self.table
    }

    fn axes(&self) -> std::ops::Range<usize> {
        0..self.watches.len()
    }

    fn divisor(&self, axis: usize) -> u64 {
        self.b.drives[axis].axis.divisor.into()
    }

    /// The cycle executed last.
    pub fn now(&self) -> u64 {
        self.b.status().planned - 1
    }

    /// The last slot up to `cycle` in which `axis` gets a request.
    fn own_slot(&self, axis: usize, cycle: u64) -> u64 {
        let (divisor, phase) = (self.divisor(axis), u64::from(self.b.drives[axis].axis.phase));
        cycle - (cycle + divisor - phase) % divisor
    }

    fn post(&mut self, axis: usize, command: Command) {
        let watch = &mut self.watches[axis];
        watch.pending = true;
        if command == Command::Enable {
            (watch.stopped, watch.stream) = (None, None);
        }
        self.b.post(axis, command);
    }

    /// One turn of the loop, and all that is to be seen of it.
    fn turn(&mut self) -> Flow {
        self.push_rows();
        let flow = self.b.step();
        for axis in self.axes() {
            let wire = std::mem::take(self.b.tape(axis).wire.as_mut().unwrap());
            let watch = &mut self.watches[axis];
            for Spoken { at, request } in wire {
                if let Err(what) = watch.reported(self.b.slot(at), &request) {
                    panic!("axis {axis} got {what}");
                }
            }
            for received in std::mem::take(&mut self.b.tape(axis).received) {
                if let Some(stopped) = &mut watch.stopped {
                    stopped.off |= says(&received.request).off;
                }
            }
        }
        // An exchange is good by its reply, whether the report in it counts or not.
        while let Ok(records) = self.tap.next(Duration::ZERO) {
            for record in records.iter() {
                // One with a round trip was answered, whatever was missed in the same cycle.
                if let Record::Drive(drive) = record
                    && (drive.reply == Reply::Suspect || drive.rtt_ns.is_some())
                {
                    self.watches[usize::from(drive.axis)].good_at = drive.index;
                }
            }
        }
        assert_eq!(self.tap.lost(), 0);
        for (axis, event) in std::mem::take(&mut self.b.events) {
            let faulty = |lane: &Lane| {
                matches!(lane.state, State::Injected(_) | State::Fixed(_)) && lane.axes.contains(&axis)
            };
            let expected = self.all || self.lanes.iter().any(faulty);
            let watch = &mut self.watches[axis];
            match event.kind {
                EventKind::Stopped(cause) => {
                    assert!(expected, "axis {axis} was stopped for nothing: {event}");
                    watch.stopped =
                        Some(Stopped { cause, good_at: watch.good_at, requested_at: None, off: false });
                    watch.enabled = false;
                }
                EventKind::Ended { command, outcome, .. } => {
                    watch.pending = false;
                    watch.enabled |= command == Command::Enable.name() && outcome == Outcome::Done;
                }
                EventKind::Link(Link::Online) => watch.online_at = event.cycle,
                _ => {}
            }
        }
        flow
    }

    /// Keeps every stream a few rows ahead.
    fn push_rows(&mut self) {
        for (axis, watch) in self.watches.iter_mut().enumerate() {
            let Some(stream) = watch.stream.as_mut().filter(|_| watch.stopped.is_none()) else { continue };
            while !stream.starving && stream.pushed < stream.reported + 4 {
                // Its drive interpolates by the velocity, too.
                let row = Row { position: stream.next, velocity: stream.velocity, ..Row::default() };
                self.b.sim.axis(axis).push_row(row).unwrap();
                // Turning round early enough to be able to brake inside the range.
                if stream.next + stream.step < 5.0 && stream.step < 0.0
                    || stream.next > 150.0 && stream.step > 0.0
                {
                    (stream.step, stream.velocity) = (-stream.step, -stream.velocity);
                }
                (stream.next, stream.pushed) = (stream.next + stream.step, stream.pushed + 1);
            }
        }
    }

    /// A turn, and each lane's next step.
    fn go_on(&mut self) {
        self.turn();
        for index in 0..self.lanes.len() {
            let state = std::mem::replace(&mut self.lanes[index].state, State::Clearing);
            let axes = self.lanes[index].axes.clone();
            self.lanes[index].state = match state {
                State::Clearing => self.clear(&axes),
                State::Rising => self.rise(&axes),
                State::Moving(until, fault, axis) if !self.quiet && self.now() >= until => {
                    State::Injected(self.inject(fault, Some(axis), axes))
                }
                State::Injected(mut injection) => match self.settle(&mut injection) {
                    true => self.rest(),
                    false => State::Injected(injection),
                },
                State::Resting(until) if self.now() >= until => {
                    axes.iter().for_each(|axis| self.mend(*axis));
                    let overdue = axes
                        .iter()
                        .map(|axis| u64::from(self.b.drives[*axis].replies_within()) * self.divisor(*axis));
                    State::Fixed(self.now() + overdue.max().unwrap_or(0))
                }
                State::Fixed(until) if self.now() > until => State::Clearing,
                state => state,
            };
        }
    }

    fn rest(&mut self) -> State {
        State::Resting(self.now() + self.random.u64(..40))
    }

    /// Undoes what was done to the drive.
    fn mend(&self, axis: usize) {
        self.b.world().plug(address(axis));
        self.b.world().set_faults(address(axis), FaultPlan::default());
        self.b.tape(axis).mute = false;
    }

    /// Brings the axes online and out of their latches and faults.
    fn clear(&mut self, axes: &[usize]) -> State {
        let mut clear = true;
        for &axis in axes {
            let feedback = self.b.feedback(axis);
            let command = match feedback.stopped {
                _ if feedback.link != Link::Online || self.watches[axis].pending => None,
                Some(_) => Some(Command::Reset),
                // Its number comes later than its state.
                None if feedback.status.state == axis::State::Fault || feedback.status.fault != 0 => {
                    Some(Command::ResetFault)
                }
                None => {
                    assert!(
                        !feedback.status.moving,
                        "axis {axis} moves, and its latch is open: {feedback:?}"
                    );
                    if feedback.status.velocity.abs() <= self.b.drives[axis].axis.stop.standstill {
                        continue;
                    }
                    // It runs out without power, and out of its range: with power on it would be stopped for that.
                    None
                }
            };
            clear = false;
            command.into_iter().for_each(|command| self.post(axis, command));
        }
        if !clear {
            return State::Clearing;
        }
        if !self.quiet && self.random.u8(..5) == 0 {
            // Given a fault on the way up.
            axes.iter().for_each(|axis| self.post(*axis, Command::Enable));
            let longest = 350 * MS / self.b.period_ns;
            let (fault, axis) = (pick(&mut self.random, &LINK), pick(&mut self.random, axes));
            return State::Moving(self.now() + self.random.u64(..longest), fault, axis);
        }
        State::Rising
    }

    /// Brings the axes up and into their range; once all are up, off they go.
    fn rise(&mut self, axes: &[usize]) -> State {
        let mut up = true;
        for &axis in axes {
            let (watch, feedback) = (&self.watches[axis], self.b.feedback(axis));
            let command = match feedback.status.homed {
                _ if watch.pending => None,
                _ if !watch.enabled => Some(Command::Enable),
                false => Some(Command::Home),
                // Where it ran out without power.
                true if feedback.status.demand < 0.0 => Some(to(5.0)),
                true => continue,
            };
            up = false;
            command.into_iter().for_each(|command| self.post(axis, command));
        }
        if !up {
            return State::Rising;
        }
        let streams = |axis: &usize| self.b.drives[*axis].stream.is_some();
        let streaming: Vec<usize> = axes.iter().copied().filter(streams).collect();
        let fault = match self.random.u8(..10) {
            0..5 => pick(&mut self.random, &LINK),
            8.. if !streaming.is_empty() => pick(&mut self.random, &STREAM),
            _ => pick(&mut self.random, &DRIVE),
        };
        let axis = pick(&mut self.random, if STREAM.contains(&fault) { &streaming } else { axes });
        for &one in axes {
            self.set_off(one, STREAM.contains(&fault) && one == axis);
        }
        State::Moving(self.now() + self.random.u64(2..60), fault, axis)
    }

    /// Any motion, to and fro in the first centimetres.
    fn set_off(&mut self, axis: usize, stream: bool) {
        let DriveStatus { demand, moving, .. } = self.b.feedback(axis).status;
        let Watch { enabled, pending, .. } = self.watches[axis];
        let can_stream =
            self.b.drives[axis].stream.is_some() && enabled && !pending && !moving && demand >= 0.0;
        let velocity = self.random.f64() * 55.0 + 5.0;
        let signed = if demand > 20.0 { -velocity } else { velocity };
        match self.random.u8(..8) {
            _ if self.watches[axis].stream.is_some() => {}
            _ if stream => self.stream(axis, demand, signed),
            0 => {}
            1 => self.post(axis, Command::Home),
            2..4 => {
                let target = Target::Absolute(self.random.f64() * 20.0);
                self.post(axis, with(target, velocity, 2_000.0));
            }
            4..6 => self.post(axis, jog(signed)),
            _ if can_stream => self.stream(axis, demand, signed),
            _ => {}
        }
    }

    fn stream(&mut self, axis: usize, from: f64, velocity: f64) {
        let step = velocity * (self.b.period_ns * self.divisor(axis)) as f64 * 1e-9;
        self.watches[axis].stream = Some(Stream { next: from, step, velocity, ..Stream::default() });
        self.push_rows();
        self.post(axis, Command::Follow);
    }

    /// Lets it happen.
    fn inject(&mut self, fault: Fault, axis: Option<usize>, axes: Vec<usize>) -> Injection {
        let (world, now) = (self.b.world(), self.now());
        let mut from = None;
        if let Some(axis) = axis {
            let last = self.own_slot(axis, now);
            let plan = |plan| assert!(world.set_faults(address(axis), plan));
            let seed = self.random.u64(..);
            match fault {
                Unplugged => drop(world.unplug(address(axis))),
                Muted => self.b.tape(axis).mute = true,
                WrongPort => plan(FaultPlan { wrong_id: 1.0, ..FaultPlan::default() }),
                Dropping => {
                    plan(FaultPlan { seed, drop: 0.5 + self.random.f64() / 2.0, ..FaultPlan::default() })
                }
                Late => {
                    // Behind the deadline of the last cycle in which it counts, up to the windows of later ones.
                    let beyond = u64::from(self.b.drives[axis].replies_within() - 1);
                    let answer_ns = self.b.period_ns * (10 * beyond + self.random.u64(6..25)) / 10;
                    plan(FaultPlan { answer_ns, ..FaultPlan::default() });
                }
                DriveError => {
                    let code = pick(&mut self.random, &[0x0003, 0x000B, 0x0023, 0x0086]);
                    self.b.tape(axis).provoke = Some(ErrorCode(code));
                }
                PowerCut => {
                    // Another master says so.
                    let request = Request {
                        control: Some(ControlWord::BASE),
                        response_def: ResponseDef::CYCLIC,
                        ..Request::default()
                    };
                    self.b.inject_request(axis, request, world.now());
                }
                Restarted => drop(world.restart(address(axis))),
                Starved => self.watches[axis].stream.as_mut().unwrap().starving = true,
                BadRow => {
                    let far = self.b.feedback(axis).status.demand + 150.0;
                    let row = row(pick(&mut self.random, &[f64::NAN, -1.0, 1e9, far]));
                    self.task.lock().unwrap().rows.push((axis, row));
                }
                _ => unreachable!("{fault:?} is not for one axis"),
            }
            from = match fault {
                Unplugged | Muted | WrongPort => Some(last),
                DriveError | PowerCut | Restarted => Some(last + self.divisor(axis)),
                _ => None,
            };
        }
        match fault {
            SlowTask => self.task.lock().unwrap().slow_ns = TASK_BUDGET_NS + self.random.u64(US..20 * US),
            PanickingTask => self.task.lock().unwrap().panic = true,
            HeldUp => {
                let slots = self.max_skip + self.random.u64(1..4);
                world.delay_next_wake(slots * self.b.period_ns - self.b.period_ns * 2 / 5);
                from = Some(now + slots);
            }
            Shutdown => {
                self.b.sim.stop();
                from = Some(now + 1);
            }
            _ => {}
        }
        Injection { fault, axis, axes, injected_at: now, from }
    }

    /// Whether every stop request is out; if so, none was late.
    fn settle(&mut self, injection: &mut Injection) -> bool {
        let Injection { fault, axis: faulty, ref axes, injected_at, .. } = *injection;
        let now = self.now();
        assert!(now < injected_at + 1_000, "{fault:?} of axis {faulty:?} in cycle {injected_at}: no stop");
        injection.from = injection.from.or_else(|| {
            let acted_at = self.task.lock().unwrap().acted_at.filter(|acted| *acted > injected_at);
            let axis = faulty.unwrap_or(0);
            match fault {
                Dropping | Late => self.watches[axis].stopped.map(|stopped| stopped.good_at),
                Starved => {
                    let stream = self.watches[axis].stream.as_ref().unwrap();
                    (stream.reported == stream.pushed).then(|| stream.requested_at + self.divisor(axis) - 1)
                }
                BadRow => Some(self.own_slot(axis, acted_at?) + self.divisor(axis) - 1),
                _ => acted_at,
            }
        });
        let reported = |axis: &usize| {
            Some((*axis, self.watches[*axis].stopped?, self.watches[*axis].stopped?.requested_at?))
        };
        let Some(reported) = axes.iter().map(reported).collect::<Option<Vec<_>>>() else { return false };
        let from = injection.from.expect("stopped, so its cause is known");
        // A stream that loses rows, or goes on without power, becomes a fault of the drive, and that may be reported
        // first.
        let reported_first = |(axis, stopped, _): &(usize, Stopped, u64)| {
            Some(*axis) == faulty && stopped.cause == StopCause::DriveFault
        };
        let may = matches!(fault, Dropping | Late | PowerCut) && reported.iter().any(reported_first);
        let fault = if may { DriveError } else { fault };
        let tally = self.table.0.entry(fault).or_default();
        tally.faults += 1;
        for (axis, stopped, requested_at) in reported {
            let own = faulty.is_none_or(|faulty| faulty == axis);
            let cause = if own { fault.cause() } else { StopCause::Group };
            let of = faulty.unwrap_or(axis);
            let [axis_plan, faulty_plan] = [axis, of].map(|index| &self.b.drives[index].axis);
            let bound = fault.bound(own, axis_plan, faulty_plan, self.stated[of]);
            let cycles = requested_at - from;
            assert!(
                cycles <= bound,
                "{fault:?} of {faulty:?}: axis {axis} got its stop {cycles} cycles after {from}, not {bound}"
            );
            assert_eq!(stopped.cause, cause, "{fault:?} of {faulty:?}: axis {axis}");
            tally.note(cycles, bound);
        }
        true
    }

    /// Drives that are found running are stopped in the cycle in which they come online.
    fn bring_up(&mut self) {
        let online = |m: &Machine| m.axes().all(|axis| m.b.feedback(axis).link == Link::Online);
        let turns = (0..200).take_while(|_| (self.turn(), online(self)) != (Flow::Continue, true)).count();
        assert!(turns < 200, "not all axes came online");
        // And once around the schedule of each.
        for _ in 0..4 {
            self.turn();
        }
        for axis in self.axes().filter(|axis| self.b.drives[*axis].simulate.start_running) {
            let watch = &self.watches[axis];
            let stopped = watch.stopped.expect("found running");
            // The first of a group takes the others along before they are online themselves.
            assert!(matches!(stopped.cause, StopCause::FoundRunning | StopCause::Group));
            let cycles = stopped.requested_at.expect("it got a stop") - watch.online_at;
            let plan = &self.b.drives[axis].axis;
            let bound = FoundRunning.bound(true, plan, plan, 0);
            assert!(
                cycles <= bound,
                "found running: axis {axis} got its stop after {cycles} cycles, not {bound}"
            );
            let tally = self.table.0.entry(FoundRunning).or_default();
            tally.faults += 1;
            tally.note(cycles, bound);
        }
    }

    /// Brings all axes into motion, and stops them all.
    fn inject_all(&mut self, fault: Fault) {
        self.quiet = true;
        let mut turns = 0;
        while !self.lanes.iter().all(|lane| matches!(lane.state, State::Moving(..))) {
            self.go_on();
            turns += 1;
            let stuck = || -> Vec<String> {
                let stuck = self.lanes.iter().filter(|lane| !matches!(lane.state, State::Moving(..)));
                stuck
                    .flat_map(|lane| &lane.axes)
                    .map(|axis| format!("{axis}: {:?}", self.b.feedback(*axis)))
                    .collect()
            };
            assert!(turns < 40_000, "not all axes came into motion: {:#?}", stuck());
        }
        self.axes().for_each(|axis| self.set_off(axis, false));
        for _ in 0..self.random.u64(2..60) {
            self.go_on();
        }
        self.all = true;
        let mut injection = self.inject(fault, None, self.axes().collect());
        while !self.settle(&mut injection) {
            self.turn();
        }
        for index in 0..self.lanes.len() {
            self.lanes[index].state = self.rest();
        }
        (self.quiet, self.all) = (false, false);
    }

    /// So many faults, and the end of the master as the last one.
    pub fn run(&mut self, faults: u64) {
        self.bring_up();
        (self.quiet, self.all) = (false, false);
        let faulty = |m: &Machine| m.table.0.values().map(|tally| tally.faults).sum::<u64>();
        while faulty(self) < faults {
            match self.random.u8(..40) {
                0 => {
                    let fault = pick(&mut self.random, &MACHINE);
                    self.inject_all(fault);
                }
                _ => (0..100).for_each(|_| self.go_on()),
            }
        }
        self.inject_all(PanickingTask);
        self.inject_all(Shutdown);
        self.all = true;
        let ends = (0..20_000).any(|_| self.turn() == Flow::End);
        assert!(ends, "the shutdown does not end");
        for axis in self.axes() {
            assert!(!self.b.feedback(axis).status.state.is_powered(), "axis {axis} has power at the end");
        }
        self.b.assert_grid();
    }
}

fn pick<T: Copy>(random: &mut Rng, among: &[T]) -> T {
    among[random.usize(..among.len())]
}
