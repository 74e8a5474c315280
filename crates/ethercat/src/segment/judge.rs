//! Which slaves took part in a frame that has come back.
//!
//! One working counter stands for all slaves of a frame. The AL status of each in it shows whether it was there,
//! and in which state; the counter has to be the sum of those. If it is not, nothing in the frame counts. A slave
//! that counts wrongly for a while must not stop all others: then each is evaluated alone, by its AL status and by
//! inputs that are not all zero, since the master sends zeros.

use std::ops::{Deref, DerefMut, Range};

use super::slave::{Mapped, Slave};
use super::{Back, Handler, Requester, Segment, SlaveState, Taken};
use crate::counters::Own;
use crate::image::AL_SIZE;
use crate::plan::Owner;
use crate::wire::registers::{AlState, AlStatus};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

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

/// The inputs of a slave that took part.
#[inline(never)]
fn take(slave: &Slave, al: AlState, back: &Back<'_>, handler: &mut impl Handler) {
    if let Some(inputs) = back.received.get(slave.offsets.inputs.clone()) {
        handler.take(slave.owner, Taken { at: back.at, al, inputs, in_window: back.in_window });
    }
}

/// The part of a frame on a slave in operation, and its owner: all that is read from cycle to cycle.
#[derive(Debug)]
struct View {
    owner: Owner,
    /// The offsets of its inputs, and of its AL status.
    inputs: Range<u16>,
    al: u16,
}

/// All slaves. Access that may change one unsettles the segment, until each of its frames has shown its slaves as
/// expected again.
#[derive(Debug, Default)]
pub struct Slaves {
    slaves: Box<[Slave]>,
    views: Box<[View]>,
    /// All are in operation with all of their process data, which was reported, and none has been changed since.
    pub are_settled: bool,
    /// The one whose clock is the segment's was determined, and whether its time goes to all; and none has been changed
    /// since.
    pub(super) are_timed: bool,
}

impl Deref for Slaves {
    type Target = [Slave];

    #[inline]
    fn deref(&self) -> &[Slave] {
        &self.slaves
    }
}

impl DerefMut for Slaves {
    #[inline]
    fn deref_mut(&mut self) -> &mut [Slave] {
        (self.are_settled, self.are_timed) = (false, false);
        &mut self.slaves
    }
}

