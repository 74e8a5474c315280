//! A soak test: axes that move for days, checkpoints that survive whatever ends the program, and a verdict by named
//! criteria. It is stepped by whoever has the machine, so that it runs on real drives and in virtual time.
//!
//! | file | what |
//! |---|---|
//! | `wave` | the rows of a streamed sine |
//! | `pattern` | moves, velocities and streams that go on by themselves |
//! | `mover` | one axis: brought up, moved by its pattern, powered off |
//! | `progress` | what is known of the test so far, over all processes that ran it; the checkpoint |
//! | `samples` | memory and descriptors of the processes |
//! | `criteria` | what it has to keep to, and whether it does |
//! | `directory` | the directory of a test: checkpoints, and its report |
//!
//! Time is that of the machine: slots of its grid times the period. It stands still between two processes.

pub mod criteria;
pub mod directory;
pub mod mover;
pub mod pattern;
pub mod progress;
pub mod samples;
pub mod wave;

use self::mover::{Mover, Seen};
use self::progress::Progress;
use fieldbeat_config::soak::SoakPlan;
use fieldbeat_core::axis::Axis;
use fieldbeat_core::axis::SilenceFaults;

/// The axes of a soak test.
#[derive(Debug)]
pub struct Soak {
    movers: Vec<Mover>,
}

impl Soak {
    /// These axes, in the order of the plan, on a grid of this period.
    pub fn new(plan: &SoakPlan, axes: Vec<Axis>, period_ns: u64) -> Soak {
        let movers = axes.into_iter().zip(&plan.axes);
        Soak { movers: movers.map(|(axis, soak)| Mover::new(axis, &soak.pattern, period_ns)).collect() }
    }

    /// It goes on after a pause; `before` is the test up to there. A fault by which a drive reacted to the silence of
    /// its master, by these codes of each axis, is reset once before the axis moves. An axis that was given up stays as
    /// it is.
    pub fn after_pause(mut self, before: &Progress, silence_faults: Vec<SilenceFaults>) -> Soak {
        for (index, (mover, is_of_pause)) in self.movers.iter_mut().zip(silence_faults).enumerate() {
            match before.axes.get(index).and_then(|axis| axis.given_up.as_deref()) {
                None => mover.resume(is_of_pause),
                Some(why) => mover.stay(why),
            }
        }
        self
    }

    /// To be called some fifty times a second of machine time, which is `now`, ns. Returns what is worth a line.
    pub fn step(&mut self, now: u64) -> Vec<String> {
        let seen: Vec<_> = self.movers.iter().map(|mover| (mover.group(), mover.seen())).collect();
        let of_group = |group: Option<u16>| {
            let mates = seen.iter().filter(|(of, _)| of.is_some() && *of == group);
            mates.fold(Seen::GOOD, |all, (_, seen)| all.and(*seen))
        };
        let movers = self.movers.iter_mut();
        movers.filter_map(|mover| mover.step(now, of_group(mover.group()))).collect()
    }

    /// Begins the end: all axes stop and are powered off as [`step`](Soak::step) goes on.
    pub fn end(&mut self) {
        self.movers.iter_mut().for_each(Mover::end);
    }

    /// All axes have come to their end.
    pub fn has_ended(&self) -> bool {
        self.movers.iter().all(Mover::has_ended)
    }

    /// The number of axes that were given up in this process. A process that goes on has to know of each: a checkpoint
    /// is due when there are more of them.
    pub fn given_up(&self) -> usize {
        self.movers.iter().filter(|mover| mover.given_up().is_some()).count()
    }

    /// The axes.
    pub fn movers(&self) -> &[Mover] {
        &self.movers
    }
}
