//! Whole numbers as drives have them: so many bits, with a sign or without.

/// A type of whole numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Integer {
    /// The bits, 1 ..= 64.
    pub bits: u32,
    /// It has a sign. One of 64 bits is taken for one with a sign in any case.
    pub signed: bool,
}

impl Integer {
    /// The one of whole bytes that people write so: `u8`, `i16`.
    pub fn named(name: &str) -> Option<Integer> {
        let bits = name.strip_prefix(['u', 'i']).filter(|bits| ["8", "16", "32", "64"].contains(bits))?;
        Some(Integer { bits: bits.parse().ok()?, signed: name.starts_with('i') })
    }

    /// The lowest and the highest value.
    pub const fn range(self) -> (i64, i64) {
        match (self.bits, self.signed) {
            (64, _) => (i64::MIN, i64::MAX),
            (bits, true) => (-1 << (bits - 1), (1 << (bits - 1)) - 1),
            (bits, false) => (0, (1 << bits) - 1),
        }
    }

    /// The raw bits of a value, 0 above them.
    pub const fn raw(self, number: i64) -> u64 {
        number as u64 & u64::MAX >> (64 - self.bits)
    }

    /// The value of raw bits. Higher bits are ignored.
    pub const fn number(self, raw: u64) -> i64 {
        let above = 64 - self.bits;
        match self.signed {
            true => (raw << above) as i64 >> above,
            false => (raw << above >> above) as i64,
        }
    }

    /// The value from `low` to `high` that is meant by raw bits which may have their sign above them: that of a number
    /// of 64 bits, or of 32.
    pub fn number_within(self, raw: u64, (low, high): (i64, i64)) -> Option<i64> {
        let own = (self.raw(raw as i64) == raw).then(|| self.number(raw));
        let word = u32::try_from(raw).ok().map(|word| i64::from(word as i32));
        [own, Some(raw as i64), word].into_iter().flatten().find(|number| (low..=high).contains(number))
    }
}

/// A number of decimal digits and nothing else.
pub fn decimal<T: std::str::FromStr>(digits: &str) -> Option<T> {
    digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok())?
}

/// A number of hexadecimal digits and nothing else.
pub fn hexadecimal(digits: &str) -> Option<u64> {
    u64::from_str_radix(digits, 16).ok().filter(|_| !digits.starts_with('+'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_its_bits_with_or_without_a_sign() {
        for (bits, signed, low, high) in [
            (8, true, -128, 127),
            (16, false, 0, 0xFFFF),
            (32, true, i32::MIN.into(), i32::MAX.into()),
            (64, true, i64::MIN, i64::MAX),
            (64, false, i64::MIN, i64::MAX),
        ] {
            let kind = Integer { bits, signed };
            assert_eq!(kind.range(), (low, high));
            for number in [low, low + 1, -1, 0, 1, high - 1, high] {
                let is_one = (low..=high).contains(&number);
                assert_eq!(kind.number(kind.raw(number)) == number, is_one, "{kind:?} {number}");
            }
        }
    }

    #[test]
    fn a_sign_may_stand_above_the_bits() {
        let (short, range) = (Integer { bits: 16, signed: true }, (-2, 300));
        for (raw, number) in [
            (0xFFFE, Some(-2)),
            (0xFFFF_FFFE, Some(-2)),
            (-2_i64 as u64, Some(-2)),
            (300, Some(300)),
            (0xFFFD, None),
            (0x1_0001, None),
        ] {
            assert_eq!(short.number_within(raw, range), number, "{raw:#x}");
        }
        assert_eq!(Integer { bits: 16, signed: false }.number_within(0xFFFE, (0, 0xFFFF)), Some(0xFFFE));
    }
}
