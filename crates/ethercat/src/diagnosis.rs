//! Why a drive is not online, from what is counted. Why its slave is not in OP says its note.

use fieldbeat_core::bus::diagnosis::Row;

/// The most specific symptoms first.
pub const DIAGNOSIS: [Row; 2] = [
    Row {
        symptom: "`late` is most of `missed`",
        holds: |of| of.mostly(of.counters.late),
        says: "its frame comes back after the receive deadline",
        remedy: "raise receive_deadline or the period, or look at what holds this computer or its adapter up",
    },
    Row {
        symptom: "`malformed` and `foreign` are most of `missed`",
        holds: |of| of.mostly(of.counters.malformed + of.counters.foreign),
        says: "the frames that come back are not those that were sent",
        remedy: "end another master on this interface, and look where its cable leads",
    },
];
