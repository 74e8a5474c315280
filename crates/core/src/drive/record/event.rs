//! An event of an axis in a record. [`EventKind`] is larger than a record may be, since a failure names its numbers in
//! words; here it is a code, and what the code needs.

use crate::axis::{
    Abort, BegunBy, Command, CommandId, Emergency, EventKind, Failure, Link, Outcome, RangeError, State,
    StopCause,
};

/// The code of an event; the ends of commands by their outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum EventCode {
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

impl EventCode {
    /// That of a number in a record.
    pub(crate) fn of(number: u8) -> Option<EventCode> {
        // SAFETY: numbered from 0 to the last one, each a byte.
        (number <= EventCode::Dropped as u8).then(|| unsafe { std::mem::transmute::<u8, EventCode>(number) })
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
    /// The quantity of the values.
    pub(crate) text: &'static str,
    pub(crate) values: [f64; 3],
    /// A code of the drive, or the number of a state, a link or a cause.
    pub(crate) number: u32,
    /// The axis, in the order of the plan.
    pub axis: u16,
    pub(crate) what: EventCode,
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
        let is_stop = matches!(self.what, EventCode::Stopped | EventCode::AbortedByStop);
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
            EventKind::Link(link) => number(EventCode::Link, link as u32),
            EventKind::State(state) => number(EventCode::State, state as u32),
            EventKind::Fault(code) => number(EventCode::Fault, code),
            EventKind::Warning(word) => number(EventCode::Warning, word),
            EventKind::Emergency(Emergency { code, register }) => {
                EventRecord { code: register, ..number(EventCode::Emergency, code.into()) }
            }
            EventKind::Stopped(cause) => number(EventCode::Stopped, cause as u32),
            EventKind::StoClosed(closed) => number(EventCode::StoClosed, closed.into()),
            EventKind::MissedInGroup => number(EventCode::MissedInGroup, 0),
            EventKind::Underrun => number(EventCode::Underrun, 0),
            EventKind::Restarted => number(EventCode::Restarted, 0),
            EventKind::PositionJump(by) => {
                EventRecord { values: [by, 0.0, 0.0], ..number(EventCode::PositionJump, 0) }
            }
            EventKind::MonitorRefused { channel, status } => {
                EventRecord { code: channel, ..number(EventCode::MonitorRefused, status) }
            }
        }
    }

    fn of_outcome(outcome: Outcome) -> EventRecord {
        let number = |what, number| EventRecord { what, number, ..EventRecord::default() };
        let failure = match outcome {
            Outcome::Done => return number(EventCode::Done, 0),
            Outcome::Aborted(Abort::Replaced(CommandId(by))) => {
                return EventRecord {
                    values: [f64::from_bits(by), 0.0, 0.0],
                    ..number(EventCode::ReplacedBy, 0)
                };
            }
            Outcome::Aborted(Abort::Stopped(cause)) => return number(EventCode::AbortedByStop, cause as u32),
            Outcome::Failed(failure) => failure,
        };
        match failure {
            Failure::WrongState(state) => number(EventCode::WrongState, state as u32),
            Failure::NotEnabled => number(EventCode::NotEnabled, 0),
            Failure::DriveFault(code) => number(EventCode::DriveFault, code),
            Failure::TimedOut(state) => number(EventCode::TimedOut, state as u32),
            Failure::NotTaken => number(EventCode::NotTaken, 0),
            Failure::NotArrived => number(EventCode::NotArrived, 0),
            Failure::OutOfPosition { distance, window } => {
                EventRecord { values: [distance, window, 0.0], ..number(EventCode::OutOfPosition, 0) }
            }
            Failure::StillMoves => number(EventCode::StillMoves, 0),
            Failure::Latched(cause) => number(EventCode::Latched, cause as u32),
            Failure::NotOnline => number(EventCode::NotOnline, 0),
            Failure::Limit { what, value, low, high } => {
                EventRecord { text: what, values: [value, low, high], ..number(EventCode::Limit, 0) }
            }
            Failure::NotPositive { what, value } => {
                EventRecord { text: what, values: [value, 0.0, 0.0], ..number(EventCode::NotPositive, 0) }
            }
            Failure::StoOpen => number(EventCode::StoOpen, 0),
            Failure::LoadInMotion => number(EventCode::LoadInMotion, 0),
            Failure::GroupRefused => number(EventCode::GroupRefused, 0),
            Failure::NotHomed => number(EventCode::NotHomed, 0),
            Failure::BeingWritten => number(EventCode::BeingWritten, 0),
            Failure::Range(RangeError { value, unit, low, high }) => {
                EventRecord { text: unit, values: [value, low, high], ..number(EventCode::Range, 0) }
            }
            Failure::NotFinite => number(EventCode::NotFinite, 0),
            Failure::Unsupported(why) => EventRecord { text: why, ..number(EventCode::Unsupported, 0) },
            Failure::Underrun => number(EventCode::StreamUnderrun, 0),
            Failure::Dropped(state) => number(EventCode::Dropped, state as u32),
        }
    }

    /// The event; `None` if its numbers have no meaning here.
    pub fn kind(&self) -> Option<EventKind> {
        Some(match self.what {
            EventCode::Link => EventKind::Link(*Link::ALL.get(self.number as usize)?),
            EventCode::State => EventKind::State(self.state()?),
            EventCode::Fault => EventKind::Fault(self.number),
            EventCode::Warning => EventKind::Warning(self.number),
            EventCode::Emergency => {
                let code = u16::try_from(self.number).ok()?;
                EventKind::Emergency(Emergency { code, register: self.code })
            }
            EventCode::Stopped => EventKind::Stopped(self.cause()?),
            EventCode::StoClosed => EventKind::StoClosed(self.number != 0),
            EventCode::MissedInGroup => EventKind::MissedInGroup,
            EventCode::Underrun => EventKind::Underrun,
            EventCode::Restarted => EventKind::Restarted,
            EventCode::PositionJump => EventKind::PositionJump(self.values[0]),
            EventCode::MonitorRefused => {
                EventKind::MonitorRefused { channel: self.code, status: self.number }
            }
            _ => {
                let command = Command::NAMES.get(usize::from(self.code))?;
                EventKind::Ended { id: CommandId(self.id), command, outcome: self.outcome()? }
            }
        })
    }

    fn outcome(&self) -> Option<Outcome> {
        let [value, low, high] = self.values;
        Some(Outcome::Failed(match self.what {
            EventCode::Done => return Some(Outcome::Done),
            EventCode::ReplacedBy => {
                return Some(Outcome::Aborted(Abort::Replaced(CommandId(value.to_bits()))));
            }
            EventCode::AbortedByStop => return Some(Outcome::Aborted(Abort::Stopped(self.cause()?))),
            EventCode::WrongState => Failure::WrongState(self.state()?),
            EventCode::NotEnabled => Failure::NotEnabled,
            EventCode::DriveFault => Failure::DriveFault(self.number),
            EventCode::TimedOut => Failure::TimedOut(self.state()?),
            EventCode::NotTaken => Failure::NotTaken,
            EventCode::NotArrived => Failure::NotArrived,
            EventCode::OutOfPosition => Failure::OutOfPosition { distance: value, window: low },
            EventCode::StillMoves => Failure::StillMoves,
            EventCode::Latched => Failure::Latched(self.cause()?),
            EventCode::NotOnline => Failure::NotOnline,
            EventCode::Limit => Failure::Limit { what: self.text, value, low, high },
            EventCode::NotPositive => Failure::NotPositive { what: self.text, value },
            EventCode::StoOpen => Failure::StoOpen,
            EventCode::LoadInMotion => Failure::LoadInMotion,
            EventCode::GroupRefused => Failure::GroupRefused,
            EventCode::NotHomed => Failure::NotHomed,
            EventCode::BeingWritten => Failure::BeingWritten,
            EventCode::Range => Failure::Range(RangeError { value, unit: self.text, low, high }),
            EventCode::NotFinite => Failure::NotFinite,
            EventCode::Unsupported => Failure::Unsupported(self.text),
            EventCode::StreamUnderrun => Failure::Underrun,
            EventCode::Dropped => Failure::Dropped(self.state()?),
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
        assert_eq!(seen.len(), EventCode::Dropped as usize + 1, "a kind of event is missing in this test");
    }

    #[test]
    fn numbers_without_a_meaning_are_no_event() {
        let event = |what, number| EventRecord { what, number, ..EventRecord::default() };
        for what in
            [EventCode::Link, EventCode::State, EventCode::Stopped, EventCode::WrongState, EventCode::Latched]
        {
            assert_eq!(event(what, 99).kind(), None, "{what:?}");
        }
        assert_eq!(event(EventCode::Stopped, 0).kind(), None);
        assert_eq!(event(EventCode::Emergency, 0x1_0000).kind(), None);
        assert_eq!(EventRecord { code: 99, ..event(EventCode::Done, 0) }.kind(), None);
    }
}
