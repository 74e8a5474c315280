//! Sequences: what an application, a wire, a drive and a host do to the axes of a machine.

use fastrand::Rng;
use fieldbeat::axis::{Command, Jog, Move, NativeOwner, Profile, Target};

use super::machine::{Kind, Scale, Shape};

/// A command, its numbers in per cent of what its axis can do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Choice {
    Enable,
    Disable,
    Home,
    To(i8),
    By(i8),
    Jog(i8),
    Velocity,
    Torque,
    /// Along this slope, per cent a second.
    TorqueAlong(f64),
    Follow,
    Stop,
    /// With this deceleration, units/s².
    StopAt(f64),
    QuickStop,
    Reset,
    ResetFault,
    Native(NativeOwner),
}

/// What an operator does. A client that has a jog holds it, in a rhythm of its own, and one that has none shows that it
/// is there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Deed {
    Take,
    Leave,
    /// Nothing comes from it for so many milliseconds.
    Silent(u16),
    /// It is there, and holds its jog no more.
    LetGo,
    Release,
    Stop,
    Jog {
        axis: u8,
        percent: i8,
    },
    Step {
        axis: u8,
        percent: i8,
    },
    Home(u8),
    Disable(u8),
    /// What the axis needs next to be ready.
    Ready(u8),
    /// It holds the jog before its own.
    Former,
    /// A request for which it has not read the last answer.
    OutOfTurn,
    /// It operates no more, and says so.
    HandBack,
    /// It is a process of the shell from here on, which gives this axis one command and ends. What happens to a client
    /// happens to it: it may leave sooner, and be silent.
    Once {
        axis: u8,
        once: Once,
    },
}

/// A command of the shell. A motion enables and homes first, as `--enable --home` do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Once {
    Enable,
    Disable,
    Home,
    /// At so many per cent of the largest speed: a slow one outlives whoever commanded it.
    Step {
        percent: i8,
        speed: u8,
    },
    Jog {
        percent: i8,
        ms: u16,
    },
    Stop,
    Reset,
}

/// What happens to one axis.
#[derive(Clone, Debug, PartialEq)]
pub enum Op {
    /// These commands are queued at once.
    Post(Vec<Choice>),
    /// A setpoint, per cent, given again in each of so many turns.
    Level {
        percent: i8,
        turns: u8,
    },
    /// So many setpoints in one turn; the newest one is this.
    Burst {
        count: u8,
        percent: i8,
    },
    /// Rows of a smooth way, the last one marked or not.
    Rows {
        count: u8,
        percent: i8,
        last: bool,
    },
    /// Writes of parameters, by their places in the protocol's list.
    Write(Vec<u8>),
    /// Outputs of the native mode, per cent.
    Outputs(i8),
    /// These commands, one for each member of the group, are queued as one call. It concerns all axes, as do the next
    /// two: a set of setpoints given again in each of so many turns, and rows.
    Together(Vec<Choice>),
    LevelTogether {
        percent: i8,
        turns: u8,
    },
    RowsTogether {
        count: u8,
        percent: i8,
        last: bool,
    },
    /// The host is late once, by so many slots. It concerns all axes, and so does the next one.
    Late(u8),
    /// Before each of so many turns so many slots are passed over.
    Overload {
        slots: u8,
        turns: u8,
    },
    /// The drive is disconnected for so many turns.
    Unplug(u8),
    /// The adapter of a serial wire is unplugged for so many turns. It concerns all axes.
    Cut(u16),
    /// The next requests and replies are lost.
    Lose {
        requests: u8,
        replies: u8,
    },
    Restart,
    /// The hardware enable is open for so many milliseconds.
    OpenSto(u8),
    /// The drive reports a fault.
    Fault,
    /// A request of long ago comes to the drive once more; `motion`: of those with a motion command.
    RepeatRequest {
        motion: bool,
        back: u8,
        us: u16,
    },
    /// A reply of long ago comes to the master once more.
    RepeatReply {
        back: u8,
        us: u16,
    },
    /// A reply of any time before comes to the master, in the shape of the one that it waits for next.
    OldReply {
        which: u16,
        us: u16,
    },
    /// The application reads no events for so many turns.
    Deaf(u8),
    /// The computer sleeps for so many milliseconds. It concerns all axes, and so does the next one.
    Suspend(u8),
    /// The process dies in motion, and another one starts so many milliseconds later.
    Die(u8),
    /// The loop does not return, until its wires are taken from it; another master starts so many milliseconds later.
    Stuck(u8),
    /// The application drops the axis.
    Drop,
    /// Another sender, or a tool on a segment, says this, by a number.
    Foreign {
        which: u8,
        us: u16,
    },
    /// What one of two operators does.
    Operate {
        client: u8,
        deed: Deed,
    },
}

