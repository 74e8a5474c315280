//! Group synchronisation: a command of all members waits until each member has it and may begin, and rows are taken
//! by all members or by none.
//!
//! The application pushes one command into each member's queue. The loop may look between two pushes, so an
//! incomplete command is held back until it is complete.

use super::seat::{Closed, Seat};
use crate::axis::{Failure, Outcome, Ticket};
use crate::bus::{Cycle, Slot};
use crate::time::Time;

/// The synchronisation of all groups, each at the index of its first member.
#[derive(Debug)]
pub struct Gates {
    gates: Vec<Gate>,
    /// A group has received a command; until then this module costs nothing.
    used: bool,
}

/// One group in this cycle, and its misses.
#[derive(Clone, Copy, Debug, Default)]
struct Gate {
    /// The call whose commands are counted.
    number: u64,
    /// Commands up to this call have ended at some member before they began.
    dropped: u64,
    /// Members that have the command and may begin.
    waiting: u32,
    /// The call whose rows the members follow ...
    following: u64,
    /// ... the highest number among their next rows ...
    front: u64,
    /// ... and how many members have that row next.
    rows: u32,
    /// Members in motion.
    moving: u32,
    /// Their exchanges that were answered or missed in this cycle ...
    closed: u32,
    /// ... and whether one of them was missed.
    missed: bool,
    /// The health rules of the most sensitive member.
    bucket: u32,
    leak: u32,
    /// The leaky bucket of the group.
    level: u32,
    /// Rounds of exchanges without a miss in a row.
    good: u32,
}

impl Gates {
    /// For a machine of so many axes.
    pub fn new(axes: usize) -> Gates {
        Gates { gates: vec![Gate::default(); axes], used: false }
    }

    /// The memory that it touches besides itself.
    pub fn memory(&self, regions: &mut crate::rt::Regions) {
        regions.add(&*self.gates);
    }

    /// Starts the commands that all members have. One member that cannot begin keeps all others from it.
    pub fn open(&mut self, cycle: &Cycle, now: Time, seats: &mut [Seat], slots: &mut [Slot]) {
        let mut complete = false;
        for seat in seats.iter_mut() {
            if let Some(ticket) = seat.take_dropped()
                && let Some(gate) = self.gates.get_mut(ticket.lead as usize)
            {
                (self.used, gate.dropped) = (true, gate.dropped.max(ticket.number));
            }
        }
        for seat in seats.iter_mut() {
            let Some(ticket) = seat.waiting() else { continue };
            self.used = true;
            let Some(gate) = self.gates.get_mut(ticket.lead as usize) else { continue };
            if ticket.number <= gate.dropped {
                // A stop, or a later command, came while it was pushed to one member after the other.
                seat.end_waiting(cycle, now, Outcome::Failed(Failure::GroupRefused));
                continue;
            }
            if gate.number != ticket.number {
                (gate.number, gate.waiting) = (ticket.number, 0);
            }
            gate.waiting += 1;
            complete |= gate.waiting == ticket.members;
        }
        for lead in 0..self.gates.len() {
            if complete && self.gates[lead].waiting > 0 {
                self.pass(lead, cycle, now, seats, slots);
            }
        }
        if self.used {
            self.gates.iter_mut().for_each(|gate| gate.waiting = 0);
        }
    }

    fn pass(&mut self, lead: usize, cycle: &Cycle, now: Time, seats: &mut [Seat], slots: &mut [Slot]) {
        let gate = self.gates[lead];
        let of_gate = |ticket: Ticket| {
            ticket.lead as usize == lead && ticket.number == gate.number && ticket.members == gate.waiting
        };
        let members = |seat: &Seat| seat.waiting().is_some_and(of_gate);
        let refused =
            seats.iter().any(|seat| members(seat) && seat.waits_for_all() && seat.admits_waiting().is_err());
        for (seat, slot) in seats.iter_mut().zip(slots) {
            if !members(seat) {
                continue;
            }
            match seat.admits_waiting() {
                Ok(()) if !refused => seat.begin_waiting(cycle, now, slot),
                Ok(()) => seat.end_waiting(cycle, now, Outcome::Failed(Failure::GroupRefused)),
                Err(failure) => seat.end_waiting(cycle, now, Outcome::Failed(failure)),
            }
        }
    }

