//! A plan in words: what `check` prints.

use fieldbeat_core::axis::{
    AxisPlan, FollowingError, Health, HeldBy, InPosition, Load, OwnerLost, StopHow, StopThen, StopTimeout,
};
use fieldbeat_core::bus::desired::{Capabilities, Generator, Velocities};
use fieldbeat_core::bus::last::ROUND_NS;
use fieldbeat_core::bus::{BusFacts, DriveFacts};
use fieldbeat_core::cycle::bound::{Pace, Paced, bound, group, paced_by, silence};
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::cycle::watch::Watch;
use fieldbeat_core::cycle::{CyclePlan, Guard, Overrun, Plan, Shares, Wait};
use fieldbeat_core::rt::{Memory, Realtime};
use fieldbeat_core::time::{Ns, S, nanos};

/// What this plan will do, line by line: the cycle, then each bus and each drive, with the bound of its stop and with
/// what happens if the master dies. A drive that differs from the one before it only in its first line refers to it.
pub fn describe(plan: &Plan) -> Vec<String> {
    let (axes, facts) = (plan.axes(), plan.facts());
    let paced = paced_by(plan, &facts);
    let mut drives = paced.iter();
    let source = plan.source.as_ref().map_or("built in code".to_owned(), |path| path.display().to_string());
    let mut lines = vec![format!("{source}: {}, {}", taking_part(&facts), count(plan.buses.len(), "bus"))];
    let is_guarded = facts.iter().flat_map(|bus| &bus.drives).any(|drive| drive.has_last_resort);
    lines.extend(cycle(&plan.cycle, is_guarded));
    for (bus, facts) in plan.buses.iter().zip(&facts) {
        let mut own = bus.describe(plan.cycle.grid()).into_iter();
        lines.push(format!("bus {}: {}, {}", bus.name(), facts.protocol, taking_part([facts])));
        let mut before: Option<(&str, Vec<String>)> = None;
        for (of, drive) in facts.drives.iter().zip(drives.by_ref()) {
            let paragraph = own.next().unwrap_or_default();
            let mut own_lines = paragraph.lines().map(|line| match line.strip_prefix(DEATH) {
                Some(rest) => DEATH.to_owned() + &guarded(rest.to_owned(), of, drive.axis, &plan.cycle),
                None => line.to_owned(),
            });
            let first = own_lines.next().unwrap_or_default();
            let rest: Vec<String> =
                own_lines.chain(axis(drive, &of.capabilities, &paced, &plan.cycle)).collect();
            let drive = drive.axis;
            match &before {
                Some((like, same)) if *same == rest => {
                    lines.push(format!("  drive {}: {first}; else as {like}", drive.name));
                }
                _ => {
                    lines.push(format!("  drive {}: {first}", drive.name));
                    lines.extend(rest.iter().map(|line| format!("    {line}")));
                    before = Some((&drive.name, rest));
                }
            }
        }
        lines.extend(own);
        let leads = plan.cycle.reference.as_deref() == Some(bus.name());
        lines.extend(facts.has_clock.then(|| clock(leads)));
    }
    lines.push(
        "one master each: another one of this host that has one of these interfaces or drives is named, and \
         the start refused"
            .into(),
    );
    lines.push(black_box(plan));
    for group in &plan.groups {
        let members = axes.iter().filter(|axis| group.axes.contains(&axis.name));
        let bucket = members.clone().map(|axis| axis.health.bucket).min().unwrap_or(0);
        let out = match members.map(|axis| axis.health.leak).max().unwrap_or(0) {
            1 => "each good one takes one out".to_owned(),
            leak => format!("{leak} good ones in a row take one out"),
        };
        lines.push(format!(
            "group {}: {} act in the same cycle, all or none; in motion each round with a missed exchange of any of \
             them puts one into a bucket, {out}, and at {bucket} the group stops",
            group.name,
            group.axes.join(", "),
        ));
    }
    lines.push("Fieldbeat is not a safety function: the machine needs its own STO / emergency stop.".into());
    lines
}

