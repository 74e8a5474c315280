//! A bus as configured, before any socket is open.

use std::any::Any;
use std::fmt::Debug;
use std::net::SocketAddrV4;
use std::sync::Arc;

use super::desired::Capabilities;
use super::diagnosis::Row;
use super::load::Load;
use super::native::NativeLayout;
use super::variant::Variant;
use super::{Bus, OpenError, OwnCounter};
use crate::axis::acyclic::{Call, Notation};
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{AxisPlan, FaultNames, MonitorChannel, PlanFault, SilenceFaults};
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
        if at % period_ns < self.deadline_ns { at } else { at.next_multiple_of(period_ns) }
    }

    /// So many cycles after the one at the begin of `within_ns` its end is known.
    pub fn cycles_behind(&self, within_ns: u64) -> u64 {
        within_ns.saturating_sub(self.deadline_ns).div_ceil(self.period_ns.max(1))
    }
}

/// A bus as configured and checked, before any socket is open. The plans of the protocols of this library implement it.
pub trait BusPlan: Any + Debug + Send + Sync {
    /// Its name in messages.
    fn name(&self) -> &str;

    /// The protocol's name, as in the configuration.
    fn protocol(&self) -> &'static str;

    /// Its axes, in slot order.
    fn axes(&self) -> Vec<&AxisPlan>;

    /// What contradicts itself or would not work in a cycle of `period_ns`, each with the index of its axis.
    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)>;

    /// How long a reply of drive `index` counts on its connection, ns; the next request waits for it. `None`: there
    /// is no connection, and a reply comes in the cycle of its request.
    fn reply_within_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// For how many cycles a reply of drive `index` counts, that of its request included. The next request does not
    /// wait for it.
    fn reply_within(&self, _index: usize) -> u32 {
        1
    }

    /// On a half-duplex wire: the longest time from the slot in which an exchange of drive `index` is due to its end,
    /// all turns before its own included, ns. `None`: a request leaves in the slot in which it is due.
    fn turn_within_ns(&self, _index: usize, _grid: Grid) -> Option<u64> {
        None
    }

    /// On a half-duplex wire: the longest time from the slot in which an exchange of drive `index` is due to the begin
    /// of its request, ns: all turns before its own. By default to its end.
    fn request_within_ns(&self, index: usize, grid: Grid) -> Option<u64> {
        self.turn_within_ns(index, grid)
    }

    /// On a half-duplex wire: what `check` prints of its turns on the grid, in one line.
    fn describe_turns(&self, _grid: Grid) -> Option<String> {
        None
    }

    /// On a half-duplex wire: why its turns do not fit onto the grid, each with the index of its axis.
    fn turn_faults(&self, _grid: Grid) -> Vec<(usize, PlanFault)> {
        Vec::new()
    }

    /// How long a packet of drive `index` counts, which sends by its own clock, in a cycle of `period_ns`, ns. Requests
    /// to it are due by divisor and phase whatever its link, since its watchdog needs them. `None`: it answers
    /// requests.
    fn fresh_within_ns(&self, _index: usize, _period_ns: u64) -> Option<u64> {
        None
    }

    /// So many requests of drive `index` may have to leave before one with a stop can: the command that the stop
    /// replaces has to end first.
    fn before_stop(&self, _index: usize) -> u32 {
        0
    }

    /// What `check` prints of each drive in addition to its [`AxisPlan`]: address, modes, what happens if the
    /// master dies. One paragraph per drive, in slot order, one sentence per line; the address is the first line.
    fn describe(&self, period_ns: u64) -> Vec<String>;

    /// Drive `index` stops by itself within this time if the master dies, ns: its own watchdog. `None`: it does not.
    fn drive_watchdog_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// Opens the sockets and builds the bus for a cycle of `period_ns`. Sends nothing.
    #[doc(hidden)]
    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError>;

    /// Refuses a master that comes for one drive of this bus only, if that would disturb what is in use there. Only
    /// reads, and blocks for a fraction of a second: for normal threads.
    #[doc(hidden)]
    fn require_idle(&self, _carriers: &dyn Carriers) -> Result<(), OpenError> {
        Ok(())
    }

    /// What its exchanges put on its wire in a cycle of `period_ns`. `None`: nothing that costs a processor time.
    #[doc(hidden)]
    fn load(&self, _period_ns: u64) -> Option<Load> {
        None
    }

    /// The variables that drive `index` reports in addition to its process data, each once.
    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; MONITOR_CHANNELS];

    /// What is known of the native process data of drive `index`.
    #[doc(hidden)]
    fn native_layout(&self, _index: usize) -> NativeLayout {
        NativeLayout::default()
    }

    /// What `Counters::own` counts on this bus, in order.
    #[doc(hidden)]
    fn own_counters(&self) -> &'static [OwnCounter] {
        &[]
    }

    /// Which of `Counters::own` is the time that the telegrams of a drive took on a half-duplex wire, µs.
    #[doc(hidden)]
    fn wire_us(&self) -> Option<usize> {
        None
    }

    /// What the counts of a drive mean that is not online, the most specific symptoms first.
    #[doc(hidden)]
    fn diagnosis(&self) -> &'static [Row] {
        &[]
    }

    /// The names of the fault codes of its drives.
    #[doc(hidden)]
    fn fault_names(&self) -> FaultNames {
        |_| None
    }

    /// Which fault codes its drives have because their master was silent: their watchdogs, a lost connection.
    #[doc(hidden)]
    fn silence_faults(&self) -> SilenceFaults {
        |_| false
    }

    /// How its drives write addresses and values for acyclic access.
    #[doc(hidden)]
    fn notation(&self) -> Arc<dyn Notation>;

    /// This bus with drive `index` only, and without anything that the drive monitors. Devices found running stay
    /// running.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>>;

    /// A call that the drive of a plan of [`reaching`](Self::reaching) answers whenever it is there, without an
    /// exchange; `None`: it has to be online.
    #[doc(hidden)]
    fn probe(&self) -> Option<Call> {
        None
    }

    /// The IP addresses of its drives, in slot order; empty if they have none.
    fn addresses(&self) -> Vec<SocketAddrV4>;

    /// Where a drive is, as the search of its protocol says it; its address, if it has one.
    #[doc(hidden)]
    fn place(&self, index: usize) -> Option<String> {
        self.addresses().get(index).map(ToString::to_string)
    }

    /// Its place on a wire without IP addresses, counted from 0 at the master's end.
    #[doc(hidden)]
    fn place_on_wire(&self, index: usize) -> usize {
        index
    }

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

    /// What drive `index` can do, in a cycle of `period_ns`.
    #[doc(hidden)]
    fn capabilities(&self, index: usize, period_ns: u64) -> Capabilities;

    /// Its drives have a common clock that can lead the grid.
    fn has_clock(&self) -> bool {
        false
    }

    /// The names of the devices that are not drives, in the order of [`Bus::device`].
    fn devices(&self) -> Vec<&str> {
        Vec::new()
    }
}
