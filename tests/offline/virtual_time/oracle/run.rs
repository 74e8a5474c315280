//! A run of sequences on one machine, judged in every turn.

use std::fmt::Write as _;

use fieldbeat::Flow;
use fieldbeat::axis::{
    Abort, Axis, AxisError, Command, CommandId, Group, GroupCommand, GroupError, Link, Outcome, Row,
    StopCause,
};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::bus::{ethercat, ethernet_ip, linudp, modbus, profibus};
use fieldbeat::sim::Truth;
use fieldbeat::time::MS;
use fieldbeat_core::rt::Taker;

use super::judge::{Breach, GRACE, MOST_ALONE, Slots, Watch};
use super::machine::{AXES, Kind, Machine, Shape};
use super::steps::{Choice, Op, Round, Step, writes};
use crate::virtual_time::replay::Log;

/// Turns after the last step of a round in which what it began goes on.
const TAIL: u64 = 60;
/// Turns between two tries to make an axis ready whose slave a tool may have lowered.
const LOWERED: u32 = 100;
/// Turns in which all ends, after a round.
const SETTLED: u64 = 4_000;
/// Turns in which a line comes up, and attempts to make an axis ready.
const UP: u64 = 12_000;
const ATTEMPTS: u32 = 12;

/// A broken rule, and where.
#[derive(Clone, Debug)]
pub struct Found {
    pub rule: &'static str,
    pub round: usize,
    pub turn: u64,
    pub axis: usize,
    pub text: String,
}

/// What a run did.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    pub sequences: u64,
    pub turns: u64,
    pub machines: u64,
    /// Commands that were accepted, and how they ended.
    pub accepted: u64,
    pub done: u64,
    pub failed: u64,
    pub aborted: u64,
    /// Stops by the master.
    pub stops: u64,
    pub effects: Effects,
    /// All that passed the wires, in one number.
    pub wire: u64,
}

impl Tally {
    /// Two runs were the same to the byte, and in all ends.
    pub fn is_that_of(&self, other: &Tally) -> bool {
        let of = |tally: &Tally| {
            [tally.wire, tally.accepted, tally.done, tally.failed, tally.aborted, tally.stops]
        };
        of(self) == of(other)
    }
}

/// What happens to a machine, and has to have an effect in a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// A call of a group was accepted; a set of setpoints and a row of it were taken; a call ended at all members as
    /// Done.
    Called,
    SetTogether,
    RowsTogether,
    DoneTogether,
    /// Native outputs were taken by a running native mode.
    NativeLinMot,
    NativeUnidrive,
    NativeMoons,
    NativeKollmorgen,
    NativeLenze,
    Died,
    Stuck,
    /// An axis was dropped, and stopped for it.
    Dropped,
    OwnerLost,
    /// Foreign datagrams and frames; stops for another master.
    Foreign,
    OtherMaster,
    /// Of operators.
    Jogged,
    Held,
    Stepped,
    Homed,
    Left,
    FellSilent,
    OutOfTurn,
    RefusedToOther,
    OtherTook,
    HandedBack,
    /// A command of the shell was done, and the process of one died before that.
    Once,
    OnceKilled,
    /// A master died while somebody operated its axes.
    OperatedDied,
}

impl Effect {
    pub const ALL: [Effect; 28] = {
        use Effect::*;
        [
            Called,
            SetTogether,
            RowsTogether,
            DoneTogether,
            NativeLinMot,
            NativeUnidrive,
            NativeMoons,
            NativeKollmorgen,
            NativeLenze,
            Died,
            Stuck,
            Dropped,
            OwnerLost,
            Foreign,
            OtherMaster,
            Jogged,
            Held,
            Stepped,
            Homed,
            Left,
            FellSilent,
            OutOfTurn,
            RefusedToOther,
            OtherTook,
            HandedBack,
            Once,
            OnceKilled,
            OperatedDied,
        ]
    };
}

/// How often each came about.
#[derive(Clone, Copy, Default)]
pub struct Effects([u64; Effect::ALL.len()]);

impl Effects {
    pub fn count(&mut self, effect: Effect) {
        self.0[effect as usize] += 1;
    }

    fn add(&mut self, other: Effects) {
        self.0.iter_mut().zip(other.0).for_each(|(sum, count)| *sum += count);
    }

    /// Those that never came about.
    pub fn missing(&self) -> Vec<Effect> {
        Effect::ALL.into_iter().filter(|effect| self.0[*effect as usize] == 0).collect()
    }
}

impl std::fmt::Debug for Effects {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_map().entries(Effect::ALL.map(|effect| (effect, self.0[effect as usize]))).finish()
    }
}

