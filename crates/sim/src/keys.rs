//! The faults on the wire of a simulated drive: the same keys for every protocol.

use super::{Carrier, FaultPlan};
use fieldbeat_core::time::{MS, S};
use fieldbeat_keys::keys;
use fieldbeat_keys::table::Table;

keys! {
    SEED "seed" = "0": "seed of the random faults: the same seed gives the same faults; each drive adds "
        "its place in the file";
    DROP "drop" = "0": "probability that a datagram is lost, 0 ... 1";
    DUPLICATE "duplicate" = "0": "probability that a datagram comes twice, 0 ... 1";
    CORRUPT "corrupt" = "0": "probability that a datagram has a wrong bit, 0 ... 1";
    DELAY "delay" = "0": "probability that a datagram is delayed, 0 ... 1";
    DELAY_BY "delay_by" = "(one period of the drive)": "how much later a delayed datagram arrives";
    REORDER "reorder" = "0": "probability that two datagrams overtake each other, 0 ... 1";
    STALL "stall" = "0": "probability that the drive stops answering, 0 ... 1";
    STALL_FOR "stall_for" = "100ms": "length of a stall";
    RESTART "restart" = "0": "probability that the drive restarts, 0 ... 1";
    STO "sto" = "0": "probability that the hardware enable (STO) opens, 0 ... 1";
    STO_FOR "sto_for" = "100ms": "how long the hardware enable stays open";
    WRONG_ID "wrong_id" = "0": "probability that a reply has a wrong identity, 0 ... 1";
    SPLIT "split" = "0": "probability that a message on a connection arrives one byte at a time, 0 ... 1";
    CUT "cut" = "0": "probability that a connection ends in the middle of a reply, 0 ... 1";
    SEGMENT_LOSS "segment_loss" = "0": "probability that a TCP segment is lost, 0 ... 1. TCP sends a lost "
        "segment again after 200 ms, and after twice the time each time after that; later ones wait behind "
        "it";
    ANSWER_TIME "answer_time" = "0us": "time from a request to its reply";
}

/// Reads those of drive `index` of its bus, with an exchange every `period_ns`.
pub fn faults(table: &mut Table<'_>, carrier: Carrier, period_ns: u64, index: usize) -> FaultPlan {
    let stream = carrier == Carrier::Stream;
    let rate = |table: &mut Table<'_>, key| table.number(key, 0.0..=1.0).unwrap_or(0.0);
    let of_stream = |table: &mut Table<'_>, key| if stream { rate(table, key) } else { 0.0 };
    let seed: u64 = table.integer(SEED, 0..=i128::from(u32::MAX)).unwrap_or(0);
    FaultPlan {
        // Drives with one seed in common would lose the same datagrams.
        seed: seed + index as u64,
        drop: rate(table, DROP),
        duplicate: rate(table, DUPLICATE),
        corrupt: rate(table, CORRUPT),
        delay: rate(table, DELAY),
        delay_ns: table.time(DELAY_BY, ..=10 * S).unwrap_or(period_ns),
        reorder: rate(table, REORDER),
        stall: rate(table, STALL),
        stall_ns: table.time(STALL_FOR, ..=600 * S).unwrap_or(100 * MS),
        restart: rate(table, RESTART),
        sto: rate(table, STO),
        sto_ns: table.time(STO_FOR, ..=600 * S).unwrap_or(100 * MS),
        wrong_id: rate(table, WRONG_ID),
        split: of_stream(table, SPLIT),
        cut: of_stream(table, CUT),
        // Read where there is a serial wire.
        lost_byte: 0.0,
        segment_loss: of_stream(table, SEGMENT_LOSS),
        answer_ns: table.time(ANSWER_TIME, ..=S).unwrap_or(0),
    }
}
