//! The link layer of the only master on a wire: silence before the first telegram, the token, one request at a time
//! with its slot time and its repetitions, and what arrives meanwhile.
//!
//! A machine of state and time: it takes instants and slices, and knows neither port nor drives. The bus writes what
//! [`to_send`](Line::to_send) returns, and hands over what has arrived.
//!
//! Nothing is sent while something may still be on the wire: own bytes, those of an answer that is late or broken,
//! noise. Each byte that arrives puts off the next telegram by an idle time. After bytes that are no telegram nothing
//! counts until the wire was idle: what follows them may be the rest of the same one.
//!
//! What has arrived before the last byte of a request can have left is no answer to it: it was there before, or came
//! into the request. After an answer to a request that was sent more than once, the slot time of the last one is waited
//! out: a second answer is dropped, and is not taken for that to the next request.

use super::plan::ProfibusPlan;
use super::wire::sap::Service;
use super::wire::telegram::{self, Frame, Head, MAX, Malformed, Next, Telegram};
use crate::net::SerialLine;
use crate::time::Time;

/// Room for what arrives: an answer, and an own telegram that the adapter returns.
const INBOX: usize = 2 * MAX;
/// Bytes of an answer around its data, and of one with a usual diagnosis.
const ANSWER: usize = 9;
const DIAGNOSIS: usize = 64;
/// Bit 6 of a function code: a request.
const REQUEST: u8 = 1 << 6;
/// Bits 5 and 4 of the function code of an answer: the kind of station; 0 is a slave.
const STATION: u8 = 0x30;
/// Functions of answers: refused (UE, RR, RS), data (DL, DH), taken without data (NR), none (OK).
const REFUSED: std::ops::RangeInclusive<u8> = 1..=3;
const DATA_LOW: u8 = 0x8;
const DATA_HIGH: u8 = 0xA;
const NO_DATA: u8 = 0x9;

/// Whose turn a telegram is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Job {
    /// The master's: a token, or what nobody answers.
    Own,
    /// A search for another master at this address.
    Gap(u8),
    /// That of the drive with this index.
    Drive(u8),
}

/// A request, as far as its answer is recognised by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Expected {
    /// The station.
    pub da: u8,
    /// Its service access point, and ours.
    pub saps: Option<(u8, u8)>,
    /// The bare acknowledgement answers it.
    pub acknowledge: bool,
    /// Its data are so many bytes; `None`: any number.
    pub data: Option<u8>,
}

/// What has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Heard<'a> {
    /// The answer to the request that was under way, which ends with it.
    Answer(Job, Answer<'a>),
    /// A telegram that answers nothing: of this station, if it says one.
    Unrelated(Unrelated, Option<u8>),
    /// No telegram, while an answer was expected or not.
    Malformed { why: Malformed, expected: bool },
    /// A telegram of the master at this address.
    OtherMaster {
        /// Its address.
        address: u8,
        /// It is a token, which has no check byte.
        is_token: bool,
    },
}

/// An answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer<'a> {
    /// The bare acknowledgement, or OK or NR without data: the request was taken.
    Acknowledged,
    /// Data; `high`: of high priority.
    Data { high: bool, data: &'a [u8] },
    /// Refused, with this function (UE, RR, RS).
    Refused(u8),
}

/// Why a telegram answers nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unrelated {
    /// From or to another station.
    Station,
    /// Of another service, or of a kind that does not answer it.
    Kind,
    /// Nothing is under way.
    Late,
}

/// What the line can do now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ready {
    /// Nothing.
    Wait,
    /// The rest of a telegram, or the same one again: it is in [`Line::to_send`].
    Resend,
    /// The request has no answer, and is repeated when the wire is free; or has failed, with all its repetitions.
    Overdue {
        /// Whose it is.
        job: Job,
        /// What there is in place of an answer.
        instead: Instead,
        /// It is not repeated.
        failed: bool,
    },
    /// The wire was silent, and is claimed: the token is in `to_send`.
    Claim,
    /// The next telegram may leave.
    Free,
}

