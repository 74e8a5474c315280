//! Several axes with one queue: commands and rows of all members take effect in the same cycle's send, all or none.
//!
//! A group takes its axes by value, so that no other owner commands them. Each member's command has its own id and
//! its own end. What one member refuses is refused to all. No member is enabled, homes or moves without the others: an
//! enable, a homing or a motion that fails at one member stops all of them by their stop group, and so does whatever
//! else ends it there before it is done (a stop of the axis, or of the application), while another member goes on. A
//! stop is never refused to one member because of another, and waits for none.

use std::time::{Duration, Instant};

use thiserror::Error;

use super::command::{
    Command, CommandId, GroupCall, Level, Move, Profile, QueuedCommand, Row, Setpoint, StreamRow, Target,
};
use super::event::Event;
use super::feedback::Feedback;
use super::handle::{Axis, AxisError};
use super::observer::GRACE;
use super::plan::AxisPlan;

/// Axes that act together: commands and rows of all of them take effect in the same cycle's send, all or none.
#[derive(Debug)]
pub struct Group {
    axes: Vec<Axis>,
}

/// One command to each member, in the order of the group.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GroupCommand {
    /// The name in messages.
    command: &'static str,
    ids: Vec<CommandId>,
}

impl GroupCommand {
    /// The ids in the members' events, in the order of the group. An id of 0, which no command has, is that of a member
    /// that was given none.
    pub fn ids(&self) -> &[CommandId] {
        &self.ids
    }
}

/// Why a request to a group failed.
#[derive(Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum GroupError {
    /// A group of fewer than two.
    #[error("a group of {0}: a group needs two axes or more")]
    TooFew(usize),
    /// Axes of two machines have no cycle in common.
    #[error("axes {0} and {1} belong to two masters: a group has one")]
    TwoMachines(String, String),
    /// The members do not exchange in the same cycles.
    #[error("axes {0} and {1} exchange in different cycles: give them one divisor and phase")]
    OutOfStep(String, String),
    /// One member would be stopped without the other.
    #[error("axes {0} and {1} do not stop together: put them into one stop.group")]
    TwoStopGroups(String, String),
    /// The number of values is not the number of members.
    #[error("{given} values for a group of {members}: give one for each axis")]
    Count {
        /// How many values were given.
        given: usize,
        /// How many members there are.
        members: usize,
    },
    /// Rows are for all members.
    #[error("some members follow and some do not: give follow to all of them")]
    MixedFollow,
    /// Different underrun policies would separate the members.
    #[error("axes {0} and {1} do different things when their streams run empty: give them one underrun")]
    TwoUnderruns(String, String),
    /// A stream ends for all members or for none.
    #[error("some rows are the last one and some are not: mark all of them or none")]
    MixedEnd,
    /// A part of the call was refused, and only its stops were given.
    #[error("{refused}; the stops of the same call were given all the same")]
    Partly {
        /// The stops. Their ids say which members have one.
        posted: GroupCommand,
        /// Why the others have nothing.
        refused: Box<GroupError>,
    },
    /// A member refused, or did not carry it out. If it was refused, no member has begun it.
    #[error(transparent)]
    Axis(#[from] AxisError),
}
crate::debug_as_display!(GroupError);

/// Axes that cannot form a group, given back.
#[derive(Error)]
#[error("{reason}")]
pub struct GroupRefused {
    /// The reason.
    pub reason: Box<GroupError>,
    /// The axes.
    pub axes: Vec<Axis>,
}
crate::debug_as_display!(GroupRefused);

impl Group {
    /// A group of these axes, two or more, of one machine, with one divisor, phase and stop group.
    pub fn new(axes: impl IntoIterator<Item = Axis>) -> Result<Group, GroupRefused> {
        let axes: Vec<Axis> = axes.into_iter().collect();
        match mismatch(&axes) {
            None => Ok(Group { axes }),
            Some(reason) => Err(GroupRefused { reason: Box::new(reason), axes }),
        }
    }

    /// The members.
    pub fn axes(&self) -> &[Axis] {
        &self.axes
    }

    /// Ends the group and gives its axes back. Its commands continue; its rows are for no other follow than its own.
    pub fn into_axes(self) -> Vec<Axis> {
        self.axes
    }

    /// The newest feedback of every member.
    pub fn feedback(&self) -> Vec<Feedback> {
        self.axes.iter().map(Axis::feedback).collect()
    }

    /// The next event of member `index`, if there is one.
    pub fn event(&mut self, index: usize) -> Option<Event> {
        self.axes.get_mut(index)?.event()
    }

    /// Gives one command to each member and returns at once. They begin in one cycle, as soon as each member may;
    /// if one of them cannot, all of them fail.
    ///
    /// Stop, QuickStop and Disable wait for no other member and are refused with none: if another part of the call is
    /// refused, they are given all the same, and the error is [`GroupError::Partly`]. A member that is stopped so,
    /// while the others go on with what it was part of, stops them; give them a motion in the same call to replace it.
    pub fn post(&mut self, commands: &[Command]) -> Result<GroupCommand, GroupError> {
        self.count(commands.len())?;
        match self.post_parts(commands, &vec![true; commands.len()]) {
            Err(refused) => Err(self.post_stops(commands, refused)),
            posted => posted,
        }
    }

