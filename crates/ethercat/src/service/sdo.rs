//! One SDO: reading or writing an object, message by message (ETG.1000.6, 5.6.2; CiA 301).
//!
//! Knows neither the mailbox nor the time. Every step brings it closer to its end, or ends it.

use super::super::object::long::MOST as MOST_BYTES;
use super::super::object::{ENDLESS, TOGGLE, TRUNCATED};
use super::super::wire::mailbox::COE_HEADER;
use super::super::wire::sdo::{AbortCode, EXPEDITED_MAX, Object, Request, Response, SEGMENT_HEADER, SIZE};
use fieldbeat_core::axis::acyclic::CallError;

/// The bytes of an object that are kept; the rest is read and counted. The most that are written.
pub const KEPT: usize = MOST_BYTES;
/// The largest object, bytes; a longer one counts as endless.
const MOST: usize = 1 << 16;

/// A transfer.
#[derive(Clone, Copy, Debug)]
pub struct Sdo {
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
pub enum Failure {
    /// The slave refused.
    Abort(AbortCode),
    /// The answer cannot be used, or the slave does not empty its mailbox: one of the statuses of the master.
    Unusable(u32),
    /// It was not carried on, since the slave did not answer, or the mailbox was closed.
    GivenUp(CallError),
}

/// How a transfer ends.
pub type End = Result<(), Failure>;

/// The answer cannot be used, with this status of the master.
pub(super) fn unusable(status: u32) -> Option<End> {
    Some(Err(Failure::Unusable(status)))
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

    /// Writes these bytes, at most [`KEPT`]; one at least.
    pub(super) fn write(object: Object, bytes: &[u8]) -> Sdo {
        let size = bytes.len().clamp(1, KEPT);
        let mut sdo = Sdo { writes: true, size: Some(size), ..Sdo::read(object, false) };
        sdo.data.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
        sdo
    }

    /// It writes more than an expedited message holds.
    pub(super) fn is_long_write(&self) -> bool {
        self.writes && self.size.is_some_and(|size| size > EXPEDITED_MAX)
    }

    /// The object.
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

    /// It writes.
    pub(super) fn writes(&self) -> bool {
        self.writes
    }

    /// It begins anew.
    pub(super) fn restart(&mut self) {
        (self.passed, self.going, self.segments, self.toggle) = (0, 0, false, false);
        if !self.writes {
            self.size = None;
        }
    }

    /// Whether an answer is one to the present request: by its command, and by the object, where it names one.
    pub(super) fn is_answered_by(&self, response: &Response<'_>) -> bool {
        let first =
            |object: Object, writes: bool| !self.segments && self.writes == writes && self.object == object;
        match *response {
            Response::Abort { object, .. } => object == self.object,
            Response::Value { object, .. } | Response::Begun { object, .. } => first(object, false),
            Response::Downloaded { object } => first(object, true),
            Response::Segment { .. } => self.segments && !self.writes,
            Response::SegmentTaken { .. } => self.segments && self.writes,
        }
    }

    /// Takes an answer to the present request. `None`: the next request is due.
    pub(super) fn take(&mut self, response: &Response<'_>) -> Option<End> {
        match *response {
            Response::Abort { code, .. } => Some(Err(Failure::Abort(code))),
            Response::Value { data, .. } => {
                self.put(data);
                Some(Ok(()))
            }
            Response::Begun { size, data, .. } => {
                self.size = size.map(|size| size as usize);
                let data = &data[..data.len().min(self.size.unwrap_or(usize::MAX))];
                self.put(data);
                self.segments = true;
                match self.size {
                    Some(size) if size <= self.passed => self.done(),
                    Some(size) if size > MOST => unusable(ENDLESS),
                    _ => None,
                }
            }
            Response::Segment { toggle, last, data } => self.segment(toggle, last, data),
            Response::Downloaded { .. } => {
                self.segments = true;
                self.gone()
            }
            Response::SegmentTaken { toggle } if toggle != self.toggle => unusable(TOGGLE),
            Response::SegmentTaken { toggle } => {
                self.toggle = !toggle;
                self.gone()
            }
        }
    }

    fn segment(&mut self, toggle: bool, last: bool, data: &[u8]) -> Option<End> {
        if toggle != self.toggle {
            return unusable(TOGGLE);
        }
        self.toggle = !toggle;
        self.put(data);
        let most = self.size.unwrap_or(MOST);
        match last {
            _ if self.passed > most => unusable(ENDLESS),
            true if self.size.is_some_and(|size| self.passed < size) => {
                self.segments = false;
                unusable(TRUNCATED)
            }
            true => self.done(),
            // Empty ones could come for ever.
            false if data.is_empty() => unusable(ENDLESS),
            false => None,
        }
    }

    /// The sent part has arrived.
    fn gone(&mut self) -> Option<End> {
        self.passed += std::mem::take(&mut self.going);
        match self.size {
            Some(size) if self.passed < size => None,
            _ => self.done(),
        }
    }

    fn done(&mut self) -> Option<End> {
        self.segments = false;
        Some(Ok(()))
    }

    /// Keeps as much as there is room for, and counts all.
    fn put(&mut self, data: &[u8]) {
        let room = self.data.get_mut(self.passed..).unwrap_or_default();
        room.iter_mut().zip(data).for_each(|(place, byte)| *place = *byte);
        self.passed = self.passed.saturating_add(data.len());
    }
}
