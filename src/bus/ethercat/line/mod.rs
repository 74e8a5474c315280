//! Brings the slaves of a segment to OP, and evaluates its frames for each.
//!
//! | file | what |
//! |---|---|
//! | `mod` | who owns the slot of the next frame |
//! | `judge` | which slaves took part in a frame that has come back |
//! | `parts` | the members, and whether any request about them is pending |
//! | `member` | one slave, step by step |
//! | `guests` | unconfigured slaves |
//! | `running` | a slave that runs on a clock set by another master |
//! | `sii` | the content of its EEPROM |
//! | `clock` | the time of the segment |
//! | `note` | why a slave is not in operation |

pub mod clock;
mod guests;
mod judge;
pub mod member;
pub mod note;
mod parts;
mod running;
mod sii;

use self::clock::LineClock;
use self::guests::Guests;
use self::judge::FrameState;
use self::member::{Around, Happened, Lent, Member};
use self::note::Notes;
use self::parts::{Part, Parts};
use self::running::Running;
use super::cia402::Mode;
use super::counters::Own;
use super::image::{Frame, Spot};
use super::plan::{EthercatPlan, Owner};
use super::service::Service;
use super::slot::{Answers, Ask};
use super::wire::registers::AlState;
use crate::axis::FoundRunning;
use crate::bus::{BusClock, Counters, Cycle, Slot};
use crate::rt::Regions;
use crate::time::Time;

/// The members that are checked for a request for the slot of one frame; and while all of them are in operation,
/// and only their mailboxes may have one.
const ASKED_A_FRAME: usize = 8;
const ASKED_STEADY: usize = 2;

/// The drives and devices behind the members, with their mailboxes.
pub trait Crew {
    /// The mailbox of a member.
    fn service(&mut self, owner: Owner) -> Option<&mut Service>;

    /// Its turn has come: its mailbox takes the requests that were posted meanwhile.
    fn advance(&mut self, owner: Owner, now: Time, slots: &mut [Slot]);

    /// Its replies count from now on, in this state, or not any more.
    fn state(&mut self, owner: Owner, al: Option<AlState>, slots: &mut [Slot]);

    /// Its mailbox was read.
    fn mailbox_heard(&mut self, owner: Owner, slots: &mut [Slot]);

    /// It was switched off and on.
    fn restarted(&mut self, owner: Owner);

    /// Its watchdog is set as configured, or was found otherwise and left so.
    fn watched(&mut self, owner: Owner, is_watched: bool);

    /// It was found in this mode of operation, and left so.
    fn found_in(&mut self, owner: Owner, mode: Mode);

    /// It will be silent for a while, caused by the master.
    fn excuse(&mut self, owner: Owner, slots: &mut [Slot]);

    /// A drive wants its outputs to go out.
    fn wants_outputs(&self, owner: Owner) -> bool;

    /// The inputs of a member, as a frame brought them; `in_window`: in time for the exchange of a drive.
    fn take(&mut self, owner: Owner, taken: Taken<'_>, slots: &mut [Slot]);

    /// The frame of this window came back without it, or contains nothing of it.
    fn passed_by(&mut self, owner: Owner, slots: &mut [Slot]);

    /// The counts of a member, if it is a drive.
    fn counters<'a>(&self, owner: Owner, slots: &'a mut [Slot]) -> Option<&'a mut Counters>;
}

/// The inputs of a member.
#[derive(Clone, Copy, Debug)]
pub struct Taken<'a> {
    /// When the frame was taken in.
    pub at: Time,
    /// The state that it is in.
    pub al: AlState,
    /// The inputs.
    pub inputs: &'a [u8],
    /// In time for the exchange of a drive.
    pub in_window: bool,
}

/// The slaves of one segment.
#[derive(Debug)]
pub struct Line {
    members: Parts,
    frames: Box<[FrameState]>,
    clock: LineClock,
    /// The member whose clock is the segment's, or is to be.
    reference: Option<usize>,
    leads: bool,
    /// The reference's time goes to all.
    timed: bool,
    /// Before that: the position of the slave that ran already, and whose time the segment has.
    lender: Option<u16>,
    /// The member whose SYNC0 sets the segment's phase, until it is joined.
    phase_lender: Option<usize>,
    count: u16,
    /// Whose turn it is; and among the members on their way up, whether this slot is for them.
    turn: usize,
    climb: usize,
    climbs: bool,
    asker: Option<Asker>,
    guests: Guests,
    /// Frames in a row that did not come back.
    dark: u32,
    /// Another master is on the segment: no slave is brought up, and none of its registers is written.
    left: bool,
    /// A slave was taken out of OP, and not by this master nor by itself.
    lowered: bool,
    notes: Notes,
    ask: Ask,
}

