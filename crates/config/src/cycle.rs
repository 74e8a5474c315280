//! `[cycle]`, and what of it cannot work.

use std::ops::RangeInclusive;

use fieldbeat_core::cycle::{CyclePlan, Guard, OnCost, Overrun, Plan, Shares, Wait, WatchAfter};
use fieldbeat_core::rt::{Memory, Realtime};
use fieldbeat_core::time::{Ns, S, US};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::table::{Table, set, time, within_times};
use fieldbeat_keys::value::{SHORT_NAME, alternatives, plain_name};

pub(super) const WAITS: [(&str, Wait); 2] = [("poll", Wait::Poll), ("spin", Wait::Spin)];
pub(super) const REALTIMES: [(&str, Realtime); 3] =
    [("require", Realtime::Require), ("prefer", Realtime::Prefer), ("off", Realtime::Off)];
pub(super) const COSTS: [(&str, OnCost); 3] =
    [("refuse", OnCost::Refuse), ("warn", OnCost::Warn), ("off", OnCost::Ignore)];
pub(super) const MEMORIES: [(&str, Memory); 2] = [("process", Memory::Process), ("own", Memory::Own)];

/// The periods that a cycle may have, ns.
const PERIODS: RangeInclusive<u64> = 50 * US..=S;
const PERIOD_HINT: &str = "1ms is 1000 cycles a second";

/// Why a cycle cannot have this period.
pub(super) fn period_fault(period_ns: u64) -> Option<String> {
    within_times(period_ns, &PERIODS, PERIOD_HINT).err()
}

/// Reads `[cycle]`; every key has its default in [`CyclePlan`].
pub(super) fn cycle(table: &mut Table<'_>) -> CyclePlan {
    let mut plan = CyclePlan::default();
    set(&mut plan.period_ns, table.time("period", PERIODS, PERIOD_HINT));
    let period_ns = plan.period_ns;
    plan.core = table.integer("core", 0..=1023, "cores are counted from 0; leave it out for the last one");
    let priority = "80 is above interrupt threads and below the kernel's own";
    set(&mut plan.priority, table.integer("priority", 1..=99, priority));
    set(&mut plan.guard, guard(table));
    let deadline = "a share of the period, 0.5 is half of it";
    set(&mut plan.receive_deadline, table.number("receive_deadline", 0.05..=0.95, deadline));
    set(&mut plan.wait, table.word("wait", &WAITS));
    set(&mut plan.overrun, overrun(table, period_ns));
    let skips = "the largest share of the last 100 slots that may be skipped; 1.0 is not watched";
    set(&mut plan.max_skip_rate, table.number("max_skip_rate", 0.0..=1.0, skips));
    let Shares { late, skipped, unanswered } = &mut plan.tolerated;
    set(late, share(table, "max_late_share", "cycles that begin late"));
    set(skipped, share(table, "max_skipped_share", "skipped slots"));
    set(unanswered, share(table, "max_unanswered_share", "unanswered exchanges of a drive"));
    set(&mut plan.cost, table.word("cost", &COSTS));
    set(&mut plan.realtime, table.word("realtime", &REALTIMES));
    set(&mut plan.memory, table.word("memory", &MEMORIES));
    plan.task_budget_ns = table.time("task_budget", US..=period_ns, "the in-loop task runs once a cycle");
    let silence =
        "the longest silence of the application while an axis is enabled; leave it out for no limit";
    plan.heartbeat_ns = table.time("heartbeat", period_ns..=3600 * S, silence);
    let watch = "or \"off\"; the loop counts as stuck after so long without a sign of life";
    let watch_ns = table.time_or_off("watch_after", CyclePlan::watch_range_ns(period_ns), watch);
    set(&mut plan.watch_after, watch_ns.map(|ns| ns.map_or(WatchAfter::Off, WatchAfter::Fixed)));
    let guardian = "or \"off\"; the guardian stops LinMots after so long without a sign of life";
    let guardian_ns = table.time_or_off("guardian_after", CyclePlan::watch_range_ns(period_ns), guardian);
    set(&mut plan.guardian_after, guardian_ns.map(|ns| ns.map_or(WatchAfter::Off, WatchAfter::Fixed)));
    let late = "the lateness above which a cycle is counted as late, with its cause";
    plan.late_ns = table.time("late", US..=period_ns, late);
    let kept = "the length of the recording that is kept for a failure; 0s keeps none";
    set(&mut plan.black_box_ns, table.time("black_box", 0..=60 * S, kept));
    let leads = "the name of a bus, whose clock leads the grid";
    plan.reference = table.text("reference", SHORT_NAME, leads, plain_name);
    plan
}