    /// Posts the chosen parts of a call, all or none.
    fn post_parts(&mut self, commands: &[Command], chosen: &[bool]) -> Result<GroupCommand, GroupError> {
        let parts = || (0..commands.len()).filter(|place| chosen[*place]);
        let follows = |place: &usize| commands[*place] == Command::Follow;
        if parts().any(|place| follows(&place)) && !parts().all(|place| follows(&place)) {
            return Err(GroupError::MixedFollow);
        }
        for place in parts() {
            self.axes[place].accepts(&commands[place])?;
        }
        let together = || parts().filter(|place| !commands[*place].is_urgent());
        let lead = &self.axes[together().next().or(parts().next()).unwrap_or_default()];
        let call = GroupCall {
            parts: parts().count() as u32,
            together: together().count() as u32,
            lead: lead.index() as u32,
            id: lead.next_id,
        };
        let queued: Vec<QueuedCommand> =
            parts().map(|place| self.axes[place].command(commands[place], Some(call))).collect();
        self.axes[0].send(&queued)?;
        let mut ids = vec![CommandId(0); commands.len()];
        for (place, part) in parts().zip(&queued) {
            ids[place] = self.axes[place].sent(part);
        }
        // Velocities are for the members that this call gives one, as long as another call does not; so are torques.
        for level in Level::ALL {
            if parts().any(|place| level.is_of(&commands[place])) {
                let others = parts().filter(|place| !level.is_of(&commands[*place]));
                others.for_each(|place| self.axes[place].follows[level as usize] = CommandId(0));
            }
        }
        Ok(GroupCommand { command: parts().next().map_or("", |place| commands[place].name()), ids })
    }

    /// Posts the stops of a call that was refused, each that is not refused itself. Returns the error of the call.
    fn post_stops(&mut self, commands: &[Command], refused: GroupError) -> GroupError {
        let stops: Vec<bool> = (self.axes.iter_mut().zip(commands))
            .map(|(axis, command)| command.is_urgent() && axis.accepts(command).is_ok())
            .collect();
        if !stops.contains(&true) {
            return refused;
        }
        let posted = self.post_parts(commands, &stops).or_else(|_| {
            // The queue of the group has no room: each member has one of its own.
            let mut ids = vec![CommandId(0); commands.len()];
            for (place, id) in ids.iter_mut().enumerate().filter(|(place, _)| stops[*place]) {
                *id = self.axes[place].post(commands[place]).unwrap_or_default();
            }
            let first = ids.iter().position(|id| *id != CommandId(0)).ok_or(())?;
            Ok::<_, ()>(GroupCommand { command: commands[first].name(), ids })
        });
        match posted {
            Ok(posted) => GroupError::Partly { posted, refused: Box::new(refused) },
            Err(()) => refused,
        }
    }

    /// Gives the same command to each member.
    pub fn post_all(&mut self, command: Command) -> Result<GroupCommand, GroupError> {
        self.post(&vec![command; self.axes.len()])
    }

    /// The velocity setpoints of all members, user units/s, while they run [`Command::Velocity`] or [`Command::Jog`].
    /// They take effect in the same cycle's send at all members, or at none: each of them has to run the command that
    /// the last call with one gave it. A member that this call gave none ignores its value. The newest set counts; it
    /// has to be renewed before it is older than `setpoint_age` or the dead-man time of a member.
    pub fn set_velocities(&mut self, velocities: &[f64]) -> Result<(), GroupError> {
        self.set(Level::Velocity, velocities)
    }

    /// The torque setpoints of all members, per cent of the rated torque, while they run [`Command::Torque`]; in the
    /// same way as [velocities](Self::set_velocities).
    pub fn set_torques(&mut self, torques: &[f64]) -> Result<(), GroupError> {
        self.set(Level::Torque, torques)
    }

    /// Hands one set of setpoints over, through the first member that takes them.
    fn set(&mut self, level: Level, values: &[f64]) -> Result<(), GroupError> {
        self.count(values.len())?;
        for (axis, value) in self.axes.iter().zip(values) {
            axis.accepts_level(level, *value)?;
        }
        let follows = |axis: &Axis| axis.follows[level as usize] != CommandId(0);
        let count = self.axes.iter().filter(|axis| follows(axis)).count();
        let parts: Vec<Setpoint> = (self.axes.iter_mut().zip(values))
            .filter(|(axis, _)| follows(axis))
            .map(|(axis, value)| axis.setpoint(axis.follows[level as usize], *value, count))
            .collect();
        if let Some(first) = self.axes.iter_mut().find(|axis| follows(axis)) {
            first.give(&parts);
        }
        Ok(())
    }

    /// How many rows the streams have room for.
    pub fn stream_room(&self) -> usize {
        self.axes[0].ends.rows.slots() / self.axes.len()
    }

