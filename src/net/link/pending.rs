//! Wake-ups of the link thread, with no system call more than it takes.
//!
//! Whoever posts something writes its queue first and sets this then. The thread clears it first and looks then: what
//! it does not see was posted after that, and sets it again.

use std::sync::atomic::Ordering;

use crate::sync::AtomicBool;

/// Whether something was posted since the last look.
#[derive(Debug)]
pub struct Pending(AtomicBool);

impl Pending {
    /// Nothing.
    pub fn new() -> Pending {
        Pending(AtomicBool::new(false))
    }

    /// Something was posted. True: nothing was pending, and the thread has to be woken.
    pub fn set(&self) -> bool {
        // Each swap reads what the one before it wrote, so that whoever clears it sees everything that was posted
        // behind any of them.
        !self.0.swap(true, Ordering::AcqRel)
    }

    /// Before a look: whether something is pending. A plain store would not see what was posted meanwhile.
    pub fn clear(&self) -> bool {
        self.0.swap(false, Ordering::AcqRel)
    }
}
