//! What holds after every call, whatever a clause is about: the referee of a line.

use fieldbeat::Cycle;
use fieldbeat::axis::{DriveStatus, Units};
use fieldbeat::telemetry::Counters;
use fieldbeat::time::Time;
use fieldbeat_core::bus::contract::Notices;
use fieldbeat_core::bus::{Exchange, Slot};

use crate::conformance::subject::{Can, Drive, Said};
use crate::conformance::wire::Tape;

/// One drive's slot around a call: the slot before it and behind it.
pub struct SlotChange<'a> {
    pub before: &'a Slot,
    pub after: &'a Slot,
    /// Virtual time before the call and behind it.
    pub span: (Time, Time),
}

impl SlotChange<'_> {
    /// What the loop writes is the loop's.
    fn keeps_the_loops(&self) {
        let loops = |slot: &Slot| (slot.due, slot.guarded, slot.link, slot.desired);
        assert_eq!(loops(self.before), loops(self.after), "what the loop writes is not the bus's to change");
    }

    /// What the drive last said stays as it was.
    fn keeps_the_report(&self) {
        kept(self.before.notices, self.before, self.after);
    }

    /// The same, unless a new connection has found the drive restarted.
    fn keeps_the_report_but(&self, can: &Can) {
        let restarted = self.before.notices.restarted || can.stream && self.after.notices.restarted;
        let mut notices = self.before.notices;
        notices.restarted = restarted;
        kept(notices, self.before, self.after);
    }

    /// Counts only grow, and `missed` is the loop's.
    fn counts_on(&self) {
        let all = |c: &Counters| {
            [c.sent, c.unsent, c.answered, c.late, c.duplicate, c.suspect, c.malformed, c.foreign]
        };
        let (before, after) = (&self.before.counters, &self.after.counters);
        assert!(all(before).iter().zip(all(after)).all(|(b, a)| a >= *b), "{before:?} -> {after:?}");
        assert_eq!(before.missed, after.missed, "a miss is for the loop to say");
    }

    /// The exchange was closed by a reply, or stayed as it was. True if it was closed.
    fn answers_or_keeps(&self, can: &Can) -> bool {
        let (before, after) = (self.before, self.after);
        let answered = after.counters.answered - before.counters.answered;
        match (before.exchange, after.exchange) {
            // The frame of all came back without it, or its reply is overdue.
            (Exchange::Owed { sent_at, .. }, Exchange::Absent { sent_at: same })
                if can.shared || can.half_duplex =>
            {
                assert_eq!((sent_at, answered), (same, 0), "it did not answer");
                self.keeps_the_report_but(can);
                false
            }
            (Exchange::Owed { sent_at, .. }, Exchange::Answered { sent_at: same, at, .. }) => {
                assert_eq!(sent_at, same, "the reply closes the exchange that was open");
                assert!(self.span.0 <= at && at <= self.span.1, "taken in at {at}, in {:?}", self.span);
                assert_eq!(answered, 1, "one exchange, answered once");
                let fresh = after.notices.fresh && !before.notices.fresh;
                assert!(!fresh || after.status.at == at, "what is new came with it: {:?}", after.status);
                true
            }
            // A second reply in the same window may tell that the first was an earlier one.
            (
                Exchange::Answered { sent_at, at, suspect },
                Exchange::Answered { sent_at: a, at: b, suspect: now },
            ) => {
                assert!((sent_at, at) == (a, b) && now >= suspect, "an answered exchange stays answered");
                assert_eq!(answered, 0, "answered once");
                true
            }
            (kept, now) => {
                assert_eq!(kept, now, "only an owed exchange is answered");
                assert_eq!(answered, 0, "nothing was owed");
                self.keeps_the_report_but(can);
                false
            }
        }
    }

    /// After `send`.
    pub fn send(&self, cycle: &Cycle, can: &Can) {
        self.keeps_the_loops();
        self.counts_on();
        let before = self.before;
        let is_open = before.due && !matches!(before.exchange, Exchange::Owed { .. });
        if is_open || before.exchange == Exchange::Queued {
            return self.opens(cycle, can);
        }
        assert_eq!(self.sends(), (0, 0), "no exchange was due, or one was still owed");
        if can.own_clock {
            assert_eq!(before.exchange, self.after.exchange, "no exchange was due");
            return self.takes_packets();
        }
        // Where answers may come cycles later, one between two windows counts, until the loop calls it missed.
        let closed = self.answers_or_keeps(can) && before.exchange != self.after.exchange;
        assert!(!closed || can.answers_after > 0, "answered after {:?}", before.exchange);
    }

    /// How often it was sent something, and how often that was refused.
    fn sends(&self) -> (u64, u64) {
        let (before, after) = (&self.before.counters, &self.after.counters);
        (after.sent - before.sent, after.unsent - before.unsent)
    }

    /// What is reported as new is of a packet that was taken in now.
    fn takes_packets(&self) {
        let (before, after) = (&self.before.status, &self.after.status);
        match self.after.notices.fresh && after.at != before.at {
            true => assert!(self.span.0 <= after.at && after.at <= self.span.1, "taken in at {}", after.at),
            false => self.keeps_the_report(),
        }
    }

    /// An exchange that was due, or queued, is opened, if it has its turn.
    fn opens(&self, cycle: &Cycle, can: &Can) {
        let (before, after) = (self.before, self.after);
        let (sent, unsent) = self.sends();
        assert_eq!(after.counters.answered, before.counters.answered, "what came before the send is late");
        if can.own_clock {
            self.takes_packets();
        } else {
            self.keeps_the_report_but(can);
        }
        match after.exchange {
            Exchange::Queued if can.half_duplex => {
                assert_eq!((sent, unsent), (0, 0), "it waits for its turn")
            }
            Exchange::OwnClock { sent_at, fresh_until } if can.own_clock => {
                assert_eq!((sent, unsent), (1, 0), "one due slot, one exchange");
                assert!(self.span.0 <= sent_at && sent_at <= self.span.1, "{sent_at} in {:?}", self.span);
                assert!(fresh_until >= after.status.at, "a packet counts until {fresh_until}");
            }
            Exchange::Owed { sent_at, reply_by, .. } => {
                assert_eq!((sent, unsent), (1, 0), "one due slot, one exchange");
                assert!(self.span.0 <= sent_at && sent_at <= self.span.1, "{sent_at} in {:?}", self.span);
                let last = cycle.deadline + u64::from(can.answers_after) * cycle.period_ns;
                assert!(sent_at < reply_by && reply_by <= last, "owed by {reply_by}, sent at {sent_at}");
            }
            Exchange::Unsent => assert_eq!((sent, unsent), (0, 1), "one due slot, one refusal"),
            other => panic!("after the send of a due slot its exchange is {other:?}"),
        }
    }

    /// After `poll`.
    pub fn poll(&self, cycle: &Cycle, can: &Can) {
        self.keeps_the_loops();
        self.counts_on();
        if self.before.exchange == Exchange::Queued {
            return self.opens(cycle, can);
        }
        assert_eq!(self.sends(), (0, 0), "nothing waited for its turn");
        assert_eq!(self.before.counters.answered, self.after.counters.answered, "nothing was taken in");
        self.answers_or_keeps(can);
    }

    /// After `receive`.
    pub fn receive(&self, can: &Can) {
        self.keeps_the_loops();
        self.counts_on();
        assert_eq!(self.sends(), (0, 0), "nothing is sent while receiving");
        if can.own_clock {
            let sent_at = |slot: &Slot| slot.exchange.sent_at();
            assert_eq!(sent_at(self.before), sent_at(self.after), "nothing is answered");
            return self.takes_packets();
        }
        let was_fresh = self.before.notices.fresh;
        let closed = self.answers_or_keeps(can);
        let Slot { status, notices, .. } = self.after;
        assert!(closed || notices.fresh == was_fresh, "fresh without an answer");
        assert!(notices.fresh || !notices.monitor_fresh, "shown without an answer: {status:?}");
    }

    /// After `prepare`.
    pub fn prepare(&self) {
        self.keeps_the_loops();
        self.keeps_the_report();
        assert_eq!(self.before.counters, self.after.counters, "nothing is sent or received while preparing");
        assert_eq!(self.before.exchange, self.after.exchange, "the exchange is not opened before the send");
    }
}

