//! The records of one drive: what it did in an executed cycle, and what happened to it. With those of the loop they go
//! to the telemetry thread through a ring.

mod event;

use std::num::NonZeroU32;

pub(crate) use self::event::EventCode;
pub use self::event::EventRecord;
use crate::axis::units::way;
use crate::axis::{Command, CommandId, Feedback, Link, QueuedCommand, Shown, State, StopCause};
use crate::named;
use crate::packed::Part as _;

named! {
    /// The result of a drive's exchange in a cycle.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
    #[repr(u8)]
    pub enum Reply {
        /// None was under way.
        #[default]
        None = 0: "not due",
        /// Owed in a later window.
        Owed = 1: "owed",
        /// Answered.
        Answered = 2: "answered",
        /// Answered, but possibly by the reply to an earlier request.
        Suspect = 3: "suspect",
        /// Not answered in time.
        Missed = 4: "missed",
        /// Refused by the operating system.
        Unsent = 5: "unsent",
        /// Answered by the newest packet of a drive that sends by its own clock, without a round trip.
        Current = 6: "current",
        /// Due, and waiting for its turn on a half-duplex wire.
        Queued = 7: "queued for its turn",
    }
}

impl Reply {
    /// The exchange was missed, or not even sent.
    pub(super) fn is_missed(self) -> bool {
        matches!(self, Reply::Missed | Reply::Unsent)
    }

    /// The exchange has ended.
    pub(super) fn is_end(self) -> bool {
        !matches!(self, Reply::None | Reply::Owed | Reply::Queued)
    }
}

/// One drive in an executed cycle, as it was published.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct DriveRecord {
    /// The slot.
    pub index: u64,
    /// Actual position, user units.
    pub position: f64,
    /// Demand position, user units.
    pub demand: f64,
    /// Actual velocity, user units/s.
    pub velocity: f32,
    /// Motor current, A.
    pub current: f32,
    /// The request left so long after the grid point, ns; `None` = none left in this cycle.
    pub phase_ns: Option<NonZeroU32>,
    /// Difference between the distance to its request before and that of their grid points, ns.
    pub jitter_ns: Option<NonZeroU32>,
    /// From the send stamp until the reply was taken in, ns; `None` for a suspect reply, and where nothing replies.
    pub rtt_ns: Option<NonZeroU32>,
    /// How old the values were when the window closed, ns; `None` before the first, and while the link is down.
    pub age_ns: Option<NonZeroU32>,
    /// Fault code, 0 = none.
    pub fault: u32,
    /// Warning word, 0 = none.
    pub warning: u32,
    /// The axis, in the order of the plan.
    pub axis: u16,
    /// The exchange.
    pub reply: Reply,
    /// The link as evaluated.
    pub link: Link,
    /// State of the drive.
    pub state: State,
    /// The latch.
    pub stopped: Option<StopCause>,
    /// The command that runs, as [`Command::code`](crate::axis::Command::code); 0 = none.
    pub command: u8,
    /// The flags of the drive.
    pub flags: DriveFlags,
}

/// The flags of a drive in a cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct DriveFlags(u8);

impl DriveFlags {
    /// All of them; see [`DriveRecord`].
    #[inline]
    pub fn new(moving: bool, sto_open: bool, was_online: bool) -> DriveFlags {
        DriveFlags(u8::from(moving) | u8::from(sto_open) << 1 | u8::from(was_online) << 2)
    }

    /// As a byte.
    pub(crate) fn bits(self) -> u8 {
        self.0
    }

    /// Those of a byte; `None` if a bit of it means nothing.
    pub(crate) fn of(bits: u8) -> Option<DriveFlags> {
        (bits < 8).then_some(DriveFlags(bits))
    }
}

/// The measurements of a drive in a cycle, as in its [`DriveRecord`].
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Measured {
    pub reply: Reply,
    pub was_online: bool,
    pub phase_ns: Option<NonZeroU32>,
    pub jitter_ns: Option<NonZeroU32>,
    pub rtt_ns: Option<NonZeroU32>,
    pub age_ns: Option<NonZeroU32>,
    /// Not measured, and here since here is room: there is something in the axis' journal.
    pub noted: bool,
}

impl DriveRecord {
    /// Moving, as the drive reports it.
    pub fn moving(&self) -> bool {
        self.flags.0 & 1 != 0
    }

    /// The drive's hardware enable (STO) is missing.
    pub fn sto_open(&self) -> bool {
        self.flags.0 & 2 != 0
    }

    /// The link was up before it was evaluated.
    pub fn was_online(&self) -> bool {
        self.flags.0 & 4 != 0
    }

    /// A value of a drive that has not answered yet is none.
    pub fn reported(&self, value: f64) -> f64 {
        if self.link == Link::Unseen { f64::NAN } else { value }
    }

    /// From the position to the demand: on a rotary axis, of this [`modulo`](crate::axis::Units::modulo), by the
    /// shorter way.
    pub fn following_error(&self, modulo: Option<f64>) -> f64 {
        self.reported(way(modulo, self.position, self.demand))
    }

