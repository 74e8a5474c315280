//! How long it takes from the loss of a drive to the stop request on the wire: what `check` states, tests prove and
//! the loop itself keeps to.

use super::plan::{Overrun, Plan};
use crate::axis::AxisPlan;
use crate::bus::facts::of_drives;
use crate::bus::{BusFacts, DriveFacts, Grid, ReplyWithin};

/// When the exchanges of a drive end, and when the next one can begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// A reply counts for so many cycles after the one that requested it, and the next request does not wait for it.
    Cycle(u64),
    /// On a connection: a reply counts for so many cycles after the one that requested it, and the next request waits
    /// for it.
    Connection(u64),
    /// On a half-duplex wire: so many cycles after the one in which it was due the request of an exchange leaves, and
    /// the exchange is over, at the latest. The next request waits for that.
    HalfDuplex(u64, u64),
    /// The drive sends by its own clock: a packet counts for so many cycles. Requests leave at the agreed rate only.
    OwnClock(u64),
}

/// An axis and how its exchanges follow each other.
#[derive(Clone, Copy, Debug)]
pub struct Paced<'a> {
    /// The axis.
    pub axis: &'a AxisPlan,
    /// When its exchanges end.
    pub pace: Pace,
    /// The number of requests that leave before one with a stop.
    pub before_stop: u32,
}

impl<'a> Paced<'a> {
    /// Axis `axis`, of whose drive this is known.
    pub fn of(grid: Grid, drive: &DriveFacts, axis: &'a AxisPlan) -> Paced<'a> {
        let period_ns = grid.period_ns.max(1);
        let pace = match drive.reply_within {
            ReplyWithin::Cycles(cycles) => Pace::Cycle(u64::from(cycles.saturating_sub(1))),
            ReplyWithin::Connection(ns) => Pace::Connection(grid.cycles_behind(ns)),
            ReplyWithin::Turn { request_ns, end_ns } => {
                Pace::HalfDuplex(grid.in_window(request_ns) / period_ns, grid.cycles_behind(end_ns))
            }
            // Its age counts from a packet that may have come in the window, to a later grid point.
            ReplyWithin::OwnClock(ns) => Pace::OwnClock(ns.div_ceil(period_ns)),
        };
        Paced { axis, pace, before_stop: drive.before_stop }
    }

    fn divisor(&self) -> u64 {
        self.axis.divisor.max(1).into()
    }

    /// The most cycles between two exchanges: one that has not ended is waited for, and the next one has its turn then.
    fn turn(&self) -> u64 {
        let waits = matches!(self.pace, Pace::Connection(_) | Pace::HalfDuplex(..));
        let open = if waits { self.late() } else { 0 };
        (open / self.divisor()).saturating_add(1).saturating_mul(self.divisor())
    }

    /// The most cycles from the slot of an exchange until it is known to be missed. Of a drive with its own clock: from
    /// the first slot after its last packet.
    fn late(&self) -> u64 {
        let (Pace::Cycle(cycles)
        | Pace::Connection(cycles)
        | Pace::HalfDuplex(_, cycles)
        | Pace::OwnClock(cycles)) = self.pace;
        cycles
    }

    /// The most cycles from the slot of an exchange until its request is on the wire.
    fn queued(&self) -> u64 {
        if let Pace::HalfDuplex(cycles, _) = self.pace { cycles } else { 0 }
    }

    /// The most cycles from the last good exchange to the one that is known to fill the bucket.
    fn filled(&self) -> u64 {
        let misses = u64::from(self.axis.health.bucket.saturating_sub(1)).saturating_mul(self.turn());
        self.divisor().saturating_add(misses).saturating_add(self.late())
    }

    /// The most cycles from the loss to the next turn of `other`. On a half-duplex wire an exchange that is missed
    /// began in an own slot, and divisors and phases say which slots of `other` follow.
    fn turn_of(&self, other: &Paced<'_>) -> u64 {
        let Pace::HalfDuplex(_, late) = self.pace else { return other.turn() };
        let slot = |of: &Paced<'_>, count: u64| u64::from(of.axis.phase) + count * of.divisor();
        let since = |count: u64| {
            let lost = slot(self, count) + late + other.divisor();
            lost.saturating_sub(slot(other, 0)) % other.divisor()
        };
        other.turn() - (0..other.divisor()).map(since).min().unwrap_or(0)
    }

    /// The most cycles from the loss to the stop request on the wire.
    fn stops(&self) -> u64 {
        let next = if let Pace::OwnClock(_) = self.pace { self.divisor() } else { 1 };
        // A repetition in progress holds up no stop of a drive that is lost: it has failed, and the request behind it
        // is new to the drive, whatever that has received.
        let ahead = if let Pace::HalfDuplex(..) = self.pace { 0 } else { self.ahead_of_stop() };
        next.saturating_add(self.queued()).saturating_add(ahead)
    }

    /// The cycles of the requests that leave before one with a stop.
    fn ahead_of_stop(&self) -> u64 {
        u64::from(self.before_stop).saturating_mul(self.turn())
    }
}

/// All axes of `plan`, in slot order.
pub fn paced(plan: &Plan) -> Vec<Paced<'_>> {
    paced_by(plan, &plan.facts())
}

