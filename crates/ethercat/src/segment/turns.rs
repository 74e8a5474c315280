//! Who owns the slot of the next frame, and receives the answers: a slave on its way to OP, or its mailbox.

use super::slave::{Context, Happened, Missing, Slave};
use super::{Back, Handler, Requester, Segment, Sent};
use crate::counters::Own;
use crate::slot::Answers;
use crate::wire::frame::Command;
use fieldbeat_core::bus::Cycle;
use fieldbeat_core::time::Time;

/// The slaves that are checked for a request for the slot of one frame; and while all of them are in operation,
/// and only their mailboxes may have one.
const LOOKS_A_FRAME: usize = 8;
const LOOKS_STEADY: usize = 2;

impl Segment {
    /// Who owns the slot.
    pub(super) fn choose(&mut self, cycle: &Cycle, handler: &mut impl Handler) {
        self.ask.clear();
        self.requester = None;
        if self.left {
            return;
        }
        let settled = self.is_settled();
        // On a long segment some mailbox always has to be read: every other slot is for the slaves on their way
        // up.
        self.climbs = !settled && !self.climbs;
        if self.climbs {
            if self.slaves.iter().any(Slave::lacks_delay) {
                self.topology.begin();
            }
            self.topology.request(&mut self.ask);
            if !self.ask.is_empty() {
                self.requester = Some(Requester::Topology);
                return;
            }
            // Clocks take longest.
            let clocks = self.slaves.iter().any(Slave::is_urgent);
            let wants = |slave: &Slave| !slave.wants_nothing() && (!clocks || slave.is_urgent());
            self.climb = self.choose_from(self.climb, LOOKS_A_FRAME, wants, cycle, handler);
        }
        if self.requester.is_none() {
            let looks = if settled { LOOKS_STEADY } else { LOOKS_A_FRAME };
            self.turn = self.choose_from(self.turn, looks, |_| true, cycle, handler);
        }
    }

    /// The first of so many slaves that has a request, in turns; and the next one to be checked.
    #[inline]
    fn choose_from(
        &mut self,
        from: usize,
        looks: usize,
        is_checked: impl Fn(&Slave) -> bool,
        cycle: &Cycle,
        handler: &mut impl Handler,
    ) -> usize {
        let (count, mut left) = (self.slaves.len(), looks);
        for step in 0..count {
            let index = (from + step) % count;
            if !is_checked(&self.slaves[index]) {
                continue;
            }
            if left == 0 {
                return index;
            }
            left -= 1;
            self.requester = self.request_of(index, cycle, handler);
            if self.requester.is_some() {
                return index + 1;
            }
        }
        from
    }

    /// The request of slave `index`.
    #[inline]
    fn request_of(&mut self, index: usize, cycle: &Cycle, handler: &mut impl Handler) -> Option<Requester> {
        let slave = &self.slaves[index];
        let service = handler.advance(slave.owner, cycle.grid);
        if !self.is_settled() && !slave.wants_nothing() {
            return self.request_of_step(index, cycle, handler);
        }
        // Usually only its mailbox may have a request.
        if slave.way.mailbox_open
            && let Some(service) = service
        {
            service.request(cycle.grid, &mut self.ask);
        }
        (!self.ask.is_empty()).then_some(Requester::Mailbox(index))
    }

    /// The same of one that is not up.
    #[inline(never)]
    fn request_of_step(
        &mut self,
        index: usize,
        cycle: &Cycle,
        handler: &mut impl Handler,
    ) -> Option<Requester> {
        let slave = &mut self.slaves[index];
        let owner = slave.owner;
        let mut service = handler.service(owner);
        if let Some(service) = &mut service {
            service.open(slave.way.mailbox_open);
        }
        slave.objects(cycle.grid, service);
        if std::mem::take(&mut slave.has_own) {
            handler.own_values(owner, &slave.own);
        }
        let sent = Sent { cycle: *cycle, at: cycle.grid };
        let context = self.context(index, &sent, handler);
        let slave = &mut self.slaves[index];
        slave.request(&context, &mut self.ask);
        self.notes.set(index, slave.note());
        if slave.reported.is_some() && slave.state_of_replies().is_none() {
            handler.expect_silence(owner);
        }
        self.report(index, handler);
        if !self.ask.is_empty() {
            return Some(Requester::Slave(index));
        }
        if self.slaves[index].way.mailbox_open {
            handler.service(owner)?.request(cycle.grid, &mut self.ask);
        }
        (!self.ask.is_empty()).then_some(Requester::Mailbox(index))
    }

