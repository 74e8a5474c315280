//! How a slice of a measurement runs.

/// How a slice runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Setting {
    /// The core.
    pub core: usize,
    /// SCHED_FIFO at this priority; `None` = an ordinary thread that runs promptly, as the loop has it without the
    /// right.
    pub fifo: Option<u8>,
    /// Wakes before each grid point by the guard of the contender.
    pub guarded: bool,
    /// All memory of the process is locked.
    pub locked: bool,
    /// Holds /dev/cpu_dma_latency at 0: no core sleeps deeper than it leaves at once.
    pub awake: bool,
}