impl Op {
    /// It happens to all axes.
    pub fn is_of_all(&self) -> bool {
        matches!(
            self,
            Op::Late(_)
                | Op::Overload { .. }
                | Op::Cut(_)
                | Op::Suspend(_)
                | Op::Die(_)
                | Op::Stuck(_)
                | Op::Together(_)
                | Op::LevelTogether { .. }
                | Op::RowsTogether { .. }
                | Op::Operate { .. }
        )
    }
}

/// One thing that happens, so many turns after the begin of its sequence.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    pub at: u16,
    pub axis: u8,
    pub op: Op,
}

/// Sequences of all axes at the same time, from axes that are ready.
pub type Round = Vec<Step>;

impl Choice {
    /// Its command, for an axis of this scale.
    pub fn command(self, scale: &Scale) -> Command {
        let Scale { velocity, acceleration, .. } = *scale;
        let profile = Profile { velocity: 0.9 * velocity, acceleration, deceleration: acceleration };
        // A tenth of a second at full speed.
        let way = |percent: i8| f64::from(percent) / 100.0 * velocity / 10.0;
        match self {
            Choice::Enable => Command::Enable,
            Choice::Disable => Command::Disable,
            Choice::Home => Command::Home,
            Choice::To(percent) => Command::Move(Move { target: Target::Absolute(way(percent)), profile }),
            Choice::By(percent) => Command::Move(Move { target: Target::Relative(way(percent)), profile }),
            Choice::Jog(percent) => {
                Command::Jog(Jog { velocity: f64::from(percent) / 100.0 * velocity, acceleration })
            }
            Choice::Velocity => Command::Velocity { acceleration },
            Choice::Torque => Command::Torque { slope: 10_000.0 },
            Choice::TorqueAlong(slope) => Command::Torque { slope },
            Choice::Follow => Command::Follow,
            Choice::Stop => Command::Stop { deceleration: None },
            Choice::StopAt(deceleration) => Command::Stop { deceleration: Some(deceleration) },
            Choice::QuickStop => Command::QuickStop,
            Choice::Reset => Command::Reset,
            Choice::ResetFault => Command::ResetFault,
            Choice::Native(owner) => Command::Native(owner),
        }
    }
}

