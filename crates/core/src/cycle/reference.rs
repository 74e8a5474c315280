//! The bus whose clock leads the grid: its phase error is read once per executed cycle, and sets the next slot.

use super::phase_lock::PhaseLock;
use super::record::ReferenceRecord;
use super::status::ReferenceStatus;
use crate::time::US;

/// The grid is locked when so many errors in a row were within a step's bound, a hundredth of the period ...
const SETTLED: u32 = 50;
/// ... or within this, if that is more, ns: the stamps of an ordinary network card are no better.
const LEAST_WITHIN_NS: u64 = 5 * US;
/// The lock is lost when this many times that bound ...
const LOST_TIMES: u64 = 4;
/// ... was passed so many times in a row: one wrong stamp is no lost lock ...
const ASTRAY: u32 = 3;
/// ... or when so many executed cycles in a row reported nothing.
const SILENT: u32 = 100;

/// The clock that leads the grid.
#[derive(Debug, Default)]
pub struct Reference {
    bus: usize,
    lock: PhaseLock,
    half_ns: i64,
    within_ns: u64,
    /// Errors within the bound, in a row.
    settled: u32,
    /// Errors far beyond it, in a row.
    astray: u32,
    /// Executed cycles without an error, in a row.
    silent: u32,
    was_locked: bool,
    status: ReferenceStatus,
}

impl Reference {
    /// The clock of the bus at this index leads a grid of this period.
    pub fn new(bus: usize, period_ns: u64) -> Reference {
        Reference {
            bus,
            lock: PhaseLock::new(period_ns),
            half_ns: (period_ns / 2) as i64,
            within_ns: (period_ns / 100).max(LEAST_WITHIN_NS),
            ..Reference::default()
        }
    }

    /// The index of its bus.
    pub fn bus(&self) -> usize {
        self.bus
    }

    /// The counts.
    pub fn status(&self) -> ReferenceStatus {
        self.status
    }

    /// The error of executed cycle `index`, if it is known. The step of the next slot is in the record.
    pub fn take(&mut self, index: u64, error_ns: Option<i64>) -> ReferenceRecord {
        // No bus reports more; the record has no room for it.
        let error_ns = error_ns.map(|error| error.clamp(-self.half_ns, self.half_ns));
        let step_ns = match error_ns {
            Some(error) => self.sample(index, error),
            None => self.pass(),
        };
        let status = &mut self.status;
        status.step_ns = step_ns;
        status.step_max.see(step_ns.unsigned_abs(), index);
        ReferenceRecord {
            index,
            error_ns: error_ns.map(|error| error as i32),
            step_ns: step_ns as i32,
            locked: status.locked,
            counts: self.was_locked,
        }
    }

    fn sample(&mut self, index: u64, error_ns: i64) -> i64 {
        let off_ns = error_ns.unsigned_abs();
        let in_a_row = |count: u32, holds: bool| if holds { count.saturating_add(1) } else { 0 };
        self.silent = 0;
        self.settled = in_a_row(self.settled, off_ns <= self.within_ns);
        self.astray = in_a_row(self.astray, off_ns > LOST_TIMES * self.within_ns);
        if self.settled >= SETTLED {
            (self.status.locked, self.was_locked) = (true, true);
        } else if self.astray >= ASTRAY {
            self.lose();
        }
        self.status.samples += 1;
        self.status.error_ns = error_ns;
        if self.was_locked {
            self.status.error_max.see(off_ns, index);
        }
        self.lock.step(error_ns)
    }

    fn pass(&mut self) -> i64 {
        self.status.silent += 1;
        self.silent = self.silent.saturating_add(1);
        if self.silent >= SILENT {
            self.settled = 0;
            self.lose();
        }
        0
    }

    fn lose(&mut self) {
        self.status.losses += u64::from(self.status.locked);
        self.status.locked = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::MS;

    fn locked() -> Reference {
        let mut reference = Reference::new(0, MS);
        for index in 0..60 {
            reference.take(index, Some(100));
        }
        assert!(reference.status().locked);
        reference
    }

    /// It was lost, and is locked by so many errors in a row as at first.
    fn relocks(reference: &mut Reference) {
        assert!((0..49).all(|_| !reference.take(0, Some(0)).locked));
        assert!(reference.take(0, Some(0)).locked);
        assert_eq!(reference.status().losses, 1);
    }

    #[test]
    fn reference_locks_by_errors_within_the_bound_in_a_row() {
        let mut reference = Reference::new(0, MS);
        let mut take = |error| reference.take(0, error).locked;
        assert!((0..49).all(|_| !take(Some(-10_000))));
        // One just outside begins anew, a silent cycle does not.
        assert!(!take(Some(10_001)));
        assert!((0..49).all(|_| !take(Some(10_000)) && !take(None)));
        assert!(take(Some(10_000)));
        let status = reference.status();
        assert_eq!((status.samples, status.silent, status.losses), (100, 49, 0));
        assert_eq!(status.error_max.ns, 10_000, "errors before the lock are not in it");
    }

    #[test]
    fn reference_is_lost_by_errors_far_outside_in_a_row_and_not_by_one_or_by_silence() {
        let mut reference = locked();
        for (index, error) in
            [40_001, -40_001, 40_000, 40_001, 12_000, 40_001, 40_001].into_iter().enumerate()
        {
            assert!(reference.take(100 + index as u64, Some(error)).locked);
        }
        assert!(!reference.take(107, Some(-400_000)).locked);
        // The error that lost the lock counts, and so do those until it is locked again.
        assert!(reference.take(108, Some(499_000)).counts);
        let status = reference.status();
        assert_eq!((status.losses, status.error_max.ns, status.error_max.index), (1, 499_000, 108));
        relocks(&mut reference);
        // Or by silence.
        let mut reference = locked();
        assert!((0..99).all(|index| reference.take(index, None).locked));
        assert!(!reference.take(99, None).locked);
        assert!((0..99).all(|index| !reference.take(index, None).locked));
        relocks(&mut reference);
    }

    #[test]
    fn the_largest_error_and_step_say_when_and_a_silent_cycle_steps_nothing() {
        let mut reference = Reference::new(0, MS);
        assert_eq!(reference.take(0, None).step_ns, 0);
        let record = reference.take(1, Some(i64::MIN));
        assert_eq!((record.error_ns, record.step_ns, record.counts), (Some(-500_000), 10_000, false));
        assert_eq!(reference.take(2, Some(500_000)).step_ns, -10_000);
        assert_eq!(reference.take(3, None).step_ns, 0);
        let status = reference.status();
        assert_eq!((status.step_max.ns, status.step_max.index, status.step_ns), (10_000, 1, 0));
        assert_eq!((status.error_ns, status.error_max.ns), (500_000, 0));
    }
}
