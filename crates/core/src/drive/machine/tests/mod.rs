//! The drive machine and drives of a few lines: what holds for all protocols.
//!
//! | file | what |
//! |---|---|
//! | `mod` | a machine and its drive, exchange by exchange |
//! | `fake` | the drive |
//! | `power` | enabling, disabling, faults, restarts |
//! | `motions` | moves, velocities, rows, torques, homing |
//! | `stops` | stops and quick stops |
//! | `random` | any sequence of commands, losses and reports |

mod fake;
mod motions;
mod power;
mod random;
mod stops;

use std::time::Duration;

use self::fake::{Drive, T, kinds};
use super::{Machine, NumberedRow, State};
use crate::axis::{
    AxisPlan, Command, Failure, Jog, Move, Profile, Row, State as Cia402, Target, Unit, Units,
};
use crate::bus::Slot;
use crate::bus::desired::{Capabilities, Desired, Generator, Motion, Power, Quantity, Setpoint};
use crate::time::{MS, Time};

type End = Option<Result<(), Failure>>;

const STOP: Command = Command::Stop { deceleration: None };
const PROFILE: Profile = Profile { velocity: 100.0, acceleration: 1_000.0, deceleration: 1_000.0 };

/// The fate of an exchange.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fate {
    Good,
    /// Not sent: its slot was passed over, or the send was refused.
    Unsent,
    /// The request is lost, or the reply to it.
    RequestLost,
    ReplyLost,
    /// A reply of so many exchanges before.
    Suspect(usize),
}

struct Rig {
    machine: Machine,
    slot: Slot,
    drive: Drive,
    now: Time,
    /// The requests that went out, in all exchanges.
    gone: Vec<Desired>,
    /// The drive's restarts that were reported.
    restarts: u32,
    sent_at: Option<Time>,
}

#[test]
fn usual_cycles_read_one_cache_line_and_one_of_the_state() {
    use std::mem::offset_of;
    assert!(offset_of!(Machine, input) <= 56, "{}", offset_of!(Machine, input));
    assert_eq!(offset_of!(Machine, state) % 64, 0);
    assert!(offset_of!(State, course) <= 64, "{}", offset_of!(State, course));
}

fn plan() -> AxisPlan {
    let units = Units { unit: Unit::Millimetre, counts_per_unit: 1_000.0, offset: 0.0, modulo: None };
    let mut plan = AxisPlan::new("x", units);
    (plan.profile, plan.stop.standstill) = (PROFILE, 0.1);
    plan.in_position.window = Some(0.5);
    (plan.enable_timeout, plan.home_timeout) = (Duration::from_millis(300), Duration::from_millis(2_000));
    plan
}

fn quantity(can: &Capabilities) -> Option<Quantity> {
    match can.generator {
        Generator::Master(quantity) => Some(quantity),
        Generator::Drive { .. } => None,
    }
}

/// Drives that go to positions.
fn movers() -> impl Iterator<Item = Capabilities> {
    kinds().into_iter().filter(|can| matches!(quantity(can), None | Some(Quantity::Position)))
}

/// Those of them that follow rows.
fn followers() -> impl Iterator<Item = Capabilities> {
    movers().filter(|can| can.lacks.rows.is_none())
}

fn to(position: f64) -> Command {
    Command::Move(Move { target: Target::Absolute(position), profile: PROFILE })
}

fn by(distance: f64) -> Command {
    Command::Move(Move { target: Target::Relative(distance), profile: PROFILE })
}

fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: 1_000.0 })
}

/// A command that the drive cannot do.
fn refused(can: &Capabilities) -> Command {
    if can.lacks.torques.is_some() { Command::Torque { slope: 1.0 } } else { to(0.0) }
}

impl Rig {
    fn new(can: Capabilities) -> Rig {
        Rig::with(can, |_| ())
    }

    fn with(can: Capabilities, change: impl FnOnce(&mut AxisPlan)) -> Rig {
        let mut plan = plan();
        change(&mut plan);
        let mut rig = Rig {
            machine: Machine::new(&plan, can, T),
            slot: Slot { due: true, ..Slot::default() },
            drive: Drive::new(can),
            now: Time(1_000 * T),
            gone: Vec::new(),
            restarts: 0,
            sent_at: None,
        };
        // It is only read.
        rig.turns(3);
        assert_eq!(rig.power(), Power::Untouched);
        rig
    }

    /// In operation.
    fn enabled(can: Capabilities) -> Rig {
        Rig::enabled_with(can, |_| ())
    }

    fn enabled_with(can: Capabilities, change: impl FnOnce(&mut AxisPlan)) -> Rig {
        let mut rig = Rig::with(can, change);
        assert_eq!(rig.run(Command::Enable), Ok(()));
        rig
    }

    fn in_motion(can: Capabilities) -> Rig {
        let mut rig = Rig::enabled(can);
        rig.moving();
        rig
    }

    /// In operation and homed, with these position limits.
    fn within(can: Capabilities, low: f64, high: f64) -> Rig {
        let mut rig = Rig::with(can, |plan| plan.limits.position = Some((low, high)));
        rig.drive.homed = true;
        assert_eq!(rig.run(Command::Enable), Ok(()));
        rig
    }

    /// The velocity, or torque, of the application; it begins a motion with it.
    fn set(&mut self, value: f64) {
        self.machine.input.level = value;
    }

    fn row(&mut self, number: u64, position: f64, last: bool) {
        let row = Row { position, last, ..Row::default() };
        self.machine.input.row = Some(NumberedRow { number, row });
    }