impl std::ops::AddAssign for Tally {
    fn add_assign(&mut self, other: Tally) {
        self.sequences += other.sequences;
        self.turns += other.turns;
        self.machines += other.machines;
        self.accepted += other.accepted;
        self.done += other.done;
        self.failed += other.failed;
        self.aborted += other.aborted;
        self.stops += other.stops;
        self.effects.add(other.effects);
        self.wire = self.wire.rotate_left(1) ^ other.wire;
    }
}

/// What goes on at an axis over several turns.
#[derive(Default)]
struct Disturbances {
    /// The setpoint that is given again, and until which turn.
    level: Option<(f64, u64)>,
    /// It is disconnected, or loses datagrams, until then.
    unplugged: Option<u64>,
    lossy: Option<u64>,
    /// Its events are not read until then.
    deaf: u64,
    /// Its wire is bad until then.
    bad: u64,
    native: Native,
    stopped: bool,
    /// Its stops, by their ids.
    urgent: Vec<u64>,
    /// It goes on with a call of its group without another member since so many turns.
    alone: u32,
}

/// The native process data of an axis, as far as they are written here.
#[derive(Default)]
enum Native {
    #[default]
    None,
    LinMot(Box<linudp::Native>),
    Unidrive(Box<modbus::Native>),
    Moons(Box<ethernet_ip::Native>),
    Kollmorgen(Box<ethercat::Native>),
    Lenze(Box<profibus::Native>),
}

impl Native {
    fn of(kind: Kind, axis: &mut Axis) -> Native {
        let native = match kind {
            Kind::LinMot => axis.native().map(Native::LinMot),
            Kind::Unidrive => axis.native().map(Native::Unidrive),
            Kind::Moons => axis.native().map(Native::Moons),
            Kind::Kollmorgen => axis.native().map(Native::Kollmorgen),
            Kind::Lenze => axis.native().map(Native::Lenze),
            Kind::Mixed => None,
        };
        native.unwrap_or_default()
    }
}

/// A call of a group, until its last part has ended: the id of each part, and how it ended.
struct Call {
    ids: Vec<u64>,
    ended: Vec<Option<Outcome>>,
}

pub struct Run {
    machine: Machine,
    /// What the application has of them: none of one that it has dropped.
    axes: Vec<Option<Axis>>,
    /// Calls of the group that have not ended.
    calls: Vec<Call>,
    /// Setpoints of the group that are given again, and until which turn.
    level: Option<(f64, u64)>,
    /// A tool has run over the segment, and nothing was written to a parameter.
    tool: bool,
    written: bool,
    watches: Vec<Watch>,
    around: Vec<Disturbances>,
    slots: Slots,
    /// So many slots are passed over before each turn until that one.
    overload: (u32, u64),
    /// The adapter of the wire is unplugged until then.
    cut: Option<u64>,
    turn: u64,
    begun: u64,
    round: usize,
    pub tally: Tally,
    /// What happened, where it is wanted.
    pub story: Option<String>,
}

type Judged = Result<(), Found>;

impl Run {
    /// A machine whose axes are ready.
    pub fn new(shape: Shape, story: bool, log: Option<Log>) -> Result<Run, Found> {
        let mut machine = Machine::new(shape, log);
        let axes = (0..AXES).map(|axis| Some(machine.sim.take_axis(axis))).collect();
        let watches = (0..AXES).map(|axis| Watch::new(machine.scales[axis], &machine.plans[axis])).collect();
        let mut run = Run {
            machine,
            axes,
            calls: Vec::new(),
            level: None,
            tool: false,
            written: false,
            watches,
            around: (0..AXES).map(|_| Disturbances::default()).collect(),
            slots: Slots::default(),
            overload: (0, 0),
            cut: None,
            turn: 0,
            begun: 0,
            round: 0,
            tally: Tally { machines: 1, ..Tally::default() },
            story: None,
        };
        run.natives();
        assert!(run.recover()?, "a machine that nothing has happened to comes up");
        run.story = story.then(String::new);
        Ok(run)
    }

