//! A test under way, over its processes.

use std::ops::AddAssign;

use fastrand::Rng;
use fieldbeat::Flow;
use fieldbeat::axis::Link;
use fieldbeat::time::{MS, S};
use fieldbeat_config::soak::{AxisSoak, Pattern, SoakPlan};
use fieldbeat_soak::Soak;
use fieldbeat_soak::criteria::judge;
use fieldbeat_soak::progress::{AxisProgress, Progress};

use super::guard::{Breach, Guard};
use super::steps::{Op, Sequence, Step, pattern};
use crate::virtual_time::oracle::machine::{AXES, Kind, Machine};
use crate::virtual_time::soak::archive;

/// Of the machines.
pub const PERIOD_NS: u64 = 4 * MS;
/// Between two looks at the axes, and between two checkpoints, turns.
const LOOK: u64 = 20 * MS / PERIOD_NS;
const CHECKPOINT: u64 = S / PERIOD_NS;
/// After the wire was bad: until the link is judged good and a stop has got through, turns.
const GRACE: u64 = 60;
/// Another program's command may move an axis for so many turns.
const PUSH: u64 = 200;
/// The soak test, and then the master, come to their ends within so many turns: on good wires, or on any.
const CALMLY_ENDS: u64 = 2 * S / PERIOD_NS;
const ENDS: u64 = 45 * S / PERIOD_NS;
const SHUTS_DOWN: u64 = 10 * S / PERIOD_NS;

/// A broken rule.
#[derive(Clone, Debug)]
pub struct Found {
    pub rule: &'static str,
    pub text: String,
}

/// What a run did.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    pub sequences: u64,
    pub turns: u64,
    pub processes: u64,
    /// Stops for a reason that no pause excuses, axes given up, and those that stayed so.
    pub stops: u64,
    pub given_up: u64,
    pub stayed: u64,
    /// Faults of pauses that were reset, and those that came again then.
    pub resets: u64,
    pub relapses: u64,
    /// Moves, velocities and swings, and how many of them were in a process that went on.
    pub cycles: u64,
    pub later: u64,
}

impl AddAssign for Tally {
    fn add_assign(&mut self, other: Tally) {
        self.sequences += other.sequences;
        self.turns += other.turns;
        self.processes += other.processes;
        self.stops += other.stops;
        self.given_up += other.given_up;
        self.stayed += other.stayed;
        self.resets += other.resets;
        self.relapses += other.relapses;
        self.cycles += other.cycles;
        self.later += other.later;
    }
}

/// A test under way.
pub struct Run {
    machine: Machine,
    plan: SoakPlan,
    soak: Soak,
    /// The test before this process.
    progress: Progress,
    /// The last checkpoint, and the axes that were given up by then.
    saved: (Progress, Vec<bool>),
    given_up: usize,
    is_resumed: bool,
    guards: Vec<Guard>,
    /// The wire of each axis is bad until then, or plugged in again then; and so another program may move it.
    bad: Vec<u64>,
    unplugged: Vec<Option<u64>>,
    pushed: Vec<u64>,
    /// Its hardware enable is open until that turn: a drive may follow the commands of a dead master behind that.
    disabled: Vec<u64>,
    /// Its drive reports once more that its master was silent, so many turns after a fault of it was reset.
    relapses: Vec<Option<u8>>,
    turn: u64,
    /// The next kill.
    kill: Option<u64>,
    began: u64,
    /// The test ends, and goes on so many ms later: since that turn; and so does the master.
    ending: Option<(u64, u16)>,
    shutting_down: Option<u64>,
    pub tally: Tally,
    pub story: Vec<String>,
}

pub type Judged = Result<(), Found>;

fn soak_plan(machine: &Machine, patterns: &[Pattern]) -> SoakPlan {
    let axis = |(plan, pattern): (&fieldbeat::axis::AxisPlan, &Pattern)| AxisSoak {
        name: plan.name.clone(),
        pattern: pattern.clone(),
        following_error: None,
    };
    SoakPlan { axes: machine.plans.iter().zip(patterns).map(axis).collect(), ..SoakPlan::default() }
}

fn soak(machine: &mut Machine, plan: &SoakPlan) -> Soak {
    let axes = (0..AXES).map(|index| machine.sim.take_axis(index)).collect();
    Soak::new(plan, axes, PERIOD_NS)
}

