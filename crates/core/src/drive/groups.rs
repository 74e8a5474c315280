//! Group synchronisation: a command of all members begins at each of them in one cycle, or at none, and so are rows
//! and setpoints taken. What one member leaves, no other goes on with. And stop groups, whose members stop together.
//!
//! The parts of all members are one entry in the queue of the first, so that the loop never sees some of them only.

use std::collections::BTreeMap;

use super::controller::{Along, DriveController};
use crate::axis::{BegunBy, Setpoint, StopCause};
use crate::bus::Cycle;
use crate::time::Time;

/// The synchronisation of all groups, each at the index of its first member.
#[derive(Debug)]
pub struct GroupSync {
    groups: Vec<GroupState>,
    /// The setpoints that are being taken.
    set: Box<[Setpoint]>,
    /// A group has received a command; until then this module costs nothing, which saves 27 instructions a drive and
    /// cycle.
    used: bool,
}

/// One group in this cycle, and its misses.
#[derive(Clone, Copy, Debug, Default)]
struct GroupState {
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
        let (groups, set) = (vec![GroupState::default(); axes], vec![Setpoint::default(); axes].into());
        GroupSync { groups, set, used: false }
    }

    /// The memory that it touches besides itself.
    pub fn memory(&self, regions: &mut crate::rt::Regions) {
        regions.add(&*self.groups);
        regions.add(&*self.set);
    }

    /// Takes the newest setpoints of the application, those of a group at all members or at none: each of them runs
    /// the command that its part is for, or each of them has it still before it. A part of an axis alone is a set of
    /// one.
    #[inline(never)]
    pub fn take_setpoints(&mut self, cycle: &Cycle, controllers: &mut [DriveController]) {
        for lead in 0..controllers.len() {
            if !controllers[lead].is_called() {
                continue;
            }
            let count = controllers[lead].take_set(&mut self.set);
            let set = &self.set[..count];
            let when = |part: &Setpoint| controllers.get(part.member as usize)?.counts(part);
            let first = set.first().and_then(when);
            if first.is_none() || set.iter().any(|part| when(part) != first) {
                continue;
            }
            for part in set {
                controllers[part.member as usize].take_setpoint(cycle.index, *part);
            }
        }
    }

    /// Begins the commands that may begin at all members. One member that cannot keeps all others from it.
    pub fn open(&mut self, cycle: &Cycle, now: Time, controllers: &mut [DriveController]) {
        for index in 0..controllers.len() {
            let Some(call) = controllers[index].waiting() else { continue };
            self.used = true;
            let lead = call.lead as usize;
            if lead != index && controllers.get(lead).is_some_and(|lead| lead.holds(call)) {
                // It begins with its lead.
                continue;
            }
            let held = controllers.iter().filter(|axis| axis.holds(call)).count();
            let waiting = controllers.iter().filter(|axis| axis.waiting() == Some(call));
            // A stop has ended it at some member before it began.
            let lost = held < call.together as usize;
            if !lost && waiting.clone().count() < held {
                continue;
            }
            let refused = lost || waiting.clone().any(|axis| axis.admits_waiting().is_err());
            for axis in controllers.iter_mut() {
                if axis.waiting() == Some(call) {
                    axis.take_waiting(cycle, now, refused);
                }
            }
        }
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
            let reply = controller.reply();
            let Some(call) = controller.moves_in_group() else { continue };
            let Some(group) = self.groups.get_mut(call.lead as usize) else { continue };
            let health = controller.plan().health;
            let first = group.moving == 0;
            group.bucket = if first { health.bucket } else { group.bucket.min(health.bucket) };
            group.leak = if first { health.leak } else { group.leak.max(health.leak) };
            group.moving += 1;
            group.closed += u32::from(reply.is_end());
            group.missed |= reply.is_missed();
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

/// The stop groups: behind each axis the next one that stops with it, in a ring. So a stop costs the members of its
/// group only, however many axes there are.
#[derive(Debug)]
pub struct StopGroups(Box<[u16]>);

impl StopGroups {
    /// Those of the plans of these axes.
    pub fn new(controllers: &[DriveController]) -> StopGroups {
        // Each begins as a ring of its own, which the ring of its group takes in.
        let mut next: Box<[u16]> = (0..controllers.len() as u16).collect();
        let mut newest = BTreeMap::new();
        for (axis, controller) in controllers.iter().enumerate() {
            if let Some(before) = controller.plan().stop.group.and_then(|group| newest.insert(group, axis)) {
                next.swap(before, axis);
            }
        }
        StopGroups(next)
    }

    /// The memory that it touches besides itself.
    pub fn memory(&self, regions: &mut crate::rt::Regions) {
        regions.add(&*self.0);
    }

    /// Stops the stop group of `axis`, which has one.
    pub fn stop(&self, cycle: &Cycle, now: Time, axis: u16, cause: StopCause, all: &mut [DriveController]) {
        let mut member = axis;
        loop {
            let controller = &mut all[usize::from(member)];
            controller.stop_along(cycle, now, BegunBy { axis, cause });
            controller.take_along();
            member = self.0[usize::from(member)];
            if member == axis {
                return;
            }
        }
    }
}

/// Why the stop group of `axis` has to stop because of it, once; `None`: it has not, or there is none. An axis that has
/// left what its group still does is stopped for that.
pub fn take_group_stop(
    cycle: &Cycle,
    now: Time,
    axis: usize,
    controllers: &mut [DriveController],
) -> Option<StopCause> {
    let cause = match controllers[axis].take_along() {
        Along::Nobody => None,
        Along::All(cause) => Some(cause),
        Along::WhoGoesOn => {
            let left = controllers[axis].left_call();
            let goes_on = left.is_some() && controllers.iter().any(|axis| axis.acts_in_group() == left);
            if goes_on {
                controllers[axis].stop(cycle, now, StopCause::GroupFailed);
                controllers[axis].take_along();
            }
            goes_on.then_some(StopCause::GroupFailed)
        }
    };
    cause.filter(|_| controllers[axis].plan().stop.group.is_some())
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
    use crate::axis::doorbell::Bells;
    use crate::axis::newest::NewestIn;
    use crate::axis::{
        Abort, Command, CommandId, Event, Failure, GroupCall, Outcome, QueuedCommand, Row, State, StopCause,
        StreamRow,
    };
    use crate::bus::Slot;
    use crate::drive::controller::tests::{Alone, cycle, ended, plan};
    use crate::drive::controller::{take_commands, take_rows};

    /// Axes in operation, with the application's ends of their queues.
    struct Machine {
        controllers: Vec<DriveController>,
        slots: Vec<Slot>,
        ends: Vec<Ends>,
        groups: GroupSync,
        bells: Bells,
        ids: Vec<u64>,
        index: u64,
    }

    struct Ends {
        commands: rtrb::Producer<QueuedCommand>,
        rows: rtrb::Producer<StreamRow>,
        setpoints: NewestIn,
        events: rtrb::Consumer<Event>,
    }

    impl Machine {
        /// `axes` axes, in this stop group.
        fn new(axes: usize, group: Option<u16>) -> Machine {
            let mut plan = plan();
            plan.stop.group = group;
            let (controllers, (slots, ends)) = (0..axes)
                .map(|_| Alone::new(plan.clone()).enabled())
                .map(|Alone { controller, slot, commands, rows, setpoints, events, .. }| {
                    let ends = Ends { commands, rows, setpoints, events };
                    (controller, (Slot { due: true, ..slot }, ends))
                })
                .unzip();
            // The first command was the enable.
            let (groups, bells) = (GroupSync::new(axes), Bells::new(axes));
            Machine { controllers, slots, ends, groups, bells, ids: vec![2; axes], index: 50 }
        }

        /// Posts a command to a group, or to one axis alone.
        fn post(&mut self, parts: &[(usize, Command)]) {
            let together = || parts.iter().filter(|(_, command)| !command.is_urgent());
            let lead = together().next().map_or(parts[0].0, |(axis, _)| *axis);
            let call = GroupCall {
                parts: parts.len() as u32,
                together: together().count() as u32,
                lead: lead as u32,
                id: CommandId(self.ids[lead]),
            };
            let entry: Vec<QueuedCommand> = (parts.iter())
                .map(|&(axis, command)| {
                    let call = (parts.len() > 1).then_some(call);
                    self.ids[axis] += 1;
                    let id = CommandId(self.ids[axis] - 1);
                    QueuedCommand { id, member: axis as u32, command, stream: 1, call }
                })
                .collect();
            self.ends[parts[0].0].commands.push_entire_slice(&entry).unwrap();
            self.bells.bell(parts[0].0).ring();
        }

        /// Gives setpoint `number` of each of these axes, each for a command, as one set.
        fn give(&mut self, number: u64, set: &[(usize, u64, f64)]) {
            let parts: Vec<Setpoint> = (set.iter())
                .map(|&(axis, of, value)| {
                    let (member, parts, of) = (axis as u32, set.len() as u32, CommandId(of));
                    Setpoint { member, parts, number, of, value }
                })
                .collect();
            self.ends[set[0].0].setpoints.write(&parts);
            self.bells.bell(set[0].0).ring();
        }

        fn levels(&self) -> Vec<f64> {
            self.controllers.iter().map(DriveController::level).collect()
        }

        fn stopped(&self) -> Vec<Option<StopCause>> {
            self.controllers.iter().map(|axis| axis.feedback().stopped).collect()
        }

        /// Posts them, and a cycle passes.
        fn begin(&mut self, parts: &[(usize, Command)]) {
            self.post(parts);
            self.turn();
        }

        /// One cycle of the commands.
        fn turn(&mut self) {
            let cycle = cycle(self.index);
            self.index += 1;
            take_commands(&mut self.controllers, &mut self.bells);
            if self.bells.take_rung() {
                self.groups.take_setpoints(&cycle, &mut self.controllers);
            }
            for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
                controller.exchange(&cycle, cycle.grid, slot);
            }
            self.groups.open(&cycle, cycle.grid, &mut self.controllers);
            for axis in 0..self.controllers.len() {
                if let Some(cause) = take_group_stop(&cycle, cycle.grid, axis, &mut self.controllers) {
                    let groups = StopGroups::new(&self.controllers);
                    groups.stop(&cycle, cycle.grid, axis as u16, cause, &mut self.controllers);
                }
            }
        }

        /// The drive carries out what `axis` runs, and a cycle passes.
        fn done(&mut self, axis: usize) {
            self.controllers[axis].end_with(Ok(()));
            self.turn();
        }

        fn runs(&self, command: Command) -> Vec<bool> {
            self.controllers.iter().map(|axis| axis.newest() == Some(command)).collect()
        }

        fn ended(&mut self, axis: usize) -> Vec<(u64, Outcome)> {
            ended(&mut self.ends[axis].events)
        }
    }

    #[test]
    fn the_members_of_a_stop_group_are_a_ring_and_an_axis_without_one_is_alone() {
        let groups = [Some(7), Some(2), Some(7), None, Some(2), Some(7)];
        let controllers: Vec<_> =
            groups.into_iter().flat_map(|group| Machine::new(1, group).controllers).collect();
        assert_eq!(*StopGroups::new(&controllers).0, [2, 4, 5, 3, 1, 0]);
    }

    /// May begin at any time, and is done at once.
    const RESET: Command = Command::Reset;
    const DONE: Outcome = Outcome::Done;

    #[test]
    fn a_command_that_ended_at_a_member_before_it_began_is_refused_to_the_others() {
        for (stopped, other) in [(0, 1), (1, 0)] {
            let mut m = Machine::new(2, None);
            m.post(&[(other, Command::Home)]);
            m.begin(&[(0, RESET), (1, RESET)]);
            assert_eq!([m.ended(0), m.ended(1)], [[], []], "one of them homes");
            m.controllers[stopped].stop(&cycle(51), cycle(51).grid, StopCause::Overrun);
            let aborted = Outcome::Aborted(Abort::Stopped(StopCause::Overrun));
            assert_eq!(m.ended(stopped), [(2, aborted)]);
            m.done(other);
            assert_eq!(m.ended(other), [(2, DONE), (3, Outcome::Failed(Failure::GroupRefused))]);
            // The next call finds no leftovers.
            m.begin(&[(0, RESET), (1, RESET)]);
            assert_eq!(m.ended(other), [(4, DONE)]);
        }
    }

    #[test]
    fn a_stop_waits_for_no_other_member_and_none_for_a_stop_and_a_complete_call_starts_no_other_group() {
        let mut m = Machine::new(3, None);
        m.post(&[(1, Command::Home)]);
        m.begin(&[(0, Command::QuickStop), (1, RESET), (2, RESET)]);
        assert_eq!(m.runs(Command::QuickStop), [true, false, false]);
        assert_eq!((m.ended(1), m.ended(2)), (vec![], vec![]));
        m.done(1);
        assert_eq!((m.ended(1), m.ended(2)), (vec![(2, DONE), (3, DONE)], vec![(2, DONE)]));
        let mut m = Machine::new(4, None);
        m.post(&[(2, Command::Enable)]);
        m.post(&[(0, Command::Home), (1, Command::Home)]);
        m.begin(&[(3, Command::Home), (2, Command::Home)]);
        assert_eq!(m.runs(Command::Home), [true, true, false, false]);
        m.done(2);
        assert_eq!(m.runs(Command::Home), [true; 4]);
    }

    #[test]
    fn the_commands_of_an_axis_keep_their_sequence_whatever_groups_it_was_in() {
        // Alone, in three groups, and alone again; each queue holds what another one has to wait for.
        let mut m = Machine::new(3, None);
        m.post(&[(2, Command::Home)]);
        for members in [&[2, 1][..], &[1, 0], &[0, 2], &[2], &[0]] {
            m.post(&members.iter().map(|axis| (*axis, RESET)).collect::<Vec<_>>());
        }
        m.turn();
        assert_eq!([m.ended(0), m.ended(1), m.ended(2)], [[], [], []]);
        m.done(2);
        (0..4).for_each(|_| m.turn());
        for (axis, last) in [(0, 4), (1, 3), (2, 5)] {
            assert_eq!(m.ended(axis), (2..=last).map(|id| (id, DONE)).collect::<Vec<_>>(), "axis {axis}");
        }
    }

    /// Two axes of three follow stream 1 together; the first one's queue holds these rows, each with its parts by
    /// axis and stream. Returns which axes have a row for the next send, and how many parts are left.
    fn handed(due: bool, rows: &[&[(u32, u32)]]) -> ([bool; 3], usize) {
        let mut m = Machine::new(3, None);
        m.post(&[(0, Command::Follow), (1, Command::Follow)]);
        for parts in rows {
            for &(member, stream) in *parts {
                let row = StreamRow { stream, member, parts: parts.len() as u32, row: Row::default() };
                m.ends[0].rows.push(row).unwrap();
            }
        }
        m.turn();
        m.slots[1].due = due;
        take_rows(&mut m.controllers, &m.slots);
        for (controller, slot) in m.controllers.iter_mut().zip(&mut m.slots) {
            controller.feed(&cycle(51), cycle(51).grid, slot);
        }
        let left = 8 - m.ends[0].rows.slots();
        (std::array::from_fn(|axis| m.controllers[axis].has_next_row()), left)
    }

    #[test]
    fn a_row_is_for_the_members_that_it_was_pushed_for_in_the_stream_that_they_follow_or_for_none() {
        let (both, none) = ([true, true, false], [false; 3]);
        let row: &[(u32, u32)] = &[(0, 1), (1, 1)];
        assert_eq!(handed(true, &[]), (none, 0));
        assert_eq!(handed(true, &[row, row]), (both, 2), "one a send");
        let three = &[(0, 1), (1, 1), (2, 1)];
        for other in [&[(0, 1)][..], &[(0, 1), (2, 1)], three, &[(0, 0), (1, 1)], &[(0, 1), (1, 0)]] {
            assert_eq!(handed(true, &[other]), (none, 0), "{other:?}");
            assert_eq!(handed(true, &[other, row]), (both, 0), "{other:?}");
        }
        assert_eq!(handed(true, &[&[(0, 2), (1, 2)], row]), (none, 4), "of a later stream");
        assert_eq!(handed(false, &[row]).0, none, "one of them sends nothing");
    }

    const TURN: Command = Command::Velocity { acceleration: 100.0 };

    #[test]
    fn setpoints_of_a_group_count_for_all_its_members_in_one_cycle_or_for_none() {
        let mut m = Machine::new(3, Some(3));
        m.post(&[(1, TURN), (0, TURN), (2, TURN)]);
        // For the commands that begin in this cycle, and for those that run.
        for (number, value) in [(1, 5.0), (2, 6.0), (4, 7.0)] {
            m.give(number, &[(1, 2, value), (0, 2, value + 10.0), (2, 2, value + 20.0)]);
            m.turn();
            assert_eq!(m.levels(), [value + 10.0, value, value + 20.0]);
        }
        // Older than one that came by another way, or for a command that one of them has not, or not any more.
        for (number, of) in [(3, 2), (4, 2), (5, 1), (5, 3), (5, 9), (5, 0)] {
            m.give(number, &[(1, 2, 1.0), (0, 2, 1.0), (2, of, 1.0)]);
            m.turn();
            assert_eq!(m.levels(), [17.0, 7.0, 27.0], "setpoint {number} of command {of}");
        }
        // One of them alone, and all of them again, of which one has a later one.
        for (number, set, levels) in [
            (5, &[(0, 2, 8.0)][..], [8.0, 7.0, 27.0]),
            (5, &[(1, 2, 1.0), (0, 2, 1.0), (2, 2, 1.0)], [8.0, 7.0, 27.0]),
            (6, &[(1, 2, 1.0), (0, 2, 2.0), (2, 2, 3.0)], [2.0, 1.0, 3.0]),
        ] {
            m.give(number, set);
            m.turn();
            assert_eq!((m.levels(), m.stopped()), (levels.to_vec(), vec![None; 3]), "{number} {set:?}");
        }
    }

    #[test]
    fn setpoints_for_commands_to_come_begin_with_them_and_never_at_one_member_alone() {
        let mut m = Machine::new(2, Some(3));
        m.post(&[(1, Command::Home)]);
        m.post(&[(0, TURN), (1, TURN)]);
        m.give(1, &[(0, 2, 5.0), (1, 3, 6.0)]);
        m.turn();
        assert_eq!(m.levels(), [0.0, 0.0]);
        m.done(1);
        assert_eq!(m.levels(), [5.0, 6.0]);
        // The next call waits for a homing again; what it runs until then has no setpoint of that call.
        m.post(&[(0, Command::Home), (1, Command::Home)]);
        m.post(&[(0, TURN), (1, TURN)]);
        m.give(2, &[(0, 2, 1.0), (1, 5, 1.0)]);
        m.turn();
        assert_eq!(m.levels(), [5.0, 6.0]);
    }

    #[test]
    fn setpoints_that_a_member_cannot_take_renew_no_other() {
        let mut m = Machine::new(2, Some(3));
        let age = u64::from(m.controllers[0].plan().setpoint_age);
        m.begin(&[(0, TURN), (1, TURN)]);
        for number in 1..=age {
            m.give(number, &[(0, 2, 5.0), (1, 1, 5.0)]);
            m.turn();
            assert_eq!(m.stopped(), [None; 2], "{number} of {age}");
        }
        m.turn();
        assert_eq!(m.stopped(), [Some(StopCause::StaleSetpoint); 2]);
    }

    #[test]
    fn a_group_command_that_ends_early_at_one_member_ends_at_all() {
        let failed = |m: &Machine, axis| {
            let mut expected = vec![Some(StopCause::Group); m.controllers.len()];
            expected[axis] = Some(StopCause::GroupFailed);
            assert_eq!(m.stopped(), expected);
        };
        let running = |command| {
            let mut m = Machine::new(3, Some(3));
            m.begin(&[0, 1, 2].map(|axis| (axis, command)));
            m
        };
        let quick = Command::QuickStop;
        for command in [Command::Enable, Command::Home, TURN] {
            // It fails at one, while the others do it or have done it.
            for (done, failure) in [
                (false, Failure::DriveFault(7)),
                (false, Failure::TimedOut(State::SwitchedOn)),
                (true, Failure::DriveFault(7)),
                (true, Failure::TimedOut(State::SwitchedOn)),
            ] {
                let mut m = running(command);
                if done {
                    m.done(0);
                    m.done(2);
                    assert_eq!(m.stopped(), [None; 3], "{command:?}");
                }
                // An axis that is enabled already stops by its fault.
                m.controllers[1].disarm();
                m.controllers[1].end_with(Err(failure));
                m.turn();
                failed(&m, 1);
            }
            // A stop of the application for one of them, at which the others go on.
            let mut m = running(command);
            m.begin(&[(0, RESET), (1, quick), (2, RESET)]);
            failed(&m, 1);
            // For all of them, or with a motion for the others, it stops nobody else.
            let mut m = running(command);
            m.begin(&[(0, quick), (1, quick), (2, quick)]);
            assert_eq!(m.stopped(), [None; 3], "{command:?}");
        }
        let mut m = running(TURN);
        m.begin(&[(0, quick), (1, TURN), (2, TURN)]);
        assert_eq!((m.stopped(), m.runs(TURN)), (vec![None; 3], vec![false, true, true]));
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