    /// All rounds, each from axes that are ready.
    pub fn rounds(shape: Shape, rounds: &[Round], story: bool) -> (Result<(), Found>, Tally, Option<String>) {
        let mut tally = Tally::default();
        let mut run = match Run::new(shape, story, None) {
            Ok(run) => run,
            Err(found) => return (Err(found), tally, None),
        };
        for (index, round) in rounds.iter().enumerate() {
            run.round = index;
            let judged = run.round(round);
            run.tally.sequences += AXES as u64;
            match judged {
                Err(found) => {
                    tally += run.end();
                    return (Err(found), tally, run.story);
                }
                Ok(true) => {}
                // It cannot be made ready again: what was written, or a fault, stays.
                Ok(false) => {
                    tally += run.end();
                    let before = run.story.take();
                    match Run::new(shape, false, None) {
                        Ok(fresh) => run = Run { story: before, ..fresh },
                        Err(found) => return (Err(found), tally, None),
                    }
                }
            }
        }
        tally += run.end();
        (Ok(()), tally, run.story)
    }

    /// What it did, at its end.
    fn end(&self) -> Tally {
        Tally { wire: self.machine.sim.world().digest(), ..self.tally }
    }

    /// The rounds of one machine whose inputs are in `log`, up to the first one that it does not get over.
    pub fn recorded(shape: Shape, rounds: &[Round], log: &Log) -> Tally {
        let mut run = match Run::new(shape, false, Some(log.clone())) {
            Ok(run) => run,
            Err(found) => panic!("{found:?}"),
        };
        for (index, round) in rounds.iter().enumerate() {
            run.round = index;
            run.tally.sequences += AXES as u64;
            if !matches!(run.round(round), Ok(true)) {
                break;
            }
        }
        run.tally
    }

    /// One round; whether its axes are ready for another.
    fn round(&mut self, round: &[Step]) -> Result<bool, Found> {
        self.begun = self.turn;
        let mut steps = round.iter().peekable();
        let last = round.last().map_or(0, |step| u64::from(step.at));
        let goes_on =
            |run: &Run| run.level.is_some() || run.around.iter().any(|around| around.level.is_some());
        while self.turn - self.begun <= last + TAIL || goes_on(self) {
            while let Some(step) = steps.next_if(|step| u64::from(step.at) <= self.turn - self.begun) {
                self.take(step)?;
            }
            self.step()?;
        }
        self.settle()?;
        let ready = self.recover()?;
        // Nothing but the tool can have left it so.
        if !ready && self.tool && !self.written && self.axes.iter().all(Option::is_some) {
            let text =
                format!("{:?}", (0..AXES).map(|axis| self.machine.sim.feedback(axis)).collect::<Vec<_>>());
            return Err(self.found(0, Breach { rule: "recovers", text }));
        }
        Ok(ready)
    }

    /// The handles of the native process data of all axes.
    fn natives(&mut self) {
        for index in 0..AXES {
            let kind = self.machine.shape.kind.of(index);
            let axis = self.axes[index].as_mut();
            self.around[index].native = axis.map_or(Native::None, |axis| Native::of(kind, axis));
        }
    }

    /// The first axes as a group, where there is one and the application has all of them.
    fn grouped<R>(&mut self, act: impl FnOnce(&mut Group) -> R) -> Option<R> {
        let members = &mut self.axes[..self.machine.shape.members()];
        if members.is_empty() || members.iter().any(Option::is_none) {
            return None;
        }
        let mut group = Group::new(members.iter_mut().filter_map(Option::take)).unwrap();
        let done = act(&mut group);
        members.iter_mut().zip(group.into_axes()).for_each(|(slot, axis)| *slot = Some(axis));
        Some(done)
    }

    fn found(&self, axis: usize, breach: Breach) -> Found {
        let Breach { rule, text } = breach;
        Found { rule, round: self.round, turn: self.turn - self.begun, axis, text }
    }

    fn tell(&mut self, axis: usize, what: impl FnOnce() -> String) {
        let turn = self.turn - self.begun;
        if let Some(story) = &mut self.story {
            let _ = writeln!(story, "{turn:5} axis {axis}: {}", what());
        }
    }

    /// One turn of the loop, and the judgement of each axis.
    fn step(&mut self) -> Judged {
        // A turn in which slots are passed over executes none.
        if self.turn < self.overload.1 && self.slots.is_executed() {
            self.machine.skip(self.overload.0);
            self.excuse();
        }
        if self.cut.take_if(|until| self.turn >= *until).is_some() {
            self.machine.cut(false);
        }
        for axis in 0..AXES {
            self.go_on(axis)?;
        }
        self.level = self.level.filter(|(_, until)| self.turn < *until);
        if let Some((percent, _)) = self.level {
            self.set_together(percent);
        }
        let before = *self.machine.sim.status();
        self.machine.step();
        let after = *self.machine.sim.status();
        self.turn += 1;
        self.tally.turns += 1;
        self.slots.turn(after.skipped - before.skipped, after.executed - before.executed);
        if after.skipped > before.skipped {
            let cycles = (after.skipped - before.skipped, after.executed - before.executed);
            self.tell(0, || format!("all axes: {} slots skipped, {} executed", cycles.0, cycles.1));
        }
        for axis in 0..AXES {
            self.judge(axis)?;
        }
        self.judge_calls()
    }

