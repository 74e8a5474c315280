//! What the loop counts of one drive, exactly.

use crate::axis::MONITOR_CHANNELS;
use crate::axis::cell::{Packed, Words};
use crate::bus::{Counters, OWN_COUNTERS};

/// The largest value seen, and its slot. All zero: none was seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Peak {
    /// ns.
    pub ns: u64,
    /// The slot.
    pub index: u64,
}

impl Peak {
    /// Takes one more value in.
    pub fn see(&mut self, ns: u64, index: u64) {
        if ns > self.ns {
            *self = Peak { ns, index };
        }
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

/// What the loop counts of one drive, published in turns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriveNumbers {
    /// Its exchanges.
    pub counters: Counters,
    /// Times that the link was lost.
    pub losses: u64,
    /// Its largest times.
    pub peaks: Peaks,
    /// Its monitored variables; `None` = not seen yet.
    pub monitor: [Option<Extent>; MONITOR_CHANNELS],
}

/// Words of the counts and times of a drive. The protocol's own counts follow, one word that says which channels
/// are seen, and three of each channel.
const COUNTS: usize = 16;
const SEEN: usize = COUNTS + OWN_COUNTERS;

impl Packed for DriveNumbers {
    type Words = [u64; SEEN + 1 + 3 * MONITOR_CHANNELS];

    fn pack(&self) -> Self::Words {
        let (c, Peaks { rtt, send_jitter, age }) = (&self.counters, self.peaks);
        let mut words = Self::Words::ZERO;
        words[..COUNTS].copy_from_slice(&[
            c.sent,
            c.unsent,
            c.answered,
            c.missed,
            c.late,
            c.duplicate,
            c.suspect,
            c.malformed,
            c.foreign,
            self.losses,
            rtt.ns,
            rtt.index,
            send_jitter.ns,
            send_jitter.index,
            age.ns,
            age.index,
        ]);
        words[COUNTS..SEEN].copy_from_slice(&c.own);
        let (seen, extents) = words[SEEN..].split_at_mut(1);
        for (channel, extent) in self.monitor.iter().enumerate() {
            let Some(Extent { value, min, max }) = extent else { continue };
            seen[0] |= 1 << channel;
            extents[3 * channel..][..3].copy_from_slice(&[value, min, max].map(|value| value.to_bits()));
        }
        words
    }

    fn unpack(words: &Self::Words) -> DriveNumbers {
        let &[
            sent,
            unsent,
            answered,
            missed,
            late,
            duplicate,
            suspect,
            malformed,
            foreign,
            losses,
            ref rest @ ..,
        ] = words;
        let peak = |at: usize| Peak { ns: rest[at], index: rest[at + 1] };
        let (seen, extents) = (words[SEEN], &words[SEEN + 1..]);
        let extent = |channel: usize| {
            let [value, min, max] = std::array::from_fn(|at| f64::from_bits(extents[3 * channel + at]));
            (seen >> channel & 1 != 0).then_some(Extent { value, min, max })
        };
        DriveNumbers {
            counters: Counters {
                sent,
                unsent,
                answered,
                missed,
                late,
                duplicate,
                suspect,
                malformed,
                foreign,
                own: std::array::from_fn(|count| words[COUNTS + count]),
            },
            losses,
            peaks: Peaks { rtt: peak(0), send_jitter: peak(2), age: peak(4) },
            monitor: std::array::from_fn(extent),
        }
    }
}
