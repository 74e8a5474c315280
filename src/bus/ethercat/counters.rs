//! What only EtherCAT counts.

use crate::bus::{Counters, OwnCounter};

/// The places of the counters in [`Counters::own`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Own {
    /// A frame came back without this slave having been part of it.
    PassedBy,
    /// A frame whose working counter fits no set of slaves.
    WrongCount,
    /// A reply of a slave below OP: it takes no outputs.
    NotOperational,
    /// It was brought up, the first time included.
    BroughtUp,
    /// It told an AL error.
    AlErrors,
    /// Frames that went round without passing the master.
    Circulated,
    /// Emergencies.
    Emergencies,
    /// Emergencies that found their queue full: they are no events.
    EmergenciesLost,
    /// SDOs that were refused by an abort code.
    Aborts,
    /// Requests and replies of its mailbox that had to be repeated.
    MailboxRepeats,
    /// Messages of its mailbox that answer nothing that was asked.
    MailboxStrays,
    /// Messages of its mailbox that are none.
    MailboxBroken,
    /// SDOs that were not answered.
    MailboxSilent,
}

/// Their keys and meanings, in order.
pub const OWN: [OwnCounter; 13] = [
    OwnCounter { key: "passed_by", what: "frames that came back without this drive" },
    OwnCounter { key: "wrong_count", what: "frames whose working counter fits no set of slaves" },
    OwnCounter { key: "not_operational", what: "replies of the drive below OP" },
    OwnCounter { key: "brought_up", what: "times that the drive was brought to OP" },
    OwnCounter { key: "al_errors", what: "AL errors that the drive reported" },
    OwnCounter { key: "circulated", what: "frames that went round without passing the master" },
    OwnCounter { key: "emergencies", what: "emergencies that the drive reported" },
    OwnCounter { key: "emergencies_lost", what: "emergencies that were lost because their queue was full" },
    OwnCounter { key: "aborts", what: "SDOs refused by an abort code" },
    OwnCounter { key: "mailbox_repeats", what: "mailbox requests and replies repeated" },
    OwnCounter { key: "mailbox_strays", what: "mailbox messages that answer no request" },
    OwnCounter { key: "mailbox_broken", what: "mailbox messages that are none" },
    OwnCounter { key: "mailbox_silent", what: "SDOs that were not answered" },
];

impl Own {
    /// Counts one more.
    #[inline]
    pub fn count(self, counters: &mut Counters) {
        counters.own[self as usize] += 1;
    }
}