    /// No member goes on with a call while another one is out of it.
    fn judge_calls(&mut self) -> Judged {
        let members = self.machine.shape.members();
        if members == 0 {
            return Ok(());
        }
        let blind = (0..members).any(|axis| self.turn <= self.around[axis].deaf);
        let truths: Vec<_> = (0..members).map(|axis| self.machine.truth(axis)).collect();
        let feedbacks: Vec<_> = (0..members).map(|axis| self.machine.sim.feedback(axis)).collect();
        let out = |call: &Call, axis: usize| match call.ended[axis] {
            Some(Outcome::Done) => false,
            Some(Outcome::Aborted(Abort::Replaced(by))) => self.around[axis].urgent.contains(&by.0),
            Some(_) => true,
            None => {
                feedbacks[axis].stopped.is_some()
                    || feedbacks[axis].link != Link::Online
                    || !truths[axis].powered
            }
        };
        let alone: Vec<bool> = (0..members)
            .map(|axis| {
                let running = self.watches[axis].running().map(|(id, _)| id);
                let call = self.calls.iter().find(|call| running == Some(call.ids[axis]));
                let goes_on = !self.watches[axis].rests(truths[axis]) && !blind;
                goes_on
                    && call.is_some_and(|call| (0..members).any(|other| other != axis && out(call, other)))
            })
            .collect();
        for (axis, is_alone) in alone.into_iter().enumerate() {
            let reached = self.turn > self.around[axis].bad;
            let around = &mut self.around[axis];
            around.alone = if is_alone { around.alone + u32::from(reached) } else { 0 };
            if around.alone > MOST_ALONE {
                let text = format!("{truths:?}; {feedbacks:?}");
                return Err(self.found(axis, Breach { rule: "group", text }));
            }
        }
        let (before, watches) = (self.calls.len(), &self.watches);
        let open = |call: &Call| (0..members).any(|axis| watches[axis].pending.contains_key(&call.ids[axis]));
        let done = self.calls.iter().filter(|call| call.ended.iter().all(|end| *end == Some(Outcome::Done)));
        let done = done.count();
        (0..done).for_each(|_| self.tally.effects.count(Effect::DoneTogether));
        if before > 0 {
            self.calls.retain(open);
        }
        Ok(())
    }

    fn judge(&mut self, axis: usize) -> Judged {
        let truth = self.machine.truth(axis);
        let feedback = self.machine.sim.feedback(axis);
        let blind = self.turn <= self.around[axis].deaf;
        while !blind && let Some(event) = self.axes[axis].as_mut().and_then(Axis::event) {
            let fresh = event.cycle + 1 >= feedback.cycle;
            if let fieldbeat::EventKind::Ended { id, outcome, .. } = event.kind {
                for call in self.calls.iter_mut().filter(|call| call.ids.get(axis) == Some(&id.0)) {
                    call.ended[axis] = Some(outcome);
                }
                match outcome {
                    Outcome::Done => self.tally.done += 1,
                    Outcome::Failed(_) => self.tally.failed += 1,
                    Outcome::Aborted(_) => self.tally.aborted += 1,
                }
            }
            self.tell(axis, || format!("{event}"));
            let judged = self.watches[axis].event(event.kind, fresh, truth, &feedback);
            judged.map_err(|breach| self.found(axis, breach))?;
        }
        let stopped = feedback.stopped.is_some();
        if stopped && !self.around[axis].stopped {
            self.tally.stops += 1;
            match feedback.stopped {
                Some(StopCause::OwnerLost) => self.tally.effects.count(Effect::OwnerLost),
                Some(StopCause::OtherMaster) => self.tally.effects.count(Effect::OtherMaster),
                _ => {}
            }
        }
        self.around[axis].stopped = stopped;
        let is_online = feedback.link == fieldbeat::axis::Link::Online;
        if !is_online {
            self.around[axis].bad = self.around[axis].bad.max(self.turn + 20);
        }
        let reached = self.turn > self.around[axis].bad;
        if !reached {
            self.watches[axis].excuse();
        }
        if self.story.is_some() && truth.powered && !self.watches[axis].rests(truth) {
            let way = if truth.homed { "homed" } else { "not homed" };
            self.tell(axis, || format!("at {:.3}, {:.3}/s, {way}", truth.position, truth.velocity));
        }
        let judged = self.watches[axis].turn(truth, &feedback, &self.slots, blind, reached);
        judged.map_err(|breach| self.found(axis, breach))
    }

