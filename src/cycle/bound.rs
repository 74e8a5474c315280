//! How long it takes from the loss of a drive to the stop request on the wire: what `check` states, tests prove and
//! the loop itself keeps to.

use super::plan::{CyclePlan, Overrun, Plan};
use crate::axis::AxisPlan;
use crate::bus::BusPlan;

/// An axis and how its exchanges follow each other.
#[derive(Clone, Copy, Debug)]
pub struct Paced<'a> {
    /// The axis.
    pub axis: &'a AxisPlan,
    /// For so many cycles behind the one that asked a reply counts, on a connection. `None`: there is none, and replies
    /// come in the cycle that asks.
    pub owed: Option<u64>,
}

impl<'a> Paced<'a> {
    /// Axis `index` of `bus`.
    pub fn of(cycle: &CyclePlan, bus: &dyn BusPlan, index: usize, axis: &'a AxisPlan) -> Paced<'a> {
        let owed =
            |within_ns: u64| within_ns.saturating_sub(cycle.deadline_ns()).div_ceil(cycle.period_ns.max(1));
        Paced { axis, owed: bus.reply_within_ns(index).map(owed) }
    }

    /// The most cycles between two requests: one whose reply is owed is waited for, and the next one has its turn then.
    fn turn(&self) -> u64 {
        let divisor = u64::from(self.axis.divisor.max(1));
        (self.owed.unwrap_or(0) / divisor).saturating_add(1).saturating_mul(divisor)
    }
}

/// All axes of `plan`, in slot order.
pub fn paced(plan: &Plan) -> Vec<Paced<'_>> {
    plan.buses
        .iter()
        .flat_map(|bus| {
            let axes = bus.axes().into_iter().enumerate();
            axes.map(move |(index, axis)| Paced::of(&plan.cycle, &**bus, index, axis))
        })
        .collect()
}

/// The drives that stop when `drive` does, itself included.
pub fn group<'a>(drive: &'a Paced<'a>, all: &'a [Paced<'a>]) -> impl Iterator<Item = &'a Paced<'a>> {
    let group = drive.axis.stop.group;
    all.iter().filter(move |one| {
        one.axis.name == drive.axis.name || group.is_some() && one.axis.stop.group == group
    })
}

/// A dead link stops axis `index` of `plan` and its group: at most so many cycles lie between the cycle that took in
/// its last good reply and the one that has sent every stop request, as far as connections take them.
///
/// `bucket` exchanges are missed first. Each is judged when its reply no longer counts, and the next one follows in its
/// turn. The lost drive is then asked in the very next cycle, and each other member of the group in its own next turn.
pub fn stop_bound(plan: &Plan, index: usize) -> u64 {
    let all = paced(plan);
    all.get(index).map_or(0, |drive| bound(drive, &all))
}

/// The same for `axis` among `all`, whose replies come in the cycle that asks.
pub fn stop_bound_cycles(axis: &AxisPlan, all: &[&AxisPlan]) -> u64 {
    let all: Vec<Paced<'_>> = all.iter().map(|axis| Paced { axis, owed: None }).collect();
    bound(&Paced { axis, owed: None }, &all)
}

/// The names of the drives that stop when that of slot `index` does, itself included.
pub fn stopping_with(plan: &Plan, index: usize) -> Vec<String> {
    let all = paced(plan);
    let with = all.get(index).into_iter().flat_map(|drive| group(drive, &all));
    with.map(|one| one.axis.name.clone()).collect()
}

/// The same, for one drive among all.
pub fn bound(drive: &Paced<'_>, all: &[Paced<'_>]) -> u64 {
    let Paced { axis, owed } = drive;
    let others = group(drive, all).filter(|one| one.axis.name != axis.name);
    let slowest = others.map(Paced::turn).max().unwrap_or(1);
    let misses = u64::from(axis.health.bucket.saturating_sub(1)).saturating_mul(drive.turn());
    u64::from(axis.divisor).saturating_add(misses).saturating_add(owed.unwrap_or(0)).saturating_add(slowest)
}

/// A link is lost so many slots after the last good exchange at the latest, however few of them were executed: twice
/// the time in which its misses fill the bucket, and one hold-up of the loop that is allowed.
pub fn silence(drive: &Paced<'_>, overrun: Overrun) -> u64 {
    let Paced { axis, owed } = drive;
    let misses = u64::from(axis.health.bucket.saturating_sub(1)).saturating_mul(drive.turn());
    let filled = u64::from(axis.divisor).saturating_add(misses).saturating_add(owed.unwrap_or(0));
    let held_up = match overrun {
        Overrun::Skip { max_skip } => max_skip,
        Overrun::Stop => 0,
    };
    filled.saturating_mul(2).saturating_add(held_up)
}
