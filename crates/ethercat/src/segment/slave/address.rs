//! Whether a slave is there, and its station address.
//!
//! Absence is what a read says: the controller of every slave takes part in that. Where the broadcast counts more
//! slaves than are in front of it, its note says so. A write that is not carried out was refused. Until a slave has its
//! station address it is reached by its position, since the addresses that another master has left may be those of
//! other positions.

use super::receive::al;
use super::request::{ALIAS, CONTROL, EMULATION_AT, LOOK};
use super::{Context, Happened, LOOK_EVERY_NS, Missing, Note, Pause, Runs, Slave, Step, Tie};
use crate::slot::{Answer, Answers};
use crate::wire::registers::{AlState, AlStatus, Features, address};
use fieldbeat_core::time::Time;

impl Slave {
    /// The station address in the answer to a look.
    pub fn station_in(&self, answers: &Answers<'_>) -> Option<u16> {
        let Step::Look = self.step else { return None };
        let look = answers[1]?.data.get(usize::from(address::STATION)..)?;
        look.first_chunk::<2>().map(|bytes| u16::from_le_bytes(*bytes))
    }

    /// It is reached by its position, which is another one's as long as the segment has another number of slaves than
    /// when it was looked at.
    pub(super) fn is_elsewhere(&self, counted: u16) -> bool {
        let is_looked_at =
            matches!(self.step, Step::Look | Step::Refused(_) | Step::There(_) | Step::Misplaced);
        !self.way.addressed && !is_looked_at && self.counted != counted
    }

    /// Drops what was read at its position; what was written there may have reached another slave.
    pub(super) fn elsewhere(&mut self, now: Time) {
        match self.step {
            Step::Unaddress | Step::Unmap(_) | Step::Clear(_) | Step::Address { .. } => {
                self.enter(now, Step::Misplaced);
            }
            _ => self.start_over(now, 0, Note::Starting),
        }
    }

    /// It is there nevertheless: it does not do this, or is not the one that was addressed.
    pub(super) fn is_there(&mut self, now: Time, missing: Missing, station: &[u8]) {
        if self.way.addressed && station != self.station().to_le_bytes() {
            self.start_over(now, 0, Note::Starting);
        } else {
            self.refuse(now, Note::NotDone(missing));
        }
    }

    /// How many slaves have the station address of this one, which is that of the slave of `place`; or its own address,
    /// which the slave that stands here now does not have.
    pub(super) fn counted(&mut self, now: Time, place: u16, count: u16) {
        let is_own = place == self.plan.place;
        self.given &= !(is_own && count == 0);
        match count {
            _ if is_own && count > 0 => self.refuse(now, Note::AddressTwice),
            0 => self.start_over(now, 0, Note::Starting),
            // The other one is reached through it, or stands here.
            1 => {
                // Nothing was written to the one that is set up.
                let tie = self.tie;
                self.refuse(now, Note::WrongPlace(place));
                self.tie = tie;
            }
            // It has an old one, which another master has left.
            _ => self.enter(now, Step::Unaddress),
        }
    }

