//! Counters that only EtherNet/IP has.

use crate::bus::{Counters, OwnCounter};

/// The indices of the counters in [`Counters::own`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub(super) enum Own {
    /// A packet with the data of the one before: it only shows that the drive is there.
    Unchanged,
    /// Bytes that are no class 1 packet.
    NoPacket,
    /// A packet whose data is longer or shorter than agreed.
    WrongLength,
    /// A packet of a connection that is not open.
    WrongConnection,
    /// A packet whose number is farther ahead of the last one than time has passed.
    Leap,
    /// A packet of the drive that came before the loop knew its connection.
    Early,
    /// Connections that were opened after the first one.
    Reopened,
    /// Connections on which the drive's packets ended.
    TimedOut,
}

/// Their keys and meanings, in order.
pub(super) const OWN: [OwnCounter; 8] = [
    OwnCounter { key: "unchanged", what: "packets with the data of the one before" },
    OwnCounter { key: "no_packet", what: "datagrams that are no class 1 packet" },
    OwnCounter { key: "wrong_length", what: "packets with more or less data than agreed" },
    OwnCounter { key: "wrong_connection", what: "packets of a connection that is not open" },
    OwnCounter { key: "leap", what: "packets whose number was too far ahead of the last one" },
    OwnCounter { key: "early", what: "packets that came before their connection was known to be open" },
    OwnCounter { key: "reopened", what: "connections opened again" },
    OwnCounter { key: "timed_out", what: "connections on which the drive's packets ended" },
];

impl Own {
    /// Counts one more.
    #[inline]
    pub(super) fn count(self, counters: &mut Counters) {
        counters.own[self as usize] += 1;
    }
}
