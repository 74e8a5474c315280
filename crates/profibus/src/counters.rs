//! Counters that only PROFIBUS has. What belongs to no drive counts for the one whose turn it was.

use super::wire::telegram::Malformed;
use fieldbeat_core::own_counters;

own_counters! {
    pub enum Own, OWN {
        Retries = "retries": "telegrams that were repeated",
        SlotTimes = "slot_times": "slot times without an answer",
        WrongCheck = "wrong_check": "telegrams with a wrong check byte",
        WrongLength = "wrong_length": "telegrams with a wrong length",
        WrongStart = "wrong_start": "receptions with which no telegram begins",
        WrongEnd = "wrong_end": "telegrams with a wrong end, or cut off",
        WrongStation = "wrong_station": "answers from or to another station",
        WrongAnswer = "wrong_answer": "answers of another service or kind",
        Refused = "refused": "exchanges and diagnoses that it refused (UE, RR, RS)",
        OtherJob = "other_job": "answers to nothing that is under way",
        Noise = "noise": "receptions while nobody was to send",
        SecondMaster = "second_master": "telegrams of another master",
        StartUps = "start_ups": "telegrams of its start-up, which are no exchanges",
        WireUs = "wire_us": "bus load, microseconds of its telegrams on the wire",
    }
}

impl Own {
    /// The mistake of bytes that are no telegram.
    pub fn of(why: &Malformed) -> Own {
        match why {
            Malformed::Start => Own::WrongStart,
            Malformed::Length => Own::WrongLength,
            Malformed::Check => Own::WrongCheck,
            Malformed::End => Own::WrongEnd,
        }
    }
}
