//! Reads the SII of a slave step by step, four or eight bytes at a time: in the slots of the cycle, and for a scan.
//!
//! A command is written to an SII that was seen idle, and its data count with the address that was requested.

use super::plan::Area;
use super::slot::{Answers, Ask};
use super::wire::frame::Command;
use super::wire::registers::{SyncManager, address};
use super::wire::sii::{self, Category, Fault, Identity, Protocols, Status, Use, word};

/// The most SyncManagers that are kept for bring-up.
const MANAGERS: usize = 8;
/// The most categories that are walked through, more than any slave has: where the end is missing.
const CATEGORIES: u8 = 64;
/// The repetitions of a command that failed.
const REPETITIONS: u8 = 3;
/// Control, address and data follow each other.
const LOOK: usize = 14;
const ADDRESS_AT: usize = 2;
const DATA_AT: usize = (address::SII_DATA - address::SII_CONTROL) as usize;
/// The value of an EEPROM that was never written.
const BLANK: u32 = u32::MAX;

/// The words before the categories, in this order.
const HEAD: [u16; 7] = [
    word::VENDOR,
    word::PRODUCT,
    word::REVISION,
    word::SERIAL,
    word::MAILBOX_OUT,
    word::MAILBOX_IN,
    word::PROTOCOLS,
];

/// The words before the categories.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Head {
    /// The slave's identity.
    pub identity: Identity,
    /// The serial number; 0 where it is not read.
    pub serial: u32,
    /// The mailboxes: out, in; at 0: it names none.
    pub mailboxes: [Area; 2],
    /// Their protocols.
    pub protocols: Protocols,
}

impl Head {
    /// The EEPROM was never written.
    pub fn is_blank(&self) -> bool {
        matches!(self.identity.vendor, 0 | BLANK)
    }

    /// Takes what `word` and the word after it have.
    fn take(&mut self, at: u16, data: [u8; 4]) {
        let number = u32::from_le_bytes(data);
        let area = Area { start: number as u16, length: (number >> 16) as u16 };
        match at {
            word::VENDOR => self.identity.vendor = number,
            word::PRODUCT => self.identity.product = number,
            word::REVISION => self.identity.revision = number,
            word::SERIAL => self.serial = number,
            word::MAILBOX_OUT => self.mailboxes[0] = area,
            word::MAILBOX_IN => self.mailboxes[1] = area,
            _ => self.protocols = Protocols(number as u16),
        }
    }
}

/// The kept part of the categories, and of the status of each read.
pub trait Content {
    /// The slave has loaded the SII, and its checksum is right, or what is read is to be kept nevertheless.
    fn accepts(&mut self, status: Status) -> bool;

    /// The most words that are read of a category of this kind.
    fn wants(&self, kind: u16) -> u16;

    /// Nothing is read behind a category of this kind.
    fn ends_with(&self, _kind: u16) -> bool {
        false
    }

    /// The serial number is read.
    fn wants_serial(&self) -> bool {
        true
    }

    /// Four bytes of such a category, or its last two, so many behind its begin.
    fn take(&mut self, kind: u16, at: usize, data: &[u8]);
}

/// The item that is being read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Item {
    /// The number of words of the head that were read.
    Head(usize),
    /// The header of category `nth`.
    Category {
        at: u16,
        nth: u8,
    },
    /// The words of a category that are left, and the header of the next one.
    Words {
        kind: u16,
        begin: u16,
        at: u16,
        end: u16,
        next: Option<u16>,
        nth: u8,
    },
    Done,
}

/// The next request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SiiStep {
    /// Whether it is idle.
    Check,
    /// The failed command is ended.
    Clear,
    Command,
    Look,
}

/// The progress of reading.
#[derive(Clone, Copy, Debug)]
pub struct Reader<C> {
    item: Item,
    next: SiiStep,
    /// Looks at a busy SII, and the most of them until the command is repeated.
    looks: u16,
    most_looks: u16,
    repetitions: u8,
    /// The head that was read.
    pub head: Head,
    /// The same of its categories.
    pub content: C,
}

