//! The oracle: random sequences on every protocol, judged by one statement about the true state of each drive.
//!
//! A sequence is what an application queues, in pairs and triples, and what happens to it: setpoints that come late,
//! parameter writes, a host that is late, drives that restart, datagrams that are lost, or come again long after. Each
//! machine has three axes, each with its own sequence, at the same time. One seed is a machine and some rounds of
//! sequences; a failure prints its seed and the steps that are left when all others are taken away.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the runs, and how a failure is made short |
//! | `machine` | the machines, and their drives as they really are |
//! | `steps` | what may happen, and how it is drawn |
//! | `run` | a run of sequences |
//! | `judge` | the statement |
//! | `operators` | a run of sequences in which operators have the axes, and what is stated of them |
//!
//! | variable | what |
//! |---|---|
//! | those of [`campaign`] | which seeds |
//! | `ORACLE_KIND` | only machines of this protocol, by the names of [`Kind`] |
//! | `ORACLE_WITHOUT` | what is left out, by the names of [`Without`] |

mod judge;
pub mod machine;
mod operators;
pub mod run;
pub mod steps;

use std::env;

use fastrand::Rng;

use self::machine::{AXES, Kind, Machine, Shape};
use self::run::{Found, Run, Tally};
use self::steps::{Op, Round, Step, Without};
use super::campaign::{self, Judged};

/// Rounds of one seed.
const ROUNDS: usize = 12;
/// Operators are slow: a hold lasts 200 ms.
const OPERATED_ROUNDS: usize = 5;
/// Every so many machines are run once more, with requests that are built and do not leave: each one that does is built
/// anew then, and both runs are the same to the byte.
const PROPOSED_EVERY: u64 = 8;
/// Runs that the shortening of a failure may take.
const TRIES: usize = 600;

/// The machine of a seed, and its rounds.
pub fn drawn(seed: u64, without: Without) -> (Shape, Vec<Round>) {
    let only = env::var("ORACLE_KIND").ok();
    let named = only.and_then(|name| Kind::ALL.into_iter().find(|kind| format!("{kind:?}") == name));
    let kind = named.unwrap_or(Kind::ALL[(seed % 5) as usize]);
    let bits = seed / 5;
    let (hold, other) = (bits & 1 != 0, bits & 2 != 0);
    // Drives in turn exchange in different cycles, and are no group.
    let in_turn = kind == Kind::Lenze && other;
    let (group, alike, operated) = match bits >> 2 & 3 {
        1 if !in_turn => (0b111, true, false),
        2 if !in_turn => (0b011, false, false),
        3 => (0, false, true),
        _ => (0, false, false),
    };
    let shape =
        Shape { hold, other, group, alike, operated, free_writes: !without.free_writes, ..Shape::of(kind) };
    let scales = Machine::scales(shape);
    let mut random = Rng::with_seed(seed);
    let mut round = || match operated {
        true if random.bool() => steps::shell(&mut random, shape, &scales),
        true => steps::operated(&mut random, shape, &scales),
        false => steps::round(&mut random, shape, &scales, without),
    };
    let rounds = if operated { OPERATED_ROUNDS } else { ROUNDS };
    (shape, (0..rounds).map(|_| round()).collect())
}

/// A run by an application, or by operators.
fn run_of(shape: Shape, rounds: &[Round], story: bool) -> (Result<(), Found>, Tally, Option<String>) {
    if shape.operated {
        return operators::Run::rounds(shape, rounds, story);
    }
    Run::rounds(shape, rounds, story)
}

/// A run, with panics of the machine as failures.
fn rounds(shape: Shape, rounds: &[Round]) -> (Result<(), Found>, Tally) {
    let (judged, tally, _) = run_of(shape, rounds, false);
    (judged, tally)
}

/// The fewest steps that break the same rule, and what happened in them.
pub fn shortened(shape: Shape, all: &[Round], found: &Found) -> (Vec<Round>, Found) {
    let mut left = all[..=found.round.min(all.len() - 1)].to_vec();
    let mut best = found.clone();
    let mut tries = 0;
    let mut attempt = |candidate: &[Round], best: &mut Found| -> bool {
        tries += 1;
        if tries > TRIES {
            return false;
        }
        match rounds(shape, candidate).0 {
            Err(found) if found.rule == best.rule => {
                *best = found;
                true
            }
            _ => false,
        }
    };
    // The last round alone, the failing axis alone, then whatever can be left out.
    let alone = left[left.len() - 1..].to_vec();
    if left.len() > 1 && attempt(&alone, &mut best) {
        left = alone;
    }
    let of_axis = |round: &Round| -> Round {
        let concerns = |step: &&Step| usize::from(step.axis) == found.axis || step.op.is_of_all();
        round.iter().filter(concerns).cloned().collect()
    };
    let own: Vec<Round> = left.iter().map(of_axis).collect();
    if attempt(&own, &mut best) {
        left = own;
    }
    loop {
        let before = size(&left);
        let mut index = 0;
        while index < left.len() && left.len() > 1 {
            let mut fewer = left.clone();
            fewer.remove(index);
            if attempt(&fewer, &mut best) { left = fewer } else { index += 1 }
        }
        for round in 0..left.len() {
            let mut index = 0;
            while index < left[round].len() {
                let mut fewer = left.clone();
                fewer[round].remove(index);
                if attempt(&fewer, &mut best) { left = fewer } else { index += 1 }
            }
            for step in 0..left[round].len() {
                let mut index = 0;
                while let Op::Post(commands) = &left[round][step].op
                    && index < commands.len()
                    && commands.len() > 1
                {
                    let mut fewer = left.clone();
                    if let Op::Post(commands) = &mut fewer[round][step].op {
                        commands.remove(index);
                    }
                    if attempt(&fewer, &mut best) { left = fewer } else { index += 1 }
                }
            }
        }
        if size(&left) == before {
            return (left, best);
        }
    }
}

