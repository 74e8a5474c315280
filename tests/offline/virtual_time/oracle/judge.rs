//! The statement about one axis, by the true state of its drive.
//!
//! | rule | statement |
//! |---|---|
//! | `limits` | powered and outside its limits leads to a stop request: it slows down, or its power goes off |
//! | `idle` | so does powered and moving, once it stood and no motion command was begun since |
//! | `suspended` | a computer that slept stops an axis that is enabled |
//! | `skips` | a loop outside its skip limits stops an axis that is enabled |
//! | `done` | Done means that the drive did it |
//! | `ends` | each accepted command ends exactly once |
//! | `newest` | the newest setpoint is taken, and wins |
//! | `stale` | a setpoint that is not renewed stops its axis |
//! | `stop` | an axis that nothing moves any more comes to rest, whatever stops it |
//! | `cut` | power that is said to be lost is lost |
//! | `place` | a position that is shown as new is one that the axis can have had |
//! | `misuse` | a drive that checks its master finds nothing wrong |
//! | `group` | no member goes on with a call of its group while another one is out of it |
//! | `stuck` | a loop whose wires were taken from it ends, and latches every axis |
//! | `recovers` | a machine over which a tool has run can be made ready again |
//!
//! Bounds are counted in turns of the loop in which the drive can be reached. A drive is given [`REACTION`] of them:
//! some reports prove a breach, the request goes out, the drive takes it and its motor slows down by what can be seen.

use std::collections::{BTreeMap, VecDeque};

use fieldbeat::axis::{Command, EventKind, Feedback, Link, Outcome, State, StopCause};
use fieldbeat::sim::Truth;

use super::machine::{Scale, range};

/// From a breach to a motor that slows down.
pub const REACTION: u32 = 40;
/// The same for a motion that nobody commands: an axis may first settle for 50 ms.
const REACTION_IDLE: u32 = 60;
/// After the wire was bad: until the link is judged good and the stop has got through.
pub const GRACE: u64 = 60;
/// The speed of the motor is compared with that of so many turns ago ...
const BACK: usize = 8;
/// ... and is slower if by this share of the largest one.
const SLOWER: f64 = 0.01;
/// A motor that follows its demand with a lag comes to rest after it, at the latest so many turns after its stop is
/// Done.
const SETTLES: u32 = 25;
/// A motor that was pushed by an old setpoint is back after so many turns.
const PUSHED: u32 = 10;
/// A member that goes on while another one is out of its call comes to rest within so many turns in which its drive can
/// be reached: the loop's reaction, then the ramp, the quick stop and power off.
pub const MOST_ALONE: u32 = REACTION + 3 * 50 + 20;
/// A drive stands after so many turns.
const STANDS: u32 = 20;
/// A speed above its limit by this factor is one: a motor overshoots.
const FAST: f64 = 1.3;
/// Slots over which skipped ones are counted, and how many are certainly too many: the default rate is 20 %.
const SLOTS: usize = 100;
const SKIPPED: usize = 25;
/// Slots within which one was skipped while an overload goes on.
const GOING_ON: usize = 5;
/// As many in a row are certainly too many: the default is 10.
const IN_A_ROW: u32 = 12;

/// A place is out of reach behind 2 ms, and some exchanges of which no report counted, at twice the largest speed or at
/// 1 m/s (`drive/watch.rs`).
const REACH_S: f64 = 0.006;
const REACH_SPEED: f64 = 1_000.0;
/// Positions change their origin around a homing.
const REHOMED: u32 = 250;

/// A rule that was broken.
#[derive(Clone, Debug)]
pub struct Breach {
    pub rule: &'static str,
    pub text: String,
}

/// A command that was accepted and is not known to have ended.
#[derive(Clone, Copy, Debug)]
pub struct Pending {
    pub command: Command,
    /// Where a move ends.
    pub target: Option<f64>,
    /// It is part of a call of a group, and begins when all members may.
    pub together: bool,
}

/// How long conditions hold.
#[derive(Clone, Copy, Debug, Default)]
struct Counters {
    fast: u32,
    outside: u32,
    idle: u32,
    skips: u32,
    stale: u32,
    wrong: u32,
}