/// The result of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// The command is under way.
    Busy,
    /// It continues.
    On,
    /// Everything is read.
    Done,
    /// It cannot be read.
    Failed(Fault),
}

impl<C: Content> Reader<C> {
    /// Nothing was read yet. A command is repeated after so many looks at a busy SII.
    pub fn new(content: C, most_looks: u16) -> Reader<C> {
        let (item, next, head) = (Item::Head(0), SiiStep::Check, Head::default());
        Reader { item, next, looks: 0, most_looks, repetitions: 0, head, content }
    }

    fn word(&self) -> Option<u16> {
        match self.item {
            Item::Head(nth) => HEAD.get(nth).copied(),
            Item::Category { at, .. } | Item::Words { at, .. } => Some(at),
            Item::Done => None,
        }
    }

    /// Requests the next part, with commands that reach the slave at a register.
    pub fn request(&self, read: impl Fn(u16) -> Command, write: impl Fn(u16) -> Command, ask: &mut Ask) {
        let Some(word) = self.word() else { return };
        let control = address::SII_CONTROL;
        match self.next {
            SiiStep::Clear => ask.write(write(control), &Status::IDLE.to_le_bytes()),
            SiiStep::Command => ask.write(write(control), &sii::read(word)),
            SiiStep::Check | SiiStep::Look => ask.read(read(control), LOOK),
        };
    }

    /// It writes next: a busy SII, or one that belongs to the slave's processor, does not take that.
    pub fn writes(&self) -> bool {
        matches!(self.next, SiiStep::Clear | SiiStep::Command)
    }

    /// Takes the answer.
    pub fn receive(&mut self, answers: &Answers<'_>) -> Reading {
        // A lost frame: the same is requested again.
        let Some(answer) = answers[0] else { return Reading::On };
        if self.writes() {
            if answer.working_counter == 0 {
                return self.again(SiiStep::Check, Fault::Owned);
            }
            self.next = if self.next == SiiStep::Clear { SiiStep::Check } else { SiiStep::Look };
            return Reading::On;
        }
        let Some(status) = answer.data.first_chunk::<2>() else { return Reading::On };
        let status = Status(u16::from_le_bytes(*status));
        if status.busy() || answer.working_counter == 0 {
            self.looks = self.looks.saturating_add(1);
            let is_long = self.looks > self.most_looks;
            return if is_long { self.again(SiiStep::Check, Fault::Busy) } else { Reading::Busy };
        }
        if self.next == SiiStep::Check {
            if status.failed() {
                return self.again(SiiStep::Clear, Fault::Refused);
            }
            (self.next, self.looks) = (SiiStep::Command, 0);
            return Reading::On;
        }
        if !self.content.accepts(status) {
            return self.again(SiiStep::Clear, status.fault());
        }
        let (address, data) = (answer.data.get(ADDRESS_AT..DATA_AT), answer.data.get(DATA_AT..LOOK));
        let (Some(word), Some(data)) = (self.word(), data.map(|data| data.as_chunks::<4>().0)) else {
            return Reading::Failed(Fault::Refused);
        };
        if address != Some(&u32::from(word).to_le_bytes()) {
            return self.again(SiiStep::Check, Fault::Address);
        }
        (self.next, self.looks, self.repetitions) = (SiiStep::Command, 0, 0);
        let halves = if status.reads_eight() { 2 } else { 1 };
        for (half, data) in (0..halves).zip(data) {
            // The second half counts if it is what would be read next.
            if self.word() == word.checked_add(2 * half) {
                self.take(*data);
            }
        }
        if self.item == Item::Done { Reading::Done } else { Reading::On }
    }

