//! Counters that only Modbus has.

use crate::bus::{Counters, OwnCounter};

/// The indices of the counters in [`Counters::own`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Own {
    /// The drive refused a request.
    Exceptions,
    /// A reply in the name of another unit.
    WrongUnit,
    /// A reply with another function than the request.
    WrongFunction,
    /// A reply whose lengths contradict each other, or the request.
    WrongLength,
    /// Bytes that are not Modbus.
    Garbage,
    /// The connection ended in the middle of a reply.
    CutOff,
    /// The connection ended between replies.
    Closed,
    /// The master gave up a connection that was silent, or refused everything.
    GivenUp,
    /// Connections that were opened after the first one.
    Reopened,
    /// A request that the wire took in pieces.
    Pieces,
    /// A block was written in part only.
    WrittenShort,
    /// A written value reads back as another one.
    NotTaken,
    /// FC23 was given up for this drive.
    NoReadWrite,
}

/// Their keys and meanings, in order.
pub const OWN: [OwnCounter; 13] = [
    OwnCounter { key: "exceptions", what: "requests refused by an exception" },
    OwnCounter { key: "wrong_unit", what: "replies with a wrong unit id" },
    OwnCounter { key: "wrong_function", what: "replies with a wrong function" },
    OwnCounter { key: "wrong_length", what: "replies with a wrong length" },
    OwnCounter { key: "garbage", what: "receptions that are not Modbus, each ends its connection" },
    OwnCounter { key: "cut_off", what: "connections that ended within a reply" },
    OwnCounter { key: "closed", what: "connections that ended between replies" },
    OwnCounter { key: "given_up", what: "connections given up by the master" },
    OwnCounter { key: "reopened", what: "connections opened again" },
    OwnCounter { key: "pieces", what: "requests that the wire took in pieces" },
    OwnCounter { key: "written_short", what: "blocks that the drive wrote in part only" },
    OwnCounter { key: "not_taken", what: "written values that read back as another one" },
    OwnCounter {
        key: "no_fc23",
        what: "changes from FC23 to FC16 and FC3, since the drive does not answer FC23",
    },
];

impl Own {
    /// Counts one more.
    #[inline]
    pub fn count(self, counters: &mut Counters) {
        counters.own[self as usize] += 1;
    }
}
