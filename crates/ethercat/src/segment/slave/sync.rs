//! The clock of a slave: set to the segment's, left to synchronise to it, and SYNC0 made of it.
//!
//! The time is compared with that of the reference in the same frame, so that no lateness of a frame counts. While it
//! is far from the segment's time its compensation runs at its limit, so its offset is corrected by what the
//! difference is then: the compensation alone takes some thousand frames for that. It has those while the slave goes
//! on to SAFEOP, and waits for the rest there.
//!
//! Delays are relative to the first slave with SYNC0. While one behind it is the reference, all others are ahead of it
//! by its own delay, about 1 us for each slave between the two.

use super::{Context, Mapped, Note, Setting, Slave, Step};
use crate::segment::clock::window_ns;
use crate::segment::running::near;
use crate::wire::registers::{AlState, Difference, address};
use fieldbeat_core::time::{MS, S, Time, US};

/// It is synchronised when its difference is not larger than this part of what a drive tolerates, 5 us at 1 ms (masters
/// wait for about 1 us at any period; but while the reference itself still settles to the grid, the others are some us
/// behind it for some thousand frames more). That is for so many looks, each so long after the other; the wait is
/// limited to so long, and to so many cycles: each frame removes a part of the difference.
const SETTLED: i64 = 64;
const SETTLED_LOOKS: u8 = 3;
const SETTLE_LOOK_NS: u64 = 100 * MS;
const SETTLE_NS: u64 = 10 * S;
const SETTLE_CYCLES: u64 = 20_000;
/// So long, and so many turns of the slot, it waits for a drive that is found in OP to show whether it has power.
const TIME_NS: u64 = 50 * MS;
const TIME_TURNS: u64 = 20;
/// SYNC0 begins so long after it was set up, and at least so long after it was switched on.
const SYNC_AHEAD_NS: u64 = 100 * MS;
/// That many turns of the slot lie between the two.
const SYNC_TURNS: u64 = 4;
const SYNC_LEFT_NS: u64 = 5 * MS;

/// A difference that the drift alone does not make: this, or this part of the period if that is more; while it settles
/// eight times as much. Its offset is corrected by that so often at most.
const COARSE_NS: i64 = 50 * US as i64;
const COARSE: u64 = 20;
const SETTLING: i64 = 8;
const CORRECTIONS: u8 = 5;

/// From its time to the end of its offset.
pub(super) const TIME: usize = OFFSET_AT + 8;
const OFFSET_AT: usize = (address::DC_OFFSET - address::DC_TIME) as usize;

impl Slave {
    /// The clock is the segment's.
    pub(super) fn is_reference(&self, context: &Context<'_>) -> bool {
        context.reference == Some(self.station())
    }

    /// Where it goes on once it is set up: its clock is to be set first, if it could not be before.
    pub(super) fn step_of_clock(&self) -> Step {
        match self.plan.sync {
            true if self.clock_set => Step::SegmentTime,
            true => Step::Time,
            false => Step::to(AlState::SafeOp),
        }
    }

    /// The clock is set, or cannot be yet: it goes on.
    pub(super) fn continue_timed(&mut self, now: Time) {
        let next = match self.plan.mailbox {
            _ if self.way.mapped == Mapped::All => self.step_of_clock(),
            Some(_) => Step::Mailbox,
            None => Step::to(AlState::PreOp),
        };
        self.enter(now, next);
    }

    /// The segment has no time for it for now: a slave runs on another one, or it is not known yet whether one does.
    pub(super) fn waits_long_for_time(&self, context: &Context<'_>) -> bool {
        let looks_ns = TIME_NS.max(TIME_TURNS * context.turn_ns);
        context.other_time.is_some() || !context.may_begin && context.cycle.grid.since(self.since) > looks_ns
    }

