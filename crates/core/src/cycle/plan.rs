//! The machine as configured and checked: what `config/` builds from TOML and an embedder builds by hand.

use std::collections::HashSet;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use super::record::{NativeRecord, Record};
use crate::axis::group::out_of_step;
use crate::axis::{
    AxisPlan, FaultNames, MONITOR_CHANNELS, MonitorChannel, PlanFault, SilenceFaults, Units, is_plain_name,
};
use crate::bus::facts::of_drives;
use crate::bus::native::NativeLayout;
use crate::bus::{BusFacts, BusPlan, DriveFacts, Grid, OwnCounter};
use crate::rt::host::Throttling;
use crate::rt::{Memory, Realtime};
use crate::time::{MS, Ns, S, US};

/// A whole machine. By default it has the usual cycle, and no bus.
#[derive(Debug, Default)]
pub struct Plan {
    /// The file, for messages; `None` if built in code.
    pub source: Option<PathBuf>,
    /// The cycle.
    pub cycle: CyclePlan,
    /// The buses.
    pub buses: Vec<Box<dyn BusPlan>>,
    /// Axes that act together, by name.
    pub groups: Vec<GroupPlan>,
}

/// Axes that act together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GroupPlan {
    /// The name, unique among groups.
    pub name: String,
    /// The members' names, two or more, in the order of its rows.
    pub axes: Vec<String>,
}

/// The mistakes in a plan that was built in code: one line each.
#[derive(Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct PlanErrors(pub Vec<String>);
crate::debug_as_display!(PlanErrors);

/// In place of a name: each drive.
const EVERY_DRIVE: &str = "all";

/// The largest black box, bytes.
const MOST_BLACK_BOX: usize = 150_000_000;

impl Plan {
    /// All of it in words, a line for each value, those by default among them; without the file that it is from. Two
    /// plans are the same if this is.
    #[doc(hidden)]
    pub fn resolved(&self) -> String {
        let Plan { source: _, cycle, buses, groups } = self;
        // What is recorded as well, and how a run is judged, changes nothing of it.
        let CyclePlan { tolerated, cost, .. } = CyclePlan::default();
        let cycle = CyclePlan { record_native: Vec::new(), tolerated, cost, ..cycle.clone() };
        format!("{cycle:#?}\n{buses:#?}\n{groups:#?}\n")
    }

    /// All axes in slot order: bus after bus, drive after drive.
    pub fn axes(&self) -> Vec<&AxisPlan> {
        self.buses.iter().flat_map(|bus| bus.axes()).collect()
    }

    /// The units of all axes, in slot order.
    pub fn units(&self) -> Vec<Units> {
        self.axes().into_iter().map(|axis| axis.units).collect()
    }

    /// The facts of each bus before the start.
    pub fn facts(&self) -> Vec<BusFacts> {
        self.buses.iter().map(|bus| bus.facts(self.cycle.grid())).collect()
    }

    /// The monitored variables of the drives, in slot order.
    pub fn monitored(&self) -> Vec<[Option<MonitorChannel>; MONITOR_CHANNELS]> {
        self.of_each_drive(|_, drive| drive.monitored.clone())
    }

    /// The most records that the loop makes in a cycle: one per drive, one more per drive that reports monitored
    /// variables, one of the bus whose clock leads, and one of its own; those of native process data apart. Commands
    /// and events are rare.
    pub fn records_a_cycle(&self) -> usize {
        let monitored = self.monitored();
        let showing = monitored.iter().filter(|channels| channels.iter().any(Option::is_some));
        monitored.len() + showing.count() + usize::from(self.cycle.reference.is_some()) + 1
    }

    /// The most records with native process data that the loop makes at once, and usually in a cycle.
    #[doc(hidden)]
    pub fn native_records_a_cycle(&self) -> usize {
        let layouts = self.native_layouts().into_iter().flatten();
        layouts.map(|(_, layout)| layout.most.div_ceil(NativeRecord::PART)).sum()
    }

    /// The axes whose native process data are recorded, in slot order, with what is known of these.
    ///
    /// # Errors
    ///
    /// One of the names is that of no drive.
    #[doc(hidden)]
    pub fn native_layouts(&self) -> Result<Vec<(usize, NativeLayout)>, String> {
        let chosen = &self.cycle.record_native;
        let axes = self.axes();
        let has = |name: &String| name == EVERY_DRIVE || axes.iter().any(|axis| axis.name == *name);
        if let Some(name) = chosen.iter().find(|name| !has(name)) {
            let known: Vec<&str> = axes.iter().map(|axis| axis.name.as_str()).collect();
            return Err(format!(
                "there is no drive {name:?} whose native process data could be recorded; name {EVERY_DRIVE}, \
                 or some of: {}",
                known.join(", ")
            ));
        }
        let drives = self.buses.iter().flat_map(|bus| (0..bus.axes().len()).map(move |index| (bus, index)));
        let is_chosen = |axis: &AxisPlan| chosen.iter().any(|name| name == EVERY_DRIVE || *name == axis.name);
        let layouts = drives.zip(axes).enumerate().filter(|(_, (_, axis))| is_chosen(axis));
        Ok(layouts.map(|(axis, ((bus, index), _))| (axis, bus.native_layout(index))).collect())
    }