/// What the sentence begins with that every protocol has for each of its drives.
pub(super) const DEATH: &str = "if the master dies: ";

/// What becomes of a drive if the master dies: `rest` by itself, or what its guardian does.
pub(super) fn guarded(rest: String, facts: &DriveFacts, axis: &AxisPlan, cycle: &CyclePlan) -> String {
    let Some(after_ns) = cycle.guardian_after_ns().filter(|_| facts.has_last_resort) else { return rest };
    let (at_once_ns, timeout_ns) = (2 * ROUND_NS, nanos(axis.stop.timeout));
    let requested = format!("its guardian requests the drive's quick stop within {}", Ns(at_once_ns));
    let then = match axis.stop.then {
        StopThen::Disable => "power off",
        StopThen::Hold => "held with power",
    };
    let stop = match (axis.stop.how, axis.stop.on_timeout) {
        (StopHow::Coast, _) => format!("its guardian switches it off within {}", Ns(at_once_ns)),
        (_, StopTimeout::Disable) => format!(
            "stops within {}: {requested}; at standstill {then}, without it after {} power off",
            Ns(at_once_ns + timeout_ns),
            Ns(timeout_ns),
        ),
        (_, StopTimeout::Hold) => format!("{requested}; at standstill {then}, without it powered"),
    };
    let hangs = match after_ns {
        CyclePlan::DEATH_ALONE => "not if the master hangs (watch_after = \"off\")".to_owned(),
        after_ns => format!("{} later if the master hangs", Ns(Watch::latest_ns(after_ns))),
    };
    format!("{stop}; {hangs}; without the guardian: {rest}")
}

/// Drives; where there are none, devices.
fn taking_part<'a>(buses: impl IntoIterator<Item = &'a BusFacts>) -> String {
    let counts = buses.into_iter().map(|bus| (bus.drives.len(), bus.devices.len()));
    match counts.fold((0, 0), |(drives, devices), (more, others)| (drives + more, devices + others)) {
        (0, devices) => count(devices, "device"),
        (drives, _) => count(drives, "drive"),
    }
}

fn count(number: usize, what: &str) -> String {
    let plural = match what {
        _ if number == 1 => "",
        what if what.ends_with('s') => "es",
        _ => "s",
    };
    format!("{number} {what}{plural}")
}

/// The shares with which a run counts as carried.
fn tolerated(Shares { late, skipped, unanswered }: Shares) -> String {
    let shares = [
        (late, "of the cycles begun late"),
        (skipped, "skipped"),
        (unanswered, "of a drive's exchanges unanswered"),
    ];
    let judged = shares.into_iter().filter(|(share, _)| *share < 1.0);
    let judged: Vec<String> = judged.map(|(share, of)| format!("{} % {of}", 100.0 * share)).collect();
    if judged.is_empty() {
        "any share of late cycles".to_owned()
    } else {
        format!("at most {}", judged.join(", "))
    }
}

