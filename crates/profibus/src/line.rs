//! The link layer of the only master on a wire: silence before the first telegram, the token, one request at a time
//! with its slot time and its repetitions, and what arrives meanwhile.
//!
//! A machine of state and time: it takes instants and slices, and knows neither port nor drives. The bus writes what
//! `to_send` returns, and hands over what has arrived. `answer` is what answers a request, `receive`
//! what arrives.
//!
//! Nothing is sent while something may still be on the wire: own bytes, those of an answer that is late or broken,
//! noise. Each byte that arrives puts off the next telegram by an idle time. After bytes that are no telegram nothing
//! counts until the wire was idle: what follows them may be the rest of the same one.
//!
//! The port is looked at inside the windows only, and an answer that ends outside of them is read late. It ended when a
//! station that keeps to MaxTsdr has sent it, at the latest, and the idle time behind it runs from then.
//!
//! What has arrived before the last byte of a request can have left is no answer to it: it was there before, or came
//! into the request. After an answer to a request that was sent more than once, the slot time of the last one is waited
//! out: a second answer is dropped, and is not taken for that to the next request.

mod answer;
mod receive;

use self::answer::ANSWER;
pub use self::answer::{Answer, Expected};
pub(super) use self::answer::{Incoming, Other, Unrelated};
use super::plan::ProfibusPlan;
use super::wire::sap::Service;
use super::wire::telegram::{self, Head, MAX};
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::{S, Time};

/// Room for what arrives: an answer, and an own telegram that the adapter returns.
const INBOX: usize = 2 * MAX;
/// A telegram with the own address so soon after the wire was claimed is one that the adapter returns, ns. Some come
/// back within this time if any do, however late they are read.
const KNOWN_NS: u64 = S;
/// The time of so many bytes is known beforehand: a request and its answer.
const SPANS: usize = 2 * MAX + 1;

/// The owner of a telegram's turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Job {
    /// The master's: a token, or what nobody answers.
    Own,
    /// A search for another master at this address.
    Gap(u8),
    /// That of the drive with this index.
    Drive(u8),
}

/// The next possible action of the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ready {
    /// Nothing.
    Wait,
    /// The rest of a telegram, or the same one again: it is in [`Line::to_send`].
    Resend,
    /// The request has no answer, and is repeated when the wire is free; or has failed, with all its repetitions.
    Overdue {
        /// The job.
        job: Job,
        /// The result in place of an answer.
        instead: Instead,
        /// It is not repeated.
        failed: bool,
    },
    /// The wire was silent, and is claimed: the token is in `to_send`.
    Claim,
    /// The next telegram may leave.
    Free,
}

/// The result in place of an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Instead {
    /// Nothing.
    Silence,
    /// The front of a telegram.
    Part,
    /// Bytes that were no telegram, and were reported.
    Garbage,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// There is no port.
    Closed,
    /// Listening: silent since then.
    Listening(Time),
    /// The number of tokens of two that have left.
    Claiming(u8),
    Free,
    /// The driver has not taken all of a telegram.
    Sending,
    Waiting,
    /// The request is to be sent again.
    Repeating,
}

/// Whether the adapter returns what is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Echo {
    /// Nobody has said so, and none has come back.
    Unknown,
    /// Nobody has said so, but one has come back.
    Seen,
    /// The plan says so.
    Planned,
}

/// The use of the wire, and until when.
#[derive(Debug)]
struct Timing {
    state: State,
    /// Nothing counts until the wire was idle.
    garbled: bool,
    /// The wire is free from then on; while an answer is waited for: the request has left by then.
    free_at: Time,
    /// The answer is overdue, or the rest of the telegram is to be sent.
    overdue_at: Time,
    /// The answer has begun by then, if its station keeps to MaxTsdr.
    answer_by: Time,
    idle_ns: u64,
}

