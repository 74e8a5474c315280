//! What is written to a slave and read from it over its mailbox: in PREOP, and in OP of a drive that is found there.

use super::{Note, Slave, Step};
use crate::bus::ethercat::cia402::{Mode, StatusWord};
use crate::bus::ethercat::object::Type;
use crate::bus::ethercat::object::number::{MODE_DISPLAY, STATUS_WORD};
use crate::bus::ethercat::plan::Start;
use crate::bus::ethercat::service::{SdoFailure, Service, Transfer};
use crate::bus::ethercat::wire::registers::AlState;
use crate::bus::ethercat::wire::sdo::{AbortCode, Object};
use crate::time::Time;

const STATE: [Start; 2] = [Start::new(MODE_DISPLAY, Type::I8, 0), Start::new(STATUS_WORD, Type::U16, 0)];

/// A list of objects, and what is done with them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum List {
    /// Written at start-up.
    Write,
    /// Read, and compared with the configuration.
    Verify,
    /// The same of a drive that was found in OP.
    Found,
    /// Its mode and status word then.
    State,
}

impl Slave {
    /// Continues with objects, over its mailbox.
    pub fn objects(&mut self, now: Time, service: Option<&mut Service>) {
        let Step::Objects { list, next, begun } = self.step else { return };
        let objects = match list {
            List::Write => &self.plan.start_up[..],
            List::Verify => &self.plan.verify,
            List::Found => &self.plan.verify_found,
            List::State => &STATE,
        };
        let (Some(start), Some(service)) = (objects.get(next).copied(), service) else {
            return self.all_objects(now, list);
        };
        if !begun {
            // An earlier request of another user is of no use any more.
            let _ = service.take_end();
            if service.is_free() {
                service.begin(match list {
                    List::Write => {
                        Transfer::Write { object: start.object, raw: start.raw, bytes: start.bytes() as u8 }
                    }
                    _ => Transfer::Read(start.object),
                });
                self.step = Step::Objects { list, next, begun: true };
            }
            return;
        }
        let Some(end) = service.take_end() else { return };
        let mask = u32::MAX >> (32 - 8 * start.kind.bytes().min(4));
        let wanted = (start.raw as u32).saturating_mul(std::mem::replace(&mut self.factor, 1));
        match end {
            Ok(found) if list == List::State && start.object == MODE_DISPLAY => {
                self.found_mode = Some(Mode(found as u8 as i8));
                self.step = Step::Objects { list, next: next + 1, begun: false };
            }
            Ok(found) if list == List::State => self.joined_as(now, StatusWord(found as u16)),
            Ok(found) if list != List::Write && start.is_factor() => {
                self.factor = found.max(1);
                self.step = Step::Objects { list, next: next + 1, begun: false };
            }
            Ok(found) if list != List::Write && (found ^ wanted) & mask != 0 => {
                self.differs(now, list, start.object, found);
            }
            // An object that a slave does not have, or does not report, cannot contradict; a drive has to report
            // its PDOs.
            Err(SdoFailure::Abort(_)) if matches!(list, List::Verify | List::State) => {
                self.step = Step::Objects { list, next: next + 1, begun: false };
            }
            Ok(_) => self.step = Step::Objects { list, next: next + 1, begun: false },
            Err(_) if matches!(list, List::Found | List::State) => self.not_joinable(now),
            Err(failure) => {
                let abort = match failure {
                    SdoFailure::Abort(code) => code,
                    SdoFailure::Silent if list == List::Verify => {
                        return self.refuse(now, Note::Unread(start.object));
                    }
                    SdoFailure::Silent => AbortCode(0),
                };
                self.refuse(now, Note::StartUp { object: start.object, abort });
            }
        }
    }

    fn all_objects(&mut self, now: Time, list: List) {
        match list {
            List::Write => self.enter(now, Step::Objects { list: List::Verify, next: 0, begun: false }),
            List::Verify if self.plan.outputs.length > 0 => self.enter(now, Step::Watchdog),
            List::Verify if self.plan.inputs.length > 0 => self.enter(now, Step::SyncManagers),
            // A coupler's head exchanges only its state.
            List::Verify if self.fmmus().1 > 0 => self.enter(now, Step::Fmmus),
            List::Verify => self.enter(now, Step::to(AlState::SafeOp)),
            List::Found => self.enter(now, Step::Objects { list: List::State, next: 0, begun: false }),
            List::State => self.joined_whole(now),
        }
    }

    fn differs(&mut self, now: Time, list: List, object: Object, found: u32) {
        if list == List::Found {
            self.not_joinable(now);
        } else {
            self.refuse(now, Note::Differs { object, found });
        }
    }
}
