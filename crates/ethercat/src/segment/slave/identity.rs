//! Who a slave is, by its SII: taken from its processor, read, compared, and given back.

use super::{Note, Slave, Step};
use crate::plan::Expected;
use crate::sii::{Head, Managers, Reader};
use crate::slot::Answer;
use crate::wire::registers::AlState;
use crate::wire::sii::{self, Fault};
use fieldbeat_core::time::Time;

/// The most looks at a busy SII before the command is repeated; and at one that its processor still has.
const SII_LOOKS: u16 = 200;
const OWNER_LOOKS: u8 = 50;

impl Slave {
    /// What its SII has is compared with the configuration.
    fn wants_sii(&self) -> bool {
        self.plan.check_sii || self.plan.identity != Expected::default()
    }

    /// Who it is, as far as the configuration wants to know that.
    pub(super) fn identify(&mut self, now: Time) {
        self.delivered = Managers::default();
        if self.wants_sii() { self.enter(now, Step::SiiForce) } else { self.identified(now) }
    }

    /// Its SII was given to the master: whether its processor has let it go.
    pub(super) fn took_sii(&mut self, now: Time, looks: u8, owner: Option<Answer<'_>>) {
        let is_processors =
            owner.is_none_or(|owner| owner.working_counter == 0 || sii::is_processors(owner.data));
        if !is_processors {
            self.enter(now, Step::Sii(Reader::new(Managers::default(), SII_LOOKS)));
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
