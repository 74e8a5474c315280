//! The members of a segment, with the content of their frames.

use std::ops::{Index, IndexMut, Range};

use super::member::Member;
use crate::bus::ethercat::image::AL_SIZE;
use crate::bus::ethercat::plan::Owner;
use crate::bus::ethercat::wire::registers::{AlState, AlStatus};
use crate::rt::Regions;

/// A member and the content of its frames.
#[derive(Debug)]
pub(super) struct Part {
    pub member: Member,
    /// Its AL status in the image; 0: none.
    pub shown: AlStatus,
    pub missing: u8,
    /// It was in OP with all of its process data, its crew knows it, and the newest frame shows the same.
    pub steady: bool,
    /// The state last reported to its crew, and its mailbox.
    pub told: Option<AlState>,
    pub open: bool,
}

/// What a frame shows of a member in operation, and its owner: all that is read from cycle to cycle.
#[derive(Debug)]
pub(super) struct View {
    pub owner: Owner,
    pub inputs: Range<usize>,
    al: usize,
}

/// All members. Access that may change one unsettles the segment, until each of its frames has shown its members as
/// expected again.
#[derive(Debug)]
pub(super) struct Parts {
    parts: Box<[Part]>,
    views: Box<[View]>,
    settled: bool,
}

impl Parts {
    pub(super) fn new(members: impl Iterator<Item = Member>) -> Parts {
        let part = |member| Part {
            member,
            shown: AlStatus::default(),
            missing: 0,
            steady: false,
            told: None,
            open: false,
        };
        let parts: Box<[Part]> = members.map(part).collect();
        let view = |part: &Part| {
            let Member { owner, spot, .. } = &part.member;
            View { owner: *owner, inputs: spot.inputs.clone(), al: spot.al }
        };
        let views = parts.iter().map(view).collect();
        Parts { parts, views, settled: false }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.parts);
        regions.add(&*self.views);
        self.parts.iter().for_each(|part| part.member.memory(regions));
    }

    pub(super) fn len(&self) -> usize {
        self.parts.len()
    }

    pub(super) fn get(&self, index: usize) -> Option<&Part> {
        self.parts.get(index)
    }

    pub(super) fn iter(&self) -> std::slice::Iter<'_, Part> {
        self.parts.iter()
    }

    pub(super) fn iter_mut(&mut self) -> std::slice::IterMut<'_, Part> {
        self.settled = false;
        self.parts.iter_mut()
    }

    /// All are in operation with all of their process data, their crew knows it, and none has been changed since.
    #[inline]
    pub(super) fn are_settled(&self) -> bool {
        self.settled
    }

    /// All were steady in the newest frame that carries them, and none has changed since.
    pub(super) fn settle(&mut self) {
        let is_so = |part: &Part| part.steady && part.told == Some(AlState::Op) && part.member.is_steady();
        self.settled = self.parts.iter().all(is_so);
    }

    /// What a frame shows of these, if all of them are in OP, without an error.
    #[inline]
    pub(super) fn in_operation(&self, range: Range<usize>, received: &[u8]) -> Option<&[View]> {
        const OPERATIONAL: u16 = AlState::Op.number() as u16;
        let views = self.views.get(range)?;
        let shown = |view: &View| {
            let bytes = received.get(view.al..).and_then(<[u8]>::first_chunk::<AL_SIZE>);
            bytes.is_some_and(|bytes| u16::from_le_bytes(*bytes) & AlStatus::SHOWN == OPERATIONAL)
        };
        views.iter().all(shown).then_some(views)
    }
}

impl Index<usize> for Parts {
    type Output = Part;

    #[inline]
    fn index(&self, index: usize) -> &Part {
        &self.parts[index]
    }
}

impl IndexMut<usize> for Parts {
    fn index_mut(&mut self, index: usize) -> &mut Part {
        self.settled = false;
        &mut self.parts[index]
    }
}
