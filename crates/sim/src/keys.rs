//! The faults on the wire of a simulated drive: the same keys for every protocol.

use super::{Carrier, FaultPlan};
use fieldbeat_core::time::{MS, S};
use fieldbeat_keys::table::Table;

/// Reads those of drive `index` of its bus, with an exchange every `period_ns`.
pub fn faults(table: &mut Table<'_>, carrier: Carrier, period_ns: u64, index: usize) -> FaultPlan {
    let (what, stream) = match carrier {
        Carrier::Datagrams => ("datagram", false),
        Carrier::Stream => ("message", true),
    };
    let each = format!("a probability for each {what}");
    let late = format!("the delay of a delayed {what}");
    let rate = |table: &mut Table<'_>, key| table.number(key, 0.0..=1.0, &each).unwrap_or(0.0);
    let of_stream = |table: &mut Table<'_>, key| if stream { rate(table, key) } else { 0.0 };
    let seed: u64 =
        table.integer("seed", 0..=i128::from(u32::MAX), "the same seed gives the same faults").unwrap_or(0);
    FaultPlan {
        // Drives with one seed in common would lose the same datagrams.
        seed: seed + index as u64,
        drop: rate(table, "drop"),
        duplicate: rate(table, "duplicate"),
        corrupt: rate(table, "corrupt"),
        delay: rate(table, "delay"),
        delay_ns: table.time("delay_by", ..=10 * S, &late).unwrap_or(period_ns),
        reorder: rate(table, "reorder"),
        stall: rate(table, "stall"),
        stall_ns: table
            .time("stall_for", ..=600 * S, "how long a stalled drive is silent")
            .unwrap_or(100 * MS),
        restart: rate(table, "restart"),
        sto: rate(table, "sto"),
        sto_ns: table
            .time("sto_for", ..=600 * S, "how long the hardware enable (STO) stays open")
            .unwrap_or(100 * MS),
        wrong_id: rate(table, "wrong_id"),
        split: of_stream(table, "split"),
        cut: of_stream(table, "cut"),
        // Read where there is a serial wire.
        lost_byte: 0.0,
        segment_loss: of_stream(table, "segment_loss"),
        answer_ns: table.time("answer_time", ..=S, "the time from a request to its reply").unwrap_or(0),
    }
}
