//! `[cycle]`, and what of it cannot work.

use std::ops::RangeInclusive;

use fieldbeat_core::cycle::{CyclePlan, Guard, OnCost, Overrun, Plan, Shares, Wait, WatchAfter};
use fieldbeat_core::rt::{Memory, Realtime};
use fieldbeat_core::time::{Ns, S, US};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::{Table, set, time, within_times};
use fieldbeat_keys::value::{SHORT_NAME, alternatives, plain_name};

keys! {
    PERIOD "period" = "1ms": "period of the cycle, 50 us ... 1 s";
    CORE "core" = "(the last core)": "core of the real-time thread, counted from 0; best one that the "
        "kernel command line isolates, without the key the last one";
    PRIORITY "priority" = "80": "SCHED_FIFO priority, 1 ... 99";
    RECEIVE_DEADLINE "receive_deadline" = "0.5": "replies are received until this share of the period, "
        "0.05 ... 0.95; a later reply is a miss";
    WAIT "wait" = "poll": "how replies are waited for: `\"poll\"` sleeps, `\"spin\"` reads the socket in a "
        "loop and keeps the core busy";
    MAX_SKIP_RATE "max_skip_rate" = "0.2": "with `\"skip\"`: a larger share of the last 100 slots skipped "
        "stops all axes; `1.0`: not watched";
    MAX_LATE_SHARE "max_late_share" = "0.1": "largest share of cycles that began late (`late`) with which "
        "a run is [carried](diagnosis.md#carried-or-not); `1.0` judges none";
    MAX_SKIPPED_SHARE "max_skipped_share" = "0.01": "largest share of skipped slots with which a run is "
        "carried; `1.0` judges none";
    MAX_UNANSWERED_SHARE "max_unanswered_share" = "0.01": "largest share of exchanges that a drive did not "
        "answer while it was online with which a run is carried; `1.0` judges none";
    COST "cost" = "refuse": "a plan whose cycle [takes longer than its "
        "period](host.md#what-a-cycle-costs): `\"refuse\"`, `\"warn\"` starts it all the same, `\"off\"` "
        "estimates nothing";
    REALTIME "realtime" = "prefer": "`\"require\"` refuses to start without the rights for SCHED_FIFO and "
        "locked memory, `\"prefer\"` runs without them and says so, `\"off\"` uses an ordinary thread";
    MEMORY "memory" = "process": "what is locked in RAM: the whole process, or the `\"own\"` memory of the "
        "real-time thread";
    TASK_BUDGET "task_budget" = "none": "longest time for the in-loop task; a longer one stops all axes";
    HEARTBEAT "heartbeat" = "none": "longest silence of the application while an axis is enabled; a longer "
        "one stops all enabled axes";
    WATCH_AFTER "watch_after" = "(`\"500ms\"`, or 20 cycles if they are longer)":
        "without a sign of life of the loop for so long, its [watch](stops.md#a-loop-that-is-stuck) stops "
        "the drives and the run has failed; at least 20 ms and 5 cycles, at most 60 s; `\"off\"`: not "
        "watched";
    GUARDIAN_AFTER "guardian_after" = "(half as long again as `watch_after`; without a watch only once the "
        "process has died)":
        "without a sign of life of the loop for so long, the [guardian](stops.md#the-guardian), a process of "
        "its own, stops the LinMots; at once if the master's process has died. The same range; `\"off\"`: "
        "there is none";
    LATE "late" = "(a tenth of the period)": "limit for a late cycle: one that begins later than this "
        "after its grid point, or spends longer in a stage, is counted with its cause";
    BLACK_BOX "black_box" = "2s": "how much of the past the black box keeps; `\"0s\"` switches it off";
    REFERENCE "reference" = "none": "name of the one bus whose clock leads the grid (EtherCAT); without it "
        "this computer's clock leads";
    GUARD "guard" = "off": "spin before each grid point: `\"off\"`, a time, or `\"auto\"` (calibrated at "
        "the start). The thread wakes that much earlier and spins up to the grid point";
    OVERRUN "overrun" = "skip": "a cycle that runs into the next grid point: `\"skip\"` keeps the grid and "
        "counts the slots that were missed, `\"stop\"` stops all axes";
    MAX_SKIP "max_skip" = "10": "with `\"skip\"`: more skipped slots in a row than this stop all axes; a "
        "number, or a time such as `\"50ms\"`";
}