fn cycle(cycle: &CyclePlan, is_guarded: bool) -> Vec<String> {
    let core = cycle.core.map_or("the last core".to_owned(), |core| format!("core {core}"));
    let memory = match cycle.memory {
        Memory::Process => "all memory of the process locked",
        Memory::Own => "the loop's own memory locked",
    };
    let realtime = match cycle.realtime {
        Realtime::Require => format!("SCHED_FIFO {} required, {memory}", cycle.priority),
        Realtime::Prefer => format!("SCHED_FIFO {} and {memory} if this host grants it", cycle.priority),
        Realtime::Off => "an ordinary thread, not real-time".to_owned(),
    };
    let guard = match cycle.guard {
        Guard::Off => "without a final spin".to_owned(),
        Guard::Fixed(ns) => format!("with a final spin of {}", Ns(ns)),
        Guard::Auto => "with a calibrated final spin".to_owned(),
    };
    let wait = match cycle.wait {
        Wait::Poll => "poll",
        Wait::Spin => "spin",
    };
    let overrun = match cycle.overrun {
        Overrun::Skip { max_skip } if cycle.max_skip_rate >= 1.0 => {
            format!("skips slots and keeps the grid, more than {max_skip} in a row stop all axes")
        }
        Overrun::Skip { max_skip } => format!(
            "skips slots and keeps the grid, more than {max_skip} in a row or {:.0} of the last 100 stop all \
             axes",
            100.0 * cycle.max_skip_rate
        ),
        Overrun::Stop => "stops all axes".to_owned(),
    };
    let mut lines = vec![
        format!(
            "cycle: every {} ({}), on {core}, {realtime}",
            Ns(cycle.period_ns),
            frequency(cycle.period_ns)
        ),
        format!("  wakes {guard}, takes replies by {wait} until {} into the cycle", Ns(cycle.deadline_ns())),
        format!("  an overrun {overrun}"),
        format!("  carried with {}", tolerated(cycle.tolerated)),
    ];
    if let Some(budget) = cycle.task_budget_ns {
        lines.push(format!("  the in-loop task has {} a cycle, more stops all axes", Ns(budget)));
    }
    if let Some(limit) = cycle.heartbeat_ns {
        lines.push(format!("  a silence of the application of {} stops all enabled axes", Ns(limit)));
    }
    lines.push(match cycle.watch_after_ns() {
        Some(after) => format!(
            "  a loop that gives no sign of life for {} is stuck: its watch takes the wires, and the run has \
             failed",
            Ns(after)
        ),
        None => "  nobody watches whether its cycle ends (watch_after = \"off\")".to_owned(),
    });
    lines.extend(is_guarded.then(|| {
        let stops = "  a guardian, a process of its own, stops the LinMot drives if this one dies";
        match cycle.guardian_after_ns() {
            Some(CyclePlan::DEATH_ALONE) => stops.to_owned(),
            Some(after) => format!("{stops}, or gives no sign of life for {}", Ns(after)),
            None => {
                "  no guardian (guardian_after = \"off\"): a LinMot whose master dies moves on, and stays \
                     powered"
                    .to_owned()
            }
        }
    }));
    lines.push(format!(
        "  a cycle that is late by more than {} is counted with its cause",
        Ns(cycle.late_ns())
    ));
    lines
}

/// Which of a bus with a clock and the grid follows the other.
fn clock(leads: bool) -> String {
    let role = match leads {
        true => "leads: the grid follows it ([cycle] reference)",
        false => "follows the grid ([cycle] reference would let it lead)",
    };
    format!("  its clock {role}")
}

fn black_box(plan: &Plan) -> String {
    match plan.black_box_records() {
        0 => "no black box".to_owned(),
        records => format!(
            "the black box holds the last {} in {:.1} MB, written to a file at a fault, a lost drive, \
             another stop, and SIGUSR1",
            Ns(plan.cycle.black_box_ns),
            (records * size_of::<Record>()) as f64 / 1e6
        ),
    }
}

fn frequency(period_ns: u64) -> String {
    let hertz = 1e9 / period_ns as f64;
    let (value, unit) = if hertz < 1000.0 { (hertz, "Hz") } else { (hertz / 1000.0, "kHz") };
    let text = format!("{value:.3}");
    format!("{} {unit}", text.trim_end_matches('0').trim_end_matches('.'))
}

/// What every protocol's axis has: schedule, link, stop, limits.
fn axis(drive: &Paced<'_>, can: &Capabilities, all: &[Paced<'_>], cycle: &CyclePlan) -> Vec<String> {
    let (axis, period_ns) = (drive.axis, cycle.period_ns);
    let mut lines = vec![schedule(drive, period_ns)];
    lines.extend(bucket(&axis.health, period_ns.saturating_mul(axis.divisor.into())));
    lines.extend([link(drive, all, cycle), stop(axis)]);
    lines.extend(load(axis));
    lines.push(setpoints(axis, period_ns));
    lines.extend(owner(axis));
    lines.push(limits(axis));
    if can.lacks.moves.is_none() {
        lines.push(in_position(axis, period_ns));
        lines.push(following_error(axis, can));
    }
    lines
}