    /// Whether this plan can work: contradictions, and mistakes that only a machine that does not stop would show.
    /// A file passes more checks than these while it is read.
    pub fn check(&self) -> Result<(), PlanErrors> {
        let mut errors = Vec::new();
        if !(50 * US..=S).contains(&self.cycle.period_ns) {
            errors.push(format!("cycle: a period of {} is outside 50 us ... 1 s", Ns(self.cycle.period_ns)));
        }
        let share = self.cycle.receive_deadline;
        if !(share > 0.0 && share < 1.0) {
            errors
                .push(format!("cycle: a receive deadline of {share} is not a share of the period, 0 ... 1"));
        }
        let Shares { late, skipped, unanswered } = self.cycle.tolerated;
        for (key, share) in [
            ("skip_rate", self.cycle.max_skip_rate),
            ("late_share", late),
            ("skipped_share", skipped),
            ("unanswered_share", unanswered),
        ] {
            if !(0.0..=1.0).contains(&share) {
                errors.push(format!("cycle: a max_{key} of {share} is not a share, 0 ... 1"));
            }
        }
        let CyclePlan { watch_after, guardian_after, .. } = self.cycle;
        for (key, after) in [("watch_after", watch_after), ("guardian_after", guardian_after)] {
            let range = CyclePlan::watch_range_ns(self.cycle.period_ns);
            if let WatchAfter::Fixed(ns) = after
                && !range.contains(&ns)
            {
                let (least, most) = (Ns(*range.start()), Ns(*range.end()));
                errors.push(format!("cycle: a {key} of {} is outside {least} ... {most}", Ns(ns)));
            }
        }
        let facts = self.facts();
        let of_cycle = self.black_box_fault().into_iter().chain(self.reference_fault(&facts));
        errors.extend(of_cycle.map(|why| format!("cycle: {why}")));
        errors.extend(self.native_layouts().err());
        let mut groups = HashSet::new();
        for GroupPlan { name, .. } in self.groups.iter().filter(|group| !groups.insert(&group.name)) {
            errors.push(format!("group {name}: its name is taken by another group"));
        }
        let axes = self.axes();
        let drives = axes.iter().map(|axis| ("drive", &axis.name));
        let devices = facts.iter().flat_map(|bus| &bus.devices).map(|name| ("device", name));
        let mut names = HashSet::new();
        for (kind, name) in drives.chain(devices) {
            if !is_plain_name(name) {
                errors.push(format!("{kind} {name:?}: its name must be 1 to 32 letters, digits, - _ or ."));
            }
            if !names.insert(name) {
                errors.push(format!("{kind} {name}: its name is taken; names are unique in the machine"));
            }
        }
        for bus in &self.buses {
            let (mut faults, axes) = (bus.faults(self.cycle.period_ns), bus.axes());
            if faults.is_empty() {
                faults = bus.turn_faults(self.cycle.grid());
            }
            errors.extend(faults.into_iter().map(|(index, PlanFault { key, message })| {
                let drive = axes.get(index).map_or_else(String::new, |axis| format!("drive {}: ", axis.name));
                format!("bus {}: {drive}{key}: {message}", bus.name())
            }));
        }
        for group in &self.groups {
            errors.extend(group.fault(&axes).map(|why| format!("group {}: {why}", group.name)));
        }
        if errors.is_empty() { Ok(()) } else { Err(PlanErrors(errors)) }
    }

    /// How many records the black box holds: those of each of its cycles. Native process data that are recorded take
    /// none of its time, though it does not write them.
    pub fn black_box_records(&self) -> usize {
        let cycles = self.cycle.black_box_ns / self.cycle.period_ns.max(1);
        let of_a_cycle = self.records_a_cycle() + self.native_records_a_cycle();
        usize::try_from(cycles).unwrap_or(0).saturating_mul(of_a_cycle)
    }

