//! A machine that repeats a recorded run in virtual time.

use super::difference::Difference;
use super::reader::{LogEnd, Recorded, ReplayError, SharedEnd};
use fieldbeat_core::axis::{Axis, Event, Feedback, Observer};
use fieldbeat_core::bus::{Cycle, OpenError};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::engine::{Control, Engine, Flow};
use fieldbeat_core::cycle::ring::{Kept, RecordReader};
use fieldbeat_core::cycle::status::Status;
use fieldbeat_core::cycle::task::{Axes, Task};
use fieldbeat_core::inputs::replaying::Source;
use fieldbeat_core::inputs::{InputLog, Replaying};
use fieldbeat_core::logged::{ReplayCarriers, ReplayClock};
use fieldbeat_core::rt::Wires;
use fieldbeat_master::{Assembly, assemble};

/// The code of the in-loop task of a repeated run.
pub enum TaskOf {
    /// The recorded run had none.
    Nobody,
    /// The requests of the recorded run are made again.
    Log,
    /// This code runs, and what it requests is compared.
    Code(Task),
}

impl std::fmt::Debug for TaskOf {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            TaskOf::Nobody => "Nobody",
            TaskOf::Log => "Log",
            TaskOf::Code(_) => "Code",
        })
    }
}

/// A machine that repeats a recorded run, step by step: the same loop with the inputs of the recorded one, whose
/// telegrams are compared with the recorded ones.
///
/// It stands still between two steps. A test looks then at what the loop publishes: feedback, events, its numbers.
#[derive(Debug)]
pub struct Replay {
    engine: Engine<ReplayClock>,
    log: InputLog,
    plan: Plan,
    axes: Vec<Axis>,
    observers: Vec<Observer>,
    records: RecordReader,
    /// Events of all axes so far, in the order of their cycles, each with the index of its axis.
    pub events: Vec<(usize, Event)>,
    /// The cycle after the last one that was repeated.
    next: u64,
    until: Option<u64>,
    goes_on: bool,
    /// The orderly end is complete.
    has_ended: bool,
    end: SharedEnd,
    other_plan: Option<String>,
}

/// How a repeated run compares with the recorded one.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Verdict {
    /// The last cycle that was repeated; `None`: there was none.
    pub last: Option<u64>,
    /// Telegrams that were compared, and are the same.
    pub telegrams: u64,
    /// Their bytes.
    pub bytes: u64,
    /// The first difference of what leaves; `None`: up to that cycle the telegrams of both runs are equal.
    pub difference: Option<Difference>,
    /// The first cycle in which the repeated loop looks for other inputs than the recorded one. A loop that was changed
    /// may do that, and still send the same.
    pub other_inputs: Option<Difference>,
}

impl Verdict {
    /// Whether both runs are equal, what the loop looks for included.
    pub fn is_equal(&self) -> bool {
        self.difference.is_none() && self.other_inputs.is_none()
    }
}

