//! Any sequence of commands, losses, faults and restarts, and what holds in each exchange of it.

use super::*;
use crate::bus::desired::{Mode, ModeIs};

/// Sequences, and exchanges of each.
const SEQUENCES: u64 = 3_000;
const EXCHANGES: usize = 300;
/// units/s², and per cent/s: the largest in the plan and in the commands below.
const STEEPEST: f64 = 2_000.0;
const NEAR: f64 = 1e-6;

/// SplitMix64.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, sides: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % sides
    }

    fn hits(&mut self, of_a_thousand: u64) -> bool {
        self.roll(1_000) < of_a_thousand
    }

    fn fate(&mut self) -> Fate {
        match self.roll(40) {
            0 | 1 => Fate::Unsent,
            2..5 => Fate::RequestLost,
            5..8 => Fate::ReplyLost,
            8..11 => Fate::Suspect(1 + self.roll(4) as usize),
            _ => Fate::Good,
        }
    }

    fn command(&mut self) -> Command {
        let way = (self.roll(41) as f64 - 20.0) * 0.1;
        match self.roll(16) {
            0..4 => Command::Enable,
            4 => Command::Disable,
            5 => Command::Home,
            6 => to(way),
            7 => by(way),
            8 => jog(30.0 * way),
            9 => Command::Velocity { acceleration: 500.0 },
            10 => Command::Torque { slope: 500.0 },
            11 => Command::Follow,
            12 => STOP,
            13 => Command::Stop { deceleration: Some(200.0) },
            14 => Command::QuickStop,
            _ => Command::ResetFault,
        }
    }
}

/// The observations of the newest command.
#[derive(Default)]
struct Judge {
    command: Option<Command>,
    end: End,
    /// The first request of it that went out.
    first: Option<Desired>,
    /// Where the drive has come to standstill by its stop.
    stands: Option<f64>,
    row: u64,
    row_velocity: f64,
    last_row: bool,
}

impl Judge {
    fn may_replace(&self, next: &Command) -> bool {
        let streams = self.command == Some(Command::Follow) && *next == Command::Follow;
        next.is_urgent()
            || self.command.is_none()
            || self.end.is_some()
            || self.command.is_some_and(|command| command.is_motion() && next.is_motion() && !streams)
    }

    fn begins(&mut self, rig: &Rig, command: Command) {
        let stands = self.stands.filter(|_| !command.is_motion() && command != Command::Home);
        *self = Judge { command: Some(command), end: rig.end(), stands, row: self.row, ..Judge::default() };
        let at_once = command == Command::ResetFault && !rig.slot.evidence.fault.active;
        assert!(self.end != Some(Ok(())) || at_once, "{command:?} is done before it left");
    }

    fn is(&self, commands: impl Fn(&Command) -> bool) -> bool {
        self.end.is_none() && self.command.as_ref().is_some_and(commands)
    }

    /// A row that continues where the setpoint is, now and then a last one.
    fn feed(&mut self, rig: &mut Rig, dice: &mut Dice) {
        let at = match quantity(&rig.drive.can) {
            None => rig.drive.point.position,
            Some(_) => rig.slot.desired.setpoint.position,
        };
        if self.last_row {
            return;
        }
        self.last_row = dice.hits(20);
        self.row += 1;
        self.row_velocity = (self.row_velocity + dice.roll(3) as f64 - 1.0).clamp(-20.0, 20.0);
        let position = at + self.row_velocity * T as f64 * 1e-9;
        let row = Row { position, velocity: self.row_velocity, last: self.last_row, ..Row::default() };
        rig.machine.input.row = Some(NumberedRow { number: self.row, row });
    }

    /// One exchange, and what it shows.
    fn exchange(&mut self, rig: &mut Rig, fate: Fate) {
        let (state, velocity) = (rig.drive.state, rig.drive.point.velocity);
        let (before, count) = (rig.gone.last().copied().unwrap_or_default(), rig.gone.len());
        let since_ns = rig.sent_at.map_or(T, |at| (rig.now + T).since(at));
        // What ended before it left.
        self.end = rig.end();
        rig.exchange(fate);
        if rig.gone.len() > count {
            let gone = rig.gone[count];
            self.first.get_or_insert(gone);
            self.request(rig, &before, &gone, since_ns);
        }
        let raised = state != Cia402::OperationEnabled && rig.state() == Cia402::OperationEnabled;
        assert!(!raised || self.is(|command| *command == Command::Enable), "nobody has enabled it");
        let arrives = !matches!(fate, Fate::Unsent | Fate::RequestLost);
        let moves = self.is(|command| command.is_motion() || *command == Command::Home);
        // Those of the master go on where the last one that went out was, lost or not.
        let most = match quantity(&rig.drive.can) {
            None => velocity.abs(),
            Some(Quantity::Torque) => f64::INFINITY,
            Some(_) => velocity.abs().max(before.setpoint.velocity.abs()),
        };
        if arrives && !moves {
            let now = rig.drive.point.velocity;
            assert!(now.abs() <= most + NEAR, "no command moves it: {velocity} -> {now}");
        }
        if let Some(place) = self.stands {
            let point = rig.drive.point;
            assert!((point.position - place).abs() < NEAR, "it has left {place}: {point:?}");
        }
        let end = rig.end();
        assert!(self.end.is_none() || end == self.end, "{:?} has ended twice: {end:?}", self.command);
        if self.end.is_none() && end == Some(Ok(())) {
            self.done(rig);
        }
        self.end = end;
    }