/// The link layer.
#[derive(Debug)]
#[repr(C)] // What every telegram touches comes first.
pub(super) struct Line {
    timing: Timing,
    job: Job,
    expected: Expected,
    /// The request may be repeated so many times more, and `retries` times in all.
    left: u8,
    retries: u8,
    /// The own address.
    address: u8,
    echo: Echo,
    /// Bytes come when they were on the wire, or later.
    is_timed: bool,
    /// The arrived bytes were there before the request had left.
    early: bool,
    /// Bytes of the own telegram that the adapter still returns.
    echo_left: u16,
    /// Of the telegram: how long it is, and how much of it the driver has.
    length: u16,
    taken: u16,
    /// Of the inbox: how much is filled, and how much of its front was handed out.
    filled: u16,
    used: u16,
    line: SerialLine,
    slot_ns: u64,
    answer_ns: u64,
    latency_ns: u64,
    unanswered_ns: u64,
    claim_ns: u64,
    /// Bytes that come back by then show that the adapter returns them.
    known_at: Time,
    request: [u8; MAX],
    inbox: [u8; INBOX],
    spans: Spans,
}

/// The time that a number of bytes takes on the wire, ns: on as few lines of the cache as possible for the usual
/// telegrams.
#[derive(Debug)]
#[repr(align(64))]
struct Spans([u32; SPANS]);

impl Line {
    pub(super) fn new(plan: &ProfibusPlan) -> Line {
        let line = plan.line();
        let bits = |bits: u32| line.bits_ns(bits.into());
        // Tto: the master with the lowest address claims a silent wire first.
        let claim_ns = plan.slot_ns().saturating_mul(6 + 2 * u64::from(plan.address));
        Line {
            timing: Timing {
                state: State::Closed,
                garbled: false,
                free_at: Time(0),
                overdue_at: Time(0),
                answer_by: Time(0),
                idle_ns: bits(plan.bits.idle.max(plan.bits.sync)),
            },
            job: Job::Own,
            expected: Expected::service(0, None, false),
            left: 0,
            retries: plan.retries,
            address: plan.address,
            echo: if plan.echo { Echo::Planned } else { Echo::Unknown },
            is_timed: false,
            early: false,
            echo_left: 0,
            length: 0,
            taken: 0,
            filled: 0,
            used: 0,
            line,
            slot_ns: plan.slot_ns(),
            answer_ns: bits(plan.bits.max_tsdr).saturating_add(plan.bits.latency_ns),
            latency_ns: plan.bits.latency_ns,
            unanswered_ns: bits(plan.bits.idle_unanswered.max(plan.bits.sync)),
            claim_ns,
            known_at: Time(0),
            request: [0; MAX],
            inbox: [0; INBOX],
            spans: Spans(std::array::from_fn(|bytes| u32::try_from(line.span_ns(bytes)).unwrap_or(u32::MAX))),
        }
    }

    /// The time that `bytes` bytes take on the wire.
    #[inline]
    fn span_ns(&self, bytes: usize) -> u64 {
        self.spans.0.get(bytes).map_or_else(|| self.line.span_ns(bytes), |ns| (*ns).into())
    }

    /// The own address.
    pub(super) fn address(&self) -> u8 {
        self.address
    }

    /// The port was opened: nothing is sent before the wire was silent for long enough. `is_timed`: its bytes take the
    /// time of their bits.
    pub(super) fn opened(&mut self, now: Time, is_timed: bool) {
        self.is_timed = is_timed;
        (self.timing.state, self.filled, self.used) = (State::Listening(now), 0, 0);
        (self.timing.garbled, self.echo_left) = (false, 0);
    }

    /// The port is gone. The drive whose request was under way.
    pub(super) fn closed(&mut self) -> Option<u8> {
        let before = std::mem::replace(&mut self.timing.state, State::Closed);
        let under_way = matches!(before, State::Sending | State::Waiting | State::Repeating);
        match self.job {
            Job::Drive(index) if under_way => Some(index),
            _ => None,
        }
    }

    /// Requests can be sent, or will be when the wire is free.
    pub(super) fn is_up(&self) -> bool {
        !matches!(self.timing.state, State::Closed | State::Listening(_) | State::Claiming(_))
    }

    /// The adapter returns what is sent, although nobody has said so.
    pub(super) fn returns(&self) -> bool {
        self.echo == Echo::Seen
    }

    /// All that has arrived was handed out.
    #[inline]
    pub(super) fn is_read(&self) -> bool {
        self.used == self.filled
    }

    /// Nothing is under way.
    #[inline]
    pub(super) fn is_free(&self) -> bool {
        matches!(self.timing.state, State::Free)
    }