    fn excuse(&mut self) {
        self.watches.iter_mut().for_each(Watch::excuse);
    }

    /// What goes on at an axis before a turn.
    fn go_on(&mut self, axis: usize) -> Judged {
        let turn = self.turn;
        if self.around[axis].unplugged.is_some_and(|until| turn >= until) {
            self.around[axis].unplugged = None;
            self.machine.plug(axis, true);
        }
        if self.around[axis].lossy.is_some_and(|until| turn >= until) {
            self.around[axis].lossy = None;
            self.machine.lose(axis, 0, 0);
        }
        match self.around[axis].level {
            Some((_, until)) if turn >= until => self.around[axis].level = None,
            Some((percent, _)) => self.set(axis, percent, 1)?,
            None => {}
        }
        Ok(())
    }

    /// Gives so many setpoints, the last one with this share.
    fn set(&mut self, axis: usize, percent: f64, count: u8) -> Judged {
        let scale = self.machine.scales[axis];
        let plan = &self.machine.plans[axis];
        let most = if scale.torques { plan.limits.torque.unwrap_or(100.0) } else { scale.velocity };
        let value = percent / 100.0 * most;
        for n in (0..count).rev() {
            let value = if n == 0 { value } else { value / 2.0 };
            let Some(handle) = self.axes[axis].as_mut() else { return Ok(()) };
            let taken = if scale.torques { handle.set_torque(value) } else { handle.set_velocity(value) };
            if n == 0 {
                let taken = taken.map_err(|error| error.to_string());
                let judged = self.watches[axis].set(self.slots.planned(), value, taken);
                judged.map_err(|breach| self.found(axis, breach))?;
            }
        }
        Ok(())
    }

    fn post(&mut self, axis: usize, command: Command) -> Judged {
        let truth = self.machine.truth(axis);
        let Some(handle) = self.axes[axis].as_mut() else { return Ok(()) };
        match handle.post(command) {
            Ok(CommandId(id)) => self.accepted(axis, id, command, truth),
            Err(AxisError::Refused { .. } | AxisError::Full { .. }) => Ok(()),
            Err(other) => panic!("{command:?}: {other}"),
        }
    }

    fn accepted(&mut self, axis: usize, id: u64, command: Command, truth: Truth) -> Judged {
        self.tell(axis, || format!("{command:?} is command {id}"));
        self.tally.accepted += 1;
        if command.is_urgent() {
            self.around[axis].urgent.push(id);
        }
        let accepted = self.watches[axis].accepted(id, command, truth);
        accepted.map_err(|breach| self.found(axis, breach))
    }

    /// One call of the group.
    fn together(&mut self, choices: &[Choice]) -> Judged {
        let members = self.machine.shape.members();
        let commands: Vec<Command> = (choices.iter().zip(&self.machine.scales).take(members))
            .map(|(choice, scale)| choice.command(scale))
            .collect();
        let posted: GroupCommand = match self.grouped(|group| group.post(&commands)) {
            Some(Ok(posted) | Err(GroupError::Partly { posted, .. })) => posted,
            None | Some(Err(_)) => return Ok(()),
        };
        let ids: Vec<u64> = posted.ids().iter().map(|id| id.0).collect();
        for (axis, command) in commands.into_iter().enumerate().filter(|(axis, _)| ids[*axis] != 0) {
            let truth = self.machine.truth(axis);
            self.accepted(axis, ids[axis], command, truth)?;
            self.watches[axis].is_part(ids[axis]);
        }
        if ids.iter().all(|id| *id != 0) {
            self.tally.effects.count(Effect::Called);
            self.calls.push(Call { ids, ended: vec![None; members] });
        }
        Ok(())
    }

    /// Setpoints of all members.
    fn set_together(&mut self, percent: f64) {
        let members = self.machine.shape.members();
        let scales = &self.machine.scales;
        let values: Vec<f64> =
            scales[..members].iter().map(|scale| percent / 100.0 * scale.velocity).collect();
        if let Some(Ok(())) = self.grouped(|group| group.set_velocities(&values)) {
            let slot = self.slots.planned();
            self.watches[..members].iter_mut().for_each(|watch| watch.set_together(slot));
            if !self.calls.is_empty() {
                self.tally.effects.count(Effect::SetTogether);
            }
        }
    }