/// Who owns the slot of the frame that is under way.
#[derive(Clone, Copy, Debug)]
enum Asker {
    Member(usize),
    Mailbox(usize),
    Guests,
}

/// A frame that was sent.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    /// Its cycle.
    pub cycle: Cycle,
    /// The instant.
    pub at: Time,
}

/// A frame that has come back.
#[derive(Clone, Copy, Debug)]
pub struct Back<'a> {
    /// As it was sent.
    pub sent: Sent,
    /// The same, with its places.
    pub frame: &'a Frame,
    /// When it was taken in.
    pub at: Time,
    /// Its bytes.
    pub received: &'a [u8],
    /// The working counter of its process data.
    pub counter: u16,
    /// It came in the window of its cycle.
    pub in_window: bool,
}

impl Line {
    /// The segment of `plan`, with the process data offsets of its slaves.
    pub fn new(plan: &EthercatPlan, spots: Vec<Spot>, period_ns: u64) -> Line {
        let slaves = plan.slaves();
        let places: Vec<u16> = slaves.iter().map(|(_, slave)| slave.place).collect();
        let member = |((owner, slave), spot): ((Owner, &_), Spot)| {
            let found_running = match owner {
                Owner::Drive(index) => plan.drives[index].axis.on_found_running,
                Owner::Device(_) => FoundRunning::Stop,
            };
            Member::new(owner, slave, spot, plan.lrw, found_running)
        };
        let count = spots.iter().map(|spot| spot.frame).max().map_or(1, |last| last + 1);
        let frame = |frame| {
            let first = spots.partition_point(|spot| spot.frame < frame);
            first..spots.partition_point(|spot| spot.frame <= frame)
        };
        let ranges: Vec<_> = (0..count).map(frame).collect();
        let notes = Notes::new(slaves.len());
        let members = Parts::new(slaves.into_iter().zip(spots).map(member));
        let frames = ranges.into_iter().map(|range| FrameState::new(range, &members)).collect();
        Line {
            members,
            frames,
            clock: LineClock::new(period_ns, plan.ahead_of_sync_ns.unwrap_or(period_ns / 2)),
            reference: None,
            leads: false,
            timed: false,
            lender: None,
            phase_lender: None,
            count: 0,
            turn: 0,
            climb: 0,
            climbs: false,
            asker: None,
            guests: Guests::new(&places),
            dark: 0,
            left: false,
            lowered: false,
            notes,
            ask: Ask::default(),
        }
    }

    /// Its clock leads the grid; otherwise it receives the grid's time.
    pub fn lead(&mut self) {
        self.leads = true;
    }

    /// The slaves are left as they are, or no longer.
    #[inline]
    pub fn leave(&mut self, left: bool) {
        self.left = left;
    }

    /// A slave was taken out of OP since the last call, and not by this master nor by itself.
    #[inline]
    pub fn take_lowered(&mut self) -> bool {
        std::mem::take(&mut self.lowered)
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.members.memory(regions);
        regions.add(&*self.frames);
        self.guests.memory(regions);
        self.notes.memory(regions);
    }

    /// Why its slaves are not in operation.
    pub fn notes(&self) -> Notes {
        self.notes.clone()
    }

    /// The time of the segment.
    pub fn clock(&mut self) -> &mut LineClock {
        &mut self.clock
    }

    /// All members are in operation, and their outputs reach them.
    #[inline]
    pub fn is_settled(&self) -> bool {
        self.members.are_settled()
    }

    /// The member with this owner is part of the exchange.
    pub fn is_operational(&self, index: usize) -> bool {
        let is_so = |part: &Part| part.told.is_some() && part.member.state_of_replies().is_some();
        self.members.get(index).is_some_and(is_so)
    }