/// What is known of one axis.
pub struct Watch {
    scale: Scale,
    stop_turns: u32,
    setpoint_age: u64,
    range: Option<(f64, f64)>,
    pub pending: BTreeMap<u64, Pending>,
    speeds: VecDeque<f64>,
    /// Power and speed of the last turns: an end that is reported now may be of a turn ago.
    powered: [bool; 4],
    counters: Counters,
    /// Turns of standstill in a row, and whether there were enough of them since the last motion.
    still: u32,
    stood: bool,
    idle_for: u32,
    /// Enabled, as the application knows it.
    enabled: bool,
    /// This master has enabled it, or has begun with it: what another master commands it leaves alone until then.
    ours: bool,
    /// The newest setpoint, since which slot it was not renewed and since which turn it has this value.
    newest: Option<Newest>,
    /// A stop is done, and the motor has so many turns left to come to rest.
    settling: Option<u32>,
    /// An old setpoint has come to the drive: so many turns later its motor follows the newest one again.
    pushed: u32,
    /// The computer has slept, and the axis has so many turns left to be stopped.
    slept: Option<u32>,
    /// The running command, since which slot.
    running: (u64, u64),
    /// It was stopped in the last turn.
    was_stopped: bool,
    /// So many turns until its origin is certain.
    rehomed: u32,
}

#[derive(Clone, Copy, Debug)]
struct Newest {
    of: u64,
    value: f64,
    renewed: u64,
    same: u32,
}

/// The loop's slots of late.
#[derive(Default)]
pub struct Slots {
    skipped: VecDeque<bool>,
    row: u32,
    planned: u64,
}

impl Slots {
    /// So many were skipped before the one that was executed.
    pub fn turn(&mut self, skipped: u64, executed: u64) {
        self.planned += skipped + executed;
        self.row = 0;
        for is_skipped in (0..skipped).map(|_| true).chain((0..executed).map(|_| false)) {
            if self.skipped.len() == SLOTS {
                self.skipped.pop_front();
            }
            self.skipped.push_back(is_skipped);
            self.row += u32::from(is_skipped);
        }
    }

    /// The last turn executed a cycle.
    pub fn is_executed(&self) -> bool {
        self.skipped.back().is_none_or(|skipped| !skipped)
    }

    /// Too many of late, and it goes on: an axis may be enabled again after a stop.
    fn too_many(&self) -> bool {
        let count = |slots: usize| self.skipped.iter().rev().take(slots).filter(|skipped| **skipped).count();
        self.row > IN_A_ROW || count(SLOTS) > SKIPPED && count(GOING_ON) > 0
    }

    pub fn any(&self) -> bool {
        self.skipped.contains(&true)
    }

    pub fn planned(&self) -> u64 {
        self.planned
    }
}

impl Watch {
    pub fn new(scale: Scale, plan: &fieldbeat::axis::AxisPlan) -> Watch {
        let stop_turns = plan.stop.timeout.as_millis() as u32;
        let stop_turns = stop_turns + stop_turns / 2 + REACTION;
        Watch::empty(scale, stop_turns, plan.setpoint_age.into(), range(&plan.limits))
    }

    fn empty(scale: Scale, stop_turns: u32, setpoint_age: u64, range: Option<(f64, f64)>) -> Watch {
        Watch {
            scale,
            stop_turns,
            setpoint_age,
            range,
            pending: BTreeMap::new(),
            speeds: VecDeque::new(),
            powered: [false; 4],
            counters: Counters::default(),
            still: 0,
            stood: false,
            idle_for: 0,
            enabled: false,
            ours: true,
            newest: None,
            settling: None,
            slept: None,
            pushed: 0,
            running: (0, 0),
            was_stopped: false,
            rehomed: REHOMED,
        }
    }

