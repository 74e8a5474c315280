//! What motion commands make of the demand: profiles, streams, armed commands.
//!
//! Knows no telegram, no command count and no state machine. Positions are in the drive's own coordinates, SI units.

use std::collections::VecDeque;

use crate::bus::linudp::motion::{Decoded, Move, Origin, Shape, Start, Vad, When};
use crate::bus::linudp::plan::StreamCommand;
use crate::bus::linudp::wire::ErrorCode;
use crate::sim::physics::Generator;
use crate::time::{S, Time};

/// One wire count of position, m.
pub(super) const METRE: f64 = 1e-7;
/// One wire count of velocity, m/s.
pub(super) const METRE_PER_S: f64 = 1e-6;
/// One wire count of acceleration, m/s2.
pub(super) const METRE_PER_S2: f64 = 1e-5;

/// The drive's quick-stop deceleration, m/s2. A parameter in the real drive.
const QUICK_STOP: f64 = 20.0;
/// The predefined profile (UPIDs 14BEh-14C0h): 1 m/s, 10 m/s2, 10 m/s2.
const PREDEFINED: Vad = Vad { velocity: 1_000_000, acceleration: 1_000_000, deceleration: 1_000_000 };

/// How far the first interval may lie outside the period range of its command, in parts of 1: a real network jitters.
const PERIOD_TOLERANCE: f64 = 0.25;

/// A position and how it changes: m, m/s, m/s2.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Demand {
    pub position: f64,
    pub velocity: f64,
    pub acceleration: f64,
}

/// The setpoint generator of the drive and what feeds it.
#[derive(Debug)]
pub(super) struct Setpoints {
    generator: Generator,
    /// Of the last profile.
    target: f64,
    /// The profile that a released freeze goes on with.
    resume: Option<Limits>,
    armed: Option<Armed>,
    stream: Option<Stream>,
    /// Expected by the commands with configured period, ns.
    configured_ns: u64,
    /// Periods of silence that are an underflow of a stream, and setpoints that it holds.
    tolerance: (f64, usize),
    predefined: Vad,
    /// Sine and Bestehorn moves that came while another motion ran.
    pub(super) refused: u64,
}

/// Velocity, acceleration, deceleration in SI units.
#[derive(Clone, Copy, Debug)]
struct Limits(f64, f64, f64);

impl From<Vad> for Limits {
    fn from(vad: Vad) -> Limits {
        Limits(
            f64::from(vad.velocity) * METRE_PER_S,
            f64::from(vad.acceleration) * METRE_PER_S2,
            f64::from(vad.deceleration) * METRE_PER_S2,
        )
    }
}

/// A command that waits for an event.
#[derive(Clone, Copy, Debug)]
enum Armed {
    /// The end of the running motion.
    After(Move),
    /// A trigger input. This drive has none wired, so it stays armed until it is cleared.
    Trigger,
    /// The demand passing a position.
    Passing { positive: bool, position: f64, limits: Limits },
}

impl Setpoints {
    /// Stands at `position`.
    pub(super) fn at(position: f64, configured_ns: u64, tolerance: (f64, usize)) -> Setpoints {
        Setpoints {
            generator: Generator::at(position),
            target: position,
            resume: None,
            armed: None,
            stream: None,
            configured_ns,
            tolerance,
            predefined: PREDEFINED,
            refused: 0,
        }
    }

    pub(super) fn demand(&self) -> Demand {
        Demand {
            position: self.generator.position(),
            velocity: self.generator.velocity(),
            acceleration: self.generator.acceleration(),
        }
    }

    /// A motion is under way, or a stream that has not begun to move yet.
    pub(super) fn is_moving(&self) -> bool {
        self.generator.is_moving() || self.stream.is_some()
    }

    /// A command waits for an event.
    pub(super) fn is_armed(&self) -> bool {
        self.armed.is_some()
    }

    /// Forgets everything and stands at `position`.
    pub(super) fn stand_at(&mut self, position: f64) {
        self.drop_all();
        self.generator.set(position, 0.0, 0.0);
        self.generator.halt();
        self.target = position;
    }

    /// Demand velocity 0 at once.
    pub(super) fn halt(&mut self) {
        self.drop_all();
        self.generator.halt();
    }

