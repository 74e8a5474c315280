//! The rows of an axis that swings: a sine whose amplitude grows from 0 and dies away to 0, so that it begins and ends
//! at standstill.

use std::f64::consts::{FRAC_PI_2, TAU};

use fieldbeat_config::soak::Swing;
use fieldbeat_core::axis::Row;

/// How deep the streams are queued, s: a thread without real-time rights waits for so long on a busy host.
const DEPTH_S: f64 = 1.0;

/// The rows of an axis.
#[derive(Debug)]
pub struct Wave {
    swing: Swing,
    /// Of the sine, rad.
    phase: f64,
    /// It grows and dies away within this time, s.
    fade_s: f64,
    /// Time between two rows, s.
    row_s: f64,
    rows: u64,
    /// The number of the next one.
    next: u64,
}

impl Wave {
    /// A wave that is so long, with this phase, a row each `row_s`, and grows and dies away within `fade` periods.
    pub fn new(swing: Swing, phase: f64, fade: f64, row_s: f64, length_s: f64) -> Wave {
        let fade_s = fade * swing.period_s;
        Wave { swing, phase, fade_s, row_s, rows: (length_s / row_s).round() as u64, next: 0 }
    }

    /// The rows have not all been taken.
    pub fn goes_on(&self) -> bool {
        self.next < self.rows
    }

    /// Ends it sooner where its rows would take longer: on a host that skips cycles each of them costs more than its
    /// time, and so does each that is `waiting` in the queue. Only between the two fades, so that it stays smooth.
    pub fn end_within(&mut self, left_s: f64, waiting: usize) {
        let fade = (self.fade_s / self.row_s).ceil() as u64;
        if self.next > fade && self.next + fade < self.rows {
            let left = ((left_s / self.row_s).ceil() as u64).saturating_sub(waiting as u64);
            let most = self.next + left.max(fade + 1);
            self.rows = self.rows.min(most);
        }
    }

    /// The number of rows that are queued at a time.
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
        let (fade, fade_v, fade_a) = fade(t, last as f64 * self.row_s, self.fade_s);
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

/// A smooth step up within `fade_s` from the begin and down before the end, with its first and second derivative: the
/// sine of an angle that rises to a right one. A step and the sine that it multiplies then have no larger velocity than
/// the sine alone, if the angle rises no faster than the sine's own does: within 0.47 of its period.
fn fade(t: f64, end: f64, fade_s: f64) -> (f64, f64, f64) {
    let (x, sign) = if t < end / 2.0 { (t / fade_s, 1.0) } else { ((end - t) / fade_s, -1.0) };
    if x >= 1.0 {
        return (1.0, 0.0, 0.0);
    }
    let x = x.max(0.0);
    // 6x^5 - 15x^4 + 10x^3: value, slope and bend are those of rest at both ends.
    let angle = FRAC_PI_2 * x * x * x * (10.0 + x * (6.0 * x - 15.0));
    let slope = FRAC_PI_2 * 30.0 * x * x * (1.0 - x) * (1.0 - x) / fade_s;
    let bend = FRAC_PI_2 * 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / (fade_s * fade_s);
    let (sin, cos) = angle.sin_cos();
    (sin, sign * slope * cos, bend * cos - slope * slope * sin)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_ends_in_its_time_on_a_host_that_skips_every_fifth_cycle_and_stays_smooth() {
        let (row_s, length_s) = (0.001, 8.0);
        let swing = Swing { centre: 200.0, amplitude: 40.0, period_s: 2.0 };
        let fade_s = 0.5 * swing.period_s;
        for share in [1.0, 0.8, 0.5] {
            let mut wave = Wave::new(swing, 1.0, 0.5, row_s, length_s);
            let (mut rows, mut before) = (0, Row { position: swing.centre, ..Row::default() });
            while !before.last {
                let waiting = rows.min(wave.depth());
                let left_s = length_s - (rows - waiting) as f64 * row_s / share;
                wave.end_within(left_s, waiting);
                let row = wave.next().expect("it ends with its last row");
                let steepest = swing.amplitude * TAU / swing.period_s * row_s;
                assert!((row.position - before.position).abs() <= steepest, "{before:?} {row:?}");
                assert!((row.velocity - before.velocity).abs() <= 1_000.0 * row_s, "{before:?} {row:?}");
                (rows, before) = (rows + 1, row);
            }
            assert_eq!(wave.next(), None);
            assert!((before.position - swing.centre).abs() < 1e-9 && before.velocity.abs() < 1e-9);
            let took_s = rows as f64 * row_s / share;
            // The rows that wait take longer than their time, too.
            assert!(took_s <= length_s + (fade_s + DEPTH_S) / share - DEPTH_S, "{took_s} s at {share}");
            assert!(share < 1.0 || rows == 8_000, "{rows}");
        }
    }

    #[test]
    fn a_wave_that_grows_is_never_faster_than_the_whole_one() {
        for seed in 0..200 {
            let part = |ratio: f64| (f64::from(seed) * ratio).fract();
            let period_s = 0.1 + 20.0 * part(0.618_034);
            let swing = Swing { centre: 7.0, amplitude: 0.01 + 300.0 * part(0.754_878), period_s };
            let (phase, row_s) = (TAU * part(0.569_840), 0.001 * period_s);
            let w = TAU / period_s;
            let [velocity, acceleration] = [swing.amplitude * w, swing.amplitude * w * w];
            for (fade, factor) in [(0.5, 2.0), (Swing::FADE, 1.015)] {
                let rows = Wave::new(swing, phase, fade, row_s, 5.0 * period_s);
                let most = |of: fn(&Row) -> f64| rows_of(&rows).map(|row| of(&row).abs()).fold(0.0, f64::max);
                assert!(most(|row| row.velocity) <= velocity * (1.0 + 1e-12), "seed {seed}, {fade}");
                assert!(most(|row| row.acceleration) <= acceleration * factor, "seed {seed}, {fade}");
                assert!(most(|row| row.position) <= swing.centre + swing.amplitude, "seed {seed}, {fade}");
            }
        }
    }

    fn rows_of(wave: &Wave) -> impl Iterator<Item = Row> {
        Wave { swing: wave.swing, ..*wave }
    }
}
