//! The content of a slave's SII (ETG.2010), read word by word.

use thiserror::Error;

use super::exchange::Ask;
use super::{ScanError, Visit, byte, word};
use crate::bus::ethercat::plan::Area;
use crate::bus::ethercat::wire::registers::{SyncManager, address};
use crate::bus::ethercat::wire::sii::{self, Category, Identity, Protocols, Status, Use};
use crate::time::MS;

/// The longest time of a command; 20 ms is usual, and this thread is a normal one.
const WITHIN_NS: u64 = 100 * MS;
/// A command that failed is repeated once.
const ATTEMPTS: usize = 2;
/// More categories than any slave has: where the end is missing.
const CATEGORIES_MAX: usize = 64;
/// The most words of a category that are read.
const WORDS_MAX: u16 = 1024;
/// In the status: the slave has not loaded it, or its checksum is wrong.
const UNSOUND: u16 = 1 << 11 | 1 << 12;
/// In the status: the command failed.
const FAILED: u16 = 1 << 13 | 1 << 14;
/// From the control register to the end of the data.
const REGISTERS: usize = 14;
const DATA_AT: usize = (address::SII_DATA - address::SII_CONTROL) as usize;
/// The offset of the name's text number in the general category.
const NAME_AT: usize = 3;

/// The content of a slave's SII.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Information {
    /// Its checksum is right, and the slave has loaded it.
    pub sound: bool,
    /// The slave's identity.
    pub identity: Identity,
    /// Its serial number.
    pub serial: u32,
    /// The name of its type; empty: none. What cannot be printed is replaced.
    pub name: String,
    /// The mailbox that the master writes, and the one that it reads.
    pub mailbox: Option<[Area; 2]>,
    /// The mailbox protocols.
    pub protocols: Protocols,
    /// Its SyncManagers as delivered.
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
crate::errors::debug_as_display!(Unread);

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

