//! A run of sequences on one machine, judged in every turn.

use std::fmt::Write as _;

use fieldbeat::axis::{AxisError, Command, Outcome, Row};
use fieldbeat::bus::{ethercat, profibus};
use fieldbeat::time::MS;

use super::judge::{Breach, GRACE, Slots, Watch};
use super::machine::{AXES, Kind, Machine, Shape};
use super::steps::{Choice, Op, Round, Step, writes};
use crate::virtual_time::replay::Log;

/// Turns after the last step of a round in which what it began goes on.
const TAIL: u64 = 60;
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
}

impl Tally {
    pub fn add(&mut self, other: Tally) {
        self.sequences += other.sequences;
        self.turns += other.turns;
        self.machines += other.machines;
        self.accepted += other.accepted;
        self.done += other.done;
        self.failed += other.failed;
        self.aborted += other.aborted;
        self.stops += other.stops;
    }
}

/// What goes on at an axis over several turns.
#[derive(Default)]
struct Around {
    /// The setpoint that is given anew, and until which turn.
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
}

/// The native process data of an axis, as far as they are written here.
#[derive(Default)]
enum Native {
    #[default]
    None,
    Kollmorgen(Box<ethercat::Native>),
    Lenze(Box<profibus::Native>),
}

impl Native {
    fn of(machine: &mut Machine, axis: usize) -> Native {
        let axis = machine.sim.axis(axis);
        match axis.native().map(Native::Kollmorgen) {
            Some(native) => native,
            None => axis.native().map_or(Native::None, Native::Lenze),
        }
    }
}

pub struct Run {
    machine: Machine,
    watches: Vec<Watch>,
    around: Vec<Around>,
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
        let machine = Machine::new(shape, log);
        let watches = (0..AXES).map(|axis| Watch::new(machine.scales[axis], &machine.plans[axis])).collect();
        let mut run = Run {
            machine,
            watches,
            around: (0..AXES).map(|_| Around::default()).collect(),
            slots: Slots::default(),
            overload: (0, 0),
            cut: None,
            turn: 0,
            begun: 0,
            round: 0,
            tally: Tally { machines: 1, ..Tally::default() },
            story: None,
        };
        for axis in 0..AXES {
            run.around[axis].native = Native::of(&mut run.machine, axis);
        }
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
                    tally.add(run.tally);
                    return (Err(found), tally, run.story);
                }
                Ok(true) => {}
                // It cannot be made ready again: what was written, or a fault, stays.
                Ok(false) => {
                    tally.add(run.tally);
                    let before = run.story.take();
                    match Run::new(shape, false, None) {
                        Ok(fresh) => run = Run { story: before, ..fresh },
                        Err(found) => return (Err(found), tally, None),
                    }
                }
            }
        }
        tally.add(run.tally);
        (Ok(()), tally, run.story)
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
        while self.turn - self.begun <= last + TAIL || self.around.iter().any(|around| around.level.is_some())
        {
            while let Some(step) = steps.next_if(|step| u64::from(step.at) <= self.turn - self.begun) {
                self.take(step)?;
            }
            self.step()?;
        }
        self.settle()?;
        self.recover()
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
        Ok(())
    }

    fn judge(&mut self, axis: usize) -> Judged {
        let truth = self.machine.truth(axis);
        let feedback = self.machine.sim.feedback(axis);
        let blind = self.turn <= self.around[axis].deaf;
        while !blind && let Some(event) = self.machine.sim.axis(axis).event() {
            let fresh = event.cycle + 1 >= feedback.cycle;
            if let fieldbeat::EventKind::Ended { outcome, .. } = event.kind {
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
        self.tally.stops += u64::from(stopped && !std::mem::replace(&mut self.around[axis].stopped, stopped));
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
            let handle = self.machine.sim.axis(axis);
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
        match self.machine.post(axis, command) {
            Ok(id) => {
                self.tell(axis, || format!("{command:?} is command {id}"));
                self.tally.accepted += 1;
                let accepted = self.watches[axis].accepted(id, command, truth);
                accepted.map_err(|breach| self.found(axis, breach))
            }
            Err(AxisError::Refused { .. } | AxisError::Full { .. }) => Ok(()),
            Err(other) => panic!("{command:?}: {other}"),
        }
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
                // A parabola up and down: at most twice the mean speed.
                let scale = self.machine.scales[axis];
                let from = self.machine.sim.feedback(axis).status.demand;
                let count = u32::from(*count);
                let way = f64::from(*percent) / 250.0 * scale.velocity * f64::from(count) * 1e-3;
                for n in 1..=count {
                    let share = f64::from(n) / f64::from(count);
                    let position = from + way * share * share * (3.0 - 2.0 * share);
                    let velocity = way / (f64::from(count) * 1e-3) * 6.0 * share * (1.0 - share);
                    let row = Row { position, velocity, last: *last && n == count, ..Row::default() };
                    let _ = self.machine.sim.axis(axis).push_row(row);
                }
            }
            Op::Write(entries) => {
                let list = writes(self.machine.shape.kind);
                let is_free = !self.machine.truth(axis).powered || self.watches[axis].is_native();
                let entries: &[u8] = if is_free && !self.machine.shape.free_writes { &[] } else { entries };
                for entry in entries {
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
            Op::Inhibit(ms) => self.machine.inhibit(axis, u64::from(*ms) * MS),
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
            Op::Die(ms) => self.replace_master((*ms).into()),
            Op::Deaf(turns) => {
                let around = &mut self.around[axis];
                around.deaf = around.deaf.max(turn + u64::from(*turns));
            }
        }
        Ok(())
    }

    /// The process dies, and with it all that its application knew.
    fn replace_master(&mut self, ms: u64) {
        self.machine.replace_master(ms);
        self.cut = None;
        for axis in 0..AXES {
            let around = &mut self.around[axis];
            (around.level, around.deaf, around.stopped) = (None, 0, false);
            around.bad = around.bad.max(self.turn + ms + GRACE);
            around.native = Native::of(&mut self.machine, axis);
            self.watches[axis].master_died();
        }
    }

    /// Native outputs, where there are some: a velocity, a torque, a set point, or the place where it is.
    fn outputs(&mut self, axis: usize, percent: i8) {
        match &mut self.around[axis].native {
            Native::None => {}
            Native::Kollmorgen(native) => {
                let velocity = i64::from(percent) * 4_000;
                let torque = i64::from(percent) * 5;
                let object = |index: u16| ethercat::Object::new(index, 0);
                let values = [(object(0x606B), velocity), (object(0x6074), torque)];
                let control = (object(0x6040), 0x0F);
                if let Some(output) = values.iter().find_map(|value| native.output(&[*value, control])) {
                    let _ = native.write(output);
                }
            }
            Native::Lenze(native) => {
                // Up to twice its limit; run, by the words of DRIVECOM and of PROFIdrive.
                let mut output = profibus::NativeOutput { mask: 0b11, ..Default::default() };
                output.words[0] = if self.machine.shape.other { 0x047F } else { 0x007F };
                output.words[1] = (i16::from(percent) * 100) as u16;
                let _ = native.write(output);
            }
        }
    }

    /// The wire is good, all is stopped, and every command has ended.
    fn settle(&mut self) -> Judged {
        self.overload = (0, 0);
        self.cut = self.cut.map(|_| 0);
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
        for _ in 0..UP {
            if self.machine.online() {
                break;
            }
            self.step()?;
        }
        for _ in 0..ATTEMPTS {
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
            // An end is reported a turn before its consequences.
            self.step()?;
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
