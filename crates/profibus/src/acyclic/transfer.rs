//! One request to a record by MSAC1, from its telegram to its answer, whether that comes at once or is polled for.
//!
//! The drive stores one answer. A request that was lost, or whose answer was, may have been carried out: it is polled
//! for its answer, and never repeated here.

use super::super::target::{self, BROKEN};
use super::super::wire::Writer;
use super::super::wire::fc::NO_RESOURCE;
use super::super::wire::msac1::{self, Function, RECORD_MAX, Record, Refusal};
use super::Answer;
use fieldbeat_core::time::{MS, Time};

/// A request that the drive cannot take now, and a response that is not ready, are tried again after so long, ns.
const AGAIN_NS: u64 = 5 * MS;
/// The number of polls that are only acknowledged which show that there is no answer any more, once a telegram was lost
/// (assumed).
const POLLS: u8 = 16;

/// The outcome of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Event<'a> {
    /// Nothing yet.
    None,
    /// The record was read, and these are its bytes; or it was written.
    Done(&'a [u8]),
    /// It was refused, with this status.
    Refused(u32),
    /// It cannot be done in the present state of the drive: of a write, nothing was carried out.
    NotNow,
    /// Telegrams were lost: it may have been carried out, or not.
    Unknown,
}

/// A request to a record.
#[derive(Debug)]
pub(super) struct Transfer {
    record: Record,
    function: Function,
    data: [u8; 4 + RECORD_MAX],
    length: usize,
    /// It has left, and was not refused: the drive may carry it out.
    pub(super) is_sent: bool,
    /// The next telegram is a poll.
    polls: bool,
    /// Polls that were only acknowledged since something was lost.
    acknowledged: Option<u8>,
    /// Nothing is sent before.
    pub(super) not_before: Time,
}

impl Transfer {
    pub(super) fn new() -> Transfer {
        Transfer {
            record: Record { slot: 0, index: 0 },
            function: Function::Read,
            data: [0; 4 + RECORD_MAX],
            length: 0,
            is_sent: false,
            polls: false,
            acknowledged: None,
            not_before: Time(0),
        }
    }

    /// A request to read it.
    pub(super) fn read(&mut self, record: Record) {
        let _ = self.begin(record, Function::Read, |out| record.put_read(RECORD_MAX as u8, out));
    }

    /// A request to write what `fill` writes. False: that is too long.
    pub(super) fn write(&mut self, record: Record, fill: impl FnOnce(&mut Writer<'_>)) -> bool {
        self.begin(record, Function::Write, |out| record.put_write(out, fill))
    }

    fn begin(&mut self, record: Record, function: Function, put: impl FnOnce(&mut Writer<'_>)) -> bool {
        let mut out = Writer::new(&mut self.data);
        put(&mut out);
        let length = out.finish();
        self.length = length.unwrap_or(0);
        (self.record, self.function) = (record, function);
        let is_in_the_way = self.polls && !self.is_sent;
        self.anew();
        if is_in_the_way {
            self.lost();
        }
        length.is_some()
    }

    /// The data of its next telegram.
    pub(super) fn data(&self) -> &[u8] {
        if self.polls { &[] } else { self.data.get(..self.length).unwrap_or_default() }
    }

    /// The telegram has left.
    pub(super) fn sent(&mut self) {
        self.is_sent |= !self.polls;
    }

    /// The telegram was not answered.
    pub(super) fn lost(&mut self) {
        (self.polls, self.acknowledged) = (true, Some(0));
    }

    /// Nobody waits for its answer any more, which may still come: it is in the way of the next request.
    pub(super) fn abandoned(&mut self) {
        if self.is_sent {
            self.is_sent = false;
            self.lost();
        }
    }

    /// It is sent again, later.
    pub(super) fn again(&mut self, at: Time) {
        self.anew();
        self.wait(at);
    }

    /// The next telegram leaves later.
    pub(super) fn wait(&mut self, at: Time) {
        self.not_before = at + AGAIN_NS;
    }

    /// As if nothing had been sent.
    pub(super) fn anew(&mut self) {
        (self.is_sent, self.polls, self.acknowledged, self.not_before) = (false, false, None, Time(0));
    }

    /// The answer to the telegram.
    pub(super) fn answered<'a>(&mut self, at: Time, answer: Answer<'a>) -> Event<'a> {
        let data = match answer {
            Answer::Acknowledged | Answer::Data { data: [], .. } => return self.acknowledged(),
            Answer::Refused(function) => return self.refused(function),
            Answer::Data { data, .. } => data,
        };
        if !self.is_sent {
            // That of an older request, which was in the way.
            (self.polls, self.acknowledged) = (false, None);
            return Event::None;
        }
        let Some(answer) = msac1::Answer::parse(data) else { return Event::Refused(BROKEN) };
        match answer.result {
            Ok((record, data)) if (record, answer.function) == (self.record, self.function) => {
                Event::Done(data)
            }
            Err(why) if answer.function == self.function && why.is_temporary() => {
                self.again(at);
                if why.code_1 == Refusal::STATE { Event::NotNow } else { Event::None }
            }
            Err(why) if answer.function == self.function => Event::Refused(target::msac1(why)),
            _ => {
                // That of an older request: its own follows, or is lost.
                self.lost();
                Event::None
            }
        }
    }

    fn acknowledged(&mut self) -> Event<'static> {
        self.polls = true;
        let Some(polls) = &mut self.acknowledged else { return Event::None };
        *polls += 1;
        if *polls <= POLLS {
            return Event::None;
        }
        (self.polls, self.acknowledged) = (false, None);
        if self.is_sent { Event::Unknown } else { Event::None }
    }

    fn refused(&mut self, function: u8) -> Event<'static> {
        if function != NO_RESOURCE {
            // Of a poll: the request before it was taken.
            let was_taken = self.polls && self.is_sent;
            (self.polls, self.acknowledged) = (false, None);
            return if was_taken { Event::Unknown } else { Event::Refused(target::link(function)) };
        }
        // An answer that nobody has fetched is in the way of the request; a poll changes nothing.
        if !self.polls {
            self.is_sent = false;
        }
        self.lost();
        Event::None
    }
}