    /// Row `n` of a parabola up and down: at most twice the mean speed.
    fn row(&self, axis: usize, from: f64, percent: i8, n: u32, count: u32, last: bool) -> Row {
        let scale = self.machine.scales[axis];
        let way = f64::from(percent) / 250.0 * scale.velocity * f64::from(count) * 1e-3;
        let share = f64::from(n) / f64::from(count);
        let position = from + way * share * share * (3.0 - 2.0 * share);
        let velocity = way / (f64::from(count) * 1e-3) * 6.0 * share * (1.0 - share);
        Row { position, velocity, last: last && n == count, ..Row::default() }
    }

    fn take(&mut self, step: &Step) -> Judged {
        let (axis, turn) = (usize::from(step.axis), self.turn);
        self.tell(axis, || format!("{:?}", step.op));
        let bad = |run: &mut Run, turns: u64| {
            let around = &mut run.around[axis];
            around.bad = around.bad.max(turn + turns + GRACE);
        };
        match &step.op {
            Op::Post(commands) => {
                for command in commands {
                    self.post(axis, command.command(&self.machine.scales[axis]))?;
                }
            }
            Op::Level { percent, turns } => {
                self.around[axis].level = Some((f64::from(*percent), turn + u64::from(*turns)));
            }
            Op::Burst { count, percent } => self.set(axis, f64::from(*percent), *count)?,
            Op::Rows { count, percent, last } => {
                let from = self.machine.sim.feedback(axis).status.demand;
                let count = u32::from(*count);
                for n in 1..=count {
                    let row = self.row(axis, from, *percent, n, count, *last);
                    let _ = self.axes[axis].as_mut().map(|axis| axis.push_row(row));
                }
            }
            Op::Together(choices) => self.together(choices)?,
            Op::LevelTogether { percent, turns } => {
                self.level = Some((f64::from(*percent), turn + u64::from(*turns)));
            }
            Op::RowsTogether { count, percent, last } => {
                let members = self.machine.shape.members();
                let from: Vec<f64> =
                    (0..members).map(|axis| self.machine.sim.feedback(axis).status.demand).collect();
                let count = u32::from(*count);
                for n in 1..=count {
                    let row = |axis: usize| self.row(axis, from[axis], *percent, n, count, *last);
                    let rows: Vec<Row> = (0..members).map(row).collect();
                    if let Some(Ok(())) = self.grouped(|group| group.push_rows(&rows)) {
                        self.tally.effects.count(Effect::RowsTogether);
                    }
                }
                self.together(&vec![Choice::Follow; members])?;
            }
            Op::Write(entries) => {
                let list = writes(self.machine.shape.kind);
                let is_free = !self.machine.truth(axis).powered || self.watches[axis].is_native();
                let entries: &[u8] = if is_free && !self.machine.shape.free_writes { &[] } else { entries };
                for entry in entries {
                    self.written = true;
                    if let Some((address, value)) = list.get(usize::from(*entry)) {
                        self.machine.write(axis, address, value);
                    }
                }
            }
            Op::Outputs(percent) => self.outputs(axis, *percent),
            Op::Late(slots) => {
                self.machine.skip((*slots).into());
                self.excuse();
            }
            Op::Overload { slots, turns } => self.overload = ((*slots).into(), turn + u64::from(*turns)),
            Op::Unplug(turns) => {
                self.machine.plug(axis, false);
                self.around[axis].unplugged = Some(turn + u64::from(*turns));
                bad(self, (*turns).into());
            }
            Op::Cut(turns) => {
                self.machine.cut(true);
                self.cut = Some(turn + u64::from(*turns));
                self.around.iter_mut().for_each(|around| {
                    around.bad = around.bad.max(turn + u64::from(*turns) + GRACE);
                });
            }
            Op::Lose { requests, replies } => {
                self.machine.lose(axis, (*requests).into(), (*replies).into());
                let turns = u64::from(requests + replies);
                self.around[axis].lossy = Some(turn + turns);
                bad(self, turns);
            }
            Op::Restart => {
                self.machine.restart(axis);
                bad(self, 0);
            }
            Op::OpenSto(ms) => self.machine.open_sto(axis, u64::from(*ms) * MS),
            Op::Fault => self.machine.provoke(axis),
            Op::RepeatRequest { motion, back, us } => {
                self.machine.repeat_request(axis, *motion, (*back).into(), (*us).into());
                if self.machine.shape.kind == Kind::Kollmorgen {
                    // A frame has the setpoints of all.
                    self.watches.iter_mut().for_each(Watch::pushed);
                }
            }
            Op::RepeatReply { back, us } => self.machine.repeat_reply(axis, (*back).into(), (*us).into()),
            Op::OldReply { which, us } => self.machine.old_reply(axis, (*which).into(), (*us).into()),
            Op::Suspend(ms) => {
                self.machine.suspend((*ms).into());
                self.watches.iter_mut().for_each(Watch::suspended);
            }
            Op::Die(ms) => {
                self.tally.effects.count(Effect::Died);
                self.replace_master((*ms).into());
            }
            Op::Stuck(ms) => {
                self.tally.effects.count(Effect::Stuck);
                let taken = self.machine.sim.wires().take(Taker::Watch);
                let ended = self.machine.sim.step() == Flow::End;
                let stopped: Vec<_> = (0..AXES).map(|axis| self.machine.sim.feedback(axis).stopped).collect();
                if !taken || !ended || stopped.contains(&None) {
                    let text = format!("taken {taken}, ended {ended}: {stopped:?}");
                    return Err(self.found(axis, Breach { rule: "stuck", text }));
                }
                self.replace_master((*ms).into());
            }
            Op::Drop => {
                if self.axes[axis].take().is_some() {
                    self.tally.effects.count(Effect::Dropped);
                    self.around[axis].native = Native::None;
                    self.around[axis].level = None;
                    self.watches[axis].dropped();
                }
            }
            Op::Foreign { which, us } => {
                self.tally.effects.count(Effect::Foreign);
                if let Some(cut) = self.machine.foreign(axis, (*which).into(), (*us).into()) {
                    let of_segment = self.machine.shape.kind == Kind::Kollmorgen;
                    self.tool |= of_segment;
                    let concerned = if of_segment { 0..AXES } else { axis..axis + 1 };
                    for other in concerned {
                        // By then it is seen, and stopped for.
                        let seen = if other == axis { cut + GRACE } else { GRACE };
                        self.around[other].bad = self.around[other].bad.max(turn + seen);
                        self.watches[other].disturbed(seen);
                    }
                }
            }
            Op::Operate { .. } => unreachable!("an application has these axes"),
            Op::Deaf(turns) => {
                let around = &mut self.around[axis];
                around.deaf = around.deaf.max(turn + u64::from(*turns));
            }
        }
        Ok(())
    }

