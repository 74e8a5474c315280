//! Groups of three axes on every wire, with links that break, drives that fall silent, fault, restart or lose their
//! STO, late hosts, and resets and enables at random instants; judged by the true state of the motors.
//!
//! | variable | what |
//! |---|---|
//! | those of [`campaign`] | which seeds; of one alone, what happened is printed |

use std::collections::BTreeMap;
use std::ops::AddAssign;

use fastrand::Rng;
use fieldbeat::axis::{
    Abort, AxisError, Command, EventKind, Group, GroupCommand, GroupError, Link, Move, Outcome, Target,
};
use fieldbeat_replay::machine::TaskOf;

use super::campaign::{self, Judged};
use super::oracle::machine::{AXES, Kind, Machine, Scale, Shape, plan};
use super::replay::{Log, replay};

/// A member that moves while another one is stopped or off comes to rest within so many turns in which its drive can be
/// reached: the loop's reaction, then the ramp, the quick stop and power off, of 50 ms each.
const MOST_ALONE: u32 = 40 + 3 * 50 + 20;
/// The wire of a drive has been good for so many turns: its link is up again, and its stop has got through.
const GRACE: u64 = 100;
/// Every command ends within so many turns: its time-out is 1.5 s.
const MOST_TURNS: u64 = 4_000;
const ROUNDS: u32 = 4;

/// What came about.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    enabled: u32,
    moved: u32,
    stops: u32,
    separated: u32,
}

impl AddAssign for Tally {
    fn add_assign(&mut self, other: Tally) {
        self.enabled += other.enabled;
        self.moved += other.moved;
        self.stops += other.stops;
        self.separated += other.separated;
    }
}

struct Run {
    m: Machine,
    group: Group,
    random: Rng,
    turn: u64,
    ends: Vec<BTreeMap<u64, Outcome>>,
    /// Disturbed until this turn, and since which one its wire is good.
    disturbed: [Option<(u64, Disturbance)>; AXES],
    good_since: [u64; AXES],
    alone: [u32; AXES],
    latched: u32,
    tally: Tally,
    story: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Disturbance {
    Nothing,
    Silent,
    Inhibited,
    Fault,
    Restart,
    LateHost,
    /// The application stops one member alone.
    OwnStop,
}

impl Run {
    fn new(kind: Kind, seed: u64, log: Option<Log>) -> Run {
        let shape = Shape { hold: !seed.is_multiple_of(2), group: 0b111, alike: true, ..Shape::of(kind) };
        let mut m = Machine::new(shape, log);
        let online = (0..30_000).any(|_| {
            m.step();
            m.online()
        });
        assert!(online, "{kind:?}");
        let axes: Vec<_> = (0..AXES).map(|index| m.sim.take_axis(index)).collect();
        Run {
            m,
            group: Group::new(axes).unwrap(),
            random: Rng::with_seed(seed),
            turn: 0,
            ends: vec![BTreeMap::new(); AXES],
            disturbed: [None; AXES],
            good_since: [0; AXES],
            alone: [0; AXES],
            latched: 0,
            tally: Tally::default(),
            story: Vec::new(),
        }
    }

    fn fails(&self, why: &str) -> ! {
        let tail = &self.story[self.story.len().saturating_sub(60)..];
        panic!("{:?}, turn {}: {why}\n{}", self.m.shape.kind, self.turn, tail.join("\n"))
    }

    fn note(&mut self, what: String) {
        let what = format!("{}: {what}", self.turn);
        if campaign::only().is_some() {
            println!("{what}");
        }
        self.story.push(what);
    }

    fn step(&mut self) {
        self.m.step();
        self.turn += 1;
        for index in 0..AXES {
            if let Some((until, what)) = self.disturbed[index]
                && until <= self.turn
            {
                self.disturbed[index] = None;
                self.good_since[index] = self.turn;
                if what == Disturbance::Silent {
                    self.m.plug(index, true);
                }
            }
            while let Some(event) = self.group.event(index) {
                self.note(format!("axis {index}: {event}"));
                match event.kind {
                    EventKind::Ended { id, outcome, .. } => {
                        assert_eq!(self.ends[index].insert(id.0, outcome), None, "ended twice");
                    }
                    EventKind::Stopped(_) => self.tally.stops += 1,
                    _ => {}
                }
            }
        }
        self.judge();
    }

    fn judge(&mut self) {
        let truths: [_; AXES] = std::array::from_fn(|index| self.m.truth(index));
        let feedbacks: [_; AXES] = std::array::from_fn(|index| self.m.sim.feedback(index));
        let out: [bool; AXES] =
            std::array::from_fn(|index| feedbacks[index].stopped.is_some() || !truths[index].powered);
        for index in 0..AXES {
            let reached = feedbacks[index].link == Link::Online
                && self.disturbed[index].is_none()
                && self.turn > self.good_since[index] + GRACE;
            let moves = truths[index].powered && truths[index].velocity.abs() > self.m.scales[index].still;
            let other = (0..AXES).any(|other| other != index && out[other]);
            match reached && moves && other {
                true => self.alone[index] += 1,
                false => self.alone[index] = 0,
            }
            if self.alone[index] > MOST_ALONE {
                self.fails(&format!("axis {index} moves alone: {truths:?} {out:?}"));
            }
        }
        let all = feedbacks.iter().all(|feedback| feedback.stopped.is_some());
        self.latched = if all { self.latched + 1 } else { 0 };
    }

