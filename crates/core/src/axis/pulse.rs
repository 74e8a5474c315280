//! The application's sign of life.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crossbeam::utils::CachePadded;

use crate::rt::Regions;

/// A counter that the application increments and the loop watches. Clones are the same pulse; each machine has its
/// own.
#[derive(Clone, Debug, Default)]
pub struct Pulse(Arc<CachePadded<AtomicU64>>);

impl Pulse {
    /// The application is alive.
    pub fn beat(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// The number of beats so far.
    pub fn count(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }

    /// The memory that it points to, to be locked.
    #[doc(hidden)]
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.0);
    }

    /// Whether both are the pulse of one machine.
    pub fn is_same(&self, other: &Pulse) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}