/// Parameters that an application might write, wisely or not: address and value.
pub fn writes(kind: Kind) -> &'static [(&'static str, &'static str)] {
    match kind {
        Kind::Mixed => &[],
        Kind::LinMot => &[
            // Run mode: motion commands, table, one that refuses motions; a variable; the predefined profile.
            ("0x1450", "1"),
            ("0x1450", "3"),
            ("0x1450", "2"),
            ("0x1E72", "7"),
            ("0x14BE", "1000"),
            ("0x14C0", "100000"),
        ],
        Kind::Unidrive => &[
            // Preset reference 1, control word, its enable; the added reference and its selector; drive enable; run
            // forward of the terminals; bipolar; reference and preset selector; stop mode; a ramp.
            ("01.021", "600.0"),
            ("06.042", "387"),
            ("06.043", "0"),
            ("06.043", "1"),
            ("03.022", "600.0"),
            ("03.023", "1"),
            ("06.015", "0"),
            ("06.030", "1"),
            ("01.010", "1"),
            ("01.014", "0"),
            ("01.015", "2"),
            ("06.001", "0"),
            ("10.038", "40"),
        ],
        Kind::Moons => &[
            // Velocity and ramps of the next move; a jog and a move for the buffer; an output; in position; reset;
            // stop.
            ("VE", "32000"),
            ("DE", "1"),
            ("JL", "1"),
            ("SCL:CJ", "0"),
            ("SCL:FL", "0"),
            ("output:1", "1"),
            ("PD", "10"),
            ("alarm-reset", "0"),
            ("stop", "0"),
        ],
        Kind::Kollmorgen => &[
            // Modes; control word; target velocity, position, torque; speed and ramp of profiles.
            ("0x6060:0", "3"),
            ("0x6060:0", "1"),
            ("0x6060:0", "4"),
            ("0x6060:0", "6"),
            ("0x6040:0", "15"),
            ("0x6040:0", "31"),
            ("0x60FF:0", "30000000"),
            ("0x60FF:0", "-3000000"),
            ("0x607A:0", "100000000"),
            ("0x6071:0", "500"),
            ("0x6081:0", "30000000"),
            ("0x6083:0", "20000"),
        ],
        Kind::Lenze => &[
            // No saving; a fixed speed; a reset of faults.
            ("C0003", "0"),
            ("C0039/1", "100"),
            ("C0043", "0"),
        ],
    }
}

/// Kinds of events that a run leaves out, to look at the others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Without {
    pub writes: bool,
    /// Those that the master does not refuse.
    pub free_writes: bool,
    pub overload: bool,
    pub requests: bool,
    /// Those without a motion command.
    pub control_requests: bool,
    pub replies: bool,
    pub slow_stops: bool,
    pub deaf: bool,
    pub homes: bool,
    pub foreign: bool,
    pub groups: bool,
    pub outputs: bool,
}

impl Without {
    /// By names in a text, such as `writes,deaf`.
    pub fn parse(text: &str) -> Without {
        let has = |name: &str| text.split(',').any(|word| word.trim() == name);
        Without {
            writes: has("writes"),
            free_writes: has("free_writes"),
            overload: has("overload"),
            requests: has("requests"),
            control_requests: has("control_requests"),
            replies: has("replies"),
            slow_stops: has("slow_stops"),
            deaf: has("deaf"),
            homes: has("homes"),
            foreign: has("foreign"),
            groups: has("groups"),
            outputs: has("outputs"),
        }
    }

    fn leaves(self, op: &Op) -> bool {
        match op {
            Op::Write(_) => !self.writes,
            Op::Late(_) | Op::Overload { .. } => !self.overload,
            Op::RepeatRequest { motion, .. } => !self.requests && (*motion || !self.control_requests),
            Op::RepeatReply { .. } | Op::OldReply { .. } => !self.replies,
            Op::Foreign { .. } => !self.foreign,
            Op::Together(_) | Op::LevelTogether { .. } | Op::RowsTogether { .. } => !self.groups,
            Op::Outputs(_) => !self.outputs,
            Op::Deaf(_) | Op::Burst { .. } => !self.deaf,
            Op::Post(commands) => commands.iter().all(|command| match command {
                Choice::StopAt(_) => !self.slow_stops,
                Choice::Home => !self.homes,
                _ => true,
            }),
            _ => true,
        }
    }
}

fn percent(random: &mut Rng) -> i8 {
    *random.choice(&[0, 5, 20, 50, 80, 100, -5, -30, -60, -100]).unwrap_or(&0)
}