fn in_position(axis: &AxisPlan, period_ns: u64) -> String {
    let InPosition { window, reports, timeout } = axis.in_position;
    let Some(window) = window else {
        return "a move is done at the end of its demand, wherever the axis is (in_position.window = \
             \"off\")"
            .into();
    };
    let exchange_ns = period_ns.saturating_mul(axis.divisor.into());
    format!(
        "a move is done within {window} {} of its target for {} ({}); it has failed {} after the end of its \
         demand",
        axis.units.unit,
        count(reports.into(), "exchange"),
        Ns(exchange_ns.saturating_mul(reports.into())),
        Ns(nanos(timeout)),
    )
}

fn following_error(axis: &AxisPlan, can: &Capabilities) -> String {
    let unit = axis.units.unit;
    let by_master = match can.generator {
        Generator::Master(_) => "",
        // The drive watches its own.
        Generator::Drive { velocities: Some(Velocities::Leash(_)) } if can.lacks.rows.is_some() => {
            " of jogs and velocities"
        }
        Generator::Drive { velocities: Some(Velocities::Leash(_)) } => " of rows, jogs and velocities",
        Generator::Drive { .. } if can.lacks.rows.is_none() => " of rows",
        Generator::Drive { .. } => {
            return match axis.limits.following_error {
                FollowingError::Most(most) => format!("stopped by a following error above {most} {unit}"),
                _ => {
                    "its following error is watched by the drive; limits.following_error watches it here, too"
                        .into()
                }
            };
        }
    };
    match (axis.limits.following_error, axis.most_following_error(can.behind_ns)) {
        (FollowingError::Off, _) => {
            "its following error is not watched here (limits.following_error = \"off\")".into()
        }
        (_, None) => {
            "its following error is not watched here: that needs limits.velocity or limits.following_error"
                .into()
        }
        (FollowingError::Most(_), Some(most)) => format!("stopped by a following error above {most} {unit}"),
        (FollowingError::Derived, Some(most)) => {
            format!(
                "stopped by a following error{by_master} above {} {unit} (limits.following_error)",
                rounded(most)
            )
        }
    }
}

/// Three digits are enough for what follows from a rule.
fn rounded(value: f64) -> f64 {
    let scale = 10_f64.powf(2.0 - value.abs().log10().floor());
    if scale.is_finite() { (value * scale).round() / scale } else { value }
}

fn schedule(drive: &Paced<'_>, period_ns: u64) -> String {
    let axis = drive.axis;
    let period = Ns(period_ns.saturating_mul(axis.divisor.into()));
    let every = match axis.divisor {
        1 => format!("an exchange every cycle ({period})"),
        divisor => format!("an exchange every {divisor} cycles ({period}), phase {}", axis.phase),
    };
    let cycles =
        |cycles| format!("{} ({})", count(cycles, "cycle"), Ns(period_ns.saturating_mul(cycles as u64)));
    match drive.pace {
        Pace::Cycle(_) | Pace::Connection(_) => every,
        Pace::HalfDuplex(_, 0) => format!("{every}, over in the cycle in which it is due"),
        Pace::HalfDuplex(_, late) => {
            format!("{every}, over {} later at most: its turn on the wire", cycles(late as usize))
        }
        Pace::OwnClock(fresh) => {
            format!(
                "{every}, whatever its link; a packet of its own clock counts for {}",
                cycles(fresh as usize)
            )
        }
    }
}