    /// Why the bus that is named as the reference cannot lead the grid.
    fn reference_fault(&self, facts: &[BusFacts]) -> Option<String> {
        let name = self.cycle.reference.as_deref()?;
        let buses = self.buses.iter().map(|bus| bus.name()).zip(facts);
        let named: Vec<_> = buses.clone().filter(|(known, _)| *known == name).collect();
        let clocks: Vec<_> = buses.filter(|(_, bus)| bus.has_clock).map(|(known, _)| known).collect();
        let remedy = match clocks[..] {
            [] => "no bus of this machine has one: leave reference out".to_owned(),
            _ => format!("name one that has: {}", clocks.join(", ")),
        };
        match named[..] {
            [] => Some(format!("reference = {name:?} is not a bus; {remedy}")),
            [(_, bus)] if bus.has_clock => None,
            [(_, BusFacts { protocol, .. })] => {
                Some(format!("reference = {name:?}: a {protocol} bus has no clock that can lead; {remedy}"))
            }
            _ => Some(format!("reference = {name:?} names {} buses; give each its own name", named.len())),
        }
    }

    /// Why the black box is too large. Its memory is locked with all the rest.
    #[doc(hidden)]
    pub fn black_box_fault(&self) -> Option<String> {
        let bytes = self.black_box_records().saturating_mul(size_of::<Record>());
        (bytes > MOST_BLACK_BOX).then(|| {
            format!(
                "a black box of {} would take {} MB, at most {} MB; shorten black_box",
                Ns(self.cycle.black_box_ns),
                bytes / 1_000_000,
                MOST_BLACK_BOX / 1_000_000
            )
        })
    }

    /// This plan with the drive of axis `name` only, to move it: the cycle is unchanged. A drive that is found
    /// running is left as it is. `None`: there is no such axis, or it cannot be reached alone.
    pub fn alone(&self, name: &str) -> Option<Plan> {
        let (bus, index) = self.find(name)?;
        Some(Plan {
            source: self.source.clone(),
            cycle: CyclePlan {
                // Without the bus that leads it, our own clock does.
                reference: self.cycle.reference.clone().filter(|name| name == bus.name()),
                ..self.cycle.clone()
            },
            buses: vec![bus.reaching(index)?],
            groups: Vec::new(),
        })
    }

    /// The least of this plan that reaches the drive of axis `name`: for acyclic access only, on an ordinary
    /// thread, which may be arbitrarily late. It must not be used for motion. `None` as of [`alone`](Self::alone).
    pub fn reaching(&self, name: &str) -> Option<Plan> {
        let plan = self.alone(name)?;
        let cycle = CyclePlan {
            period_ns: self.cycle.period_ns,
            receive_deadline: self.cycle.receive_deadline,
            realtime: Realtime::Off,
            black_box_ns: 0,
            overrun: Overrun::Skip { max_skip: u64::MAX },
            max_skip_rate: 1.0,
            ..CyclePlan::default()
        };
        Some(Plan { cycle, ..plan })
    }

    /// The counters of each drive that only its protocol has, in slot order.
    pub fn own_counters(&self) -> Vec<&'static [OwnCounter]> {
        self.of_each_drive(|bus, _| bus.own_counters)
    }

    /// The names of the fault codes of each drive, in slot order.
    pub fn fault_names(&self) -> Vec<FaultNames> {
        self.of_each_drive(|bus, _| bus.fault_names)
    }

    /// Which fault codes say that the master was silent, of each drive, in slot order.
    #[doc(hidden)]
    pub fn silence_faults(&self) -> Vec<SilenceFaults> {
        self.of_each_drive(|bus, _| bus.silence_faults)
    }

    fn of_each_drive<T>(&self, of: impl Fn(&BusFacts, &DriveFacts) -> T) -> Vec<T> {
        of_drives(&self.facts()).map(|(bus, drive)| of(bus, drive)).collect()
    }

    /// The bus of axis `name`, and its index there.
    pub fn find(&self, name: &str) -> Option<(&dyn BusPlan, usize)> {
        self.buses.iter().find_map(|bus| {
            let index = bus.axes().iter().position(|axis| axis.name == name)?;
            Some((&**bus, index))
        })
    }

    /// The bus that has a device of this name that is not a drive.
    pub fn find_device(&self, name: &str) -> Option<&dyn BusPlan> {
        let has = |bus: &BusFacts| bus.devices.iter().any(|device| device == name);
        self.buses.iter().zip(self.facts()).find(|(_, facts)| has(facts)).map(|(bus, _)| &**bus)
    }
}

