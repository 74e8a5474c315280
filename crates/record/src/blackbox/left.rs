//! What a program that was killed has left in memory: the records of its black box, and as much about the machine as a
//! file says.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use crate::file::save;
use crate::recording::machine::{Faults, Machine, WRITTEN};
use crate::recording::newest::{Due, encode};
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::cycle::ring::Remains;
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_core::rt::mapping::{Found, Left};
use fieldbeat_core::time::nanos;

/// The contents of the memory besides the records.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct About {
    /// Where the black box of the program wrote its files.
    directory: PathBuf,
    process: u32,
    /// Of UTC, so much later than the clock of the records, ns.
    utc_ns: i64,
    machine: Machine,
    /// The names that each protocol gives its codes.
    faults: BTreeMap<String, BTreeMap<u32, String>>,
}

/// A program that is killed again and again does not fill the disk: so many of its files stay.
const MOST_FILES: usize = 16;

/// The part of their names before the process.
pub const PROCESS: &str = "-process-";

/// Codes that may have a name.
const CODES: std::ops::RangeInclusive<u32> = 1..=0xFFFF;

impl About {
    /// Of the black box of a machine with files in `directory`.
    pub fn new(directory: &Path, machine: &Machine) -> About {
        let mut faults = BTreeMap::new();
        for axis in &machine.axes {
            let (Some(protocol), Faults::Known(names)) = (axis.protocol(), &axis.faults) else { continue };
            faults
                .entry(protocol.to_owned())
                .or_insert_with(|| CODES.filter_map(|code| Some((code, names(code)?.to_owned()))).collect());
        }
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, nanos) as i64;
        About {
            directory: absolute(directory),
            process: std::process::id(),
            utc_ns: now.wrapping_sub(MonotonicClock::read().0 as i64),
            machine: machine.clone(),
            faults,
        }
    }

    /// The bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        // Strings and numbers can always be written.
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// The machine, with the names of its faults.
    fn into_machine(self) -> Machine {
        let mut machine = self.machine;
        for axis in &mut machine.axes {
            let names = axis.protocol().and_then(|protocol| self.faults.get(protocol));
            axis.faults = Faults::Listed(names.cloned().unwrap_or_default());
        }
        machine
    }
}

/// The programs may run in other directories, or name it by a link. It need not be there yet.
fn absolute(directory: &Path) -> PathBuf {
    let directory = std::path::absolute(directory).unwrap_or_else(|_| directory.to_owned());
    let known = |ancestor: &Path| {
        let rest = directory.strip_prefix(ancestor).ok()?;
        Some(ancestor.canonicalize().ok()?.join(rest))
    };
    directory.ancestors().find_map(known).unwrap_or_else(|| directory.clone())
}

/// The memory that one program has left. It is its holder's: nobody else finds it.
#[derive(Debug)]
pub struct Orphan {
    memory: Left,
    about: About,
    due: Due,
    /// When its last cycle was.
    ended: SystemTime,
}

/// Memory of which no file is made here.
#[derive(Debug)]
pub struct Other {
    /// The name.
    pub path: PathBuf,
    /// Where the black box of its program wrote its files; `None`: it is of another version.
    pub directory: Option<PathBuf>,
}

impl Orphan {
    /// That of each program whose black box wrote to `directory`, and that has ended without an orderly end.
    pub fn all(directory: &Path) -> Vec<Orphan> {
        let directory = absolute(directory);
        let is_of_it =
            |found: &Found| about(&found.file).is_some_and(|(about, _)| about.directory == directory);
        Found::all().filter(is_of_it).filter_map(Found::claim).filter_map(Orphan::of).collect()
    }

    /// The processes that have died, and whose guardians still have the memory: they stop their drives.
    pub fn guarded(directory: &Path) -> Vec<u32> {
        let directory = absolute(directory);
        let of = |found: Found| {
            let (about, _) = about(&found.file).filter(|(about, _)| about.directory == directory)?;
            let has_died = !Path::new("/proc").join(about.process.to_string()).exists();
            (has_died && found.claim().is_none()).then_some(about.process)
        };
        Found::all().filter_map(of).collect()
    }