impl Run {
    pub fn new(sequence: &Sequence) -> Run {
        let Sequence { shape, patterns, before, .. } = sequence;
        let mut machine = Machine::new(*shape, None);
        if let Some((turns, ms)) = *before {
            // It moves all axes that can move.
            let random = &mut Rng::with_seed(0);
            let all: Vec<Pattern> = (0..AXES).map(|index| pattern(random, shape.kind, index)).collect();
            let plan = soak_plan(&machine, &all);
            let mut soak = soak(&mut machine, &plan);
            for turn in 0..turns {
                machine.step();
                if turn % LOOK == 0 {
                    soak.step(turn * PERIOD_NS);
                }
            }
            machine.replace_master(ms);
        }
        let plan = soak_plan(&machine, patterns);
        let progress = Progress::new(String::new(), 3_600 * S);
        let silence = machine.sim.plan().silence_faults();
        let guards = (0..AXES).map(|axis| {
            let is_to_move = !matches!(patterns[axis], Pattern::Still(_));
            let range = machine.plans[axis].limits.position;
            Guard::new(is_to_move, machine.scales[axis], range, silence[axis])
        });
        let mut run = Run {
            guards: guards.collect(),
            soak: soak(&mut machine, &plan),
            machine,
            plan,
            saved: (progress.clone(), vec![false; AXES]),
            progress,
            given_up: 0,
            is_resumed: false,
            bad: vec![GRACE; AXES],
            unplugged: vec![None; AXES],
            pushed: vec![0; AXES],
            disabled: vec![0; AXES],
            relapses: vec![None; AXES],
            turn: 0,
            kill: None,
            began: 0,
            ending: None,
            shutting_down: None,
            tally: Tally { sequences: 1, ..Tally::default() },
            story: Vec::new(),
        };
        run.begin();
        run
    }

    fn tell(&mut self, what: impl Into<String>) {
        self.story.push(format!("{:5} {}", self.turn, what.into()));
    }

    /// A process begins with what was saved.
    fn begin(&mut self) {
        self.progress.begin();
        (self.began, self.given_up) = (self.turn, 0);
        self.tally.processes += 1;
        for axis in 0..AXES {
            let truth = self.machine.truth(axis);
            self.guards[axis].begin(self.is_resumed, self.saved.1[axis], truth);
            if self.turn < self.disabled[axis] {
                self.guards[axis].lend();
            }
            self.tally.stayed += u64::from(self.saved.1[axis]);
        }
        for axis in 0..AXES {
            if self.saved.0.axes.get(axis).is_some_and(AxisProgress::was_stopped) {
                self.bar_group_of(axis);
            }
        }
    }

    /// The next process goes on with the last checkpoint.
    fn resume(&mut self, ms: u16) -> Judged {
        self.line_of_each()?;
        let cycles: u64 = self.soak.movers().iter().map(|mover| mover.cycles()).sum();
        self.tally.cycles += cycles;
        self.tally.later += if self.is_resumed { cycles } else { 0 };
        let written = serde_json::to_string(&self.saved.0).unwrap();
        self.progress = serde_json::from_str(&written).unwrap();
        self.machine.replace_master(ms.into());
        self.soak = soak(&mut self.machine, &self.plan);
        let silence = self.machine.sim.plan().silence_faults();
        let fresh = std::mem::replace(&mut self.soak, Soak::new(&SoakPlan::default(), Vec::new(), PERIOD_NS));
        self.soak = fresh.after_pause(&self.progress, silence);
        (self.is_resumed, self.ending, self.shutting_down) = (true, None, None);
        self.bad.iter_mut().for_each(|bad| *bad = (*bad).max(self.turn + GRACE));
        self.begin();
        Ok(())
    }

    /// It is time for a checkpoint. Only those are made that a process may go on with.
    fn is_due(&self) -> bool {
        let is_last = self.kill.is_some_and(|kill| kill < self.turn + CHECKPOINT);
        is_last && (self.turn - self.began) % CHECKPOINT < LOOK
    }

    fn checkpoint(&mut self) {
        let progress = self.progress.with(&archive(&self.machine.sim), &self.soak);
        self.given_up = self.soak.given_up();
        self.saved = (progress, self.guards.iter().map(Guard::is_given_up).collect());
    }

    fn found(&self, axis: usize, (rule, text): Breach) -> Found {
        Found { rule, text: format!("axis {axis}, turn {}: {text}", self.turn) }
    }

