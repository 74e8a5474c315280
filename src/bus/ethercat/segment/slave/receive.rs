//! The answers to the requests of a step.

use super::request::{AL_LOOK, LOOK};
use super::setup::WATCHDOG_DIVIDER;
use super::{Change, Context, FMMUS_AT_ONCE, Happened, List, Mapped, Note, Slave, Step};
use crate::bus::ethercat::plan::FIRST_STATION;
use crate::bus::ethercat::segment::running::Running;
use crate::bus::ethercat::sii::{Head, Managers, Reading};
use crate::bus::ethercat::slot::{Answer, Answers};
use crate::bus::ethercat::wire::registers::{AlCode, AlState, AlStatus, Features, SyncManager};
use crate::time::Time;

/// Missing answers in a row until it counts as lost.
const SILENT: u8 = 3;
/// Errors that are acknowledged on the way to one state.
const ERRORS: u8 = 3;

impl Slave {
    /// Takes the answer to its request; returns the time of a running slave, if the segment is to have it.
    pub fn receive(&mut self, context: &Context<'_>, answers: &Answers<'_>) -> (Happened, Option<Running>) {
        let step = self.step;
        let happened = self.take_answers(context, answers);
        let is_received = answers.iter().flatten().all(|answer| answer.working_counter > 0);
        let running = match step {
            Step::FoundClock if is_received => self.found_clock(context, answers),
            _ => None,
        };
        (happened, running)
    }

    fn take_answers(&mut self, context: &Context<'_>, answers: &Answers<'_>) -> Happened {
        let now = context.cycle.grid;
        // A lost frame: the same is requested again.
        let Some(first) = answers[0] else { return Happened::Nothing };
        // AL control may still be unread by the firmware, and not accept a second request; usually nobody else has
        // its station address.
        let may_be_zero = match self.step {
            Step::Latch | Step::State(Change { said: false, .. }) => true,
            Step::Address { .. } => answers[1].is_some_and(|given| given.working_counter > 0),
            _ => false,
        };
        let nobody = |answer: &Option<Answer<'_>>| answer.is_some_and(|answer| answer.working_counter == 0);
        if answers.iter().any(nobody) && matches!(self.step, Step::ReferenceTimes { .. }) {
            // The reference itself does not answer.
            self.enter(now, Step::Latch);
            return Happened::Nothing;
        }
        if answers.iter().any(nobody) && !may_be_zero {
            self.silent += 1;
            if self.silent >= SILENT || matches!(self.step, Step::Look) {
                self.absent(now);
            }
            return Happened::Nothing;
        }
        self.silent = 0;
        match self.step {
            Step::Look => return self.looked(now, answers),
            Step::SiiOwner => self.enter(now, Step::sii()),
            Step::Sii(mut reader) => match reader.receive(answers) {
                Reading::Busy | Reading::On => self.step = Step::Sii(reader),
                Reading::Done => self.identified(now, &reader.head, reader.content),
                Reading::Failed => self.refuse(now, Note::Sii),
            },
            Step::Found => self.found(now, answers),
            Step::FoundFmmus => self.found_fmmus(now, first.data),
            Step::Join => self.join(now),
            Step::Ports => self.enter(now, Step::Clear(0)),
            Step::Clear(done) => {
                // The last ones are followed by one that is not counted.
                let over = done >= self.fmmus.max(self.managers);
                let next = done.saturating_add(FMMUS_AT_ONCE);
                self.enter(now, if over { Step::Address { joins: false } } else { Step::Clear(next) });
            }
            Step::Address { joins } => self.enter(now, Step::AddressCheck { joins }),
            Step::AddressCheck { joins } => self.was_addressed(now, first, joins),
            Step::Mailbox => self.enter(now, Step::to(AlState::PreOp)),
            Step::Watchdog => self.enter(now, Step::WatchdogCheck),
            Step::WatchdogCheck => {
                let values = [WATCHDOG_DIVIDER, self.watchdog()].map(u16::to_le_bytes);
                let is_set = answers
                    .iter()
                    .zip(values)
                    .all(|(answer, value)| answer.is_some_and(|answer| answer.data == value));
                self.checked(now, is_set, Step::SyncManagers);
            }
            Step::SyncManagers => self.enter(now, Step::SyncManagersCheck),
            Step::SyncManagersCheck => {
                let is_set = answers.iter().flatten().zip(self.managers()).all(|(answer, (_, wanted))| {
                    let bytes = answer.data.first_chunk::<{ SyncManager::SIZE }>();
                    bytes.is_some_and(|bytes| SyncManager::new(*bytes) == wanted)
                });
                self.checked(now, is_set, Step::Fmmus);
            }
            Step::Fmmus => {
                self.way.mapped = Mapped::All;
                self.enter(now, if self.plan.sync { Step::Latch } else { Step::to(AlState::SafeOp) });
            }
            Step::State(change) => return self.went(now, change, answers),
            Step::Release => self.release(now),
            Step::Code => return self.receive_code(now, first.data),
            Step::Rest(_) | Step::FoundClock => {}
            Step::Objects { .. } | Step::Lock | Step::Up => {}
            _ => self.receive_clock(context, first.data, answers[1].map_or(&[], |answer| answer.data)),
        }
        Happened::Nothing
    }

