//! The in-loop task: the application's own code inside the cycle.

use crate::axis::{Command, CommandId, Failure, Feedback, QueuedCommand, Row};
use crate::bus::Cycle;
use crate::drive::controller::DriveController;
use crate::time::Time;

/// Runs on the real-time thread once a cycle, between the evaluation of the replies and the building of the next
/// requests: it sees the feedback of cycle k, and its commands leave in cycle k + 1. It must not allocate, lock or
/// wait.
pub type Task = Box<dyn FnMut(&Cycle, &mut Axes<'_>) + Send>;

/// All axes of the machine, as the in-loop task sees them, in the order of the plan.
#[derive(Debug)]
pub struct Axes<'a> {
    controllers: &'a mut [DriveController],
    next_id: &'a mut u64,
    cycle: &'a Cycle,
    now: Time,
}

impl<'a> Axes<'a> {
    pub(super) fn new(
        controllers: &'a mut [DriveController],
        next_id: &'a mut u64,
        cycle: &'a Cycle,
        now: Time,
    ) -> Axes<'a> {
        Axes { controllers, next_id, cycle, now }
    }

    /// The number of axes.
    pub fn len(&self) -> usize {
        self.controllers.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.controllers.is_empty()
    }

    /// The index of the axis of this name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.controllers.iter().position(|controller| controller.plan().name == name)
    }

    /// The feedback of axis `index` in this cycle; `None` beyond the last.
    pub fn feedback(&self, index: usize) -> Option<&Feedback> {
        self.controllers.get(index).map(DriveController::feedback)
    }

    /// Gives a command to axis `index`, at most one a cycle. Its end is an event of the axis.
    pub fn command(&mut self, index: usize, command: Command) -> Result<CommandId, Failure> {
        let controller =
            self.controllers.get_mut(index).ok_or(Failure::Unsupported("there is no such axis"))?;
        let id = CommandId::of_task(*self.next_id);
        controller.command_from_task(
            self.cycle,
            self.now,
            QueuedCommand { id, member: index as u32, command, stream: 0, call: None },
        )?;
        *self.next_id += 1;
        Ok(id)
    }

    /// The velocity of axis `index` at its next exchange, user units/s, while it runs [`Command::Velocity`] or
    /// [`Command::Jog`]; to be renewed before it is too old.
    pub fn set_velocity(&mut self, index: usize, velocity: f64) -> Result<(), Failure> {
        let controller =
            self.controllers.get_mut(index).ok_or(Failure::Unsupported("there is no such axis"))?;
        controller.velocity_from_task(self.cycle.index, velocity)
    }

    /// The torque of axis `index` at its next exchange, per cent of the rated torque, while it runs
    /// [`Command::Torque`]; to be renewed before it is too old.
    pub fn set_torque(&mut self, index: usize, torque: f64) -> Result<(), Failure> {
        let controller =
            self.controllers.get_mut(index).ok_or(Failure::Unsupported("there is no such axis"))?;
        controller.torque_from_task(self.cycle.index, torque)
    }

    /// The row that axis `index` follows at its next exchange, while it runs [`Command::Follow`] outside of a group. It
    /// is checked against the limits like a streamed one.
    pub fn follow(&mut self, index: usize, row: Row) {
        if let Some(controller) = self.controllers.get_mut(index) {
            controller.row_from_task(row);
        }
    }
}
