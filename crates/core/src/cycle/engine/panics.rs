//! After a panic on the loop's thread: the stop sequence of every axis and the orderly end, by a cycle that does
//! nothing else. And the end of a loop whose wires were taken.
//!
//! The usual cycle is given up with its first panic, whatever its stage. From then on each call of a bus and each step
//! of an axis is guarded by itself. What panics twice is left out: a bus, whose drives then end by their own watchdogs;
//! an axis; or the clock, without which the loop ends at once. So the number of panics is bounded. A panic allocates
//! and prints on this thread: it is the end of the run, and the deadline of a cycle no longer matters.

use std::any::Any;
use std::collections::BTreeMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};

use super::{Engine, Flow, Grid, RUN, STOP};
use crate::axis::{Link, StopCause};
use crate::bus::{Cycle, Exchange, Slot};
use crate::cycle::record::{CycleRecord, Record, Reply, SkippedRecord, Stage, short};
use crate::cycle::window::OpenBus;
use crate::drive::controller::{DriveController, take_commands};
use crate::rt::{Clock, PollSet};
use crate::time::Time;

/// A part of the loop that panics so often is left out.
const MOST: u8 = 2;

/// A bus takes in at most so many batches in one cycle: what all of its drives sent, several times over.
const MOST_LOOKS: u32 = 16;
/// Waits in one window, at most. A turn of a half-duplex wire is some of them, and the shortest takes 100 us.
const MOST_WAITS: u32 = 256;

/// A panic of the loop, for its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoopPanic {
    /// The slot of the first one.
    pub cycle: u64,
    /// The stage, and the bus or axis if one is known.
    pub place: String,
    /// How many there were.
    pub count: u32,
    /// Buses and axes that were left out of the stop, since they panicked again. Their drives end by their own
    /// watchdogs; the watch and the guardian stop those that have none.
    pub left_out: Vec<String>,
    /// The loop ended before the orderly end was complete.
    pub cut_short: bool,
}

impl LoopPanic {
    /// Somebody else has to stop drives of this loop.
    #[doc(hidden)]
    pub fn leaves_drives(&self) -> bool {
        !self.left_out.is_empty() || self.cut_short
    }
}

impl fmt::Display for LoopPanic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let LoopPanic { cycle, place, count, left_out, cut_short } = self;
        write!(f, "internal error: the loop panicked {place} (cycle {cycle}")?;
        if *count > 1 {
            write!(f, ", {count} times in all")?;
        }
        f.write_str("); all axes were stopped and the master ended")?;
        if !left_out.is_empty() {
            write!(f, "; without a stop by the master: {}", left_out.join(", "))?;
        }
        if *cut_short {
            f.write_str("; the stop is not complete: look at the drives")?;
        }
        f.write_str("; please report it with the message of the panic and the black box")
    }
}

/// The part that panicked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Part {
    /// The usual cycle, outside of its buses.
    Loop,
    Bus(usize),
    Axis(usize),
    Clock,
    /// The queues to and from other threads.
    Outlets,
}

/// The panics so far.
#[derive(Debug, Default)]
pub(super) struct Panics {
    /// The slot, and the stage of the usual cycle; `None`: between two cycles.
    pub slot: u64,
    pub stage: Option<Stage>,
    /// Each part is guarded by itself.
    pub each: bool,
    first: Option<(u64, Option<Stage>, Part)>,
    counts: BTreeMap<Part, u8>,
    cut_short: bool,
}

impl Panics {
    /// Whether there was one.
    pub fn any(&self) -> bool {
        !self.counts.is_empty()
    }

    fn note(&mut self, part: Part, payload: Box<dyn Any + Send>) {
        // To drop it may panic again.
        std::mem::forget(payload);
        self.first.get_or_insert((self.slot, self.stage, part));
        self.each = true;
        *self.counts.entry(part).or_default() += 1;
    }

    /// A stop is not complete that the loop alone could complete.
    pub(super) fn leaves_drives(&self) -> bool {
        let left_out = |part: &Part| matches!(part, Part::Bus(_) | Part::Axis(_)) && self.is_left_out(*part);
        self.cut_short || self.counts.keys().any(left_out)
    }