/// Why the reading has ended.
#[derive(Error)]
enum End {
    #[error(transparent)]
    Scan(#[from] ScanError),
    #[error(transparent)]
    Sii(#[from] Unread),
}
crate::errors::debug_as_display!(End);

impl Visit<'_, '_> {
    /// Reads the SII. One that the slave's processor owns is taken, and given back.
    pub(super) fn information(&mut self, owned: bool) -> Result<Result<Information, Unread>, ScanError> {
        if owned {
            self.own(&[sii::FORCE])?;
            self.own(&[sii::MASTER])?;
        }
        let read = self.all();
        if owned {
            self.own(&[1])?;
        }
        match read {
            Ok(information) => Ok(Ok(information)),
            Err(End::Sii(why)) => Ok(Err(why)),
            Err(End::Scan(error)) => Err(error),
        }
    }

    fn own(&mut self, owner: &[u8]) -> Result<(), ScanError> {
        self.write(address::SII_OWNER, owner).map(drop)
    }

    /// Whether the slave accepted it.
    fn write(&mut self, register: u16, data: &[u8]) -> Result<bool, ScanError> {
        let asks = [Ask::write_to(self.place, register, data)];
        let answers = self.exchange.ask(&asks)?.ok_or_else(|| self.lost())?;
        Ok(answers.iter().all(|answer| answer.count > 0))
    }

    fn all(&mut self) -> Result<Information, End> {
        let mut information = Information { sound: true, ..Information::default() };
        let numbers = self.words(&mut information, sii::word::VENDOR, 8)?;
        let number = |n: usize| u32::from(word(&numbers, 4 * n)) | u32::from(word(&numbers, 4 * n + 2)) << 16;
        information.identity = Identity { vendor: number(0), product: number(1), revision: number(2) };
        information.serial = number(3);
        let boxes = self.words(&mut information, sii::word::MAILBOX_OUT, 5)?;
        let areas = [0, 4].map(|at| Area { start: word(&boxes, at), length: word(&boxes, at + 2) });
        let is_there = areas.iter().all(|area| !matches!(area.length, 0 | 0xFFFF));
        information.mailbox = is_there.then_some(areas);
        information.protocols = Protocols(if is_there { word(&boxes, 8) } else { 0 });
        self.categories(&mut information)?;
        Ok(information)
    }

    fn categories(&mut self, information: &mut Information) -> Result<(), End> {
        let (mut texts, mut name) = (Vec::new(), 0);
        let mut at = Some(sii::word::CATEGORIES);
        for _ in 0..CATEGORIES_MAX {
            let Some(here) = at else { break };
            let head = self.words(information, here, 2)?;
            let Some(category) = head.first_chunk().and_then(|head| Category::new(*head)) else { break };
            let (Some(begin), words) = (here.checked_add(2), category.words.min(WORDS_MAX)) else { break };
            match category.kind {
                Category::STRINGS => texts = self.words(information, begin, words)?,
                Category::GENERAL => name = byte(&self.words(information, begin, words.min(2))?, NAME_AT),
                Category::SYNC_MANAGERS => {
                    let entries = self.words(information, begin, words)?;
                    information.managers =
                        entries.as_chunks().0.iter().map(|entry| sii::sync_manager(*entry)).collect();
                }
                _ => {}
            }
            at = begin.checked_add(category.words);
        }
        information.name = printable(text(&texts, name).unwrap_or_default());
        Ok(())
    }

    /// So many words from `at` on.
    fn words(&mut self, information: &mut Information, at: u16, count: u16) -> Result<Vec<u8>, End> {
        let wanted = 2 * usize::from(count);
        let mut bytes = Vec::with_capacity(wanted);
        while bytes.len() < wanted {
            let Some(next) = at.checked_add((bytes.len() / 2) as u16) else { break };
            let (status, data) = self.piece(next)?;
            information.sound &= status.0 & UNSOUND == 0;
            let size = if status.reads_eight() { 8 } else { 4 };
            bytes.extend_from_slice(&data[..size.min(wanted - bytes.len())]);
        }
        Ok(bytes)
    }

    /// Two or four words from `at` on.
    fn piece(&mut self, at: u16) -> Result<(Status, [u8; 8]), End> {
        for _ in 0..ATTEMPTS {
            self.rest()?;
            if !self.write(address::SII_CONTROL, &sii::read(at))? {
                continue;
            }
            let (status, data) = self.rest()?;
            if status.0 & FAILED == 0 {
                return Ok((status, data));
            }
            self.write(address::SII_CONTROL, &Status::IDLE.to_le_bytes())?;
        }
        Err(Unread::Refused.into())
    }

    /// Waits until no command is under way.
    fn rest(&mut self) -> Result<(Status, [u8; 8]), End> {
        let until = self.exchange.now() + WITHIN_NS;
        loop {
            let [registers] = self.read([(address::SII_CONTROL, REGISTERS)])?;
            let status = Status(word(&registers, 0));
            if !status.busy() {
                let data = registers.get(DATA_AT..).and_then(<[u8]>::first_chunk);
                return Ok((status, data.copied().unwrap_or_default()));
            }
            if self.exchange.now() >= until {
                return Err(Unread::Busy.into());
            }
        }
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
    let shown = |byte: &u8| if byte.is_ascii_graphic() || *byte == b' ' { char::from(*byte) } else { '?' };
    text.iter().map(shown).collect::<String>().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_counted_from_one_and_never_reach_beyond() {
        let texts = [2, 3, b'a', b'b', b'c', 2, b'd', 0x1B, 0, 9];
        assert_eq!(text(&texts, 1), Some(&b"abc"[..]));
        assert_eq!(printable(text(&texts, 2).unwrap()), "d?");
        assert_eq!(text(&texts, 3), Some(&[][..]));
        assert_eq!(text(&texts, 4), Some(&[][..]), "it says 9, and there are none");
        assert_eq!((text(&texts, 5), text(&texts, 0), text(&[], 1)), (None, None, None));
    }
}