    /// Ramps down with the quick-stop deceleration, and forgets what it was doing.
    pub(super) fn quick_stop(&mut self) {
        self.drop_all();
        self.generator.brake(QUICK_STOP);
    }

    /// Ramps down with the quick-stop deceleration; a profile can be resumed.
    pub(super) fn freeze(&mut self) {
        let resume = self.resume;
        self.quick_stop();
        self.resume = resume;
    }

    /// Goes on with the profile that was frozen, if it was one.
    pub(super) fn resume(&mut self) {
        if let Some(Limits(v, a, d)) = self.resume {
            self.generator.go_to(self.target, v, a, d);
        }
    }

    /// A motion of the drive's own: to `target` with `velocity` and `acceleration`.
    pub(super) fn go_to(&mut self, target: f64, velocity: f64, acceleration: f64) {
        self.drop_all();
        self.target = target;
        self.generator.go_to(target, velocity, acceleration, acceleration);
    }

    /// A motion of the drive's own: runs without end at `velocity`, signed.
    pub(super) fn run(&mut self, velocity: f64, acceleration: f64) {
        self.drop_all();
        self.generator.run(velocity, acceleration);
    }

    fn drop_all(&mut self) {
        (self.resume, self.armed, self.stream) = (None, None, None);
    }

    /// Takes a command in state 8. What belongs to the state machine is not for here and does nothing.
    pub(super) fn execute(&mut self, command: &Decoded, now: Time, actual: Demand) -> Result<(), ErrorCode> {
        match *command {
            Decoded::Move(order) => self.take_move(order, actual),
            Decoded::Stop(deceleration) => {
                self.drop_all();
                let given = deceleration.map(|d| f64::from(d) * METRE_PER_S2);
                self.generator.brake(given.unwrap_or(QUICK_STOP));
            }
            Decoded::Run { positive, velocity, acceleration } => {
                let v = f64::from(velocity.unwrap_or(self.predefined.velocity)) * METRE_PER_S;
                let a = f64::from(acceleration.unwrap_or(self.predefined.acceleration)) * METRE_PER_S2;
                self.run(if positive { v } else { -v }, a);
            }
            Decoded::ChangeProfile { positive, position, profile } => {
                let position = f64::from(position) * METRE;
                self.armed = Some(Armed::Passing { positive, position, limits: profile.into() });
            }
            Decoded::ClearEvents => self.armed = None,
            Decoded::LiveParameter { upid, value } => match upid {
                0x14BE => self.predefined.velocity = value,
                0x14BF => self.predefined.acceleration = value,
                0x14C0 => self.predefined.deceleration = value,
                // No other parameter of this drive is live.
                _ => {}
            },
            Decoded::Stream { command, position, velocity, acceleration } => {
                let setpoint = Demand {
                    position: f64::from(position) * METRE,
                    velocity: f64::from(velocity) * METRE_PER_S,
                    acceleration: f64::from(acceleration) * METRE_PER_S2,
                };
                return self.take_setpoint(command, now, setpoint);
            }
            Decoded::EndStream => {
                // What is still buffered is dropped: the strictest reading of "leave streaming".
                if self.stream.take().is_some() {
                    self.generator.halt();
                }
            }
            Decoded::Curve(_) => return Err(ErrorCode::CURVE_NOT_DEFINED),
            Decoded::TableEntry(_) => return Err(ErrorCode::ENTRY_MISSING),
            Decoded::Unknown => return Err(ErrorCode::UNKNOWN_COMMAND),
            Decoded::NoOperation
            | Decoded::ControlWord(_)
            | Decoded::MasterHoming(_)
            | Decoded::ResetFirmware => {}
        }
        Ok(())
    }

    fn take_move(&mut self, order: Move, actual: Demand) {
        match order.when {
            When::Trigger { .. } => self.armed = Some(Armed::Trigger),
            When::AfterActual if self.is_moving() => self.armed = Some(Armed::After(order)),
            When::AfterActual | When::Now => {
                let from_rest = matches!(order.shape, Shape::Sine | Shape::Bestehorn(_));
                if from_rest && self.is_moving() {
                    self.refused += 1;
                } else {
                    self.start(order, actual);
                }
            }
        }
    }

