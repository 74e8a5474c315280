//! Accesses of a master that real hardware tolerates badly, or not at all.

use super::*;

/// How often a master did what it should not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Misuse {
    /// Writes to the size of the receive FIFO (0102h): the least one is for clocks of 25 ppm only.
    pub fifo_sizes: u32,
    /// Errors acknowledged where none was shown: a slave without a processor shows one from then on.
    pub needless_acknowledges: u32,
    /// Changes of a SyncManager that is on: they have no effect.
    pub locked_managers: u32,
    /// Memory from 1000h on that was written by its address in INIT.
    pub early_writes: u32,
}

impl Chip {
    /// Counts what is wrong with a write.
    pub(super) fn count_misuse(&mut self, at: u16, data: &[u8]) {
        let range = usize::from(at)..usize::from(at) + data.len();
        let byte = |at: usize| range.contains(&at).then(|| data[at - range.start]);
        let status = self.word(address::AL_STATUS);
        if byte(address::FIFO_SIZE.into()).is_some() {
            self.misuse.fifo_sizes += 1;
        }
        let acknowledges =
            byte(address::AL_CONTROL.into()).is_some_and(|low| u16::from(low) & al::ERROR != 0);
        if acknowledges && status & al::ERROR == 0 {
            self.misuse.needless_acknowledges += 1;
        }
        if range.start >= PROCESS && AlState::of(status) == Some(AlState::Init) {
            self.misuse.early_writes += 1;
        }
        let changes =
            |at: usize| is_locked(at, &self.memory) && byte(at).is_some_and(|new| new != self.memory[at]);
        if is_configuration(data) && (0x0800..0x0900).any(changes) {
            self.misuse.locked_managers += 1;
        }
    }
}

/// Zeros switch SyncManagers off, which is how masters clear them.
fn is_configuration(data: &[u8]) -> bool {
    data.iter().any(|byte| *byte != 0)
}

/// Whether it is start, length or control of a SyncManager that is on (ET1100 data sheet, section II, 0800h).
pub(super) fn is_locked(at: usize, memory: &[u8]) -> bool {
    let (manager, offset) = (at & !(SyncManager::SIZE - 1), at % SyncManager::SIZE);
    (0x0800..0x0900).contains(&at) && offset < 5 && memory[manager + 6] & 1 != 0
}
