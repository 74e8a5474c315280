//! The rows of an axis that swings: a sine whose amplitude grows from 0 and dies away to 0, so that it begins and ends
//! at standstill.

use std::f64::consts::TAU;

use fieldbeat_config::soak::Swing;
use fieldbeat_core::axis::Row;

/// The wave grows and dies away within this time, s.
pub const FADE_S: f64 = 1.0;

/// How deep the streams are queued, s: a thread without real-time rights waits for so long on a busy host.
const DEPTH_S: f64 = 1.0;

/// The rows of an axis.
#[derive(Debug)]
pub struct Wave {
    swing: Swing,
    /// Of the sine, rad.
    phase: f64,
    /// Time between two rows, s.
    row_s: f64,
    rows: u64,
    /// The number of the next one.
    next: u64,
}

impl Wave {
    /// A wave that is so long, with this phase, a row each `row_s`.
    pub fn new(swing: Swing, phase: f64, row_s: f64, length_s: f64) -> Wave {
        Wave { swing, phase, row_s, rows: (length_s / row_s).round() as u64, next: 0 }
    }

    /// Its rows have not all been taken.
    pub fn goes_on(&self) -> bool {
        self.next < self.rows
    }

    /// Ends it sooner where its rows would take longer: on a host that skips cycles each of them costs more than its
    /// time, and so does each that is `waiting` in the queue. Only between the two fades, so that it stays smooth.
    pub fn end_within(&mut self, left_s: f64, waiting: usize) {
        let fade = (FADE_S / self.row_s).ceil() as u64;
        if self.next > fade && self.next + fade < self.rows {
            let left = ((left_s / self.row_s).ceil() as u64).saturating_sub(waiting as u64);
            let most = self.next + left.max(fade + 1);
            self.rows = self.rows.min(most);
        }
    }

    /// So many rows are queued at a time.
    pub fn depth(&self) -> usize {
        ((DEPTH_S / self.row_s) as usize).max(16)
    }
}

impl Iterator for Wave {
    type Item = Row;

    fn next(&mut self) -> Option<Row> {
        let last = self.rows.checked_sub(1)?;
        if self.next > last {
            return None;
        }
        let t = self.next as f64 * self.row_s;
        let (fade, fade_v, fade_a) = fade(t, last as f64 * self.row_s);
        let w = TAU / self.swing.period_s;
        let (sin, cos) = (w * t - self.phase).sin_cos();
        let Swing { centre, amplitude, .. } = self.swing;
        let is_last = self.next == last;
        self.next += 1;
        Some(Row {
            position: centre + amplitude * fade * sin,
            velocity: amplitude * (fade_v * sin + fade * w * cos),
            acceleration: amplitude * (fade_a * sin + 2.0 * fade_v * w * cos - fade * w * w * sin),
            last: is_last,
        })
    }
}

/// A smooth step up within [`FADE_S`] from the begin and down before the end, with its first and second derivative.
fn fade(t: f64, end: f64) -> (f64, f64, f64) {
    let (x, sign) = if t < end / 2.0 { (t / FADE_S, 1.0) } else { ((end - t) / FADE_S, -1.0) };
    if x >= 1.0 {
        return (1.0, 0.0, 0.0);
    }
    let x = x.max(0.0);
    // 6x^5 - 15x^4 + 10x^3: position, velocity and acceleration are 0 at both ends.
    let value = x * x * x * (10.0 + x * (6.0 * x - 15.0));
    let slope = 30.0 * x * x * (1.0 - x) * (1.0 - x) / FADE_S;
    let bend = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / (FADE_S * FADE_S);
    (value, sign * slope, bend)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_ends_in_its_time_on_a_host_that_skips_every_fifth_cycle_and_stays_smooth() {
        let (row_s, length_s) = (0.001, 8.0);
        let swing = Swing { centre: 200.0, amplitude: 40.0, period_s: 2.0 };
        for share in [1.0, 0.8, 0.5] {
            let mut wave = Wave::new(swing, 1.0, row_s, length_s);
            let (mut rows, mut before) = (0, Row { position: swing.centre, ..Row::default() });
            while !before.last {
                let waiting = rows.min(wave.depth());
                let left_s = length_s - (rows - waiting) as f64 * row_s / share;
                wave.end_within(left_s, waiting);
                let row = wave.next().expect("it ends with its last row");
                let steepest = swing.amplitude * (TAU / swing.period_s + 2.0 / FADE_S) * row_s;
                assert!((row.position - before.position).abs() <= steepest, "{before:?} {row:?}");
                assert!((row.velocity - before.velocity).abs() <= 1_000.0 * row_s, "{before:?} {row:?}");
                (rows, before) = (rows + 1, row);
            }
            assert_eq!(wave.next(), None);
            assert!((before.position - swing.centre).abs() < 1e-9 && before.velocity.abs() < 1e-9);
            let took_s = rows as f64 * row_s / share;
            // The rows that wait take longer than their time, too.
            assert!(took_s <= length_s + (FADE_S + DEPTH_S) / share - DEPTH_S, "{took_s} s at {share}");
            assert!(share < 1.0 || rows == 8_000, "{rows}");
        }
    }
}