    /// Every shape runs as a trapezoid within its limits: what a master sees of a shape is when it ends.
    fn start(&mut self, order: Move, actual: Demand) {
        let base = match order.origin {
            Origin::Zero => 0.0,
            Origin::Demand => self.generator.position(),
            Origin::Target => self.target,
            Origin::Actual => actual.position,
        };
        let limits @ Limits(v, a, d) = Limits::from(Vad {
            velocity: order.velocity.unwrap_or(self.predefined.velocity),
            acceleration: order.acceleration.unwrap_or(self.predefined.acceleration),
            deceleration: order.deceleration.unwrap_or(self.predefined.deceleration),
        });
        self.drop_all();
        match order.start {
            Start::Demand => {}
            Start::Actual => self.generator.set(actual.position, actual.velocity, 0.0),
            Start::Standstill => self.generator.set(actual.position, 0.0, 0.0),
        }
        self.target = base + f64::from(order.value) * METRE;
        self.resume = Some(limits);
        self.generator.go_to(self.target, v, a, d);
    }

    fn take_setpoint(
        &mut self,
        command: StreamCommand,
        now: Time,
        setpoint: Demand,
    ) -> Result<(), ErrorCode> {
        match &mut self.stream {
            Some(stream) if stream.command == command => stream.push(now, setpoint),
            _ => {
                self.armed = None;
                self.resume = None;
                self.stream =
                    Some(Stream::begin(command, now, setpoint, self.configured_ns, self.tolerance)?);
                Ok(())
            }
        }
    }

    /// Lets `dt_ns` pass, which end at `now`.
    pub(super) fn advance(&mut self, now: Time, dt_ns: u64, actual: Demand) -> Result<(), ErrorCode> {
        if let Some(stream) = &mut self.stream {
            match stream.output(now)? {
                Some(demand) => {
                    self.generator.set(demand.position, demand.velocity, demand.acceleration);
                    self.target = demand.position;
                }
                // Until the first setpoint is due, whatever ran before goes on.
                None => self.generator.advance(dt_ns),
            }
            return Ok(());
        }
        let before = self.generator.position();
        self.generator.advance(dt_ns);
        match self.armed {
            Some(Armed::After(order)) if !self.generator.is_moving() => self.start(order, actual),
            Some(Armed::Passing { positive, position, limits }) => {
                let after = self.generator.position();
                let passed = if positive {
                    before < position && position <= after
                } else {
                    after <= position && position < before
                };
                if passed {
                    self.armed = None;
                    if self.resume.is_some() {
                        self.resume = Some(limits);
                        self.resume();
                    }
                }
            }
            _ => {}
        }
        Ok(())
    }
}

/// Setpoints on their way to the demand (SG5 manual, streaming). The output runs 1.5 nominal periods behind and
/// interpolates: straight lines between bare positions, cubics where the velocity is given too.
#[derive(Debug)]
struct Stream {
    command: StreamCommand,
    /// Set by the first two commands, or configured.
    nominal_ns: Option<u64>,
    /// So many periods of silence are an underflow.
    patience: f64,
    /// So many setpoints are held ahead of the output.
    depth: usize,
    /// When the last command was received.
    received_at: Time,
    /// What the output has not passed yet, and the one setpoint before.
    points: VecDeque<Point>,
}

/// A setpoint and its instant on the time base, not yet delayed.
#[derive(Clone, Copy, Debug)]
struct Point {
    at: Time,
    demand: Demand,
}

impl Stream {
    fn begin(
        command: StreamCommand,
        now: Time,
        demand: Demand,
        configured_ns: u64,
        (patience, depth): (f64, usize),
    ) -> Result<Stream, ErrorCode> {
        let nominal_ns = command.has_configured_period().then_some(configured_ns);
        if let Some(period_ns) = nominal_ns {
            check_period(command, period_ns)?;
        }
        let mut points = VecDeque::with_capacity(depth + 2);
        points.push_back(Point { at: now, demand });
        Ok(Stream { command, nominal_ns, patience, depth, received_at: now, points })
    }