    /// It is there: its state, the features of its controller, its station address.
    pub(super) fn looked(&mut self, context: &Context<'_>, answers: &Answers<'_>) -> Happened {
        let now = context.cycle.grid;
        let [Some(status), Some(look)] = answers else { return Happened::Nothing };
        let Some((requested, status)) = status.data.split_first_chunk::<CONTROL>() else {
            return Happened::Nothing;
        };
        let requested = AlStatus(u16::from_le_bytes([requested[0], requested[1]]));
        let (Some((status, code)), Some(emulation)) = (al(status), status.get(EMULATION_AT)) else {
            return Happened::Nothing;
        };
        let Some((look, behind)) = look.data.split_first_chunk::<LOOK>() else { return Happened::Nothing };
        self.alias = behind.first_chunk::<ALIAS>().map_or(0, |bytes| u16::from_le_bytes(*bytes));
        self.emulated = emulation & 1 != 0;
        self.acknowledge = self.acknowledgement(status, code);
        (self.way.al, self.counted) = (status.state(), context.counted);
        (self.fmmus, self.managers) = (look[4], look[5]);
        self.features = Features(u16::from_le_bytes([look[8], look[9]]));
        let station = u16::from_le_bytes([look[0x10], look[0x11]]);
        self.has_al = usize::from(self.fmmus) > self.wanted_fmmus();
        self.note = Note::Starting;
        // A drive that may move has a time of its own, as long as that is not known.
        let has_time = self.may_be_found() && self.features.has_clock();
        self.runs = if has_time { Runs::Unknown } else { Runs::Harmless };
        // A slave with an address that this master has given is the one that was set up with it, wherever it answers:
        // it may still have the FMMUs of that one, and carry out its outputs. That holds for the one with this address.
        let own = (self.given && station != self.station()).then_some((self.station(), self.plan.place));
        let other = context.in_use.map(|place| (station, place));
        if let Some((station, place)) = other.or(own) {
            self.enter(now, Step::Twin { station, place });
            return Happened::Nothing;
        }
        if let Some(note) = self.unusable() {
            self.refuse(now, note);
            return Happened::Nothing;
        }
        let intruded = self.is_intruded((status, requested), station, context.counted);
        let is_known = self.tie >= Tie::Known;
        let restarted =
            is_known && !intruded && (station != self.station() || self.way.al == Some(AlState::Init));
        if restarted || intruded {
            // Under the address that another master has given it nothing would be read back.
            (self.clock_set, self.tie) = (false, Tie::None);
        }
        if restarted && station != self.station() {
            // It was switched off.
            (self.refused, self.refusals) = (Note::None, 0);
        }
        if !self.goes_on(now) {
            self.tie = Tie::None;
            self.unmapped(now, 0);
        }
        match () {
            () if intruded => {
                self.refused = Note::Intruded;
                Happened::Intruded
            }
            () if restarted => Happened::Restarted,
            () => Happened::Nothing,
        }
    }

    /// A slave that was refused is looked at: another state or station address is another one, or it was restarted.
    pub(super) fn looked_again(&mut self, now: Time, mut pause: Pause, answers: &Answers<'_>) {
        let [Some(status), Some(look)] = answers else { return };
        let station = look.data.get(usize::from(address::STATION)..).and_then(<[u8]>::first_chunk::<2>);
        let status = status.data.get(CONTROL..).unwrap_or_default();
        let (Some((status, code)), Some(station)) = (al(status), station) else { return };
        let seen = (AlStatus(status.0 & AlStatus::SHOWN), code, u16::from_le_bytes(*station));
        if *pause.seen.get_or_insert(seen) != seen {
            self.refusals = 0;
            return self.enter(now, Step::Look);
        }
        pause.next = now + LOOK_EVERY_NS;
        self.step = Step::Refused(pause);
    }

    /// `done` of its FMMUs have been cleared.
    pub(super) fn unmapped(&mut self, now: Time, done: u8) {
        if done < self.fmmus && !self.may_be_found() {
            self.enter(now, Step::Unmap(done));
        } else {
            self.identify(now);
        }
    }

    /// Why a slave with these features cannot be used here.
    fn unusable(&self) -> Option<Note> {
        match () {
            () if self.lrw && self.features.lacks_lrw() => Some(Note::NoLrw),
            () if self.plan.sync && !self.features.has_clock() => Some(Note::NoClock),
            () if usize::from(self.fmmus) < self.wanted_fmmus() => Some(Note::Fmmus(self.fmmus)),
            () => None,
        }
    }

    /// The station address was written, and read from whoever has it.
    pub(super) fn was_addressed(&mut self, now: Time, read: Option<Answer<'_>>, joins: bool) {
        let Some(read) = read else { return };
        if read.working_counter > 1 {
            return self.leave_running(now, Note::AddressTwice);
        }
        if read.data != self.station().to_le_bytes() {
            let missing = Missing { register: address::STATION, is_write: true };
            return self.leave_running(now, Note::NotDone(missing));
        }
        (self.way.addressed, self.given) = (true, true);
        match joins {
            true => self.power(now),
            false if self.plan.sync => self.enter(now, Step::Time),
            false => self.continue_timed(now),
        }
    }
}