    /// The steps of its clock.
    fn receive_clock(&mut self, context: &Context<'_>, first: &[u8], second: &[u8]) {
        let now = context.cycle.grid;
        match self.step {
            Step::Latch => {
                let segment_ns = context.clock.shows(context.cycle, context.sent_at);
                self.enter(now, Step::ReferenceTimes { segment_ns });
            }
            Step::ReferenceTimes { segment_ns } => self.referred(now, context, segment_ns, first, second),
            Step::OwnTimes { segment_ns, reference_loop_ns } => {
                self.timed(now, context, segment_ns, reference_loop_ns, first, second);
            }
            Step::Offset { .. } => self.offset_set(now),
            Step::Filter if self.is_reference(context) => self.enter(now, Step::SegmentTime),
            Step::Filter => self.enter(now, Step::Settle { good: 0, next: now }),
            Step::Settle { good, .. } => self.settled(context, good, first),
            Step::SegmentTime => self.segment_time(now, context, second),
            Step::SyncStart { segment_ns, .. } => self.enter(now, Step::SyncOn { segment_ns }),
            Step::SyncOn { segment_ns } => self.sync_on(now, context, segment_ns),
            _ => {}
        }
    }

    fn looked(&mut self, now: Time, answers: &Answers<'_>) -> Happened {
        let [Some(status), Some(look)] = answers else { return Happened::Nothing };
        let (Some((status, _)), Some(look)) = (al(status.data), look.data.first_chunk::<LOOK>()) else {
            return Happened::Nothing;
        };
        self.way.al = status.state();
        (self.fmmus, self.managers) = (look[4], look[5]);
        self.features = Features(u16::from_le_bytes([look[8], look[9]]));
        let station = u16::from_le_bytes([look[0x10], look[0x11]]);
        self.has_al = usize::from(self.fmmus) > self.wanted_fmmus();
        self.note = Note::Starting;
        // In OP nothing is taken by force; and the time that it runs on comes first.
        let runs = self.way.al == Some(AlState::Op);
        let has_time = runs && self.features.has_clock();
        (self.looked_at, self.other_time, self.clock_fits) = (!has_time, has_time, !has_time);
        if let Some(note) = self.unusable(station) {
            self.refuse(now, note);
            return Happened::Nothing;
        }
        let restarted = self.known && (station != self.station() || self.way.al == Some(AlState::Init));
        self.known &= !restarted;
        if restarted {
            (self.clock_set, self.ours, self.refused) = (false, false, Note::None);
        }
        if !self.goes_on(now) {
            self.known = false;
            self.enter(
                now,
                match runs {
                    _ if has_time => Step::FoundClock,
                    true => Step::sii(),
                    false => Step::SiiOwner,
                },
            );
        }
        if restarted { Happened::Restarted } else { Happened::Nothing }
    }

    /// Why a slave with this station address cannot be used here.
    fn unusable(&self, station: u16) -> Option<Note> {
        let other = station.checked_sub(FIRST_STATION).filter(|place| *place != self.plan.place);
        match other {
            _ if self.lrw && self.features.lacks_lrw() => Some(Note::NoLrw),
            _ if self.plan.sync && !self.features.has_clock() => Some(Note::NoClock),
            _ if usize::from(self.fmmus) < self.wanted_fmmus() => Some(Note::Fmmus(self.fmmus)),
            // It was given this address at another position, and works there.
            Some(place) if self.way.al.is_some_and(|al| al >= AlState::SafeOp) => {
                Some(Note::WrongPlace(place))
            }
            _ => None,
        }
    }

    fn identified(&mut self, now: Time, head: &Head, delivered: Managers) {
        self.delivered = delivered;
        let (expected, found) = (&self.plan.identity, head.identity);
        let differs = |expected: Option<u32>, found: u32| expected.is_some_and(|expected| expected != found);
        let note = match () {
            () if differs(expected.vendor, found.vendor) => Some(Note::Vendor(found.vendor)),
            () if differs(expected.product, found.product) => Some(Note::Product(found.product)),
            () if differs(expected.revision, found.revision) => Some(Note::Revision(found.revision)),
            () if self.plan.check_sii && !head.is_blank() => self.contradicts(head),
            () => None,
        };
        if let Some(note) = note {
            return self.refuse(now, note);
        }
        let is_found = self.way.al == Some(AlState::Op) && !self.is_device();
        self.enter(now, if is_found { Step::Found } else { Step::to(AlState::Init) });
    }