    fn context<'a>(&self, index: usize, sent: &'a Sent, handler: &impl Handler) -> Context<'a> {
        let owner = &self.slaves[index].owner;
        Context {
            cycle: &sent.cycle,
            sent_at: sent.at,
            clock: self.clock,
            reference: self.reference.map(|index| self.slaves[index].station()),
            first_delay_ns: self.slaves.iter().find_map(|slave| slave.delay_ns.filter(|_| slave.plan.sync)),
            timed: self.timed,
            may_begin: self.timed || self.may_have_time(),
            other_time: if self.timed { None } else { self.other_time() },
            has_time: self.has_time(index),
            counted: 0,
            in_use: None,
            missing: None,
            turn_ns: sent.cycle.period_ns.saturating_mul(self.slaves.len() as u64),
            wants_outputs: handler.wants_outputs(*owner),
            powered: handler.powered(*owner),
        }
    }

    /// Passes the answers of the slot to its owner.
    #[inline(never)]
    pub(super) fn answer(&mut self, requester: Requester, back: &Back<'_>, handler: &mut impl Handler) {
        let answers = back.frame.answers_of(back.received);
        match requester {
            Requester::Slave(index) => self.slave_received(back, index, &answers, handler),
            Requester::Topology if self.topology.receive(&answers) => {
                let delay_ns = |slave: &Slave| self.topology.delay_ns(slave.plan.place);
                self.slaves.iter_mut().for_each(|slave| slave.delay_ns = Some(delay_ns(slave)));
            }
            Requester::Topology => {}
            Requester::Mailbox(index) => {
                handler.mailbox_received(self.slaves[index].owner, back.sent.cycle.grid, &answers);
            }
        }
    }

    fn slave_received(
        &mut self,
        back: &Back<'_>,
        index: usize,
        answers: &Answers<'_>,
        handler: &mut impl Handler,
    ) {
        let station = self.slaves[index].station_in(answers);
        let place_of = |has: fn(&Slave, u16) -> bool| {
            let station = station?;
            let mut others = self.slaves.iter().enumerate().filter(|(other, _)| *other != index);
            others.find(|(_, other)| has(other, station)).map(|(_, other)| other.plan.place)
        };
        let context = Context {
            counted: back.frame.slaves_in(back.received),
            in_use: place_of(Slave::has_address).or_else(|| place_of(Slave::was_given)),
            missing: self.missing(answers),
            ..self.context(index, back.sent, handler)
        };
        let slave = &mut self.slaves[index];
        let owner = slave.owner;
        let happened = slave.receive(&context, answers);
        self.notes.set(index, slave.note());
        self.remarks.set(index, slave.remark);
        self.further.set(index, slave.further);
        match happened {
            Happened::Nothing => {}
            Happened::Restarted => handler.restarted(owner),
            Happened::Intruded => self.lowered = true,
            Happened::GivesTime(time) => {
                self.clock.take_over(&back.sent.cycle, back.sent.at, time);
                self.time_source = Some(index);
            }
            Happened::Misplaced => self.doubt_behind(index, back.sent.cycle.grid, handler),
            Happened::Operational => handler.count(owner, Own::BroughtUp),
            Happened::Error => handler.count(owner, Own::AlErrors),
        }
        self.report(index, handler);
    }

    /// Slaves behind this one may have received what was written for it.
    #[cold]
    fn doubt_behind(&mut self, index: usize, now: Time, handler: &mut impl Handler) {
        let place = self.slaves[index].plan.place;
        for behind in 0..self.slaves.len() {
            let slave = &self.slaves[behind];
            if slave.plan.place > place && slave.way.addressed {
                self.slaves[behind].doubted(now);
                self.report(behind, handler);
            }
        }
    }

    /// The first datagram of the slot that nobody has carried out.
    fn missing(&self, answers: &Answers<'_>) -> Option<Missing> {
        let mut slot = self.ask.datagrams().zip(answers.iter().flatten());
        let ((command, _), _) = slot.find(|(_, answer)| answer.working_counter == 0)?;
        let is_write = matches!(command, Command::Apwr(..) | Command::Fpwr(..) | Command::Bwr(_));
        Some(Missing { register: (command.address() >> 16) as u16, is_write })
    }
}
