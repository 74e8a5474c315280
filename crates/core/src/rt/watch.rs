//! What the kernel reports of another thread of this process, for a normal thread that watches the loop.
//!
//! Reads /proc, so that the watched thread pays nothing. Its times cost about a microsecond and are read for each
//! sample; the counts are in files that take the kernel some hundred times as long to write, and are read now and then.
//! Knows nothing of cycles.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use super::{MonotonicClock, host};
use crate::time::Time;

/// Totals since the thread began, at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadSample {
    /// The instant.
    pub at: Time,
    /// Time on a processor, ns. A kernel that knows its hypervisor leaves out stolen time.
    pub run_ns: u64,
    /// Time that it could have run and waited for a processor, ns.
    pub delay_ns: u64,
    /// The newest counts, from this sample or from an earlier one.
    pub counts: ThreadCounts,
}

/// The counts that are read less often than the times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadCounts {
    /// When they were read: what is counted later happened later.
    pub at: Time,
    /// Page faults, modulo 2^32.
    pub faults: u32,
    /// Involuntary context switches, modulo 2^32.
    pub switches: u32,
    /// Time that the hypervisor took from its core, ms since boot; in steps of a tick.
    pub steal_ms: u64,
}

/// A thread under watch.
#[derive(Debug)]
pub struct ThreadWatch {
    schedstat: File,
    stat: File,
    status: File,
    all: File,
    core: Option<usize>,
    /// For /proc/stat up to the line of that core; with many cores it is long.
    buffer: Vec<u8>,
    counts: ThreadCounts,
}

impl ThreadWatch {
    /// Watches thread `tid` of this process, on `core` if it is pinned.
    pub fn open(tid: libc::pid_t, core: Option<usize>) -> io::Result<ThreadWatch> {
        let of = |name: &str| File::open(format!("/proc/self/task/{tid}/{name}"));
        let label = core.map_or("cpu ".to_owned(), |core| format!("cpu{core} "));
        let now = std::fs::read_to_string("/proc/stat")?;
        let begin = now.find(&label).unwrap_or(0);
        // Its numbers grow, and so do those before it.
        let buffer = vec![0; 2 * begin + 1024];
        Ok(ThreadWatch {
            schedstat: of("schedstat")?,
            stat: of("stat")?,
            status: of("status")?,
            all: File::open("/proc/stat")?,
            core,
            buffer,
            counts: ThreadCounts::default(),
        })
    }

    /// The totals now; `None` once the thread has ended, or where the kernel keeps none. The counts are read anew if
    /// they are as old as `counts_every_ns`.
    pub fn sample(&mut self, counts_every_ns: u64) -> Option<ThreadSample> {
        let now = MonotonicClock::read();
        if self.counts.at == Time::default() || now.since(self.counts.at) >= counts_every_ns {
            self.read_counts()?;
        }
        let mut buffer = [0; 128];
        let (run_ns, delay_ns) = times(read(&self.schedstat, &mut buffer)?)?;
        Some(ThreadSample { at: MonotonicClock::read(), run_ns, delay_ns, counts: self.counts })
    }

    fn read_counts(&mut self) -> Option<()> {
        let mut buffer = [0; 4096];
        let faults = faults(read(&self.stat, &mut buffer)?)?;
        let switches = switches(read(&self.status, &mut buffer)?)?;
        let at = MonotonicClock::read();
        // Text after the last line break is cut off.
        let all = read(&self.all, &mut self.buffer).and_then(|stat| Some(stat.rsplit_once('\n')?.0));
        let steal_ms =
            all.and_then(|stat| host::steal_ms_of(stat, self.core)).unwrap_or(self.counts.steal_ms);
        self.counts = ThreadCounts { at, faults, switches, steal_ms };
        Some(())
    }
}

/// A file of /proc is generated anew whenever it is read from its begin.
fn read<'a>(file: &File, buffer: &'a mut [u8]) -> Option<&'a str> {
    let length = file.read_at(buffer, 0).ok()?;
    // Cut off in the middle of a character: none of these files has multi-byte ones.
    std::str::from_utf8(&buffer[..length]).ok()
}

/// `run delay slices` (Documentation/scheduler/sched-stats.rst).
fn times(schedstat: &str) -> Option<(u64, u64)> {
    let mut fields = schedstat.split_whitespace().map(str::parse);
    Some((fields.next()?.ok()?, fields.next()?.ok()?))
}

/// `minflt` and `majflt`, the tenth and twelfth field (proc_pid_stat(5)), counted from behind the name, which may hold
/// anything.
fn faults(stat: &str) -> Option<u32> {
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace().skip(7);
    let minor: u64 = fields.next()?.parse().ok()?;
    let major: u64 = fields.nth(1)?.parse().ok()?;
    Some(minor.wrapping_add(major) as u32)
}

/// `nonvoluntary_ctxt_switches` (proc_pid_status(5)).
fn switches(status: &str) -> Option<u32> {
    let line = status.lines().find_map(|line| line.strip_prefix("nonvoluntary_ctxt_switches:"))?;
    Some(line.trim().parse::<u64>().ok()? as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_the_kernel_writes() {
        assert_eq!(times("346033 39676 3\n"), Some((346_033, 39_676)));
        assert_eq!(times(""), None);
        let stat = "7 (a) b (c) S 1 7 7 0 -1 4194304 120 0 3 0 1 2 0 0 20 0 1 0 99";
        assert_eq!(faults(stat), Some(123));
        assert_eq!(faults("7 (x) S 1"), None);
        let status = "Name:\tx\nvoluntary_ctxt_switches:\t5\nnonvoluntary_ctxt_switches:\t7\n";
        assert_eq!(switches(status), Some(7));
        assert_eq!(switches("Name:\tx\n"), None);
    }

    #[test]
    fn sees_another_thread_work_and_fault() {
        let (report, reported) = crossbeam_channel::unbounded();
        let (go, wait) = crossbeam_channel::unbounded::<()>();
        let thread = std::thread::spawn(move || {
            report.send(nix::unistd::gettid().as_raw()).unwrap();
            wait.recv().unwrap();
            let mut memory = vec![0_u8; 64 << 20];
            memory.iter_mut().step_by(4096).for_each(|byte| *byte = std::hint::black_box(1));
            report.send(0).unwrap();
            wait.recv().unwrap();
        });
        let mut watch = ThreadWatch::open(reported.recv().unwrap(), None).unwrap();
        let before = watch.sample(0).unwrap();
        go.send(()).unwrap();
        reported.recv().unwrap();
        // Its times are new, its counts are not old enough.
        let between = watch.sample(u64::MAX).unwrap();
        assert!(between.at > before.at && between.run_ns > before.run_ns, "{before:?} {between:?}");
        assert_eq!(between.counts, before.counts);
        let after = watch.sample(0).unwrap();
        assert!(after.counts.at > before.counts.at, "{before:?} {after:?}");
        assert!(after.counts.faults.wrapping_sub(before.counts.faults) >= 32, "{before:?} {after:?}");
        go.send(()).unwrap();
        thread.join().unwrap();
        // The kernel wakes who joins a thread before it removes the thread's files.
        while watch.sample(u64::MAX).is_some() {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }
}