impl GroupPlan {
    /// Why its members, found by name among `axes`, cannot act together.
    pub fn fault(&self, axes: &[&AxisPlan]) -> Option<String> {
        let mut members: Vec<&AxisPlan> = Vec::with_capacity(self.axes.len());
        for name in &self.axes {
            let Some(axis) = axes.iter().find(|axis| axis.name == *name) else {
                return Some(format!("there is no drive {name}"));
            };
            if members.iter().any(|member| member.name == *name) {
                return Some(format!("{name} is listed twice"));
            }
            members.push(axis);
        }
        out_of_step(members.into_iter()).map(|error| error.to_string())
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
    /// The reaction to an overrun.
    pub overrun: Overrun,
    /// With [`Overrun::Skip`], a larger share of the last 100 slots skipped is a stop, 0 ... 1. 1 = not watched.
    pub max_skip_rate: f64,
    /// With larger shares than these of its cycles, slots and exchanges the period counts as not carried.
    pub tolerated: Shares,
    /// The treatment of a plan whose cycle [costs](super::cost) more than its period.
    pub cost: OnCost,
    /// The bus whose clock leads the grid, by name. `None` = ours does.
    pub reference: Option<String>,
    /// Whether real-time scheduling is required.
    pub realtime: Realtime,
    /// The memory to lock.
    pub memory: Memory,
    /// Longest time that the in-loop task may run, ns; longer is a stop. `None` = no budget.
    pub task_budget_ns: Option<u64>,
    /// Longest silence of the application while an axis is enabled, ns; longer is a stop of all enabled axes.
    /// `None` = not watched.
    pub heartbeat_ns: Option<u64>,
    /// After what time without a sign of life the loop counts as stuck.
    pub watch_after: WatchAfter,
    /// After what time without a sign of life the guardian of the process stops the drives that have no watchdog of
    /// their own. It stops them at once if the process ends without an orderly end. `Off`: there is no guardian.
    pub guardian_after: WatchAfter,
    /// A cycle that begins later, or spends longer in a stage, counts as late, ns. `None` = a tenth of the period.
    pub late_ns: Option<u64>,
    /// How far back the black box reaches, ns.
    pub black_box_ns: u64,
    /// The drives whose native process data the loop reports, by name; `all` is each of them. A recorder sets it.
    #[doc(hidden)]
    pub record_native: Vec<String>,
}

/// The treatment of a plan whose cycle takes longer than its period, as estimated before the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnCost {
    /// It is refused.
    Refuse,
    /// It starts, and `check` says so.
    Warn,
    /// Nothing is estimated.
    Ignore,
}

/// The shares of a run that were not as planned, 0 ... 1 each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shares {
    /// Cycles that began late, of those executed; see [`CyclePlan::late_ns`].
    pub late: f64,
    /// Slots skipped, of all.
    pub skipped: f64,
    /// Exchanges that were missed or not sent while the drive was online, of the drive with most of them.
    pub unanswered: f64,
}

impl CyclePlan {
    /// Until when replies are taken, ns after the grid point.
    pub fn deadline_ns(&self) -> u64 {
        (self.period_ns as f64 * self.receive_deadline).round() as u64
    }

    /// The period and the window.
    pub fn grid(&self) -> Grid {
        Grid { period_ns: self.period_ns, deadline_ns: self.deadline_ns() }
    }

    /// After what time without a sign of life the loop counts as stuck, ns; `None` = it is not watched.
    pub fn watch_after_ns(&self) -> Option<u64> {
        self.watch_after.ns(WATCH_NS.max(WATCH_CYCLES.saturating_mul(self.period_ns)))
    }

    /// After what time without a sign of life the guardian acts, ns; `None` = there is none. By default half as long
    /// again as that of the watch, which can do more; without a watch [`DEATH_ALONE`](Self::DEATH_ALONE).
    pub fn guardian_after_ns(&self) -> Option<u64> {
        let usual = self.watch_after_ns().map_or(CyclePlan::DEATH_ALONE, |watch_ns| watch_ns + watch_ns / 2);
        self.guardian_after.ns(usual)
    }

    /// The guardian acts once the process has ended, however long its loop gives no sign of life.
    pub const DEATH_ALONE: u64 = i64::MAX as u64;

    /// The times after which a loop with this period may count as stuck, ns. A cycle alone takes up to two periods, the
    /// wait for its grid point included.
    #[doc(hidden)]
    pub fn watch_range_ns(period_ns: u64) -> RangeInclusive<u64> {
        WATCH_LEAST_NS.max(WATCH_LEAST_CYCLES.saturating_mul(period_ns))..=WATCH_MOST_NS
    }

    /// The delay from which a cycle is late, ns.
    pub fn late_ns(&self) -> u64 {
        self.late_ns.unwrap_or(self.period_ns / 10)
    }
}