/// Bit for bit: no number is no number.
fn kept(notices: Notices, before: &Slot, after: &Slot) {
    let (before, after) = ((before.status, notices), (after.status, after.notices));
    assert_eq!(format!("{before:?}"), format!("{after:?}"), "the status changed without an accepted reply");
}

/// Every request is answered, missed or owed, and each telegram that was taken in is counted in one place.
pub fn accounts(slot: &Slot, tape: &Tape, can: &Can) {
    let c = &slot.counters;
    // What is absent is a miss that the loop has not counted yet, and of what nothing answers it has counted nothing.
    let open =
        matches!(slot.exchange, Exchange::Owed { .. } | Exchange::Absent { .. } | Exchange::OwnClock { .. });
    let owed = u64::from(open);
    assert_eq!(c.sent, c.answered + c.missed + owed, "sent = answered + missed + owed: {c:?}");
    let answers = if can.own_clock { 0 } else { c.answered };
    let said = answers + c.late + c.duplicate + c.malformed + c.foreign;
    match can.shared || can.own_clock {
        // What is late or broken counts for whoever has the turn.
        _ if can.bytes => {}
        // A frame without an exchange is not counted, nor is a packet that answers nothing.
        true => assert!(said <= tape.taken, "of {} frames each is counted once at most: {c:?}", tape.taken),
        false => assert_eq!(tape.taken, said, "telegrams from the drive = all they are counted as: {c:?}"),
    }
    assert!(c.suspect <= c.answered, "{c:?}");
}