    /// The outputs of member `index` reach it.
    pub fn outputs_count(&self, index: usize) -> bool {
        self.members.get(index).is_some_and(|part| part.member.mapped() == member::Mapped::All)
    }

    /// The relation of the clock of the segment and the grid; `None`: there is none.
    pub fn clock_status(&self) -> Option<BusClock> {
        self.members.iter().any(|part| part.member.has_clock()).then(|| self.clock.status())
    }

    /// The member with this owner.
    pub fn member_of(&self, owner: Owner) -> Option<usize> {
        self.members.iter().position(|part| part.member.owner == owner)
    }

    /// The position of each member.
    pub fn places(&self) -> Vec<u16> {
        self.members.iter().map(|part| part.member.place()).collect()
    }

    /// Prepares the first frame for `cycle`: clock and slot.
    pub fn prepare(&mut self, cycle: &Cycle, first: &mut Frame, crew: &mut impl Crew, slots: &mut [Slot]) {
        self.refer();
        self.begin_time();
        let set = self.set_clock().map(Member::station);
        if set.is_none() {
            self.clock.forget();
        }
        // It receives our time once it has shown that its own is near.
        first.refer_to(set, self.timed, self.timed && !self.leads && self.clock.is_seen());
        self.choose(cycle, crew, slots);
        first.ask(&self.ask);
    }

    /// The slave whose clock is the segment's: the nearest one that is set, since all others are behind it; without
    /// any, the nearest that is to be set.
    fn refer(&mut self) {
        let first = |has: fn(&Member) -> bool| self.members.iter().position(|part| has(&part.member));
        self.reference = first(Member::clock_is_set).or_else(|| first(Member::waits_for_clock));
    }

    /// Its time goes to all, once it is known that no slave runs on another one.
    fn begin_time(&mut self) {
        let is_set = self.set_clock().is_some();
        self.timed = is_set && (self.timed || self.may_have_time());
        if self.timed {
            self.lender = None;
        }
    }

    /// All slaves were read, and none runs on a time other than the segment's.
    fn may_have_time(&self) -> bool {
        let are_looked_at =
            self.guests.are_looked_at() && self.members.iter().all(|part| part.member.was_looked_at());
        are_looked_at && self.stranger().is_none()
    }

    /// The position of a slave that runs on a time other than the segment's.
    fn stranger(&self) -> Option<u16> {
        let member = self.members.iter().find(|part| part.member.is_stranger());
        member.map(|part| part.member.place()).or_else(|| self.guests.stranger())
    }

    /// The slave whose clock is the segment's, if it is set.
    fn set_clock(&self) -> Option<&Member> {
        let member = &self.members[self.reference?].member;
        member.clock_is_set().then_some(member)
    }

    /// The segment has a time that is not that of the slave at `place` alone.
    fn has_time(&self, place: u16) -> bool {
        self.timed || self.clock.is_seen() || self.lender.is_some_and(|lender| lender != place)
    }

    /// Another member gave the segment its phase, and is being joined.
    fn is_lent_to(&self, index: usize) -> bool {
        let lender = self.phase_lender.filter(|lender| *lender != index);
        lender.is_some_and(|lender| self.members[lender].member.is_being_joined())
    }

    /// The slave at `place` runs, and gives the segment its time.
    fn lend(&mut self, place: u16, sent: &Sent, lent: Lent) {
        self.clock.lend(&sent.cycle, sent.at, lent.time, lent.phase_ns);
        self.lender = Some(place);
    }

    /// The time of a running clock of an unconfigured slave.
    fn guest_runs(&mut self, place: u16, sent: &Sent, running: &Running) {
        if !self.has_time(place) {
            self.lend(place, sent, Lent { time: running.time(), phase_ns: None });
        } else if !self.clock.is_time_of(&sent.cycle, sent.at, running.time()) {
            self.guests.is_strange(place);
        }
    }

