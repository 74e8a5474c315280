//! What the loop counts of one drive, exactly.

use crate::axis::MONITOR_CHANNELS;
use crate::bus::Counters;
use crate::{packed, parts};

/// The largest value seen, and its slot. All zero: none was seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Peak {
    /// ns.
    pub ns: u64,
    /// The slot.
    pub index: u64,
}

impl Peak {
    /// Takes one more value in; returns whether it is the largest.
    #[inline]
    pub fn see(&mut self, ns: u64, index: u64) -> bool {
        let largest = ns > self.ns;
        if largest {
            *self = Peak { ns, index };
        }
        largest
    }
}

/// The largest times of one drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Peaks {
    /// Of its round trips.
    pub rtt: Peak,
    /// Largest difference between the distance of two requests and that of their grid points.
    pub send_jitter: Peak,
    /// Age of its values when a window closed.
    pub age: Peak,
}

/// The largest times of one drive, ns, or their slots: the loop compares with the times in each cycle.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Largest {
    pub rtt: u64,
    pub send_jitter: u64,
    pub age: u64,
}

impl Largest {
    /// With their slots.
    pub fn peaks(&self, slots: &Largest) -> Peaks {
        let peak = |of: fn(&Largest) -> u64| Peak { ns: of(self), index: of(slots) };
        Peaks { rtt: peak(|of| of.rtt), send_jitter: peak(|of| of.send_jitter), age: peak(|of| of.age) }
    }
}

/// Takes one more time into the largest one and its slot.
#[inline]
pub(super) fn see(largest: &mut u64, slot: &mut u64, ns: u64, index: u64) {
    if ns > *largest {
        (*largest, *slot) = (ns, index);
    }
}

/// The range of a monitored variable: newest, smallest and largest value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// The newest value.
    pub value: f64,
    /// The smallest one.
    pub min: f64,
    /// The largest one.
    pub max: f64,
}

impl Extent {
    /// Takes one more value into `extent`; `None`: there was none yet.
    pub fn see(extent: &mut Option<Extent>, value: f64) {
        let Extent { min, max, .. } = extent.unwrap_or(Extent { value, min: value, max: value });
        *extent = Some(Extent { value, min: min.min(value), max: max.max(value) });
    }
}

/// The loop's counts of one drive, published in turns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriveNumbers {
    /// The exchanges.
    pub counters: Counters,
    /// Times that the link was lost.
    pub losses: u64,
    /// The largest times.
    pub peaks: Peaks,
    /// The monitored variables; `None` = not seen yet.
    pub monitor: [Option<Extent>; MONITOR_CHANNELS],
}

parts! {
    DriveNumbers { counters, losses, peaks, monitor }
    Counters { sent, unsent, answered, missed, late, duplicate, suspect, implausible, malformed, foreign, own }
    Peaks { rtt, send_jitter, age }
    Peak { ns, index }
    Extent { value, min, max }
}
packed!(DriveNumbers);
