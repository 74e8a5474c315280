//! Who a slave is, before anything of it is set: by its alias; by its SII, which is taken from its processor, read,
//! compared, and given back; by its identification, which is requested with its present state.

use super::receive::al;
use super::{Context, Note, Slave, Step};
use crate::sii::{Head, Managers, Reader};
use crate::slot::{Answer, Answers};
use crate::wire::registers::{AlState, AlStatus};
use crate::wire::sii::{self, Fault};
use fieldbeat_core::time::{MS, Time};

/// The most looks at a busy SII before the command is repeated; and at one that its processor still has.
const SII_LOOKS: u16 = 200;
const OWNER_LOOKS: u8 = 50;
/// A processor reads AL control in its own time: SOEM and TwinCAT wait less for an identification.
const IDENTIFIES_WITHIN_NS: u64 = 500 * MS;

impl Slave {
    /// Who it is, as far as the configuration wants to know that.
    pub(super) fn identify(&mut self, now: Time) {
        self.delivered = Managers::default();
        match self.plan.identity.alias {
            Some(wanted) if wanted != self.alias => {
                self.leave_running(now, Note::Alias { found: self.alias, wanted });
            }
            // What its SII has is compared with the configuration.
            _ if self.plan.check_sii || self.plan.identity.is_in_sii() => self.enter(now, Step::SiiForce),
            _ => self.known_by_sii(now),
        }
    }

    /// The SII has nothing against it.
    pub(super) fn known_by_sii(&mut self, now: Time) {
        match self.plan.identity.identification {
            None => self.identified(now),
            // Without a processor it only copies what is requested.
            Some(_) if self.emulated => self.leave_running(now, Note::NoIdentification),
            Some(_) => self.enter(now, Step::Identification),
        }
    }

    /// AL control of its present state.
    pub(super) fn present(&self) -> AlStatus {
        self.acknowledge.unwrap_or(AlStatus::request(self.way.al.unwrap_or_default()))
    }

    /// The AL status, in whose code the identification is once it says so.
    pub(super) fn takes_identification(&mut self, context: &Context<'_>, answers: &Answers<'_>) {
        let (now, Some(wanted)) = (context.cycle.grid, self.plan.identity.identification) else { return };
        let shown = answers[1].and_then(|answer| al(answer.data));
        let found = shown.filter(|(status, _)| status.0 & AlStatus::IDENTIFICATION != 0);
        let refused = match found {
            Some((_, code)) if code.0 == wanted => Note::None,
            Some((_, code)) => Note::Identification { found: code.0, wanted },
            None if now.since(self.since) < IDENTIFIES_WITHIN_NS => return,
            None => Note::NoIdentification,
        };
        self.enter(now, Step::Identified { refused });
    }

    /// The SII was given to the master: whether its processor has let it go.
    pub(super) fn took_sii(&mut self, now: Time, looks: u8, owner: Option<Answer<'_>>) {
        let is_processors =
            owner.is_none_or(|owner| owner.working_counter == 0 || sii::is_processors(owner.data));
        if !is_processors {
            let managers = Managers::new(self.plan.identity.serial.is_some());
            self.enter(now, Step::Sii(Reader::new(managers, SII_LOOKS)));
        } else if looks < OWNER_LOOKS {
            self.step = Step::SiiTake { looks: looks + 1 };
        } else {
            self.enter(now, Step::SiiBack { refused: Note::Sii(Fault::Owned) });
        }
    }

    /// A difference between its SII and the configuration.
    pub(super) fn contradiction(&mut self, head: &Head, delivered: Managers) -> Option<Note> {
        self.delivered = delivered;
        let (expected, found) = (&self.plan.identity, head.identity);
        let differs = |expected: Option<u32>, found: u32| expected.is_some_and(|expected| expected != found);
        match () {
            () if head.is_blank() && expected.serial.is_some() => Some(Note::Sii(Fault::Blank)),
            () if expected.is(found) && differs(expected.serial, head.serial) => {
                Some(Note::Serial(head.serial))
            }
            () if expected.is(found) => {
                (self.plan.check_sii && !head.is_blank()).then(|| self.contradicts(head))?
            }
            () if head.is_blank() => Some(Note::Sii(Fault::Blank)),
            () if differs(expected.vendor, found.vendor) => Some(Note::Vendor(found.vendor)),
            () if differs(expected.product, found.product) => Some(Note::Product(found.product)),
            () => Some(Note::Revision(found.revision)),
        }
    }

    pub(super) fn identified(&mut self, now: Time) {
        let init = Step::acknowledged(AlState::Init, self.acknowledge);
        self.enter(now, if self.may_be_found() { Step::Found } else { init });
    }
}
