//! What the kernel counted against a thread: page faults and context switches. Two snapshots and their difference
//! prove, or disprove, that the loop ran undisturbed. Knows nothing of cycles.

use nix::sys::resource::{Usage as Rusage, UsageWho, getrusage};

/// Counts since the thread began (`getrusage(RUSAGE_THREAD)`, getrusage(2)).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Usage {
    /// Page faults served without a disk: a first touch, a copy on write, a page moved by the kernel.
    pub minor_faults: u64,
    /// Page faults that waited for a disk.
    pub major_faults: u64,
    /// Times the thread gave up the processor itself: about once per sleep.
    pub voluntary_switches: u64,
    /// Times it was taken from the thread. Under SCHED_FIFO only a higher priority, or throttling, can do that.
    pub involuntary_switches: u64,
}

impl Usage {
    /// The counts of the calling thread. One system call, no allocation.
    pub fn of_thread() -> Usage {
        // Linux knows RUSAGE_THREAD since 2.6.26 and fails only on a bad pointer: no counts, then, rather than an
        // error.
        getrusage(UsageWho::RUSAGE_THREAD).map(Usage::from).unwrap_or_default()
    }

    /// The increase since `earlier`, a snapshot of the same thread.
    pub fn since(self, earlier: Usage) -> Usage {
        Usage {
            minor_faults: self.minor_faults.saturating_sub(earlier.minor_faults),
            major_faults: self.major_faults.saturating_sub(earlier.major_faults),
            voluntary_switches: self.voluntary_switches.saturating_sub(earlier.voluntary_switches),
            involuntary_switches: self.involuntary_switches.saturating_sub(earlier.involuntary_switches),
        }
    }

    /// Page faults of both kinds.
    pub fn page_faults(self) -> u64 {
        self.minor_faults + self.major_faults
    }
}

impl From<Rusage> for Usage {
    fn from(usage: Rusage) -> Usage {
        // `ru_*` are signed longs that only ever count up from 0; on a 32-bit system they wrap.
        Usage {
            minor_faults: usage.minor_page_faults() as u64,
            major_faults: usage.major_page_faults() as u64,
            voluntary_switches: usage.voluntary_context_switches() as u64,
            involuntary_switches: usage.involuntary_context_switches() as u64,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_first_touch_is_a_fault_and_a_sleep_is_a_switch() {
        let before = Usage::of_thread();
        // Fresh from the kernel: larger than any free block that the allocator may have kept.
        let mut memory = vec![0_u8; 64 << 20];
        memory.iter_mut().step_by(4096).for_each(|byte| *byte = std::hint::black_box(1));
        std::thread::sleep(Duration::from_millis(1));
        let used = Usage::of_thread().since(before);
        // Huge pages make one fault of 512.
        assert!(used.page_faults() >= 32, "{used:?}");
        assert!(used.voluntary_switches >= 1, "{used:?}");
    }

    #[test]
    fn differences_never_wrap() {
        let later =
            Usage { minor_faults: 3, major_faults: 1, voluntary_switches: 9, involuntary_switches: 2 };
        assert_eq!(later.since(Usage::default()), later);
        assert_eq!(Usage::default().since(later), Usage::default());
        assert_eq!(later.page_faults(), 4);
    }
}
