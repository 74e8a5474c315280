//! The loop's reports to the telemetry thread: fixed-size records through a ring, one per drive, a second one per
//! drive that reports monitored variables, one of the bus clock that leads the grid, if any, and one per cycle; one
//! per command and event; and some per drive whose native process data are recorded. A full ring loses records, never
//! truth: the counts and extremes that the loop keeps itself are exact, and the loss is counted.

use crate::drive::journal::Note;
pub use crate::drive::record::{
    CommandRecord, CommandStep, DriveFlags, DriveRecord, EventRecord, MonitorRecord, Reply, measured, short,
};
use crate::named;
use crate::time::Time;

/// One record. All others come before that of their cycle; those of native process data before the ones of the drives,
/// those of commands and events, axis by axis, after them.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(u8)]
pub enum Record {
    /// One drive in an executed cycle.
    Drive(DriveRecord),
    /// The monitored variables of a drive in an executed cycle, after its other record.
    Monitor(MonitorRecord),
    /// The bus clock that leads the grid in an executed cycle; absent if ours leads.
    Reference(ReferenceRecord),
    /// One executed cycle.
    Cycle(CycleRecord),
    /// Slots passed over.
    Skipped(SkippedRecord),
    /// A command that was taken, or begins.
    Command(CommandRecord),
    /// An event of an axis, the ends of its commands among them.
    Event(EventRecord),
    /// A part of the native process data of a drive.
    Native(NativeRecord),
}

impl From<Note> for Record {
    fn from(note: Note) -> Record {
        match note {
            Note::Command(record) => Record::Command(record),
            Note::Event(record) => Record::Event(record),
        }
    }
}

impl Record {
    /// The axis that it is of, in the order of the plan.
    #[doc(hidden)]
    pub fn axis(&self) -> Option<usize> {
        let axis = match self {
            Record::Drive(DriveRecord { axis, .. })
            | Record::Monitor(MonitorRecord { axis, .. })
            | Record::Event(EventRecord { axis, .. })
            | Record::Native(NativeRecord { axis, .. }) => *axis,
            Record::Command(command) => command.axis(),
            Record::Reference(_) | Record::Cycle(_) | Record::Skipped(_) => return None,
        };
        Some(axis.into())
    }

    /// The slot; of slots passed over, the first. An event between two cycles has the slot of the next one.
    pub fn index(&self) -> u64 {
        match self {
            Record::Drive(DriveRecord { index, .. })
            | Record::Monitor(MonitorRecord { index, .. })
            | Record::Reference(ReferenceRecord { index, .. })
            | Record::Cycle(CycleRecord { index, .. })
            | Record::Command(CommandRecord { index, .. })
            | Record::Event(EventRecord { index, .. })
            | Record::Native(NativeRecord { index, .. })
            | Record::Skipped(SkippedRecord { first: index, .. }) => *index,
        }
    }
}

named! {
    /// The stages of a cycle, in their order.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
    #[repr(u8)]
    pub enum Stage {
        /// Draining the sockets and handing the requests to the kernel.
        Send = 0: "send",
        /// Taking in replies until the window closes.
        Receive = 1: "receive",
        /// Link health, limits, stop sequences.
        Evaluate = 2: "evaluate",
        /// Command queues and the in-loop task, and what they desire of each drive.
        Commands = 3: "commands",
        /// Building the next requests.
        Prepare = 4: "prepare",
        /// Feedback, events, records.
        Publish = 5: "publish",
    }
}

/// One executed cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct CycleRecord {
    /// The slot.
    pub index: u64,
    /// The instant of its slot on the grid.
    pub grid: Time,
    /// Begin of the cycle after its grid point, ns.
    pub wake_ns: u32,
    /// Difference between the distance to the begin of the cycle before and that of their grid points, ns.
    pub jitter_ns: u32,
    /// How long each [`Stage`] took, ns.
    pub stages_ns: [u32; 6],
    /// The kernel's counts against the loop's thread; read only after a late cycle.
    pub look: Option<Look>,
    /// Exchanges with drives that are online, not answered in this window.
    pub missed: u16,
    /// The loop was awake before the grid point and spun up to it.
    pub spun: bool,
}

/// A report of the clock that leads the grid in an executed cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ReferenceRecord {
    /// The slot.
    pub index: u64,
    /// How far the slot was from where that clock wants it, ns: positive is late; `None` = not reported.
    pub error_ns: Option<i32>,
    /// How much longer than a period the distance to the next slot is, ns.
    pub step_ns: i32,
    /// The grid is locked.
    pub locked: bool,
    /// The grid is locked, or was locked before: its errors count.
    pub counts: bool,
}

