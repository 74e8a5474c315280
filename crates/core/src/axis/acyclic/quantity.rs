//! What the counts of a parameter measure: as people read it, and as they write it.

use super::notation::NotationError;

/// A quantity that a parameter counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quantity {
    /// The value of a count in the unit.
    pub scale: Scale,
    /// The unit; empty for a plain number.
    pub unit: &'static str,
}

/// The value of a count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// `10^-decimals` of the unit: exact.
    Decimals(u32),
    /// `count = (value - zero) * per_unit`, rounded.
    Linear {
        /// Counts in one unit.
        per_unit: f64,
        /// The value whose count is 0.
        zero: f64,
    },
}

impl Quantity {
    /// Of so many decimals; `None`: its counts are the values, without a unit.
    pub fn decimals(decimals: u32, unit: &'static str) -> Option<Quantity> {
        let is_plain = decimals == 0 && unit.is_empty();
        (!is_plain).then_some(Quantity { scale: Scale::Decimals(decimals), unit })
    }

    /// The raw value of `text`, which is a value of the quantity, with its unit behind it or without. `raw_of` gives
    /// the raw value of a count, if that is in the range of its type.
    pub(super) fn raw(
        self,
        text: &str,
        raw_of: impl FnOnce(&str) -> Result<u64, NotationError>,
    ) -> Result<u64, NotationError> {
        let Some(count) = self.count(text) else {
            return Err(NotationError::Value { value: text.to_owned(), form: self.form() });
        };
        raw_of(&count.to_string()).map_err(|error| match error {
            NotationError::Range { low, high, .. } => NotationError::OutOfReach {
                value: text.to_owned(),
                low: self.show(low),
                high: self.show(high),
            },
            error => error,
        })
    }

    /// The count of a value.
    fn count(self, text: &str) -> Option<i64> {
        let text = text.trim();
        let end = text.find(|c: char| !c.is_ascii_digit() && !matches!(c, '-' | '.')).unwrap_or(text.len());
        let (number, unit) = text.split_at(end);
        let unit = unit.trim_start();
        if !unit.is_empty() && plain(unit) != plain(self.unit) {
            return None;
        }
        let (whole, part) = number.split_once('.').unwrap_or((number, "0"));
        let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        if !digits(whole.strip_prefix('-').unwrap_or(whole)) || !digits(part) {
            return None;
        }
        match self.scale {
            Scale::Decimals(decimals) => {
                // A nought more is the same value.
                let part = part.trim_end_matches('0');
                let places = u32::try_from(part.len()).ok().filter(|places| *places <= decimals)?;
                let number: i64 = format!("{whole}{part}").parse().ok()?;
                number.checked_mul(10_i64.checked_pow(decimals - places)?)
            }
            // Values out of range saturate, and are out of range.
            Scale::Linear { per_unit, zero } => {
                number.parse::<f64>().ok().map(|value| ((value - zero) * per_unit).round() as i64)
            }
        }
    }

    /// A count as a value, with the unit.
    pub fn show(self, count: i64) -> String {
        let value = match self.scale {
            Scale::Decimals(decimals) => {
                format!("{:.*}", decimals as usize, count as f64 / 10_f64.powi(decimals as i32))
            }
            Scale::Linear { per_unit, zero } => {
                let text = format!("{:.4}", count as f64 / per_unit + zero);
                text.trim_end_matches('0').trim_end_matches('.').to_owned()
            }
        };
        format!("{value} {}", self.unit).trim_end().to_owned()
    }

    /// The correct form of a value.
    fn form(self) -> String {
        let unit = match self.unit {
            "" => "a value".to_owned(),
            unit => format!("a value in {unit}, with its unit or without"),
        };
        let decimals = match self.scale {
            Scale::Decimals(1) => ", up to 1 decimal".to_owned(),
            Scale::Decimals(decimals @ 1..) => format!(", up to {decimals} decimals"),
            Scale::Decimals(0) | Scale::Linear { .. } => String::new(),
        };
        format!("{unit}{decimals}, or its bits as 0x...; or a count, with --raw")
    }
}

/// A unit as any keyboard writes it.
fn plain(unit: &str) -> String {
    unit.chars().filter(|c| *c != '°').map(|c| if c == '²' { '2' } else { c }).collect()
}

/// A value as people read it: what it means, if it is more than a number, and the number itself with its bits.
pub fn shown(means: Option<String>, number: i64, bits: u64) -> String {
    match means {
        Some(means) => format!("{means} (raw {number}, 0x{bits:X})"),
        None => format!("{number} (0x{bits:X})"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPEED: Quantity = Quantity { scale: Scale::Decimals(1), unit: "rpm" };
    const CELSIUS: Quantity = Quantity { scale: Scale::Linear { per_unit: 1.02, zero: -50.0 }, unit: "°C" };
    const PER_S2: Quantity = Quantity { scale: Scale::Linear { per_unit: 6.0, zero: 0.0 }, unit: "rev/s²" };

    #[test]
    fn a_shown_value_is_parsed_back_with_its_unit_or_without() {
        for (quantity, count) in [(SPEED, 15_000), (SPEED, -5), (SPEED, 0), (CELSIUS, 82), (PER_S2, 600)] {
            let shown = quantity.show(count);
            assert_eq!(quantity.count(&shown), Some(count), "{shown}");
            let number = shown.split(' ').next().unwrap();
            assert_eq!(quantity.count(number), Some(count), "{number}");
        }
        for (quantity, text, count) in [
            (SPEED, "1500", 15_000),
            (SPEED, "1500.00rpm", 15_000),
            (SPEED, " -0.5  rpm ", -5),
            (CELSIUS, "30.39 C", 82),
            (PER_S2, "100 rev/s2", 600),
            (PER_S2, "0.17", 1),
        ] {
            assert_eq!(quantity.count(text), Some(count), "{text}");
        }
    }

    #[test]
    fn another_unit_and_what_is_no_value_are_refused_with_what_would_be_right() {
        let raw = |text: &str| SPEED.raw(text, |count| Ok(count.parse::<i64>().unwrap() as u64));
        for text in ["1500 rps", "1500 mm", "0.05", "1500.", ".5", "--1", "1.-5", "1e3", "", "rpm", "fast"] {
            let error = raw(text).unwrap_err().to_string();
            assert!(
                error.starts_with(&format!("{text} is not a value of this parameter; write ")),
                "{error}"
            );
            assert!(error.contains("a value in rpm") && error.contains("--raw"), "{error}");
        }
        let range = |_: &str| Err(NotationError::Range { value: "9".into(), low: 0, high: 30_000 });
        let error = SPEED.raw("4000 rpm", range).unwrap_err().to_string();
        assert_eq!(error, "4000 rpm is out of the range of its type, 0.0 rpm ... 3000.0 rpm");
        assert_eq!(SPEED.count("922337203685477580.8"), None, "more than 64 bits");
    }
}
