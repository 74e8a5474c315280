//! Why a drive is not online, from what is counted. What it refuses, and that nobody answers at its address, says its
//! note.

use super::counters::Own;
use fieldbeat_core::bus::diagnosis::{Row, Symptoms, is_most};

/// A start-up is four telegrams at least: diagnosis, Set_Prm, Chk_Cfg, diagnosis.
const START_UP: u64 = 4;

/// It answers Data_Exchange with RS.
pub(crate) const LEFT: Row = Row {
    symptom: "`refused` is most of `missed`, and `start_ups` are four times as many",
    holds: |of| {
        let refused = own(of, Own::Refused);
        of.mostly(refused) && own(of, Own::StartUps) >= START_UP * refused
    },
    says: "it does not stay in Data_Exchange",
    remedy: "raise watchdog, look at configuration and at the process data that the drive is set to, and end \
             another master that parametrises it",
};

/// It answers Data_Exchange with UE or RR.
pub(crate) const OVERLOADED: Row = Row {
    symptom: "`refused` is most of `missed`",
    holds: |of| of.mostly(own(of, Own::Refused)),
    says: "it cannot take its exchanges (UE, RR)",
    remedy: "raise divisor, or set min_slave_interval as its GSD file has it",
};

/// The most specific symptoms first.
pub const DIAGNOSIS: [Row; 7] = [
    Row {
        symptom: "`late` and `duplicate` are a quarter of `slot_times`",
        holds: |of| 4 * (of.counters.late + of.counters.duplicate) > own(of, Own::SlotTimes),
        says: "its answers come after the slot time",
        remedy: "raise latency, which an adapter on USB or the network needs, or bits.slot",
    },
    Row {
        symptom: "`wrong_check`, `wrong_length`, `wrong_start` and `wrong_end` are most of `slot_times`",
        holds: |of| is_most(damaged(of), own(of, Own::SlotTimes)),
        says: "its answers arrive damaged",
        remedy: "look at wiring, termination and shield, at the rate, and whether two drives have its \
                 address",
    },
    Row {
        symptom: "`wrong_answer` is most of `missed` and of `slot_times`",
        holds: |of| is_cause(of, own(of, Own::WrongAnswer)),
        says: "it answers with SC, or with another length, in place of its inputs",
        remedy: "look at configuration, and at the process data that the drive is set to",
    },
    Row {
        symptom: "`wrong_station` is most of `missed` and of `slot_times`",
        holds: |of| is_cause(of, own(of, Own::WrongStation)),
        says: "another station answers in its place",
        remedy: "look for two drives with one address, and at bits.max_tsdr",
    },
    LEFT,
    OVERLOADED,
    Row {
        symptom: "`missed`, after it has answered",
        holds: |of| of.counters.missed > 0 && !of.never(),
        says: "its answers have ended",
        remedy: "look at its power, its cable and terminators",
    },
];

fn own(of: &Symptoms<'_>, counter: Own) -> u64 {
    of.own(counter as usize)
}

/// `count` answers, each of which may have been followed by a slot time, explain what was missed.
fn is_cause(of: &Symptoms<'_>, count: u64) -> bool {
    of.mostly(count) && is_most(count, own(of, Own::SlotTimes))
}

fn damaged(of: &Symptoms<'_>) -> u64 {
    [Own::WrongCheck, Own::WrongLength, Own::WrongStart, Own::WrongEnd]
        .map(|counter| own(of, counter))
        .iter()
        .sum()
}
