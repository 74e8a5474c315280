//! A time curve while it runs.
//!
//! Knows the curve and how a command stretches it; no store and no state.
//!
//! Chosen where the manuals are silent: a curve's setpoints are positions of the axis, so that a curve that does
//! not begin at the motor's position makes it jump; the commands "to target" and "from actual position" shift and
//! stretch it so that it begins at the motor's position. A time scale of 200 % takes twice the time. Amplitudes
//! beyond 2000 %, including those that "to target" would need, and time scales beyond 200 % are error 0089h.

use std::sync::Arc;

use super::machine::CURVE_SCALE;
use super::motion::{Demand, METRE};
use crate::bus::linudp::curve::Curve;
use crate::bus::linudp::motion::{CurveFit, CurveStart};
use crate::bus::linudp::wire::ErrorCode;
use crate::time::{S, US};

/// One count of a curve's time, ns.
const TIME_NS: u64 = 10 * US;

/// The largest amplitude, and the largest time scale, in parts of 1.
const AMPLITUDE: f64 = 20.0;
const TIME_SCALE: f64 = 2.0;

/// A running curve.
#[derive(Debug)]
pub(super) struct TimeCurve {
    curve: Arc<Curve>,
    /// Position = offset + gain x setpoint; m, and m in a count.
    offset: f64,
    gain: f64,
    duration_ns: u64,
    elapsed_ns: u64,
}

impl TimeCurve {
    /// `curve` with the settings of the command, for a motor at `position`.
    pub(super) fn new(curve: Arc<Curve>, start: &CurveStart, position: f64) -> Result<TimeCurve, ErrorCode> {
        let own_ns = u64::from(curve.x_length) * TIME_NS;
        let time_ns = |time: i32| u64::try_from(time).unwrap_or(0) * TIME_NS;
        let (first, last) = (curve.position_at(0.0), curve.position_at(f64::INFINITY));
        // Through the position now, and through the target at the end.
        let through = |target: i32| {
            let amplitude = (f64::from(target) - position / METRE) / (last - first);
            (position / METRE - amplitude * first, amplitude)
        };
        let (offset, amplitude, duration_ns) = match start.fit {
            CurveFit::Plain if start.from_actual => (position / METRE - first, 1.0, own_ns),
            CurveFit::Plain => (0.0, 1.0, own_ns),
            CurveFit::Target(target) => {
                let (offset, amplitude) = through(target);
                (offset, amplitude, own_ns)
            }
            CurveFit::TargetInTime { target, time } => {
                let (offset, amplitude) = through(target);
                (offset, amplitude, time_ns(time))
            }
            CurveFit::Scaled { offset, time_scale, amplitude } => {
                let scale = f64::from(time_scale) / 1e4;
                if scale > TIME_SCALE {
                    return Err(CURVE_SCALE);
                }
                (offset.into(), f64::from(amplitude) / 1e3, (own_ns as f64 * scale).round() as u64)
            }
            CurveFit::InTime { offset, time, amplitude } => {
                (offset.into(), f64::from(amplitude) / 1e3, time_ns(time))
            }
        };
        // Including NaN: a curve that ends where it begins leads to no other target.
        let possible = amplitude.abs() <= AMPLITUDE;
        if !possible {
            return Err(CURVE_SCALE);
        }
        Ok(TimeCurve { curve, offset: offset * METRE, gain: amplitude * METRE, duration_ns, elapsed_ns: 0 })
    }

    /// Lets `dt_ns` pass: the demand then, and whether the curve is at its end.
    pub(super) fn advance(&mut self, dt_ns: u64) -> (Demand, bool) {
        let before = self.position();
        let from_ns = self.elapsed_ns;
        self.elapsed_ns = self.elapsed_ns.saturating_add(dt_ns).min(self.duration_ns);
        let position = self.position();
        let passed_ns = self.elapsed_ns - from_ns;
        let velocity = match passed_ns {
            0 => 0.0,
            ns => (position - before) / (ns as f64 / S as f64),
        };
        (Demand { position, velocity, acceleration: 0.0 }, self.elapsed_ns == self.duration_ns)
    }

    fn position(&self) -> f64 {
        let x = if self.elapsed_ns == self.duration_ns {
            // Even if it takes no time at all.
            f64::INFINITY
        } else {
            f64::from(self.curve.x_length) * (self.elapsed_ns as f64 / self.duration_ns as f64)
        };
        self.offset + self.gain * self.curve.position_at(x)
    }
}
