//! A SyncManager: access to its buffer, and when the buffer is complete (ETG.1000.4, 6.7).

use std::ops::Range;

use super::codec::registers::{AlState, SyncManager};

/// One SyncManager.
#[derive(Clone, Debug, Default)]
pub(super) struct Manager {
    pub(super) setting: SyncManager,
    status: u8,
    /// The slave's side of the repeat bit.
    repeated: bool,
    /// The state of the slave: below the one that needs the buffer it is locked.
    state: AlState,
    /// The last completely written outputs.
    pub(super) taken: Vec<u8>,
}

impl Manager {
    /// Takes over its registers. Its content is lost once it was off.
    pub(super) fn set(&mut self, setting: SyncManager) {
        let is_same = SyncManager { activate: self.setting.activate, ..setting } == self.setting;
        self.setting = setting;
        if !is_same || setting.activate & SyncManager::ON == 0 {
            self.clear();
        }
    }

    fn clear(&mut self) {
        self.status = 0;
        self.taken.clear();
    }

    /// The slave is in this state now.
    pub(super) fn enter(&mut self, state: AlState) {
        self.state = state;
        if self.is_locked() {
            self.clear();
        }
    }

    fn is_locked(&self) -> bool {
        self.state < if self.setting.is_mailbox() { AlState::PreOp } else { AlState::SafeOp }
    }

    /// Status and the slave's control, as they stand in the registers.
    pub(super) fn registers(&self) -> (u8, u8) {
        (
            self.status,
            u8::from(self.is_on() && self.is_locked()) | if self.repeated { SyncManager::REPEAT } else { 0 },
        )
    }

    /// The master switched it on.
    pub(super) fn is_on(&self) -> bool {
        self.setting.activate & SyncManager::ON != 0 && self.setting.length > 0
    }

    /// The buffer in memory; empty if the SyncManager is off.
    pub(super) fn area(&self) -> Range<usize> {
        let start = usize::from(self.setting.start);
        start..start + if self.is_on() { usize::from(self.setting.length) } else { 0 }
    }

    /// The memory that is occupied: process data has three buffers.
    pub(super) fn footprint(&self) -> Range<usize> {
        let area = self.area();
        let copies = if self.setting.is_mailbox() { 1 } else { 3 };
        area.start..area.start + copies * area.len()
    }

    /// A mailbox for this direction that is on.
    pub(super) fn is_mailbox(&self, output: bool) -> bool {
        self.is_on() && self.setting.is_mailbox() && self.setting.is_output() == output
    }

    /// Process data of this direction, on.
    pub(super) fn is_process(&self, output: bool) -> bool {
        self.is_on() && !self.setting.is_mailbox() && self.setting.is_output() == output
    }

    /// The master may read its buffer.
    pub(super) fn may_read(&self) -> bool {
        !self.is_locked() && !self.setting.is_output() && (!self.setting.is_mailbox() || self.is_full())
    }

    /// The master may write its buffer.
    pub(super) fn may_write(&self) -> bool {
        !self.is_locked() && self.setting.is_output() && !(self.setting.is_mailbox() && self.is_full())
    }

    /// The mailbox holds a message.
    pub(super) fn is_full(&self) -> bool {
        self.status & SyncManager::FULL != 0
    }

    /// The mailbox was written by the master, or read.
    pub(super) fn event(&self) -> bool {
        self.status & if self.setting.is_output() { SyncManager::WRITTEN } else { SyncManager::READ } != 0
    }

    /// The master has read this range of the memory.
    pub(super) fn has_read(&mut self, range: &Range<usize>) {
        let area = self.area();
        if area.is_empty() || !self.may_read() {
            return;
        }
        if range.contains(&(area.end - 1)) {
            self.status = if self.setting.is_mailbox() {
                SyncManager::READ
            } else {
                self.status & !SyncManager::WRITTEN | SyncManager::READ
            };
        }
    }

    /// The master has written this range of the memory; whether that completes the buffer.
    pub(super) fn has_written(&mut self, range: &Range<usize>, memory: &[u8]) -> bool {
        let area = self.area();
        if area.is_empty() || !self.may_write() || !range.contains(&(area.end - 1)) {
            return false;
        }
        if self.setting.is_mailbox() {
            self.status = SyncManager::WRITTEN | SyncManager::FULL;
        } else {
            self.status = self.status & !SyncManager::READ | SyncManager::WRITTEN;
            self.taken.clear();
            self.taken.extend_from_slice(memory.get(area).unwrap_or_default());
        }
        true
    }

    /// The slave has taken the message.
    pub(super) fn take(&mut self) {
        self.status = SyncManager::READ;
    }

    /// The slave has put a message, or inputs, there.
    pub(super) fn put(&mut self) {
        let full = if self.setting.is_mailbox() { SyncManager::FULL } else { 0 };
        self.status = SyncManager::WRITTEN | full;
    }

    /// The master requests the last message again; returned once.
    pub(super) fn takes_repeat(&mut self) -> bool {
        let requested = self.setting.activate & SyncManager::REPEAT != 0;
        std::mem::replace(&mut self.repeated, requested) != requested
    }
}
