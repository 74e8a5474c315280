//! Group synchronisation: a command of all members waits until each member has it and may begin, and rows are taken
//! by all members or by none.
//!
//! The application pushes one command into each member's queue. The loop may look between two pushes, so an
//! incomplete command is held back until it is complete.

use super::controller::{Closed, DriveController};
use crate::axis::{Failure, Outcome, Ticket};
use crate::bus::{Cycle, Slot};
use crate::time::Time;

/// The synchronisation of all groups, each at the index of its first member.
#[derive(Debug)]
pub struct GroupSync {
    groups: Vec<GroupState>,
    /// A group has received a command; until then this module costs nothing.
    used: bool,
}

/// One group in this cycle, and its misses.
#[derive(Clone, Copy, Debug, Default)]
struct GroupState {
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

impl GroupSync {
    /// For a machine of so many axes.
    pub fn new(axes: usize) -> GroupSync {
        GroupSync { groups: vec![GroupState::default(); axes], used: false }
    }

    /// The memory that it touches besides itself.
    pub fn memory(&self, regions: &mut crate::rt::Regions) {
        regions.add(&*self.groups);
    }

    /// Starts the commands that all members have. One member that cannot begin keeps all others from it.
    pub fn open(
        &mut self,
        cycle: &Cycle,
        now: Time,
        controllers: &mut [DriveController],
        slots: &mut [Slot],
    ) {
        let mut complete = false;
        for controller in controllers.iter_mut() {
            if let Some(ticket) = controller.take_dropped()
                && let Some(group) = self.groups.get_mut(ticket.lead as usize)
            {
                (self.used, group.dropped) = (true, group.dropped.max(ticket.number));
            }
        }
        for controller in controllers.iter_mut() {
            let Some(ticket) = controller.waiting() else { continue };
            self.used = true;
            let Some(group) = self.groups.get_mut(ticket.lead as usize) else { continue };
            if ticket.number <= group.dropped {
                // A stop, or a later command, came while it was pushed to one member after the other.
                controller.end_waiting(cycle, now, Outcome::Failed(Failure::GroupRefused));
                continue;
            }
            if group.number != ticket.number {
                (group.number, group.waiting) = (ticket.number, 0);
            }
            group.waiting += 1;
            complete |= group.waiting == ticket.members;
        }
        for lead in 0..self.groups.len() {
            if complete && self.groups[lead].waiting > 0 {
                self.pass(lead, cycle, now, controllers, slots);
            }
        }
        if self.used {
            self.groups.iter_mut().for_each(|group| group.waiting = 0);
        }
    }

    fn pass(
        &mut self,
        lead: usize,
        cycle: &Cycle,
        now: Time,
        controllers: &mut [DriveController],
        slots: &mut [Slot],
    ) {
        let group = self.groups[lead];
        let of_gate = |ticket: Ticket| {
            ticket.lead as usize == lead && ticket.number == group.number && ticket.members == group.waiting
        };
        let members = |controller: &DriveController| controller.waiting().is_some_and(of_gate);
        let refused = controllers.iter().any(|controller| {
            members(controller) && controller.waits_for_all() && controller.admits_waiting().is_err()
        });
        for (controller, slot) in controllers.iter_mut().zip(slots) {
            if !members(controller) {
                continue;
            }
            match controller.admits_waiting() {
                Ok(()) if !refused => controller.begin_waiting(cycle, now, slot),
                Ok(()) => controller.end_waiting(cycle, now, Outcome::Failed(Failure::GroupRefused)),
                Err(failure) => controller.end_waiting(cycle, now, Outcome::Failed(failure)),
            }
        }
    }

    /// Finds the row that all members have next, and counts the members that have it.
    pub fn count_rows(&mut self, controllers: &mut [DriveController], slots: &[Slot]) {
        if !self.used {
            return;
        }
        for group in &mut self.groups {
            (group.following, group.front, group.rows) = (0, 0, 0);
        }
        // The row that the foremost member has next is the least that can be next: earlier rows of the others
        // belong to no common point.
        for find in [true, false] {
            for (controller, _) in controllers.iter_mut().zip(slots).filter(|(_, slot)| slot.due) {
                let lead = controller.moves_in_group().map(|ticket| ticket.lead as usize);
                let Some(group) = lead.and_then(|lead| self.groups.get_mut(lead)) else { continue };
                let from = if find { 0 } else { group.front };
                let Some((ticket, number)) = controller.offers_row(from) else { continue };
                if find {
                    group.following = group.following.max(ticket.number);
                    group.front = group.front.max(number);
                } else if ticket.number == group.following && number == group.front {
                    group.rows += 1;
                }
            }
        }
    }