fn link(drive: &Paced<'_>, all: &[Paced<'_>], cycle: &CyclePlan) -> String {
    let (health, cycles) = (&drive.axis.health, bound(drive, all));
    let silent = silence(drive, cycle.overrun);
    let names: Vec<&str> = group(drive, all).map(|one| one.axis.name.as_str()).collect();
    let together = match names.len() {
        0 | 1 => String::new(),
        _ => format!("; stop together: {}", names.join(", ")),
    };
    let taken = if let Pace::Connection(_) = drive.pace { ", if it still answers" } else { "" };
    format!(
        "{}: the stop request is on the wire within {cycles} cycles ({}) of the last good exchange{taken}; with slots \
         skipped lost after {} at the latest{together}",
        in_a_row(health.bucket),
        Ns(cycles.saturating_mul(cycle.period_ns)),
        Ns(silent.saturating_mul(cycle.period_ns)),
    )
}

fn in_a_row(misses: u32) -> String {
    match misses {
        1 => "a single miss loses the link".into(),
        misses => format!("{misses} misses in a row lose the link"),
    }
}

/// The rule of a link with an exchange every `every_ns`, and what follows from it.
fn bucket(health: &Health, every_ns: u64) -> [String; 2] {
    let out = match health.leak {
        1 => "each good exchange takes one out".to_owned(),
        leak => format!("{leak} good exchanges in a row take one out"),
    };
    let one_in = health.tolerates_one_in();
    let random = health.exchanges_to_loss(RANDOM_LOSS);
    let exchanges = if random < 1e15 { format!("{:.0}", rounded(random)) } else { "10^15 or more".into() };
    let rule = format!(
        "link up after {} good exchanges in a row; each miss puts one into a bucket, {out}, and at {} the link is lost \
         (health)",
        health.gate, health.bucket,
    );
    let follows = format!(
        "one miss in {one_in} exchanges, evenly spread, never loses it; twice as many do within {} exchanges \
         ({}); with {} % missed at random it lasts for {exchanges} exchanges on average ({})",
        health.lost_at_twice_that(),
        Ns(health.lost_at_twice_that().saturating_mul(every_ns)),
        100.0 * RANDOM_LOSS,
        long(random * every_ns as f64 / S as f64),
    );
    [rule, follows]
}

/// The share of exchanges that a bad network loses at random.
const RANDOM_LOSS: f64 = 0.01;

/// A long time in a unit that fits.
fn long(seconds: f64) -> String {
    const UNITS: [(f64, &str); 4] =
        [(365.25 * 86_400.0, "years"), (86_400.0, "days"), (3_600.0, "h"), (60.0, "min")];
    match UNITS.iter().find(|(unit, _)| seconds >= 2.0 * unit) {
        Some((unit, _)) if seconds > 1e4 * unit => "more than 10000 years".into(),
        Some((unit, name)) => format!("{} {name}", rounded(seconds / unit)),
        None => format!("{} s", rounded(seconds)),
    }
}

fn stop(axis: &AxisPlan) -> String {
    let (stop, unit) = (&axis.stop, axis.units.unit);
    let then = match stop.then {
        StopThen::Hold => "stays powered and in position",
        StopThen::Disable => "power off",
    };
    let late = match stop.on_timeout {
        StopTimeout::Hold => "stays powered",
        StopTimeout::Disable => "power off",
    };
    let how = match stop.how {
        StopHow::Coast => return "stop: power off at once".into(),
        StopHow::Ramp => format!("ramp at {} {unit}/s²", stop.deceleration),
        StopHow::Quick => "the drive's quick stop".into(),
    };
    let timeout_ns = nanos(stop.timeout);
    let without = match stop.how {
        StopHow::Ramp => format!(
            "without it after {} the drive's quick stop, after {} {late}",
            Ns(timeout_ns),
            Ns(timeout_ns.saturating_mul(2))
        ),
        _ => format!("without it after {} {late}", Ns(timeout_ns)),
    };
    format!(
        "stop: {how}; at standstill (below {} {unit}/s for {} exchanges) {then}; {without}",
        stop.standstill, stop.standstill_for,
    )
}