pub(super) const WAITS: [(&str, Wait); 2] = [("poll", Wait::Poll), ("spin", Wait::Spin)];
pub(super) const REALTIMES: [(&str, Realtime); 3] =
    [("require", Realtime::Require), ("prefer", Realtime::Prefer), ("off", Realtime::Off)];
pub(super) const COSTS: [(&str, OnCost); 3] =
    [("refuse", OnCost::Refuse), ("warn", OnCost::Warn), ("off", OnCost::Ignore)];
pub(super) const MEMORIES: [(&str, Memory); 2] = [("process", Memory::Process), ("own", Memory::Own)];

/// The periods that a cycle may have, ns.
const PERIODS: RangeInclusive<u64> = 50 * US..=S;

/// Why a cycle cannot have this period.
pub(super) fn period_fault(period_ns: u64) -> Option<String> {
    within_times(period_ns, &PERIODS).err()
}

/// Reads `[cycle]`; every key has its default in [`CyclePlan`].
pub(super) fn cycle(table: &mut Table<'_>) -> CyclePlan {
    let mut plan = CyclePlan::default();
    set(&mut plan.period_ns, table.time(PERIOD, PERIODS));
    let period_ns = plan.period_ns;
    plan.core = table.integer(CORE, 0..=1023);
    set(&mut plan.priority, table.integer(PRIORITY, 1..=99));
    set(&mut plan.guard, guard(table));
    set(&mut plan.receive_deadline, table.number(RECEIVE_DEADLINE, 0.05..=0.95));
    set(&mut plan.wait, table.word(WAIT, &WAITS));
    set(&mut plan.overrun, overrun(table, period_ns));
    set(&mut plan.max_skip_rate, table.number(MAX_SKIP_RATE, 0.0..=1.0));
    let Shares { late, skipped, unanswered } = &mut plan.tolerated;
    set(late, share(table, MAX_LATE_SHARE));
    set(skipped, share(table, MAX_SKIPPED_SHARE));
    set(unanswered, share(table, MAX_UNANSWERED_SHARE));
    set(&mut plan.cost, table.word(COST, &COSTS));
    set(&mut plan.realtime, table.word(REALTIME, &REALTIMES));
    set(&mut plan.memory, table.word(MEMORY, &MEMORIES));
    plan.task_budget_ns = table.time(TASK_BUDGET, US..=period_ns);
    plan.heartbeat_ns = table.time(HEARTBEAT, period_ns..=3600 * S);
    let watch_ns = table.time_or_off(WATCH_AFTER, CyclePlan::watch_range_ns(period_ns));
    set(&mut plan.watch_after, watch_ns.map(|ns| ns.map_or(WatchAfter::Off, WatchAfter::Fixed)));
    let guardian_ns = table.time_or_off(GUARDIAN_AFTER, CyclePlan::watch_range_ns(period_ns));
    set(&mut plan.guardian_after, guardian_ns.map(|ns| ns.map_or(WatchAfter::Off, WatchAfter::Fixed)));
    plan.late_ns = table.time(LATE, US..=period_ns);
    set(&mut plan.black_box_ns, table.time(BLACK_BOX, 0..=60 * S));
    plan.reference = table.text(REFERENCE, SHORT_NAME, "the name of a bus", plain_name);
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

/// The share up to which a period counts as carried.
fn share(table: &mut Table<'_>, key: Key) -> Option<f64> {
    table.number(key, 0.0..=1.0)
}

fn guard(table: &mut Table<'_>) -> Option<Guard> {
    table.read(GUARD, Form::Time.or(Form::words(["off", "auto"])), |value| match value.as_str() {
        Some("off") => Ok(Guard::Off),
        Some("auto") => Ok(Guard::Auto),
        _ => time(value, &(US..)).map(Guard::Fixed).map_err(|why| format!("{why}, or \"auto\", or \"off\"")),
    })
}

fn overrun(table: &mut Table<'_>, period_ns: u64) -> Option<Overrun> {
    let skips = table.word(OVERRUN, &[("skip", true), ("stop", false)]);
    let max_skip = table.count(MAX_SKIP, 1..=1_000_000, period_ns);
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
