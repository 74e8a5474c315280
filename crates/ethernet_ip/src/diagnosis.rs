//! Why a drive is not online, from what is counted. Why its connection is not open says the session.

use super::counters::Own;
use fieldbeat_core::bus::diagnosis::{Row, Symptoms};

/// The most specific symptoms first.
pub const DIAGNOSIS: [Row; 7] = [
    Row {
        symptom: "`wrong_length` is a quarter of `missed`",
        holds: |of| comes(of, own(of, Own::WrongLength)),
        says: "its packets have another length than was agreed",
        remedy: "set version as the drive is, and look at its assemblies",
    },
    Row {
        symptom: "`wrong_source` is a quarter of `missed`",
        holds: |of| comes(of, own(of, Own::WrongSource)),
        says: "its packets come from another address than its own",
        remedy: "set address to the one that it sends from, or take its second port or address out of use",
    },
    Row {
        symptom: "`no_packet` and `leap` are a quarter of `missed`",
        holds: |of| comes(of, own(of, Own::NoPacket) + own(of, Own::Leap)),
        says: "what it sends are no class 1 packets, or their numbers leap",
        remedy: "look whether another program or device sends from its address to UDP port 2222",
    },
    Row {
        symptom: "`late` and `duplicate` are a quarter of `missed`",
        holds: |of| comes(of, of.counters.late + of.counters.duplicate),
        says: "its packets have numbers that were there before",
        remedy: "look whether the network delivers old packets again, and whether the drive counts its \
                 packets",
    },
    Row {
        symptom: "`wrong_connection` is most of `missed`",
        holds: |of| of.mostly(own(of, Own::WrongConnection)),
        says: "its packets are those of another connection",
        remedy: "end the other originator, or give this one another originator",
    },
    Row {
        symptom: "`missed` or `timed_out`, and nothing was ever answered",
        holds: |of| of.never() && silent(of),
        says: "it opens the connection, and no packet of it has ever come",
        remedy: "let UDP port 2222 through the firewall of this computer and on the way, and look at bind",
    },
    Row {
        symptom: "`missed` or `timed_out`",
        holds: silent,
        says: "its packets have ended",
        remedy: "look at its power and cable; raise timeout_multiplier if the network loses some in a row",
    },
];

fn own(of: &Symptoms<'_>, counter: Own) -> u64 {
    of.own(counter as usize)
}

/// `count` came in place of its packets: it may send more rarely than it is sent to.
fn comes(of: &Symptoms<'_>, count: u64) -> bool {
    count > 0 && 4 * count > of.counters.missed
}

fn silent(of: &Symptoms<'_>) -> bool {
    of.counters.missed + own(of, Own::TimedOut) > 0
}
