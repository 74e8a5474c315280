//! Which slaves took part in a frame that has come back.
//!
//! One working counter stands for all slaves of a frame. The AL status of each in it shows whether it was there,
//! and in which state; the counter has to be the sum of those. If it is not, nothing in the frame counts. A slave
//! that counts wrongly for a while must not stop all others: then each is evaluated alone, by its AL status and by
//! inputs that are not all zero, since the master sends zeros.

use std::ops::Range;

use super::member::{Mapped, Member};
use super::parts::Parts;
use super::{Asker, Back, Crew, Line, Taken};
use crate::bus::Slot;
use crate::bus::ethercat::counters::Own;
use crate::bus::ethercat::plan::Owner;
use crate::bus::ethercat::wire::registers::{AlState, AlStatus};
use crate::time::Time;

/// Frames in a row that come back without a slave until it counts as lost.
const GONE_AFTER: u8 = 3;
/// The weight of an unsound frame; a sound one takes 1 away. From this sum on each slave is evaluated alone: after
/// two in a row, or where more than every fourth one is unsound.
const UNSOUND: u8 = 3;
const UNSOUND_MANY: u8 = 3 * UNSOUND;
const UNSOUND_MOST: u8 = 20 * UNSOUND;
/// Frames in a row that do not come back until the last inputs of devices are no longer valid.
const DARK: u32 = 20;

/// In OP, without an error.
const OPERATIONAL: AlStatus = AlStatus(AlState::Op.number() as u16);

/// The inputs of a member that took part.
#[inline(never)]
fn take(member: &Member, al: AlState, back: &Back<'_>, crew: &mut impl Crew, slots: &mut [Slot]) {
    if let Some(inputs) = back.received.get(member.spot.inputs.clone()) {
        crew.take(member.owner, Taken { at: back.at, al, inputs, in_window: back.in_window }, slots);
    }
}

/// How a frame is evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    /// All of its content is valid. `whole`: no slave is missing.
    Sound { whole: bool },
    /// Each slave is evaluated alone.
    Alone,
    /// Nothing in it counts.
    Unsound,
}

/// The state of one frame of the image.
#[derive(Debug)]
pub(super) struct FrameState {
    /// The members whose process data it carries.
    range: Range<usize>,
    /// Its working counter when all of them are in operation.
    full: u16,
    /// How often it was unsound recently.
    unsound: u8,
}

impl FrameState {
    pub(super) fn new(range: Range<usize>, members: &Parts) -> FrameState {
        let full = range.clone().filter_map(|index| members.get(index)).map(|part| part.member.full()).sum();
        FrameState { range, full, unsound: 0 }
    }
}

impl Line {
    /// Which slaves took part in the frame, and what follows.
    #[inline]
    pub(super) fn judge(&mut self, back: &Back<'_>, number: usize, crew: &mut impl Crew, slots: &mut [Slot]) {
        if !self.is_as_before(back, number, crew, slots) {
            self.judge_each(back, number, crew, slots);
        }
    }

    /// The usual case: all were in operation, and still are.
    #[inline]
    fn is_as_before(&self, back: &Back<'_>, number: usize, crew: &mut impl Crew, slots: &mut [Slot]) -> bool {
        let Some(frame) = self.frames.get(number) else { return false };
        if !self.members.are_settled() || frame.unsound > 0 || back.counter != frame.full {
            return false;
        }
        let Some(views) = self.members.in_operation(frame.range.clone(), back.received) else { return false };
        for view in views {
            if let Some(inputs) = back.received.get(view.inputs.clone()) {
                let taken = Taken { at: back.at, al: AlState::Op, inputs, in_window: back.in_window };
                crew.take(view.owner, taken, slots);
            }
        }
        true
    }