impl Default for CyclePlan {
    /// 1 kHz, SCHED_FIFO 80 if available, no guard, replies until half of the period by poll, up to 10 slots
    /// skipped in a row and 20 % of the last 100.
    fn default() -> CyclePlan {
        CyclePlan {
            period_ns: MS,
            core: None,
            priority: 80,
            guard: Guard::Off,
            receive_deadline: 0.5,
            wait: Wait::Poll,
            overrun: Overrun::Skip { max_skip: 10 },
            max_skip_rate: 0.2,
            tolerated: Shares { late: 0.1, skipped: 0.01, unanswered: 0.01 },
            cost: OnCost::Refuse,
            reference: None,
            realtime: Realtime::Prefer,
            memory: Memory::Process,
            task_budget_ns: None,
            heartbeat_ns: None,
            watch_after: WatchAfter::Auto,
            guardian_after: WatchAfter::Auto,
            late_ns: None,
            black_box_ns: 2 * S,
            record_native: Vec::new(),
        }
    }
}

/// The default time without a sign of life after which the loop counts as stuck, ns, and in cycles: a virtual host
/// takes a processor away for up to some 100 ms, and so does a busy one from an ordinary thread.
const WATCH_NS: u64 = 500 * MS;
const WATCH_CYCLES: u64 = 20;
/// The shortest and the longest such time, ns and in cycles.
const WATCH_LEAST_NS: u64 = 20 * MS;
const WATCH_LEAST_CYCLES: u64 = 5;
const WATCH_MOST_NS: u64 = 60 * S;

/// Whether a watch on another thread sees that the loop's cycle does not end, and after what time without a sign of
/// life: a task that does not return, a bus that hangs, a thread that the host does not run.
///
/// Then it takes the wires from the loop: nothing more is sent by it, [feedback](crate::axis::Feedback) ages and shows
/// [`StopCause::LoopStuck`](crate::axis::StopCause::LoopStuck), waiting calls return with the cause, and drives without
/// a watchdog of their own are stopped by the watch. A loop that comes back latches all axes and ends; the run has
/// failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WatchAfter {
    /// It is not watched.
    Off,
    /// 500 ms, or 20 cycles if they are longer; the guardian half as long again as the watch, and without a watch not
    /// at all while the process lives.
    Auto,
    /// A fixed time, ns.
    Fixed(u64),
}

impl WatchAfter {
    /// The time, if there is one; `usual`: that of `Auto`.
    fn ns(self, usual: u64) -> Option<u64> {
        match self {
            WatchAfter::Off => None,
            WatchAfter::Auto => Some(usual),
            WatchAfter::Fixed(ns) => Some(ns),
        }
    }
}

/// How long before a grid point the loop wakes to spin up to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guard {
    /// No spin: the sleep alone.
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
    /// Read the socket again and again: lower latency, and it occupies the core.
    Spin,
}

/// The reaction of the loop when the work of a cycle passes the next grid point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overrun {
    /// Keep the grid and leave out the missed slots; more than `max_skip` in a row are a stop.
    Skip {
        /// The most slots skipped in a row.
        max_skip: u64,
    },
    /// Stop at the first.
    Stop,
}

/// Why this cycle would starve the host it runs on, and what to do about it; `None` if it does not.
///
/// A loop that spins for most of its period never lets its core go. With real-time throttling on, the kernel then takes
/// the core away, for tens of milliseconds at a stretch.
pub fn starvation(cycle: &CyclePlan, host: &Throttling) -> Option<String> {
    let runtime_us = host.runtime_us.filter(|runtime_us| *runtime_us < host.period_us)?;
    if cycle.realtime == Realtime::Off {
        return None;
    }
    let guard_ns = match cycle.guard {
        Guard::Off => 0,
        Guard::Fixed(ns) => ns,
        Guard::Auto => cycle.period_ns / 4,
    };
    let receive_ns = match cycle.wait {
        Wait::Poll => 0,
        Wait::Spin => cycle.deadline_ns(),
    };
    let busy_ns = guard_ns.saturating_add(receive_ns);
    (busy_ns > cycle.period_ns / 2).then(|| {
        format!(
            "cycle: guard ({}) and spinning receive ({}) would hold the core for {} of every {}, and this \
             kernel takes it away from real-time threads after {} of every {}; use wait = \"poll\" or a \
             shorter guard, or on a core of its own: sysctl kernel.sched_rt_runtime_us=-1",
            Ns(guard_ns),
            Ns(receive_ns),
            Ns(busy_ns),
            Ns(cycle.period_ns),
            Ns(runtime_us.saturating_mul(US)),
            Ns(host.period_us.saturating_mul(US)),
        )
    })
}
