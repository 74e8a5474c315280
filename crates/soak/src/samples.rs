//! Memory and descriptors of a process over its time.

use std::fs;

use serde::{Deserialize, Serialize};

/// The most samples of a process. When there are so many, every second one is dropped.
const MOST: usize = 512;

/// A sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Machine time since the process began, ns.
    pub at_ns: u64,
    /// Resident memory, kB.
    pub memory_kb: u64,
    /// Open descriptors.
    pub descriptors: u64,
}

impl Sample {
    /// This process now; what cannot be read is 0.
    pub fn now(at_ns: u64) -> Sample {
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let memory_kb = resident.and_then(|line| line.split_whitespace().next()?.parse().ok());
        // The one that lists them is among them.
        let descriptors = fs::read_dir("/proc/self/fd").map_or(0, |entries| entries.count() as u64);
        Sample { at_ns, memory_kb: memory_kb.unwrap_or(0), descriptors: descriptors.saturating_sub(1) }
    }
}

/// A process that ran the test.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Process {
    /// When it began and when its last checkpoint was, s since 1970.
    pub began_s: u64,
    /// See `began_s`.
    pub seen_s: u64,
    /// Machine time at its begin, ns, of all the processes before.
    pub from_ns: u64,
    /// The own machine time so far, ns.
    pub ran_ns: u64,
    /// The samples, rising.
    pub samples: Vec<Sample>,
    /// Between two samples that are kept, ns; 0: all of them are. Of no use to another process.
    #[serde(skip)]
    pub(super) spacing_ns: u64,
}

/// Growth of a process after its warm-up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Growth {
    /// MB.
    pub memory: f64,
    /// Descriptors.
    pub descriptors: f64,
}

impl Process {
    /// Keeps a sample. The samples stay evenly spread over the time of the process, and the newest is always kept.
    pub fn take(&mut self, sample: Sample) {
        // Samples are not taken to the nanosecond.
        let near_ns = self.spacing_ns - self.spacing_ns / 64;
        let is_near = |[before, newest]: &[Sample; 2]| newest.at_ns.saturating_sub(before.at_ns) < near_ns;
        if self.samples.last_chunk().is_some_and(is_near) {
            self.samples.pop();
        } else if self.samples.len() >= MOST {
            let mut place = 0;
            self.samples.retain(|_| {
                place += 1;
                place % 2 == 1
            });
            if let [first, between @ .., last] = self.samples.as_slice() {
                self.spacing_ns = last.at_ns.saturating_sub(first.at_ns) / (between.len() as u64 + 1);
            }
        }
        self.samples.push(sample);
    }

    /// How much larger it was in the last quarter after its warm-up than in the first quarter, each by its median: a
    /// peak is no growth. `None`: it did not run for so long.
    pub fn growth(&self, warm_up_ns: u64) -> Option<Growth> {
        let warm = || self.samples.iter().filter(|sample| sample.at_ns >= warm_up_ns);
        let (first, last) = (warm().next()?.at_ns, warm().next_back()?.at_ns);
        // Those of a damaged checkpoint may not rise.
        let quarter = last.checked_sub(first)? / 4;
        if warm().count() < 4 {
            return None;
        }
        // By time: the last sample may be close to the one before.
        let median = |from: u64, to: u64, of: fn(&Sample) -> u64| {
            let within = warm().filter(|sample| (from..=to).contains(&sample.at_ns));
            let mut values: Vec<u64> = within.map(of).collect();
            values.sort_unstable();
            values[values.len() / 2] as f64
        };
        let grown =
            |of: fn(&Sample) -> u64| median(last - quarter, last, of) - median(first, first + quarter, of);
        Some(Growth {
            memory: grown(|sample| sample.memory_kb) / 1000.0,
            descriptors: grown(|s| s.descriptors),
        })
    }

    /// Time of the clock between the last checkpoint of the process before and the begin of this one, s.
    pub fn gap_after(&self, before: &Process) -> u64 {
        self.began_s.saturating_sub(before.seen_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::time::S;

    fn days(days: u64, memory_kb: impl Fn(u64) -> u64) -> Process {
        let mut process = Process::default();
        for minute in 0..days * 1_440 {
            let (at_ns, descriptors) = (minute * 60 * S, 20);
            process.take(Sample { at_ns, memory_kb: memory_kb(minute), descriptors });
        }
        process
    }

    #[test]
    fn a_slow_leak_of_a_month_is_seen_whole() {
        let month = 30 * 1_440;
        let process = days(30, |minute| 20_000 + 70_000 * minute / month);
        // The medians of the quarters are three quarters of the time apart.
        let grown = process.growth(600 * S).unwrap().memory;
        assert!((51.5..52.6).contains(&grown), "{grown}");
        let samples = &process.samples;
        assert!((MOST / 2..=MOST).contains(&samples.len()), "{}", samples.len());
        assert_eq!(samples.last().unwrap().at_ns, (month - 1) * 60 * S, "the newest");
        let gaps = samples[..samples.len() - 1].windows(2).map(|pair| pair[1].at_ns - pair[0].at_ns);
        let (least, most) = (gaps.clone().min().unwrap(), gaps.max().unwrap());
        assert!(most < least * 5 / 4, "{least} {most}");
    }

    #[test]
    fn this_process_has_memory_and_descriptors() {
        let sample = Sample::now(7);
        assert!(sample.memory_kb > 1_000 && sample.descriptors >= 3, "{sample:?}");
    }
}
