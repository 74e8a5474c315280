//! Streamed setpoints: period, delay, interpolation, and the four errors.
//!
//! Knows no telegram and no command count.

use std::collections::VecDeque;

use super::codec::commands::StreamKind;
use super::codec::errors;
use super::demand::Demand;
use fieldbeat_core::time::{S, Time};

/// How far the first interval may lie outside the period range of its command, in parts of 1: a real network jitters.
const PERIOD_TOLERANCE: f64 = 0.25;

/// Setpoints under way to the demand (SG5 manual, streaming). The output runs 1.5 nominal periods behind and
/// interpolates: straight lines between bare positions, cubics where the velocity is given too.
#[derive(Debug)]
pub(super) struct Stream {
    pub command: StreamKind,
    /// Set by the first two commands, or configured.
    nominal_ns: Option<u64>,
    /// So many periods of silence are an underflow.
    patience: f64,
    /// So many setpoints are held ahead of the output.
    depth: usize,
    /// When the last command was received.
    received_at: Time,
    /// Setpoints that the output has not passed yet, and the one before.
    points: VecDeque<Point>,
}

/// A setpoint and its instant on the time base, not yet delayed.
#[derive(Clone, Copy, Debug)]
struct Point {
    at: Time,
    demand: Demand,
}

impl Stream {
    /// The first setpoint.
    pub(super) fn begin(
        command: StreamKind,
        now: Time,
        demand: Demand,
        configured_ns: u64,
        (patience, depth): (f64, usize),
    ) -> Result<Stream, u16> {
        let nominal_ns = command.has_configured_period().then_some(configured_ns);
        if let Some(period_ns) = nominal_ns {
            check_period(command, period_ns)?;
        }
        let mut points = VecDeque::with_capacity(depth + 2);
        points.push_back(Point { at: now, demand });
        Ok(Stream { command, nominal_ns, patience, depth, received_at: now, points })
    }

    /// The next setpoint.
    pub(super) fn push(&mut self, now: Time, mut demand: Demand) -> Result<(), u16> {
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
            // One period each, independent of their arrival; a setpoint that the output would already have passed
            // delays the time base.
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
            return Err(errors::STREAM_OVERFLOW);
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
    pub(super) fn output(&mut self, now: Time) -> Result<Option<Demand>, u16> {
        let silent_ns = now.since(self.received_at);
        let Some(nominal_ns) = self.nominal_ns else {
            let (_, longest_ns) = tolerated(self.command);
            return if silent_ns > longest_ns { Err(errors::STREAM_TOO_SLOW) } else { Ok(None) };
        };
        if silent_ns as f64 > nominal_ns as f64 * self.patience {
            return Err(errors::STREAM_UNDERFLOW);
        }
        let at = now - (nominal_ns + nominal_ns / 2);
        self.pass(at);
        let Some(from) = self.points.front().filter(|point| point.at <= at) else { return Ok(None) };
        let t = seconds(at.since(from.at));
        let Some(to) = self.points.get(1) else {
            // No next setpoint yet: straight on, but not further than to where the next one should have been.
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

/// The shortest and longest first interval that a drive accepts, ns.
fn tolerated(command: StreamKind) -> (u64, u64) {
    let (shortest, longest) = command.periods_ns();
    ((shortest as f64 * (1.0 - PERIOD_TOLERANCE)) as u64, (longest as f64 * (1.0 + PERIOD_TOLERANCE)) as u64)
}

fn check_period(command: StreamKind, period_ns: u64) -> Result<(), u16> {
    let (shortest, longest) = tolerated(command);
    if period_ns < shortest {
        Err(errors::STREAM_TOO_FAST)
    } else if period_ns > longest {
        Err(errors::STREAM_TOO_SLOW)
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
