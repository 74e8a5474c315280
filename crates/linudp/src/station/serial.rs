//! Which drive it is, by a parameter with its serial number.
//!
//! It is read while the link is down, by the probes that go out anyway, before any reply counts: until then the drive
//! is not connected, and nothing is written to it. The command has an own count in each attempt, and is one that a
//! drive carries out at any time. After each loss of the link the number is read again: the drive may be another one.

use crate::plan::Serial;
use crate::wire::{RtcBlock, RtcCommand, RtcStatus};
use fieldbeat_core::bus::notes::NoteCells;

/// Clean replies without the echo of the command: the drive had stored this count already.
const UNECHOED: u8 = 5;

/// Why a drive is not connected although it answers.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) enum SerialNote {
    #[default]
    None,
    /// It has another serial number.
    Another(u32),
    /// It refuses to give it, by this code.
    Refused(u8),
}

impl SerialNote {
    /// In words, for a drive that has to be this one.
    pub(crate) fn text(self, Serial { from, number }: Serial) -> Option<String> {
        let expected = number?;
        match self {
            SerialNote::None => None,
            SerialNote::Another(number) => Some(format!(
                "its serial number ({from}) is {number}, not {expected}: drives or cables are exchanged: put \
                 them back, or correct serial for another drive"
            )),
            SerialNote::Refused(status) => Some(format!(
                "it does not give {from}, where its serial number is to be (status {status:#04x}): correct \
                 serial_from, or leave serial out"
            )),
        }
    }
}

/// Whether the drive is the one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum IdentifiedFor {
    No,
    /// Since the link is down, and no exchange was missed after that.
    Fresh,
    /// Until the link is lost.
    Linked,
}

/// Whether a drive is the one.
#[derive(Debug)]
pub(super) struct Identification {
    /// The one that it has to be, if any.
    wanted: Option<Serial>,
    known: IdentifiedFor,
    count: u8,
    unechoed: u8,
}

impl Identification {
    /// Of a drive that has to be this one, if any.
    pub(super) fn new(wanted: Option<Serial>) -> Identification {
        let wanted = wanted.filter(|wanted| wanted.number.is_some());
        let known = if wanted.is_none() { IdentifiedFor::Linked } else { IdentifiedFor::No };
        Identification { wanted, known, count: 1, unechoed: 0 }
    }

    /// It is the one, or may be any.
    #[inline]
    pub(super) fn is_known(&self) -> bool {
        self.known != IdentifiedFor::No
    }

    /// The next request is built: on a link that is down, and after an exchange that was missed.
    pub(super) fn advance(&mut self, is_down: bool, is_missed: bool) {
        self.known = match self.known {
            known if self.wanted.is_none() => known,
            IdentifiedFor::No => IdentifiedFor::No,
            _ if !is_down => IdentifiedFor::Linked,
            IdentifiedFor::Fresh if !is_missed => IdentifiedFor::Fresh,
            IdentifiedFor::Fresh | IdentifiedFor::Linked => IdentifiedFor::No,
        };
    }

    /// The read of the next request.
    pub(super) fn block(&self) -> Option<RtcBlock> {
        let wanted = self.wanted.filter(|_| !self.is_known())?;
        Some(RtcBlock::call(self.count, RtcCommand::READ_RAM, wanted.from.0, 0))
    }

    /// A reply that can be no older one. Why the drive is not the one goes into `note`.
    pub(super) fn take(&mut self, answer: Option<RtcBlock>, note: &NoteCells<SerialNote>) {
        let Some(wanted) = self.wanted else { return };
        let Some(block) = answer.filter(|block| block.count() == self.count) else {
            self.unechoed += 1;
            if self.unechoed >= UNECHOED {
                self.again();
            }
            return;
        };
        self.unechoed = 0;
        match block.status() {
            RtcStatus::Running | RtcStatus::Busy => return,
            // The answer to an earlier command with this count.
            _ if block.index() != wanted.from.0 => {}
            RtcStatus::Refused(refusal) => note.set(0, SerialNote::Refused(refusal.code())),
            _ if Some(block.value()) != wanted.number => note.set(0, SerialNote::Another(block.value())),
            _ => {
                note.set(0, SerialNote::None);
                self.known = IdentifiedFor::Fresh;
            }
        }
        self.again();
    }

    /// With another count; 0 is what a drive has stored after its start.
    fn again(&mut self) {
        (self.count, self.unechoed) = (if self.count >= 14 { 1 } else { self.count + 1 }, 0);
    }
}
