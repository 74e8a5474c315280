//! The one clock of the whole program: nanoseconds of CLOCK_MONOTONIC as a plain value.
//!
//! A `Time` is only ever taken from a [`Clock`](crate::rt::Clock) or a carrier, so the same code runs on the
//! machine's clock and in virtual time.

use std::fmt;
use std::ops::{Add, Sub};
use std::time::Duration;

/// One microsecond in nanoseconds.
pub const US: u64 = 1_000;
/// One millisecond in nanoseconds.
pub const MS: u64 = 1_000_000;
/// One second in nanoseconds.
pub const S: u64 = 1_000_000_000;

/// An instant: nanoseconds of CLOCK_MONOTONIC (or of the virtual clock).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Time(pub u64);

impl Time {
    /// Nanoseconds from `earlier` to `self`; 0 if `earlier` is the later one.
    pub fn since(self, earlier: Time) -> u64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// Later by so many nanoseconds, saturating at the end of time.
impl Add<u64> for Time {
    type Output = Time;
    fn add(self, ns: u64) -> Time {
        Time(self.0.saturating_add(ns))
    }
}

/// Earlier by so many nanoseconds, saturating at zero.
impl Sub<u64> for Time {
    type Output = Time;
    fn sub(self, ns: u64) -> Time {
        Time(self.0.saturating_sub(ns))
    }
}

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09} s", self.0 / S, self.0 % S)
    }
}

/// Nanoseconds of a `Duration`, saturating at 584 years, which is enough for every setting.
pub fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

/// A span rounded to three significant digits: more than that no measurement repeats.
pub fn three_digits(ns: u64) -> u64 {
    let step = 10_u64.pow(ns.checked_ilog10().unwrap_or(0).saturating_sub(2));
    // The largest spans have no room above them.
    ns.saturating_add(step / 2) / step * step
}

/// A time span in nanoseconds as a person reads it: `1 ms`, `250 us`, `1.5 s`, at most three decimals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ns(pub u64);

impl fmt::Display for Ns {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (unit, name) = match self.0 {
            S.. => (S, "s"),
            MS.. => (MS, "ms"),
            US.. => (US, "us"),
            0 => return f.write_str("0"),
            ns => return write!(f, "{ns} ns"),
        };
        let text = format!("{:.3}", self.0 as f64 / unit as f64);
        write!(f, "{} {name}", text.trim_end_matches('0').trim_end_matches('.'))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_are_enough() {
        let cases = [(0, 0), (999, 999), (1_000, 1_000), (76_287, 76_300), (999_500, 1_000_000)];
        assert!(cases.iter().all(|(ns, rounded)| three_digits(*ns) == *rounded));
    }

    #[test]
    fn spans_read_naturally() {
        let cases = [
            (0, "0"),
            (999, "999 ns"),
            (US, "1 us"),
            (250 * US, "250 us"),
            (MS, "1 ms"),
            (1_234_567, "1.235 ms"),
            (10 * MS, "10 ms"),
            (3 * S / 2, "1.5 s"),
            (100 * S, "100 s"),
        ];
        for (ns, text) in cases {
            assert_eq!(Ns(ns).to_string(), text);
        }
    }
}