/// A motion that the axis can do, mostly.
fn motion(random: &mut Rng, scale: &Scale) -> Choice {
    let any = random.u8(..16) == 0;
    match random.u8(..8) {
        0 | 1 if scale.positions || any => Choice::To(percent(random)),
        2 if scale.positions || any => Choice::By(percent(random)),
        3 if scale.positions || any => Choice::Follow,
        4 if scale.torques || any => Choice::Torque,
        5 | 6 if scale.velocities || any => Choice::Jog(percent(random)),
        7 if random.u8(..4) == 0 => {
            Choice::Native(if random.bool() { NativeOwner::Master } else { NativeOwner::Application })
        }
        7 if scale.torques => Choice::TorqueAlong(2_000.0),
        _ if scale.torques => Choice::Torque,
        _ => Choice::Velocity,
    }
}

fn command(random: &mut Rng, scale: &Scale) -> Choice {
    match random.u8(..24) {
        0 | 1 => Choice::Enable,
        2 => Choice::Disable,
        3 | 4 if scale.homes => Choice::Home,
        5..=7 => Choice::Stop,
        8 => Choice::StopAt(*random.choice(&[1e-9, 1e-3, 1.0, 1e4, 1e9]).unwrap_or(&1.0)),
        9 => Choice::QuickStop,
        10 => Choice::Reset,
        11 => Choice::ResetFault,
        _ => motion(random, scale),
    }
}

fn op(random: &mut Rng, shape: Shape, scales: &[Scale], axis: usize) -> Op {
    let scale = &scales[axis];
    // What brings a segment down costs it seconds of its machine time.
    let rare = shape.kind == Kind::Kollmorgen && random.u8(..8) != 0;
    let repeats = shape.kind != Kind::Unidrive;
    match random.u8(..64) {
        0..=11 => Op::Level { percent: percent(random), turns: random.u8(5..150) },
        12 => Op::Burst { count: random.u8(1..100), percent: percent(random) },
        13..=16 => Op::Rows { count: random.u8(10..80), percent: percent(random), last: random.u8(..4) > 0 },
        17..=22 => {
            let all = writes(shape.kind).len() as u8;
            Op::Write((0..random.u8(1..=3)).map(|_| random.u8(..all)).collect())
        }
        23 => Op::Outputs(percent(random)),
        24 => Op::Late(random.u8(1..14)),
        25 if !rare => Op::Overload { slots: random.u8(1..10), turns: random.u8(5..60) },
        26 if shape.kind == Kind::Lenze && random.bool() => Op::Cut(random.u16(20..1_000)),
        26 if !rare => Op::Unplug(random.u8(1..60)),
        27 => Op::Lose { requests: random.u8(..4), replies: random.u8(..4) },
        28 if !rare && random.u8(..4) == 0 => Op::Restart,
        29 => Op::OpenSto(random.u8(1..30)),
        30 => Op::Fault,
        31..=35 if repeats => Op::RepeatRequest {
            motion: random.u8(..4) > 0,
            back: *random.choice(&[0, 0, 1, 1, 2, 3, 5, 10, 30, 60]).unwrap_or(&0),
            us: random.u16(..2_000),
        },
        36..=40 if repeats => Op::RepeatReply { back: random.u8(1..12), us: random.u16(..2_000) },
        41 => Op::Deaf(random.u8(10..200)),
        42 if !rare && random.u8(..2) == 0 => Op::Suspend(random.u8(20..)),
        42 if !rare => Op::Die(random.u8(1..)),
        43..=46 if shape.members() > 0 => Op::Together(together(random, scales)),
        47 | 48 if shape.members() > 0 => {
            Op::LevelTogether { percent: percent(random), turns: random.u8(5..150) }
        }
        49 if shape.members() > 0 => {
            Op::RowsTogether { count: random.u8(10..80), percent: percent(random), last: random.bool() }
        }
        50 | 51 if !rare => Op::Foreign { which: random.u8(..), us: random.u16(..2_000) },
        52 if !rare && random.u8(..4) == 0 => Op::Drop,
        52 if !rare && random.u8(..4) == 0 => Op::Stuck(random.u8(1..)),
        53..=56 if matches!(shape.kind, Kind::LinMot | Kind::Mixed) => {
            Op::OldReply { which: random.u16(..), us: random.u16(..100) }
        }
        _ => Op::Post((0..random.u8(1..=3)).map(|_| command(random, scale)).collect()),
    }
}