    /// The process dies, and with it all that its application knew.
    fn replace_master(&mut self, ms: u64) {
        // They are of the master that died, and nobody reads what they have posted.
        self.axes.clear();
        self.machine.replace_master(ms);
        self.axes = (0..AXES).map(|axis| Some(self.machine.sim.take_axis(axis))).collect();
        self.calls.clear();
        (self.cut, self.level) = (None, None);
        for axis in 0..AXES {
            let around = &mut self.around[axis];
            (around.level, around.deaf, around.stopped, around.alone) = (None, 0, false, 0);
            around.bad = around.bad.max(self.turn + ms + GRACE);
            around.urgent.clear();
            self.watches[axis].master_died();
        }
        self.natives();
    }

    /// Native outputs, where there are some: a velocity, a torque, a set point, or the place where it is.
    fn outputs(&mut self, axis: usize, percent: i8) {
        let (count, speed) = (i64::from(percent), i32::from(percent));
        let taken = match &mut self.around[axis].native {
            Native::None => None,
            // Up to twice its limit, near the ends of its range.
            Native::LinMot(native) => {
                let target = if percent < 0 { 5.0 } else { 150.0 };
                let velocity = 4.0 * f64::from(percent.unsigned_abs().max(1));
                let to = Position::from_mm(target).ok().zip(Velocity::from_mm_per_s(velocity).ok());
                let ramp = Acceleration(400_000);
                let motion = to.map(|(to, velocity)| MotionCommand::vai_go_to(to, velocity, ramp, ramp));
                let output = linudp::NativeOutput { motion, ..linudp::NativeOutput::default() };
                let running = native.inputs().running;
                (native.write(output).is_ok() && running).then_some(Effect::NativeLinMot)
            }
            // Up to twice its limit.
            Native::Unidrive(native) => {
                let control = modbus::ControlWord::FORWARD;
                let running = native.inputs().running;
                let written = native.write(modbus::NativeOutput { control, reference: speed * 96 });
                (written.is_ok() && running).then_some(Effect::NativeUnidrive)
            }
            // Up to twice its limit; its range ends within it, and there its position limit is.
            Native::Moons(native) => {
                let outputs = ethernet_ip::Outputs {
                    command: ethernet_ip::command::MOVE_RELATIVE,
                    velocity: (speed.unsigned_abs() * 38).max(1),
                    acceleration: 960,
                    deceleration: 960,
                    distance: speed.signum() * 20_000,
                    ..ethernet_ip::Outputs::default()
                };
                let running = native.inputs().running;
                let written = native.write(ethernet_ip::NativeOutput { outputs });
                (written.is_ok() && running).then_some(Effect::NativeMoons)
            }
            Native::Kollmorgen(native) => {
                let (velocity, torque) = (count * 4_000, count * 5);
                let object = |index: u16| ethercat::Object::new(index, 0);
                let values = [(object(0x606B), velocity), (object(0x6074), torque)];
                let control = (object(0x6040), 0x0F);
                let running = native.inputs().running;
                let output = values.iter().find_map(|value| native.output(&[*value, control]));
                let written = output.is_some_and(|output| native.write(output).is_ok());
                (written && running).then_some(Effect::NativeKollmorgen)
            }
            Native::Lenze(native) => {
                // Up to twice its limit; run, by the words of DRIVECOM and of PROFIdrive.
                let mut output = profibus::NativeOutput { mask: 0b11, ..Default::default() };
                output.words[0] = if self.machine.shape.other { 0x047F } else { 0x007F };
                output.words[1] = (i16::from(percent) * 100) as u16;
                let running = native.inputs().running;
                (native.write(output).is_ok() && running).then_some(Effect::NativeLenze)
            }
        };
        if let Some(effect) = taken {
            self.tally.effects.count(effect);
        }
    }

