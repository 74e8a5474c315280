//! Random soak tests on every protocol: whatever befalls drives, wires, host and processes, nothing moves that must
//! not. [`guard`] has the rules of an axis.
//!
//! A seed is a machine of three axes, their patterns, and what happens to them, over several processes of one test. A
//! failure prints its seed and the steps that are left when all others are taken away.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the runs, and how a failure is made short |
//! | `steps` | what may happen, and how it is drawn |
//! | `run` | a test under way |
//! | `guard` | the rules of an axis |

mod guard;
mod run;
mod steps;

use fieldbeat::time::MS;
use fieldbeat_config::soak::Pattern;

use self::run::{Found, Judged, Run, Tally};
use self::steps::{Op, Sequence, Step, drawn};
use crate::virtual_time::campaign;
use crate::virtual_time::oracle::machine::{AXES, Kind, Shape};

/// Runs that the shortening of a failure may take.
const TRIES: usize = 200;

fn judged(sequence: &Sequence, steps: &[Step]) -> (Judged, Tally, Vec<String>) {
    let mut run = Run::new(sequence);
    let judged = run.run(steps);
    (judged, run.tally, run.story)
}

/// A failure as a person reads it: with the fewest steps that break the same rule.
fn report(sequence: &Sequence, found: Found) -> String {
    let (mut steps, mut best) = (sequence.steps.clone(), found);
    let mut tries = 0;
    let mut index = 0;
    while index < steps.len() && tries < TRIES {
        let mut fewer = steps.clone();
        fewer.remove(index);
        tries += 1;
        match judged(sequence, &fewer).0 {
            Err(found) if found.rule == best.rule => (steps, best, index) = (fewer, found, 0),
            _ => index += 1,
        }
    }
    let story = judged(sequence, &steps).2;
    let shown: String = steps.iter().map(|step| format!("    {step:?}\n")).collect();
    let Sequence { shape, patterns, before, .. } = sequence;
    format!(
        "rule {:?} is broken: {}\n{shape:?}, before: {before:?}\n{patterns:?}\n\
         the shortest sequence:\n{shown}what happened in it:\n{}",
        best.rule,
        best.text,
        story.join("\n"),
    )
}

fn of_seed(seed: u64) -> campaign::Judged<Tally> {
    let sequence = drawn(seed);
    let (judged, tally, _) = judged(&sequence, &sequence.steps);
    (tally, judged.map_err(|found| report(&sequence, found)))
}

/// The process before was killed right behind its enable: the drive switches on under the next one.
#[test]
fn a_drive_that_was_found_while_it_switched_on_is_held_by_its_stop_until_the_master_ends() {
    for seed in [175_248_401_013, 175_248_404_818, 175_248_404_840] {
        of_seed(seed).1.unwrap_or_else(|why| panic!("{seed}: {why}"));
    }
}

/// The STO opens at a drive that is found running: all others of its group were stopped already, for the tolerated
/// reason.
#[test]
fn a_group_is_not_moved_again_of_which_a_drive_was_stopped_after_it_was_found_running() {
    let shape = Shape { group: 0b111, period_ns: run::PERIOD_NS, ..Shape::of(Kind::Unidrive) };
    let patterns = [191, 493, 725]
        .map(|hold_ms| Pattern::Velocities { velocities: vec![4.0, -6.0, 1.0], hold_ns: hold_ms * MS });
    let step = |at, op| Step { at, axis: 1, op };
    let steps = vec![step(104, Op::Kill(1)), step(107, Op::OpenSto(50))];
    let sequence = Sequence { shape, patterns: patterns.into(), before: None, steps };
    if let (Err(found), _, story) = judged(&sequence, &sequence.steps) {
        panic!("{found:?}\n{}", story.join("\n"));
    }
}

/// Its hardware enable comes back while it is only read: three reports of its motion stop it, each of which takes a
/// Unidrive six requests then.
#[test]
fn a_drive_that_runs_again_by_the_control_word_of_a_dead_master_is_stopped() {
    let shape = Shape { period_ns: run::PERIOD_NS, ..Shape::of(Kind::Mixed) };
    let patterns = vec![Pattern::Still("move = false".into()); AXES];
    // Before a master has found it running, and in each part of a round of its requests.
    for at in 6..12 {
        let step = |axis, op| Step { at, axis, op };
        let steps = vec![step(0, Op::Kill(1)), step(1, Op::OpenSto(500))];
        let sequence = Sequence { shape, patterns: patterns.clone(), before: Some((324, 10)), steps };
        let (result, _, story) = judged(&sequence, &sequence.steps);
        let story = story.join("\n");
        assert!(result.is_ok(), "{at}: {result:?}\n{story}");
        assert!(story.contains("axis 1 is stopped: found running"), "{at}: {story}");
    }
}

/// What the pause caused comes again before the axis is enabled: something else causes it.
#[test]
fn a_fault_of_a_pause_that_comes_again_is_not_reset_again() {
    let shape = Shape { period_ns: run::PERIOD_NS, ..Shape::of(Kind::Unidrive) };
    let moving = Pattern::Velocities { velocities: vec![4.0, -6.0, 1.0], hold_ns: 300 * MS };
    let step = |at, op| Step { at, axis: 1, op };
    // From the reset until the axis is enabled.
    for turns in 0..15 {
        let steps = vec![step(104, Op::Kill(1)), step(105, Op::Relapse(turns))];
        let sequence = Sequence { shape, patterns: vec![moving.clone(); AXES], before: None, steps };
        let (result, tally, story) = judged(&sequence, &sequence.steps);
        let story = story.join("\n");
        assert!(result.is_ok(), "{result:?}\n{story}");
        assert_eq!((tally.resets, tally.relapses, tally.given_up), (1, 1, 1), "{story}");
    }
}

#[test]
fn no_forbidden_motion_in_random_soak_tests() {
    let tally = campaign::fixed("soak", 24, of_seed);
    if campaign::only().is_none() {
        // Each kind of event came about.
        let Tally { stops, given_up, stayed, resets, later, .. } = tally;
        assert!([stops, given_up, stayed, resets, later].iter().all(|count| *count > 1), "{tally:?}");
    }
}

#[test]
#[ignore = "new seeds: minutes, in a release build"]
fn no_forbidden_motion_in_soak_tests_of_new_seeds() {
    campaign::long("soak", of_seed);
}
