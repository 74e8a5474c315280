//! Bytes that go over the real-time-config channel four at a time.

use std::sync::Arc;

/// A block under way to the drive.
#[derive(Debug)]
pub(super) struct Incoming {
    /// Of the curve or table entry.
    pub id: u16,
    bytes: Vec<u8>,
    size: usize,
}

impl Incoming {
    /// `size` bytes, a multiple of 4.
    pub(super) fn new(id: u16, size: usize) -> Incoming {
        Incoming { id, bytes: Vec::with_capacity(size), size }
    }

    /// How many bytes have come.
    pub(super) fn received(&self) -> usize {
        self.bytes.len()
    }

    /// Takes four more. `None` while some are missing, otherwise all of them.
    pub(super) fn put(&mut self, block: [u8; 4]) -> Option<&[u8]> {
        if self.bytes.len() < self.size {
            self.bytes.extend(block);
        }
        (self.bytes.len() >= self.size).then_some(&*self.bytes)
    }
}

/// A block under way to the master.
#[derive(Debug)]
pub(super) struct Outgoing {
    /// Of the curve or table entry.
    pub id: u16,
    bytes: Arc<[u8]>,
    sent: usize,
}

impl Outgoing {
    /// These bytes, a multiple of 4.
    pub(super) fn new(id: u16, bytes: Arc<[u8]>) -> Outgoing {
        Outgoing { id, bytes, sent: 0 }
    }

    /// How many are sent.
    pub(super) fn sent(&self) -> usize {
        self.sent
    }

    /// The next four, and whether they are the last ones; `None` after the last ones.
    pub(super) fn take(&mut self) -> Option<([u8; 4], bool)> {
        let block = self.bytes.get(self.sent..)?.first_chunk().copied()?;
        self.sent += block.len();
        Some((block, self.sent == self.bytes.len()))
    }
}
