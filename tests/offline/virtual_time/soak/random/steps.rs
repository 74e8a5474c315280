//! Machines, their patterns, and what happens to them, drawn by a seed.

use fastrand::Rng;
use fieldbeat::axis::Profile;
use fieldbeat::time::MS;
use fieldbeat_config::soak::Pattern;
use fieldbeat_config::soak::Swing;

use super::run::PERIOD_NS;
use crate::virtual_time::oracle::machine::{AXES, Kind, Shape};

/// What happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Op {
    /// The drive is disconnected for so many turns.
    Unplug(u16),
    Restart,
    /// The hardware enable is open for so many ms.
    OpenSto(u16),
    /// The drive reports a fault, or that its master was silent; or this, and again so many turns
    /// after it was reset.
    Fault,
    Silence,
    Relapse(u8),
    /// The host is late by so many slots.
    Late(u8),
    /// The computer sleeps for so many ms.
    Suspend(u16),
    /// Requests and replies are lost.
    Lose(u8),
    /// Another program repeats a motion command of before.
    Repeat(u8),
    /// The process is killed, and the next one starts so many ms later.
    Kill(u16),
    /// The test is ended, and goes on with another process so many ms later.
    End(u16),
}

/// One thing that happens, in this turn of the test.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Step {
    pub at: u64,
    pub axis: usize,
    pub op: Op,
}

/// A test.
#[derive(Clone, Debug)]
pub struct Sequence {
    pub shape: Shape,
    pub patterns: Vec<Pattern>,
    /// Another test ran before for so many turns, and was killed so many ms before this one.
    pub before: Option<(u64, u64)>,
    pub steps: Vec<Step>,
}

/// The pattern of an axis that can move.
pub fn pattern(random: &mut Rng, kind: Kind, index: usize) -> Pattern {
    let moves = |random: &mut Rng, low: f64, high: f64, velocity: f64, acceleration: f64| Pattern::Moves {
        targets: (0..3).map(|_| low + random.f64() * (high - low)).collect(),
        profile: Profile { velocity, acceleration, deceleration: acceleration },
        pause_ns: random.u64(0..100) * MS,
    };
    let swing = |centre, amplitude, period_s| Pattern::Sine(Swing { centre, amplitude, period_s });
    match kind.of(index) {
        Kind::LinMot if random.bool() => swing(60.0, 20.0, 1.5),
        Kind::LinMot => moves(random, 5.0, 150.0, 160.0, 4_000.0),
        Kind::Moons => moves(random, -2.0, 2.0, 4.0, 160.0),
        Kind::Kollmorgen if index == 2 => Pattern::Still("torques only".into()),
        Kind::Kollmorgen if index == 0 && random.bool() => swing(0.0, 1.0, 1.5),
        Kind::Kollmorgen if index == 0 => moves(random, -2.0, 2.0, 8.0, 300.0),
        _ => Pattern::Velocities { velocities: vec![4.0, -6.0, 1.0], hold_ns: random.u64(100..800) * MS },
    }
}

fn choice<T: Copy>(random: &mut Rng, among: &[T]) -> T {
    among[random.usize(..among.len())]
}

fn op(random: &mut Rng) -> Op {
    match random.u8(..32) {
        0..=4 => Op::Unplug(choice(random, &[2, 15, 50, 350])),
        5 | 6 => Op::Restart,
        7..=9 => Op::OpenSto(choice(random, &[5, 50, 500])),
        10..=12 => Op::Fault,
        13 => Op::Silence,
        20 => Op::Relapse(random.u8(..15)),
        14 | 15 => Op::Late(random.u8(1..16)),
        16 => Op::Suspend(choice(random, &[50, 500])),
        17 | 18 => Op::Lose(random.u8(1..8)),
        19 => Op::Repeat(random.u8(..6)),
        21..=28 => Op::Kill(choice(random, &[1, 100, 700, 1_500, 4_000])),
        _ => Op::End(choice(random, &[1, 100, 1_500])),
    }
}

/// What is likely while a process begins.
const EARLY: [Op; 6] = [Op::Fault, Op::Silence, Op::Relapse(5), Op::Unplug(15), Op::OpenSto(50), Op::Restart];

/// The test of a seed.
pub fn drawn(seed: u64) -> Sequence {
    let mut random = Rng::with_seed(seed);
    let random = &mut random;
    use Kind::{Kollmorgen, Lenze, LinMot, Mixed, Moons, Unidrive};
    // What brings a segment, or a wire, down costs it seconds of its machine time.
    let all = [Mixed, LinMot, Unidrive, Mixed, Moons, Mixed, Unidrive];
    let kind = match seed % 16 {
        7 => Kollmorgen,
        15 => Lenze,
        _ => choice(random, &all),
    };
    let group = choice(random, &[0, 0b011, 0b101, 0b110, 0b111, 0b111]);
    let held = if matches!(kind, Mixed | LinMot) && random.u8(..4) == 0 { 1 } else { 0 };
    let short = if random.u8(..6) == 0 { 0b111 } else { 0 };
    let shape = Shape { hold: random.bool(), group, held, short, period_ns: PERIOD_NS, ..Shape::of(kind) };
    let mut patterns: Vec<Pattern> = (0..AXES).map(|index| pattern(random, kind, index)).collect();
    if random.u8(..3) == 0 {
        patterns[random.usize(..AXES)] = Pattern::Still("move = false".into());
    }
    let before = (random.u8(..3) == 0).then(|| (random.u64(100..500), choice(random, &[10, 10, 700, 4_000])));
    let (mut at, mut was_killed) = (0, false);
    let steps = (0..random.usize(2..9)).map(|_| {
        // Often one thing right after the other, and something else while a process begins.
        let is_early = was_killed && random.bool();
        let longest = if is_early { 12 } else { choice(random, &[1, 5, 50, 200, 400]) };
        at += random.u64(..longest);
        let op = if is_early { choice(random, &EARLY) } else { op(random) };
        was_killed = matches!(op, Op::Kill(_) | Op::Silence | Op::Relapse(_));
        Step { at, axis: random.usize(..AXES), op }
    });
    let steps = steps.collect();
    Sequence { shape, patterns, before, steps }
}
