//! The two mailboxes of a slave: how a message gets into the one, and out of the other (ETG.1000.4, 6.7;
//! ETG.1000.6, 5.6).
//!
//! Knows no SDO. It requests one slot at a time, and knows only the answers:
//!
//! | answer | meaning |
//! |---|---|
//! | a write, working counter 1 | the request is there |
//! | a write, 0 | the mailbox is full: repeat, for as long as the slave may take. After a write whose frame was lost: that one is there |
//! | a write, no frame | it may be there or not: repeat with the same count, which the slave ignores if it has it |
//! | the status, bit 3 | a message waits |
//! | a read of the last byte, 1 | the message is taken |
//! | a read of the last byte, no frame | it may be taken: if there is none now, the slave is requested to repeat it (0x080E, 0x080F) |
//! | no message after that | the slave does not support it, or acknowledges and sends nothing: the message is gone |
//!
//! A message counts as written, or read, with the last byte of its area. So a message goes with the last byte
//! behind it in the same frame, and one that is longer than a slot in pieces, the last byte at the end. With the
//! status the first bytes of a longer mailbox are read: then its last byte and the rest of the message follow in
//! the next slot.

use std::ops::Range;

use super::super::counters::Own;
use super::super::plan::Area;
use super::super::slot::{Answer, Answers, Ask, ROOM};
use super::super::wire::frame::Command;
use super::super::wire::mailbox::{self, COE_HEADER, Counter, HEADER, SDO_SIZE};
use super::super::wire::registers::{SyncManager, address};
use super::super::wire::sdo::{self, Request};
use super::counts::Counts;
use super::sdo::{KEPT, Sdo};
use fieldbeat_core::bus::Counters;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, Time, US};

/// The most that is written at once: the longest value in one message, if the mailbox holds it. A Kollmorgen drive
/// takes 16.
const OUT_MAX: usize = COE_HEADER + sdo::SIZE + KEPT;
/// Bytes that are read with the status of a mailbox that is longer.
const HEAD: usize = 64;
/// Interval of looks while an answer is awaited: a drive's firmware takes a request about once a millisecond.
const LOOK_NS: u64 = 750 * US;
/// A slave that has not answered the first request by then may have had its count from another master: it is
/// repeated with the next one.
const UNCOUNTED_NS: u64 = 300 * MS;
/// Interval of looks for unrequested messages.
const IDLE_NS: u64 = 50 * MS;
/// A message whose repetition has not come by then is gone, whether the slave has acknowledged the request or not.
const REPEAT_NS: u64 = 100 * MS;
/// In `activate` and in the slave's control behind it: the repeat request, and its acknowledgement, each a toggle.
const TOGGLE: u8 = 1 << 1;
const ON: u8 = 1 << 0;
/// Status, `activate` and the slave's control of the mailbox that the master reads, and the second of them.
const STATUS: u16 = address::sync_manager(1) + SyncManager::STATUS;
const ACTIVATE: u16 = STATUS + 1;

/// Both mailboxes.
#[derive(Debug)]
pub struct Mailbox {
    station: u16,
    out: Area,
    input: Area,
    counter: Counter,
    message: [u8; OUT_MAX],
    length: usize,
    sending: Sending,
    reading: Reading,
    read: Box<[u8]>,
    pending: Option<Pending>,
    looked: Option<Time>,
    /// The message there may answer a request that is over.
    stale: bool,
    /// A request was answered since the mailbox was opened: the slave counts as the master does.
    counted: bool,
    /// The counts of the request under way and of its answers.
    counts: Counts,
    /// The time that the slave may take for a request, ns.
    answer_ns: u64,
    /// The longest time until it has the slot again, ns.
    turn_ns: u64,
    /// The interval of looks for unrequested messages, ns.
    idle_ns: u64,
}

/// A request to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Post {
    /// A new one.
    First,
    /// The same again: an answer to an earlier one is as good.
    Again,
    /// It has no answer.
    Unanswered,
}

/// The state of the request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Sending {
    /// There is none.
    #[default]
    Nothing,
    /// It is to be written.
    Due {
        /// An answer to it is owed.
        answered: bool,
        /// A frame with it was lost.
        lost: bool,
        /// The mailbox has been full since then.
        full: Option<Time>,
    },
    /// It was written, and its answer is awaited; twice perhaps, and then there may be two answers.
    Written { twice: bool, since: Time },
}