    fn disturb(&mut self) {
        use Disturbance::{Fault, Inhibited, LateHost, Nothing, OwnStop, Restart, Silent};
        let kinds = [Nothing, Silent, Silent, Silent, Inhibited, Fault, Restart, LateHost, OwnStop];
        let what = kinds[self.random.usize(0..kinds.len())];
        let index = self.random.usize(0..AXES);
        let ms = self.random.u64(2..60);
        self.note(format!("axis {index}: {what:?} for {ms} ms"));
        match what {
            Nothing => return,
            Silent => self.m.plug(index, false),
            Inhibited => self.m.open_sto(index, ms * 1_000_000),
            Fault => self.m.provoke(index),
            Restart => self.m.restart(index),
            LateHost => return self.m.skip(ms as u32 / 4),
            OwnStop => {
                let stop = |place| match place == index {
                    true => Command::Stop { deceleration: None },
                    // Refused: it is no command for some members.
                    false => Command::Follow,
                };
                let posted = self.group.post(&std::array::from_fn::<_, AXES, _>(stop));
                // Where the drives follow no rows, each part of it is refused for that.
                match posted {
                    Err(GroupError::Partly { posted, .. }) => {
                        assert!((0..AXES).all(|place| (posted.ids()[place].0 != 0) == (place == index)));
                    }
                    other => self.fails(&format!("{other:?}")),
                }
                return;
            }
        }
        self.disturbed[index] = Some((self.turn + ms, what));
    }

    /// Waits for the end of a command; meanwhile, after `delay` turns, something happens.
    fn ended(&mut self, command: &GroupCommand, delay: Option<u64>) -> [Outcome; AXES] {
        for turn in 0..MOST_TURNS {
            let end = |index: usize| self.ends[index].get(&command.ids()[index].0).copied();
            if let [Some(a), Some(b), Some(c)] = [end(0), end(1), end(2)] {
                return [a, b, c];
            }
            if delay == Some(turn) {
                self.disturb();
            }
            self.step();
        }
        self.fails(&format!("no end of {command:?}"))
    }

    /// What was not done at all members, or refused to all of them, stops them all.
    fn is_done(&mut self, outcomes: [Outcome; AXES]) -> bool {
        let done = outcomes.iter().filter(|outcome| **outcome == Outcome::Done).count();
        let own = |outcome: &Outcome| matches!(outcome, Outcome::Aborted(Abort::Replaced(_)));
        if done > 0 && done < AXES && !outcomes.iter().any(own) {
            self.tally.separated += 1;
            (0..3).for_each(|_| self.step());
            if self.latched == 0 {
                self.fails(&format!("one goes on without the others: {outcomes:?}"));
            }
        }
        done == AXES
    }

    fn all(&mut self, command: Command, disturbed: bool) -> bool {
        let delay = (disturbed && self.random.u8(0..3) > 0).then(|| self.random.u64(0..80));
        let posted = self.group.post_all(command).unwrap();
        let outcomes = self.ended(&posted, delay);
        self.note(format!("{}: {outcomes:?}", command.name()));
        match command {
            Command::Enable | Command::Home => self.is_done(outcomes),
            _ => outcomes == [Outcome::Done; AXES],
        }
    }

    /// Velocities of all of them for a while, in which something happens.
    fn moves(&mut self) {
        let Scales { velocity, acceleration } = Scales::of(&self.m);
        let command = self.group.post_all(Command::Velocity { acceleration }).unwrap();
        let sign = if self.random.bool() { 1.0 } else { -1.0 };
        let (turns, at) = (self.random.u64(60..200), self.random.u64(0..120));
        for turn in 0..turns {
            let share = 0.2 + 0.3 * (turn as f64 * 0.1).sin().abs();
            self.group.set_velocities(&[sign * share * velocity; AXES]).unwrap();
            if turn == at {
                self.disturb();
            }
            self.step();
        }
        let ended = (0..AXES).any(|index| self.ends[index].contains_key(&command.ids()[index].0));
        self.tally.moved += u32::from(!ended);
        // A velocity ends at all of them, if it does at one.
        self.all(Command::Stop { deceleration: None }, false);
        self.ended(&command, None);
    }