impl Slaves {
    pub(super) fn new(slaves: impl Iterator<Item = Slave>) -> Slaves {
        let slaves: Box<[Slave]> = slaves.collect();
        let view = |Slave { owner, offsets, .. }: &Slave| View {
            owner: *owner,
            inputs: offsets.inputs.start as u16..offsets.inputs.end as u16,
            al: offsets.al as u16,
        };
        Slaves { views: slaves.iter().map(view).collect(), slaves, ..Slaves::default() }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.slaves);
        regions.add(&*self.views);
        self.iter().for_each(|slave| slave.memory(regions));
    }

    /// The state of these in a frame, if all of them are in OP, without an error.
    #[inline]
    fn in_operation(&self, range: Range<usize>, received: &[u8]) -> Option<&[View]> {
        let views = self.views.get(range)?;
        let mut differs = 0;
        for view in views {
            let al = usize::from(view.al);
            let bytes = received.get(al..al + AL_SIZE)?.try_into().ok()?;
            differs |= u16::from_le_bytes(bytes) ^ OPERATIONAL.0;
        }
        (differs & AlStatus::SHOWN == 0).then_some(views)
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
pub struct FrameState {
    /// The slaves whose process data it carries.
    range: Range<usize>,
    /// The working counter when all of them are in operation.
    full: u16,
    /// How often it was unsound recently.
    unsound: u8,
}

impl FrameState {
    pub(super) fn new(range: Range<usize>, slaves: &Slaves) -> FrameState {
        FrameState { full: slaves[range.clone()].iter().map(Slave::full).sum(), range, unsound: 0 }
    }
}

impl Segment {
    /// Which slaves took part in the frame, and what follows; true: all of them, as before.
    #[inline]
    pub(super) fn judge(&mut self, back: &Back<'_>, number: usize, handler: &mut impl Handler) -> bool {
        let is_as_before = self.is_as_before(back, number, handler);
        if !is_as_before {
            self.judge_each(back, number, handler);
        }
        is_as_before
    }

    /// The usual case: all were in operation, and still are.
    #[inline]
    fn is_as_before(&self, back: &Back<'_>, number: usize, handler: &mut impl Handler) -> bool {
        let Some(frame) = self.frames.get(number) else { return false };
        if !self.is_settled() || frame.unsound > 0 || back.counter != frame.full {
            return false;
        }
        let Some(views) = self.slaves.in_operation(frame.range.clone(), back.received) else { return false };
        let inputs = |view: &View| {
            let range = usize::from(view.inputs.start)..usize::from(view.inputs.end);
            Some((view.owner, back.received.get(range)?))
        };
        handler.take_all(back.at, back.in_window, views.iter().filter_map(inputs));
        true
    }

    #[inline(never)]
    fn judge_each(&mut self, back: &Back<'_>, number: usize, handler: &mut impl Handler) {
        let Some(FrameState { range, unsound, .. }) = self.frames.get_mut(number) else { return };
        let (mut least, mut most) = (0, 0);
        for slave in &mut self.slaves[range.clone()] {
            slave.shown = slave.shown_in(back.received);
            slave.steady = slave.shown == OPERATIONAL && slave.is_steady();
            let (low, high) = match slave.steady {
                true => (slave.full(), slave.full()),
                false => slave.counts(),
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
            let slave = &mut self.slaves[index];
            if slave.steady && sound {
                slave.missing = 0;
                take(slave, AlState::Op, back, handler);
                continue;
            }
            if !sound {
                handler.count(slave.owner, Own::WrongCount);
            }
            self.judge_slave(index, verdict, back, handler);
        }
        if sound {
            self.slaves.are_settled = self.slaves.iter().all(|slave| slave.steady && slave.is_steady());
        }
    }

    fn judge_slave(&mut self, index: usize, verdict: Verdict, back: &Back<'_>, handler: &mut impl Handler) {
        let slave = &mut self.slaves[index];
        if slave.way.mapped == Mapped::None {
            return;
        }
        let now = back.sent.cycle.grid;
        let there = match verdict {
            Verdict::Unsound => false,
            Verdict::Sound { whole } => slave.shown.0 != 0 || whole && !slave.has_al,
            Verdict::Alone => slave.shown.0 != 0 && (slave.is_device() || slave.has_inputs(back.received)),
        };
        if !there {
            if back.in_window && slave.reported.is_some() {
                handler.passed_by(slave.owner);
            }
            if verdict == Verdict::Unsound {
                return;
            }
            slave.missing = slave.missing.saturating_add(1);
            // Without an AL status in the image it is read separately.
            if slave.missing >= GONE_AFTER && slave.is_settled() && slave.has_al {
                slave.lost(now);
            }
            return self.report(index, handler);
        }
        slave.missing = 0;
        if slave.has_al && (slave.way.al != slave.shown.state() || slave.shown.error()) {
            self.lowered |= slave.is_lowered(now);
            slave.show(now);
        }
        let state = slave.state_of_replies();
        self.report(index, handler);
        if let Some(al) = state {
            take(&self.slaves[index], al, back, handler);
        }
    }

    /// A sent frame did not come back in its time: its request is repeated. `first`: the frame with the slot.
    pub fn lost(&mut self, now: Time, first: bool, handler: &mut impl Handler) {
        if !first {
            return;
        }
        if let Some(Requester::Mailbox(index)) = self.requester.take() {
            handler.mailbox_received(self.slaves[index].owner, now, &[None, None]);
        }
        self.clock.miss();
        self.dark = self.dark.saturating_add(1);
        if self.dark == DARK {
            // Both clocks run by themselves now.
            self.clock.forget();
            // The state of a drive is shown by its exchanges, and its stop continues: it may receive although
            // nothing is received from it. A device has no exchanges.
            for slave in self.slaves.iter_mut().filter(|slave| slave.is_device()) {
                if slave.reported.take().is_some() {
                    let state = SlaveState { al: None, is_watched: slave.watched, found_mode: None };
                    handler.state(slave.owner, state);
                }
            }
        }
    }
}
