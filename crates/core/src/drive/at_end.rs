//! How a drive was left at the end of a run: by its last report, and by what was requested of it.

use std::fmt;

use crate::axis::{Command, Feedback, State, StopCause, Unit};
use crate::named;
use crate::time::Time;

named! {
    /// How a drive was left at the end of a run.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    #[repr(u8)]
    #[non_exhaustive]
    pub enum Condition {
        /// The last report says so: without power, and at standstill.
        Off = 0: "off",
        /// Powered and at standstill, as planned: only the drive holds its vertical load.
        Held = 1: "held",
        /// At standstill, and its power stage may be on.
        Powered = 2: "powered",
        /// Faster than the standstill window, or its motion has not ended; without power it coasts or falls.
        Moving = 3: "moving",
        /// It does not answer, and it had power, was moving, or power was requested after its last report.
        Unknown = 4: "unknown",
    }
}

named! {
    /// The requests of a stop to a drive.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    #[repr(u8)]
    #[non_exhaustive]
    pub enum StopRequest {
        /// A ramp, or the drive's halt.
        Ramp = 0: "ramp",
        /// The drive's own quick stop.
        QuickStop = 1: "quick stop",
        /// Power off.
        PowerOff = 2: "power off",
    }
}

/// The set of what the stop of an axis has requested of its drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Requested(u8);

impl Requested {
    /// Adds what the command requests, if it belongs to a stop.
    pub(super) fn note(&mut self, command: Option<Command>) {
        let request = match command {
            Some(Command::Stop { .. }) => StopRequest::Ramp,
            Some(Command::QuickStop) => StopRequest::QuickStop,
            Some(Command::Disable) => StopRequest::PowerOff,
            _ => return,
        };
        self.0 |= 1 << request as u8;
    }

    fn list(self) -> Vec<StopRequest> {
        StopRequest::ALL.into_iter().filter(|request| self.0 & 1 << *request as u8 != 0).collect()
    }
}

/// The loop's knowledge of a drive besides its last report.
#[derive(Clone, Copy, Debug)]
pub(super) struct LoopFacts {
    /// The standstill window, user units/s.
    pub standstill: f64,
    /// It answered until its bus ended the link.
    pub answers: bool,
    /// Something was requested of it.
    pub ours: bool,
    /// Power on was requested, and no later report shows that it is off.
    pub may_rise: bool,
    /// The stop is complete, and leaves it powered because only the drive holds its load.
    pub holds: bool,
    /// The requests of its stop.
    pub requested: Requested,
    /// The wires were taken from the loop.
    pub stuck: bool,
}

/// A drive at the end of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct AtEnd {
    /// How it was left.
    pub condition: Condition,
    /// The requests of its stop, in this order; empty: it was only read, or the loop was stuck.
    pub requested: Vec<StopRequest>,
    /// The loop has not come to an orderly end, and read no report in it.
    #[cfg_attr(feature = "serde", serde(skip))]
    abandoned: bool,
}

impl AtEnd {
    /// `None`: the drive has never reported its state, and nothing was requested of it.
    pub(super) fn of(known: LoopFacts, feedback: &Feedback) -> Option<AtEnd> {
        let status = &feedback.status;
        let (state, powered) = (status.state, status.state.is_powered());
        // A velocity that is not known (NaN) says nothing. Without power no setpoint generator moves the axis.
        let moves = status.velocity.abs() > known.standstill || powered && status.moving;
        let condition = match known.answers {
            true if state == State::Unknown => known.ours.then_some(Condition::Unknown)?,
            true if moves => Condition::Moving,
            true if powered && known.holds => Condition::Held,
            true if powered => Condition::Powered,
            false if powered || moves || known.may_rise => Condition::Unknown,
            false if state == State::Unknown => known.ours.then_some(Condition::Unknown)?,
            _ => Condition::Off,
        };
        Some(AtEnd { condition, requested: known.requested.list(), abandoned: known.stuck })
    }

    /// Of a drive that the loop has left alone: it has died, or its cycle does not end.
    #[doc(hidden)]
    pub fn abandoned(feedback: &Feedback) -> Option<AtEnd> {
        let end = || AtEnd { condition: Condition::Unknown, requested: Vec::new(), abandoned: true };
        // The link of a loop that is stuck is shown as lost.
        (feedback.status.at != Time(0)).then(end)
    }

    /// Whether the drive is known to be off, or held as planned.
    pub fn is_safe(&self) -> bool {
        matches!(self.condition, Condition::Off | Condition::Held)
    }

    /// In words: how it was left, what was tried, and what to do; nothing of a drive that is off.
    #[doc(hidden)]
    pub fn line(&self, feedback: &Feedback, unit: Unit) -> Option<String> {
        let (state, velocity, cycles) = (feedback.status.state, feedback.status.velocity, feedback.age);
        let speed = if velocity.is_nan() { String::new() } else { format!(" at {velocity:.3} {unit}/s") };
        let how = match self.condition {
            Condition::Off => return None,
            Condition::Held => return Some("stays powered: only the drive holds its vertical load".into()),
            Condition::Powered => format!("is still powered at the end ({state})"),
            Condition::Moving => format!("still moves at the end ({state}{speed})"),
            Condition::Unknown => {
                format!(
                    "may be powered or moving at the end: its last report ({state}) is {cycles} cycles old"
                )
            }
        };
        let only_read = match feedback.stopped {
            Some(StopCause::OtherMaster) => "another master commands it, and this one has only read it",
            Some(StopCause::FoundRunning) => {
                "it was found running and only read, as on_found_running = \"refuse\" says"
            }
            _ => "this master has only read it",
        };
        let off =
            "take its power away by its hardware enable (STO) or its supply before anybody comes near it";
        let (tried, remedy) = match &*self.requested {
            _ if self.abandoned => {
                ("the loop did not come to its end, and has not seen it since".to_owned(), off)
            }
            [] => (only_read.to_owned(), "stop it by what commands it, or by its hardware enable (STO)"),
            requested => (
                match self.condition {
                    Condition::Unknown => format!("{} requested, and nothing answered", Listed(requested)),
                    _ => format!("{} requested and had no effect", Listed(requested)),
                },
                off,
            ),
        };
        Some(format!("{how}; {tried}; {remedy}"))
    }
}