    fn round(&mut self) {
        for _ in 0..8 {
            if self.random.bool() {
                for _ in 0..2_000 {
                    if self.m.online() {
                        break;
                    }
                    self.step();
                }
            }
            let wait = self.random.u64(0..100);
            (0..wait).for_each(|_| self.step());
            self.all(Command::ResetFault, false);
            let disturbed = self.random.u8(0..4) == 0;
            if self.all(Command::Reset, disturbed) && self.all(Command::Enable, true) {
                self.tally.enabled += 1;
                break;
            }
            // Nobody moves by a later command, whatever came up.
            self.moves();
        }
        let homed = (0..AXES).all(|index| self.m.sim.feedback(index).status.homed);
        if self.m.scales[0].homes && !homed && !self.all(Command::Home, true) {
            return;
        }
        self.moves();
    }
}

/// What is commanded on this machine.
struct Scales {
    velocity: f64,
    acceleration: f64,
}

impl Scales {
    fn of(m: &Machine) -> Scales {
        let least = |value: fn(&Scale) -> f64| m.scales.iter().map(value).fold(f64::INFINITY, f64::min);
        Scales { velocity: least(|scale| scale.velocity), acceleration: least(|scale| scale.acceleration) }
    }
}

fn of_seed(kind: Kind, seed: u64) -> Judged<Tally> {
    // What the loop takes of a group is in its log: one run of each wire is repeated.
    let log = (seed == 0).then(Log::default);
    let mut run = Run::new(kind, seed, log.clone());
    (0..ROUNDS).for_each(|_| run.round());
    let (tally, shape) = (run.tally, run.m.shape);
    drop(run);
    for words in log.iter().flat_map(Log::words) {
        let verdict = replay(plan(shape), words, TaskOf::Nobody).run();
        assert!(verdict.is_equal(), "{kind:?}: {verdict:?}");
    }
    (tally, Ok(()))
}

fn seeds(kind: Kind, count: u64) {
    let sum = campaign::fixed(&format!("{kind:?}"), count, |seed| of_seed(kind, seed));
    if campaign::only().is_none() {
        let least = count as u32;
        assert!(sum.enabled >= least && sum.moved > 0 && sum.stops >= 3 * least, "{kind:?}: {sum:?}");
    }
}

#[test]
#[ignore = "new seeds: minutes, in a release build"]
fn no_member_moves_without_the_others_in_groups_of_new_seeds() {
    campaign::long("groups", |seed| of_seed(Kind::ALL[(seed % 5) as usize], seed / 5));
}

#[test]
fn no_member_on_linudp_moves_without_the_others() {
    seeds(Kind::LinMot, 6);
}

#[test]
fn no_member_on_ethercat_moves_without_the_others() {
    seeds(Kind::Kollmorgen, 3);
}

#[test]
fn no_member_on_ethernet_ip_moves_without_the_others() {
    seeds(Kind::Moons, 6);
}

#[test]
fn no_member_on_modbus_moves_without_the_others() {
    seeds(Kind::Unidrive, 3);
}

#[test]
fn no_member_on_profibus_moves_without_the_others() {
    seeds(Kind::Lenze, 3);
}

/// A slave that was deaf is set up again, and is silent for that. A group that is enabled at any instant of that comes
/// up as a whole, or not at all.
#[test]
fn a_group_that_is_enabled_while_a_slave_is_set_up_again_leaves_no_member_in_operation_alone() {
    let mut run = Run::new(Kind::Kollmorgen, 1, None);
    for delay in (0..40).chain([60, 100, 200, 400]).step_by(7) {
        let up = (0..20).any(|_| {
            (0..500).for_each(|_| run.step());
            run.all(Command::ResetFault, false);
            run.all(Command::Reset, false) && run.all(Command::Enable, false)
        });
        assert!(up, "before delay {delay}");
        let acceleration = Scales::of(&run.m).acceleration;
        run.group.post_all(Command::Velocity { acceleration }).unwrap();
        for turn in 0..100 {
            run.group.set_velocities(&[8.0; AXES]).unwrap();
            if turn == 80 {
                run.m.plug(0, false);
                run.disturbed[0] = Some((run.turn + 10, Disturbance::Silent));
            }
            run.step();
        }
        let mut back = 0;
        while !run.m.online() {
            run.step();
            back += 1;
            assert!(back < 20_000, "delay {delay}");
        }
        (0..delay).for_each(|_| run.step());
        run.note(format!("delay {delay}"));
        run.all(Command::Reset, false);
        run.all(Command::Enable, false);
        (0..100).for_each(|_| run.step());
        let stopped: Vec<bool> = (0..AXES).map(|index| run.m.sim.feedback(index).stopped.is_some()).collect();
        let operational = (0..AXES).filter(|index| run.m.sim.feedback(*index).is_operational()).count();
        if stopped.contains(&true) && stopped.contains(&false) && operational > 0 {
            run.fails(&format!("delay {delay}: {stopped:?}"));
        }
    }
}

/// Drives that follow speeds only have no rows to be taken together.
#[test]
fn groups_on_modbus_and_profibus_refuse_rows_and_moves() {
    for kind in [Kind::Unidrive, Kind::Lenze] {
        let mut run = Run::new(kind, 0, None);
        let profile = run.group.axes()[0].profile();
        let target = Target::Absolute(1.0);
        for command in [Command::Follow, Command::Move(Move { target, profile })] {
            let refused = run.group.post_all(command).unwrap_err();
            assert!(refused.to_string().contains(command.name()), "{refused}");
            assert!(matches!(refused, GroupError::Axis(AxisError::Refused { .. })), "{refused}");
        }
    }
}