/// More than there are answers from one part to the same one again.
const PARTS: usize = 8;

/// What is reported as new is what the drive said in answer to a request that left at `since` or later.
pub fn honest(slot: &Slot, tape: &Tape, drive: &Drive, can: &Can, since: Time) {
    let units = drive.axis.units;
    if !tape.packets.is_empty() {
        let mut newer = tape.packets.iter().rev().take_while(|packet| packet.at >= since);
        let given =
            newer.any(|packet| packet.said.is_some_and(|said| matches_report(&slot.status, said, &units)));
        assert!(given, "reported as new, but not said since {since}: {:?}", slot.status);
        return;
    }
    // Of an answer that says a part, the rest is of those before it.
    let before = if can.whole { 0 } else { PARTS };
    let newer = tape.received.iter().rev().take_while(|received| received.at >= since).count();
    let recent = tape.received.iter().rev().take(newer + before);
    let mut given = recent.filter_map(|received| received.reported);
    let given = given.any(|said| matches_report(&slot.status, said, &units))
        || tape.received.iter().all(|received| received.reported.is_none());
    assert!(given, "reported as new, but not said since {since}: {:?}", slot.status);
}

/// Position, demand and velocity are as the drive reported them, in its units.
pub fn matches_report(report: &DriveStatus, said: Said, units: &Units) -> bool {
    let at = |position: Option<i64>, reported| match position {
        Some(position) => near(units.position(position), reported),
        None => reported.is_nan(),
    };
    at(said.position, report.position)
        && (at(said.demand, report.demand)
            || said.setpoint.is_some_and(|own| {
                near(units.position(own), report.demand) || at(said.position, report.demand)
            }))
        && said.velocity.is_none_or(|velocity| near(units.distance(velocity), report.velocity))
}

/// Equal but for the last digits.
pub fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * (1.0 + a.abs())
}