    /// Queues one row for each member, all or none of them. The loop takes them together.
    pub fn push_rows(&mut self, rows: &[Row]) -> Result<(), GroupError> {
        self.count(rows.len())?;
        if rows.iter().any(|row| row.last) && rows.iter().any(|row| !row.last) {
            return Err(GroupError::MixedEnd);
        }
        let parts: Vec<StreamRow> = (self.axes.iter().zip(rows))
            .map(|(axis, row)| axis.row(*row, rows.len()))
            .collect::<Result<_, _>>()?;
        self.axes[0].send_row(&parts)?;
        self.axes.iter_mut().zip(&parts).for_each(|(axis, part)| axis.sent_row(part));
        Ok(())
    }

    /// Starts to follow the streams, whose first rows should be queued already. Ends with the rows marked `last`.
    pub fn follow(&mut self) -> Result<GroupCommand, GroupError> {
        self.post_all(Command::Follow)
    }

    /// Enables all members and waits until they are in operation.
    pub fn enable(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::Enable)
    }

    /// Powers all members off and waits until they are off.
    pub fn disable(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::Disable)
    }

    /// Homes all members and waits until homing is complete.
    pub fn home(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::Home)
    }

    /// Moves each member to its position (user units) along its own profile and waits until all have arrived. They
    /// start in one cycle; each takes its own time.
    pub fn move_to(&mut self, positions: &[f64]) -> Result<(), GroupError> {
        let profiles: Vec<Profile> = self.axes.iter().map(Axis::profile).collect();
        self.count(positions.len())?;
        let commands: Vec<Command> = (positions.iter().zip(profiles))
            .map(|(position, profile)| Command::Move(Move { target: Target::Absolute(*position), profile }))
            .collect();
        let limit = (self.axes.iter().zip(&commands)).map(|(axis, command)| axis.time_limit(command)).max();
        let command = self.post(&commands)?;
        self.wait(&command, limit.unwrap_or_default() + GRACE)
    }

    /// Ramps all members down and waits for standstill; the drives stay enabled.
    pub fn stop(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::Stop { deceleration: None })
    }

    /// The fastest controlled stop of all members; waits for standstill.
    pub fn quick_stop(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::QuickStop)
    }

    /// Acknowledges the faults of all members.
    pub fn reset_fault(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::ResetFault)
    }

    /// Clears the stop latches of all members.
    pub fn reset(&mut self) -> Result<(), GroupError> {
        self.run_all(Command::Reset)
    }

    /// Waits until `command` has ended at all members. The error is that of the member which caused it, if one did.
    pub fn wait(&mut self, command: &GroupCommand, limit: Duration) -> Result<(), GroupError> {
        let begun = Instant::now();
        let mut errors = Vec::new();
        for (axis, id) in self.axes.iter_mut().zip(&command.ids) {
            if *id == CommandId(0) {
                continue;
            }
            let left = limit.saturating_sub(begun.elapsed());
            errors.extend(axis.wait(*id, command.command, left).err());
        }
        match errors.iter().position(|error| !error.is_of_group()) {
            Some(cause) => Err(errors.swap_remove(cause).into()),
            None => errors.into_iter().next().map_or(Ok(()), |error| Err(error.into())),
        }
    }

    fn run_all(&mut self, command: Command) -> Result<(), GroupError> {
        let limit = self.axes.iter().map(|axis| axis.time_limit(&command)).max().unwrap_or_default();
        match self.post_all(command) {
            Err(GroupError::Partly { posted, refused }) => {
                self.wait(&posted, limit + GRACE)?;
                Err(GroupError::Partly { posted, refused })
            }
            posted => self.wait(&posted?, limit + GRACE),
        }
    }

    fn count(&self, given: usize) -> Result<(), GroupError> {
        let members = self.axes.len();
        if given == members { Ok(()) } else { Err(GroupError::Count { given, members }) }
    }
}

/// Why `axes` cannot form a group.
fn mismatch(axes: &[Axis]) -> Option<GroupError> {
    let other = |axis: &&Axis| !axes[0].shares_machine(axis);
    match axes.iter().find(other) {
        Some(other) => Some(GroupError::TwoMachines(axes[0].name().to_owned(), other.name().to_owned())),
        None => out_of_step(axes.iter().map(Axis::plan)),
    }
}

/// Why axes of one machine cannot act together.
pub(crate) fn out_of_step<'a>(mut axes: impl ExactSizeIterator<Item = &'a AxisPlan>) -> Option<GroupError> {
    let count = axes.len();
    let first = axes.next().filter(|_| count > 1);
    let Some(first) = first else { return Some(GroupError::TooFew(count)) };
    axes.find_map(|other| {
        let why = if (first.divisor, first.phase) != (other.divisor, other.phase) {
            GroupError::OutOfStep
        } else if first.stop.group.is_none() || first.stop.group != other.stop.group {
            GroupError::TwoStopGroups
        } else if first.underrun != other.underrun {
            GroupError::TwoUnderruns
        } else {
            return None;
        };
        Some(why(first.name.clone(), other.name.clone()))
    })
}