    fn start(&mut self, command: impl Into<Option<Command>>) {
        self.machine.start(self.now, command.into());
        self.propose();
    }

    /// For the next send, as often as somebody likes; and the setpoint that was kept is the one that is planned.
    fn propose(&mut self) {
        let next = self.now + T;
        self.machine.propose(next, &mut self.slot);
        let ended = |rig: &Rig| rig.end().map(|end| end.is_ok());
        let (first, end) = (self.slot.desired, ended(self));
        // As if it knew nothing of a setpoint that is kept; then it goes on as it was.
        let left = self.machine.state.left().clone();
        self.machine.state.left_mut().course.is_constant = false;
        self.machine.propose(next, &mut self.slot);
        // An intent that has not left has another serial each time; and a place has no meaning for all drives.
        let is_place = quantity(&self.drive.can) == Some(Quantity::Position);
        let values = |desired: Desired| {
            let Desired { power, mode, motion, setpoint } = desired;
            let position = if is_place { setpoint.position } else { 0.0 };
            (power.value, mode.value, motion.value, Setpoint { row: 0, position, ..setpoint })
        };
        assert_eq!((values(self.slot.desired), ended(self)), (values(first), end), "it is proposed again");
        if !self.machine.state.is_proposed() {
            *self.machine.state.left_mut() = left;
        }
    }

    fn turn(&mut self) {
        self.exchange(Fate::Good);
    }

    fn turns(&mut self, count: usize) {
        (0..count).for_each(|_| self.turn());
    }

    fn exchange(&mut self, fate: Fate) {
        self.now = self.now + T;
        let desired = self.slot.desired;
        if fate != Fate::Unsent {
            self.machine.commit(self.now);
            self.remember(&desired);
            self.sent_at = Some(self.now);
        }
        let arrives = !matches!(fate, Fate::Unsent | Fate::RequestLost);
        self.drive.exchange(self.now, arrives.then_some(&desired));
        let back = match fate {
            Fate::Good => Some(self.drive.delay),
            Fate::Suspect(back) => Some(self.drive.delay + back),
            Fate::Unsent | Fate::RequestLost | Fate::ReplyLost => None,
        };
        let mut restarted = false;
        if let Some(report) = back.and_then(|back| self.drive.reports.get(back)) {
            let accepted = self.slot.evidence.accepted;
            (self.slot.status, self.slot.evidence) = (report.status, report.evidence);
            self.slot.status.suspect = matches!(fate, Fate::Suspect(_));
            if self.slot.status.suspect {
                self.slot.evidence.accepted = accepted;
            } else {
                restarted = std::mem::replace(&mut self.restarts, report.restarts) < report.restarts;
            }
            self.slot.notices.fresh = true;
        }
        self.observe(restarted);
    }

    fn observe(&mut self, restarted: bool) {
        self.machine.observe(self.now, restarted, &self.slot);
        self.slot.notices.fresh = false;
        self.propose();
    }

    /// Remembers the sent state for its serial from then on.
    fn remember(&mut self, desired: &Desired) {
        if let Some(before) = self.gone.last() {
            let (power, mode, motion) = (desired.power, desired.mode, desired.motion);
            let same = (power.serial > before.power.serial || power == before.power)
                && (mode.serial > before.mode.serial || mode == before.mode)
                && (motion.serial > before.motion.serial || motion == before.motion);
            assert!(same, "a serial stands for two intents: {before:?}, {desired:?}");
        }
        self.gone.push(*desired);
    }

    /// One exchange of which the newest report comes all the same, and says that the drive moves or not.
    fn see(&mut self, fate: Fate, moving: bool) {
        self.exchange(fate);
        self.drive.reports[0].status.moving = moving;
        (self.slot.status, self.slot.evidence) =
            (self.drive.reports[0].status, self.drive.reports[0].evidence);
        self.slot.notices.fresh = true;
        self.observe(false);
    }

    /// How the newest command has ended.
    fn end(&self) -> End {
        self.machine.end()
    }

    #[track_caller]
    fn until(&mut self, what: &str, done: impl Fn(&Rig) -> bool) {
        for _ in 0..8_000 {
            if done(self) {
                return;
            }
            self.turn();
        }
        panic!("never {what}: {:?} {:?} {:?}", self.slot.status, self.machine, self.drive.point);
    }

    #[track_caller]
    fn finish(&mut self) -> Result<(), Failure> {
        self.until("an end", |rig| rig.end().is_some());
        self.end().unwrap()
    }

    #[track_caller]
    fn run(&mut self, command: Command) -> Result<(), Failure> {
        self.start(command);
        self.finish()
    }

    /// Begins the motion of its kind, at 50 units/s or more.
    #[track_caller]
    fn moving(&mut self) {
        match quantity(&self.drive.can) {
            Some(Quantity::Torque) => {
                self.start(Command::Torque { slope: 10_000.0 });
                self.set(100.0);
                self.until("a speed", |rig| rig.drive.point.velocity >= 50.0);
                self.set(0.0);
                self.until("no torque", |rig| rig.gone.last().unwrap().setpoint.torque == 0.0);
            }
            _ => self.start(jog(50.0)),
        }
        self.until("a speed", |rig| rig.drive.point.velocity > 49.99);
    }

    fn state(&self) -> Cia402 {
        self.drive.state
    }

    /// The power of the next request.
    fn power(&self) -> Power {
        self.slot.desired.power.value
    }

    fn motion(&self) -> Motion {
        self.slot.desired.motion.value
    }
}
