//! The frames of a segment, for `check`: how long they are, and how long they take.

use super::EthercatPlan;
use crate::image::{Frame, Image};
use crate::slot;
use crate::wire::frame::{DATAGRAM_HEADER, WORKING_COUNTER};

/// Their check sequence, and preamble and gap, bytes.
const AROUND: usize = 4 + 20;
/// A byte at 100 Mbit/s.
const BYTE_NS: u64 = 80;

impl EthercatPlan {
    /// Bytes of each frame that leaves in every cycle, without acyclic access; `None`: a slave fits into none.
    pub(super) fn frames(&self) -> Option<Vec<usize>> {
        let slaves = self.slaves();
        let clock = slaves.iter().any(|(_, slave)| slave.sync);
        let (image, _) = Image::new(&slaves, 0, [0; 6], clock, self.lrw)?;
        Some(image.frames().iter().map(|frame: &Frame| frame.bytes().len()).collect())
    }
}

/// The most that acyclic access adds to the first one.
pub(super) const ACYCLIC: usize = slot::ROOM + slot::DATAGRAMS * (DATAGRAM_HEADER + WORKING_COUNTER);

/// How long the wire is taken by frames of these bytes.
pub(super) fn wire_ns(frames: &[usize]) -> u64 {
    frames.iter().map(|bytes| (bytes + AROUND) as u64 * BYTE_NS).sum()
}