    /// Whether each member of the group of `ticket` has the same row next, as counted last.
    pub fn have_rows(&self, ticket: Ticket) -> bool {
        let group = self.groups.get(ticket.lead as usize);
        group.is_some_and(|group| group.following == ticket.number && group.rows == ticket.members)
    }

    /// Fills the buckets of the groups in motion with the misses of their members.
    pub fn judge(&mut self, controllers: &mut [DriveController]) {
        if !self.used {
            return;
        }
        for group in &mut self.groups {
            (group.moving, group.closed, group.missed) = (0, 0, false);
        }
        for controller in controllers {
            let closed = controller.take_closed();
            let Some(ticket) = controller.moves_in_group() else { continue };
            let Some(group) = self.groups.get_mut(ticket.lead as usize) else { continue };
            let health = controller.plan().health;
            let first = group.moving == 0;
            group.bucket = if first { health.bucket } else { group.bucket.min(health.bucket) };
            group.leak = if first { health.leak } else { group.leak.max(health.leak) };
            group.moving += 1;
            group.closed += u32::from(closed.is_some());
            group.missed |= closed == Some(Closed::Missed);
        }
        self.groups.iter_mut().for_each(GroupState::fill);
    }

    /// The first member of a group whose bucket is full; empties it.
    pub fn take_full(&mut self) -> Option<usize> {
        if !self.used {
            return None;
        }
        let lead = self.groups.iter().position(|group| group.moving > 0 && group.level >= group.bucket)?;
        (self.groups[lead].level, self.groups[lead].moving) = (0, 0);
        Some(lead)
    }
}

impl GroupState {
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
    use crate::axis::{
        AxisPlan, Command, CommandId, Event, EventKind, Feedback, QueuedCommand, StopCause, Units,
    };
    use crate::axis::{Row, StreamRow};
    use crate::drive::controller::Queues;
    use crate::drive::controller::tests::{Alone, cycle, plan};
    use crate::rt::{Regions, ring};
    use crate::time::MS;

    /// A member, and the application's ends of its queues.
    fn member(name: &str) -> (DriveController, rtrb::Producer<QueuedCommand>, rtrb::Consumer<Event>) {
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
        (
            DriveController::new(AxisPlan::new(name, Units::millimetres(1.0)), queues, MS, 0, 100, false),
            commands,
            events,
        )
    }

    /// A reset: it may begin at any time and is done at once.
    fn call(number: u64) -> QueuedCommand {
        let ticket = Some(Ticket { lead: 0, members: 2, number });
        QueuedCommand { id: CommandId(number), verb: Command::Reset, stream: 0, ticket }
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
        let (mut controllers, mut slots) = ([x, y], [Slot::default(), Slot::default()]);
        let mut groups = GroupSync::new(2);
        let cycle = Cycle { index: 0, grid: Time(0), period_ns: MS, deadline: Time(0) };
        let mut turn = |controllers: &mut [DriveController; 2]| {
            for (controller, slot) in controllers.iter_mut().zip(&mut slots) {
                controller.exchange(&cycle, Time(0), slot);
            }
            groups.open(&cycle, Time(0), controllers, &mut slots);
        };
        to_x.push(call(1)).unwrap();
        (0..5).for_each(|_| turn(&mut controllers));
        assert_eq!(outcomes(&mut of_x), []);
        to_y.push(call(1)).unwrap();
        turn(&mut controllers);
        assert_eq!([outcomes(&mut of_x), outcomes(&mut of_y)], [[(1, Outcome::Done)], [(1, Outcome::Done)]]);

        // The loop stops both between two pushes: the command that reaches y later has no other member to wait for.
        to_x.push(call(2)).unwrap();
        turn(&mut controllers);
        for controller in &mut controllers {
            controller.stop(&cycle, Time(0), StopCause::Overrun, &mut Slot::default());
        }
        to_y.push(call(2)).unwrap();
        (0..2).for_each(|_| turn(&mut controllers));
        assert!(matches!(outcomes(&mut of_x)[..], [(2, Outcome::Aborted(_))]));
        assert_eq!(outcomes(&mut of_y), [(2, Outcome::Failed(Failure::GroupRefused))]);
        // The next call finds no leftovers.
        to_x.push(call(3)).unwrap();
        to_y.push(call(3)).unwrap();
        turn(&mut controllers);
        assert_eq!([outcomes(&mut of_x), outcomes(&mut of_y)], [[(3, Outcome::Done)], [(3, Outcome::Done)]]);
    }