    /// Who owns the slot.
    fn choose(&mut self, cycle: &Cycle, crew: &mut impl Crew, slots: &mut [Slot]) {
        self.ask.clear();
        self.asker = None;
        if self.left {
            return;
        }
        if self.guests.ask(cycle.grid, self.count, self.timed, cycle.period_ns, &mut self.ask) {
            self.asker = Some(Asker::Guests);
            return;
        }
        let settled = self.is_settled();
        // On a long segment some mailbox always has to be read: every other slot is for the members on their way
        // up.
        self.climbs = !settled && !self.climbs;
        if self.climbs {
            let from = self.climb;
            self.climb =
                self.choose_from(from, ASKED_A_FRAME, |member| !member.wants_nothing(), cycle, crew, slots);
        }
        if self.asker.is_none() {
            let from = self.turn;
            let looks = if settled { ASKED_STEADY } else { ASKED_A_FRAME };
            self.turn = self.choose_from(from, looks, |_| true, cycle, crew, slots);
        }
    }

    /// The first of so many members that has a request, in turns; and the next one to be checked.
    #[inline]
    fn choose_from(
        &mut self,
        from: usize,
        looks: usize,
        is_asked: impl Fn(&Member) -> bool,
        cycle: &Cycle,
        crew: &mut impl Crew,
        slots: &mut [Slot],
    ) -> usize {
        let (count, mut left) = (self.members.len(), looks);
        for step in 0..count {
            let index = (from + step) % count;
            if !is_asked(&self.members[index].member) {
                continue;
            }
            if left == 0 {
                return index;
            }
            left -= 1;
            self.asker = self.ask_one(index, cycle, crew, slots);
            if self.asker.is_some() {
                return index + 1;
            }
        }
        from
    }

    /// The request of member `index`.
    fn ask_one(
        &mut self,
        index: usize,
        cycle: &Cycle,
        crew: &mut impl Crew,
        slots: &mut [Slot],
    ) -> Option<Asker> {
        let part = &self.members[index];
        let owner = part.member.owner;
        crew.advance(owner, cycle.grid, slots);
        if part.member.wants_nothing() && part.open == part.member.has_mailbox() {
            // Usually only its mailbox may have a request.
            return self.ask_mailbox(index, cycle, crew);
        }
        let part = &mut self.members[index];
        let mut service = crew.service(owner);
        if let Some(service) = &mut service
            && part.open != part.member.has_mailbox()
        {
            part.open = part.member.has_mailbox();
            service.open(part.open);
        }
        part.member.objects(cycle.grid, service);
        let sent = Sent { cycle: *cycle, at: cycle.grid };
        let around = self.around(index, &sent, crew.wants_outputs(owner), slots);
        let (part, ask) = (&mut self.members[index], &mut self.ask);
        part.member.ask(&around, ask);
        self.notes.set(index, part.member.note());
        let own_doing = part.told.is_some() && part.member.state_of_replies().is_none();
        if own_doing {
            crew.excuse(owner, slots);
        }
        self.tell(index, crew, slots);
        if !self.ask.is_empty() {
            return Some(Asker::Member(index));
        }
        self.ask_mailbox(index, cycle, crew)
    }

    /// The request of the mailbox of member `index`.
    fn ask_mailbox(&mut self, index: usize, cycle: &Cycle, crew: &mut impl Crew) -> Option<Asker> {
        let member = &self.members[index].member;
        if !member.has_mailbox() {
            return None;
        }
        crew.service(member.owner)?.ask(cycle.grid, &mut self.ask);
        (!self.ask.is_empty()).then_some(Asker::Mailbox(index))
    }

