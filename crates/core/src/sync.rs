//! What threads share in the files that a model checker explores: `tests/loom` builds them with its own ones.

pub use std::sync::atomic::{AtomicBool, AtomicU64, fence};
pub use std::sync::{Mutex, MutexGuard};

pub use crossbeam::utils::Backoff;
pub use rtrb::{Consumer, Producer};