/// Requests in words.
struct Listed<'a>(&'a [StopRequest]);

impl fmt::Display for Listed<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            [] => Ok(()),
            [one] => write!(f, "{one} was"),
            [before @ .., last] => {
                let before: Vec<&str> = before.iter().map(|request| request.name()).collect();
                write!(f, "{} and {last} were", before.join(", "))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::{DriveStatus, Link};

    const OURS: LoopFacts = LoopFacts {
        standstill: 1.0,
        answers: true,
        ours: true,
        may_rise: false,
        holds: false,
        requested: Requested(0),
        stuck: false,
    };

    fn seen(link: Link, state: State, velocity: f64) -> Feedback {
        let status = DriveStatus { state, velocity, ..DriveStatus::default() };
        Feedback { link, status, ..Feedback::default() }
    }

    fn condition(known: LoopFacts, feedback: &Feedback) -> Option<Condition> {
        let known = LoopFacts { answers: matches!(feedback.link, Link::Online | Link::Qualifying), ..known };
        AtEnd::of(known, feedback).map(|end| end.condition)
    }

    #[test]
    fn only_what_is_held_as_planned_is_held_and_what_is_silent_is_off_only_if_nothing_can_have_powered_it() {
        use State::{OperationEnabled, ReadyToSwitchOn, SwitchOnDisabled, Unknown};
        let holds = LoopFacts { holds: true, ..OURS };
        let found = LoopFacts { ours: false, ..OURS };
        let rising = LoopFacts { may_rise: true, ..OURS };
        for (known, link, state, velocity, expected) in [
            (holds, Link::Online, OperationEnabled, 0.0, Some(Condition::Held)),
            (holds, Link::Online, OperationEnabled, 1.1, Some(Condition::Moving)),
            (holds, Link::Online, SwitchOnDisabled, 0.0, Some(Condition::Off)),
            (holds, Link::Lost, OperationEnabled, 0.0, Some(Condition::Unknown)),
            (OURS, Link::Lost, ReadyToSwitchOn, 0.0, Some(Condition::Off)),
            (rising, Link::Lost, ReadyToSwitchOn, 0.0, Some(Condition::Unknown)),
            (OURS, Link::Lost, OperationEnabled, 0.0, Some(Condition::Unknown)),
            (found, Link::Lost, OperationEnabled, 0.0, Some(Condition::Unknown)),
            (OURS, Link::Lost, SwitchOnDisabled, 2.0, Some(Condition::Unknown)),
            (found, Link::Lost, SwitchOnDisabled, 2.0, Some(Condition::Unknown)),
            // Nothing is known of it, and nothing was requested.
            (found, Link::Unseen, Unknown, 0.0, None),
            (OURS, Link::Lost, Unknown, 0.0, Some(Condition::Unknown)),
        ] {
            assert_eq!(condition(known, &seen(link, state, velocity)), expected, "{known:?} {link} {state}");
        }
    }

    #[test]
    fn stop_requests_are_listed_in_their_order() {
        let mut requested = Requested::default();
        requested.note(Some(Command::Enable));
        requested.note(None);
        assert_eq!(requested.list(), []);
        let line = |requested: Requested, feedback: &Feedback| {
            let known = LoopFacts { requested, ..OURS };
            AtEnd::of(known, feedback).and_then(|end| end.line(feedback, Unit::Millimetre))
        };
        let feedback = seen(Link::Online, State::OperationEnabled, 20.0);
        let expected = "still moves at the end (OperationEnabled at 20.000 mm/s); this master has only read \
             it; stop it by what commands it, or by its hardware enable (STO)";
        assert_eq!(line(requested, &feedback).as_deref(), Some(expected));
        for (command, tried) in [
            (Command::Disable, "; power off was requested and had no effect; "),
            (Command::Stop { deceleration: None }, "; ramp and power off were requested and had no effect; "),
            (Command::QuickStop, "; ramp, quick stop and power off were requested and had no effect; "),
        ] {
            requested.note(Some(command));
            let line = line(requested, &feedback).unwrap();
            assert!(line.contains(tried), "{line}");
        }
        for (cause, why) in [
            (StopCause::OtherMaster, "another master commands it"),
            (StopCause::FoundRunning, "on_found_running = \"refuse\""),
        ] {
            let feedback = Feedback { stopped: Some(cause), ..feedback };
            let line = line(Requested::default(), &feedback).unwrap();
            assert!(line.contains(why), "{line}");
        }
        assert_eq!(line(requested, &seen(Link::Online, State::SwitchOnDisabled, 0.0)), None);
    }
}