    fn is_left_out(&self, part: Part) -> bool {
        self.counts.get(&part).is_some_and(|count| *count >= MOST)
    }

    /// Runs the work of a part. `None`: it panicked, or it is left out.
    pub fn guard<R>(&mut self, part: Part, work: impl FnOnce() -> R) -> Option<R> {
        if self.is_left_out(part) {
            return None;
        }
        catch_unwind(AssertUnwindSafe(work)).map_err(|payload| self.note(part, payload)).ok()
    }

    /// The same of work that the usual cycle has, too, which gives up as a whole.
    #[inline]
    pub fn run<R>(&mut self, part: Part, work: impl FnOnce() -> R) -> Option<R> {
        if self.each { self.guard(part, work) } else { Some(work()) }
    }
}

impl<C: Clock> Engine<C> {
    /// Runs `turn` of the usual cycle. Its first panic stops all axes and requests the orderly end.
    pub(super) fn guarded(&mut self, turn: impl FnOnce(&mut Engine<C>) -> Flow) -> Flow {
        let slot = self.grid.index();
        let payload = match catch_unwind(AssertUnwindSafe(|| turn(self))) {
            Ok(flow) => return flow,
            Err(payload) => payload,
        };
        let bus = self.buses.iter().position(|open| open.is_at_work);
        let stage = self.panics.stage;
        self.panics.note(bus.map_or(Part::Loop, Part::Bus), payload);
        if self.channels.requested() == RUN {
            self.channels.control.stop();
        }
        let cycle = self.cycle_at(self.grid.index(), self.grid.at());
        let now = self.now_or(cycle.grid);
        self.ending.get_or_insert((now, STOP));
        if self.grid.at() == Time(0) {
            // It was not begun yet.
            self.grid = Grid::new(now + 2 * self.plan.period_ns, self.plan.period_ns);
        }
        // A cycle that was begun is closed, so that no exchange stays open.
        if stage.is_some() && cycle.index == slot {
            if stage.is_some_and(|stage| stage > Stage::Evaluate) {
                // What is due by now is due at the next send.
                self.slots.iter_mut().for_each(|slot| slot.due = false);
            }
            self.judge_all(&cycle, now.max(cycle.deadline));
            self.grid.advance(1);
        }
        let next = self.cycle_at(self.grid.index(), self.grid.at());
        self.stop_each(&next, now, StopCause::Panic);
        self.prepare_stop(&next);
        let record = CycleRecord { index: cycle.index, grid: cycle.grid, ..CycleRecord::default() };
        self.publish_stop(Some(record));
        Flow::Continue
    }

