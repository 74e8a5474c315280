//! Whether another master is on the wire: what is a sign of one, and how many signs are enough.
//!
//! A token has no check byte, so that noise can look like one: three bytes. What another master really sends is
//! different. It listens, claims a silent wire with two tokens to itself, and then goes on without end: requests, each
//! with a check byte, and a token to itself behind them. Or it waits for a search, and answers it.
//!
//! | sign | weight | of a given address in one burst of random bytes |
//! |---|---|---|
//! | a token from one station to another | 0 | |
//! | a token to itself | 1 | 2^-24 |
//! | a request with its check byte | 2 | 2^-34 as SD1, 2^-32 as SD3, less as SD2 |
//! | an answer to a search of ours, with its check byte | 4 | 2^-41, while that is awaited |
//!
//! A weight of [`ENOUGH`] from one address in one second is another master: the two tokens of its claim and one
//! request, two requests, or four tokens. A second begins with its first sign, so that three of them may have been in
//! the second before: at the latest the seventh token, or the third request, within a second that follows.
//!
//! A thousand bursts a second, each of 14 bytes or more, leave no room for an exchange. They name another master
//! less than once in 5 000 years: 127 addresses · (1000 · 2^-32 · 1.25)² / 2 a second for two requests, and less for
//! what has a token in it. The own token with one bit changed, as a distorted echo, is none to itself.

use fieldbeat_core::time::{S, Time};

/// The weight of signs that is enough.
const ENOUGH: u8 = 4;
/// Signs count together for so long, ns; a master that was not received for so long is gone.
const WITHIN_NS: u64 = S;

/// A telegram of another master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sign {
    /// A token from one station to another.
    Passed,
    /// A token to itself.
    Token,
    /// A request.
    Request,
    /// The answer of a station that is no slave.
    Answer,
}

impl Sign {
    fn weight(self) -> u8 {
        match self {
            Sign::Passed => 0,
            Sign::Token => 1,
            Sign::Request => 2,
            Sign::Answer => ENOUGH,
        }
    }
}

/// The signs of other masters.
#[derive(Debug)]
#[repr(C)] // What each cycle looks at comes first.
pub(super) struct Others {
    /// The one that was found, and when it was last received.
    found: Option<(u8, Time)>,
    /// By address, in the second that began then.
    weights: [u8; 128],
    since: Time,
}

impl Others {
    pub(super) fn new() -> Others {
        Others { found: None, weights: [0; 128], since: Time(0) }
    }

    /// A telegram of the master at `address` was received: whether there is such a master.
    pub(super) fn received(&mut self, now: Time, address: u8, sign: Sign) -> bool {
        if now.since(self.since) > WITHIN_NS {
            (self.weights, self.since) = ([0; 128], now);
        }
        let Some(weight) = self.weights.get_mut(usize::from(address)) else { return false };
        *weight = weight.saturating_add(sign.weight());
        let is_one = *weight >= ENOUGH || self.found.is_some_and(|(found, _)| found == address);
        if is_one {
            self.found = Some((address, now));
        }
        is_one
    }

    /// The one that was found has gone, as of now.
    #[inline]
    pub(super) fn has_gone(&mut self, now: Time) -> bool {
        let gone = self.found.is_some_and(|(_, at)| now.since(at) > WITHIN_NS);
        if gone {
            self.found = None;
        }
        gone
    }
}

#[cfg(test)]
mod tests {
    use fastrand::Rng;

    use super::*;
    use crate::line::{Incoming, Line, Other};
    use crate::{LenzeDrive, ProfibusPlan};
    use fieldbeat_core::time::{MS, US};

    const OWN: u8 = 2;

    /// A wire on which something arrives each millisecond.
    struct Wire {
        line: Line,
        others: Others,
        now: Time,
        signs: u32,
    }

    impl Wire {
        fn new() -> Wire {
            let plan = ProfibusPlan::new("/dev/ttyS1", 1_500_000, vec![LenzeDrive::new("x", 7)]);
            let mut line = Line::new(&ProfibusPlan { address: OWN, ..plan });
            line.opened(Time(0), true);
            Wire { line, others: Others::new(), now: Time(0), signs: 0 }
        }

        /// These bytes arrive: the address of the master that is named by them.
        fn arrive(&mut self, bytes: &[u8]) -> Option<u8> {
            self.now = self.now + MS;
            self.line.room()[..bytes.len()].copy_from_slice(bytes);
            self.line.received(self.now, bytes.len());
            let mut named = None;
            while let Some(incoming) = self.line.incoming(self.now) {
                if let Incoming::Other(Other::Master { address, sign }) = incoming {
                    self.signs += 1;
                    named = self.others.received(self.now, address, sign).then_some(address).or(named);
                }
            }
            // What was left of a telegram is given up.
            self.line.opened(self.now + 500 * US, true);
            named
        }

        /// The telegram of these by which another master is named.
        fn named_by(&mut self, telegrams: &[&[u8]]) -> Option<(usize, u8)> {
            telegrams.iter().enumerate().find_map(|(k, bytes)| Some((k + 1, self.arrive(bytes)?)))
        }
    }

    const TOKEN: &[u8] = &[0xDC, 9, 9];
    /// A search of the master at address 9, and a diagnosis that it requests.
    const SEARCH: &[u8] = &[0x10, 10, 9, 0x49, 92, 0x16];

    #[test]
    fn one_that_was_named_is_named_again_by_each_telegram_and_has_gone_after_a_second_without_one() {
        let mut wire = Wire::new();
        // Signs that are a second apart are none.
        for _ in 0..100 {
            assert_eq!(wire.named_by(&[TOKEN, SEARCH]), None);
            wire.now = wire.now + S;
        }
        assert_eq!(wire.named_by(&[SEARCH, SEARCH]), Some((2, 9)));
        for _ in 0..10 {
            wire.now = wire.now + 900 * MS;
            assert!(!wire.others.has_gone(wire.now));
            assert_eq!(wire.arrive(&[0xDC, 11, 9]), Some(9));
        }
        wire.now = wire.now + S;
        assert!(!wire.others.has_gone(wire.now));
        assert!(wire.others.has_gone(wire.now + 1));
        assert_eq!(wire.arrive(TOKEN), None);
    }

    #[test]
    fn noise_is_no_sign_of_a_master() {
        let mut tokens = 0;
        for seed in 0..400 {
            let mut random = Rng::with_seed(seed);
            let mut wire = Wire::new();
            // All begin like a token: 256 times as many of them as in what is random from the first byte on.
            let start = (seed % 2 == 0).then_some(0xDC);
            for _ in 0..10_000 {
                let mut bytes: [u8; 16] = random.u128(..).to_ne_bytes();
                bytes[0] = start.unwrap_or(bytes[0]);
                let named = wire.arrive(&bytes[..random.usize(3..=16)]);
                assert_eq!(named, None, "seed {seed}, after {} tokens", wire.signs);
            }
            tokens += wire.signs;
        }
        assert!(tokens > 100_000, "{tokens}");
        // An own token with one bit changed.
        let mut wire = Wire::new();
        for bit in (0..24).cycle().take(24_000) {
            let mut token = [0xDC, OWN, OWN];
            token[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(wire.arrive(&token), None, "bit {bit}");
        }
        assert!(wire.signs > 1_000, "{}", wire.signs);
    }
}