/// The bus whose clock leads has to be there, and to have one.
pub(super) fn check_reference(root: &Table<'_>, plan: &Plan) {
    let Some(reference) = &plan.cycle.reference else { return };
    let facts = plan.facts();
    let mut buses = plan.buses.iter().map(|bus| bus.name()).zip(&facts);
    let clocked: Vec<&str> = buses.clone().filter(|(_, bus)| bus.has_clock).map(|(name, _)| name).collect();
    if clocked.contains(&reference.as_str()) {
        return;
    }
    let what = match buses.find(|(name, _)| name == reference) {
        Some((_, bus)) => format!("is a bus without a clock ({})", bus.protocol),
        None => "is not a bus of this machine".to_owned(),
    };
    let remedy = match clocked.as_slice() {
        [] => "no bus here has a clock, leave it out".to_owned(),
        names => format!("use {}", alternatives(names.iter().copied())),
    };
    root.fault("cycle.reference", format!("{what}; {remedy}"));
}

/// The share of `what` up to which a period counts as carried.
fn share(table: &mut Table<'_>, key: &'static str, what: &str) -> Option<f64> {
    let hint =
        format!("the largest share of {what} with which the period counts as carried; 1.0 judges none");
    table.number(key, 0.0..=1.0, &hint)
}

fn guard(table: &mut Table<'_>) -> Option<Guard> {
    table.read("guard", Form::Time.or(Form::words(["off", "auto"])), |value| match value.as_str() {
        Some("off") => Ok(Guard::Off),
        Some("auto") => Ok(Guard::Auto),
        _ => time(value, &(US..), "or \"auto\", or \"off\"").map(Guard::Fixed),
    })
}

fn overrun(table: &mut Table<'_>, period_ns: u64) -> Option<Overrun> {
    let skips = table.word("overrun", &[("skip", true), ("stop", false)]);
    let max_skip =
        table.count("max_skip", 1..=1_000_000, period_ns, "the most slots that may be skipped in a row");
    match (skips, max_skip) {
        (Some(false), Some(_)) => {
            table.fault("max_skip", "needs overrun = \"skip\"; \"stop\" skips nothing, leave max_skip out");
            None
        }
        (Some(false), None) => Some(Overrun::Stop),
        (_, Some(max_skip)) => Some(Overrun::Skip { max_skip }),
        (_, None) => None,
    }
}

/// The loop's own work between the deadline and the next grid point: twice what the `scale` bench allows it, so that a
/// plan at the edge is refused and not found out by overruns.
fn preparation_ns(drives: usize) -> u64 {
    5 * US + drives as u64 * 500
}

/// The guard and the work that lies between the deadline and the next grid point must fit into the rest of the period.
pub(super) fn check_period(root: &Table<'_>, cycle: &CyclePlan, drives: usize) {
    let guard_ns = match cycle.guard {
        Guard::Fixed(ns) => ns,
        // Calibrated at the start, and bounded there.
        Guard::Off | Guard::Auto => 0,
    };
    let deadline_ns = cycle.deadline_ns();
    let task_ns = cycle.task_budget_ns.unwrap_or(0);
    let preparation_ns = preparation_ns(drives);
    let rest = guard_ns.saturating_add(task_ns).saturating_add(preparation_ns);
    if deadline_ns.saturating_add(rest) <= cycle.period_ns {
        return;
    }
    let mut parts = vec![format!("replies until {}", Ns(deadline_ns))];
    let mut key = "cycle.receive_deadline";
    if task_ns > 0 {
        parts.push(format!("an in-loop task of {}", Ns(task_ns)));
        key = "cycle.task_budget";
    }
    if guard_ns > 0 {
        parts.push(format!("a guard of {}", Ns(guard_ns)));
        key = "cycle.guard";
    }
    // Whole per cents, downwards, so that the advice itself fits.
    let fitting = cycle.period_ns.saturating_sub(rest) * 100 / cycle.period_ns;
    let remedy = match fitting {
        0..5 => "lengthen the period".to_owned(),
        share => format!("receive_deadline = {} fits", share.min(95) as f64 / 100.0),
    };
    root.fault(
        key,
        format!(
            "{} and {} to prepare {drives} drive{} exceed the period of {}; {remedy}",
            parts.join(", "),
            Ns(preparation_ns),
            if drives == 1 { "" } else { "s" },
            Ns(cycle.period_ns)
        ),
    );
}