    /// One turn of the loop, and what the program does after it.
    fn step(&mut self) -> Judged {
        for axis in 0..AXES {
            if self.unplugged[axis].take_if(|until| self.turn >= *until).is_some() {
                self.machine.plug(axis, true);
            }
        }
        let flow = self.machine.sim.step();
        self.turn += 1;
        self.tally.turns += 1;
        for axis in 0..AXES {
            self.judge(axis)?;
            self.relapse(axis);
        }
        if flow == Flow::End {
            return self.ended();
        }
        if self.shutting_down.is_some_and(|since| self.turn > since + SHUTS_DOWN) {
            return Err(self.found(0, ("end", "the master does not end".into())));
        }
        if (self.turn - self.began).is_multiple_of(LOOK) {
            self.look()?;
        }
        Ok(())
    }

    fn relapse(&mut self, axis: usize) {
        if !self.guards[axis].has_reset() {
            return;
        }
        match &mut self.relapses[axis] {
            None => {}
            Some(turns @ 1..) => *turns -= 1,
            due => {
                *due = None;
                self.machine.silence(axis);
                self.tally.relapses += 1;
                self.tell(format!("axis {axis}: the silence again"));
            }
        }
    }

    /// It, and its stop group.
    fn bar_group_of(&mut self, axis: usize) {
        let group = self.machine.plans[axis].stop.group;
        for mate in 0..AXES {
            if mate == axis || group.is_some() && self.machine.plans[mate].stop.group == group {
                self.guards[mate].bar();
            }
        }
    }

    fn judge(&mut self, axis: usize) -> Judged {
        let truth = self.machine.truth(axis);
        let feedback = self.machine.sim.feedback(axis);
        if feedback.link != Link::Online {
            self.bad[axis] = self.bad[axis].max(self.turn + GRACE);
        }
        let reached = self.turn > self.bad[axis] && self.unplugged[axis].is_none();
        if let Some((cause, is_tolerated)) = self.guards[axis].stops(&feedback) {
            self.tell(format!("axis {axis} is stopped: {cause}"));
            if !is_tolerated {
                self.tally.stops += 1;
                self.bar_group_of(axis);
            }
        }
        let pushed = self.turn <= self.pushed[axis];
        let judged = self.guards[axis].turn(truth, &feedback, reached, pushed);
        judged.map_err(|breach| self.found(axis, breach))
    }

    /// The program looks after its axes.
    fn look(&mut self) -> Judged {
        let now = self.machine.sim.status().planned * PERIOD_NS;
        // The program looks no longer once its axes have ended.
        if self.shutting_down.is_some() {
            return Ok(());
        }
        for line in self.soak.step(now) {
            self.tell(&line);
            let name = |axis: &usize| line.starts_with(&format!("axis {}: ", self.plan.axes[*axis].name));
            let axis = (0..AXES).find(name).expect("a line names its axis");
            if line.contains("moves no longer") {
                self.guards[axis].bar();
                self.guards[axis].lines += 1;
                self.tally.given_up += 1;
            } else {
                self.tally.resets += 1;
            }
        }
        self.line_of_each()?;
        match self.ending {
            Some(_) if self.soak.has_ended() => {
                self.tell("the soak test has ended");
                self.at_rest(true)?;
                self.machine.sim.stop();
                self.shutting_down = Some(self.turn);
            }
            Some((since, _)) if self.turn > since + self.ends_within(since) => {
                return Err(self.found(0, ("end", "the soak test does not end".into())));
            }
            None if self.soak.given_up() > self.given_up || self.is_due() => self.checkpoint(),
            _ => {}
        }
        Ok(())
    }

    /// The soak test, that ends since then, takes no longer.
    fn ends_within(&self, since: u64) -> u64 {
        let is_calm = self.bad.iter().all(|bad| *bad < since);
        if is_calm { CALMLY_ENDS } else { ENDS }
    }

    fn line_of_each(&self) -> Judged {
        for (axis, (guard, mover)) in self.guards.iter().zip(self.soak.movers()).enumerate() {
            let given_up = mover.given_up().is_some() || guard.was_given_up();
            let begins = self.turn < self.began + LOOK;
            if !begins {
                guard.named(given_up, self.ending.is_some()).map_err(|breach| self.found(axis, breach))?;
            }
        }
        Ok(())
    }