/// The state of the message in the other mailbox.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Reading {
    /// None is known.
    #[default]
    Nothing,
    /// One is there, and so many bytes of it have been read.
    There(usize),
    /// It may have been taken by a frame that was lost.
    Lost,
    /// The repetition is to be requested, by this toggle.
    Repeat { toggle: u8, since: Time },
    /// It was requested, and the slave has not acknowledged it yet.
    Repeated { toggle: u8, since: Time },
}

/// The last request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pending {
    Write,
    Look,
    /// A part of the message; `closes`: the last byte of the mailbox is read with it.
    Piece {
        at: usize,
        length: usize,
        closes: bool,
    },
    Toggle(u8),
}

/// The result of a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// Nothing ended.
    Nothing,
    /// The slave does not empty the mailbox: the request was given up.
    Full,
    /// A message was lost with its frame, and the slave does not repeat it.
    Gone,
    /// A message: see [`Mailbox::received`].
    Message,
}

/// Done, and done once.
fn done(answer: &Option<Answer<'_>>) -> bool {
    answer.is_some_and(|answer| answer.working_counter == 1)
}

impl Mailbox {
    /// The mailboxes of a slave; `None`: too short to be any.
    pub(super) fn new(
        [out, input]: [Area; 2],
        station: u16,
        answer_ns: u64,
        turn_ns: u64,
    ) -> Option<Mailbox> {
        let is_one = [out, input].iter().all(|area| usize::from(area.length) >= SDO_SIZE);
        is_one.then(|| Mailbox {
            station,
            out,
            input,
            counter: Counter::default(),
            message: [0; OUT_MAX],
            length: 0,
            sending: Sending::Nothing,
            reading: Reading::Nothing,
            read: vec![0; usize::from(input.length)].into(),
            pending: None,
            looked: None,
            stale: true,
            counted: false,
            counts: Counts::default(),
            answer_ns,
            turn_ns,
            // On a long segment that leaves slots for others.
            idle_ns: IDLE_NS.max(2 * turn_ns),
        })
    }

