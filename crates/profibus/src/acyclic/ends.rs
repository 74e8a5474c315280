//! How the request under way goes on with what the drive answers by MSAC1, and how its calls end.
//!
//! A write of which the outcome is not known ends as timed out, since the drive may have carried it out.

use super::super::target::{BROKEN, BROKEN_WRITE, Kind, learned};
use super::request::Next;
use super::transfer::Event;
use super::{Acyclic, Answer, Read, Way, Work};
use fieldbeat_core::axis::acyclic::long::raw;
use fieldbeat_core::axis::acyclic::{Answer as CallAnswer, CallError};
use fieldbeat_core::time::Time;

impl Acyclic {
    /// The MSAC1 request was answered.
    pub(in super::super) fn answered(&mut self, at: Time, answer: Answer<'_>) {
        let Work { active, transfer, requests, .. } = &mut *self.work;
        let Some(of) = active else { return };
        let perhaps_done = |_: &Work, _| Err(CallError::TimedOut);
        match (of.way, transfer.answered(at, answer)) {
            (Way::Channel(_), _) | (_, Event::None) => {}
            // A response to an earlier request may be in the way, which nobody has read.
            (Way::Request { response: false }, Event::NotNow) => {
                of.way = Way::Unread;
                requests.read_response(transfer);
                transfer.wait(at);
            }
            (Way::Unread, Event::Done(_) | Event::Unknown) => self.request_anew(),
            (Way::Unread, Event::NotNow) => {
                self.request_anew();
                self.work.transfer.wait(at);
            }
            (_, Event::NotNow) => {}
            // The drive has the request, and only its response was refused.
            (Way::Request { response: true }, Event::Refused(status)) if of.writes && status != BROKEN => {
                self.finish(perhaps_done);
            }
            (_, Event::Refused(status)) => self.finish_all(Err(status)),
            (Way::Record(_), Event::Done(data)) => {
                if let ([Some(posted), ..], false) = (&of.calls, of.writes) {
                    self.calls.keep(posted, data.len(), data);
                }
                self.finish_all(Ok((raw(data), Kind::Own)));
            }
            (Way::Record(_), Event::Unknown) if of.writes => self.finish(perhaps_done),
            (Way::Record(record), Event::Unknown) => transfer.read(record),
            (Way::Request { .. }, Event::Unknown) if !of.writes => self.request_anew(),
            // What may have become of a write is in a response with its number.
            (Way::Request { .. }, Event::Unknown) | (Way::Request { response: false }, Event::Done(_)) => {
                of.way = Way::Request { response: true };
                requests.read_response(transfer);
            }
            (Way::Request { response: true }, Event::Done(data)) => self.respond(at, data),
        }
    }

    /// Reads what is still wanted by a request of its own.
    fn request_anew(&mut self) {
        let Work { active, transfer, requests, .. } = &mut *self.work;
        let Some(of) = active else { return };
        if of.calls.iter().all(Option::is_none) {
            *active = None;
            return;
        }
        of.way = Way::Request { response: false };
        requests.build(&of.calls, of.writes, &self.calls, transfer);
    }

    /// The record with the response was read.
    fn respond(&mut self, at: Time, data: &[u8]) {
        let Work { active, transfer, requests, .. } = &mut *self.work;
        let Some(of) = active else { return };
        match requests.respond(data, &of.calls, of.writes, &mut self.calls) {
            Next::Again => transfer.again(at),
            Next::Further => self.request_anew(),
            Next::Over(result) => self.finish_all(result),
            Next::Each => self.finish(|work, place| work.requests.result(place).map_err(CallError::Refused)),
        }
    }

    /// Ends all calls under way alike; an error is a status.
    pub(super) fn finish_all(&mut self, result: Result<Read, u32>) {
        self.finish(|_, _| result.map_err(CallError::Refused));
    }

    /// Ends the request, and its calls with the result of each. What was written is the value of a write.
    pub(super) fn finish(&mut self, result: impl Fn(&Work, usize) -> Result<Read, CallError>) {
        let Some(of) = self.work.active.take() else { return };
        let mut failed = 0;
        for (place, posted) in of.calls.iter().enumerate() {
            let Some(posted) = posted else { continue };
            let mut result = result(&self.work, place).map_err(|error| match error {
                CallError::Refused(BROKEN) if of.writes => CallError::Refused(BROKEN_WRITE),
                error => error,
            });
            if posted.series != 0 && posted.series == failed {
                result = Err(CallError::Skipped);
            } else if result.is_err() {
                failed = posted.series;
            }
            let address = posted.call.address;
            let answer = |(read, kind)| match of.writes {
                true => CallAnswer { status: 0, address, value: posted.call.value },
                false => CallAnswer { status: 0, address: learned(address, kind), value: read },
            };
            self.calls.end(posted, result.map(answer));
        }
    }
}
