//! A plan as one JSON object: what `check --json` prints.

use serde_json::{Value, json};

use super::cycle::{COSTS, MEMORIES, REALTIMES, WAITS};
use super::describe::{DEATH, guarded};
use fieldbeat_core::axis::Load;
use fieldbeat_core::bus::{DriveFacts, ReplyWithin};
use fieldbeat_core::cycle::bound::{Paced, bound, group, paced_by};
use fieldbeat_core::cycle::{CyclePlan, Guard, Overrun, Plan};
use fieldbeat_core::time::nanos;
use fieldbeat_keys::drive::{HOLDERS, HOWS, THENS, TIMEOUTS};
use fieldbeat_keys::error::ConfigError;

/// The plan as one object. Times are in ns, lengths in the drive's `unit`; what is not set is null. The keys are
/// stable:
///
/// - `source`: the file; null for a plan built in code.
/// - `cycle`: `period_ns`, `core` (null: the last one), `priority`, `realtime`, `memory`, `guard` (`"off"`, `"fixed"`
///   or `"auto"`), `guard_ns`, `wait`, `deadline_ns`, `overrun`, `max_skip`, `max_skip_rate`,
///   `max_late_share`, `max_skipped_share`, `max_unanswered_share`, `cost`, `late_ns`, `task_budget_ns`,
///   `heartbeat_ns`, `watch_after_ns`, `guardian`, `guardian_after_ns` (null: once the process has died alone),
///   `reference`, `black_box_ns`.
/// - `buses`: a list of `name`, `protocol`, `has_clock`, and the names of its `drives` and `devices`.
/// - `drives`: a list in slot order of `name`, `bus`, `protocol`, `address`, `unit`, `divisor`, `phase`, `period_ns`
///   (of its exchanges), `reply_within_ns` (on a connection), `stops_with` (the drives that stop together, itself
///   included), `stop_bound_cycles` and `stop_bound_ns` (from the last good exchange of a dead link to the stop
///   request), `stop` (`how`, `deceleration`, `then`, `timeout_ns`, `on_timeout`), `limits` (`position`, `velocity`,
///   `acceleration`, `step`, `torque`), `load`, `held_by`, `drive_watchdog_ns` (if the master dies, the drive stops by
///   itself within this time; null: it does not), and the same in words as `if_master_dies`.
/// - `groups`: a list of `name` and `axes`.
/// - `errors`: why this host cannot carry the plan; empty if it can. Each has `file`, `line`, `key`, `value` and
///   `message`.
pub fn json(plan: &Plan, errors: &[ConfigError]) -> Value {
    let facts = plan.facts();
    let paced = paced_by(plan, &facts);
    let (mut buses, mut drives) = (Vec::new(), Vec::new());
    for (bus, facts) in plan.buses.iter().zip(&facts) {
        let axes = bus.axes();
        buses.push(json!({
            "name": bus.name(),
            "protocol": facts.protocol,
            "has_clock": facts.has_clock,
            "drives": axes.iter().map(|axis| &axis.name).collect::<Vec<_>>(),
            "devices": facts.devices,
        }));
        for (of, lines) in facts.drives.iter().zip(bus.describe(plan.cycle.grid())) {
            let stops = (&paced[drives.len()], &paced[..]);
            drives.push(drive(&plan.cycle, bus.name(), facts.protocol, of, stops, &lines));
        }
    }
    let groups: Vec<Value> =
        plan.groups.iter().map(|group| json!({ "name": group.name, "axes": group.axes })).collect();
    json!({
        "source": plan.source,
        "cycle": cycle(&plan.cycle),
        "buses": buses,
        "drives": drives,
        "groups": groups,
        "errors": errors,
    })
}