    fn around<'a>(&self, index: usize, sent: &'a Sent, wants_outputs: bool, slots: &[Slot]) -> Around<'a> {
        let report = match self.members[index].member.owner {
            Owner::Drive(drive) => slots.get(drive).map(|slot| &slot.status),
            Owner::Device(_) => None,
        };
        Around {
            cycle: &sent.cycle,
            sent_at: sent.at,
            clock: self.clock,
            reference: self.reference.map(|index| self.members[index].member.station()),
            timed: self.timed,
            phased: self.set_clock().is_some() || self.is_lent_to(index),
            may_begin: self.timed || self.may_have_time(),
            stranger: if self.timed { None } else { self.stranger() },
            has_time: self.has_time(self.members[index].member.place()),
            timing_taken: self.members.iter().any(|part| part.member.is_timing()),
            turn_ns: sent.cycle.period_ns.saturating_mul(self.members.len() as u64),
            wants_outputs,
            powered: report.map(|report| (report.state.is_powered(), report.at)),
        }
    }

    /// The frame `number` has come back.
    pub fn heard(&mut self, back: &Back<'_>, number: usize, crew: &mut impl Crew, slots: &mut [Slot]) {
        if number == 0 {
            self.dark = 0;
            if let Some((count, _)) = back.frame.states_of(back.received) {
                self.count = count;
            }
        }
        self.judge(back, number, crew, slots);
        if number == 0 {
            let is_there = |member: &Member| {
                !member.has_al() || member.spot.frame != 0 || member.shown(back.received).0 != 0
            };
            let is_there = self.set_clock().is_some_and(is_there);
            if let Some(time) = back.frame.time_of(back.received).filter(|_| is_there) {
                self.clock.sample(&back.sent.cycle, back.sent.at, time);
            }
            self.answer(back, crew, slots);
        }
    }

    /// Reports a change to the crew.
    fn tell(&mut self, index: usize, crew: &mut impl Crew, slots: &mut [Slot]) {
        let part = &mut self.members[index];
        let state = part.member.state_of_replies();
        if state != part.told {
            let before = std::mem::replace(&mut part.told, state);
            crew.watched(part.member.owner, part.member.is_watched());
            crew.state(part.member.owner, state, slots);
            if let Some(mode) = part.member.found_mode().filter(|_| before.is_none()) {
                crew.found_in(part.member.owner, mode);
            }
            self.notes.set(index, part.member.note());
        }
    }

    /// Takes the answer of the slot.
    fn answer(&mut self, back: &Back<'_>, crew: &mut impl Crew, slots: &mut [Slot]) {
        let answers = back.frame.answers_of(back.received);
        match self.asker.take() {
            Some(Asker::Member(index)) => self.member_heard(back, index, &answers, crew, slots),
            Some(Asker::Mailbox(index)) => {
                self.mailbox_heard(back.sent.cycle.grid, index, &answers, crew, slots);
            }
            Some(Asker::Guests) => {
                let place = self.guests.place();
                if let Some(running) = self.guests.heard(&answers) {
                    self.guest_runs(place, &back.sent, &running);
                }
            }
            None => {}
        }
    }

    fn member_heard(
        &mut self,
        back: &Back<'_>,
        index: usize,
        answers: &Answers<'_>,
        crew: &mut impl Crew,
        slots: &mut [Slot],
    ) {
        let owner = self.members[index].member.owner;
        let around = self.around(index, &back.sent, crew.wants_outputs(owner), slots);
        let (happened, lent) = self.members[index].member.heard(&around, answers);
        if let Some(lent) = lent {
            let place = self.members[index].member.place();
            self.phase_lender = lent.phase_ns.map(|_| index).or(self.phase_lender);
            self.lend(place, &back.sent, lent);
        }
        let counter = match happened {
            Happened::Nothing => None,
            Happened::Restarted => {
                crew.restarted(owner);
                None
            }
            Happened::Operational => Some(Own::BroughtUp),
            Happened::Error => Some(Own::AlErrors),
        };
        if let (Some(counter), Some(counters)) = (counter, crew.counters(owner, slots)) {
            counter.count(counters);
        }
        self.notes.set(index, self.members[index].member.note());
        self.tell(index, crew, slots);
    }

    fn mailbox_heard(
        &mut self,
        now: Time,
        index: usize,
        answers: &Answers<'_>,
        crew: &mut impl Crew,
        slots: &mut [Slot],
    ) {
        let owner = self.members[index].member.owner;
        let mut counted = Counters::default();
        if let Some(service) = crew.service(owner) {
            service.heard(now, answers, &mut counted);
        }
        if let Some(counters) = crew.counters(owner, slots) {
            counters.own.iter_mut().zip(counted.own).for_each(|(own, more)| *own += more);
        }
        crew.mailbox_heard(owner, slots);
    }

    /// Shuts down everything that is in operation; true once that is done.
    pub fn shut_down(&mut self, now: Time) -> bool {
        if !self.guests.end() {
            // Earlier answers no longer match the state of the slaves.
            self.asker = None;
        }
        let mut done = true;
        for part in self.members.iter_mut() {
            done &= part.member.shut_down(now);
        }
        done
    }
}

#[cfg(test)]
mod tests;
