//! Which reports count. One that says what it may say only because it is an older one, or a damaged one, is held back:
//! it is not shown, proves nothing and leads to nothing. The next one decides.
//!
//! - **A loss** of power, reference or hardware enable takes as many reports in a row as a state of its power
//!   ([`Capabilities::power_reports`](crate::bus::desired::Capabilities::power_reports)). A report of a lost reference
//!   and one of lost power do not prove each other. What this master has requested needs no more proof than its
//!   command takes.
//! - **A place** that the axis cannot have reached ([`Reach`]) takes a second report that agrees with it, on every
//!   wire. Then the axis is there, is no longer homed, and stops.
//!
//! A report that is suspect decides nothing.

use super::DriveController;
use super::duty::Claim;
use super::watch::Braked;
use crate::axis::{Command, DriveStatus, EventKind, Link, Outcome, State, StopCause};
use crate::bus::desired::{Evidence, Homing, ModeIs, Power};
use crate::bus::{Cycle, Exchange, Slot};
use crate::drive::reach::{Bound, Reach, Weight};
use crate::time::{MS, Time};

/// After a homing, or after native mode, the positions may change their origin for so long, ns.
const SETTLES_NS: u64 = 200 * MS;

/// What a report says to be lost: power or the hardware enable, and the reference.
type Losses = (bool, bool);

/// What is not certain about the reports of one drive.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Doubt {
    /// The next report is no usual one: the one before did not count, or the drive's reference does not.
    is_open: bool,
    /// So many reports in a row say a loss ...
    losses: u8,
    /// ... of as many that prove it; the newest of them says these.
    proof: u8,
    said: Losses,
    /// The position has jumped: what the drive says of its reference does not count until it homes, or starts anew.
    unreferenced: bool,
    /// The origin of the positions may change until then.
    settles_until: Time,
    reach: Reach,
}

impl Doubt {
    pub(super) fn new(reach: Reach, proof: u8) -> Doubt {
        Doubt {
            is_open: false,
            losses: 0,
            proof,
            said: Losses::default(),
            unreferenced: false,
            settles_until: Time(0),
            reach,
        }
    }

    /// A command has ended.
    pub(super) fn ended(&mut self, now: Time, command: &Command, outcome: Outcome) {
        if matches!(command, Command::Home | Command::Native(_)) {
            self.settles_until = now + SETTLES_NS;
            self.unreferenced &= !(matches!(command, Command::Home) && outcome == Outcome::Done);
        }
    }
}

impl DriveController {
    /// A fresh report: takes it back out of the slot if it does not count. Returns by how much the axis has jumped.
    #[inline(always)] // Once for each axis and cycle; what is not usual takes the way around it.
    pub(super) fn weigh(&mut self, slot: &mut Slot) -> Option<f64> {
        let (status, before) = (&slot.status, &self.feedback.status);
        let sent_at = match slot.exchange {
            Exchange::Answered { sent_at, suspect: false, .. } => sent_at,
            Exchange::Answered { sent_at, .. } => slot.earlier_answered().unwrap_or(sent_at),
            // It has a stamp of its own, or is that of an earlier cycle.
            _ => slot.earlier_answered().unwrap_or(status.at),
        };
        let same = (status.state, status.sto_open, status.homed, status.suspect)
            == (before.state, before.sto_open, before.homed, false);
        let usual = same && !self.doubt.is_open;
        if usual && self.doubt.reach.takes(sent_at, status.at, &slot.evidence) {
            return None;
        }
        self.weigh_anew(sent_at, slot)
    }

    #[inline(never)]
    fn weigh_anew(&mut self, sent_at: Time, slot: &mut Slot) -> Option<f64> {
        let weight = self.weight(sent_at, slot);
        if weight == Weight::Held {
            // Nothing of it is seen by the machine, nor by the application.
            slot.status = self.feedback.status;
            self.doubt.reach.restore(&mut slot.evidence);
            (slot.notices.fresh, slot.notices.monitor_fresh) = (false, false);
        }
        let masked = self.is_masked();
        slot.status.homed &= !masked;
        slot.anew = weight == Weight::Held || masked;
        let Doubt { losses, unreferenced, ref reach, .. } = self.doubt;
        self.doubt.is_open = losses > 0 || unreferenced || reach.holds();
        if let Weight::Jumped(by) = weight { Some(by) } else { None }
    }