    /// Finds the row that all members have next, and counts the members that have it.
    pub fn count_rows(&mut self, seats: &mut [Seat], slots: &[Slot]) {
        if !self.used {
            return;
        }
        for gate in &mut self.gates {
            (gate.following, gate.front, gate.rows) = (0, 0, 0);
        }
        // The row that the foremost member has next is the least that can be next: earlier rows of the others
        // belong to no common point.
        for find in [true, false] {
            for (seat, _) in seats.iter_mut().zip(slots).filter(|(_, slot)| slot.due) {
                let lead = seat.moves_in_group().map(|ticket| ticket.lead as usize);
                let Some(gate) = lead.and_then(|lead| self.gates.get_mut(lead)) else { continue };
                let from = if find { 0 } else { gate.front };
                let Some((ticket, number)) = seat.offers_row(from) else { continue };
                if find {
                    gate.following = gate.following.max(ticket.number);
                    gate.front = gate.front.max(number);
                } else if ticket.number == gate.following && number == gate.front {
                    gate.rows += 1;
                }
            }
        }
    }

    /// Whether each member of the group of `ticket` has the same row next, as counted last.
    pub fn have_rows(&self, ticket: Ticket) -> bool {
        let gate = self.gates.get(ticket.lead as usize);
        gate.is_some_and(|gate| gate.following == ticket.number && gate.rows == ticket.members)
    }

    /// Fills the buckets of the groups in motion with the misses of their members.
    pub fn judge(&mut self, seats: &mut [Seat]) {
        if !self.used {
            return;
        }
        for gate in &mut self.gates {
            (gate.moving, gate.closed, gate.missed) = (0, 0, false);
        }
        for seat in seats {
            let closed = seat.take_closed();
            let Some(ticket) = seat.moves_in_group() else { continue };
            let Some(gate) = self.gates.get_mut(ticket.lead as usize) else { continue };
            let health = seat.plan().health;
            let first = gate.moving == 0;
            gate.bucket = if first { health.bucket } else { gate.bucket.min(health.bucket) };
            gate.leak = if first { health.leak } else { gate.leak.max(health.leak) };
            gate.moving += 1;
            gate.closed += u32::from(closed.is_some());
            gate.missed |= closed == Some(Closed::Missed);
        }
        self.gates.iter_mut().for_each(Gate::fill);
    }

    /// The first member of a group whose bucket is full; empties it.
    pub fn take_full(&mut self) -> Option<usize> {
        if !self.used {
            return None;
        }
        let lead = self.gates.iter().position(|gate| gate.moving > 0 && gate.level >= gate.bucket)?;
        (self.gates[lead].level, self.gates[lead].moving) = (0, 0);
        Some(lead)
    }
}

