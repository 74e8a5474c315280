//! The content of a slave's SII (ETG.2010), for people.

use thiserror::Error;

use super::exchange;
use super::{ScanError, Visit, byte};
use crate::plan::Area;
use crate::sii::{Content, Reader, Reading};
use crate::slot::{self, Ask};
use crate::wire::frame::{Command, position};
use crate::wire::registers::{SyncManager, address};
use crate::wire::sii::{self, Category, Fault, Identity, Protocols, Status, Use};
use fieldbeat_core::axis::acyclic::long;
use fieldbeat_core::time::MS;

/// The longest time of a command; 20 ms is usual, and this thread is a normal one.
const WITHIN_NS: u64 = 500 * MS;
/// The most words of a category that are read.
const WORDS_MAX: u16 = 1024;
/// The offset of the name's text number in the general category, and the words up to it.
const NAME_AT: usize = 3;
const NAME_WORDS: u16 = 2;

/// The content of a slave's SII.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Information {
    /// The checksum is right, and the slave has loaded it.
    pub sound: bool,
    /// The slave's identity.
    pub identity: Identity,
    /// The serial number.
    pub serial: u32,
    /// The name of its type; empty: none. What cannot be printed is replaced.
    pub name: String,
    /// The mailbox that the master writes, and the one that it reads.
    pub mailbox: Option<[Area; 2]>,
    /// The mailbox protocols.
    pub protocols: Protocols,
    /// The SyncManagers as delivered.
    pub managers: Vec<(SyncManager, Use)>,
}

/// Why the SII was not read.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum Unread {
    /// A master works with the slave.
    #[error("not read in this state")]
    InUse,
    /// The slave's processor owns it.
    #[error("owned by the slave's processor")]
    Owned,
    /// A command does not end.
    #[error("busy")]
    Busy,
    /// A command failed.
    #[error("it refuses to be read")]
    Refused,
}
fieldbeat_core::debug_as_display!(Unread);

impl Information {
    /// Bytes of process data as delivered: outputs, inputs.
    pub fn process_data(&self) -> (usize, usize) {
        let bytes = |wanted: Use| {
            let managers = self.managers.iter().filter(|(_, usage)| *usage == wanted);
            managers.map(|(manager, _)| usize::from(manager.length)).sum()
        };
        (bytes(Use::Outputs), bytes(Use::Inputs))
    }
}

impl Visit<'_, '_> {
    /// Reads the SII. One that the slave's processor owns is taken, and given back.
    pub(super) fn information(&mut self, owned: bool) -> Result<Result<Information, Unread>, ScanError> {
        if owned {
            self.own(&[sii::FORCE])?;
            self.own(&[sii::MASTER])?;
        }
        let read = self.all();
        if owned {
            self.own(&[sii::PROCESSOR])?;
        }
        read
    }

    fn own(&mut self, owner: &[u8]) -> Result<(), ScanError> {
        let requests = [exchange::Ask::write(Command::Apwr(position(self.place), address::SII_OWNER), owner)];
        self.exchange.ask(&requests)?.ok_or_else(|| self.lost()).map(drop)
    }

    fn all(&mut self) -> Result<Result<Information, Unread>, ScanError> {
        let place = position(self.place);
        // The time limits the looks.
        let mut reader = Reader::new(Categories { sound: true, ..Categories::default() }, u16::MAX);
        let mut until = self.exchange.now() + WITHIN_NS;
        loop {
            let mut ask = Ask::default();
            let (read, write) =
                (|register| Command::Aprd(place, register), |register| Command::Apwr(place, register));
            reader.request(read, write, &mut ask);
            let requests: Vec<_> =
                ask.datagrams().map(|(command, data)| exchange::Ask::write(command, data)).collect();
            let answers = self.exchange.ask(&requests)?.ok_or_else(|| self.lost())?;
            let answer = answers
                .first()
                .map(|answer| slot::Answer { working_counter: answer.count, data: &answer.data });
            match reader.receive(&[answer, None]) {
                Reading::On => until = self.exchange.now() + WITHIN_NS,
                Reading::Busy if self.exchange.now() < until => {}
                Reading::Busy | Reading::Failed(Fault::Busy) => return Ok(Err(Unread::Busy)),
                Reading::Failed(Fault::Owned) => return Ok(Err(Unread::Owned)),
                Reading::Failed(_) => return Ok(Err(Unread::Refused)),
                Reading::Done => break,
            }
        }
        let (head, Categories { sound, texts, general, managers }) = (reader.head, reader.content);
        let is_there = head.mailboxes.iter().all(|area| !matches!(area.length, 0 | 0xFFFF));
        Ok(Ok(Information {
            sound,
            identity: head.identity,
            serial: head.serial,
            name: printable(text(&texts, byte(&general, NAME_AT)).unwrap_or_default()),
            mailbox: is_there.then_some(head.mailboxes),
            protocols: if is_there { head.protocols } else { Protocols::default() },
            managers: managers.as_chunks().0.iter().map(|entry| sii::sync_manager(*entry)).collect(),
        }))
    }
}

/// The categories that are shown.
#[derive(Debug, Default)]
struct Categories {
    sound: bool,
    texts: Vec<u8>,
    general: Vec<u8>,
    managers: Vec<u8>,
}

impl Content for Categories {
    fn accepts(&mut self, status: Status) -> bool {
        self.sound &= !status.unsound();
        !status.failed()
    }

    fn wants(&self, kind: u16) -> u16 {
        match kind {
            Category::STRINGS | Category::SYNC_MANAGERS => WORDS_MAX,
            Category::GENERAL => NAME_WORDS,
            _ => 0,
        }
    }

    fn take(&mut self, kind: u16, at: usize, data: &[u8]) {
        let bytes = match kind {
            Category::STRINGS => &mut self.texts,
            Category::GENERAL => &mut self.general,
            _ => &mut self.managers,
        };
        // Of two categories of one kind the last one counts.
        bytes.truncate(at);
        bytes.extend_from_slice(data);
    }
}

/// Text `number` of the category, counted from 1.
fn text(category: &[u8], number: u8) -> Option<&[u8]> {
    let (_, mut rest) = category.split_first()?;
    for _ in 1..number {
        let (length, behind) = rest.split_first()?;
        rest = behind.get(usize::from(*length)..)?;
    }
    let (length, behind) = rest.split_first().filter(|_| number > 0)?;
    Some(behind.get(..usize::from(*length)).unwrap_or(behind))
}

/// Characters that a terminal may show.
fn printable(text: &[u8]) -> String {
    let shown = long::characters(text).into_iter().map(|c| if c.is_control() { '?' } else { c });
    shown.collect::<String>().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_counted_from_one_and_never_reach_beyond() {
        let texts = [2, 3, b'a', b'b', b'c', 2, b'd', 0x1B, 0, 9];
        assert_eq!(text(&texts, 1), Some(&b"abc"[..]));
        assert_eq!(printable(text(&texts, 2).unwrap()), "d?");
        assert_eq!(printable(b"EL1252 1\xB5s \x9B\0"), "EL1252 1\u{B5}s ??", "as a real terminal has it");
        assert_eq!(printable("1\u{B5}s".as_bytes()), "1\u{B5}s");
        assert_eq!(text(&texts, 3), Some(&[][..]));
        assert_eq!(text(&texts, 4), Some(&[][..]), "it says 9, and there are none");
        assert_eq!((text(&texts, 5), text(&texts, 0), text(&[], 1)), (None, None, None));
    }
}