    /// The answers to the steps of its clock.
    pub(super) fn receive_clock(&mut self, context: &Context<'_>, first: &[u8], second: &[u8]) {
        let now = context.cycle.grid;
        match self.step {
            Step::Time => self.timed(context, first),
            Step::Offset(setting) => {
                self.clock_set = true;
                match self.is_reference(context) {
                    true => self.continue_timed(now),
                    false => self.enter(now, Step::Correct(setting)),
                }
            }
            Step::Correct(setting) => self.corrected(context, setting, first),
            Step::Settle { good, .. } => self.settled(context, good, first),
            Step::SegmentTime => {
                let Some(own) = second.first_chunk().map(|bytes| u64::from_le_bytes(*bytes)) else { return };
                let segment_ns = near(context.clock.time(context.cycle, context.sent_at), own as u32);
                let ahead_ns = own.wrapping_sub(segment_ns);
                let segment_ns = context.clock.sync_from(segment_ns.wrapping_add(sync_ahead_ns(context)));
                self.enter(now, Step::SyncStart { ahead_ns, segment_ns });
            }
            Step::SyncStart { segment_ns, .. } => self.enter(now, Step::SyncOn { segment_ns }),
            Step::SyncOn { segment_ns } => {
                // Its start must lie ahead, or there is none.
                let left = segment_ns.wrapping_sub(context.clock.time(context.cycle, context.sent_at)) as i64;
                let in_time = left > SYNC_LEFT_NS as i64;
                self.enter(now, if in_time { Step::to(AlState::SafeOp) } else { Step::SegmentTime });
            }
            _ => {}
        }
    }

    /// The own time and offset, as this frame read them.
    fn timed(&mut self, context: &Context<'_>, data: &[u8]) {
        let long = |at: usize| data.get(at..)?.first_chunk().map(|bytes| u64::from_le_bytes(*bytes));
        let (Some(shown), Some(before), Some(own_ns)) = (long(0), long(OFFSET_AT), self.delay_ns) else {
            return;
        };
        let delay_ns = own_ns.saturating_sub(context.first_delay_ns.unwrap_or(0));
        let segment_ns = context.clock.shows(context.cycle, context.sent_at);
        let ahead = shown.wrapping_sub(segment_ns.wrapping_add(delay_ns.into()));
        let offset = self.whole(before.wrapping_sub(ahead));
        self.enter(context.cycle.grid, Step::Offset(Setting { offset, delay_ns, corrected: 0 }));
    }

    /// The difference to the reference with that offset.
    fn corrected(&mut self, context: &Context<'_>, setting: Setting, data: &[u8]) {
        let now = context.cycle.grid;
        let Some(off) = difference_ns(data) else { return };
        // It ran at its limit until its offset was set for the first time.
        let most = if setting.corrected == 0 { settled_ns(context) } else { coarse_ns(context) };
        if off.abs() <= most {
            return self.continue_timed(now);
        }
        if setting.corrected >= CORRECTIONS {
            return self.refuse(now, Note::Unsettled);
        }
        let offset = self.whole(setting.offset.wrapping_sub(off as u64));
        self.enter(now, Step::Offset(Setting { offset, corrected: setting.corrected + 1, ..setting }));
    }

    fn settled(&mut self, context: &Context<'_>, good: u8, data: &[u8]) {
        let now = context.cycle.grid;
        let limit_ns = SETTLE_NS.max(context.cycle.period_ns.saturating_mul(SETTLE_CYCLES));
        let Some(off) = difference_ns(data) else { return };
        let good = if off.abs() <= settled_ns(context) { good + 1 } else { 0 };
        if good >= SETTLED_LOOKS || self.is_reference(context) {
            // It has received regular cycles and SYNC0 since it is in SAFEOP.
            self.step = Step::Lock;
        } else if now.since(self.since) > limit_ns {
            self.refuse(now, Note::Unsettled);
        } else if off.abs() > SETTLING * coarse_ns(context) && self.way.set_anew < CORRECTIONS {
            // Another time than it was set to.
            self.way.set_anew += 1;
            self.enter(now, Step::Time);
        } else {
            // The others have looks, too.
            let next = now + SETTLE_LOOK_NS.max(2 * context.turn_ns);
            self.step = Step::Settle { good, next };
        }
    }

    /// A time that its clock can have.
    pub(super) fn whole(&self, ns: u64) -> u64 {
        if self.features.has_long_clock() { ns } else { u64::from(ns as u32) }
    }
}

/// How long before its begin SYNC0 is set up.
pub(super) fn sync_ahead_ns(context: &Context<'_>) -> u64 {
    SYNC_AHEAD_NS + SYNC_TURNS * context.turn_ns
}

/// The difference to the reference, as its register has it.
fn difference_ns(data: &[u8]) -> Option<i64> {
    data.first_chunk().map(|bytes| Difference(u32::from_le_bytes(*bytes)).ns())
}

/// The most that a synchronised clock is off.
fn settled_ns(context: &Context<'_>) -> i64 {
    window_ns(context.cycle.period_ns) / SETTLED
}

/// The least difference that its offset is corrected by.
fn coarse_ns(context: &Context<'_>) -> i64 {
    COARSE_NS.max((context.cycle.period_ns / COARSE) as i64)
}