    fn weight(&mut self, sent_at: Time, slot: &mut Slot) -> Weight {
        let before = self.feedback.status;
        let Slot { status, evidence, notices, counters, desired, .. } = slot;
        if notices.restarted {
            // Its bus has proved it.
            (self.doubt.losses, self.doubt.unreferenced) = (0, false);
            self.doubt.reach.rebase(sent_at, evidence);
            return Weight::Counts;
        }
        let rehomed = status.homed != before.homed && !self.is_masked();
        let falls = is_up(desired.power.value)
            && !self.duty.follows().is_free
            && rank(status.state) < rank(before.state);
        let says = (falls || status.sto_open && !before.sto_open, rehomed);
        if says != Losses::default() && before.state != State::Unknown && self.doubt.proof > 1 {
            if !status.suspect {
                let Doubt { losses, said, .. } = &mut self.doubt;
                let (power, reference) = says;
                if power && !said.0 || !power && reference && !said.1 {
                    // The ones before, if there are any, have not said that.
                    counters.implausible += u64::from(std::mem::take(losses));
                }
                (*losses, *said) = (losses.saturating_add(1), says);
            }
            if status.suspect || self.doubt.losses < self.doubt.proof {
                return Weight::Held;
            }
        } else if !status.suspect {
            counters.implausible += u64::from(std::mem::take(&mut self.doubt.losses));
        }
        // The drive itself says that it has no reference any more: it will say when it has one again.
        self.doubt.unreferenced &= status.homed;
        let bound = if rehomed { Bound::None } else { self.bound(status, evidence) };
        let mut reach = self.doubt.reach;
        let weight = reach.weigh(sent_at, status.at, bound, evidence, &mut status.velocity);
        if status.suspect {
            // It may be an older one: it is shown, if the axis can have been there, and is no measure for the next one.
            return if weight == Weight::Counts { weight } else { Weight::Held };
        }
        self.doubt.reach = reach;
        match weight {
            Weight::Held => counters.implausible += 1,
            Weight::Counts => self.doubt.losses = 0,
            Weight::Jumped(_) => (self.doubt.losses, self.doubt.unreferenced) = (0, status.homed),
        }
        weight
    }

    /// How far from its last place the axis may be.
    fn bound(&self, status: &DriveStatus, evidence: &Evidence) -> Bound {
        let before = &self.feedback.status;
        let starts = |state: State| matches!(state, State::Unknown | State::NotReadyToSwitchOn);
        if self.feedback.link != Link::Online
            || starts(before.state)
            || starts(status.state)
            || matches!(self.duty.command(), Some(Command::Home | Command::Native(_)))
            || (evidence.homing, evidence.mode == ModeIs::Homing) != (Homing::Open, false)
            || status.at < self.doubt.settles_until
        {
            return Bound::None;
        }
        // Without power it may be moved by anything; and what another master commands keeps to no limit of this one.
        let led = self.duty.claim() == Claim::Armed && before.state.is_powered() && status.state.is_powered();
        if led { Bound::Plan } else { Bound::Fastest }
    }

    /// What the drive says of its reference does not count.
    fn is_masked(&self) -> bool {
        self.doubt.unreferenced && self.duty.command() != Some(&Command::Home)
    }

    /// The axis is where two reports agree, and cannot have moved there: its encoder or its drive has lost its place.
    /// No setpoint of this master leads it from there, nor holds it there, so its drive stops it, if it has power and
    /// was not only read.
    #[cold]
    pub(super) fn jump(&mut self, cycle: &Cycle, now: Time, by: f64) {
        self.bounds.forget();
        self.emit(cycle, now, EventKind::PositionJump(by));
        let ours = self.duty.claim() != Claim::Found && self.feedback.status.state.is_powered();
        let Some((_, sequence)) = self.duty.sequence() else {
            if ours || self.is_armed() {
                self.stop_by(Braked::ByTheDrive, cycle, now, StopCause::PositionJump);
            }
            return;
        };
        if sequence.is_ramp() {
            sequence.quicken();
            self.issue(Some(Command::QuickStop));
        } else if ours && sequence.is_down() {
            self.stop_again(cycle, now, StopCause::PositionJump);
        }
    }
}

/// The drive is to have power.
fn is_up(power: Power) -> bool {
    matches!(power, Power::Untouched | Power::EnableOperation | Power::QuickStop)
}

/// How much of its power a drive has: less is a loss.
fn rank(state: State) -> u8 {
    match state {
        State::OperationEnabled | State::QuickStopActive => 3,
        State::SwitchedOn | State::FaultReactionActive => 2,
        State::NotReadyToSwitchOn | State::SwitchOnDisabled | State::ReadyToSwitchOn => 1,
        State::Fault | State::Unknown => 0,
    }
}
