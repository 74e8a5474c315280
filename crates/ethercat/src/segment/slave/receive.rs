//! The answers to the requests of a step.

use super::request::AL_LOOK;
use super::setup::WATCHDOG_DIVIDER;
use super::step::Resumes;
use super::{Change, Context, FMMUS_AT_ONCE, Happened, List, Mapped, Note, Phase, Runs, Slave, Step, Tie};
use crate::sii::Reading;
use crate::slot::Answers;
use crate::wire::registers::{AlCode, AlState, AlStatus};
use fieldbeat_core::time::Time;

/// Missing answers in a row until it counts as lost.
const SILENT: u8 = 3;
/// Errors that are acknowledged on the way to one state.
const ERRORS: u8 = 3;

impl Slave {
    /// Takes the answer to its request.
    pub fn receive(&mut self, context: &Context<'_>, answers: &Answers<'_>) -> Happened {
        let now = context.cycle.grid;
        // A lost frame: the same is requested again.
        let Some(first) = answers[0] else { return Happened::Nothing };
        if self.is_elsewhere(context.counted) {
            self.elsewhere(now);
            return Happened::Nothing;
        }
        // AL control may still be unread by the firmware, and not accept a second request; usually nobody else has
        // its station address.
        let may_be_zero = match self.step {
            Step::State(Change { phase: Phase::Requests, .. }) => true,
            Step::SiiForce | Step::SiiTake { .. } | Step::SiiBack { .. } => true,
            Step::Identification | Step::Identified { .. } => true,
            Step::Sii(reader) => reader.writes(),
            Step::Twin { .. } | Step::Free { .. } | Step::Misplaced => true,
            Step::Watchdog => !self.sets_watchdog(),
            _ => false,
        };
        if let Some(missing) = context.missing.filter(|_| !may_be_zero) {
            self.silent += 1;
            if matches!(self.step, Step::Look | Step::There(_) | Step::Refused(_)) {
                self.absent(now, context.counted);
            } else if self.silent >= SILENT {
                self.enter(now, Step::There(missing));
            }
            return Happened::Nothing;
        }
        self.silent = 0;
        if self.way.addressed {
            self.counted_as_ours = context.counted;
        }
        match self.step {
            Step::Look => return self.looked(context, answers),
            Step::Refused(pause) => self.looked_again(now, pause, answers),
            Step::Twin { place, .. } => self.counted(now, place, first.working_counter),
            Step::Unaddress => self.enter(now, Step::Look),
            Step::Misplaced => {
                self.start_over(now, 0, Note::Starting);
                return Happened::Misplaced;
            }
            Step::Unmap(done) => self.unmapped(now, done.saturating_add(FMMUS_AT_ONCE)),
            Step::There(missing) => {
                self.is_there(now, missing, answers[1].map_or(&[], |station| station.data));
            }
            Step::SiiForce => self.enter(now, Step::SiiTake { looks: 0 }),
            Step::SiiTake { looks } => self.took_sii(now, looks, answers[1]),
            Step::Sii(mut reader) => match reader.receive(answers) {
                Reading::Busy | Reading::On => self.step = Step::Sii(reader),
                Reading::Done => {
                    let refused = self.contradiction(&reader.head, reader.content);
                    self.enter(now, Step::SiiBack { refused: refused.unwrap_or_default() });
                }
                Reading::Failed(fault) => self.enter(now, Step::SiiBack { refused: Note::Sii(fault) }),
            },
            Step::SiiBack { .. } if self.ending => self.start_over(now, 0, self.note),
            Step::SiiBack { refused: Note::None } => self.known_by_sii(now),
            Step::SiiBack { refused } => self.leave_running(now, refused),
            Step::Identification => self.takes_identification(context, answers),
            Step::Identified { refused: Note::None } => self.identified(now),
            Step::Identified { refused } => self.leave_running(now, refused),
            Step::Found => self.found(now, answers),
            Step::FoundFmmus => self.found_fmmus(now, first.data),
            Step::Check { resumes, part } => return self.was_checked(context, resumes, part, first.data),
            Step::Join => self.join(now),
            Step::Ports => self.enter(now, Step::Clear(0)),
            Step::Clear(done) => {
                // The last ones are followed by one that is not counted.
                let over = done >= self.fmmus.max(self.managers);
                let next = done.saturating_add(FMMUS_AT_ONCE);
                self.enter(now, if over { Step::Free { joins: false } } else { Step::Clear(next) });
            }
            Step::Free { joins } => self.enter(now, Step::Address { joins }),
            Step::Address { joins } => self.was_addressed(now, answers[1], joins),
            Step::Mailbox => self.enter(now, Step::to(AlState::PreOp)),
            Step::Watchdog if self.sets_watchdog() => self.enter(now, Step::WatchdogCheck),
            Step::Watchdog => self.enter(now, Step::SyncManagers(0)),
            Step::WatchdogCheck => {
                let values = [WATCHDOG_DIVIDER, self.watchdog()].map(u16::to_le_bytes);
                let is_set = answers
                    .iter()
                    .zip(values)
                    .all(|(answer, value)| answer.is_some_and(|answer| answer.data == value));
                self.checked(now, if is_set { Ok(Step::SyncManagers(0)) } else { Err(Note::Watchdog) });
            }
            Step::SyncManagers(from) => self.enter(now, Step::SyncManagersCheck(from)),
            Step::SyncManagersCheck(from) => {
                self.checked(now, self.managers_read(from, answers));
            }
            Step::Fmmus => {
                self.way.mapped = Mapped::All;
                self.enter(now, self.step_of_clock());
            }
            Step::State(change) => return self.went(now, change, answers),
            // Its outputs are released.
            Step::Release => {
                self.way.mapped = Mapped::All;
                self.enter(now, Step::Up);
            }
            Step::Code => return self.receive_code(now, first.data),
            Step::FoundClock { refused } => return self.found_clock(context, refused, answers),
            Step::Rest(_) | Step::Objects { .. } | Step::Lock | Step::Up => {}
            _ => self.receive_clock(context, first.data, answers[1].map_or(&[], |answer| answer.data)),
        }
        Happened::Nothing
    }

