//! Rows, velocities and torques for the next send: which one, how old it may be, and what follows when there is
//! none.

use super::{DriveController, Owner, Queues};
use crate::axis::limits::{check_braking, check_reach, check_row};
use crate::axis::{
    Command, CommandId, EventKind, Failure, Outcome, QueuedCommand, Row, Setpoint, StopCause, Underrun,
};
use crate::bus::{Cycle, Slot};
use crate::drive::machine::NumberedRow;
use crate::time::{Time, nanos};

/// The first row may be so many rows' ways ahead of the demand: the reply is one exchange old, and a drive's output
/// runs behind its setpoints.
const FIRST_ROW_AHEAD: f64 = 4.0;

/// Where an axis is in its stream.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Follow {
    /// Number of the last row given to the station.
    number: u64,
    /// The last row; `None` before the first.
    last: Option<Row>,
    /// Exchanges in a row for which the stream had nothing.
    empty: u32,
    /// The row of the next send, out of the queue.
    next: Option<Row>,
}

/// When a setpoint counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Counts {
    /// The command runs.
    Now,
    /// The command is still to begin.
    Later,
}

/// Takes the next row of each stream out of its queue, for all members of a group or for none.
pub fn take_rows(controllers: &mut [DriveController], slots: &[Slot]) {
    for lead in 0..controllers.len() {
        let Some(follow) = controllers[lead].takes_row(&slots[lead]) else { continue };
        let parts = follow.call.map_or(1, |call| call.parts);
        if !follow.call.map_or(controllers[lead].task_row.is_none(), |call| call.lead as usize == lead) {
            continue;
        }
        // Bounded by what is queued now: the application may go on pushing.
        for _ in 0..controllers[lead].queues.rows.slots() {
            if !controllers[lead].has_row(follow.stream) {
                break;
            }
            let row = |controllers: &mut [DriveController], part| controllers[lead].queues.rows.entry(part);
            let all = (0..parts as usize).all(|part| {
                row(controllers, part).is_some_and(|row| {
                    let member = row.member as usize;
                    controllers[member].takes_row(&slots[member]).is_some_and(|own| {
                        (own.call, own.stream, parts) == (follow.call, row.stream, row.parts)
                    })
                })
            });
            for part in 0..if all { parts as usize } else { 0 } {
                if let Some(row) = row(controllers, part) {
                    controllers[row.member as usize].follow.next = Some(row.row);
                }
            }
            // One that was pushed for other axes is for none of these.
            controllers[lead].drop_row();
            if all {
                break;
            }
        }
    }
}

impl DriveController {
    /// The newest setpoints that the application has given through this axis, into `set`; how many there are.
    pub fn take_set(&mut self, set: &mut [Setpoint]) -> usize {
        let Queues { setpoints, log, .. } = &mut self.queues;
        let found = setpoints.take();
        let part = |place| log.part(if found { setpoints.part(place) } else { None });
        let Some(first) = part(0) else { return 0 };
        let count = (first.parts as usize).min(set.len());
        for (place, to) in set[..count].iter_mut().enumerate() {
            *to = if place == 0 { first } else { part(place).unwrap_or_default() };
        }
        count
    }

    /// When `setpoint` would count here; `None`: its command has ended, or a later setpoint has come by another way.
    pub fn counts(&self, setpoint: &Setpoint) -> Option<Counts> {
        let next = self.queues.commands.front().map_or(self.next_id, |command| command.id.0);
        match *self.duty.active() {
            _ if setpoint.number <= self.numbered => None,
            Some(active) if active.id == setpoint.of => Some(Counts::Now),
            _ => (setpoint.of.0 >= next).then_some(Counts::Later),
        }
    }

    /// Takes one that counts. If it is not for the running command, it waits for its own.
    pub fn take_setpoint(&mut self, cycle: u64, setpoint: Setpoint) {
        // Those of the in-loop task have no number.
        self.numbered = self.numbered.max(setpoint.number);
        match *self.duty.active() {
            Some(active) if active.id == setpoint.of => self.set_level(cycle, setpoint.value),
            _ if setpoint.of == CommandId::NO_OWNER => self.owner = Owner::Leaves,
            _ => self.ahead = setpoint,
        }
    }

    /// Sets the velocity or torque of the running command.
    pub(super) fn set_level(&mut self, cycle: u64, value: f64) {
        self.machine.input.level = value;
        (self.level_at, self.ages_at) = (cycle, 0);
    }

    /// Stops an axis whose velocity or torque is older than it may be, and notes when to look at that again.
    pub(super) fn age_setpoint(&mut self, cycle: &Cycle, now: Time) {
        let age = match self.duty.command() {
            Some(Command::Velocity { .. } | Command::Torque { .. }) => {
                Some((u64::from(self.plan.setpoint_age), StopCause::StaleSetpoint))
            }
            Some(Command::Jog(_)) => self
                .plan
                .jog_deadman
                .map(|limit| (nanos(limit).div_ceil(cycle.period_ns), StopCause::DeadMan)),
            _ => None,
        };
        let Some((most, cause)) = age else {
            self.ages_at = u64::MAX;
            return;
        };
        self.ages_at = self.level_at.saturating_add(most).saturating_add(1);
        if cycle.index >= self.ages_at {
            self.stop(cycle, now, cause);
        }
    }

