//! What callgrind collects: what runs inside of [`counted`], and not inside of [`paused`], which is where the carriers
//! in memory and the simulated drives are. So neither the drives nor the way into operation is counted, and nothing has
//! to be subtracted.

use std::hint::black_box;
use std::sync::atomic::{AtomicU8, Ordering};

/// What callgrind does now: it toggles, so that to pause what it does not collect would begin it.
static STATE: AtomicU8 = AtomicU8::new(OFF);
const OFF: u8 = 0;
const COUNTS: u8 = 1;
const PAUSES: u8 = 2;

/// Runs what is counted.
pub fn counted<R>(body: impl FnOnce() -> R) -> R {
    STATE.store(COUNTS, Ordering::Relaxed);
    let result = callgrind_counts(body);
    STATE.store(OFF, Ordering::Relaxed);
    result
}

/// Runs what is not: a carrier in memory, a simulated drive.
#[inline]
pub fn paused<R>(body: impl FnOnce() -> R) -> R {
    if STATE.load(Ordering::Relaxed) != COUNTS {
        return body();
    }
    STATE.store(PAUSES, Ordering::Relaxed);
    let result = callgrind_pauses(body);
    STATE.store(COUNTS, Ordering::Relaxed);
    result
}

/// Runs what is counted although a carrier that is not calls it.
#[inline]
pub fn resumed<R>(body: impl FnOnce() -> R) -> R {
    if STATE.load(Ordering::Relaxed) != PAUSES {
        return body();
    }
    STATE.store(COUNTS, Ordering::Relaxed);
    let result = callgrind_counts_again(body);
    STATE.store(PAUSES, Ordering::Relaxed);
    result
}

// Callgrind toggles where these begin and end. It knows them by their names, so they are never inlined. The last one is
// there because it does not toggle where a function calls itself.

#[inline(never)]
fn callgrind_counts<R>(body: impl FnOnce() -> R) -> R {
    black_box(body())
}

#[inline(never)]
fn callgrind_pauses<R>(body: impl FnOnce() -> R) -> R {
    black_box(body())
}

#[inline(never)]
fn callgrind_counts_again<R>(body: impl FnOnce() -> R) -> R {
    black_box(body())
}
