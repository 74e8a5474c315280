//! Which drive it is, by a parameter with its serial number.
//!
//! It is read while the link is down, by the probes that go out anyway, before any reply counts: until then the drive
//! is not connected, and nothing is written to it. The command has an own count in each attempt, and is one that a
//! drive carries out at any time. After each loss of the link the number is read again: the drive may be another one.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::plan::Serial;
use crate::wire::{RtcBlock, RtcCommand, RtcStatus};

/// Clean replies without the echo of the command: the drive had stored this count already.
const UNECHOED: u8 = 5;

/// Why a drive is not connected although it answers, for normal threads.
#[derive(Clone, Debug, Default)]
pub(crate) struct SerialNote(Arc<AtomicU64>);

/// What a note says, above its number.
const ANOTHER: u64 = 1 << 32;
const REFUSED: u64 = 2 << 32;

impl SerialNote {
    fn set(&self, note: u64) {
        self.0.store(note, Ordering::Relaxed);
    }

    /// In words, for a drive that has to be this one.
    pub(crate) fn text(&self, serial: Serial) -> Option<String> {
        let note = self.0.load(Ordering::Relaxed);
        let (number, from, expected) = (note as u32, serial.from, serial.number?);
        match note & !u64::from(u32::MAX) {
            ANOTHER => Some(format!(
                "its serial number ({from}) is {number}, not {expected}: drives or cables are exchanged: put \
                 them back, or correct serial for another drive"
            )),
            REFUSED => Some(format!(
                "it does not give {from}, where its serial number is to be (status {number:#04x}): correct \
                 serial_from, or leave serial out"
            )),
            _ => None,
        }
    }
}

/// Whether a drive is the one.
#[derive(Debug)]
pub(super) struct Identification {
    wanted: Option<Serial>,
    is_known: bool,
    /// Since the link is down, and no exchange was missed after that.
    is_fresh: bool,
    count: u8,
    unechoed: u8,
    note: SerialNote,
}

impl Identification {
    /// Of a drive that has to be this one, if any.
    pub(super) fn new(wanted: Option<Serial>) -> Identification {
        let wanted = wanted.filter(|wanted| wanted.number.is_some());
        let (is_known, is_fresh) = (wanted.is_none(), false);
        Identification { wanted, is_known, is_fresh, count: 1, unechoed: 0, note: SerialNote::default() }
    }

    pub(super) fn note(&self) -> SerialNote {
        self.note.clone()
    }

    /// It is the one, or may be any.
    #[inline]
    pub(super) fn is_known(&self) -> bool {
        self.is_known
    }

    /// The next request is built: on a link that is down, and after an exchange that was missed.
    pub(super) fn advance(&mut self, is_down: bool, is_missed: bool) {
        self.is_fresh &= is_down && !is_missed;
        self.is_known &= self.wanted.is_none() || !is_down || self.is_fresh;
    }

    /// What the next request asks for.
    pub(super) fn block(&self) -> Option<RtcBlock> {
        let wanted = self.wanted.filter(|_| !self.is_known)?;
        Some(RtcBlock::call(self.count, RtcCommand::READ_RAM, wanted.from.0, 0))
    }

    /// A reply that can be no older one.
    pub(super) fn take(&mut self, answer: Option<RtcBlock>) {
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
            RtcStatus::Refused(refusal) => self.note.set(REFUSED | u64::from(refusal.code())),
            _ if Some(block.value()) != wanted.number => self.note.set(ANOTHER | u64::from(block.value())),
            _ => {
                self.note.set(0);
                (self.is_known, self.is_fresh) = (true, true);
            }
        }
        self.again();
    }

    /// With another count; 0 is what a drive has stored after its start.
    fn again(&mut self) {
        (self.count, self.unechoed) = (if self.count >= 14 { 1 } else { self.count + 1 }, 0);
    }
}