/// A command for each of the axes, the same one or a motion that the axis can do.
fn together(random: &mut Rng, scales: &[Scale]) -> Vec<Choice> {
    use Choice::{Disable, Enable, Follow, Home, QuickStop, Reset, Stop, Velocity};
    let all = [Stop, Enable, Home, QuickStop, Reset, Disable, Follow, Velocity, Velocity, Velocity];
    match random.u8(..3) {
        0 => vec![all[random.usize(..all.len())]; scales.len()],
        1 => scales.iter().map(|scale| if scale.torques { Choice::Torque } else { Velocity }).collect(),
        _ => scales.iter().map(|scale| motion(random, scale)).collect(),
    }
}

/// What may come while nothing moves.
fn quiet(random: &mut Rng, shape: Shape) -> Op {
    match shape.kind {
        Kind::LinMot | Kind::Moons => {
            Op::RepeatRequest { motion: true, back: random.u8(..6), us: random.u16(..2_000) }
        }
        kind => {
            let all = writes(kind).len() as u8;
            Op::Write((0..3).map(|_| random.u8(..all)).collect())
        }
    }
}

/// What two operators do, and what happens to the axes meanwhile.
pub fn operated(random: &mut Rng, shape: Shape, scales: &[Scale]) -> Round {
    let (mut round, mut at) = (Round::new(), 0);
    let count = scales.len() as u8;
    // Who operates, mostly: the first client begins.
    let (mut operator, mut jogs) = (0, false);
    for _ in 0..random.u8(3..10) {
        let axis = random.u8(..count);
        let scale = &scales[usize::from(axis)];
        let client = if random.u8(..6) == 0 { 1 - operator } else { operator };
        let deed = match random.u8(..32) {
            0..=7 if jogs => Deed::Release,
            8..=10 if jogs => Deed::LetGo,
            11..=13 => Deed::Silent(random.u16(100..1_300)),
            14 | 15 => Deed::Leave,
            16 => Deed::Stop,
            17 => Deed::Former,
            18 => Deed::OutOfTurn,
            19 => Deed::Disable(axis),
            20 => Deed::Ready(axis),
            21 if scale.homes => Deed::Home(axis),
            22..=24 if scale.positions && !jogs => Deed::Step { axis, percent: percent(random) },
            25 => Deed::Take,
            _ => Deed::Jog { axis, percent: percent(random) },
        };
        jogs = matches!(deed, Deed::Jog { .. }) && !jogs || jogs && matches!(deed, Deed::Former | Deed::Take);
        let rare = shape.kind == Kind::Kollmorgen && random.u8(..8) != 0;
        let op = match random.u8(..16) {
            0 if !rare => Op::Unplug(random.u8(1..60)),
            1 => Op::Lose { requests: random.u8(..4), replies: random.u8(..4) },
            2 => Op::OpenSto(random.u8(1..30)),
            3 => Op::Fault,
            4 => Op::Late(random.u8(1..14)),
            5 => Op::Deaf(random.u8(10..)),
            _ => Op::Operate { client, deed },
        };
        let hands_over = matches!(op, Op::Operate { deed: Deed::Leave, client } if client == operator);
        round.push(Step { at, axis, op });
        let longest = *random.choice(&[1, 80, 250, 400]).unwrap_or(&1);
        at += random.u16(..longest);
        if hands_over {
            // The other one takes the axes, as soon as it may.
            operator = 1 - operator;
            for _ in 0..3 {
                at += 100;
                round.push(Step { at, axis, op: Op::Operate { client: operator, deed: Deed::Take } });
            }
            round.push(Step { at, axis, op: Op::Operate { client: operator, deed: Deed::Ready(axis) } });
        }
    }
    round
}