    /// One cycle of the commands of all.
    fn turn(groups: &mut GroupSync, index: u64, controllers: &mut [DriveController], slots: &mut [Slot]) {
        let cycle = cycle(index);
        for (controller, slot) in controllers.iter_mut().zip(&mut *slots) {
            controller.exchange(&cycle, cycle.grid, slot);
        }
        groups.open(&cycle, cycle.grid, controllers, slots);
    }

    #[test]
    fn a_stop_waits_two_cycles_for_the_other_members_and_no_longer() {
        let [mut x, mut y] = [plan(), plan()].map(|plan| Alone::new(plan).enabled());
        let (mut controllers, mut slots) = ([x.controller, y.controller], [x.slot, y.slot]);
        let mut groups = GroupSync::new(2);
        let all = |verb, slots: &[Slot; 2]| slots.each_ref().map(|slot| slot.order.verb == Some(verb));
        let stop = QueuedCommand { verb: Command::QuickStop, ..call(101) };
        x.commands.push(stop).unwrap();
        turn(&mut groups, 50, &mut controllers, &mut slots);
        assert_eq!(all(stop.verb, &slots), [false; 2]);
        y.commands.push(stop).unwrap();
        turn(&mut groups, 51, &mut controllers, &mut slots);
        assert_eq!(all(stop.verb, &slots), [true; 2]);
        let off = QueuedCommand { verb: Command::Disable, ..call(102) };
        x.commands.push(off).unwrap();
        for (index, begins) in [(60, false), (61, false), (62, true)] {
            turn(&mut groups, index, &mut controllers, &mut slots);
            assert_eq!(all(off.verb, &slots), [begins, false], "{index}");
        }
    }

    #[test]
    fn a_complete_call_starts_no_other_group() {
        let mut alone = [(); 4].map(|()| Alone::new(plan()).enabled());
        let ticket = |lead| Some(Ticket { lead, members: 2, number: 7 });
        for (index, lead) in [(0, 0), (1, 0), (3, 2)] {
            let command = QueuedCommand { verb: Command::Home, ticket: ticket(lead), ..call(107) };
            alone[index].commands.push(command).unwrap();
        }
        let (mut controllers, mut slots): (Vec<_>, Vec<_>) =
            alone.into_iter().map(|alone| (alone.controller, alone.slot)).unzip();
        turn(&mut GroupSync::new(4), 50, &mut controllers, &mut slots);
        let homes: Vec<_> = slots.iter().map(|slot| slot.order.verb == Some(Command::Home)).collect();
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
            let follow = QueuedCommand { verb: Command::Follow, ..call(101) };
            for (one, rows) in [(&mut x, of_x), (&mut y, of_y)] {
                one.commands.push(follow).unwrap();
                rows.iter().for_each(|number| one.rows.push(row(*number)).unwrap());
                one.slot.due = true;
            }
            let (mut controllers, mut slots) = ([x.controller, y.controller], [x.slot, y.slot]);
            let mut groups = GroupSync::new(2);
            turn(&mut groups, 50, &mut controllers, &mut slots);
            groups.count_rows(&mut controllers, &slots);
            assert_eq!(groups.have_rows(follow.ticket.unwrap()), there, "{of_x:?} {of_y:?}");
            for (controller, slot) in controllers.iter_mut().zip(&mut slots) {
                controller.feed(&cycle(51), Time(51 * MS), slot, &groups);
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
            let follow = QueuedCommand { verb: Command::Follow, stream: 1, ..call(101) };
            x.commands.push(follow).unwrap();
            rows.into_iter().for_each(|row| x.rows.push(row).unwrap());
            let mut other = Alone::new(plan()).enabled();
            other.commands.push(follow).unwrap();
            let (mut controllers, mut slots) = ([x.controller, other.controller], [x.slot, other.slot]);
            turn(&mut GroupSync::new(2), 50, &mut controllers, &mut slots);
            assert_eq!(controllers[0].offers_row(0).map(|(_, number)| number), offered);
        }
    }

    #[test]
    fn the_misses_of_one_motion_are_not_counted_in_the_next() {
        let mut group = GroupState { moving: 2, bucket: 4, leak: 1_000, ..GroupState::default() };
        for _ in 0..3 {
            (group.closed, group.missed) = (2, true);
            group.fill();
        }
        assert_eq!(group.level, 3);
        group.moving = 0;
        group.fill();
        assert_eq!((group.level, group.good), (0, 0));
    }
}
