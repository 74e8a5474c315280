//! A bus as configured, before any socket is open.

use std::any::Any;
use std::fmt::Debug;

use super::native::NativeLayout;
use super::variant::Variant;
use super::{BusFacts, OpenError, Opened};
use crate::axis::{AxisPlan, PlanFault};
use crate::net::Carriers;

/// The grid of a cycle and its windows: what a wire depends on whose requests wait for their turn, since each of them
/// begins inside a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    /// The period, ns.
    pub period_ns: u64,
    /// The end of the window, ns after the slot.
    pub deadline_ns: u64,
}

impl Grid {
    /// The earliest time in a window that is not before `at`, ns after a slot of the grid.
    pub fn in_window(&self, at: u64) -> u64 {
        let period_ns = self.period_ns.max(1);
        match at % period_ns < self.deadline_ns {
            true => at,
            false => at.checked_next_multiple_of(period_ns).unwrap_or(u64::MAX),
        }
    }

    /// The number of cycles after the one at the start of `within_ns` until its end is known.
    pub fn cycles_behind(&self, within_ns: u64) -> u64 {
        within_ns.saturating_sub(self.deadline_ns).div_ceil(self.period_ns.max(1))
    }
}

/// The line of `check` on a drive that nothing stops if the master dies.
pub const fn unwatched(is_accepted: bool) -> &'static str {
    match is_accepted {
        true => "nothing stops the drive: it keeps its last speed (no_drive_watchdog = \"accept\")",
        false => "nothing would stop the drive, so it is not enabled (no_drive_watchdog = \"refuse\")",
    }
}

/// A bus as configured and checked, before any socket is open. The plans of the protocols of this library implement it.
pub trait BusPlan: Any + Debug + Send + Sync {
    /// The name in messages.
    fn name(&self) -> &str;

    /// The axes, in slot order.
    fn axes(&self) -> Vec<&AxisPlan>;

    /// The contradictions, and settings that would not work in a cycle of `period_ns`, each with the index of its axis.
    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)>;

    /// On a half-duplex wire: why its turns do not fit onto the grid, each with the index of its axis. Of a plan
    /// without [`faults`](Self::faults).
    fn turn_faults(&self, _grid: Grid) -> Vec<(usize, PlanFault)> {
        Vec::new()
    }

    /// The facts of the bus before the start, whatever is wrong with it. A caller that needs several facts computes
    /// them once.
    fn facts(&self, grid: Grid) -> BusFacts;

    /// The lines of `check` on each drive in addition to its [`AxisPlan`]: address, modes, what happens if the
    /// master dies. One paragraph per drive, in slot order, one sentence per line; the address is the first line. The
    /// lines of the bus itself follow. No fact: it is printed only, of a plan without faults.
    fn describe(&self, grid: Grid) -> Vec<String>;

    /// The description of the native process data of drive `index`. No fact: only a recorded drive needs all these
    /// names.
    #[doc(hidden)]
    fn native_layout(&self, _index: usize) -> NativeLayout {
        NativeLayout::default()
    }

    /// Opens the sockets and builds the bus for a cycle of `period_ns`. Sends nothing.
    #[doc(hidden)]
    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError>;

    /// Refuses a master that comes for one drive of this bus only, if that would disturb what is in use there. Only
    /// reads, and blocks for a fraction of a second: for normal threads.
    #[doc(hidden)]
    fn require_idle(&self, _carriers: &dyn Carriers) -> Result<(), OpenError> {
        Ok(())
    }

    /// This bus with drive `index` only, and without anything that the drive monitors. Devices found running stay
    /// running.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>>;

    /// The drive that byte `at` of a frame or telegram of this bus is for, where drives have no IP address; `None`: it
    /// is for no single one.
    #[doc(hidden)]
    fn drive_in(&self, _telegram: &[u8], _at: usize) -> Option<usize> {
        None
    }

    /// This bus in a machine that is otherwise like its own; `None`: it cannot be had so.
    #[doc(hidden)]
    fn variant(&self, _wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        None
    }
}
