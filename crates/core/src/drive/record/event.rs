//! An event of an axis in a record. [`EventKind`] is larger than a record may be, since a failure names its numbers in
//! words; here it is a code, and what the code needs.

use crate::axis::{
    Abort, BegunBy, Command, CommandId, Emergency, EventKind, Failure, Link, Outcome, RangeError, State,
    StopCause,
};

/// What has happened; the ends of commands by their outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum What {
    #[default]
    Link,
    State,
    Fault,
    Warning,
    Emergency,
    Stopped,
    StoClosed,
    MissedInGroup,
    Underrun,
    Restarted,
    PositionJump,
    MonitorRefused,
    Done,
    ReplacedBy,
    AbortedByStop,
    WrongState,
    NotEnabled,
    DriveFault,
    TimedOut,
    NotTaken,
    NotArrived,
    OutOfPosition,
    StillMoves,
    Latched,
    NotOnline,
    Limit,
    NotPositive,
    StoOpen,
    LoadInMotion,
    GroupRefused,
    NotHomed,
    BeingWritten,
    Range,
    NotFinite,
    Unsupported,
    StreamUnderrun,
    Dropped,
}

impl What {
    /// That of a number in a record.
    pub(crate) fn of(number: u8) -> Option<What> {
        // SAFETY: numbered from 0 to the last one, each a byte.
        (number <= What::Dropped as u8).then(|| unsafe { std::mem::transmute::<u8, What>(number) })
    }
}

/// One event of one axis, in as few bytes as a record has. The numbers that its code does not need are 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct EventRecord {
    /// The slot in which it happened.
    pub index: u64,
    /// The command that ended.
    pub(crate) id: u64,
    /// What the values are of.
    pub(crate) text: &'static str,
    pub(crate) values: [f64; 3],
    /// A code of the drive, or the number of a state, a link or a cause.
    pub(crate) number: u32,
    /// The axis, in the order of the plan.
    pub axis: u16,
    pub(crate) what: What,
    /// The code of the command that ended; the register of an emergency, or a channel.
    pub(crate) code: u8,
}

impl EventRecord {
    /// Of an event in slot `index`.
    pub fn new(index: u64, axis: u16, kind: EventKind, begun_by: Option<BegunBy>) -> EventRecord {
        EventRecord { index, axis, ..EventRecord::of(kind) }.begun(begun_by)
    }

    /// Of the end of a command with this [`code`](Command::code), in slot `index`.
    pub(crate) fn ended(index: u64, id: CommandId, code: u8, outcome: Outcome) -> EventRecord {
        EventRecord { index, id: id.0, code, ..EventRecord::of_outcome(outcome) }
    }

    /// The same, if another axis has begun it.
    pub(crate) fn begun(mut self, by: Option<BegunBy>) -> EventRecord {
        if let Some(BegunBy { axis, cause }) = by {
            // Above the number of its own cause.
            self.number |= u32::from(axis) << 16 | (cause as u32) << 8;
        }
        self
    }

    /// The axis that began the stop, if it is one of a stop group.
    pub fn begun_by(&self) -> Option<BegunBy> {
        let is_stop = matches!(self.what, What::Stopped | What::AbortedByStop);
        let cause = StopCause::of(usize::from((self.number >> 8) as u8)).filter(|_| is_stop)?;
        Some(BegunBy { axis: (self.number >> 16) as u16, cause })
    }

    fn of(kind: EventKind) -> EventRecord {
        let number = |what, number| EventRecord { what, number, ..EventRecord::default() };
        match kind {
            EventKind::Ended { id, command, outcome } => {
                let code = Command::NAMES.iter().position(|name| *name == command).unwrap_or(0) as u8;
                EventRecord::ended(0, id, code, outcome)
            }
            EventKind::Link(link) => number(What::Link, link as u32),
            EventKind::State(state) => number(What::State, state as u32),
            EventKind::Fault(code) => number(What::Fault, code),
            EventKind::Warning(word) => number(What::Warning, word),
            EventKind::Emergency(Emergency { code, register }) => {
                EventRecord { code: register, ..number(What::Emergency, code.into()) }
            }
            EventKind::Stopped(cause) => number(What::Stopped, cause as u32),
            EventKind::StoClosed(closed) => number(What::StoClosed, closed.into()),
            EventKind::MissedInGroup => number(What::MissedInGroup, 0),
            EventKind::Underrun => number(What::Underrun, 0),
            EventKind::Restarted => number(What::Restarted, 0),
            EventKind::PositionJump(by) => {
                EventRecord { values: [by, 0.0, 0.0], ..number(What::PositionJump, 0) }
            }
            EventKind::MonitorRefused { channel, status } => {
                EventRecord { code: channel, ..number(What::MonitorRefused, status) }
            }
        }
    }

