//! User units, and the wire counts of reports in them.

use std::fmt;

use thiserror::Error;

/// The user unit of an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Unit {
    /// Millimetres.
    #[default]
    Millimetre,
    /// Revolutions.
    Revolution,
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Unit::Millimetre => "mm",
            Unit::Revolution => "rev",
        })
    }
}

/// How user units map onto the drive's position counts: `count = (position - offset) * counts_per_unit`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// The name of the unit.
    pub unit: Unit,
    /// Drive counts in one user unit; negative inverts the direction. Never zero or non-finite (checked by the plan).
    pub counts_per_unit: f64,
    /// The user position of the drive's count zero.
    pub offset: f64,
    /// Length of one turn of a rotary axis in user units; positions are then shown in `[0, modulo)`.
    pub modulo: Option<f64>,
}

/// A value that the wire cannot carry.
#[derive(Clone, Copy, PartialEq, Error)]
#[error("{value} {unit} is outside the range of the drive ({low} ... {high}): give a value inside it")]
pub struct RangeError {
    /// The requested value, in `unit`.
    pub value: f64,
    /// The unit of all three numbers.
    pub unit: &'static str,
    /// The smallest value that fits.
    pub low: f64,
    /// The largest value that fits.
    pub high: f64,
}
crate::debug_as_display!(RangeError);

impl Units {
    /// Millimetres on a drive that counts so many per millimetre.
    pub fn millimetres(counts_per_unit: f64) -> Units {
        Units { unit: Unit::Millimetre, counts_per_unit, offset: 0.0, modulo: None }
    }

    /// Revolutions of a motor on a drive that counts so many in one.
    #[doc(hidden)]
    pub fn revolutions(counts_per_unit: f64) -> Units {
        Units { unit: Unit::Revolution, ..Units::millimetres(counts_per_unit) }
    }

    /// Wire counts (unwrapped) to a user position.
    pub fn position(&self, counts: i64) -> f64 {
        self.folded(counts as f64 / self.counts_per_unit + self.offset)
    }

    /// A user position as the application sees it: on a rotary axis within one turn.
    #[inline]
    pub fn folded(&self, position: f64) -> f64 {
        self.modulo.map_or(position, |turn| position.rem_euclid(turn))
    }

    /// A wire distance or speed in counts to user units; no offset, no modulo.
    #[inline]
    pub fn distance(&self, counts: f64) -> f64 {
        counts / self.counts_per_unit
    }

    /// The distance between two positions whose 32-bit counts were unwrapped one by one: whole wrap-arounds are none.
    #[doc(hidden)]
    pub fn unwrapped(&self, distance: f64) -> f64 {
        let around = self.distance(WRAP).abs();
        distance - (distance / around).round() * around
    }

    /// The distance from one user position to another: on a rotary axis the shorter way, at most half a turn.
    pub fn way(&self, from: f64, to: f64) -> f64 {
        way(self.modulo, from, to)
    }
}

/// The same on an axis with this [`modulo`](Units::modulo).
#[inline]
pub fn way(modulo: Option<f64>, from: f64, to: f64) -> f64 {
    match modulo {
        Some(turn) => {
            let ahead = (to - from).rem_euclid(turn);
            if ahead > turn / 2.0 { ahead - turn } else { ahead }
        }
        None => to - from,
    }
}

/// The counts after which a 32-bit count begins again.
const WRAP: f64 = 4_294_967_296.0;

/// Follows a 32-bit wire count over its wrap-around.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unwrap {
    last: Option<i64>,
}

impl Unwrap {
    /// The unwrapped count: the value congruent to `raw` nearest to the last one.
    #[inline]
    pub fn next(&mut self, raw: i32) -> i64 {
        let next = match self.last {
            None => i64::from(raw),
            Some(last) => last + i64::from(raw.wrapping_sub(last as i32)),
        };
        self.last = Some(next);
        next
    }

    /// Discards the history: the next count stands for itself (after a restart of the drive).
    pub fn reset(&mut self) {
        self.last = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unwraps_in_both_directions() {
        let mut count = Unwrap::default();
        assert_eq!(count.next(i32::MAX), i64::from(i32::MAX));
        assert_eq!(count.next(i32::MIN), i64::from(i32::MAX) + 1);
        assert_eq!(count.next(i32::MAX), i64::from(i32::MAX));
        count.reset();
        assert_eq!(count.next(-5), -5);
    }

    #[test]
    fn rotary_positions_stay_inside_one_turn() {
        let rotary =
            Units { unit: Unit::Revolution, counts_per_unit: 1_000.0, offset: 0.25, modulo: Some(1.0) };
        assert_eq!(rotary.position(-500), 0.75);
    }
}
