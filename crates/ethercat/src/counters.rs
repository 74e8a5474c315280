//! Counters that only EtherCAT has.

use std::sync::atomic::{AtomicU64, Ordering};

use fieldbeat_core::bus::Counters;
use fieldbeat_core::bus::counters::OWN_COUNTERS;
use fieldbeat_core::own_counters;

own_counters! {
    pub enum Own, OWN {
        PassedBy = "passed_by": "frames that came back without this slave",
        WrongCount = "wrong_count": "frames whose working counter fits no set of slaves",
        NotOperational = "not_operational": "replies of the slave below OP",
        BroughtUp = "brought_up": "times that the slave was brought to OP",
        AlErrors = "al_errors": "AL errors that the slave reported",
        Circulated = "circulated": "frames that went round without passing the master",
        Emergencies = "emergencies": "emergencies that the slave reported",
        EmergenciesLost = "emergencies_lost": "emergencies that were lost because their queue was full",
        Aborts = "aborts": "SDOs refused by an abort code",
        MailboxRepeats = "mailbox_repeats": "mailbox requests and replies repeated",
        MailboxStrays = "mailbox_strays": "mailbox messages that answer no request",
        MailboxBroken = "mailbox_broken": "mailbox messages that are malformed",
        MailboxSilent = "mailbox_silent": "SDOs that were not answered",
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
