//! How often a master met a special property of a slave.

/// Counts since power-on: a test that relies on such a slave shows by them that it came to that.
#[derive(Clone, Copy, Debug, Default)]
pub struct Met {
    /// The SII was taken by force from the processor that had it.
    pub sii_forced: u32,
    /// Reads of the SII.
    pub sii_reads: u32,
    /// Looks at a busy SII.
    pub sii_busy: u32,
    /// Reads of the SII that returned another address.
    pub sii_slipped: u32,
    /// Commands of the SII that failed.
    pub sii_failed: u32,
    /// States that were entered after the SyncManagers were found to be those of the SII, byte by byte.
    pub exact_managers: u32,
    /// Answers that came late.
    pub late_answers: u32,
    /// Answers that did not come.
    pub lost_answers: u32,
    /// Requests to send the last message again that were acknowledged, and nothing else.
    pub unheeded_repeats: u32,
}