    /// It follows rows.
    #[inline]
    pub fn follows_rows(&self) -> bool {
        self.duty.follows().rows
    }

    /// It follows rows, or the in-loop task has given one: [`feed`](Self::feed) has something to do.
    #[inline]
    pub fn takes_rows(&self) -> bool {
        self.follows_rows() || self.task_row.is_some()
    }

    /// The follow that takes a row for the next send.
    fn takes_row(&self, slot: &Slot) -> Option<QueuedCommand> {
        let follow = self.duty.active().filter(|active| matches!(active.command, Command::Follow))?;
        let due = slot.due && matches!(self.machine.command(), Some(Command::Follow));
        let done = self.row_waits || self.follow.last.is_some_and(|row| row.last);
        (due && !done).then_some(follow)
    }

    /// Chooses the row of the next send, if one is due.
    pub fn feed(&mut self, cycle: &Cycle, now: Time, slot: &Slot) {
        let Some(active) = self.takes_row(slot) else {
            // A row of the task is for the send that it was given for, and begins no later stream.
            if !self.follows_rows() {
                self.task_row = None;
            }
            return;
        };
        let task_row = self.task_row.take().filter(|_| active.call.is_none());
        let row = task_row.or_else(|| self.follow.next.take());
        let chosen = match (row, self.follow.last) {
            (None, None) => return,
            (Some(row), last) => {
                self.follow.empty = 0;
                if let Err(failure) = self.check_row(&row, last) {
                    self.fail_follow(cycle, now, failure, StopCause::Limit);
                    return;
                }
                row
            }
            (None, Some(last)) => {
                self.follow.empty = self.follow.empty.saturating_add(1);
                if self.follow.empty == 1 {
                    self.emit(cycle, now, EventKind::Underrun);
                }
                let position = last.position + last.velocity * self.row_seconds;
                let ahead = Row { position, acceleration: 0.0, ..last };
                match self.plan.underrun {
                    Underrun::Hold => Row { velocity: 0.0, acceleration: 0.0, ..last },
                    Underrun::Extrapolate(most)
                        if self.follow.empty <= most && self.check_row(&ahead, Some(last)).is_ok() =>
                    {
                        ahead
                    }
                    Underrun::Extrapolate(_) | Underrun::Stop => {
                        self.fail_follow(cycle, now, Failure::Underrun, StopCause::Underrun);
                        return;
                    }
                }
            }
        };
        self.follow.number += 1;
        self.follow.last = Some(chosen);
        self.row_waits = true;
        self.machine.input.row = Some(NumberedRow { number: self.follow.number, row: chosen });
    }

    /// The first row starts near the axis' position; later ones near the row before, and so that the axis can still
    /// stop inside its range.
    fn check_row(&self, row: &Row, last: Option<Row>) -> Result<(), Failure> {
        let (limit, seconds) = (self.plan.limits.velocity, self.row_seconds);
        let (from, velocity) = match last {
            None => {
                let own = limit.unwrap_or(self.plan.profile.velocity);
                (self.feedback.status.demand, own * FIRST_ROW_AHEAD)
            }
            Some(last) => (last.position, limit.unwrap_or(f64::INFINITY)),
        };
        check_row(&self.plan, row, Some(from))?;
        check_reach(&self.plan, from, row.position, velocity * seconds)?;
        last.map_or(Ok(()), |_| check_braking(&self.plan, from, row.position, seconds))
    }

    fn fail_follow(&mut self, cycle: &Cycle, now: Time, failure: Failure, cause: StopCause) {
        if let Some(active) = *self.duty.active() {
            self.end(cycle, now, active, Outcome::Failed(failure));
        }
        self.stop(cycle, now, cause);
    }

    /// Drops the rest of the streams up to `stream`.
    pub(super) fn drop_rows(&mut self, stream: u32) {
        self.task_row = None;
        self.row_waits = false;
        self.follow = Follow { number: self.follow.number, ..Follow::default() };
        self.has_row(stream + 1);
    }

    /// Whether the first row is of `stream`; rows of earlier streams before it are dropped.
    fn has_row(&mut self, stream: u32) -> bool {
        for _ in 0..self.queues.rows.slots() {
            match self.queues.rows.entry(0) {
                Some(row) if row.stream < stream => self.drop_row(),
                row => return row.is_some_and(|row| row.stream == stream),
            }
        }
        false
    }

    /// Drops the first row, with the parts of all members.
    fn drop_row(&mut self) {
        let parts = self.queues.rows.entry(0).map_or(0, |row| row.parts as usize);
        self.queues.rows.skip(parts);
    }
}