    /// Stops every axis, each guarded by itself.
    fn stop_each(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            self.panics.guard(Part::Axis(axis), || {
                controller.stop(cycle, now, cause);
                controller.take_along();
            });
        }
    }

    /// The end of a loop that has found the wires taken, since a cycle of it did not end: it sends nothing more,
    /// receives nothing, latches every axis and ends.
    #[cold]
    pub(super) fn give_way(&mut self) -> Flow {
        // First, so that whoever has taken them knows that nothing follows.
        self.channels.gate.wires().give_way();
        (self.panics.stage, self.panics.each) = (None, true);
        let cycle = self.cycle_at(self.grid.index(), self.grid.at());
        self.stop_each(&cycle, cycle.grid, StopCause::LoopStuck);
        self.publish_stop(None);
        self.controllers.iter_mut().for_each(DriveController::note_stuck);
        Flow::End
    }

    /// One slot of the grid after a panic.
    pub(super) fn stop_slot(&mut self) -> Flow {
        let mut cycle = self.cycle_at(self.grid.index(), self.grid.at());
        self.sleep(cycle.grid);
        let woke = self.now_or(cycle.grid);
        let late = self.grid.passed(woke, self.deadline_ns / 2);
        if late > 0 {
            self.status.overruns += 1;
            let (first, grid, given_up_ns) = (cycle.index, cycle.grid, woke.since(cycle.grid));
            let late_ns = given_up_ns.max(late.saturating_mul(self.plan.period_ns));
            let skipped =
                SkippedRecord { first, grid, count: late, late_ns, given_up_ns, ..SkippedRecord::default() };
            self.channels.record(Record::Skipped(skipped), &mut self.status.lost_records);
            self.grid.advance(late);
            cycle = self.cycle_at(self.grid.index(), self.grid.at());
            self.prepare_stop(&cycle);
            return self.flow(false);
        }
        for bus in 0..self.buses.len() {
            self.bus(bus, |open, slots| open.exchange(slots, |bus, slots| bus.send(&cycle, slots)));
            if self.panics.is_left_out(Part::Bus(bus)) {
                let open = &self.buses[bus];
                let slots = self.slots[open.first..open.end].iter_mut();
                let due = slots.filter(|slot| slot.due || slot.exchange == Exchange::Queued);
                due.for_each(|slot| slot.exchange = Exchange::Unsent);
            }
        }
        self.status.executed += 1;
        self.take_turns(&cycle);
        // All that comes by the deadline is in the sockets then.
        self.sleep(cycle.deadline);
        for bus in 0..self.buses.len() {
            self.bus(bus, |open, slots| {
                let mut look = || {
                    open.exchange(slots, |bus, slots| {
                        bus.receive(&cycle, slots);
                        slots.iter().any(|slot| slot.exchange.is_waited_for(&cycle))
                    })
                };
                (0..MOST_LOOKS).any(|_| look() != Some(true))
            });
        }
        let now = self.now_or(cycle.deadline);
        let missed = self.judge_all(&cycle, now);
        if let Some(reference) = &mut self.reference {
            let leader = reference.bus();
            let (bus, grid) = (&mut self.buses[leader].bus, &mut self.grid);
            self.panics.guard(Part::Bus(leader), || {
                grid.steer(reference.take(cycle.index, bus.phase_error()).step_ns.into());
            });
        }
        let (controllers, bells) = (&mut self.controllers, &mut self.channels.bells);
        self.panics.guard(Part::Outlets, || take_commands(controllers, bells));
        let ended = self.end(&cycle, now);
        let next = self.cycle_at(cycle.index + 1, self.grid.next_at());
        self.prepare_stop(&next);
        let wake_ns = short(woke.since(cycle.grid));
        self.grid.advance(1);
        let record =
            CycleRecord { index: cycle.index, grid: cycle.grid, wake_ns, missed, ..CycleRecord::default() };
        self.publish_stop(Some(record));
        self.flow(ended)
    }

    /// Polls the half-duplex wires until the deadline, so that what waits for its turn, the stop of each drive, leaves.
    fn take_turns(&mut self, cycle: &Cycle) {
        let polled: Vec<usize> = (0..self.buses.len()).filter(|bus| self.buses[*bus].is_polled).collect();
        let mut poll_set = PollSet::with_room(polled.len());
        for _ in 0..MOST_WAITS {
            let looks: Vec<_> = (polled.iter())
                .filter_map(|bus| {
                    self.bus(*bus, |open, slots| (open.waits(cycle, slots).poll_at, open.bus.fd()))
                })
                .collect();
            let at = looks.iter().map(|(at, _)| *at).min();
            let Some(at) = at.filter(|at| *at < cycle.deadline) else { return };
            poll_set.fill(looks.iter().map(|(_, fd)| *fd));
            let clock = &mut self.clock;
            self.panics.guard(Part::Clock, || {
                if clock.now() < at {
                    clock.wait(&mut poll_set, at);
                }
            });
            let now = self.now_or(cycle.deadline);
            if now >= cycle.deadline {
                return;
            }
            for bus in &polled {
                self.bus(*bus, |open, slots| {
                    open.exchange(slots, |bus, slots| {
                        bus.receive(cycle, slots);
                        if bus.waits(cycle, slots).poll_at <= now {
                            bus.poll(cycle, now, slots);
                        }
                    })
                });
            }
        }
    }

    fn flow(&mut self, ended: bool) -> Flow {
        // Without a clock there is no cycle.
        self.panics.cut_short = !ended && self.panics.is_left_out(Part::Clock);
        if ended || self.panics.cut_short { Flow::End } else { Flow::Continue }
    }

    fn sleep(&mut self, until: Time) {
        self.panics.guard(Part::Clock, || self.clock.sleep_until(until));
    }

    fn now_or(&mut self, otherwise: Time) -> Time {
        self.panics.guard(Part::Clock, || self.clock.now()).unwrap_or(otherwise)
    }

    fn bus<R>(&mut self, bus: usize, work: impl FnOnce(&mut OpenBus, &mut [Slot]) -> R) -> Option<R> {
        self.panics.guard(Part::Bus(bus), || work(&mut self.buses[bus], &mut self.slots))
    }

    /// Evaluates all exchanges; returns how many drives that were online have not answered.
    fn judge_all(&mut self, cycle: &Cycle, now: Time) -> u16 {
        let (mut missed, status) = (0, &mut self.status);
        (status.operational, status.online) = (0, 0);
        for (axis, (controller, slot)) in self.controllers.iter_mut().zip(&mut self.slots).enumerate() {
            self.panics.guard(Part::Axis(axis), || {
                let online = controller.feedback().link == Link::Online;
                let reply = controller.evaluate(cycle, now, slot);
                missed += u16::from(online && reply == Reply::Missed);
                status.operational += u32::from(controller.feedback().is_operational());
                status.online += u32::from(controller.feedback().link == Link::Online);
            });
        }
        missed
    }

    /// Builds the requests of `next`: the stop, or whatever comes after it.
    fn prepare_stop(&mut self, next: &Cycle) {
        for (axis, (controller, slot)) in self.controllers.iter_mut().zip(&mut self.slots).enumerate() {
            let due = self.panics.guard(Part::Axis(axis), || controller.is_due(next.index));
            slot.due = due.unwrap_or(false);
            self.panics.guard(Part::Axis(axis), || controller.propose(next, slot));
        }
        self.build(next);
    }

    fn publish_stop(&mut self, record: Option<CycleRecord>) {
        self.publish_each();
        self.publish_notes();
        let planned = self.grid.planned();
        let (channels, status) = (&mut self.channels, &mut self.status);
        let axes = self.axes.iter_mut().zip(self.controllers.iter().zip(&self.slots));
        self.panics.guard(Part::Outlets, || {
            axes.for_each(|(outlet, (controller, slot))| outlet.numbers.write(&controller.numbers(slot)));
            if let Some(record) = record {
                channels.record(Record::Cycle(record), &mut status.lost_records);
            }
            // A cycle that a panic cut off counts as executed once its requests had left, else as skipped.
            (status.planned, status.skipped) = (planned, planned.saturating_sub(status.executed));
            channels.status.write(status);
        });
    }

    /// The panics of the run in words.
    pub(super) fn loop_panic(&mut self) -> Option<LoopPanic> {
        let (cycle, stage, part) = self.panics.first?;
        let name = |part: Part| match part {
            Part::Bus(index) => Some(format!("bus {}", self.buses[index].info.name)),
            Part::Axis(index) => Some(format!("axis {}", self.axes[index].info.name)),
            Part::Loop | Part::Clock | Part::Outlets => None,
        };
        let during =
            stage.map_or("between two cycles".to_owned(), |stage| format!("in stage {}", stage.name()));
        let place = name(part).map_or(during.clone(), |name| format!("{during}, {name}"));
        let counts = &self.panics.counts;
        let count = counts.values().copied().map(u32::from).sum();
        let left_out = counts.keys().filter(|part| self.panics.is_left_out(**part));
        let left_out = left_out.filter_map(|part| name(*part)).collect();
        Some(LoopPanic { cycle, place, count, left_out, cut_short: self.panics.cut_short })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_that_panics_twice_is_left_out_and_no_other() {
        let mut panics = Panics { slot: 7, stage: Some(Stage::Send), ..Panics::default() };
        let fails = || std::panic::resume_unwind(Box::new("on purpose"));
        for part in [Part::Axis(1), Part::Bus(0), Part::Clock, Part::Outlets] {
            for left_out in [false, false, true] {
                assert_eq!(panics.is_left_out(part), left_out);
                assert_eq!(panics.guard::<()>(part, fails), None);
            }
            assert_eq!(panics.guard(part, || 1), None, "also what would not panic");
        }
        assert_eq!(panics.counts.values().sum::<u8>(), 8);
        assert_eq!(panics.first, Some((7, Some(Stage::Send), Part::Axis(1))));
        for part in [Part::Axis(0), Part::Bus(1)] {
            assert_eq!(panics.guard(part, || 1), Some(1));
        }
    }
}
