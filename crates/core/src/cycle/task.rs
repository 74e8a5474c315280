//! The in-loop task: the application's own code inside the cycle.

use crate::axis::command::Level;
use crate::axis::{Command, CommandId, Failure, Feedback, QueuedCommand, Row};
use crate::bus::Cycle;
use crate::drive::controller::DriveController;
use crate::inputs::InputLog;
use crate::packed::Part;
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
    log: &'a InputLog,
}

/// The task's requests of an axis, by its index: all that leaves it, and what was refused by no rule of the
/// loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TaskCall {
    /// A command.
    Command(usize, Command),
    /// A velocity or torque.
    Level(usize, Level, f64),
    /// A row.
    Follow(usize, Row),
    /// A command that was refused, since the application had left no room for its end.
    NoRoom(usize),
}

impl<'a> Axes<'a> {
    pub(super) fn new(
        controllers: &'a mut [DriveController],
        next_id: &'a mut u64,
        cycle: &'a Cycle,
        now: Time,
        log: &'a InputLog,
    ) -> Axes<'a> {
        Axes { controllers, next_id, cycle, now, log }
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
        let id = CommandId::of_task(*self.next_id);
        let queued = QueuedCommand { id, member: index as u32, command, stream: 0, call: None };
        let (cycle, now, log) = (self.cycle, self.now, self.log);
        self.controller(index)?.command_from_task(cycle, now, queued, |found| has_room(log, index, found))?;
        *self.next_id += 1;
        self.log.calls(&TaskCall::Command(index, command));
        Ok(id)
    }

    /// The velocity of axis `index` at its next exchange, user units/s, while it runs [`Command::Velocity`] or
    /// [`Command::Jog`]; to be renewed before it is too old.
    pub fn set_velocity(&mut self, index: usize, velocity: f64) -> Result<(), Failure> {
        self.set(index, Level::Velocity, velocity)
    }

    /// The torque of axis `index` at its next exchange, per cent of the rated torque, while it runs
    /// [`Command::Torque`]; to be renewed before it is too old.
    pub fn set_torque(&mut self, index: usize, torque: f64) -> Result<(), Failure> {
        self.set(index, Level::Torque, torque)
    }

    fn set(&mut self, index: usize, level: Level, value: f64) -> Result<(), Failure> {
        let cycle = self.cycle.index;
        self.controller(index)?.level_from_task(cycle, level, value)?;
        self.log.calls(&TaskCall::Level(index, level, value));
        Ok(())
    }

    fn controller(&mut self, index: usize) -> Result<&mut DriveController, Failure> {
        self.controllers.get_mut(index).ok_or(Failure::Unsupported("there is no such axis"))
    }

    /// The row that axis `index` follows at its next exchange, while it runs [`Command::Follow`] outside of a group. It
    /// is checked against the limits like a streamed one.
    pub fn follow(&mut self, index: usize, row: Row) {
        if let Some(controller) = self.controllers.get_mut(index) {
            controller.row_from_task(row);
            self.log.calls(&TaskCall::Follow(index, row));
        }
    }

    /// Makes a call as the task of a recorded run made it, where it was accepted. Returns whether it is here.
    #[doc(hidden)]
    pub fn repeat(&mut self, call: TaskCall) -> bool {
        match call {
            TaskCall::Command(index, command) => self.command(index, command).is_ok(),
            TaskCall::Level(index, level, value) => self.set(index, level, value).is_ok(),
            TaskCall::Follow(index, row) => {
                self.follow(index, row);
                index < self.len()
            }
            TaskCall::NoRoom(index) => {
                self.log.calls(&call);
                index < self.len()
            }
        }
    }
}

/// Whether the application has left room for the end of a command to axis `index`: of a repeated run what the recorded
/// one found, `found` in any other.
fn has_room(log: &InputLog, index: usize, found: bool) -> bool {
    let none = TaskCall::NoRoom(index);
    let has_room = log.as_replaying().map_or(found, |replaying| replaying.peek_call() != Some(none));
    if !has_room {
        log.calls(&none);
    }
    has_room
}

impl Part for TaskCall {
    const WORDS: usize = 2 + Command::WORDS;

    fn put(&self, words: &mut [u64]) {
        words.fill(0);
        let (code, index) = match *self {
            TaskCall::Command(index, command) => {
                command.put(&mut words[2..]);
                (0, index)
            }
            TaskCall::Level(index, level, value) => {
                value.put(&mut words[2..]);
                (1 + level as u64, index)
            }
            TaskCall::Follow(index, row) => {
                row.put(&mut words[2..]);
                (3, index)
            }
            TaskCall::NoRoom(index) => (4, index),
        };
        (words[0], words[1]) = (code, index as u64);
    }

    fn take(words: &[u64]) -> TaskCall {
        let (index, rest) = (words[1] as usize, &words[2..]);
        match words[0] {
            0 => TaskCall::Command(index, Part::take(rest)),
            1 => TaskCall::Level(index, Level::Velocity, Part::take(rest)),
            2 => TaskCall::Level(index, Level::Torque, Part::take(rest)),
            3 => TaskCall::Follow(index, Part::take(rest)),
            _ => TaskCall::NoRoom(index),
        }
    }
}
