//! What is written to a slave and read from it over its mailbox: in PREOP, and in OP of a drive that is found there.

use super::{Note, Slave, Step};
use crate::mode::Mode;
use crate::object::Type;
use crate::object::number::{MODE_DISPLAY, STATUS_WORD};
use crate::plan::Start;
use crate::service::{Failure, Service};
use crate::wire::registers::AlState;
use crate::wire::sdo::AbortCode;
use fieldbeat_core::bus::cia402::StatusWord;
use fieldbeat_core::time::{MS, Time};

const POWER: [Start; 1] = [Start::new(STATUS_WORD, Type::U16, 0)];
const MODE: [Start; 1] = [Start::new(MODE_DISPLAY, Type::I8, 0)];

/// How often the lists are begun in PREOP before the slave is brought up anew, since it does not answer.
const LISTS: u8 = 3;

/// A list of objects, and what is done with them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum List {
    /// Written at start-up.
    Write,
    /// Read, and compared with the configuration.
    Verify,
    /// Read, since its outputs carry it as it is.
    Own,
    /// Of a drive that was found in OP: its status word; what is compared; its mode.
    Power,
    Found,
    Mode,
}

impl Slave {
    /// Continues with objects, over its mailbox.
    pub fn objects(&mut self, now: Time, service: Option<&mut Service>) {
        let Step::Objects { list, next, begun } = self.step else { return };
        let objects = match list {
            List::Write => &self.plan.start_up[..],
            List::Verify => &self.plan.verify,
            List::Own => &self.own,
            List::Found => &self.plan.verify_found,
            List::Power => &POWER,
            List::Mode => &MODE,
        };
        let (Some(start), Some(service)) = (objects.get(next), service) else {
            return self.all_objects(now, list);
        };
        if !begun {
            if (list, next) == (List::Write, 0) {
                self.omitted = Note::None;
            }
            // An earlier request of another user is of no use any more.
            let _ = service.take_end();
            if service.is_free() {
                match list {
                    List::Write if start.string.is_empty() => {
                        service.write(start.object, &start.raw.to_le_bytes()[..start.kind.bytes()]);
                    }
                    List::Write => service.write(start.object, &start.string),
                    _ => service.read(start.object),
                }
                self.step = Step::Objects { list, next, begun: true };
            }
            return;
        }
        let Some(end) = service.take_end() else { return };
        let (index, sub, is_factor) = (start.object.index, start.object.sub, start.is_factor());
        let mask = u32::MAX >> (32 - 8 * start.kind.bytes().min(4));
        let wanted = (start.raw as u32).saturating_mul(std::mem::replace(&mut self.factor, 1));
        match end {
            Ok(found) => match list {
                List::Power if StatusWord(found as u16).state().is_powered() => return self.has_power(now),
                List::Power => return self.set_up(now, None),
                List::Mode => self.found_mode = Some(Mode(found as u8 as i8)),
                List::Own => {
                    if let Some(own) = self.own.get_mut(next) {
                        own.raw = (found & mask).into();
                    }
                }
                List::Verify | List::Found if is_factor => self.factor = found.max(1),
                List::Found if (found ^ wanted) & mask != 0 => return self.not_joinable(now),
                List::Verify if (found ^ wanted) & mask != 0 => {
                    return self.refuse(now, Note::Differs { index, sub, found });
                }
                List::Write | List::Verify | List::Found => {}
            },
            // An object that a slave does not have, or does not report, cannot contradict; a drive has to report
            // its PDOs.
            Err(Failure::Abort(_)) if matches!(list, List::Verify | List::Power | List::Mode) => {}
            Err(Failure::Abort(abort)) if start.optional && abort.is_of_optional() => {
                self.omitted = Note::Omitted { index, sub, abort };
            }
            Err(_) if self.way.joined || matches!(list, List::Power | List::Found | List::Mode) => {
                return self.not_joinable(now);
            }
            Err(Failure::Abort(abort)) if list == List::Own => {
                return self.refuse(now, Note::OwnValue { index, sub, abort });
            }
            Err(Failure::Abort(abort)) => return self.refuse(now, Note::StartUp { index, sub, abort }),
            Err(Failure::Unusable(status)) => {
                return self.list_again(now, Note::StartUp { index, sub, abort: AbortCode(status) });
            }
            Err(Failure::GivenUp(_)) => {
                let within_ms = u32::try_from(self.plan.sdo_timeout_ns / MS).unwrap_or(u32::MAX);
                let note = match list {
                    List::Write => Note::Unwritten { index, sub, within_ms },
                    _ => Note::Unread { index, sub, within_ms },
                };
                return self.list_again(now, note);
            }
        }
        self.step = Step::Objects { list, next: next + 1, begun: false };
    }

    /// The slave stays in PREOP, if it is there, and the list begins anew: what was written is written once more.
    fn list_again(&mut self, now: Time, note: Note) {
        self.way.lists += 1;
        if self.way.lists >= LISTS {
            return self.refuse(now, note);
        }
        self.refused = note;
        self.enter(now, Step::to(AlState::PreOp));
    }

    fn all_objects(&mut self, now: Time, list: List) {
        let next = match list {
            List::Write => Step::list(List::Verify),
            List::Verify | List::Found => Step::list(List::Own),
            List::Own => {
                self.has_own = true;
                if self.way.joined { Step::list(List::Mode) } else { self.process_data() }
            }
            List::Power => return self.has_power(now),
            List::Mode => return self.joined_whole(now),
        };
        self.enter(now, next);
    }
}

#[cfg(test)]
mod tests {
    use super::super::Change;
    use super::*;
    use crate::image::Offsets;
    use crate::plan::{Area, Owner, SlavePlan};
    use crate::wire::sdo::Object;
    use fieldbeat_core::axis::acyclic::{self, Commanding};

    #[test]
    fn an_object_that_is_not_answered_is_named_and_the_slave_stays_in_preop() {
        let object = Object::new(0x1C12, 1);
        let mailbox = Some([0x1800, 0x1C00].map(|start| Area { start, length: 16 }));
        let start_up = vec![Start::new(object, Type::U16, 0x1702)];
        let plan = SlavePlan { mailbox, start_up, ..SlavePlan::new(0) };
        // One that is not open ends each transfer without an answer.
        let (_, port) = acyclic::queue(1, Commanding::none());
        let mut service = Service::new(&plan, port, 0);
        let owner = Owner::Device(0);
        let mut slave = Slave::new(owner, &plan, Offsets::default(), true);
        let now = Time(0);
        for list in 1..=LISTS {
            slave.step = Step::list(List::Write);
            slave.objects(now, Some(&mut service));
            slave.objects(now, Some(&mut service));
            let note = Note::Unwritten { index: 0x1C12, sub: 1, within_ms: 2_000 };
            assert_eq!(slave.note(), note);
            let is_there = matches!(slave.step, Step::State(Change { to: AlState::PreOp, .. }));
            assert_eq!(is_there, list < LISTS, "{:?}", slave.step);
        }
        let text = slave.note().text(4, &plan.identity).unwrap_or_default();
        let start =
            "place 4: it does not answer within 2000 ms, 3 times in a row, when 0x1c12:1 is written: ";
        assert!(text.starts_with(start), "{text}");
        assert!(matches!(slave.step, Step::Refused(_)), "then it begins anew");
    }
}
