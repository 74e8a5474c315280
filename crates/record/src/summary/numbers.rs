//! Numbers as text.

use fieldbeat_core::time::three_digits;
use fieldbeat_telemetry::signals::shown;

/// A count and its noun, singular or plural.
pub fn plural(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// To the finest step of a drive's own variables, without the digits that are only binary, and with one zero only.
pub fn plain(value: f64) -> f64 {
    (value * 1e4).round() / 1e4 + 0.0
}

/// A value that a drive reports; NaN is none.
pub fn reported(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// A value with so many decimals; a dash if there is none.
pub fn decimals(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// A span in the unit of times, with three significant digits, or a dash.
pub(super) fn us(ns: Option<u64>) -> String {
    let Some(ns) = ns.map(three_digits) else { return String::from("-") };
    let digits = match ns {
        0 | 100_000.. => 0,
        10_000.. => 1,
        1_000.. => 2,
        _ => 3,
    };
    format!("{:.digits$}", shown(ns as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_one_unit_and_three_digits() {
        let ns = [0, 51, 847, 1_000, 9_996, 28_911, 99_950, 129_419, 12_345_678];
        let expected = ["0", "0.051", "0.847", "1.00", "10.0", "28.9", "100", "129", "12300"];
        assert_eq!(ns.map(|ns| us(Some(ns))), expected);
        assert_eq!(
            (us(None), plural(1, "cycle"), plural(0, "cycle")),
            ("-".into(), "1 cycle".into(), "0 cycles".into())
        );
    }

    #[test]
    fn an_unknown_value_is_a_dash() {
        let text = |value| decimals(reported(value), 3);
        assert_eq!([1.0, -0.25, f64::NAN, f64::INFINITY].map(text), ["1.000", "-0.250", "-", "-"]);
    }
}
