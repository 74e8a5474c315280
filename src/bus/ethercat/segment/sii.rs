//! Reads the SII of a slave, four bytes at a time: two slots per pair of words.

use crate::bus::ethercat::plan::Area;
use crate::bus::ethercat::slot::{Answers, Ask};
use crate::bus::ethercat::wire::frame::Command;
use crate::bus::ethercat::wire::registers::{SyncManager, address};
use crate::bus::ethercat::wire::sii::{self, Category, Identity, Protocols, Status, Use, word};

/// The most SyncManagers that are read.
pub const MANAGERS: usize = 8;
/// The most categories that are walked through.
const CATEGORIES: u8 = 64;
/// The most polls of a busy SII before the command is repeated, and repetitions.
const LOOKS: u8 = 200;
const ASKINGS: u8 = 3;
/// Control, address and data follow each other.
const POLL: usize = 14;
const DATA_AT: usize = (address::SII_DATA - address::SII_CONTROL) as usize;
/// The value of an EEPROM that was never written.
const BLANK: u32 = u32::MAX;

/// Its content.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Contents {
    /// The slave's identity.
    pub identity: Identity,
    /// Its mailboxes: out, in; at 0: it names none.
    pub mailboxes: [Area; 2],
    /// Their protocols.
    pub protocols: Protocols,
    /// Its SyncManagers in their order, and the use of each.
    pub managers: [Option<(SyncManager, Use)>; MANAGERS],
}

/// The words before the categories, in this order.
const HEAD: [u16; 6] =
    [word::VENDOR, word::PRODUCT, word::REVISION, word::MAILBOX_OUT, word::MAILBOX_IN, word::PROTOCOLS];

/// What is being read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Item {
    /// So many of the head were read.
    Head(usize),
    Category {
        at: u16,
        nth: u8,
    },
    /// Half of the entry of a SyncManager.
    Manager {
        at: u16,
        nth: u8,
        of: u8,
        first: Option<[u8; 4]>,
    },
    Done,
}

/// The progress of reading.
#[derive(Clone, Copy, Debug)]
pub struct Reader {
    item: Item,
    requested: bool,
    looks: u8,
    askings: u8,
    contents: Contents,
}

/// The result of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// It continues.
    On,
    /// Everything is read.
    Done,
    /// It cannot be read.
    Failed,
}

impl Default for Reader {
    fn default() -> Reader {
        Reader { item: Item::Head(0), requested: false, looks: 0, askings: 0, contents: Contents::default() }
    }
}

impl Reader {
    /// The content read so far.
    pub fn contents(&self) -> &Contents {
        &self.contents
    }

    fn word(&self) -> Option<u16> {
        Some(match self.item {
            Item::Head(nth) => *HEAD.get(nth)?,
            Item::Category { at, .. } => at,
            Item::Manager { at, first, .. } => at.wrapping_add(if first.is_some() { 2 } else { 0 }),
            Item::Done => return None,
        })
    }

    /// Requests the next part, with commands that reach the slave at a register.
    pub fn request(&self, read: impl Fn(u16) -> Command, write: impl Fn(u16) -> Command, ask: &mut Ask) {
        let Some(word) = self.word() else { return };
        if self.requested {
            ask.read(read(address::SII_CONTROL), POLL);
        } else {
            ask.write(write(address::SII_CONTROL), &sii::read(word));
        }
    }

    /// Takes the answer.
    pub fn receive(&mut self, answers: &Answers<'_>) -> Reading {
        // A lost frame: the same is requested again.
        let Some(answer) = answers[0] else { return Reading::On };
        if !self.requested {
            self.requested = true;
            return Reading::On;
        }
        let Some([low, high]) = answer.data.first_chunk::<2>().copied() else { return Reading::On };
        let status = Status(u16::from_le_bytes([low, high]));
        if status.busy() {
            self.looks += 1;
            return if self.looks > LOOKS { self.again() } else { Reading::On };
        }
        if status.error() {
            return self.again();
        }
        let Some(data) = answer.data.get(DATA_AT..).and_then(<[u8]>::first_chunk::<4>) else {
            return Reading::Failed;
        };
        (self.requested, self.looks, self.askings) = (false, 0, 0);
        self.take(*data);
        if self.item == Item::Done { Reading::Done } else { Reading::On }
    }

    fn again(&mut self) -> Reading {
        (self.requested, self.looks) = (false, 0);
        self.askings += 1;
        if self.askings > ASKINGS { Reading::Failed } else { Reading::On }
    }

    fn take(&mut self, data: [u8; 4]) {
        let number = u32::from_le_bytes(data);
        let half = number as u16;
        let area = Area { start: half, length: (number >> 16) as u16 };
        let contents = &mut self.contents;
        self.item = match self.item {
            Item::Head(nth) => {
                let Contents { identity, mailboxes: [out, input], protocols, .. } = contents;
                match nth {
                    0 => identity.vendor = number,
                    1 => identity.product = number,
                    2 => identity.revision = number,
                    3 => *out = area,
                    4 => *input = area,
                    _ => *protocols = Protocols(half),
                }
                match nth + 1 {
                    next if next < HEAD.len() => Item::Head(next),
                    _ => Item::Category { at: word::CATEGORIES, nth: 0 },
                }
            }
            Item::Category { at, nth } => next_category(at, nth, data),
            Item::Manager { at, nth, of, first: None } => Item::Manager { at, nth, of, first: Some(data) },
            Item::Manager { at, nth, of, first: Some([a, b, c, d]) } => {
                let [e, f, g, h] = data;
                if let Some(manager) = contents.managers.get_mut(usize::from(nth)) {
                    *manager = Some(sii::sync_manager([a, b, c, d, e, f, g, h]));
                }
                match nth + 1 {
                    next if next < of => Item::Manager { at: at.wrapping_add(4), nth: next, of, first: None },
                    _ => Item::Done,
                }
            }
            Item::Done => Item::Done,
        };
    }
}

/// The header of a category was read.
fn next_category(at: u16, nth: u8, header: [u8; 4]) -> Item {
    let category = Category::new(header).filter(|_| nth < CATEGORIES && u32::from_le_bytes(header) != 0);
    let Some(Category { kind, words }) = category else { return Item::Done };
    let behind = at.checked_add(2);
    match (kind, behind, behind.and_then(|behind| behind.checked_add(words))) {
        (Category::SYNC_MANAGERS, Some(at), _) if words >= 4 => {
            let of = (words / 4).min(MANAGERS as u16) as u8;
            Item::Manager { at, nth: 0, of, first: None }
        }
        (_, _, Some(next)) => Item::Category { at: next, nth: nth + 1 },
        _ => Item::Done,
    }
}

impl Contents {
    /// The EEPROM was never written.
    pub fn is_blank(&self) -> bool {
        matches!(self.identity.vendor, 0 | BLANK)
    }

    /// The SyncManager of this use, and its number.
    pub fn manager(&self, usage: Use) -> Option<(u16, SyncManager)> {
        let found = |(number, entry): (usize, &Option<(SyncManager, Use)>)| {
            entry.filter(|(_, other)| *other == usage).map(|(manager, _)| (number as u16, manager))
        };
        self.managers.iter().enumerate().find_map(found)
    }
}
