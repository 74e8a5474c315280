//! Whole Ethernet frames on the real-time thread: the contract of a carrier below IP.

use std::fmt::Debug;
use std::os::fd::{BorrowedFd, RawFd};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use crate::rt::Regions;
use crate::time::Time;

/// The address of every carrier that is not a network card: without the bit that the first slave of an EtherCAT
/// segment sets.
pub const MAC: [u8; 6] = [0x10; 6];

/// From 1970-01-01 to 2000-01-01.
const EPOCH: Duration = Duration::from_secs(946_684_800);

/// The date of this computer's clock.
pub(super) fn today_ns() -> Option<u64> {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).ok()?.checked_sub(EPOCH)?;
    u64::try_from(since.as_nanos()).ok()
}

/// A carrier of Ethernet frames on one interface: never waits, never allocates.
pub trait Frames: Send {
    /// The descriptor that becomes readable when a frame arrives; `None` for a carrier without one.
    fn fd(&self) -> Option<RawFd>;

    /// Hands a frame to the wire; returns when that began. An error: it was not sent.
    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent>;

    /// Takes in one frame: its arrival time and its length in bytes; `None`: there is none. A frame longer than
    /// `room` is cut off, and its length shows it.
    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)>;

    /// The present time, by the clock of its stamps.
    fn now(&mut self) -> Time;

    /// The present date: ns since 2000-01-01, the epoch of distributed clocks. It is read once, outside of the cycle.
    /// `None`: there is none, or it is before that.
    fn today_ns(&self) -> Option<u64> {
        None
    }

    /// The Ethernet address of the interface.
    fn mac(&self) -> [u8; 6];

    /// Errors of the interface while frames were taken in.
    fn errors(&self) -> u64 {
        0
    }

    /// The counter of dropped incoming frames, for normal threads; `None`: the carrier never drops frames silently.
    fn dropped(&self) -> Option<Arc<dyn Dropped>> {
        None
    }

    /// Adds the memory that it touches on the real-time thread, to be locked.
    fn memory(&self, regions: &mut Regions);

    /// Waits until a frame arrives, or for so long at most. For normal threads. A carrier without a descriptor has
    /// nothing to wait for.
    fn wait(&self, most_ms: u8) {
        let Some(fd) = self.fd() else { return };
        // SAFETY: the carrier holds it, and is borrowed here.
        let fd = unsafe { BorrowedFd::borrow_raw(fd) };
        // A signal wakes it early, too: the caller decides whether to go on.
        let _ = poll(&mut [PollFd::new(fd, PollFlags::POLLIN)], PollTimeout::from(most_ms));
    }
}

/// Incoming frames that a carrier dropped because they were not taken in soon enough. For normal threads: reading
/// it may be a system call.
pub trait Dropped: Debug + Send + Sync {
    /// All frames since the beginning.
    fn count(&self) -> u64;
}

/// Why a frame was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unsent {
    /// The interface is down or gone, or has no cable.
    Down,
    /// The kernel has no room for it.
    Full,
    /// Another error of the operating system.
    Failed(i32),
}