    /// That of all others.
    pub fn others(directory: &Path) -> Vec<Other> {
        let directory = absolute(directory);
        let all = Found::all().map(|found| {
            let of = about(&found.file).map(|(about, _)| about.directory);
            (Other { path: found.path.clone(), directory: of }, found)
        });
        let others = all.filter(|(other, _)| other.directory.as_ref() != Some(&directory));
        // Taken over for a moment: that of a program that lives is its own.
        others.filter_map(|(other, found)| found.claim().map(|_| other)).collect()
    }

    fn of(memory: Left) -> Option<Orphan> {
        let (about, mut remains) = about(memory.file())?;
        let last = remains.newest().find_map(|record| match record {
            Record::Cycle(cycle) => Some((cycle.index, cycle.grid.0.saturating_add_signed(about.utc_ns))),
            _ => None,
        });
        let Some((cycle, ended_ns)) = last else {
            // Without a cycle there is nothing to tell.
            let _ = memory.remove();
            return None;
        };
        let mut why = format!("process {} was killed, or crashed", about.process);
        if !remains.said.is_empty() {
            why = why + "; " + &remains.said;
        }
        let due = Due { why, cycle, from: cycle, failed: true };
        Some(Orphan { memory, about, due, ended: UNIX_EPOCH + Duration::from_nanos(ended_ns) })
    }

    /// Why and when it was left.
    pub fn due(&self) -> &Due {
        &self.due
    }

    /// The file that is to be made of it.
    pub fn path(&self) -> PathBuf {
        self.place().0
    }

    /// Two programs of the same directory may have ended in the same second.
    fn place(&self) -> (PathBuf, String) {
        super::place(&self.about.directory, self.ended, &self.due, Some(self.about.process))
    }

    /// Makes that file, and gives the memory back.
    pub fn save(self) -> io::Result<()> {
        let (path, written) = self.place();
        let Orphan { memory, about, due, .. } = self;
        let Some((_, mut remains)) = self::about(memory.file()) else { return memory.remove() };
        let mut records: Vec<Record> = remains.newest().collect();
        records.reverse();
        let records = super::written_of(records, remains.is_cut());
        let (utc_ns, directory) = (about.utc_ns, about.directory.clone());
        let mut machine = due.described(about.into_machine());
        machine.about.insert(WRITTEN.to_owned(), written);
        let file = encode(machine, utc_ns, records.iter(), std::iter::empty(), None, 0)?;
        save(&path, &file.bytes)?;
        remove_oldest(&directory);
        memory.remove()
    }
}

/// Of the files of programs that were killed, the newest stay.
fn remove_oldest(directory: &Path) {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let is_one =
        |name: &String| name.starts_with("fieldbeat-") && name.contains(PROCESS) && name.ends_with(".mcap");
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok()).filter(is_one);
    // Their names begin with their times.
    let mut names: Vec<String> = names.collect();
    names.sort();
    for name in &names[..names.len().saturating_sub(MOST_FILES)] {
        // What somebody else has removed is gone all the same.
        let _ = std::fs::remove_file(directory.join(name));
    }
}

/// The description of a memory's records, and the records.
fn about(memory: &File) -> Option<(About, Remains<&File>)> {
    let remains = Remains::of(memory).ok()??;
    Some((serde_json::from_slice(&remains.about).ok()?, remains))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_files_of_killed_programs_stay_and_all_others() {
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str| std::fs::write(directory.path().join(name), b"x").unwrap();
        for second in 0..30 {
            file(&format!("fieldbeat-20261201T0515{second:02}Z{PROCESS}{}-cycle-7.mcap", 900 - second));
        }
        file("fieldbeat-20250101T000000Z-cycle-7.mcap");
        file("a-process-b.mcap");
        remove_oldest(directory.path());
        let names = std::fs::read_dir(directory.path()).unwrap();
        let mut names: Vec<String> =
            names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        assert_eq!(names.len(), MOST_FILES + 2);
        assert_eq!(names[..2], ["a-process-b.mcap", "fieldbeat-20250101T000000Z-cycle-7.mcap"]);
        assert!(names[2].starts_with("fieldbeat-20261201T051514Z"), "{names:?}");
    }
}
