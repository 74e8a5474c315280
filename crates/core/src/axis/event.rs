//! What happened to an axis: each event reported once, in order.

use std::fmt;

use super::command::{Abort, CommandId, Outcome};
use super::feedback::{BegunBy, Fault, Link, State, StopCause};
use crate::time::Time;

/// One event of one axis. It comes a moment before the feedback of its cycle: the rest of the cycle lies between the
/// two.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Event {
    /// The cycle in which it happened.
    pub cycle: u64,
    /// When the loop noticed it.
    pub at: Time,
    /// The kind of event.
    pub kind: EventKind,
    /// Which axis began the stop, and why, if this is one of [`StopCause::Group`], or a command that ended by it.
    pub begun_by: Option<BegunBy>,
}

/// A drive's own report of an error, or of the error's end: an emergency (CiA 301).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Emergency {
    /// The error code, named like the faults of the drive's protocol; 0 = an error is over.
    pub code: u16,
    /// The error register of the drive, 1001h.
    pub register: u8,
}

impl Emergency {
    /// In words; `fault` is its code with the name, if it has one.
    pub fn described(self, fault: Fault<'_>) -> String {
        match self.code {
            0 => format!("emergency: error over, register {:#04x}", self.register),
            _ => format!("emergency {fault}, register {:#04x}", self.register),
        }
    }
}

/// The kinds of events of an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum EventKind {
    /// A command ended.
    Ended {
        /// The id.
        id: CommandId,
        /// The command's name.
        command: &'static str,
        /// The end.
        outcome: Outcome,
    },
    /// The link changed.
    Link(Link),
    /// The drive changed its state.
    State(State),
    /// The drive reports this fault (0 = no longer).
    Fault(u32),
    /// The drive's warning word changed.
    Warning(u32),
    /// The drive reported an emergency, whether or not a fault or a warning follows from it.
    /// [`Axis::fault`](crate::axis::Axis::fault) has the name of its code.
    Emergency(Emergency),
    /// The master stopped the axis; latched until reset.
    Stopped(StopCause),
    /// The drive's hardware enable (STO) is closed (true) or missing (false).
    StoClosed(bool),
    /// An exchange of this axis was missed while its group was in motion: the other members went on.
    MissedInGroup,
    /// A stream ran empty; its policy says what follows. Reported once, until rows come again.
    Underrun,
    /// The drive was restarted or replaced, or its software was stopped: earlier knowledge of it was discarded.
    Restarted,
    /// The reported position jumped by so much, user units, farther than the axis can have moved: positions count no
    /// longer from its reference, and the axis is not homed.
    PositionJump(f64),
    /// The drive refuses to report the variable of this monitoring channel; its status says why.
    MonitorRefused {
        /// The channel, from 0.
        channel: u8,
        /// The drive's own status.
        status: u32,
    },
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&BegunBy::after(format!("cycle {}: {}", self.cycle, self.kind), self.begun_by, None))
    }
}

impl EventKind {
    /// The code that its drive may have a name for.
    #[doc(hidden)]
    pub fn fault(&self) -> Option<u32> {
        match *self {
            EventKind::Ended { outcome, .. } => outcome.fault(),
            EventKind::Fault(code) => Some(code).filter(|code| *code != 0),
            EventKind::Emergency(emergency) => Some(emergency.code.into()),
            _ => None,
        }
    }

    /// It is a stop with the stop group, or a command that ended by that.
    pub(crate) fn is_of_stop_group(&self) -> bool {
        matches!(
            self,
            EventKind::Stopped(StopCause::Group)
                | EventKind::Ended { outcome: Outcome::Aborted(Abort::Stopped(StopCause::Group)), .. }
        )
    }

    /// As an entry of a recording: its kind, its text, its number. `name_of` names a code of the drive.
    #[doc(hidden)]
    pub fn entry(&self, name_of: impl Fn(u32) -> Option<String>) -> (&'static str, String, u32) {
        let fault = |code| Fault { code, name: name_of(code).as_deref() }.to_string();
        match *self {
            EventKind::Ended { outcome, .. } => {
                let code = outcome.fault().unwrap_or(0);
                ("ended", outcome.described(name_of(code).as_deref()), code)
            }
            EventKind::Link(link) => ("link", link.to_string(), link as u32),
            EventKind::State(state) => ("state", state.to_string(), state as u32),
            EventKind::Fault(code) => ("fault", fault(code), code),
            EventKind::Warning(word) => ("warning", format!("{word:#06x}"), word),
            EventKind::Emergency(emergency) => {
                let code = emergency.code.into();
                let name = name_of(code);
                ("emergency", emergency.described(Fault { code, name: name.as_deref() }), code)
            }
            EventKind::Stopped(cause) => ("stopped", cause.to_string(), cause as u32),
            EventKind::StoClosed(closed) => {
                ("hardware enable", if closed { "closed" } else { "missing" }.to_owned(), closed.into())
            }
            EventKind::MissedInGroup => ("missed in group", String::new(), 0),
            EventKind::Underrun => ("underrun", String::new(), 0),
            EventKind::Restarted => ("restarted", String::new(), 0),
            EventKind::PositionJump(by) => ("position jumped", format!("{by:.3}"), 0),
            EventKind::MonitorRefused { channel, status } => {
                ("monitor refused", format!("channel {}", channel + 1), status)
            }
        }
    }

    /// In words, with the protocol's name for that code.
    #[doc(hidden)]
    pub fn described(&self, name: Option<&str>) -> String {
        match *self {
            EventKind::Fault(code) if code != 0 => format!("fault {}", Fault { code, name }),
            EventKind::Emergency(emergency) => {
                emergency.described(Fault { code: emergency.code.into(), name })
            }
            _ => self.to_string(),
        }
    }
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            EventKind::Ended { id, command, outcome } => write!(f, "{command} (command {}) {outcome}", id.0),
            EventKind::Link(link) => write!(f, "link {link}"),
            EventKind::State(state) => write!(f, "state {state}"),
            EventKind::Fault(0) => write!(f, "fault gone"),
            EventKind::Fault(code) => write!(f, "fault {code:#06x}"),
            EventKind::Warning(0) => write!(f, "warnings gone"),
            EventKind::Warning(word) => write!(f, "warnings {word:#06x}"),
            EventKind::Emergency(emergency) => {
                let code = emergency.code.into();
                f.write_str(&emergency.described(Fault { code, name: None }))
            }
            EventKind::Stopped(cause) => write!(f, "stopped: {cause}"),
            EventKind::StoClosed(true) => write!(f, "hardware enable (STO) closed"),
            EventKind::StoClosed(false) => write!(f, "hardware enable (STO) missing"),
            EventKind::MissedInGroup => write!(f, "missed an exchange while its group was in motion"),
            EventKind::Underrun => write!(f, "stream ran empty"),
            EventKind::Restarted => write!(f, "drive restarted"),
            EventKind::PositionJump(by) => write!(f, "position jumped by {by:.3}, no longer homed"),
            EventKind::MonitorRefused { channel, status } => {
                write!(f, "monitoring channel {} refused with status {status:#04x}", channel + 1)
            }
        }
    }
}
