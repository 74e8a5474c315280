//! What the loop counts of itself, exactly.

use crate::axis::Feedback;
use crate::axis::cell::Packed;
use crate::bus::{Counters, Strangers};

/// The loop in numbers, published every cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Slots that the grid has laid out so far, by its instants.
    pub planned: u64,
    /// Cycles executed, counted when their requests were sent.
    pub executed: u64,
    /// Slots passed over, counted when that was noticed.
    pub skipped: u64,
    /// Times that the work of a cycle passed the next grid point, or the loop woke too late to begin.
    pub overruns: u64,
    /// The longest row of skipped slots.
    pub longest_skip: u64,
    /// Latest begin of a cycle after its grid point, ns, skipped slots included.
    pub wake_max_ns: u64,
    /// In which slot that was.
    pub wake_max_index: u64,
    /// Axes in operation now.
    pub operational: u32,
    /// Axes online now.
    pub online: u32,
    /// Exchanges missed by all drives.
    pub missed: u64,
    /// Records that the telemetry ring had no room for.
    pub lost_records: u64,
    /// Events and samples that the application's queues had no room for.
    pub lost_events: u64,
}

impl Packed for Status {
    type Words = [u64; 11];

    fn pack(&self) -> [u64; 11] {
        [
            self.planned,
            self.executed,
            self.skipped,
            self.overruns,
            self.longest_skip,
            self.wake_max_ns,
            self.wake_max_index,
            u64::from(self.operational) | u64::from(self.online) << 32,
            self.missed,
            self.lost_records,
            self.lost_events,
        ]
    }

    fn unpack(words: &[u64; 11]) -> Status {
        Status {
            planned: words[0],
            executed: words[1],
            skipped: words[2],
            overruns: words[3],
            longest_skip: words[4],
            wake_max_ns: words[5],
            wake_max_index: words[6],
            operational: words[7] as u32,
            online: (words[7] >> 32) as u32,
            missed: words[8],
            lost_records: words[9],
            lost_events: words[10],
        }
    }
}

/// One drive at the end of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveEnd {
    /// Its axis' name.
    pub name: String,
    /// Its protocol's name.
    pub protocol: &'static str,
    /// The last feedback.
    pub feedback: Feedback,
    /// What was sent and what came of it.
    pub counters: Counters,
    /// Times that the link was lost.
    pub losses: u64,
    /// The largest round trip: its slot, and ns.
    pub rtt_max: Option<(u64, u32)>,
}

/// The end of a run: exact, whatever the rings lost.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunEnd {
    /// The loop.
    pub status: Status,
    /// The drives, in the order of the plan.
    pub drives: Vec<DriveEnd>,
    /// The buses: name, and what belonged to none of their drives.
    pub buses: Vec<(String, Strangers)>,
    /// Page faults and involuntary switches of the loop's thread while it ran; `None` in virtual time.
    pub page_faults: Option<u64>,
    /// See `page_faults`.
    pub involuntary_switches: Option<u64>,
}