    fn push(&mut self, now: Time, mut demand: Demand) -> Result<(), ErrorCode> {
        let Some(last) = self.points.back().copied() else { return Ok(()) };
        let nominal_ns = match self.nominal_ns {
            Some(nominal_ns) => nominal_ns,
            None => {
                let interval_ns = now.since(self.received_at);
                check_period(self.command, interval_ns)?;
                self.nominal_ns = Some(interval_ns);
                interval_ns
            }
        };
        self.received_at = now;
        let at = if self.command.has_configured_period() {
            // One period each, whenever they come; a setpoint that the output would already have passed makes the
            // time base wait for it.
            (last.at + nominal_ns).max(now - nominal_ns / 2)
        } else {
            now
        };
        if !self.command.has_velocity() {
            let dt_ns = at.since(last.at).max(1);
            demand.velocity = (demand.position - last.demand.position) / seconds(dt_ns);
        }
        self.points.push_back(Point { at, demand });
        self.pass(now - (nominal_ns + nominal_ns / 2));
        // The front one has been reached.
        if self.points.len() > self.depth + 1 {
            return Err(ErrorCode::STREAM_OVERFLOW);
        }
        Ok(())
    }

    /// Drops the setpoints before the one that was reached last at `at`.
    fn pass(&mut self, at: Time) {
        while self.points.get(1).is_some_and(|next| next.at <= at) {
            self.points.pop_front();
        }
    }

    /// The demand at `now`; `None` before the first setpoint is due.
    fn output(&mut self, now: Time) -> Result<Option<Demand>, ErrorCode> {
        let silent_ns = now.since(self.received_at);
        let Some(nominal_ns) = self.nominal_ns else {
            let (_, longest_ns) = tolerated(self.command);
            return if silent_ns > longest_ns { Err(ErrorCode::STREAM_TOO_SLOW) } else { Ok(None) };
        };
        if silent_ns as f64 > nominal_ns as f64 * self.patience {
            return Err(ErrorCode::STREAM_UNDERFLOW);
        }
        let at = now - (nominal_ns + nominal_ns / 2);
        self.pass(at);
        let Some(from) = self.points.front().filter(|point| point.at <= at) else { return Ok(None) };
        let t = seconds(at.since(from.at));
        let Some(to) = self.points.get(1) else {
            // Nothing to go to yet: straight on, but not further than to where the next one should have been.
            let position = from.demand.position + from.demand.velocity * t.min(seconds(nominal_ns));
            return Ok(Some(Demand { position, velocity: from.demand.velocity, acceleration: 0.0 }));
        };
        let span = seconds(to.at.since(from.at).max(1));
        Ok(Some(if self.command.has_velocity() {
            cubic(from.demand, to.demand, span, t)
        } else {
            let velocity = (to.demand.position - from.demand.position) / span;
            let position = from.demand.position + velocity * t;
            Demand { position, velocity, acceleration: 0.0 }
        }))
    }
}

fn seconds(ns: u64) -> f64 {
    ns as f64 / S as f64
}

/// The shortest and longest first interval that a drive takes, ns.
fn tolerated(command: StreamCommand) -> (u64, u64) {
    let (shortest, longest) = command.period_range_ns();
    ((shortest as f64 * (1.0 - PERIOD_TOLERANCE)) as u64, (longest as f64 * (1.0 + PERIOD_TOLERANCE)) as u64)
}

fn check_period(command: StreamCommand, period_ns: u64) -> Result<(), ErrorCode> {
    let (shortest, longest) = tolerated(command);
    if period_ns < shortest {
        Err(ErrorCode::STREAM_TOO_FAST)
    } else if period_ns > longest {
        Err(ErrorCode::STREAM_TOO_SLOW)
    } else {
        Ok(())
    }
}

/// The cubic through two positions with their velocities, `span` apart, at `t` behind the first (Hermite form).
fn cubic(from: Demand, to: Demand, span: f64, t: f64) -> Demand {
    let slope = (to.position - from.position) / span;
    let c2 = (3.0 * slope - 2.0 * from.velocity - to.velocity) / span;
    let c3 = (from.velocity + to.velocity - 2.0 * slope) / (span * span);
    Demand {
        position: from.position + t * (from.velocity + t * (c2 + t * c3)),
        velocity: from.velocity + t * (2.0 * c2 + t * 3.0 * c3),
        acceleration: 2.0 * c2 + 6.0 * c3 * t,
    }
}