    /// A command was accepted.
    pub fn accepted(&mut self, id: u64, command: Command, truth: Truth) -> Result<(), Breach> {
        use fieldbeat::axis::{Move, Target};
        let stands = self.pending.is_empty() && truth.velocity.abs() < self.scale.still / 4.0;
        let target = match command {
            Command::Move(Move { target: Target::Absolute(position), .. }) => Some(position),
            Command::Move(Move { target: Target::Relative(distance), .. }) if stands => {
                Some(truth.position + distance)
            }
            _ => None,
        };
        match self.pending.insert(id, Pending { command, target, together: false }) {
            None => Ok(()),
            Some(_) => Err(breach("ends", format!("id {id} was given twice"))),
        }
    }

    /// This command is part of a call of a group.
    pub fn is_part(&mut self, id: u64) {
        if let Some(pending) = self.pending.get_mut(&id) {
            pending.together = true;
        }
    }

    /// A setpoint was given for the newest command that takes it.
    pub fn set(&mut self, slot: u64, value: f64, taken: Result<(), String>) -> Result<(), Breach> {
        let torques = self.scale.torques;
        let takes =
            |command: &Command| if torques { command.takes_torques() } else { command.takes_velocities() };
        let Some((of, _)) = self.pending.iter().rev().find(|(_, pending)| takes(&pending.command)) else {
            return Ok(());
        };
        if let Err(why) = taken {
            return Err(breach("newest", format!("the setpoint {value} was refused: {why}")));
        }
        let same = self.newest.filter(|newest| newest.value == value && newest.of == *of);
        let same = same.map_or(0, |newest| newest.same);
        self.newest = Some(Newest { of: *of, value, renewed: slot, same });
        Ok(())
    }

    /// The same for a set of setpoints of a group, which each member takes or none: it counts, and its value is that of
    /// whoever runs the call.
    pub fn set_together(&mut self, slot: u64) {
        let takes = |command: &Command| command.takes_velocities() || command.takes_torques();
        if let Some((of, _)) = self.pending.iter().rev().find(|(_, pending)| takes(&pending.command)) {
            self.newest = Some(Newest { of: *of, value: f64::NAN, renewed: slot, same: 0 });
        }
    }

    /// An event came; `fresh`: of this turn.
    pub fn event(
        &mut self,
        kind: EventKind,
        fresh: bool,
        truth: Truth,
        feedback: &Feedback,
    ) -> Result<(), Breach> {
        let EventKind::Ended { id, outcome, command } = kind else { return Ok(()) };
        let Some(pending) = self.pending.remove(&id.0) else {
            return Err(breach("ends", format!("{command} {} ended, {outcome}, and was not pending", id.0)));
        };
        if outcome != Outcome::Done {
            return Ok(());
        }
        self.enabled |= pending.command == Command::Enable;
        self.ours |= pending.command == Command::Enable;
        if fresh { self.done(pending, truth, feedback) } else { Ok(()) }
    }

    fn done(&mut self, pending: Pending, truth: Truth, feedback: &Feedback) -> Result<(), Breach> {
        let speed = truth.velocity.abs();
        let stands = speed <= self.scale.still;
        let powered = self.powered.iter().any(|powered| *powered) || truth.powered;
        let off = self.powered.iter().any(|powered| !powered) || !truth.powered;
        let is_true = match pending.command {
            Command::Enable => powered,
            Command::Disable => off,
            Command::Home => truth.homed || !truth.powered,
            Command::Move(_) => {
                let near = |target: f64| (truth.position - target).abs() <= self.scale.near;
                // The setpoint has ended there; the motor lags.
                self.settling = (truth.powered && !stands && self.pushed == 0).then_some(SETTLES);
                !truth.powered || self.pushed > 0 || pending.target.is_none_or(near)
            }
            Command::Stop { .. } | Command::QuickStop => {
                self.settling = (truth.powered && !stands).then_some(SETTLES);
                true
            }
            _ => true,
        };
        if is_true {
            return Ok(());
        }
        Err(breach("done", format!("{pending:?} is Done, but {truth:?}; {feedback:?}")))
    }

    /// What runs, by what the application knows: commands run in their order.
    pub fn running(&self) -> Option<(u64, Command)> {
        self.pending.first_key_value().map(|(id, pending)| (*id, pending.command))
    }