fn size(rounds: &[Round]) -> usize {
    let commands = |step: &Step| if let Op::Post(commands) = &step.op { commands.len() } else { 1 };
    rounds.len() + rounds.iter().flatten().map(commands).sum::<usize>()
}

/// The steps of some rounds break no rule; each step is its turn, its axis and what happens.
pub fn holds(shape: Shape, all: &[&[(u16, u8, Op)]]) {
    let step = |(at, axis, op): &(u16, u8, Op)| Step { at: *at, axis: *axis, op: op.clone() };
    let all: Vec<Round> = all.iter().map(|round| round.iter().map(step).collect()).collect();
    if let (Err(Found { rule, round, turn, axis, text }), _, story) = run_of(shape, &all, true) {
        let story = story.unwrap_or_default();
        panic!("{shape:?}: rule {rule:?}, axis {axis}, turn {turn} of round {round}: {text}\n{story}");
    }
}

/// A failure as a person reads it.
fn report(shape: Shape, all: &[Round], found: &Found) -> String {
    let (short, found) = shortened(shape, all, found);
    let (again, _, story) = run_of(shape, &short, true);
    let found = again.err().unwrap_or(found);
    let tail = |text: String| {
        let lines: Vec<&str> = text.lines().collect();
        lines[lines.len().saturating_sub(600)..].join("\n")
    };
    format!(
        "{shape:?}: rule {:?} is broken by axis {} in turn {} of round {}:\n{}\n\
         as a fixed test, for oracle_found.rs:\n{}\nwhat happened in it:\n{}",
        found.rule,
        found.axis,
        found.turn,
        found.round,
        found.text,
        shown(shape, &short),
        story.map(tail).unwrap_or_default(),
    )
}

/// Sequences as a test has them.
fn shown(shape: Shape, rounds: &[Round]) -> String {
    let step = |Step { at, axis, op }: &Step| format!("        ({at}, {axis}, {op:?}),\n");
    let round = |round: &Round| format!("    &[\n{}    ],\n", round.iter().map(step).collect::<String>());
    let rounds: String = rounds.iter().map(round).collect();
    let text = format!("holds({shape:?}, &[\n{rounds}]);");
    let as_written = [("kind: ", "kind: Kind::"), ("([", "(vec!["), ("Native(", "Native(NativeOwner::")];
    as_written.into_iter().fold(text, |text, (shown, written)| text.replace(shown, written))
}

/// What the machine of a seed does, judged.
fn judged(seed: u64) -> Judged<Tally> {
    let without = Without::parse(&env::var("ORACLE_WITHOUT").unwrap_or_default());
    let (shape, all) = drawn(seed, without);
    let (judged, tally) = rounds(shape, &all);
    let judged = judged.map_err(|found| report(shape, &all, &found));
    if judged.is_ok() && !shape.operated && seed.is_multiple_of(PROPOSED_EVERY) {
        let (_, proposing) = rounds(Shape { proposals: true, ..shape }, &all);
        if !tally.is_that_of(&proposing) {
            let why = format!(
                "{shape:?}: what is built and does not leave has an effect: {tally:?}, {proposing:?}"
            );
            return (tally, Err(why));
        }
    }
    (tally, judged)
}

#[test]
fn no_forbidden_motion_in_ten_thousand_sequences() {
    let tally = campaign::fixed("sequences", 10_000_u64.div_ceil((ROUNDS * AXES) as u64), judged);
    // Each kind of end came about.
    let Tally { sequences, accepted, done, failed, aborted, stops, effects, .. } = tally;
    if campaign::only().is_none() && env::var("ORACLE_KIND").is_err() {
        let least = sequences / 2;
        assert!([accepted, done, failed, aborted, stops].iter().all(|count| *count > least), "{tally:?}");
        // And each thing that may happen to a machine.
        assert_eq!(effects.missing(), [], "{tally:?}");
    }
}

#[test]
#[ignore = "new seeds: minutes, in a release build"]
fn no_forbidden_motion_in_sequences_of_new_seeds() {
    campaign::long("sequences", judged);
}
