//! The command table: read, written, saved. It lives in RAM until it is saved.

use std::collections::{BTreeMap, BTreeSet};

use super::{Progress, Saved, ServiceError, Services, USUAL, Watcher, after, quiet};
use crate::motion::EntryId;
use crate::table::{Entry, Table};
use crate::upid::call;
use crate::wire::{Refusal, RtcCommand};

/// The remedy when RAM could not be restored.
const REMEDY: &str =
    "restart the drive, it comes up with the table that its flash holds; what was not saved is lost";

/// A table as the drive holds it, valid or not. An entry without bytes exists, but cannot be read: a transfer of it
/// may have ended half-way.
type Image = BTreeMap<EntryId, Vec<u8>>;

/// Entries of one presence list.
const LISTED: u16 = 32;

impl Services<'_> {
    /// The ids of all entries that the drive has.
    pub fn entries(&self) -> Result<Vec<EntryId>, ServiceError> {
        let lists: Vec<_> = (RtcCommand::PRESENCE_0.0..=RtcCommand::PRESENCE_7.0)
            .map(|code| call(RtcCommand(code), 0, 0))
            .collect();
        let answers = self.series(&lists, USUAL)?;
        let mut ids = Vec::new();
        // The command names the list. Word 2 of the answer is an offset, and not always a multiple of 4 (sheet, 5.2).
        for (answer, base) in answers.iter().zip((0_u16..).step_by(usize::from(LISTED))) {
            // A bit that is 0 is an entry that is used.
            let used = (0..LISTED).filter(|bit| answer.value >> bit & 1 == 0);
            ids.extend(used.filter_map(|bit| EntryId::new(base + bit).ok()));
        }
        Ok(ids)
    }

    /// The whole command table.
    pub fn table(&self, watch: Watcher<'_>) -> Result<Table, ServiceError> {
        let mut table = Table::new();
        for (id, bytes) in self.image(watch)? {
            let entry = Entry::decode(&bytes).map_err(|error| {
                let why = format!("{error}; or delete the table, or put another one");
                self.content(format!("command table entry {}", id.wire()), why)
            })?;
            table.insert(id, entry);
        }
        Ok(table)
    }

    /// Writes this table into the drive's RAM, entry by entry where they differ, and reads it back. If it is
    /// cancelled or fails, the previous content is restored the same way. A drive that is running its table
    /// meanwhile executes whatever is there.
    pub fn put_table(&self, table: &Table, watch: Watcher<'_>) -> Result<(), ServiceError> {
        let new: Image = table.iter().map(|(id, entry)| (*id, entry.encode().to_vec())).collect();
        let old = self.image(&mut quiet)?;
        let mut begun = false;
        let report = &mut |progress| {
            let flow = watch(progress);
            begun |= flow.is_continue();
            flow
        };
        let written = self.change(&old, &new, report).and_then(|()| self.verify_table(&new, report));
        written.map_err(|failed| match begun {
            true => after(failed, self.restore(&old), REMEDY),
            // Cancelled before anything was sent.
            false => failed,
        })
    }

    /// Deletes all entries in RAM.
    pub fn delete_table(&self) -> Result<(), ServiceError> {
        self.command(call(RtcCommand::DELETE_TABLE, 0, 0), USUAL).map(drop)
    }

    /// Saves the table to flash, with the software stopped meanwhile. It may take minutes in which the drive is silent;
    /// it has to be homed again then.
    pub fn save_table(&self) -> Result<Saved, ServiceError> {
        self.save(RtcCommand::SAVE_TABLE)
    }

    /// From `old` to `new`.
    fn change(&self, old: &Image, new: &Image, watch: Watcher<'_>) -> Result<(), ServiceError> {
        let all: BTreeSet<EntryId> = old.keys().chain(new.keys()).copied().collect();
        // Deletions make room first.
        let (gone, kept): (Vec<EntryId>, Vec<EntryId>) =
            all.into_iter().filter(|id| old.get(id) != new.get(id)).partition(|id| !new.contains_key(id));
        let of = gone.len() + kept.len();
        for (done, id) in gone.into_iter().chain(kept).enumerate() {
            let writing = || "writing the command table".to_owned();
            self.go_on(watch, Progress { what: "write", done, of }, writing)?;
            if old.contains_key(&id) {
                self.command(call(RtcCommand::DELETE_ENTRY, id.wire(), 0), USUAL)?;
            }
            if let Some(bytes) = new.get(&id) {
                self.write_entry(id, bytes)?;
            }
        }
        let _ = watch(Progress { what: "write", done: of, of });
        Ok(())
    }

    /// Restores `old` with as few steps as the present content allows: an entry may be half written. What could not
    /// be read then cannot be written now.
    fn restore(&self, old: &Image) -> Result<(), ServiceError> {
        let mut old = old.clone();
        old.retain(|_, bytes| !bytes.is_empty());
        let is = match self.image(&mut quiet) {
            Ok(is) => is,
            Err(_) => {
                self.delete_table()?;
                Image::new()
            }
        };
        self.change(&is, &old, &mut quiet)?;
        self.verify_table(&old, &mut quiet)
    }

    fn verify_table(&self, written: &Image, watch: Watcher<'_>) -> Result<(), ServiceError> {
        match self.image(watch)? == *written {
            true => Ok(()),
            false => Err(self.not_as_written("command table".to_owned())),
        }
    }

    fn image(&self, watch: Watcher<'_>) -> Result<Image, ServiceError> {
        let (ids, mut image) = (self.entries()?, Image::new());
        for (done, id) in ids.iter().enumerate() {
            let reading = || "reading the command table".to_owned();
            self.go_on(watch, Progress { what: "read", done, of: ids.len() }, reading)?;
            let bytes = match self.entry_bytes(*id) {
                Err(error) if error.refusal() == Some(Refusal::WrongSize) => Vec::new(),
                bytes => bytes?,
            };
            image.insert(*id, bytes);
        }
        let _ = watch(Progress { what: "read", done: ids.len(), of: ids.len() });
        Ok(image)
    }

    fn write_entry(&self, id: EntryId, bytes: &[u8]) -> Result<(), ServiceError> {
        // As the drive returned it, or as an entry is encoded: both have a size of 16 bits.
        self.command(call(RtcCommand::WRITE_ENTRY, id.wire(), bytes.len() as u32), USUAL)?;
        self.send_block(RtcCommand::WRITE_ENTRY_DATA, id.wire(), bytes, |_| Ok(()))
    }

    fn entry_bytes(&self, id: EntryId) -> Result<Vec<u8>, ServiceError> {
        let answer = self.command(call(RtcCommand::GET_ENTRY, id.wire(), 0), USUAL)?;
        let size = usize::from(answer.value as u16);
        self.take_block(RtcCommand::GET_ENTRY_DATA, id.wire(), size, |_| Ok(()))
    }
}