    /// All axes that can be reached have come to their end; `own`: those that this process moved, by the soak test.
    fn at_rest(&self, own: bool) -> Judged {
        for axis in 0..AXES {
            let is_reached =
                self.turn > self.bad[axis].max(self.pushed[axis]) && self.unplugged[axis].is_none();
            if is_reached {
                let is_held = self.machine.shape.held >> axis & 1 != 0;
                let judged = self.guards[axis].ended(self.machine.truth(axis), is_held, own);
                judged.map_err(|breach| self.found(axis, breach))?;
            }
        }
        Ok(())
    }

    /// The master has ended.
    fn ended(&mut self) -> Judged {
        let Some((_, ms)) = self.ending else {
            return Err(self.found(0, ("end", "the master ended by itself".into())));
        };
        self.tell("the master has ended");
        self.at_rest(false)?;
        self.checkpoint();
        let failed: Vec<_> =
            judge(&self.plan, &self.saved.0, true).into_iter().filter(|one| !one.passed).collect();
        for (axis, (known, plan)) in self.saved.0.axes.iter().zip(&self.plan.axes).enumerate() {
            let names = |one: &&fieldbeat_soak::criteria::Judged| {
                matches!(one.criterion, "given_up" | "stops" | "faults" | "lost_links")
                    && one.note.contains(&plan.name)
            };
            if known.given_up.is_some() && !failed.iter().any(|one| names(&one)) {
                let text = format!("{known:?} fails no criterion: {failed:?}");
                return Err(self.found(axis, ("verdict", text)));
            }
        }
        self.resume(ms)
    }

    fn take(&mut self, step: Step) -> Judged {
        let Step { axis, op, .. } = step;
        self.tell(format!("axis {axis}: {op:?}"));
        let turn = self.turn;
        let bad = |run: &mut Run, turns: u64| run.bad[axis] = run.bad[axis].max(turn + turns + GRACE);
        match op {
            Op::Unplug(turns) => {
                self.machine.plug(axis, false);
                self.unplugged[axis] = Some(turn + u64::from(turns));
                bad(self, turns.into());
            }
            Op::Restart => {
                self.machine.restart(axis);
                self.guards[axis].restarted();
                bad(self, 0);
            }
            Op::OpenSto(ms) => {
                let open_ns = u64::from(ms) * MS;
                self.machine.open_sto(axis, open_ns);
                self.disabled[axis] = turn + open_ns / PERIOD_NS;
                self.guards[axis].lend();
            }
            Op::Fault => self.machine.provoke(axis),
            Op::Silence => self.machine.silence(axis),
            Op::Relapse(turns) => {
                self.machine.silence(axis);
                self.relapses[axis] = Some(turns);
            }
            Op::Late(slots) => self.machine.skip(slots.into()),
            Op::Suspend(ms) => self.machine.suspend(ms.into()),
            Op::Lose(count) => {
                self.machine.lose(axis, count.into(), count.into());
                bad(self, 2 * u64::from(count));
                if self.machine.shape.kind == Kind::Kollmorgen {
                    self.unplugged[axis] = Some(turn + u64::from(count));
                }
            }
            Op::Repeat(back) => {
                if self.guards[axis].is_to_move {
                    self.machine.repeat_request(axis, true, back.into(), 0);
                    self.guards[axis].pushed();
                    self.pushed[axis] = turn + PUSH;
                }
            }
            Op::Kill(ms) => self.resume(ms)?,
            Op::End(ms) => {
                if self.ending.is_none() {
                    self.soak.end();
                    self.ending = Some((turn, ms));
                }
            }
        }
        Ok(())
    }

    pub fn run(&mut self, steps: &[Step]) -> Judged {
        for (index, step) in steps.iter().enumerate() {
            let kill = steps[index..].iter().find(|step| matches!(step.op, Op::Kill(_)));
            self.kill = kill.map(|step| step.at);
            while self.turn < step.at {
                self.step()?;
            }
            self.take(*step)?;
        }
        self.kill = None;
        // It goes on for a while, and ends.
        for _ in 0..S / PERIOD_NS {
            self.step()?;
        }
        let processes = self.tally.processes + u64::from(self.ending.is_some());
        while self.tally.processes < processes + 1 {
            if self.ending.is_none() {
                self.take(Step { at: self.turn, axis: 0, op: Op::End(1) })?;
            }
            self.step()?;
        }
        Ok(())
    }
}
