//! A run that was recorded is repeated bit by bit, whatever happened in it; and a repeated run that differs says where.
//!
//! The runs are those of the oracle: random commands, parameter writes, native process data, faults and restarts.

mod differences;
mod field;

use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::Setup;
use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_replay::machine::TaskOf;
use fieldbeat_replay::{Replay, Verdict};

use super::oracle::drawn;
use super::oracle::machine::{Kind, plan};
use super::oracle::run::Run;
use super::oracle::steps::Without;

/// The inputs of one master after the other.
#[derive(Clone, Default)]
pub struct Log(Arc<Mutex<Vec<Master>>>);

struct Master {
    reader: LogReader,
    words: Vec<u64>,
}

impl Log {
    fn masters(&self) -> MutexGuard<'_, Vec<Master>> {
        self.0.lock().unwrap()
    }

    /// The machine of `setup`, with its inputs in this log.
    pub fn of(&self, setup: Setup) -> Setup {
        let log = self.clone();
        setup.with_log(move |begin| {
            log.masters().push(Master { reader: begin.reader, words: Vec::new() });
        })
    }

    /// Takes out what is there.
    pub fn drain(&self) {
        if let Some(Master { reader, words }) = self.masters().last_mut() {
            reader.take(words);
        }
    }

    /// The words of each master.
    pub fn words(&self) -> Vec<Vec<u64>> {
        let take = |master: &mut Master| {
            assert_eq!(master.reader.ended_at(), None, "the log was full");
            master.reader.take(&mut master.words);
            std::mem::take(&mut master.words)
        };
        self.masters().iter_mut().map(take).collect()
    }
}

/// A machine that repeats these words.
pub fn replay(plan: fieldbeat::Plan, words: Vec<u64>, task: TaskOf) -> Replay {
    let mut pieces = vec![words];
    Replay::over(plan, Box::new(move || pieces.pop()), task).unwrap()
}

pub fn verdict(plan: fieldbeat::Plan, words: Vec<u64>) -> Verdict {
    replay(plan, words, TaskOf::Nobody).run()
}

/// Random commands, parameter writes and faults on a machine of this kind, recorded and repeated.
fn repeats(kind: u64, seeds: std::ops::Range<u64>) {
    for seed in seeds.map(|seed| 5 * seed + kind) {
        let (shape, rounds) = drawn(seed, Without::default());
        let log = Log::default();
        let tally = Run::recorded(shape, &rounds[..4], &log);
        assert!(tally.sequences > 0);
        let mut telegrams = 0;
        for (master, words) in log.words().into_iter().enumerate() {
            if words.is_empty() {
                // It was replaced before its first cycle.
                continue;
            }
            let verdict = verdict(plan(shape), words);
            assert!(verdict.is_equal(), "seed {seed}, {shape:?}, master {master}: {verdict:?}");
            telegrams += verdict.telegrams;
        }
        assert!(telegrams > 500, "seed {seed}: {telegrams}");
        assert_eq!(kind == 0, shape.kind == Kind::LinMot);
    }
}

#[test]
fn runs_on_linudp_are_repeated() {
    repeats(0, 0..4);
}

#[test]
fn runs_on_modbus_are_repeated() {
    repeats(1, 0..4);
}

#[test]
fn runs_on_ethercat_are_repeated() {
    repeats(2, 0..4);
}

#[test]
fn runs_on_ethernet_ip_are_repeated() {
    repeats(3, 0..4);
}

#[test]
fn runs_on_profibus_are_repeated() {
    repeats(4, 0..4);
}
