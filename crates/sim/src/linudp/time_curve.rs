//! A time curve while it runs.
//!
//! Knows the curve and how the commands 040x ... 04Fx stretch it; no store and no state.
//!
//! Chosen where the manuals are silent: a curve's setpoints are positions of the axis, so that a curve that does
//! not begin at the motor's position makes it jump; the commands "to target" and "from actual position" shift and
//! stretch it so that it begins at the motor's position. A time scale of 200 % takes twice the time. Amplitudes
//! beyond 2000 %, including those that "to target" would need, and time scales beyond 200 % are error 0089h.

use super::codec::errors::CURVE_SCALE;
use super::codec::stored::Curve;
use super::demand::{Demand, METRE};
use fieldbeat_core::time::{S, US};

/// One count of a curve's time, ns.
const TIME_NS: u64 = 10 * US;

/// The largest amplitude, and the largest time scale, in parts of 1.
const AMPLITUDE: f64 = 20.0;
const TIME_SCALE: f64 = 2.0;

/// A running curve.
#[derive(Debug)]
pub(super) struct TimeCurve {
    curve: Curve,
    /// Position = offset + gain x setpoint; m, and m in a count.
    offset: f64,
    gain: f64,
    duration_ns: u64,
    elapsed_ns: u64,
}

impl TimeCurve {
    /// `curve` as command 04`sub`x stretches it with its fields, for a motor at `position`.
    pub(super) fn new(
        curve: Curve,
        sub: u16,
        [a, b, c, _]: [i64; 4],
        position: f64,
    ) -> Result<TimeCurve, u16> {
        let own_ns = u64::from(curve.length) * TIME_NS;
        let time_ns = |time: i64| u64::try_from(time).unwrap_or(0) * TIME_NS;
        let (first, last) = (curve.position_at(0.0), curve.position_at(1.0));
        // Through the position now, and through the target at the end.
        let through = |target: i64| {
            let amplitude = (target as f64 - position / METRE) / (last - first);
            (position / METRE - amplitude * first, amplitude)
        };
        let ((offset, amplitude), duration_ns) = match sub {
            0x0 => ((0.0, 1.0), own_ns),
            0x1 => ((position / METRE - first, 1.0), own_ns),
            // To a target, in its own time or in another one.
            0x2 | 0xA | 0xC => (through(a), own_ns),
            0x3 | 0xE | 0xF => (through(a), time_ns(b)),
            // With an offset and an amplitude, by a scale of its time or in another time.
            0x4 => {
                let scale = b as f64 / 1e4;
                if scale > TIME_SCALE {
                    return Err(CURVE_SCALE);
                }
                ((a as f64, c as f64 / 1e3), (own_ns as f64 * scale).round() as u64)
            }
            _ => ((a as f64, c as f64 / 1e3), time_ns(b)),
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
        // At its end even if it takes no time at all.
        let share = if self.elapsed_ns == self.duration_ns {
            1.0
        } else {
            self.elapsed_ns as f64 / self.duration_ns as f64
        };
        self.offset + self.gain * self.curve.position_at(share)
    }
}