    fn again(&mut self, next: SiiStep, fault: Fault) -> Reading {
        (self.next, self.looks) = (next, 0);
        self.repetitions += 1;
        if self.repetitions > REPETITIONS { Reading::Failed(fault) } else { Reading::On }
    }

    fn take(&mut self, data: [u8; 4]) {
        self.item = match self.item {
            Item::Head(nth) => {
                self.head.take(HEAD[nth], data);
                let is_read = |next: &usize| HEAD[*next] != word::SERIAL || self.content.wants_serial();
                match (nth + 1..HEAD.len()).find(is_read) {
                    Some(next) => Item::Head(next),
                    None => Item::Category { at: word::CATEGORIES, nth: 0 },
                }
            }
            Item::Category { at, nth } => self.next_category(at, nth, data),
            Item::Words { kind, begin, at, end, next, nth } => {
                let bytes = 2 * usize::from(end - at);
                self.content.take(kind, 2 * usize::from(at - begin), &data[..bytes.min(data.len())]);
                match at.checked_add(2) {
                    Some(at) if at < end => Item::Words { kind, begin, at, end, next, nth },
                    _ if self.content.ends_with(kind) => Item::Done,
                    _ => next.map_or(Item::Done, |at| Item::Category { at, nth: nth + 1 }),
                }
            }
            Item::Done => Item::Done,
        };
    }

    /// The header of a category was read.
    fn next_category(&self, at: u16, nth: u8, header: [u8; 4]) -> Item {
        let category = Category::new(header).filter(|_| nth < CATEGORIES && u32::from_le_bytes(header) != 0);
        let (Some(Category { kind, words }), Some(begin)) = (category, at.checked_add(2)) else {
            return Item::Done;
        };
        let next = begin.checked_add(words);
        let wanted = words.min(self.content.wants(kind));
        if wanted > 0 {
            let end = begin.saturating_add(wanted);
            return Item::Words { kind, begin, at: begin, end, next, nth };
        }
        next.map_or(Item::Done, |at| Item::Category { at, nth: nth + 1 })
    }
}

/// The SyncManagers as delivered, in their order, and the use of each: what bring-up compares.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Managers {
    entries: [Option<(SyncManager, Use)>; MANAGERS],
    /// The first half of an entry.
    first: [u8; 4],
    /// The serial number is read, too.
    serial: bool,
}

impl Content for Managers {
    fn accepts(&mut self, status: Status) -> bool {
        !status.error()
    }

    fn wants(&self, kind: u16) -> u16 {
        if kind == Category::SYNC_MANAGERS { 4 * MANAGERS as u16 } else { 0 }
    }

    fn ends_with(&self, kind: u16) -> bool {
        kind == Category::SYNC_MANAGERS
    }

    fn wants_serial(&self) -> bool {
        self.serial
    }

    fn take(&mut self, _kind: u16, at: usize, data: &[u8]) {
        let Ok(data) = <[u8; 4]>::try_from(data) else { return };
        if at.is_multiple_of(8) {
            self.first = data;
        } else if let Some(entry) = self.entries.get_mut(at / 8) {
            let ([a, b, c, d], [e, f, g, h]) = (self.first, data);
            *entry = Some(sii::sync_manager([a, b, c, d, e, f, g, h]));
        }
    }
}

impl Managers {
    /// None is read yet.
    pub fn new(serial: bool) -> Managers {
        Managers { serial, ..Managers::default() }
    }

    /// There are none.
    pub fn is_empty(&self) -> bool {
        self.entries.iter().all(Option::is_none)
    }

    /// The SyncManagers of this use, each with its number.
    pub fn of(&self, usage: Use) -> impl Iterator<Item = (u16, SyncManager)> {
        let entries =
            (0..).zip(&self.entries).filter_map(|(number, entry)| entry.map(|entry| (number, entry)));
        entries.filter(move |(_, (_, other))| *other == usage).map(|(number, (manager, _))| (number, manager))
    }
}
