//! What threads share in the files that a model checker explores: `tests/loom` builds them with its own ones.

pub(crate) use std::sync::atomic::{AtomicBool, AtomicU64, fence};
pub(crate) use std::sync::{Mutex, MutexGuard};

pub(crate) use crossbeam::utils::Backoff;
pub(crate) use rtrb::{Consumer, Producer};