    fn of_outcome(outcome: Outcome) -> EventRecord {
        let number = |what, number| EventRecord { what, number, ..EventRecord::default() };
        let failure = match outcome {
            Outcome::Done => return number(What::Done, 0),
            Outcome::Aborted(Abort::Replaced(CommandId(by))) => {
                return EventRecord { values: [f64::from_bits(by), 0.0, 0.0], ..number(What::ReplacedBy, 0) };
            }
            Outcome::Aborted(Abort::Stopped(cause)) => return number(What::AbortedByStop, cause as u32),
            Outcome::Failed(failure) => failure,
        };
        match failure {
            Failure::WrongState(state) => number(What::WrongState, state as u32),
            Failure::NotEnabled => number(What::NotEnabled, 0),
            Failure::DriveFault(code) => number(What::DriveFault, code),
            Failure::TimedOut(state) => number(What::TimedOut, state as u32),
            Failure::NotTaken => number(What::NotTaken, 0),
            Failure::NotArrived => number(What::NotArrived, 0),
            Failure::OutOfPosition { distance, window } => {
                EventRecord { values: [distance, window, 0.0], ..number(What::OutOfPosition, 0) }
            }
            Failure::StillMoves => number(What::StillMoves, 0),
            Failure::Latched(cause) => number(What::Latched, cause as u32),
            Failure::NotOnline => number(What::NotOnline, 0),
            Failure::Limit { what, value, low, high } => {
                EventRecord { text: what, values: [value, low, high], ..number(What::Limit, 0) }
            }
            Failure::NotPositive { what, value } => {
                EventRecord { text: what, values: [value, 0.0, 0.0], ..number(What::NotPositive, 0) }
            }
            Failure::StoOpen => number(What::StoOpen, 0),
            Failure::LoadInMotion => number(What::LoadInMotion, 0),
            Failure::GroupRefused => number(What::GroupRefused, 0),
            Failure::NotHomed => number(What::NotHomed, 0),
            Failure::BeingWritten => number(What::BeingWritten, 0),
            Failure::Range(RangeError { value, unit, low, high }) => {
                EventRecord { text: unit, values: [value, low, high], ..number(What::Range, 0) }
            }
            Failure::NotFinite => number(What::NotFinite, 0),
            Failure::Unsupported(why) => EventRecord { text: why, ..number(What::Unsupported, 0) },
            Failure::Underrun => number(What::StreamUnderrun, 0),
            Failure::Dropped(state) => number(What::Dropped, state as u32),
        }
    }

    /// The event; `None` if its numbers have no meaning here.
    pub fn kind(&self) -> Option<EventKind> {
        Some(match self.what {
            What::Link => EventKind::Link(*Link::ALL.get(self.number as usize)?),
            What::State => EventKind::State(self.state()?),
            What::Fault => EventKind::Fault(self.number),
            What::Warning => EventKind::Warning(self.number),
            What::Emergency => {
                let code = u16::try_from(self.number).ok()?;
                EventKind::Emergency(Emergency { code, register: self.code })
            }
            What::Stopped => EventKind::Stopped(self.cause()?),
            What::StoClosed => EventKind::StoClosed(self.number != 0),
            What::MissedInGroup => EventKind::MissedInGroup,
            What::Underrun => EventKind::Underrun,
            What::Restarted => EventKind::Restarted,
            What::PositionJump => EventKind::PositionJump(self.values[0]),
            What::MonitorRefused => EventKind::MonitorRefused { channel: self.code, status: self.number },
            _ => {
                let command = Command::NAMES.get(usize::from(self.code))?;
                EventKind::Ended { id: CommandId(self.id), command, outcome: self.outcome()? }
            }
        })
    }

    fn outcome(&self) -> Option<Outcome> {
        let [value, low, high] = self.values;
        Some(Outcome::Failed(match self.what {
            What::Done => return Some(Outcome::Done),
            What::ReplacedBy => {
                return Some(Outcome::Aborted(Abort::Replaced(CommandId(value.to_bits()))));
            }
            What::AbortedByStop => return Some(Outcome::Aborted(Abort::Stopped(self.cause()?))),
            What::WrongState => Failure::WrongState(self.state()?),
            What::NotEnabled => Failure::NotEnabled,
            What::DriveFault => Failure::DriveFault(self.number),
            What::TimedOut => Failure::TimedOut(self.state()?),
            What::NotTaken => Failure::NotTaken,
            What::NotArrived => Failure::NotArrived,
            What::OutOfPosition => Failure::OutOfPosition { distance: value, window: low },
            What::StillMoves => Failure::StillMoves,
            What::Latched => Failure::Latched(self.cause()?),
            What::NotOnline => Failure::NotOnline,
            What::Limit => Failure::Limit { what: self.text, value, low, high },
            What::NotPositive => Failure::NotPositive { what: self.text, value },
            What::StoOpen => Failure::StoOpen,
            What::LoadInMotion => Failure::LoadInMotion,
            What::GroupRefused => Failure::GroupRefused,
            What::NotHomed => Failure::NotHomed,
            What::BeingWritten => Failure::BeingWritten,
            What::Range => Failure::Range(RangeError { value, unit: self.text, low, high }),
            What::NotFinite => Failure::NotFinite,
            What::Unsupported => Failure::Unsupported(self.text),
            What::StreamUnderrun => Failure::Underrun,
            What::Dropped => Failure::Dropped(self.state()?),
            _ => return None,
        }))
    }