    /// One turn is over. `blind`: the application has not read its events. `reached`: the wire is good.
    pub fn turn(
        &mut self,
        truth: Truth,
        feedback: &Feedback,
        slots: &Slots,
        blind: bool,
        reached: bool,
    ) -> Result<(), Breach> {
        let speed = truth.velocity.abs();
        let foreign = !self.ours && feedback.stopped == Some(StopCause::OtherMaster);
        let moving = truth.powered && speed > self.scale.still && !foreign;
        self.speeds.push_front(speed);
        self.speeds.truncate(BACK + 1);
        let before = self.speeds.back().copied().unwrap_or(speed);
        let slower = !moving || speed <= before - SLOWER * self.scale.velocity;
        self.powered.rotate_right(1);
        self.powered[0] = truth.powered;

        let latched = feedback.stopped.is_some();
        let running = self.running().filter(|_| !latched);
        // What has begun is not known to an application that does not read its events.
        let any = blind && self.is_to_move() && !latched;
        let commanded = any || running.is_some_and(|(_, command)| moves(&command));
        let homing = blind || running.is_some_and(|(_, command)| command == Command::Home);
        self.enabled &=
            truth.powered && !latched && running.is_none_or(|(_, command)| command != Command::Disable);
        let id = running.map_or(0, |(id, _)| id);
        if self.running.0 != id {
            self.running = (id, slots.planned());
        }
        if let Some(newest) = &mut self.newest {
            newest.same += 1;
        }

        if commanded {
            (self.still, self.stood, self.idle_for) = (0, false, 0);
        } else {
            self.still = if moving { 0 } else { self.still + 1 };
            self.stood |= self.still >= STANDS;
            self.idle_for = if moving { self.idle_for + u32::from(reached) } else { 0 };
        }

        self.settling = self.settling.filter(|_| moving && !commanded).map(|left| left.saturating_sub(1));
        let awaits_stop = self.enabled && feedback.status.state == State::OperationEnabled;
        self.pushed = self.pushed.saturating_sub(1);
        self.slept = self.slept.filter(|_| awaits_stop).map(|left| left.saturating_sub(1));
        let fast = moving && speed > FAST * self.scale.velocity && !homing;
        let outside = moving
            && truth.homed
            && !homing
            && self.range.is_some_and(|(low, high)| {
                let margin = 3.0 * self.scale.near;
                truth.position > high + margin && truth.velocity > 0.0
                    || truth.position < low - margin && truth.velocity < 0.0
            });
        let idle = moving && !commanded && self.stood;
        let lost = [StopCause::DriveDropped, StopCause::StoOpen];
        let is_new = latched && !std::mem::replace(&mut self.was_stopped, latched);
        self.was_stopped = latched;
        let cut = self.scale.replies_again
            && is_new
            && feedback.stopped.is_some_and(|cause| lost.contains(&cause))
            && self.powered.iter().all(|powered| *powered);
        let sure = truth.homed && truth.powered && feedback.status.homed && !homing && !self.is_native();
        self.rehomed = if sure { self.rehomed.saturating_sub(1) } else { REHOMED };
        let place = self.is_elsewhere(truth, feedback) && self.rehomed == 0 && reached && !slots.any();
        let skips = slots.too_many() && awaits_stop;
        let stale = moving && !blind && self.is_stale(slots.planned(), running);
        let wrong = !blind && !slots.any() && self.is_wrong(truth, running, reached);

        // Each counts while it holds and nothing is done about it.
        let lasts = |counter: &mut u32, holds: bool, most: u32| {
            *counter = match (holds, reached) {
                (false, _) => 0,
                (true, false) => *counter,
                (true, true) => *counter + 1,
            };
            *counter > most
        };
        let count = |counter: &mut u32, holds: bool| lasts(counter, holds, REACTION);
        let counters = &mut self.counters;
        let broken = [
            ("cut", cut),
            ("place", place),
            ("done", self.settling == Some(0)),
            ("suspended", self.slept == Some(0)),
            ("limits", count(&mut counters.fast, fast && !slower)),
            ("limits", count(&mut counters.outside, outside && !slower)),
            ("idle", lasts(&mut counters.idle, idle && !slower, REACTION_IDLE)),
            ("skips", count(&mut counters.skips, skips)),
            ("stale", count(&mut counters.stale, stale && !slower)),
            ("newest", count(&mut counters.wrong, wrong)),
            ("stop", moving && !commanded && !self.stood && self.idle_for > self.stop_turns),
        ];
        match broken.iter().find(|(_, is_broken)| *is_broken) {
            None => Ok(()),
            Some((rule, _)) => {
                let pending: Vec<_> = self.pending.iter().collect();
                Err(breach(rule, format!("{truth:?}; pending {pending:?}; {feedback:?}")))
            }
        }
    }