    /// Checks a request by the one before it.
    fn request(&self, rig: &Rig, before: &Desired, gone: &Desired, since_ns: u64) {
        let on = |power| matches!(power, Power::SwitchOn | Power::EnableOperation);
        let rises = on(gone.power.value) && !on(before.power.value);
        assert!(!rises || self.is(|command| *command == Command::Enable), "power on: {gone:?}");
        if gone.motion.serial != before.motion.serial {
            let suits = match gone.motion.value {
                Motion::Move { .. } => {
                    self.is(|command| matches!(command, Command::Move(_)) || command.takes_velocities())
                }
                Motion::Follow | Motion::EndStream => self.is(|command| *command == Command::Follow),
                Motion::Home => self.is(|command| *command == Command::Home),
                _ => true,
            };
            assert!(suits, "{gone:?} of {:?}", self.command);
        }
        let leads = |desired: &Desired| {
            desired.power.value == Power::EnableOperation
                && desired.mode.value == Mode::Own
                && desired.motion.value == Motion::Hold
        };
        if quantity(&rig.drive.can).is_none() || !leads(before) || !leads(gone) {
            return;
        }
        let value = |desired: &Desired| desired.setpoint.velocity + desired.setpoint.torque;
        let (from, to) = (value(before), value(gone));
        let rows = before.setpoint.row != gone.setpoint.row;
        let slows = to.abs() <= from.abs() + NEAR;
        assert!(slows || self.is(Command::is_motion), "{from} -> {to} of no motion, or of one that is over");
        let most = STEEPEST * since_ns as f64 * 1e-9 + NEAR;
        // A torque may be removed at once.
        let removed = quantity(&rig.drive.can) == Some(Quantity::Torque) && to == 0.0;
        assert!(rows || removed || (to - from).abs() <= most, "{from} -> {to} in {since_ns} ns");
        if quantity(&rig.drive.can) == Some(Quantity::Position) && !rows {
            let way = gone.setpoint.position - before.setpoint.position;
            let fastest = from.abs().max(to.abs()) + most;
            let most = fastest * since_ns.min(2 * T) as f64 * 1e-9 + NEAR;
            assert!(way.abs() <= most, "{way} at {from} -> {to}");
        }
    }

    /// The command is done: the drive has taken it, and reports so.
    fn done(&mut self, rig: &Rig) {
        let (Some(command), Some(first)) = (self.command, self.first) else {
            panic!("{:?} is done before it left", self.command)
        };
        let (report, accepted) = (&rig.slot.status, rig.slot.evidence.accepted);
        assert!(!report.suspect && accepted.power >= first.power.serial, "{command:?} was not taken");
        let motion = command.is_motion() || command == Command::Home;
        assert!(!motion || accepted.motion >= first.motion.serial, "{command:?} was not taken");
        let shown = match command {
            Command::Enable => report.state == Cia402::OperationEnabled,
            Command::Disable => !report.state.is_powered(),
            Command::Move(Move { target: Target::Absolute(place), .. }) => {
                !report.moving && (report.position - place).abs() < NEAR
            }
            Command::Move(_) | Command::Follow => !report.moving,
            Command::Home => rig.slot.evidence.mode == ModeIs::Own && report.homed,
            Command::ResetFault => !rig.slot.evidence.fault.active && !report.state.is_powered(),
            Command::Stop { .. } | Command::QuickStop => !report.moving || !report.state.is_powered(),
            _ => false,
        };
        assert!(shown, "{command:?} is done at {report:?}");
        if command.is_urgent() && !rig.drive.is_moving() {
            self.stands = Some(rig.drive.point.position);
        }
        assert!(!command.is_urgent() || !rig.drive.is_moving() || !rig.state().is_powered(), "{command:?}");
    }
}

fn run(seed: u64) {
    let mut dice = Dice(seed);
    let mut rig = Rig::with(kinds()[seed as usize % kinds().len()], |plan| {
        plan.limits.acceleration = Some(STEEPEST);
        plan.limits.position = [None, Some((-3.0, 4.0))][seed as usize / 4 % 2];
    });
    rig.drive.point.position = dice.roll(5) as f64 - 2.0;
    let mut judge = Judge::default();
    for _ in 0..EXCHANGES {
        if dice.hits(2) && !rig.drive.shows.fault.active {
            rig.drive.trip(5);
        }
        if dice.hits(2) {
            rig.drive.restart();
        }
        if dice.hits(40) {
            rig.set(5.0 * (dice.roll(21) as f64 - 10.0));
        }
        let command = dice.command();
        let busy = judge.command.is_some() && judge.end.is_none();
        if dice.hits(if busy { 12 } else { 150 }) && judge.may_replace(&command) {
            rig.start(command);
            judge.begins(&rig, command);
        }
        if judge.is(|command| *command == Command::Follow) && !dice.hits(100) {
            judge.feed(&mut rig, &mut dice);
        }
        rig.propose();
        judge.exchange(&mut rig, dice.fate());
    }
    // It comes to rest whatever was before.
    rig.start(STOP);
    judge.begins(&rig, STOP);
    for _ in 0..3_000 {
        if rig.end().is_some() && !rig.drive.is_moving() {
            return;
        }
        judge.exchange(&mut rig, Fate::Good);
    }
    panic!("it never comes to rest: {:?} {:?}", rig.end(), rig.drive);
}

#[test]
fn random_events_cause_no_forbidden_motion() {
    for seed in 0..SEQUENCES {
        let held = std::panic::catch_unwind(|| run(seed));
        assert!(held.is_ok(), "in sequence {seed}");
    }
}