    /// Nothing is under way, and the next telegram may leave from then on.
    #[inline]
    pub(super) fn free_at(&self) -> Option<Time> {
        self.is_free().then_some(self.timing.free_at)
    }

    /// The next telegram may leave at `now`.
    #[inline]
    pub(super) fn is_free_at(&self, now: Time) -> bool {
        self.is_free() && now >= self.timing.free_at
    }

    /// The job whose answer is waited for.
    #[inline]
    pub(super) fn waits_for(&self) -> Option<u8> {
        match self.job {
            Job::Drive(index) if !self.is_free() => Some(index),
            _ => None,
        }
    }

    /// When it wants to be looked at again; `waits`: a telegram waits to be sent.
    #[inline]
    pub(super) fn look_at(&self, waits: bool) -> Option<Time> {
        match self.timing.state {
            State::Waiting | State::Sending => Some(self.timing.overdue_at),
            State::Repeating | State::Claiming(_) => Some(self.timing.free_at),
            State::Free if waits => Some(self.timing.free_at),
            State::Free | State::Closed | State::Listening(_) => None,
        }
    }

    /// The next action at `now`. Bytes that have arrived until then were handed over.
    pub(super) fn ready(&mut self, now: Time) -> Ready {
        match self.timing.state {
            State::Free if self.is_free_at(now) => Ready::Free,
            State::Waiting if now >= self.timing.overdue_at => self.overdue(now),
            State::Free | State::Waiting | State::Closed => Ready::Wait,
            State::Sending if now >= self.timing.overdue_at => Ready::Resend,
            State::Repeating if now >= self.timing.free_at => {
                (self.taken, self.timing.state) = (0, State::Sending);
                Ready::Resend
            }
            State::Listening(since) if now.since(since) >= self.claim_ns => self.claim(0),
            State::Claiming(sent) if now >= self.timing.free_at => self.claim(sent),
            State::Sending | State::Repeating | State::Listening(_) | State::Claiming(_) => Ready::Wait,
        }
    }

    fn claim(&mut self, sent: u8) -> Ready {
        if sent >= 2 {
            self.timing.state = State::Free;
            return Ready::Free;
        }
        self.token();
        self.timing.state = State::Claiming(sent);
        Ready::Claim
    }

    #[cold]
    fn overdue(&mut self, now: Time) -> Ready {
        let instead = match self.filled > self.used {
            _ if self.timing.garbled => Instead::Garbage,
            true => Instead::Part,
            false => Instead::Silence,
        };
        // What has arrived is not all of a telegram, and stays so.
        (self.filled, self.used, self.timing.garbled) = (0, 0, false);
        self.timing.free_at = self.timing.free_at.max(now);
        let failed = self.left == 0;
        self.left = self.left.saturating_sub(1);
        self.timing.state = if failed { State::Free } else { State::Repeating };
        Ready::Overdue { job: self.job, instead, failed }
    }

    /// The driver still holds so many bytes of the telegram that is overdue: its slot time begins later.
    #[cold]
    pub(super) fn still_sends(&mut self, now: Time, bytes: usize, failed: bool) {
        self.left += u8::from(!failed);
        self.timing.state = State::Waiting;
        self.timing.overdue_at = now + self.span_ns(bytes + 1) + self.slot_ns;
    }

    /// The next telegram is a token to this master itself.
    pub(super) fn token(&mut self) {
        let token = telegram::token(self.address, self.address);
        self.request[..token.len()].copy_from_slice(&token);
        self.begin(Job::Own, token.len());
    }

    /// The next telegram is this one, which nobody answers; false: its data are too long.
    pub(super) fn broadcast(&mut self, head: &Head, data: &[u8]) -> bool {
        let Some(length) = head.emit(data, &mut self.request) else { return false };
        self.begin(Job::Own, length);
        true
    }

    /// The next telegram is a request for the status of a master at this address.
    pub(super) fn gap(&mut self, address: u8) {
        let head = Service::FdlStatus.head(address, self.address, false, false);
        if let Some(length) = head.emit(&[], &mut self.request) {
            self.begin(Job::Gap(address), length);
            self.left = 0;
            self.expected = Expected::exchange(address, self.address, 0);
        }
    }