    fn was_addressed(&mut self, now: Time, read: Answer<'_>, joins: bool) {
        if read.working_counter > 1 {
            return self.refuse(now, Note::AddressTwice);
        }
        if read.data != self.station().to_le_bytes() {
            return self.absent(now);
        }
        self.way.addressed = true;
        self.enter(
            now,
            match self.plan.mailbox {
                _ if joins => Step::Join,
                Some(_) => Step::Mailbox,
                None => Step::to(AlState::PreOp),
            },
        );
    }

    /// The settings were read back.
    fn checked(&mut self, now: Time, is_set: bool, next: Step) {
        if is_set {
            self.enter(now, next);
        } else {
            self.refuse(now, Note::Watchdog);
        }
    }

    /// A change of state continues: the request was accepted, or the status was read.
    fn went(&mut self, now: Time, mut change: Change, answers: &Answers<'_>) -> Happened {
        let Some(first) = answers[0] else { return Happened::Nothing };
        if !change.said {
            change.said = first.working_counter > 0;
            self.step = Step::State(change);
            return Happened::Nothing;
        }
        let Some((status, code)) = al(first.data) else { return Happened::Nothing };
        if status.error() {
            return self.refused_state(now, change, status, code);
        }
        if change.acknowledge.take().is_some() {
            change.said = false;
        }
        self.step = Step::State(change);
        match status.state() {
            Some(state) if state == change.to && change.said => return self.reached(now, state),
            // It has lost a precondition of OP.
            Some(state) if change.to == AlState::Op && state < AlState::SafeOp => {
                self.start_over(now, 0, Note::Starting);
            }
            _ => {}
        }
        Happened::Nothing
    }

    fn refused_state(&mut self, now: Time, mut change: Change, status: AlStatus, code: AlCode) -> Happened {
        if change.acknowledge.is_some() {
            // The firmware has not read the acknowledgement yet.
            return Happened::Nothing;
        }
        let note = Note::State { to: change.to, code };
        if change.errors >= ERRORS {
            self.refuse(now, note);
            return Happened::Error;
        }
        self.note = note;
        change.errors += 1;
        (change.acknowledge, change.said) = (Some(acknowledging(status)), false);
        self.step = Step::State(change);
        Happened::Error
    }

    fn reached(&mut self, now: Time, state: AlState) -> Happened {
        self.note = Note::Starting;
        match state {
            AlState::PreOp => {
                (self.way.mailbox_open, self.known) = (self.plan.mailbox.is_some(), true);
                self.enter(now, Step::Objects { list: List::Write, next: 0, begun: false });
            }
            AlState::SafeOp => {
                (self.way.al, self.ours, self.watched) = (Some(AlState::SafeOp), true, true);
                self.enter(now, Step::Lock);
            }
            AlState::Op => {
                (self.way.al, self.way.was_operational) = (Some(AlState::Op), true);
                (self.note, self.refused) = (Note::None, Note::None);
                self.enter(now, Step::Up);
                return Happened::Operational;
            }
            AlState::Init | AlState::Boot if self.ending => {
                self.start_over(now, 0, Note::None);
            }
            AlState::Init | AlState::Boot => {
                (self.way.mailbox_open, self.other_time) = (false, false);
                self.enter(now, Step::Ports);
            }
        }
        Happened::Nothing
    }

    /// The AL status code of a fall out of OP.
    fn receive_code(&mut self, now: Time, data: &[u8]) -> Happened {
        let Some((status, code)) = al(data) else { return Happened::Nothing };
        // The image may not have shown it.
        self.way.al = status.state();
        match status.state() {
            Some(AlState::Op) if !status.error() => self.enter(now, Step::Up),
            // Its own watchdog has stopped it.
            Some(AlState::SafeOp) if self.way.joined => self.set_up(now),
            Some(AlState::Op | AlState::SafeOp) => {
                self.note = Note::State { to: AlState::Op, code };
                let acknowledge = status.error().then(|| acknowledging(status));
                // By way of SAFEOP, where the grid has to be locked first.
                let change = Change { to: AlState::SafeOp, said: false, errors: 0, acknowledge };
                self.enter(now, Step::State(change));
            }
            _ => self.start_over(now, 0, Note::Starting),
        }
        if status.error() { Happened::Error } else { Happened::Nothing }
    }
}

/// AL status and its code.
fn al(data: &[u8]) -> Option<(AlStatus, AlCode)> {
    let [low, high, _, _, code_low, code_high] = *data.first_chunk::<AL_LOOK>()?;
    Some((AlStatus(u16::from_le_bytes([low, high])), AlCode(u16::from_le_bytes([code_low, code_high]))))
}

/// What acknowledges the error in this status: its own state, and the bit.
fn acknowledging(status: AlStatus) -> AlStatus {
    AlStatus::request(status.state().unwrap_or_default()).acknowledge()
}
