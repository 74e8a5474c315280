//! The steps of a slave.

use super::Note;
use super::objects::List;
use super::resume::Part;
use crate::sii::{Managers, Reader};
use crate::wire::registers::{AlCode, AlState, AlStatus};
use fieldbeat_core::time::Time;

/// The step that it is at.
#[derive(Clone, Copy, Debug, Default)]
pub(super) enum Step {
    /// Nothing until then.
    Rest(Time),
    /// It was refused.
    Refused(Pause),
    #[default]
    Look,
    /// Whether the slave that has its station address is another one, or it has an old address itself, which it loses.
    Twin {
        station: u16,
        place: u16,
    },
    Unaddress,
    /// The position was another one's when something was written there: whoever has its station address loses it.
    Misplaced,
    /// Whether it is there, although it did not answer.
    There(Missing),
    /// The FMMUs are cleared: those of another master may reach into the frames of this one.
    Unmap(u8),
    /// The SII is taken from its processor: by force; to the master, until the slave shows that; and given back.
    SiiForce,
    SiiTake {
        looks: u8,
    },
    Sii(Reader<Managers>),
    /// `refused`: why the slave cannot be used.
    SiiBack {
        refused: Note,
    },
    /// The identification is requested until the slave shows it; then the request is taken back. `refused`: as above.
    Identification,
    Identified {
        refused: Note,
    },
    /// A drive in OP: its SyncManagers and watchdog; after its station address and its power the time that it runs on,
    /// ...
    Found,
    /// `refused`: why it is left alone.
    FoundClock {
        refused: Note,
    },
    /// ... its FMMUs, its inputs, and its PDOs and mode.
    FoundFmmus,
    Join,
    Ports,
    Clear(u8),
    /// The station address is taken from whoever has it; set, and read. `joins`: of a drive in OP.
    Free {
        joins: bool,
    },
    Address {
        joins: bool,
    },
    Mailbox,
    /// Objects over the mailbox.
    Objects {
        list: List,
        next: usize,
        begun: bool,
    },
    Watchdog,
    WatchdogCheck,
    /// From this one on, as many as a slot has room for.
    SyncManagers(u8),
    SyncManagersCheck(u8),
    Fmmus,
    /// The set-up is read back before it is resumed, this part of it.
    Check {
        resumes: Resumes,
        part: Part,
    },
    /// The time is read, its offset set by that, and corrected by what is left.
    Time,
    Offset(Setting),
    Correct(Setting),
    Settle {
        good: u8,
        next: Time,
    },
    SegmentTime,
    /// `ahead_ns`: its own time less the segment's.
    SyncStart {
        ahead_ns: u64,
        segment_ns: u64,
    },
    SyncOn {
        segment_ns: u64,
    },
    State(Change),
    Lock,
    Up,
    /// The outputs are released.
    Release,
    /// It has reported an AL error in operation.
    Code,
}

/// Where a slave continues whose settings are still those that were set up here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Resumes {
    /// It is in OP.
    Op,
    /// It is in SAFEOP, and its clock ran by itself meanwhile.
    Clock,
    /// It is in SAFEOP; its error is acknowledged first.
    SafeOp(Option<AlStatus>),
}

/// The setting of its clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct Setting {
    /// The segment's time less its own, ns.
    pub(super) offset: u64,
    /// How much later than the first clock it receives, ns.
    pub(super) delay_ns: u32,
    pub(super) corrected: u8,
}

/// The pause of a slave that was refused.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pause {
    pub(super) until: Time,
    /// When it is looked at.
    pub(super) next: Time,
    /// AL status, its code and station address at the first look: with other ones it is tried at once.
    pub(super) seen: Option<(AlStatus, AlCode, u16)>,
}

/// A change of state.
#[derive(Clone, Copy, Debug)]
pub(super) struct Change {
    pub(super) to: AlState,
    pub(super) phase: Phase,
    pub(super) errors: u8,
    /// Requested in its place, to acknowledge an error.
    pub(super) acknowledge: Option<AlStatus>,
}

/// How far a change of state is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// It is to be requested.
    Requests,
    /// The request was not accepted: whether the slave is there at all.
    Looks,
    /// It was requested.
    Waits,
}

impl Step {
    /// The first object of a list.
    pub(super) fn list(list: List) -> Step {
        Step::Objects { list, next: 0, begun: false }
    }

    pub(super) fn to(state: AlState) -> Step {
        Step::acknowledged(state, None)
    }

    /// The same, after the error that it shows was acknowledged.
    pub(super) fn acknowledged(state: AlState, acknowledge: Option<AlStatus>) -> Step {
        Step::State(Change { to: state, phase: Phase::Requests, errors: 0, acknowledge })
    }
}

/// A request that was not carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Missing {
    /// The register.
    pub register: u16,
    /// It was a write.
    pub is_write: bool,
}