fn cycle(cycle: &CyclePlan) -> Value {
    let (guard, guard_ns) = match cycle.guard {
        Guard::Off => ("off", None),
        Guard::Fixed(ns) => ("fixed", Some(ns)),
        Guard::Auto => ("auto", None),
    };
    let (overrun, max_skip) = match cycle.overrun {
        Overrun::Skip { max_skip } => ("skip", Some(max_skip)),
        Overrun::Stop => ("stop", None),
    };
    json!({
        "period_ns": cycle.period_ns,
        "core": cycle.core,
        "priority": cycle.priority,
        "realtime": word(&REALTIMES, cycle.realtime),
        "memory": word(&MEMORIES, cycle.memory),
        "guard": guard,
        "guard_ns": guard_ns,
        "wait": word(&WAITS, cycle.wait),
        "deadline_ns": cycle.deadline_ns(),
        "overrun": overrun,
        "max_skip": max_skip,
        "max_skip_rate": cycle.max_skip_rate,
        "cost": word(&COSTS, cycle.cost),
        "max_late_share": cycle.tolerated.late,
        "max_skipped_share": cycle.tolerated.skipped,
        "max_unanswered_share": cycle.tolerated.unanswered,
        "late_ns": cycle.late_ns(),
        "task_budget_ns": cycle.task_budget_ns,
        "heartbeat_ns": cycle.heartbeat_ns,
        "watch_after_ns": cycle.watch_after_ns(),
        "guardian": cycle.guardian_after_ns().is_some(),
        "guardian_after_ns": cycle.guardian_after_ns().filter(|ns| *ns != CyclePlan::DEATH_ALONE),
        "reference": cycle.reference,
        "black_box_ns": cycle.black_box_ns,
    })
}

/// A drive among all; `lines` are what `check` says of it.
fn drive(
    cycle: &CyclePlan,
    bus: &str,
    protocol: &str,
    facts: &DriveFacts,
    (paced, all): (&Paced<'_>, &[Paced<'_>]),
    lines: &str,
) -> Value {
    let (axis, stop_bound_cycles) = (paced.axis, bound(paced, all));
    let reply_within_ns = if let ReplyWithin::Connection(ns) = facts.reply_within { Some(ns) } else { None };
    let (load, held_by) = match axis.load {
        Load::Level => ("level", None),
        Load::Vertical(held_by) => ("vertical", word(&HOLDERS, held_by)),
    };
    let limits = &axis.limits;
    json!({
        "name": axis.name,
        "bus": bus,
        "protocol": protocol,
        "address": lines.lines().next(),
        "unit": axis.units.unit.to_string(),
        "divisor": axis.divisor,
        "phase": axis.phase,
        "period_ns": cycle.period_ns.saturating_mul(axis.divisor.into()),
        "reply_within_ns": reply_within_ns,
        "stops_with": group(paced, all).map(|one| &one.axis.name).collect::<Vec<_>>(),
        "stop_bound_cycles": stop_bound_cycles,
        "stop_bound_ns": stop_bound_cycles.saturating_mul(cycle.period_ns),
        "stop": {
            "how": word(&HOWS, axis.stop.how),
            "deceleration": axis.stop.deceleration,
            "then": word(&THENS, axis.stop.then),
            "timeout_ns": nanos(axis.stop.timeout),
            "on_timeout": word(&TIMEOUTS, axis.stop.on_timeout),
        },
        "limits": {
            "position": limits.position,
            "velocity": limits.velocity,
            "acceleration": limits.acceleration,
            "step": limits.step,
            "torque": limits.torque,
        },
        "load": load,
        "held_by": held_by,
        "drive_watchdog_ns": facts.watchdog_ns,
        "if_master_dies": lines.lines().find_map(|line| {
            line.strip_prefix(DEATH).map(|rest| guarded(rest.to_owned(), facts, axis, cycle))
        }),
    })
}

/// The word of the configuration for `value`.
fn word<T: PartialEq>(words: &[(&'static str, T)], value: T) -> Option<&'static str> {
    words.iter().find(|(_, meaning)| *meaning == value).map(|(word, _)| *word)
}