/// A part of the native process data of a drive that is chosen for it: of the inputs, as they were received in an
/// executed cycle, followed by the outputs, as they were sent in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct NativeRecord {
    /// The slot.
    pub index: u64,
    /// The inputs were taken in so long after the grid point, ns.
    pub received_ns: u32,
    /// The axis, in the order of the plan.
    pub axis: u16,
    /// Bytes of inputs and outputs together.
    pub total: u16,
    /// Bytes of the inputs; 0: none were received.
    pub inputs: u16,
    /// Where this part begins.
    pub offset: u16,
    /// The part. What follows the end of the last one means nothing.
    pub bytes: [u8; NativeRecord::PART],
}

impl NativeRecord {
    /// Bytes of a part, except for the last one.
    pub const PART: usize = 44;

    /// The bytes of this part.
    pub fn part(&self) -> &[u8] {
        let rest = usize::from(self.total.saturating_sub(self.offset));
        &self.bytes[..rest.min(NativeRecord::PART)]
    }
}

/// Slots passed over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct SkippedRecord {
    /// The first of them.
    pub first: u64,
    /// The instant of the first on the grid.
    pub grid: Time,
    /// How many.
    pub count: u64,
    /// How late the first of them is when the next executed one begins, ns; each further one is a period less.
    pub late_ns: u64,
    /// How late the first was when it was given up, ns.
    pub given_up_ns: u64,
    /// The loop woke too late to begin; otherwise the cycle before took too long.
    pub woke_late: bool,
    /// A late cycle of its own: the cycle before was not late itself.
    pub late: bool,
    /// It was awake before the grid point of the first.
    pub spun: bool,
    /// As of a cycle.
    pub look: Option<Look>,
}

/// The kernel's counts against the loop's thread since it began, modulo 2^32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct Look {
    /// Page faults.
    pub faults: u32,
    /// Involuntary context switches.
    pub switches: u32,
}

/// Why a cycle counts as late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lateness {
    /// It began so long after its grid point, ns.
    Wake(u64),
    /// A stage took so long, ns. For the receive stage: so long beyond the deadline.
    Stage(Stage, u64),
    /// A drive that is online had not answered at the deadline.
    Reply,
}

impl Lateness {
    /// How long, ns.
    pub fn ns(self) -> u64 {
        match self {
            Lateness::Wake(ns) | Lateness::Stage(_, ns) => ns,
            Lateness::Reply => 0,
        }
    }
}

impl CycleRecord {
    /// Whether this cycle is late, by more than `late_ns`, with replies taken until `deadline_ns` after the grid
    /// point. The longest of its delays is named: the others follow from it.
    #[inline]
    pub fn lateness(&self, late_ns: u64, deadline_ns: u64) -> Option<Lateness> {
        let wake_ns = u64::from(self.wake_ns);
        let mut delays = self.stages_ns.map(u64::from);
        let begin = wake_ns + delays[Stage::Send as usize];
        let received = begin + delays[Stage::Receive as usize];
        delays[Stage::Receive as usize] = received.saturating_sub(deadline_ns.max(begin));
        let longest = delays.into_iter().fold(wake_ns, u64::max);
        // Usually none is long.
        if longest <= late_ns {
            return (self.missed > 0).then_some(Lateness::Reply);
        }
        let stage = Stage::ALL.into_iter().zip(delays).find(|(_, ns)| *ns == longest && wake_ns < longest);
        Some(stage.map_or(Lateness::Wake(wake_ns), |(stage, ns)| Lateness::Stage(stage, ns)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::US;

    #[test]
    fn the_longest_delay_makes_a_cycle_late() {
        let us = |us: u64| short(us * US);
        let late = |wake, stages: [u64; 6], missed| {
            let record =
                CycleRecord { wake_ns: us(wake), stages_ns: stages.map(us), missed, ..Default::default() };
            record.lateness(100 * US, 500 * US)
        };
        assert_eq!(late(100, [40, 360, 100, 1, 1, 1], 0), None);
        assert_eq!(late(101, [40, 360, 1, 1, 1, 1], 1), Some(Lateness::Wake(101 * US)));
        assert_eq!(late(101, [140, 260, 1, 1, 1, 1], 0), Some(Lateness::Stage(Stage::Send, 140 * US)));
        assert_eq!(late(9, [40, 1, 1, 900, 1, 1], 0), Some(Lateness::Stage(Stage::Commands, 900 * US)));
        // The window may last until its deadline; a drive that is missing then is a cause of its own.
        assert_eq!(late(9, [40, 451, 1, 1, 1, 1], 1), Some(Lateness::Reply));
        assert_eq!(late(0, [50, 551, 1, 1, 1, 1], 1), Some(Lateness::Stage(Stage::Receive, 101 * US)));
        // A window that began beyond its deadline is not charged for earlier delays.
        assert_eq!(late(90, [450, 99, 1, 1, 1, 1], 0), Some(Lateness::Stage(Stage::Send, 450 * US)));
    }
}
