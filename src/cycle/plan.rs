//! The machine as configured and checked: what `config/` builds from TOML and an embedder builds by hand.

use std::path::PathBuf;

use crate::axis::AxisPlan;
use crate::bus::BusPlan;
use crate::rt::{Memory, Realtime};
use crate::sim::DatagramDrive;
use crate::time::MS;

/// A whole machine.
#[derive(Debug)]
pub struct Plan {
    /// Where it came from, for messages; `None` if built in code.
    pub source: Option<PathBuf>,
    /// The cycle.
    pub cycle: CyclePlan,
    /// The buses.
    pub buses: Vec<Box<dyn BusPlan>>,
}

impl Plan {
    /// All axes in slot order: bus after bus, drive after drive.
    pub fn axes(&self) -> Vec<&AxisPlan> {
        self.buses.iter().flat_map(|bus| bus.axes()).collect()
    }

    /// The drives of all buses, simulated.
    pub fn simulate(&self) -> Vec<Box<dyn DatagramDrive>> {
        self.buses.iter().flat_map(|bus| bus.simulate()).collect()
    }
}

/// The cycle.
#[derive(Clone, Debug, PartialEq)]
pub struct CyclePlan {
    /// The period T, ns.
    pub period_ns: u64,
    /// The core of the loop; `None` = the last one.
    pub core: Option<usize>,
    /// SCHED_FIFO priority, 1 ... 99.
    pub priority: u8,
    /// The final spin before each grid point.
    pub guard: Guard,
    /// Replies are taken until this share of the period, 0 < share < 1.
    pub receive_deadline: f64,
    /// How replies are waited for.
    pub wait: Wait,
    /// What an overrun does.
    pub overrun: Overrun,
    /// How badly real-time scheduling is wanted.
    pub realtime: Realtime,
    /// What memory is locked.
    pub memory: Memory,
    /// Longest the in-loop task may run, ns; over it is a stop. `None` = no budget.
    pub task_budget_ns: Option<u64>,
}

impl CyclePlan {
    /// Until when replies are taken, ns after the grid point.
    pub fn deadline_ns(&self) -> u64 {
        (self.period_ns as f64 * self.receive_deadline).round() as u64
    }
}

impl Default for CyclePlan {
    /// 1 kHz, SCHED_FIFO 80 if it can be had, no guard, replies until half of the period by poll, up to 10 slots skipped
    /// in a row.
    fn default() -> CyclePlan {
        CyclePlan {
            period_ns: MS,
            core: None,
            priority: 80,
            guard: Guard::Off,
            receive_deadline: 0.5,
            wait: Wait::Poll,
            overrun: Overrun::Skip { max_skip: 10 },
            realtime: Realtime::Prefer,
            memory: Memory::Process,
            task_budget_ns: None,
        }
    }
}

/// How long before a grid point the loop wakes to spin up to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guard {
    /// No spin: what the sleep gives.
    Off,
    /// A fixed time, ns.
    Fixed(u64),
    /// Calibrated from the thread's own wake-up latencies, at most a quarter of the period.
    Auto,
}

/// How replies are waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wait {
    /// Sleep until the socket is readable.
    Poll,
    /// Ask the socket again and again: shorter, and it takes the core for itself.
    Spin,
}

/// What the loop does when the work of a cycle passes the next grid point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overrun {
    /// Keep the grid and leave the missed slots out; more than `max_skip` in a row are a stop.
    Skip {
        /// The most slots skipped in a row.
        max_skip: u64,
    },
    /// Stop at the first.
    Stop,
}