    #[inline(never)]
    fn judge_each(&mut self, back: &Back<'_>, number: usize, crew: &mut impl Crew, slots: &mut [Slot]) {
        let Some(FrameState { range, unsound, .. }) = self.frames.get_mut(number) else { return };
        let (mut least, mut most) = (0, 0);
        for index in range.clone() {
            let part = &mut self.members[index];
            part.shown = part.member.shown(back.received);
            part.steady =
                part.shown == OPERATIONAL && part.told == Some(AlState::Op) && part.member.is_steady();
            let (low, high) = match part.steady {
                true => (part.member.full(), part.member.full()),
                false => part.member.counts(part.shown),
            };
            (least, most) = (least + low, most + high);
        }
        let verdict = if (least..=most).contains(&back.counter) {
            *unsound = unsound.saturating_sub(1);
            Verdict::Sound { whole: back.counter == most }
        } else {
            *unsound = (*unsound + UNSOUND).min(UNSOUND_MOST);
            if *unsound >= UNSOUND_MANY { Verdict::Alone } else { Verdict::Unsound }
        };
        let sound = matches!(verdict, Verdict::Sound { .. });
        for index in range.clone() {
            let part = &mut self.members[index];
            if part.steady && sound {
                part.missing = 0;
                take(&part.member, AlState::Op, back, crew, slots);
                continue;
            }
            if !sound && let Some(counters) = crew.counters(self.members[index].member.owner, slots) {
                Own::WrongCount.count(counters);
            }
            self.note_part(index, verdict, back, crew, slots);
        }
        if sound {
            self.members.settle();
        }
    }

    /// The content of a frame for one member.
    fn note_part(
        &mut self,
        index: usize,
        verdict: Verdict,
        back: &Back<'_>,
        crew: &mut impl Crew,
        slots: &mut [Slot],
    ) {
        let part = &mut self.members[index];
        let member = &mut part.member;
        if member.mapped() == Mapped::None {
            return;
        }
        let now = back.sent.cycle.grid;
        let there = match verdict {
            Verdict::Unsound => {
                if back.in_window && part.told.is_some() {
                    crew.passed_by(member.owner, slots);
                }
                return;
            }
            Verdict::Sound { whole } => part.shown.0 != 0 || whole && !member.has_al(),
            Verdict::Alone => part.shown.0 != 0 && (member.is_device() || member.has_inputs(back.received)),
        };
        if !there {
            if back.in_window && part.told.is_some() {
                crew.passed_by(member.owner, slots);
            }
            part.missing = part.missing.saturating_add(1);
            // Without an AL status in the image it is read separately.
            if part.missing >= GONE_AFTER && member.is_settled() && member.has_al() {
                member.lost(now);
            }
            return self.tell(index, crew, slots);
        }
        part.missing = 0;
        if member.has_al() && (member.al() != part.shown.state() || part.shown.error()) {
            self.lowered |= member.is_lowered(now, part.shown);
            member.show(now, part.shown);
        }
        let state = member.state_of_replies();
        if part.told != state {
            self.tell(index, crew, slots);
        }
        let member = &self.members[index].member;
        if let Some(al) = state {
            take(member, al, back, crew, slots);
        }
    }

    /// A sent frame did not come back in its time: its request is repeated. `first`: the frame with the slot.
    pub fn lost(&mut self, now: Time, first: bool, crew: &mut impl Crew, slots: &mut [Slot]) {
        if !first {
            return;
        }
        if let Some(Asker::Mailbox(index)) = self.asker.take() {
            self.mailbox_heard(now, index, &[None, None], crew, slots);
        }
        self.dark = self.dark.saturating_add(1);
        if self.dark == DARK {
            // Both clocks run by themselves now.
            self.clock.forget();
            // The state of a drive is shown by its exchanges, and its stop continues: it may receive although
            // nothing is received from it. A device has no exchanges.
            for part in self.members.iter_mut() {
                if matches!(part.member.owner, Owner::Device(_)) && part.told.take().is_some() {
                    crew.state(part.member.owner, None, slots);
                }
            }
        }
    }
}