    /// The settings were read back.
    fn checked(&mut self, now: Time, next: Result<Step, Note>) {
        match next {
            Ok(next) => self.enter(now, next),
            Err(note) => self.refuse(now, note),
        }
    }

    /// A change of state continues: the request was accepted, or the status was read.
    fn went(&mut self, now: Time, mut change: Change, answers: &Answers<'_>) -> Happened {
        let Some(first) = answers[0] else { return Happened::Nothing };
        if change.phase != Phase::Waits {
            change.phase = match change.phase {
                _ if first.working_counter == 0 => Phase::Looks,
                Phase::Requests => Phase::Waits,
                _ => Phase::Requests,
            };
            self.step = Step::State(change);
            return Happened::Nothing;
        }
        let Some((status, code)) = al(first.data) else { return Happened::Nothing };
        // A mirrored bit is no error; nor is one without a code in the state that was requested.
        let is_reached = code == AlCode::NONE && status.state() == Some(change.to);
        if status.error() && !self.emulated && !is_reached {
            return self.refused_state(now, change, status, code);
        }
        if change.acknowledge.take().is_some() {
            change.phase = Phase::Requests;
        }
        self.step = Step::State(change);
        match status.state() {
            Some(state) if state == change.to && change.phase == Phase::Waits => {
                return self.reached(now, state);
            }
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
        let note = self.refusal(change.to, code);
        if change.errors >= ERRORS {
            self.refuse(now, note);
            return Happened::Error;
        }
        self.note = note;
        change.errors += 1;
        (change.acknowledge, change.phase) = (Some(acknowledging(status)), Phase::Requests);
        self.step = Step::State(change);
        Happened::Error
    }

    fn reached(&mut self, now: Time, state: AlState) -> Happened {
        self.note = Note::Starting;
        match state {
            AlState::PreOp => {
                (self.way.mailbox_open, self.tie) = (self.plan.mailbox.is_some(), self.tie.max(Tie::Known));
                self.enter(now, Step::list(List::Write));
            }
            AlState::SafeOp => {
                (self.way.al, self.tie, self.watched) = (Some(AlState::SafeOp), Tie::Ours, true);
                self.remark = match self.refused {
                    Note::Intruded => Note::Intruded,
                    _ => self.unarmed(),
                };
                self.further = self.omitted;
                let settles = self.plan.sync;
                self.enter(now, if settles { Step::Settle { good: 0, next: now } } else { Step::Lock });
            }
            AlState::Op => {
                (self.way.al, self.way.was_operational) = (Some(AlState::Op), true);
                (self.note, self.refused, self.moved_at) = (Note::None, Note::None, now);
                self.enter(now, Step::Up);
                return Happened::Operational;
            }
            AlState::Init | AlState::Boot if self.ending => {
                self.start_over(now, 0, Note::None);
            }
            AlState::Init | AlState::Boot => {
                (self.way.mailbox_open, self.runs) = (false, Runs::Harmless);
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
        let fallen = Note::State { to: AlState::Op, code };
        match status.state() {
            Some(AlState::Op) if !status.error() => self.enter(now, Step::Up),
            // Its own watchdog has stopped it.
            Some(AlState::SafeOp) if self.way.joined => {
                self.set_up(now, self.acknowledgement(status, code));
            }
            _ if status.error() && self.falls_again(now) => self.refuse(now, fallen),
            Some(AlState::Op | AlState::SafeOp) => {
                self.note = fallen;
                self.acknowledge = self.acknowledgement(status, code);
                self.check(now, Resumes::SafeOp(self.acknowledge));
            }
            _ => self.start_over(now, 0, Note::Starting),
        }
        if status.error() { Happened::Error } else { Happened::Nothing }
    }

    /// The acknowledgement of the error in this status; `None`: it is none.
    pub(super) fn acknowledgement(&self, status: AlStatus, code: AlCode) -> Option<AlStatus> {
        let is_error = status.error() && !self.emulated && code != AlCode::NONE;
        is_error.then(|| acknowledging(status))
    }
}

/// AL status and its code.
pub(super) fn al(data: &[u8]) -> Option<(AlStatus, AlCode)> {
    let [low, high, _, _, code_low, code_high] = *data.first_chunk::<AL_LOOK>()?;
    Some((AlStatus(u16::from_le_bytes([low, high])), AlCode(u16::from_le_bytes([code_low, code_high]))))
}

/// The acknowledgement of the error in this status: its own state, and the bit.
fn acknowledging(status: AlStatus) -> AlStatus {
    AlStatus::request(status.state().unwrap_or_default()).acknowledge()
}