    /// The wire is good, all is stopped, and every command has ended.
    fn settle(&mut self) -> Judged {
        self.overload = (0, 0);
        self.cut = self.cut.map(|_| 0);
        self.level = None;
        for axis in 0..AXES {
            let around = &mut self.around[axis];
            (around.deaf, around.level) = (0, None);
            around.unplugged = around.unplugged.map(|_| 0);
            around.lossy = around.lossy.map(|_| 0);
            // A stop that is under way has to end by itself.
            if self.watches[axis].is_to_move() {
                self.post(axis, Command::Stop { deceleration: None })?;
            }
        }
        for _ in 0..SETTLED {
            let rest = |axis: usize| self.watches[axis].rests(self.machine.truth(axis));
            let ended = self.watches.iter().all(|watch| watch.pending.is_empty());
            if ended && self.machine.online() && (0..AXES).all(rest) {
                break;
            }
            self.step()?;
        }
        if let Some((axis, text)) = (0..AXES).find_map(|axis| Some((axis, self.machine.misuse(axis)?))) {
            return Err(self.found(axis, Breach { rule: "misuse", text }));
        }
        let open = (0..AXES).find(|axis| !self.watches[*axis].pending.is_empty());
        match open {
            None => Ok(()),
            Some(axis) => {
                let text = format!("never ended: {:?}", self.watches[axis].pending);
                Err(self.found(axis, Breach { rule: "ends", text }))
            }
        }
    }

    /// All axes online, enabled and homed; false if one of them cannot be brought there.
    fn recover(&mut self) -> Result<bool, Found> {
        self.machine.calls.clear();
        // Nobody can make a dropped axis ready again.
        if self.axes.iter().any(Option::is_none) {
            return Ok(false);
        }
        for _ in 0..ATTEMPTS {
            // What a tool has done may show itself by then only: a watchdog ends the link.
            for _ in 0..UP {
                if self.machine.online() {
                    break;
                }
                self.step()?;
            }
            if !self.machine.online() {
                return Ok(false);
            }
            let mut ready = true;
            for axis in 0..AXES {
                if let Some(command) = self.way_back(axis) {
                    ready = false;
                    self.post(axis, command.command(&self.machine.scales[axis]))?;
                }
            }
            if ready {
                return Ok(true);
            }
            for _ in 0..2_000 {
                if self.watches.iter().all(|watch| watch.pending.is_empty()) {
                    break;
                }
                self.step()?;
            }
            // An end is reported a turn before its consequences; what a tool has lowered is read back first.
            for _ in 0..if self.tool { LOWERED } else { 1 } {
                self.step()?;
            }
        }
        Ok(false)
    }

    /// What an axis needs next to be ready.
    fn way_back(&self, axis: usize) -> Option<Choice> {
        let feedback = self.machine.sim.feedback(axis);
        let homes = self.machine.plans[axis].limits.position.is_some();
        match feedback.stopped {
            _ if feedback.status.fault != 0 => Some(Choice::ResetFault),
            Some(_) => Some(Choice::Reset),
            None if !feedback.is_operational() => Some(Choice::Enable),
            None if homes && !feedback.status.homed => Some(Choice::Home),
            None => None,
        }
    }
}
