//! Counters that only PROFIBUS has.

use super::wire::telegram::Malformed;
use crate::bus::{Counters, OwnCounter};

/// The indices of the counters in [`Counters::own`]. What belongs to no drive counts for the one whose turn it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Own {
    /// A telegram was repeated.
    Retries,
    /// A slot time passed without an answer.
    SlotTimes,
    /// A telegram with a wrong check byte.
    WrongCheck,
    /// A telegram whose lengths contradict each other.
    WrongLength,
    /// Bytes with which no telegram begins.
    WrongStart,
    /// A telegram without its end byte, or cut off.
    WrongEnd,
    /// An answer from or to another station.
    WrongStation,
    /// An answer to another service, or of another kind.
    WrongAnswer,
    /// An answer to nothing that is under way.
    OtherJob,
    /// Bytes while nobody was to send.
    Noise,
    /// A telegram of another master.
    SecondMaster,
    /// A telegram of the start-up: it is no exchange.
    StartUps,
    /// The time that its telegrams took on the wire, µs.
    WireUs,
}

/// Their keys and meanings, in order.
pub const OWN: [OwnCounter; 13] = [
    OwnCounter { key: "retries", what: "telegrams that were repeated" },
    OwnCounter { key: "slot_times", what: "slot times without an answer" },
    OwnCounter { key: "wrong_check", what: "telegrams with a wrong check byte" },
    OwnCounter { key: "wrong_length", what: "telegrams with a wrong length" },
    OwnCounter { key: "wrong_start", what: "receptions with which no telegram begins" },
    OwnCounter { key: "wrong_end", what: "telegrams with a wrong end, or cut off" },
    OwnCounter { key: "wrong_station", what: "answers from or to another station" },
    OwnCounter { key: "wrong_answer", what: "answers of another service or kind" },
    OwnCounter { key: "other_job", what: "answers to nothing that is under way" },
    OwnCounter { key: "noise", what: "receptions while nobody was to send" },
    OwnCounter { key: "second_master", what: "telegrams of another master" },
    OwnCounter { key: "start_ups", what: "telegrams of its start-up, which are no exchanges" },
    OwnCounter { key: "wire_us", what: "bus load, microseconds of its telegrams on the wire" },
];

impl Own {
    /// Counts one more.
    #[inline]
    pub fn count(self, counters: &mut Counters) {
        counters.own[self as usize] += 1;
    }

    /// What is wrong with bytes that are no telegram.
    pub fn of(why: &Malformed) -> Own {
        match why {
            Malformed::Start { .. } => Own::WrongStart,
            Malformed::Check { .. } => Own::WrongCheck,
            Malformed::End { .. } => Own::WrongEnd,
            Malformed::Lengths { .. }
            | Malformed::SecondStart { .. }
            | Malformed::Length { .. }
            | Malformed::Extension => Own::WrongLength,
        }
    }
}