fn load(axis: &AxisPlan) -> Option<String> {
    let Load::Vertical(held_by) = axis.load else { return None };
    Some(match held_by {
        HeldBy::Brake => {
            let late = if axis.stop.on_timeout == StopTimeout::Disable { ", or by the time-out" } else { "" };
            format!(
                "vertical load: power goes off at standstill{late}; set the drive to close its brake before \
                 its power stage goes off"
            )
        }
        HeldBy::Drive => {
            "vertical load: only the powered drive holds it, so the master never powers it off".into()
        }
    })
}

fn setpoints(axis: &AxisPlan, period_ns: u64) -> String {
    let age = u64::from(axis.setpoint_age);
    let jog = match axis.jog_deadman {
        Some(limit) => format!("a jog not renewed for {}", Ns(nanos(limit))),
        None => "a jog runs until something replaces it".into(),
    };
    let velocity = format!(
        "a velocity setpoint older than {} ({})",
        count(axis.setpoint_age as usize, "cycle"),
        Ns(age.saturating_mul(period_ns)),
    );
    match axis.jog_deadman {
        Some(_) => format!("stopped by {velocity} and by {jog}"),
        None => format!("stopped by {velocity}; {jog}"),
    }
}

/// What is left out where a drop stops it.
fn owner(axis: &AxisPlan) -> Option<String> {
    (axis.on_owner_lost == OwnerLost::Finish)
        .then(|| "a program that drops the axis lets it go on to the end of what was commanded".into())
}

fn limits(axis: &AxisPlan) -> String {
    let (limits, unit) = (&axis.limits, axis.units.unit);
    let mut set = Vec::new();
    set.extend(limits.position.map(|(low, high)| format!("{low} ... {high} {unit}")));
    set.extend(limits.velocity.map(|velocity| format!("{velocity} {unit}/s")));
    set.extend(limits.acceleration.map(|acceleration| format!("{acceleration} {unit}/s²")));
    set.extend(limits.homing.map(|velocity| format!("{velocity} {unit}/s while it homes")));
    set.extend(limits.torque.map(|torque| format!("{torque} % of the rated torque")));
    set.extend(limits.step.map(|step| format!("{step} {unit} between two rows")));
    match set.is_empty() {
        true => "limits: only the drive's own".into(),
        false => format!("limits: {}", set.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::Units;
    use fieldbeat_core::time::MS;

    #[test]
    fn what_follows_from_a_rule_is_shown_with_three_digits() {
        let shown = [62.5, 1_052.44, 0.012_345, 0.0, 7e-9].map(|value| rounded(value).to_string());
        assert_eq!(shown, ["62.5", "1050", "0.0123", "0", "0.000000007"]);
    }

    #[test]
    fn the_schedule_of_a_drive_says_when_its_exchanges_end_where_no_reply_ends_them_at_once() {
        let mut axis = AxisPlan::new("x", Units::millimetres(1.0));
        (axis.divisor, axis.phase) = (10, 3);
        let says = |pace| schedule(&Paced { axis: &axis, pace, before_stop: 0 }, MS);
        let every = "an exchange every 10 cycles (10 ms), phase 3";
        assert_eq!(says(Pace::Cycle(1)), every);
        assert_eq!(says(Pace::Connection(20)), every);
        let own_clock = ", whatever its link; a packet of its own clock counts for 30 cycles (30 ms)";
        assert_eq!(says(Pace::OwnClock(30)), format!("{every}{own_clock}"));
        let turn = ", over 1 cycle (1 ms) later at most: its turn on the wire";
        assert_eq!(says(Pace::HalfDuplex(0, 1)), format!("{every}{turn}"));
        assert_eq!(says(Pace::HalfDuplex(0, 0)), format!("{every}, over in the cycle in which it is due"));
    }
}