    /// Of axis `axis`, which runs `command`: what was measured and published.
    #[inline]
    pub(crate) fn new(axis: u16, command: u8, measured: Measured, feedback: &Feedback) -> DriveRecord {
        let Feedback { cycle, link, stopped, ref status, .. } = *feedback;
        let Measured { reply, was_online, phase_ns, jitter_ns, rtt_ns, age_ns, .. } = measured;
        DriveRecord {
            index: cycle,
            position: status.position,
            demand: status.demand,
            velocity: status.velocity as f32,
            current: status.current as f32,
            phase_ns,
            jitter_ns,
            rtt_ns,
            age_ns,
            fault: status.fault,
            warning: status.warning,
            axis,
            reply,
            link,
            state: status.state,
            stopped,
            command,
            flags: DriveFlags::new(status.moving, status.sto_open, was_online),
        }
    }
}

/// The monitored variables of a drive, in the units of the plan: only of cycles in which it reported some.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct MonitorRecord {
    /// The slot.
    pub index: u64,
    /// The axis, in the order of the plan.
    pub axis: u16,
    /// The values.
    pub shown: Shown,
}

named! {
    /// Where a command is.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
    #[repr(u8)]
    pub enum CommandStep {
        /// The loop has taken it; it waits for its turn.
        #[default]
        Taken = 0: "taken",
        /// It begins.
        Begun = 1: "begun",
    }
}

/// A command that the loop has taken, or that begins. Its end is an event.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct CommandRecord {
    /// The slot.
    pub index: u64,
    /// The id.
    pub id: CommandId,
    /// The command. Its first word is its code, which is in the lowest byte; above it the step, a byte, whether it is
    /// one to a group, a byte, and two axes.
    pub(crate) words: [u64; Command::WORDS],
}

impl CommandRecord {
    /// Of a command in a slot that is still to be named.
    pub fn new(step: CommandStep, queued: &QueuedCommand) -> CommandRecord {
        let mut words = [0; Command::WORDS];
        queued.command.put(&mut words);
        let group = queued.call.map_or(0, |call| 1 << 16 | u64::from(call.lead as u16) << 48);
        words[0] |= (step as u64) << 8 | group | u64::from(queued.member as u16) << 32;
        CommandRecord { index: 0, id: queued.id, words }
    }

    /// The axis, in the order of the plan.
    pub fn axis(&self) -> u16 {
        (self.words[0] >> 32) as u16
    }

    /// Of a command to a group: the first axis of it.
    pub fn group(&self) -> Option<u16> {
        (self.words[0] >> 16 & 1 != 0).then_some((self.words[0] >> 48) as u16)
    }

    /// Where it is.
    pub fn step(&self) -> CommandStep {
        if self.words[0] >> 8 & 1 == 0 { CommandStep::Taken } else { CommandStep::Begun }
    }

    /// The command.
    pub fn command(&self) -> Command {
        let [head, others @ ..] = self.words;
        let mut words = [u64::from(head as u8); Command::WORDS];
        words[1..].copy_from_slice(&others);
        Command::take(&words)
    }
}

/// Nanoseconds in a record: saturate at 4.29 s.
pub fn short(ns: u64) -> u32 {
    u32::try_from(ns).unwrap_or(u32::MAX)
}

/// A measured time in a record, at least 1 ns.
#[inline]
pub fn measured(ns: u64) -> Option<NonZeroU32> {
    // Usually the time fits, and is not 0.
    match u32::try_from(ns) {
        Ok(ns @ 1..) => NonZeroU32::new(ns),
        Ok(_) => Some(NonZeroU32::MIN),
        Err(_) => Some(NonZeroU32::MAX),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::DriveStatus;

    #[test]
    fn a_record_shows_the_status_of_its_cycle() {
        let status = DriveStatus {
            state: State::Fault,
            moving: true,
            sto_open: true,
            ..DriveStatus {
                current: 0.25,
                velocity: 0.5,
                position: 3.0,
                demand: 4.0,
                ..DriveStatus::default()
            }
        };
        let status = DriveStatus { fault: 1, warning: 2, ..status };
        let feedback = Feedback { cycle: 7, link: Link::Online, status, ..Feedback::default() };
        let measures = Measured { rtt_ns: measured(0), ..Measured::default() };
        let shown = DriveRecord::new(3, 5, measures, &feedback);
        assert_eq!((shown.index, shown.axis, shown.rtt_ns), (7, 3, NonZeroU32::new(1)));
        assert_eq!((shown.link, shown.command), (Link::Online, 5));
        assert_eq!((shown.state, shown.moving(), shown.sto_open()), (State::Fault, true, true));
        assert!(!shown.was_online());
        assert_eq!((shown.fault, shown.warning), (1, 2));
        assert_eq!((shown.current, shown.velocity, shown.position, shown.demand), (0.25, 0.5, 3.0, 4.0));
        assert_eq!(measured(u64::MAX), NonZeroU32::new(u32::MAX));
    }
}