    /// The next telegram is the request of drive `index` that `write` writes, and what its answer is; `None`: it is
    /// none. Returns what the driver is to take.
    #[inline]
    pub(super) fn request(
        &mut self,
        index: u8,
        write: impl FnOnce(&mut [u8; MAX]) -> Option<(usize, Expected)>,
    ) -> Option<&[u8]> {
        let (length, expected) = write(&mut self.request)?;
        self.begin(Job::Drive(index), length);
        self.expected = expected;
        self.request.get(..length)
    }

    #[inline]
    fn begin(&mut self, job: Job, length: usize) {
        (self.job, self.length, self.taken) = (job, length as u16, 0);
        (self.left, self.filled, self.used, self.timing.garbled) = (self.retries, 0, 0, false);
    }

    /// The bytes of the telegram for the driver.
    #[inline]
    pub(super) fn to_send(&self) -> &[u8] {
        self.request.get(usize::from(self.taken)..usize::from(self.length)).unwrap_or_default()
    }

    /// The driver took so many bytes of it at `at`. False: it took none of a telegram of which it had none, which is
    /// given up.
    #[inline]
    pub(super) fn sent(&mut self, at: Time, count: usize) -> bool {
        if self.taken == 0 && count >= usize::from(self.length) {
            self.left_for_wire(at);
            return true;
        }
        self.sent_in_part(at, count)
    }

    #[cold]
    fn sent_in_part(&mut self, at: Time, count: usize) -> bool {
        let claiming = matches!(self.timing.state, State::Claiming(_));
        if count == 0 && self.taken == 0 {
            self.timing.free_at = self.timing.free_at.max(at + self.timing.idle_ns);
            // One that is repeated waits on.
            match self.timing.state {
                State::Sending => self.timing.state = State::Repeating,
                _ if claiming => {}
                _ => self.timing.state = State::Free,
            }
            return self.timing.state == State::Repeating;
        }
        self.taken = self.taken.saturating_add(count as u16);
        if self.taken >= self.length {
            self.left_for_wire(at);
        } else if !claiming {
            (self.timing.state, self.timing.overdue_at) = (State::Sending, at + self.span_ns(count.max(1)));
        }
        true
    }

    /// All of the telegram is on its way since `at`.
    #[inline]
    fn left_for_wire(&mut self, at: Time) {
        let ends = at + self.span_ns(usize::from(self.length));
        self.echo_left = if self.echo == Echo::Planned { self.length } else { 0 };
        if self.job != Job::Own {
            (self.timing.state, self.timing.overdue_at) = (State::Waiting, ends + self.slot_ns);
            (self.timing.free_at, self.timing.answer_by) = (ends, ends + self.answer_ns);
            return;
        }
        let is_token = self.length == 3;
        self.timing.free_at = ends + if is_token { self.timing.idle_ns } else { self.unanswered_ns };
        self.timing.state = match self.timing.state {
            State::Claiming(sent) => {
                self.known_at = at + KNOWN_NS;
                if self.echo == Echo::Seen {
                    self.echo = Echo::Unknown;
                }
                State::Claiming(sent + 1)
            }
            _ => State::Free,
        };
    }

    /// The end of the last received bytes.
    #[inline]
    pub(super) fn quiet_since(&self) -> Time {
        self.timing.free_at - self.timing.idle_ns
    }

    /// The time that the request that began at `began` and its answer with `data` bytes of data took on the wire, ns:
    /// without what the port held back. One that was repeated counts as it was.
    #[inline]
    pub(super) fn took_ns(&self, began: Time, data: usize) -> u64 {
        let took_ns = self.quiet_since().since(began);
        if self.latency_ns == 0 || self.left < self.retries {
            return took_ns;
        }
        let saps = if self.expected.saps.is_some() { 2 } else { 0 };
        let bytes = usize::from(self.length) + usize::from(ANSWER) + saps + data;
        took_ns.min(self.span_ns(bytes) + self.answer_ns - self.latency_ns)
    }

    /// The longest time from the begin of the telegram until it is closed, with all its repetitions.
    #[inline]
    pub(super) fn closed_within_ns(&self) -> u64 {
        let bytes = usize::from(self.length) + usize::from(self.expected.longest);
        let once = self.span_ns(bytes) + self.slot_ns + self.timing.idle_ns;
        once * (u64::from(self.left) + 1)
    }
}

#[cfg(test)]
mod tests;