/// What there is in place of an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Instead {
    /// Nothing.
    Silence,
    /// The front of a telegram.
    Part,
    /// What was no telegram, and was reported.
    Garbage,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// There is no port.
    Closed,
    /// Listening: silent since then.
    Listening(Time),
    /// So many tokens of two have left.
    Claiming(u8),
    Free,
    /// The driver has not taken all of a telegram.
    Sending,
    Waiting,
    /// The request is to be sent again.
    Repeating,
}

/// What the wire is used for, and until when.
#[derive(Debug)]
struct Timing {
    state: State,
    /// Nothing counts until the wire was idle.
    garbled: bool,
    /// The wire is free from then on; while an answer is waited for: the request has left by then.
    free_at: Time,
    /// The answer is overdue, or the rest of the telegram is to be sent.
    overdue_at: Time,
    idle_ns: u64,
}

/// The link layer.
#[derive(Debug)]
#[repr(C)] // What each telegram touches in any case comes first.
pub(super) struct Line {
    timing: Timing,
    job: Job,
    expected: Expected,
    /// The request may be repeated so many times more, and `retries` times in all.
    left: u8,
    retries: u8,
    /// Its own address.
    address: u8,
    echo: bool,
    /// Bytes come when they were on the wire, or later.
    is_timed: bool,
    /// What has arrived was there before the request had left.
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
    unanswered_ns: u64,
    claim_ns: u64,
    request: [u8; MAX],
    inbox: [u8; INBOX],
}

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
                idle_ns: bits(plan.bits.idle.max(plan.bits.sync)),
            },
            job: Job::Own,
            expected: Expected { da: 0, saps: None, acknowledge: false, data: None },
            left: 0,
            retries: plan.retries,
            address: plan.address,
            echo: plan.echo,
            is_timed: false,
            early: false,
            echo_left: 0,
            length: 0,
            taken: 0,
            filled: 0,
            used: 0,
            line,
            slot_ns: plan.slot_ns(),
            unanswered_ns: bits(plan.bits.idle_unanswered.max(plan.bits.sync)),
            claim_ns,
            request: [0; MAX],
            inbox: [0; INBOX],
        }
    }

    /// Its own address.
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

    /// Nothing is under way.
    #[inline]
    pub(super) fn is_free(&self) -> bool {
        self.timing.state == State::Free
    }

    /// Whose answer is waited for.
    #[inline]
    pub(super) fn waits_for(&self) -> Option<u8> {
        match self.job {
            Job::Drive(index) if self.timing.state != State::Free => Some(index),
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

    /// What is to be done at `now`. What has arrived until then was handed over.
    #[inline]
    pub(super) fn ready(&mut self, now: Time) -> Ready {
        match self.timing.state {
            State::Free if now >= self.timing.free_at => Ready::Free,
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
        self.timing.overdue_at = now + self.line.span_ns(bytes + 1) + self.slot_ns;
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

    /// The next telegram asks for a master at this address.
    pub(super) fn gap(&mut self, address: u8) {
        let head = Service::FdlStatus.head(address, self.address, false, false);
        if let Some(length) = head.emit(&[], &mut self.request) {
            self.begin(Job::Gap(address), length);
            self.left = 0;
            self.expected = Expected { da: address, saps: None, acknowledge: false, data: Some(0) };
        }
    }

    /// The next telegram is the request of drive `index` that `write` writes, and what its answer is; `None`: it is
    /// none.
    #[inline]
    pub(super) fn request(
        &mut self,
        index: u8,
        write: impl FnOnce(&mut [u8; MAX]) -> Option<(usize, Expected)>,
    ) -> bool {
        let Some((length, expected)) = write(&mut self.request) else { return false };
        self.begin(Job::Drive(index), length);
        self.expected = expected;
        true
    }

    #[inline]
    fn begin(&mut self, job: Job, length: usize) {
        (self.job, self.length, self.taken) = (job, length as u16, 0);
        (self.left, self.filled, self.used, self.timing.garbled) = (self.retries, 0, 0, false);
    }

    /// What the driver is to take of the telegram.
    #[inline]
    pub(super) fn to_send(&self) -> &[u8] {
        self.request.get(usize::from(self.taken)..usize::from(self.length)).unwrap_or_default()
    }

    /// The driver took so many bytes of it at `at`. False: it took none of a telegram of which it had none, which is
    /// given up.
    #[inline]
    pub(super) fn sent(&mut self, at: Time, count: usize) -> bool {
        if count >= self.to_send().len() && self.taken == 0 {
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
            (self.timing.state, self.timing.overdue_at) =
                (State::Sending, at + self.line.span_ns(count.max(1)));
        }
        true
    }

    /// All of the telegram is on its way since `at`.
    #[inline]
    fn left_for_wire(&mut self, at: Time) {
        let ends = at + self.line.span_ns(usize::from(self.length));
        self.echo_left = if self.echo { self.length } else { 0 };
        if self.job != Job::Own {
            (self.timing.state, self.timing.overdue_at) = (State::Waiting, ends + self.slot_ns);
            self.timing.free_at = ends;
            return;
        }
        let is_token = self.length == 3;
        self.timing.free_at = ends + if is_token { self.timing.idle_ns } else { self.unanswered_ns };
        self.timing.state = match self.timing.state {
            State::Claiming(sent) => State::Claiming(sent + 1),
            _ => State::Free,
        };
    }

    /// The longest time from the begin of the telegram until it is closed, with all its repetitions.
    #[inline]
    pub(super) fn closed_within_ns(&self) -> u64 {
        let answer = match self.expected {
            Expected { data: Some(data), .. } => usize::from(data) + ANSWER,
            // An acyclic answer may have any length, a diagnosis is short.
            Expected { acknowledge: true, .. } => MAX,
            Expected { .. } => DIAGNOSIS,
        };
        let once = self.line.span_ns(usize::from(self.length) + answer) + self.slot_ns + self.timing.idle_ns;
        once * (u64::from(self.left) + 1)
    }

    /// Room for what arrives.
    #[inline]
    pub(super) fn room(&mut self) -> &mut [u8] {
        if self.used > 0 {
            self.inbox.copy_within(usize::from(self.used)..usize::from(self.filled), 0);
            (self.filled, self.used) = (self.filled - self.used, 0);
        }
        if usize::from(self.filled) >= INBOX {
            // More than any telegram: noise.
            (self.filled, self.timing.garbled) = (0, true);
        }
        &mut self.inbox[usize::from(self.filled)..]
    }

    /// So many bytes have arrived in its room, the last of them by `at`.
    #[inline]
    pub(super) fn received(&mut self, at: Time, count: usize) {
        self.filled += count as u16;
        if self.echo_left > 0 && self.is_echo() {
            return;
        }
        let Timing { state, free_at, garbled, idle_ns, .. } = &mut self.timing;
        let waits = *state == State::Waiting;
        self.early = waits && self.is_timed && at < *free_at;
        if waits {
            return;
        }
        if at > *free_at {
            // The wire was idle before.
            *garbled = false;
        }
        *free_at = (*free_at).max(at + *idle_ns);
        if let State::Listening(since) = &mut self.timing.state {
            *since = at;
        }
    }

    /// What has arrived is the own telegram, and no more than it.
    #[cold]
    fn is_echo(&mut self) -> bool {
        let echoed = usize::from(self.length - self.echo_left);
        let count = usize::from(self.echo_left.min(self.filled));
        let own = self.request.get(echoed..echoed + count).unwrap_or_default();
        if self.inbox.get(..count) != Some(own) {
            // Something else is on the wire.
            self.echo_left = 0;
            return false;
        }
        self.echo_left -= count as u16;
        self.inbox.copy_within(count..usize::from(self.filled), 0);
        self.filled -= count as u16;
        self.filled == 0
    }

    /// The next thing that has arrived by `at`; `None`: no more.
    #[inline]
    pub(super) fn heard(&mut self, at: Time) -> Option<Heard<'_>> {
        let Line { timing, expected, inbox, used, filled, job, address, early, .. } = self;
        let waits = timing.state == State::Waiting && !*early;
        let bytes = inbox.get(usize::from(*used)..usize::from(*filled)).filter(|bytes| !bytes.is_empty())?;
        if timing.garbled {
            *used = *filled;
            timing.put_off(at, 0);
            return None;
        }
        let telegram = match Next::parse(bytes) {
            Next::Incomplete { .. } if *early => {
                *used = *filled;
                return None;
            }
            Next::Incomplete { at_least } => {
                timing.put_off(at, self.line.span_ns(at_least));
                return None;
            }
            Next::Malformed { why, .. } => {
                *used = *filled;
                if !*early {
                    timing.garbled = true;
                    timing.put_off(at, 0);
                }
                return Some(Heard::Malformed { why, expected: waits });
            }
            Next::Telegram { telegram, size } => {
                *used += size as u16;
                telegram
            }
        };
        let answer = match telegram {
            Telegram::Acknowledge if expected.acknowledge => Ok(Answer::Acknowledged),
            Telegram::Acknowledge => Err(Judged::Unrelated(Unrelated::Kind, None)),
            Telegram::Token { sa, .. } if sa != *address => Err(Judged::OtherMaster(sa)),
            // Its own, from an adapter that returns it.
            Telegram::Token { .. } => Err(Judged::Unrelated(Unrelated::Kind, None)),
            Telegram::Data(frame) => expected.judge(&frame, *address),
        };
        Some(match answer {
            Err(Judged::OtherMaster(address)) => {
                let is_token = matches!(telegram, Telegram::Token { .. });
                Heard::OtherMaster { address, is_token }
            }
            Err(Judged::Unrelated(why, from)) if waits => Heard::Unrelated(why, from),
            Err(Judged::Unrelated(_, from)) => Heard::Unrelated(Unrelated::Late, from),
            Ok(_) if !waits => Heard::Unrelated(Unrelated::Late, Some(expected.da)),
            Ok(answer) => {
                timing.state = State::Free;
                timing.free_at = timing.free_at.max(at + timing.idle_ns);
                if self.left < self.retries {
                    timing.free_at = timing.free_at.max(timing.overdue_at);
                }
                Heard::Answer(*job, answer)
            }
        })
    }
}

impl Timing {
    /// More bytes may follow, for so long.
    #[cold]
    fn put_off(&mut self, at: Time, more_ns: u64) {
        let until = at + more_ns + self.idle_ns;
        match self.state {
            State::Waiting if self.garbled => self.overdue_at = until.max(self.free_at),
            State::Waiting => self.overdue_at = self.overdue_at.max(until),
            _ => self.free_at = self.free_at.max(until),
        }
    }
}

enum Judged {
    Unrelated(Unrelated, Option<u8>),
    OtherMaster(u8),
}

impl Expected {
    /// Whether a telegram answers it, and how.
    #[inline]
    fn judge<'a>(&self, frame: &Frame<'a>, own: u8) -> Result<Answer<'a>, Judged> {
        let Head { da, sa, dsap, ssap, fc } = frame.head;
        let function = fc.0 & !STATION;
        if fc.0 & REQUEST != 0 {
            return Err(match sa == own {
                true => Judged::Unrelated(Unrelated::Kind, None),
                false => Judged::OtherMaster(sa),
            });
        }
        if (da, sa) != (own, self.da) {
            return Err(Judged::Unrelated(Unrelated::Station, Some(sa)));
        }
        if fc.0 & STATION != 0 {
            return Err(Judged::OtherMaster(sa));
        }
        let same_service = self.saps == ssap.zip(dsap);
        let fits = self.data.is_none_or(|length| frame.data.len() == usize::from(length));
        match function {
            DATA_LOW | DATA_HIGH if same_service && fits => {
                Ok(Answer::Data { high: function == DATA_HIGH, data: frame.data })
            }
            // What has no such service cannot name it.
            _ if REFUSED.contains(&function) && (same_service || (dsap, ssap) == (None, None)) => {
                Ok(Answer::Refused(function))
            }
            NO_DATA
                if self.acknowledge
                    && frame.data.is_empty()
                    && (same_service || (dsap, ssap) == (None, None)) =>
            {
                Ok(Answer::Acknowledged)
            }
            0 if (same_service || (dsap, ssap) == (None, None))
                && (self.acknowledge || self.data == Some(0)) =>
            {
                Ok(Answer::Acknowledged)
            }
            _ => Err(Judged::Unrelated(Unrelated::Kind, Some(sa))),
        }
    }
}

#[cfg(test)]
mod tests;