    fn state(&self) -> Option<State> {
        State::ALL.get(self.number as usize).copied()
    }

    fn cause(&self) -> Option<StopCause> {
        StopCause::of(usize::from(self.number as u8))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failures() -> Vec<Failure> {
        vec![
            Failure::NotEnabled,
            Failure::DriveFault(u32::MAX),
            Failure::NotTaken,
            Failure::NotArrived,
            Failure::OutOfPosition { distance: -0.7, window: 0.5 },
            Failure::StillMoves,
            Failure::NotOnline,
            Failure::Limit { what: "position", value: 1e300, low: -0.1, high: 60.000_000_000_1 },
            Failure::NotPositive { what: "velocity", value: -1.0 },
            Failure::StoOpen,
            Failure::LoadInMotion,
            Failure::GroupRefused,
            Failure::NotHomed,
            Failure::BeingWritten,
            Failure::Range(RangeError { value: 1.0, unit: "mm", low: 2.0, high: 3.0 }),
            Failure::NotFinite,
            Failure::Unsupported("no torque"),
            Failure::Underrun,
        ]
    }

    /// Every kind of event, with every state, link and cause.
    fn kinds() -> Vec<EventKind> {
        let mut failures = failures();
        failures.extend(State::ALL.iter().flat_map(|state| {
            [Failure::WrongState(*state), Failure::TimedOut(*state), Failure::Dropped(*state)]
        }));
        failures.extend(StopCause::ALL.map(Failure::Latched));
        let mut outcomes = vec![Outcome::Done, Outcome::Aborted(Abort::Replaced(CommandId::of_task(7)))];
        outcomes.extend(StopCause::ALL.map(|cause| Outcome::Aborted(Abort::Stopped(cause))));
        outcomes.extend(failures.into_iter().map(Outcome::Failed));
        let ended = |outcome| EventKind::Ended { id: CommandId(u64::MAX), command: "quick stop", outcome };
        let mut kinds: Vec<EventKind> = outcomes.into_iter().map(ended).collect();
        kinds.extend(Link::ALL.map(EventKind::Link));
        kinds.extend(State::ALL.map(EventKind::State));
        kinds.extend(StopCause::ALL.map(EventKind::Stopped));
        kinds.extend([
            EventKind::Fault(u32::MAX),
            EventKind::Warning(3),
            EventKind::Emergency(Emergency { code: u16::MAX, register: 8 }),
            EventKind::StoClosed(true),
            EventKind::StoClosed(false),
            EventKind::MissedInGroup,
            EventKind::Underrun,
            EventKind::Restarted,
            EventKind::PositionJump(-338.9),
            EventKind::MonitorRefused { channel: 3, status: 0xD4 },
        ]);
        kinds
    }

    #[test]
    fn every_event_survives_its_record() {
        let mut seen = std::collections::BTreeSet::new();
        let by = BegunBy { axis: u16::MAX, cause: StopCause::PositionJump };
        for kind in kinds() {
            let begun_by = kind.is_of_stop_group().then_some(by);
            let record = EventRecord::new(7, 3, kind, begun_by);
            seen.insert(record.what as u8);
            assert_eq!((record.index, record.axis, record.kind()), (7, 3, Some(kind)));
            assert_eq!(record.begun_by(), begun_by, "{kind}");
        }
        assert_eq!(seen.len(), What::Dropped as usize + 1, "a kind of event is missing in this test");
    }

    #[test]
    fn numbers_without_a_meaning_are_no_event() {
        let event = |what, number| EventRecord { what, number, ..EventRecord::default() };
        for what in [What::Link, What::State, What::Stopped, What::WrongState, What::Latched] {
            assert_eq!(event(what, 99).kind(), None, "{what:?}");
        }
        assert_eq!(event(What::Stopped, 0).kind(), None);
        assert_eq!(event(What::Emergency, 0x1_0000).kind(), None);
        assert_eq!(EventRecord { code: 99, ..event(What::Done, 0) }.kind(), None);
    }
}
