//! One SDO: reading or writing an object, message by message (ETG.1000.6, 5.6.2; CiA 301).
//!
//! Knows neither the mailbox nor the time. Every step brings it closer to its end, or ends it.

use super::super::object::{ENDLESS, TOGGLE, TRUNCATED};
use super::super::wire::mailbox::COE_HEADER;
use super::super::wire::sdo::{AbortCode, EXPEDITED_MAX, Object, Request, Response, SEGMENT_HEADER, SIZE};

/// The bytes of an object that are kept; the rest is read and counted.
pub(super) const KEPT: usize = 64;
/// The largest object, bytes; a longer one counts as endless.
const MOST: usize = 1 << 16;

/// A transfer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sdo {
    object: Object,
    complete: bool,
    writes: bool,
    data: [u8; KEPT],
    /// The size: of the data to write, or as the slave announced it.
    size: Option<usize>,
    /// Bytes transferred, and under way.
    passed: usize,
    going: usize,
    /// It continues in segments, and the toggle of the next one.
    segments: bool,
    toggle: bool,
}

/// Why a transfer failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Failure {
    /// The slave refused.
    Abort(AbortCode),
    /// Its answer cannot be used; a status of our own.
    Unusable(u32),
}

/// The effect of an answer on a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// None: it answers something else.
    Stray,
    /// The next request is due.
    Next,
    /// It is done.
    Done,
    /// It failed.
    Failed(Failure),
}

impl Sdo {
    /// Reads an object, or with `complete` all subindices of it.
    pub(super) fn read(object: Object, complete: bool) -> Sdo {
        Sdo {
            object,
            complete,
            writes: false,
            data: [0; KEPT],
            size: None,
            passed: 0,
            going: 0,
            segments: false,
            toggle: false,
        }
    }

    /// Writes the first `bytes` bytes of `value`, the lowest first: one at least.
    pub(super) fn write(object: Object, value: u64, bytes: usize) -> Sdo {
        let mut sdo = Sdo { writes: true, size: Some(bytes.clamp(1, 8)), ..Sdo::read(object, false) };
        sdo.data[..8].copy_from_slice(&value.to_le_bytes());
        sdo
    }

    /// Its object.
    pub(super) fn object(&self) -> Object {
        self.object
    }

    /// The slave is in the middle of it, and has to be informed if it is given up.
    pub(super) fn is_begun(&self) -> bool {
        self.segments
    }

    /// The number of bytes read, and those that are kept; the others are 0.
    pub(super) fn value(&self) -> (usize, &[u8; KEPT]) {
        (self.passed, &self.data)
    }

    /// The next request, for a message with `room`.
    pub(super) fn request(&mut self, room: usize) -> Request<'_> {
        let (object, complete, toggle) = (self.object, self.complete, self.toggle);
        if !self.writes {
            return match self.segments {
                true => Request::UploadSegment { toggle },
                false => Request::Upload { object, complete },
            };
        }
        let size = self.size.unwrap_or_default();
        let begin = &self.data;
        if !self.segments && size <= EXPEDITED_MAX {
            self.going = size;
            let [a, b, c, d, ..] = *begin;
            return Request::Download { object, value: [a, b, c, d], length: size as u8 };
        }
        let header = COE_HEADER + if self.segments { SEGMENT_HEADER } else { SIZE };
        self.going = (size - self.passed).min(room.saturating_sub(header));
        let end = self.passed + self.going;
        let data = begin.get(self.passed..end).unwrap_or_default();
        match self.segments {
            true => Request::DownloadSegment { toggle, last: end == size, data },
            false => Request::DownloadBegin { object, complete, size: size as u32, data },
        }
    }

    /// Takes the answer.
    pub(super) fn take(&mut self, response: &Response<'_>) -> Step {
        match *response {
            Response::Abort { object, code } if object == self.object || self.segments => {
                Step::Failed(Failure::Abort(code))
            }
            Response::Value { object, data } if self.is_first(object, false) => {
                self.put(data);
                Step::Done
            }
            Response::Begun { object, size, data } if self.is_first(object, false) => {
                self.size = size.map(|size| size as usize);
                let data = &data[..data.len().min(self.size.unwrap_or(usize::MAX))];
                self.put(data);
                self.segments = true;
                match self.size {
                    Some(size) if size <= self.passed => self.done(),
                    Some(size) if size > MOST => Step::Failed(Failure::Unusable(ENDLESS)),
                    _ => Step::Next,
                }
            }
            Response::Segment { toggle, last, data } if self.segments && !self.writes => {
                self.segment(toggle, last, data)
            }
            Response::Downloaded { object } if self.is_first(object, true) => {
                self.segments = true;
                self.gone()
            }
            Response::SegmentTaken { toggle } if self.segments && self.writes => {
                if toggle != self.toggle {
                    return Step::Failed(Failure::Unusable(TOGGLE));
                }
                self.toggle = !toggle;
                self.gone()
            }
            _ => Step::Stray,
        }
    }

    /// An answer to the first request, of this object.
    fn is_first(&self, object: Object, writes: bool) -> bool {
        !self.segments && self.writes == writes && self.object == object
    }

    fn segment(&mut self, toggle: bool, last: bool, data: &[u8]) -> Step {
        if toggle != self.toggle {
            return Step::Failed(Failure::Unusable(TOGGLE));
        }
        self.toggle = !toggle;
        self.put(data);
        let most = self.size.unwrap_or(MOST);
        match last {
            _ if self.passed > most => Step::Failed(Failure::Unusable(ENDLESS)),
            true if self.size.is_some_and(|size| self.passed < size) => {
                self.segments = false;
                Step::Failed(Failure::Unusable(TRUNCATED))
            }
            true => self.done(),
            // Empty ones could come for ever.
            false if data.is_empty() => Step::Failed(Failure::Unusable(ENDLESS)),
            false => Step::Next,
        }
    }

    /// The sent part has arrived.
    fn gone(&mut self) -> Step {
        self.passed += std::mem::take(&mut self.going);
        match self.size {
            Some(size) if self.passed < size => Step::Next,
            _ => self.done(),
        }
    }

    fn done(&mut self) -> Step {
        self.segments = false;
        Step::Done
    }

    /// Keeps as much as there is room for, and counts all.
    fn put(&mut self, data: &[u8]) {
        let room = self.data.get_mut(self.passed..).unwrap_or_default();
        room.iter_mut().zip(data).for_each(|(place, byte)| *place = *byte);
        self.passed = self.passed.saturating_add(data.len());
    }
}