impl Gate {
    /// One cycle of the bucket.
    fn fill(&mut self) {
        if self.moving == 0 {
            (self.level, self.good) = (0, 0);
        } else if self.missed {
            // A round counts once: a delay of all members at once is no worse for the group than for each of them.
            self.good = 0;
            self.level += 1;
        } else if self.closed > 0 {
            self.good += 1;
            if self.good >= self.leak {
                self.good = 0;
                self.level = self.level.saturating_sub(1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::cell;
    use crate::axis::{AxisPlan, Command, CommandId, Event, EventKind, Feedback, StopCause, Units, Verb};
    use crate::axis::{Row, StreamRow};
    use crate::cycle::seat::Queues;
    use crate::cycle::seat::tests::{Alone, cycle, plan};
    use crate::rt::{Regions, ring};
    use crate::time::MS;

    /// A member, and the application's ends of its queues.
    fn member(name: &str) -> (Seat, rtrb::Producer<Command>, rtrb::Consumer<Event>) {
        let mut regions = Regions::default();
        let (commands, command_out) = ring(8, &mut regions);
        let (_, rows) = ring(8, &mut regions);
        let (_, setpoints) = crate::axis::newest::newest();
        let (event_in, events) = ring(32, &mut regions);
        let (feedback, _) = cell::cell(Feedback::default());
        let queues = Queues {
            commands: command_out,
            rows,
            setpoints,
            events: event_in,
            room_for_ends: 0,
            feedback,
            samples: None,
        };
        (Seat::new(AxisPlan::new(name, Units::millimetres(1.0)), queues, MS, 0, 100), commands, events)
    }

    /// A reset: it may begin at any time and is done at once.
    fn call(number: u64) -> Command {
        let ticket = Some(Ticket { lead: 0, members: 2, number });
        Command { id: CommandId(number), verb: Verb::Reset, stream: 0, ticket }
    }

    fn outcomes(events: &mut rtrb::Consumer<Event>) -> Vec<(u64, Outcome)> {
        std::iter::from_fn(|| events.pop().ok())
            .filter_map(|event| match event.kind {
                EventKind::Ended { id, outcome, .. } => Some((id.0, outcome)),
                _ => None,
            })
            .collect()
    }

    #[test]
    fn a_call_that_is_half_pushed_waits_and_one_that_was_flushed_at_a_member_is_waited_for_by_none() {
        let ((x, mut to_x, mut of_x), (y, mut to_y, mut of_y)) = (member("x"), member("y"));
        let (mut seats, mut slots) = ([x, y], [Slot::default(), Slot::default()]);
        let mut gates = Gates::new(2);
        let cycle = Cycle { index: 0, grid: Time(0), period_ns: MS, deadline: Time(0) };
        let mut turn = |seats: &mut [Seat; 2]| {
            for (seat, slot) in seats.iter_mut().zip(&mut slots) {
                seat.exchange(&cycle, Time(0), slot);
            }
            gates.open(&cycle, Time(0), seats, &mut slots);
        };
        to_x.push(call(1)).unwrap();
        (0..5).for_each(|_| turn(&mut seats));
        assert_eq!(outcomes(&mut of_x), []);
        to_y.push(call(1)).unwrap();
        turn(&mut seats);
        assert_eq!([outcomes(&mut of_x), outcomes(&mut of_y)], [[(1, Outcome::Done)], [(1, Outcome::Done)]]);

        // The loop stops both between two pushes: the command that reaches y later has no other member to wait for.
        to_x.push(call(2)).unwrap();
        turn(&mut seats);
        for seat in &mut seats {
            seat.stop(&cycle, Time(0), StopCause::Overrun, &mut Slot::default());
        }
        to_y.push(call(2)).unwrap();
        (0..2).for_each(|_| turn(&mut seats));
        assert!(matches!(outcomes(&mut of_x)[..], [(2, Outcome::Aborted(_))]));
        assert_eq!(outcomes(&mut of_y), [(2, Outcome::Failed(Failure::GroupRefused))]);
        // The next call finds no leftovers.
        to_x.push(call(3)).unwrap();
        to_y.push(call(3)).unwrap();
        turn(&mut seats);
        assert_eq!([outcomes(&mut of_x), outcomes(&mut of_y)], [[(3, Outcome::Done)], [(3, Outcome::Done)]]);
    }

    /// One cycle of the commands of all.
    fn turn(gates: &mut Gates, index: u64, seats: &mut [Seat], slots: &mut [Slot]) {
        let cycle = cycle(index);
        for (seat, slot) in seats.iter_mut().zip(&mut *slots) {
            seat.exchange(&cycle, cycle.grid, slot);
        }
        gates.open(&cycle, cycle.grid, seats, slots);
    }

    #[test]
    fn a_stop_waits_two_cycles_for_the_other_members_and_no_longer() {
        let [mut x, mut y] = [plan(), plan()].map(|plan| Alone::new(plan).enabled());
        let (mut seats, mut slots) = ([x.seat, y.seat], [x.slot, y.slot]);
        let mut gates = Gates::new(2);
        let all = |verb, slots: &[Slot; 2]| slots.each_ref().map(|slot| slot.order.verb == Some(verb));
        let stop = Command { verb: Verb::QuickStop, ..call(101) };
        x.commands.push(stop).unwrap();
        turn(&mut gates, 50, &mut seats, &mut slots);
        assert_eq!(all(stop.verb, &slots), [false; 2]);
        y.commands.push(stop).unwrap();
        turn(&mut gates, 51, &mut seats, &mut slots);
        assert_eq!(all(stop.verb, &slots), [true; 2]);
        let off = Command { verb: Verb::Disable, ..call(102) };
        x.commands.push(off).unwrap();
        for (index, begins) in [(60, false), (61, false), (62, true)] {
            turn(&mut gates, index, &mut seats, &mut slots);
            assert_eq!(all(off.verb, &slots), [begins, false], "{index}");
        }
    }

    #[test]
    fn a_complete_call_starts_no_other_group() {
        let mut alone = [(); 4].map(|()| Alone::new(plan()).enabled());
        let ticket = |lead| Some(Ticket { lead, members: 2, number: 7 });
        for (index, lead) in [(0, 0), (1, 0), (3, 2)] {
            let command = Command { verb: Verb::Home, ticket: ticket(lead), ..call(107) };
            alone[index].commands.push(command).unwrap();
        }
        let (mut seats, mut slots): (Vec<_>, Vec<_>) =
            alone.into_iter().map(|alone| (alone.seat, alone.slot)).unzip();
        turn(&mut Gates::new(4), 50, &mut seats, &mut slots);
        let homes: Vec<_> = slots.iter().map(|slot| slot.order.verb == Some(Verb::Home)).collect();
        assert_eq!(homes, [true, true, false, false]);
    }

    #[test]
    fn rows_of_a_group_are_there_once_each_member_has_the_same_one_next() {
        let row = |number| StreamRow { stream: 0, number, row: Row::default() };
        for (of_x, of_y, there) in [
            (&[][..], &[][..], false),
            (&[1], &[], false),
            (&[], &[1], false),
            (&[1], &[1], true),
            (&[1, 2], &[2], true),
            (&[2], &[1], false),
            (&[2], &[1, 3], false),
        ] {
            let [mut x, mut y] = [plan(), plan()].map(|plan| Alone::new(plan).enabled());
            let follow = Command { verb: Verb::Follow, ..call(101) };
            for (one, rows) in [(&mut x, of_x), (&mut y, of_y)] {
                one.commands.push(follow).unwrap();
                rows.iter().for_each(|number| one.rows.push(row(*number)).unwrap());
                one.slot.due = true;
            }
            let (mut seats, mut slots) = ([x.seat, y.seat], [x.slot, y.slot]);
            let mut gates = Gates::new(2);
            turn(&mut gates, 50, &mut seats, &mut slots);
            gates.count_rows(&mut seats, &slots);
            assert_eq!(gates.have_rows(follow.ticket.unwrap()), there, "{of_x:?} {of_y:?}");
            for (seat, slot) in seats.iter_mut().zip(&mut slots) {
                seat.feed(&cycle(51), Time(51 * MS), slot, &gates);
            }
            assert_eq!(slots.each_ref().map(|slot| slot.row.is_some()), [there; 2], "{of_x:?} {of_y:?}");
        }
    }

    #[test]
    fn rows_of_an_earlier_stream_are_dropped_and_those_of_a_later_one_are_left() {
        let row = |stream, number| StreamRow { stream, number, row: Row::default() };
        for (rows, offered) in [
            ([row(0, 5), row(1, 6)], Some(6)),
            ([row(1, 6), row(2, 7)], Some(6)),
            ([row(2, 6), row(2, 7)], None),
        ] {
            let mut x = Alone::new(plan()).enabled();
            let follow = Command { verb: Verb::Follow, stream: 1, ..call(101) };
            x.commands.push(follow).unwrap();
            rows.into_iter().for_each(|row| x.rows.push(row).unwrap());
            let mut other = Alone::new(plan()).enabled();
            other.commands.push(follow).unwrap();
            let (mut seats, mut slots) = ([x.seat, other.seat], [x.slot, other.slot]);
            turn(&mut Gates::new(2), 50, &mut seats, &mut slots);
            assert_eq!(seats[0].offers_row(0).map(|(_, number)| number), offered);
        }
    }

    #[test]
    fn the_misses_of_one_motion_are_not_counted_in_the_next() {
        let mut gate = Gate { moving: 2, bucket: 4, leak: 1_000, ..Gate::default() };
        for _ in 0..3 {
            (gate.closed, gate.missed) = (2, true);
            gate.fill();
        }
        assert_eq!(gate.level, 3);
        gate.moving = 0;
        gate.fill();
        assert_eq!((gate.level, gate.good), (0, 0));
    }
}
