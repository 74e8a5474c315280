//! Why a drive is not online, from what is counted.

use fieldbeat_core::bus::diagnosis::{Row, is_most};

/// The most specific symptoms first.
pub const DIAGNOSIS: [Row; 6] = [
    Row {
        symptom: "`late` is most of `missed`",
        holds: |of| of.mostly(of.counters.late),
        says: "its replies come too late",
        remedy: "raise reply_within, or receive_deadline or the period; the late cycles show whether this \
                 computer holds them up",
    },
    Row {
        symptom: "`malformed` is most of `missed`",
        holds: |of| of.mostly(of.counters.malformed),
        says: "what it answers is no telegram of LinUDP V2",
        remedy: "set the drive to LinUDP V2, or look which device has its address",
    },
    Row {
        symptom: "`foreign` is most of `missed`",
        holds: |of| of.mostly(of.counters.foreign),
        says: "it answers from another port, or something that was not requested",
        remedy: "look at the port in its address, and end another master or program that uses its address",
    },
    Row {
        symptom: "nothing from its address, and datagrams from unknown senders are most of `missed`",
        holds: |of| of.never() && of.mostly(of.unmatched.datagrams),
        says: "nothing comes from its address, and datagrams come from one that no drive has",
        remedy: "correct its address: a capture shows the sender",
    },
    Row {
        symptom: "`missed`, and nothing was ever answered",
        holds: |of| of.never() && of.counters.missed > 0,
        says: "nothing has ever come from it",
        remedy: "look at its power, cable and address, at a firewall, and whether it has locked onto \
                 another master",
    },
    Row {
        symptom: "`missed`",
        holds: |of| is_most(of.counters.missed, 0),
        says: "its replies have ended, or were lost",
        remedy: "look at its power and cable, and at what else sends on this network",
    },
];