    /// What is shown as new, and is no place of the axis.
    fn is_elsewhere(&self, truth: Truth, feedback: &Feedback) -> bool {
        let most = (2.0 * self.scale.velocity).max(REACH_SPEED) * REACH_S;
        let is_new = feedback.link == Link::Online && feedback.age == 0 && !feedback.status.suspect;
        self.scale.replies_again && is_new && (feedback.status.position - truth.position).abs() > most
    }

    /// A setpoint of the running command is too old, in slots.
    fn is_stale(&self, slot: u64, running: Option<(u64, Command)>) -> bool {
        let Some((id, Command::Velocity { .. } | Command::Torque { .. })) = running else { return false };
        let renewed = self.newest.filter(|newest| newest.of == id).map_or(0, |newest| newest.renewed);
        slot - renewed.max(self.running.1) > self.setpoint_age + 2
    }

    /// The newest velocity of the running command is long since the present one, and the motor has another.
    fn is_wrong(&self, truth: Truth, running: Option<(u64, Command)>, reached: bool) -> bool {
        let Some((id, Command::Velocity { acceleration })) = running else { return false };
        // One of a group may still wait for the other members.
        if self.pending.get(&id).is_some_and(|pending| pending.together) {
            return false;
        }
        let Some(newest) = self.newest.filter(|newest| newest.of == id) else { return false };
        let turns = 2.0 * self.scale.velocity / acceleration * 1e3 + f64::from(REACTION);
        reached
            && truth.powered
            && f64::from(newest.same) > turns
            && (truth.velocity - newest.value).abs() > 0.1 * self.scale.velocity
    }

    /// The wire was bad, or the loop was late: what was wrong until now does not count.
    pub fn excuse(&mut self) {
        self.counters.wrong = 0;
        if let Some(newest) = &mut self.newest {
            newest.same = 0;
        }
    }

    /// A request of before has come to it.
    pub fn pushed(&mut self) {
        self.pushed = PUSHED;
    }

    /// The application has dropped the axis: nobody sees its commands end.
    pub fn dropped(&mut self) {
        self.pending.clear();
        self.newest = None;
    }

    /// Another master, or a tool, may move it for so many turns.
    pub fn disturbed(&mut self, turns: u64) {
        self.pushed = turns as u32;
    }

    /// The computer has slept.
    pub fn suspended(&mut self) {
        self.slept = Some(REACTION);
    }

    /// Another master starts: what was commanded before has no end.
    pub fn master_died(&mut self) {
        let (speeds, powered) = (std::mem::take(&mut self.speeds), self.powered);
        let Watch { scale, stop_turns, setpoint_age, range, .. } = *self;
        let fresh =
            Watch { speeds, powered, ours: false, ..Watch::empty(scale, stop_turns, setpoint_age, range) };
        *self = fresh;
    }

    /// Native mode has not ended.
    pub fn is_native(&self) -> bool {
        self.pending.values().any(|pending| matches!(pending.command, Command::Native(_)))
    }

    /// A command that moves it has not ended.
    pub fn is_to_move(&self) -> bool {
        self.pending.values().any(|pending| moves(&pending.command))
    }

    /// It stands, or has no power.
    pub fn rests(&self, truth: Truth) -> bool {
        !truth.powered || truth.velocity.abs() <= self.scale.still
    }
}

fn moves(command: &Command) -> bool {
    command.is_motion() || *command == Command::Home
}

fn breach(rule: &'static str, text: String) -> Breach {
    Breach { rule, text }
}
