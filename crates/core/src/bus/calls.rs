//! The acyclic calls to one drive, as the executor of its wire holds them: the same on each wire but for how a call is
//! carried out.
//!
//! A call is taken from its queue, is under way, may have reached the drive, and ends, once. An executor keeps what is
//! under way by itself. What ends it before the drive has answered, which calls need no telegram, and whether one that
//! commands the drive may still be carried out although it has ended, is decided here.

use crate::axis::acyclic::long::{Kept, LOAD, MOST, PART, SIZE};
use crate::axis::acyclic::{Answer, CallError, Port, Posted};
use crate::rt::Regions;
use crate::time::Time;

/// The calls to one drive. Values of a series of calls have room for so many bytes.
#[derive(Debug)]
#[repr(C)] // The queue is looked at in each exchange.
pub struct Calls<const ROOM: usize = MOST> {
    port: Port,
    /// A call that commands the drive has ended without the drive's answer: it may still be carried out.
    is_unsettled: bool,
    series: Box<Series<ROOM>>,
}

/// The values of a series of calls: touched only by calls that are about them.
#[derive(Debug)]
struct Series<const ROOM: usize> {
    /// The values that the last one has read ...
    read: Kept<ROOM>,
    /// ... and what they have handed over to be written.
    loaded: Kept<ROOM>,
    /// The statuses of a part of what was not read, and of one that has no room.
    not_read: u32,
    not_loaded: u32,
}

impl<const ROOM: usize> Calls<ROOM> {
    /// The calls of this queue. `not_read`, `not_loaded`: the wire's statuses of a call for a part of what was not
    /// read, and of one that hands over more than there is room for.
    pub fn new(port: Port, not_read: u32, not_loaded: u32) -> Calls<ROOM> {
        let (read, loaded) = (Kept::default(), Kept::default());
        let series = Box::new(Series { read, loaded, not_read, not_loaded });
        Calls { port, is_unsettled: false, series }
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.port.memory(regions);
        regions.add(&*self.series);
    }

    /// From now on calls that command the drive are refused, or not.
    #[inline]
    pub fn guard(&mut self, on: bool) {
        self.port.guard(on);
    }