/// Commands of the shell, one after the other and sometimes at the same time, and all that ends their processes and
/// their master.
pub fn shell(random: &mut Rng, shape: Shape, scales: &[Scale]) -> Round {
    let (mut round, mut at) = (Round::new(), 0);
    let count = scales.len() as u8;
    for _ in 0..random.u8(4..12) {
        let axis = random.u8(..count);
        let scale = &scales[usize::from(axis)];
        let client = u8::from(random.u8(..6) == 0);
        let once = match random.u8(..16) {
            0 | 1 => Once::Enable,
            2 => Once::Disable,
            3 if scale.homes => Once::Home,
            4..=8 if scale.positions => {
                Once::Step { percent: percent(random), speed: *random.choice(&[5, 15, 90]).unwrap_or(&5) }
            }
            9 | 10 => Once::Stop,
            11 | 12 => Once::Reset,
            _ => Once::Jog { percent: percent(random), ms: random.u16(20..600) },
        };
        // A segment takes thousands of turns to come back.
        let rare = shape.kind == Kind::Kollmorgen && random.u8(..8) != 0;
        let deed = |deed| Op::Operate { client, deed };
        let op = match random.u8(..24) {
            0 if !rare => Op::Die(random.u8(1..)),
            1 if !rare => Op::Unplug(random.u8(1..60)),
            2 => Op::Lose { requests: random.u8(..4), replies: random.u8(..4) },
            3 => Op::Fault,
            4 => Op::Late(random.u8(1..14)),
            5 => Op::Deaf(random.u8(10..)),
            // It is killed, or held for a while.
            6..=8 => deed(Deed::Leave),
            9 | 10 => deed(Deed::Silent(random.u16(100..2_000))),
            11 | 12 => deed(Deed::HandBack),
            _ => deed(Deed::Once { axis, once }),
        };
        round.push(Step { at, axis, op });
        let longest = *random.choice(&[1, 60, 300, 900]).unwrap_or(&1);
        at += random.u16(..longest);
    }
    round
}

/// A round of sequences, one for each axis. What is `without` was drawn all the same, and then left out: the others are
/// the same.
pub fn round(random: &mut Rng, shape: Shape, scales: &[Scale], without: Without) -> Round {
    let mut round = Round::new();
    for (axis, scale) in scales.iter().enumerate() {
        let mut at = 0;
        // It begins with a motion.
        let mut first: Vec<_> = (0..random.u8(0..2)).map(|_| command(random, scale)).collect();
        let native = random.u8(..8) == 0;
        first.push(match native {
            true => {
                Choice::Native(if random.bool() { NativeOwner::Master } else { NativeOwner::Application })
            }
            false => motion(random, scale),
        });
        let first = match random.u8(..3) {
            0 if axis == 0 && !native && shape.members() > 0 => Op::Together(together(random, scales)),
            _ => Op::Post(first),
        };
        let mut rest: Vec<Op> = (0..random.u8(1..8)).map(|_| op(random, shape, scales, axis)).collect();
        // A native mode, and a group, want something to follow.
        match &first {
            Op::Together(_) => rest.insert(0, Op::LevelTogether { percent: percent(random), turns: 150 }),
            _ if native => rest.splice(0..0, [0; 2].map(|_| Op::Outputs(percent(random)))).for_each(drop),
            _ => {}
        }
        for op in [first].into_iter().chain(rest) {
            if without.leaves(&op) {
                round.push(Step { at, axis: axis as u8, op });
            }
            // Until the native mode runs.
            if native && at == 0 {
                at = random.u16(10..80);
            }
            // Often one thing right after the other.
            let longest = *random.choice(&[1, 4, 15, 60]).unwrap_or(&1);
            at += random.u16(..longest);
        }
        // And sometimes, after all has come to rest, what should move nothing.
        if random.u8(..4) == 0 {
            at += random.u16(100..200);
            let op = quiet(random, shape);
            if without.leaves(&op) {
                round.push(Step { at, axis: axis as u8, op });
            }
        }
    }
    round.sort_by_key(|step| step.at);
    round
}
