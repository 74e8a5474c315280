//! Why a drive is not online, from what is counted, and from what the handshake has found.

use super::counters::Own;
use fieldbeat_core::bus::diagnosis::{NOTED, Row, Symptoms};

/// The handshake received what is no answer.
pub(crate) const MISFIT: Row = Row {
    symptom: "`wrong_function`, `wrong_length` and `garbage` are most of `missed`, or so in the handshake",
    holds: |of| of.mostly(own(of, Own::WrongFunction) + own(of, Own::WrongLength) + own(of, Own::Garbage)),
    says: "its replies do not fit the requests",
    remedy: "look whether it is a Unidrive's Modbus port, or another device or a gateway has its address",
};

/// The handshake received an answer to another request.
pub(crate) const WRONG_ID: Row = Row {
    symptom: "`foreign` is most of `missed`, or so in the handshake",
    holds: |of| of.mostly(of.counters.foreign),
    says: "it answers with another transaction id than the request has",
    remedy: "look whether another device or a gateway has its address",
};

/// The handshake received exception 01 for the status word: a Unidrive has the function.
pub(crate) const NO_FUNCTION: Row = Row {
    symptom: "exception 01h for its status word in the handshake",
    holds: NOTED,
    says: "it does not have the function by which its status word is read",
    remedy: "look whether it is a Unidrive's Modbus port, or another device has its address",
};

/// The handshake received exception 03 for the status word.
pub(crate) const BAD_VALUE: Row = Row {
    symptom: "exception 03h for its status word in the handshake",
    holds: NOTED,
    says: "it does not give its status word in so many bits",
    remedy: "look at the bits of map.status, and whether another device has its address",
};

/// The handshake received exception 04 for the status word.
pub(crate) const FAILED: Row = Row {
    symptom: "exception 04h for its status word in the handshake",
    holds: NOTED,
    says: "it has failed to read its status word",
    remedy: "correct unit, which some servers answer so, or restart the drive and its option modules",
};

/// The handshake received another exception for the status word: 02 of a Unidrive.
pub(crate) const REFUSED: Row = Row {
    symptom: "exception 02h, or any other, for its status word in the handshake",
    holds: NOTED,
    says: "it refuses to report its status word",
    remedy: "look at addressing and map.status, and at unit if it is behind a gateway",
};

/// The handshake received an exception of a gateway.
pub(crate) const UNREACHED: Row = Row {
    symptom: "exception 0Ah or 0Bh in the handshake",
    holds: NOTED,
    says: "the gateway in front of it does not reach it",
    remedy: "correct unit, or look at what is behind the gateway",
};

/// The handshake was answered, and did not end in its time.
pub(crate) const SLOW: Row = Row {
    symptom: "answers in the handshake, and none of an exchange or none in its time",
    holds: |of| of.never() && own(of, Own::GivenUp) > 0,
    says: "it answers, and too late",
    remedy: "raise reply_within, and with it watchdog.timeout",
};

/// The most specific symptoms first.
pub const DIAGNOSIS: [Row; 11] = [
    Row {
        symptom: "`wrong_unit` is most of `missed`",
        holds: |of| of.mostly(own(of, Own::WrongUnit)),
        says: "it answers with another unit id",
        remedy: "correct unit, or look at the gateway in front of it",
    },
    MISFIT,
    WRONG_ID,
    UNREACHED,
    NO_FUNCTION,
    BAD_VALUE,
    FAILED,
    REFUSED,
    Row {
        symptom: "`late` is most of `missed`, more than `given_up`, and more than one",
        holds: |of| of.mostly(of.counters.late) && of.counters.late > own(of, Own::GivenUp).max(1),
        says: "its replies come later than reply_within",
        remedy: "raise reply_within, and with it watchdog.timeout",
    },
    SLOW,
    Row {
        symptom: "`missed` or `given_up`",
        holds: |of| of.counters.missed + own(of, Own::GivenUp) > 0,
        says: "its replies have ended",
        remedy: "look at its power and cable",
    },
];

fn own(of: &Symptoms<'_>, counter: Own) -> u64 {
    of.own(counter as usize)
}
