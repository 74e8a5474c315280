//! Counters that only EtherCAT has.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::bus::counters::OWN_COUNTERS;
use crate::bus::{Counters, OwnCounter};

/// The indices of the counters in [`Counters::own`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Own {
    /// A frame came back without this slave having taken part.
    PassedBy,
    /// A frame whose working counter fits no set of slaves.
    WrongCount,
    /// A reply of a slave below OP: outputs do not reach it.
    NotOperational,
    /// It was brought up, the first time included.
    BroughtUp,
    /// It reported an AL error.
    AlErrors,
    /// Frames that went round without passing the master.
    Circulated,
    /// Emergencies.
    Emergencies,
    /// Emergencies for which the queue had no room: no events were made of them.
    EmergenciesLost,
    /// SDOs that were refused by an abort code.
    Aborts,
    /// Requests and replies of its mailbox that had to be repeated.
    MailboxRepeats,
    /// Messages of its mailbox that belong to no request.
    MailboxStrays,
    /// Messages of its mailbox that are malformed.
    MailboxBroken,
    /// SDOs that were not answered.
    MailboxSilent,
}

/// Their keys and meanings, in order.
pub const OWN: [OwnCounter; 13] = [
    OwnCounter { key: "passed_by", what: "frames that came back without this slave" },
    OwnCounter { key: "wrong_count", what: "frames whose working counter fits no set of slaves" },
    OwnCounter { key: "not_operational", what: "replies of the slave below OP" },
    OwnCounter { key: "brought_up", what: "times that the slave was brought to OP" },
    OwnCounter { key: "al_errors", what: "AL errors that the slave reported" },
    OwnCounter { key: "circulated", what: "frames that went round without passing the master" },
    OwnCounter { key: "emergencies", what: "emergencies that the slave reported" },
    OwnCounter { key: "emergencies_lost", what: "emergencies that were lost because their queue was full" },
    OwnCounter { key: "aborts", what: "SDOs refused by an abort code" },
    OwnCounter { key: "mailbox_repeats", what: "mailbox requests and replies repeated" },
    OwnCounter { key: "mailbox_strays", what: "mailbox messages that answer no request" },
    OwnCounter { key: "mailbox_broken", what: "mailbox messages that are malformed" },
    OwnCounter { key: "mailbox_silent", what: "SDOs that were not answered" },
];

impl Own {
    /// Counts one more.
    #[inline]
    pub fn count(self, counters: &mut Counters) {
        counters.own[self as usize] += 1;
    }
}

/// The same of a device that is not a drive: written by the cycle without a lock, read by normal threads.
#[derive(Debug, Default)]
pub struct DeviceCounters([AtomicU64; OWN_COUNTERS]);

impl DeviceCounters {
    /// Counts one more.
    #[inline]
    pub fn count(&self, counter: Own) {
        self.0[counter as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Adds what was counted.
    pub fn add(&self, counters: &Counters) {
        for (sum, counted) in self.0.iter().zip(counters.own).filter(|(_, counted)| *counted > 0) {
            sum.fetch_add(counted, Ordering::Relaxed);
        }
    }

    /// Reads all of them.
    pub fn get(&self) -> [u64; OWN_COUNTERS] {
        self.0.each_ref().map(|sum| sum.load(Ordering::Relaxed))
    }
}