/// The same, of whose buses this is known.
pub fn paced_by<'a>(plan: &'a Plan, facts: &[BusFacts]) -> Vec<Paced<'a>> {
    let axes = plan.axes().into_iter().zip(of_drives(facts));
    axes.map(|(axis, (_, drive))| Paced::of(plan.cycle.grid(), drive, axis)).collect()
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
/// turn. The lost drive is then requested to stop in the very next cycle, or in its own next turn if it is sent its
/// requests at an agreed rate, and each other member of the group in its own next turn. On a half-duplex wire the
/// request waits for the turns of the others.
pub fn stop_bound(plan: &Plan, index: usize) -> u64 {
    let all = paced(plan);
    all.get(index).map_or(0, |drive| bound(drive, &all))
}

/// The same, for one drive among all.
pub fn bound(drive: &Paced<'_>, all: &[Paced<'_>]) -> u64 {
    let others = group(drive, all).filter(|one| one.axis.name != drive.axis.name);
    let others = others
        .map(|one| drive.turn_of(one).saturating_add(one.queued()).saturating_add(one.ahead_of_stop()))
        .max()
        .unwrap_or(0);
    drive.filled().saturating_add(others.max(drive.stops()))
}

/// A link is lost so many slots after the last good exchange at the latest, however few of them were executed: twice
/// the time in which its misses fill the bucket, and one hold-up of the loop that is allowed.
pub fn silence(drive: &Paced<'_>, overrun: Overrun) -> u64 {
    let held_up = match overrun {
        Overrun::Skip { max_skip } => max_skip,
        Overrun::Stop => 0,
    };
    drive.filled().saturating_mul(2).saturating_add(held_up)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::Units;

    #[test]
    fn a_loss_ends_in_a_stop_request_after_the_misses_and_the_turns_of_each_wire() {
        let axis = |name: &str, divisor, group| {
            let mut axis = AxisPlan::new(name, Units::millimetres(1.0));
            (axis.divisor, axis.health.bucket, axis.stop.group) = (divisor, 3, group);
            axis
        };
        let (x, y) = (axis("x", 4, Some(1)), axis("y", 2, Some(1)));
        let alone = axis("alone", 4, None);
        let bound_of = |pace, of_y| {
            let paced = |axis, pace| Paced { axis, pace, before_stop: 0 };
            let (x, alone) = (paced(&x, pace), paced(&alone, pace));
            let all = [x, paced(&y, of_y), alone];
            [bound(&x, &all), bound(&alone, &all)]
        };
        // Three misses, each known in its own cycle; the stop of y leaves in its next turn, that of x in the next
        // cycle.
        let cycle = Pace::Cycle(0);
        assert_eq!(bound_of(cycle, cycle), [4 + 2 * 4 + 2, 4 + 2 * 4 + 1]);
        // Each miss is known 5 cycles later, and no request waits for that.
        assert_eq!(bound_of(Pace::Cycle(5), cycle), [4 + 2 * 4 + 5 + 2, 4 + 2 * 4 + 5 + 1]);
        assert_eq!(bound_of(cycle, Pace::Cycle(5)), bound_of(cycle, cycle));
        // Each miss is known 5 cycles later, and the next request waits for that.
        assert_eq!(bound_of(Pace::Connection(5), cycle), [4 + 2 * 8 + 5 + 2, 4 + 2 * 8 + 5 + 1]);
        // The stop waits for its turn as well.
        let turn = Pace::HalfDuplex(3, 5);
        assert_eq!(bound_of(turn, cycle), [4 + 2 * 8 + 5 + 4, 4 + 2 * 8 + 5 + 4]);
        assert_eq!(bound_of(cycle, turn), [4 + 2 * 4 + 6 + 3, 4 + 2 * 4 + 1]);
        // What a drive of the group is sent counts with its next new request; what the lost one is sent is new.
        let of = |axis, before_stop| Paced { axis, pace: Pace::HalfDuplex(0, 0), before_stop };
        let all = [of(&x, 1), of(&y, 1), of(&alone, 1)];
        assert_eq!([bound(&all[0], &all), bound(&all[2], &all)], [4 + 2 * 4 + 2 + 2, 4 + 2 * 4 + 1]);
        // The miss is known 5 cycles behind a slot of 4: in one of the next two, and y has slots in each second one.
        let y = axis("y", 2, Some(1));
        for (phase, next) in [(0, 1), (1, 2)] {
            let (mut x, mut y) = (axis("x", 8, Some(1)), y.clone());
            (x.phase, y.phase) = (0, phase);
            let of = |axis, late| Paced { axis, pace: Pace::HalfDuplex(0, late), before_stop: 0 };
            let all = [of(&x, 5), of(&y, 1)];
            assert_eq!(bound(&all[0], &all), 8 + 2 * 8 + 5 + next, "{phase}");
        }
        // The last packet counts for 7 cycles, and the stop leaves in the next own slot.
        assert_eq!(bound_of(Pace::OwnClock(7), cycle), [4 + 2 * 4 + 7 + 4, 4 + 2 * 4 + 7 + 4]);
    }
}