    /// None waits.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.port.is_empty()
    }

    /// Ends those that wait, a bounded number in one cycle.
    pub fn refuse_all(&mut self, why: CallError) {
        self.port.refuse_all(why);
    }

    /// The next call.
    #[inline]
    pub fn take(&mut self) -> Option<Posted> {
        self.port.take()
    }

    /// The next call if it is `wanted`; else it stays the next one.
    pub fn take_if(&mut self, wanted: impl Fn(&Posted) -> bool) -> Option<Posted> {
        self.port.take_if(wanted)
    }

    /// The next call that needs a telegram, if it is among the next `most`. Those before it are about the values of a
    /// series, and end here.
    pub fn next(&mut self, most: usize) -> Option<Posted> {
        let Series { read, loaded, not_read, not_loaded } = &mut *self.series;
        for _ in 0..most {
            let posted = self.port.take()?;
            let here = match posted.call.service {
                SIZE | PART => read.answer(&posted).ok_or(*not_read),
                LOAD => loaded.load(&posted).ok_or(*not_loaded),
                _ => return Some(posted),
            };
            self.port.end(&posted, here.map_err(CallError::Refused));
        }
        None
    }

    /// The value that was handed over for this call; `None`: it is not there.
    pub fn loaded(&self, posted: &Posted) -> Option<&[u8]> {
        self.series.loaded.whole(posted)
    }

    /// This call has read a value of `size` bytes, and the first of them.
    pub fn keep(&mut self, posted: &Posted, size: usize, bytes: &[u8]) {
        self.series.read = Kept::of_read(posted, size, bytes);
    }

    /// Why a call that is under way since `begun` ends now, although the drive has not answered it. `is_sent`: the
    /// drive may have received it. What has not reached a drive that is not `online` does not reach it later.
    pub fn over(
        &self,
        posted: &Posted,
        begun: Time,
        now: Time,
        is_sent: bool,
        online: bool,
    ) -> Option<CallError> {
        match is_sent {
            _ if now.since(begun) > posted.limit_ns => Some(CallError::TimedOut),
            _ if self.port.is_cancelled(posted) => Some(CallError::Cancelled),
            true => None,
            false if !online => Some(CallError::NotOnline),
            false => self.port.refusal(posted),
        }
    }

    /// Whether the application has cancelled this call.
    pub fn is_cancelled(&self, posted: &Posted) -> bool {
        self.port.is_cancelled(posted)
    }

    /// Why a call of which nothing was sent yet must not be sent now.
    pub fn refusal(&self, posted: &Posted) -> Option<CallError> {
        self.port.refusal(posted)
    }

    /// Ends a call.
    pub fn end(&mut self, posted: &Posted, result: Result<Answer, CallError>) {
        self.port.end(posted, result);
    }

    /// Whether a call commands the drive.
    pub fn commands(&self, posted: &Posted) -> bool {
        self.port.commands(posted)
    }

    /// A call that commands the drive, which may have received it, ends without an answer.
    pub fn doubt(&mut self) {
        self.is_unsettled = true;
    }

    /// The drive has answered a later request, or forgotten the earlier ones: none of them is carried out any more.
    pub fn settle(&mut self) {
        self.is_unsettled = false;
    }

    /// One that commands the drive may still be carried out, although it has ended.
    #[inline]
    pub fn is_unsettled(&self) -> bool {
        self.is_unsettled
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::acyclic::long::STORE;
    use crate::axis::acyclic::{Acyclic, Call, CallTicket, Commanding, Numbers};
    use crate::time::S;
    use std::sync::Arc;
    use std::time::Duration;

    /// Calls of which those that write at once command the drive.
    fn both() -> (Acyclic, Calls) {
        let commanding = Commanding::new(|call, _| (call.service == 2).then_some(CallError::Commands), []);
        let (acyclic, port) = Acyclic::alone(8, commanding, Arc::new(Numbers));
        (acyclic, Calls::new(port, 0x10, 0x11))
    }

    fn post(acyclic: &Acyclic, service: u32) -> CallTicket {
        acyclic.post(Call { service, address: 7, value: 0 }, Duration::from_secs(1)).unwrap()
    }

    #[test]
    fn a_call_without_answer_ends_by_whether_the_drive_may_have_received_it() {
        let (acyclic, mut calls) = both();
        let ticket = post(&acyclic, 2);
        let posted = calls.take().unwrap();
        let over =
            |calls: &Calls, now, is_sent, online| calls.over(&posted, Time(S), Time(now), is_sent, online);
        for (now, is_sent, online, expected) in [
            (2 * S, false, true, None),
            (2 * S, true, false, None),
            (2 * S, false, false, Some(CallError::NotOnline)),
            (2 * S + 1, true, true, Some(CallError::TimedOut)),
        ] {
            assert_eq!(over(&calls, now, is_sent, online), expected, "{now} {is_sent} {online}");
        }
        calls.guard(true);
        assert_eq!(over(&calls, S, false, true), Some(CallError::Commands));
        assert_eq!(over(&calls, S, true, true), None, "it is under way");
        ticket.cancel();
        assert_eq!(over(&calls, S, true, true), Some(CallError::Cancelled));
    }

    #[test]
    fn calls_about_the_value_of_a_series_need_no_telegram_and_have_a_bound() {
        let (acyclic, mut calls) = both();
        let mut parts = [SIZE, PART].map(|service| post(&acyclic, service));
        let mut pieces = [LOAD, LOAD].map(|service| post(&acyclic, service));
        let _whole = post(&acyclic, STORE);
        assert_eq!(calls.next(2), None, "two in this cycle");
        assert!(parts.iter_mut().all(|part| part.poll() == Some(Err(CallError::Refused(0x10)))));
        assert!(pieces.iter_mut().all(|piece| piece.poll().is_none()));
        assert_eq!(calls.next(3).map(|posted| posted.call.service), Some(STORE));
    }
}