    /// A time that is also long enough for so many turns.
    fn within(&self, ns: u64, turns: u64) -> u64 {
        ns.max(turns * self.turn_ns)
    }

    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.read);
    }

    /// Discards everything under way. The count continues: the slave may still know the last one.
    pub(super) fn reset(&mut self) {
        (self.sending, self.reading, self.pending) = (Sending::Nothing, Reading::Nothing, None);
        (self.looked, self.stale, self.counted, self.counts) = (None, true, false, Counts::default());
    }

    /// Bytes that a message may have.
    pub(super) fn room(&self) -> usize {
        usize::from(self.out.length).min(OUT_MAX)
    }

    /// The requests have room for this. A mailbox of one SDO has expedited ones only (EtherCAT manual, "Mail Input").
    pub(super) fn takes(&self, sdo: &Sdo) -> bool {
        self.room() > SDO_SIZE || !sdo.is_long_write()
    }

    /// No request is under way.
    pub(super) fn is_free(&self) -> bool {
        self.sending == Sending::Nothing
    }

    /// The request has gone out more than once: there may be more than one answer.
    pub(super) fn is_twice(&self) -> bool {
        self.counts.is_repeated() || matches!(self.sending, Sending::Written { twice: true, .. })
    }

    /// The next request. False: it does not fit.
    pub(super) fn post(&mut self, request: &Request<'_>, post: Post) -> bool {
        let (room, counter) = (self.room(), self.counter.next());
        self.length = mailbox::emit(request, counter, &mut self.message[..room]);
        if self.length == 0 {
            return false;
        }
        self.counter = counter;
        self.counts.send(counter, post == Post::Again);
        self.sending = Sending::Due { answered: post != Post::Unanswered, lost: false, full: None };
        true
    }

    /// The request of the next frame is to be written with it.
    pub(super) fn writes(&self) -> bool {
        self.pending == Some(Pending::Write)
    }

    /// The request is with the slave, or an earlier one for the same, and was not answered yet.
    pub(super) fn awaits(&self) -> bool {
        match self.sending {
            Sending::Nothing => false,
            Sending::Due { .. } => self.counts.is_repeated(),
            Sending::Written { .. } => true,
        }
    }

    /// The answer has come.
    pub(super) fn answered(&mut self) {
        self.stale |= self.is_twice();
        self.counted |= self.awaits();
        self.sending = Sending::Nothing;
    }

    /// The answer is no longer awaited; it may still come.
    pub(super) fn abandon(&mut self) {
        // The answer to its frame is not that of the next request.
        self.pending = self.pending.filter(|pending| *pending != Pending::Write);
        (self.sending, self.stale) = (Sending::Nothing, true);
        self.counts.abandon();
    }

    /// The last read bytes, and whatever was behind them; and the counts that they have to fit.
    pub fn received(&mut self) -> (&[u8], &mut Counts) {
        (&self.read, &mut self.counts)
    }

    /// The last count of another master is not known: if it was this one, the slave takes the first request for a
    /// repetition.
    fn recount(&mut self, now: Time) {
        let Sending::Written { since, .. } = self.sending else { return };
        if self.counted || self.reading != Reading::Nothing || now.since(since) < self.within(UNCOUNTED_NS, 6)
        {
            return;
        }
        self.counter = self.counter.next();
        mailbox::recount(&mut self.message[..self.length], self.counter);
        self.counts.send(self.counter, true);
        self.sending = Sending::Due { answered: true, lost: false, full: None };
        self.counted = true;
    }

    /// The request for the next slot.
    #[inline]
    pub(super) fn request(&mut self, now: Time, ask: &mut Ask) {
        self.pending = None;
        // Usually nothing is under way, and it was looked at not long ago.
        let is_idle = (self.sending, self.reading) == (Sending::Nothing, Reading::Nothing);
        if !is_idle || self.looked.is_none_or(|looked| now.since(looked) >= self.idle_ns) {
            self.request_next(now, ask);
        }
    }

    fn request_next(&mut self, now: Time, ask: &mut Ask) {
        self.recount(now);
        let pending = self.next(now);
        let is_requested = match pending {
            None => false,
            Some(Pending::Write) => self.request_write(ask),
            Some(Pending::Look) => self.request_look(ask),
            Some(Pending::Piece { at, length, closes }) => self.request_piece(at, length, closes, ask),
            Some(Pending::Toggle(toggle)) => ask.write(Command::Fpwr(self.station, ACTIVATE), &[ON | toggle]),
        };
        // The room that others left in the slot may be too small.
        self.pending = pending.filter(|_| is_requested);
    }

    fn next(&self, now: Time) -> Option<Pending> {
        let rest = match (self.reading, self.sending) {
            (Reading::There(at), _) => return Some(self.piece(at)),
            (Reading::Repeat { toggle, .. }, _) => return Some(Pending::Toggle(toggle)),
            (Reading::Lost, _) => return Some(Pending::Look),
            (Reading::Nothing, Sending::Due { .. }) if self.stale => return Some(Pending::Look),
            (Reading::Nothing, Sending::Due { .. }) => return Some(Pending::Write),
            (Reading::Nothing, Sending::Nothing) => self.idle_ns,
            (Reading::Nothing, Sending::Written { .. }) | (Reading::Repeated { .. }, _) => LOOK_NS,
        };
        self.looked.is_none_or(|looked| now.since(looked) >= rest).then_some(Pending::Look)
    }

    fn request_write(&self, ask: &mut Ask) -> bool {
        let (area, message) = (self.out, &self.message[..self.length]);
        let last = area.start.wrapping_add(area.length - 1);
        ask.write(Command::Fpwr(self.station, area.start), message)
            && (self.length == usize::from(area.length) || ask.write(Command::Fpwr(self.station, last), &[0]))
    }

    fn request_look(&self, ask: &mut Ask) -> bool {
        // A mailbox that is no longer would be emptied by that.
        let head = self.read.len() <= HEAD || ask.room().is_none_or(|room| room < HEAD + 3);
        ask.read(Command::Fprd(self.station, STATUS), 3)
            && (head || ask.read(Command::Fprd(self.station, self.input.start), HEAD))
    }

    fn request_piece(&self, at: usize, length: usize, closes: bool, ask: &mut Ask) -> bool {
        let read = |at: usize| Command::Fprd(self.station, self.input.start.wrapping_add(at as u16));
        let reaches_end = at + length == self.read.len();
        (length == 0 || ask.read(read(at), length))
            && (!closes || reaches_end || ask.read(read(self.read.len() - 1), 1))
    }

    /// The part to be read after the first `at` bytes.
    fn piece(&self, at: usize) -> Pending {
        if at < HEADER {
            let length = self.read.len().min(HEAD);
            return Pending::Piece { at: 0, length, closes: length == self.read.len() };
        }
        let rest = mailbox::extent(&self.read, self.read.len()).saturating_sub(at);
        Pending::Piece { at, length: rest.min(ROOM - 1), closes: rest < ROOM }
    }

    /// Takes the answer to its request.
    pub(super) fn receive(&mut self, now: Time, answers: &Answers<'_>, counters: &mut Counters) -> Received {
        match self.pending.take() {
            None => Received::Nothing,
            Some(Pending::Write) => self.receive_write(now, answers, counters),
            Some(Pending::Look) => self.receive_look(now, answers, counters),
            Some(Pending::Piece { at, length, closes }) => {
                self.receive_piece(at..at + length, closes, answers, counters)
            }
            Some(Pending::Toggle(toggle)) => {
                let Reading::Repeat { since, .. } = self.reading else { return Received::Nothing };
                if done(&answers[0]) {
                    self.reading = Reading::Repeated { toggle, since };
                } else if now.since(since) >= self.within(REPEAT_NS, 4) {
                    self.reading = Reading::Nothing;
                    return Received::Gone;
                }
                Received::Nothing
            }
        }
    }

    fn receive_write(&mut self, now: Time, answers: &Answers<'_>, counters: &mut Counters) -> Received {
        let Sending::Due { answered, lost, full } = self.sending else { return Received::Nothing };
        let parts = if self.length == usize::from(self.out.length) { 1 } else { 2 };
        let parts = &answers[..parts];
        if parts.iter().any(Option::is_none) {
            Own::MailboxRepeats.count(counters);
            self.sending = Sending::Due { answered, lost: true, full };
        } else if lost || parts.iter().all(done) {
            // Full after a loss: with the message that was thought lost.
            self.sending =
                if answered { Sending::Written { twice: lost, since: now } } else { Sending::Nothing };
        } else {
            let since = full.unwrap_or(now);
            if now.since(since) > self.answer_ns {
                self.sending = Sending::Nothing;
                return Received::Full;
            }
            self.sending = Sending::Due { answered, lost, full: Some(since) };
            // It may wait until its own message is read.
            self.stale = true;
        }
        Received::Nothing
    }

    fn receive_look(&mut self, now: Time, answers: &Answers<'_>, counters: &mut Counters) -> Received {
        let [Some(Answer { working_counter: 1, data: &[status, activate, control] }), head] = *answers else {
            // Haste does not help with a slave that does not answer at all.
            if answers[0].is_some() {
                self.looked = Some(now);
            }
            return Received::Nothing;
        };
        self.looked = Some(now);
        let is_full = status & SyncManager::FULL != 0;
        match self.reading {
            Reading::Repeated { toggle, since }
                if (control & TOGGLE != toggle || !is_full)
                    && now.since(since) < self.within(REPEAT_NS, 4) => {}
            _ if is_full => {
                let read = head.filter(|head| done(&Some(*head)) && head.data.len() == HEAD);
                if let Some((place, head)) = self.read.get_mut(..HEAD).zip(read) {
                    place.copy_from_slice(head.data);
                }
                self.reading = Reading::There(read.map_or(0, |_| HEAD));
            }
            Reading::Lost => {
                Own::MailboxRepeats.count(counters);
                self.reading = Reading::Repeat { toggle: !activate & TOGGLE, since: now };
            }
            Reading::Repeated { .. } => {
                self.reading = Reading::Nothing;
                return Received::Gone;
            }
            _ => (self.reading, self.stale) = (Reading::Nothing, false),
        }
        Received::Nothing
    }

    fn receive_piece(
        &mut self,
        part: Range<usize>,
        closes: bool,
        answers: &Answers<'_>,
        counters: &mut Counters,
    ) -> Received {
        let (length, end) = (part.len(), part.end);
        let is_apart = closes && end < self.read.len();
        let (data, last) = match (length, is_apart) {
            (0, _) => (Some(&[][..]), answers[0]),
            (_, true) => (read(&answers[0], length), answers[1]),
            (_, false) => (read(&answers[0], length), answers[0]),
        };
        let is_lost = answers[0].is_none() || last.is_none();
        let taken = closes && (is_lost || done(&last));
        let Some(data) = data.filter(|_| !is_lost && (!closes || taken)) else {
            self.reading = match (taken, is_lost) {
                (true, _) => Reading::Lost,
                // The bytes that were read of it are still there.
                (false, true) => self.reading,
                (false, false) => Reading::Nothing,
            };
            if is_lost && !closes {
                Own::MailboxRepeats.count(counters);
            }
            return Received::Nothing;
        };
        if let Some(place) = self.read.get_mut(part) {
            place.copy_from_slice(data);
        }
        self.reading = if closes { Reading::Nothing } else { Reading::There(end) };
        if !closes {
            return Received::Nothing;
        }
        // Another one may follow.
        self.looked = None;
        Received::Message
    }
}

/// The read bytes, if all requested ones are there.
fn read<'a>(answer: &Option<Answer<'a>>, length: usize) -> Option<&'a [u8]> {
    answer
        .filter(|answer| answer.working_counter == 1 && answer.data.len() == length)
        .map(|answer| answer.data)
}