impl Replay {
    /// The machine of `plan` over the log that `source` gives.
    #[doc(hidden)]
    pub fn over(plan: Plan, source: Source, task: TaskOf) -> Result<Replay, OpenError> {
        let log = InputLog::replaying(Replaying::new(source));
        let of_log = log.clone();
        let task: Option<Task> = match task {
            TaskOf::Nobody => None,
            TaskOf::Code(task) => Some(task),
            TaskOf::Log => Some(Box::new(move |_: &Cycle, axes: &mut Axes<'_>| {
                let Some(replaying) = of_log.as_replaying() else { return };
                while let Some(call) = replaying.peek_call() {
                    if !axes.repeat(call) {
                        replaying.call_refused();
                    }
                }
            })),
        };
        let carriers = ReplayCarriers::new(&log);
        let Assembly { mut engine, axes, records, .. } = assemble(
            &plan,
            ReplayClock::new(&log),
            &carriers,
            task,
            Control::default(),
            Wires::default(),
            Kept::default(),
        )?;
        engine.begin();
        let observers = axes.iter().map(Axis::observer).collect();
        Ok(Replay {
            engine,
            log,
            plan,
            axes,
            observers,
            records,
            events: Vec::new(),
            next: 0,
            until: None,
            goes_on: false,
            has_ended: false,
            end: SharedEnd::default(),
            other_plan: None,
        })
    }

    /// The machine that repeats the record at `path`, for a test: a record of another version is taken, as far as its
    /// layout is the present one, since the version under test is another one than that in the field.
    pub fn open(path: impl AsRef<std::path::Path>) -> Result<Replay, ReplayError> {
        Recorded::open(path)?.replay()
    }

    pub(super) fn of_file(self, end: SharedEnd, other_plan: Option<String>) -> Replay {
        Replay { end, other_plan, ..self }
    }

    /// The first value in which the plan differs from that of the recorded run, if it does: a default of another
    /// program, as a rule. It explains what differs from there on.
    pub fn other_plan(&self) -> Option<&str> {
        self.other_plan.as_deref()
    }

    /// How the log of the file ends, as far as it was read.
    pub fn log_end(&self) -> LogEnd {
        self.end.get()
    }

    /// The last cycle that is to be repeated; without it, the last one of the record.
    pub fn until(mut self, cycle: u64) -> Replay {
        self.until = Some(cycle);
        self
    }

    /// It goes on after the first difference. The drives of the record know nothing of it: they answer as they did.
    pub fn past_differences(mut self) -> Replay {
        self.goes_on = true;
        self
    }

    /// The machine.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Repeats the next cycle, or slots that were passed over. False if there is nothing more to repeat: at the end of
    /// the record, and [usually](Self::past_differences) after a difference.
    pub fn step(&mut self) -> bool {
        let Some(replaying) = self.log.as_replaying() else { return false };
        let is_over = !self.goes_on && replaying.difference().is_some();
        let is_far = self.until.is_some_and(|until| self.engine.slot() > until);
        if self.has_ended || is_over || is_far || replaying.is_over() {
            return false;
        }
        self.next = self.engine.slot() + 1;
        self.has_ended = self.engine.step() == Flow::End;
        // All slots that were passed over are repeated, too.
        self.next = self.next.max(self.engine.slot());
        // Nobody else takes them, and full queues would be another run.
        while self.records.pop().is_some() {}
        for (index, axis) in self.axes.iter_mut().enumerate() {
            while let Some(event) = axis.event() {
                self.events.push((index, event));
            }
        }
        true
    }

    /// Repeats cycles until `done` holds. False: it never held.
    pub fn run_until(&mut self, mut done: impl FnMut(&Replay) -> bool) -> bool {
        while !done(self) {
            if !self.step() {
                return false;
            }
        }
        true
    }

    /// Repeats what is left.
    pub fn run(&mut self) -> Verdict {
        while self.step() {}
        if let Some(replaying) = self.log.as_replaying() {
            let before = self.until.map_or(u64::MAX, |until| until.saturating_add(1));
            replaying.end(self.has_ended.then_some(before));
        }
        self.verdict()
    }

    /// How what was repeated so far compares.
    pub fn verdict(&self) -> Verdict {
        let replaying = self.log.as_replaying();
        let (telegrams, bytes) = replaying.map_or((0, 0), Replaying::compared);
        let in_words = |found| Difference::new(found, &self.plan);
        let difference = replaying.and_then(Replaying::difference).map(in_words);
        let other_inputs = replaying.and_then(Replaying::first_astray).map(in_words);
        Verdict { last: self.next.checked_sub(1), telegrams, bytes, difference, other_inputs }
    }

    /// The cycle that was repeated last; `None`: none yet.
    pub fn cycle(&self) -> Option<u64> {
        self.next.checked_sub(1)
    }

    /// The feedback of axis `index`, in the order of the plan.
    pub fn feedback(&self, index: usize) -> Feedback {
        self.observers[index].feedback()
    }

    /// The numbers of the loop so far.
    pub fn status(&self) -> &Status {
        self.engine.status()
    }
}
