//! The system's allocator, counting what watched threads ask of it.
//!
//! An allocator is the whole program's: whoever wants this one makes it that (`#[global_allocator]`).

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};

pub struct Counting;

static COUNT: AtomicU64 = AtomicU64::new(0);

thread_local! {
    static WATCHED: Cell<bool> = const { Cell::new(false) };
}

/// Watches the calling thread from here on, or no longer. Returns whether it did before.
pub fn watch(watched: bool) -> bool {
    WATCHED.replace(watched)
}

/// How often watched threads have allocated or freed so far.
pub fn count() -> u64 {
    COUNT.load(Ordering::Relaxed)
}

/// Watches the calling thread while `body` runs and returns how often it allocated or freed. No other may be watched.
pub fn allocations(body: impl FnOnce()) -> u64 {
    let before = count();
    watch(true);
    body();
    watch(false);
    count() - before
}

fn note() {
    // Gone at the end of a thread, when its other thread-locals are freed.
    if WATCHED.try_with(Cell::get).unwrap_or(false) {
        COUNT.fetch_add(1, Ordering::Relaxed);
    }
}

// SAFETY: everything is left to the system's allocator; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: the caller's promises are those of `System`.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        note();
        // SAFETY: as above.
        unsafe { System.dealloc(block, layout) }
    }
    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note();
        // SAFETY: as above.
        unsafe { System.realloc(block, layout, size) }
    }
}
