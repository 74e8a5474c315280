//! Results of carriers as words of the log.

use crate::net::Broken;
use crate::net::frames::Unsent;

/// The bit of an error of the operating system.
const FAILED: u64 = 1 << 32;

/// Why a connection cannot be used.
pub(super) fn broken(why: Broken) -> u64 {
    match why {
        Broken::Absent => 0,
        Broken::Closed => 1,
        Broken::Failed(error) => FAILED | u64::from(error.cast_unsigned()),
    }
}

/// The same of a word.
pub(super) fn broken_of(word: u64) -> Broken {
    match word {
        0 => Broken::Absent,
        1 => Broken::Closed,
        error => Broken::Failed((error as u32).cast_signed()),
    }
}

/// Why a frame was not sent.
pub(super) fn unsent(why: Unsent) -> u64 {
    match why {
        Unsent::Down => 0,
        Unsent::Full => 1,
        Unsent::Failed(error) => FAILED | u64::from(error.cast_unsigned()),
    }
}

/// The same of a word.
pub(super) fn unsent_of(word: u64) -> Unsent {
    match word {
        0 => Unsent::Down,
        1 => Unsent::Full,
        error => Unsent::Failed((error as u32).cast_signed()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_pass_through_words() {
        for why in [Broken::Absent, Broken::Closed, Broken::Failed(0), Broken::Failed(104)] {
            assert_eq!(broken_of(broken(why)), why);
        }
        for why in [Unsent::Down, Unsent::Full, Unsent::Failed(1), Unsent::Failed(-1)] {
            assert_eq!(unsent_of(unsent(why)), why);
        }
    }
}
