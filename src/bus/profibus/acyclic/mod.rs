//! Acyclic access to one drive, as its station sees it: what rides on the drive's own turns, and nothing else does.
//!
//! A turn of a drive is one telegram. With a parameter channel (paths A and B) a call is 8 bytes of the outputs of
//! Data_Exchange, and its answer 8 bytes of the inputs, as often as it takes. With MSAC1 (path C) a call takes a turn in
//! place of Data_Exchange now and then: its data unit goes to the service access point of MSAC1, and what the drive
//! answers in that turn comes back here; never twice in a row, and never before a stop.
//!
//! The station calls, in each turn of its drive:
//!
//! 1. [`advance`](Acyclic::advance) with each build of the next telegram, maybe more than once for the same turn: takes
//!    the next call, ends those that are over. Built again, it is the same: what a telegram changes is changed by
//!    [`sent`](Acyclic::sent).
//! 2. [`channel`](Acyclic::channel), the bytes for the outputs, and [`data_unit`](Acyclic::data_unit), the data of an
//!    MSAC1 request if the turn is to be one.
//! 3. `sent` when the telegram has left: with Data_Exchange, or with the MSAC1 request. A telegram that is repeated is the
//!    same, and is not sent again here.
//! 4. One of [`channel_answered`](Acyclic::channel_answered), [`answered`](Acyclic::answered) and
//!    [`lost`](Acyclic::lost) when the telegram is closed.
//!
//! [`ended`](Acyclic::ended) follows when the drive has left Data_Exchange: its channel and its MSAC1 begin anew.

use super::plan::{CHANNEL, LenzeDrive, ParameterPath};
use crate::axis::Link;
use crate::axis::acyclic::{CallError, Commanding, Port};
use crate::rt::Regions;
use crate::time::Time;

/// What a turn of the drive is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turn {
    /// Data_Exchange, with the channel in it.
    DataExchange,
    /// An MSAC1 request.
    Msac1,
}

/// What an MSAC1 request was answered with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer<'a> {
    /// A data unit, which may be empty.
    Data(&'a [u8]),
    /// The bare acknowledgement: the answer is to be polled for.
    Acknowledged,
    /// Refused by the link layer (UE, RR, RS): the service is not active.
    Refused,
}

/// The acyclic access to one drive.
#[derive(Debug)]
pub(super) struct Acyclic {
    port: Port,
    channel: [u8; CHANNEL],
}

/// The calls that command a drive.
pub(super) fn commanding(_drive: &LenzeDrive) -> Commanding {
    Commanding::none()
}

impl Acyclic {
    /// That of `drive`.
    pub(super) fn new(drive: &LenzeDrive, port: Port) -> Acyclic {
        debug_assert!(drive.parameters != ParameterPath::Pkw || drive.channel);
        Acyclic { port, channel: [0; CHANNEL] }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.port.memory(regions);
    }

    /// Nothing is to be done: no call runs, none is posted, and calls that command the drive are refused or not as it
    /// knows. Checked in each turn, so that nothing else is.
    #[inline]
    pub(super) fn is_idle(&self) -> bool {
        self.port.is_empty()
    }

    /// Takes the next call, and ends those that are over. `guarded`: calls that command the drive are refused.
    /// `exchanges`: the drive is in Data_Exchange.
    pub(super) fn advance(&mut self, _now: Time, link: Link, exchanges: bool, guarded: bool) {
        self.port.guard(guarded);
        let online = exchanges && !matches!(link, Link::Unseen | Link::Lost);
        self.port.refuse_all(if online { CallError::Refused(0) } else { CallError::NotOnline });
    }

    /// A call of the application that commands the drive is under way.
    #[inline]
    pub(super) fn commands(&self) -> bool {
        false
    }

    /// The parameter channel in the outputs.
    #[inline]
    pub(super) fn channel(&self) -> &[u8; CHANNEL] {
        &self.channel
    }

    /// The data of an MSAC1 request, in place of the next Data_Exchange; `None`: there is none to send. Empty: a poll
    /// for the answer.
    #[inline]
    pub(super) fn data_unit(&self) -> Option<&[u8]> {
        None
    }

    /// The telegram of this turn has left.
    #[inline]
    pub(super) fn sent(&mut self, _at: Time, _turn: Turn) {}

    /// Data_Exchange was answered, with this channel in its inputs.
    #[inline]
    pub(super) fn channel_answered(&mut self, _at: Time, _channel: &[u8; CHANNEL]) {}

    /// The MSAC1 request was answered.
    pub(super) fn answered(&mut self, _at: Time, _answer: Answer<'_>) {}

    /// The telegram of this turn was not answered, with all its repetitions: the drive may have received it.
    pub(super) fn lost(&mut self, _turn: Turn) {}

    /// The drive has left Data_Exchange, or is set up anew.
    pub(super) fn ended(&mut self) {}
}
