//! What a program that was killed has left in memory: the records of its black box, and as much about the machine as a
//! file says.

use std::collections::BTreeMap;
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
use fieldbeat_core::rt::mapping::Left;
use fieldbeat_core::time::nanos;

/// What stands in the memory beside the records.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct About {
    /// Where the black box of the program wrote its files.
    directory: PathBuf,
    process: u32,
    /// Of UTC, so much later than the clock of the records, ns.
    utc_ns: i64,
    machine: Machine,
    /// What each protocol calls its codes.
    faults: BTreeMap<String, BTreeMap<u32, String>>,
}

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

    /// Its bytes.
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

/// The programs may run in other directories.
fn absolute(directory: &Path) -> PathBuf {
    std::path::absolute(directory).unwrap_or_else(|_| directory.to_owned())
}

/// What one program has left. Nobody else finds it meanwhile.
#[derive(Debug)]
pub struct Orphan {
    memory: Left,
    about: About,
    records: Vec<Record>,
    due: Due,
    /// When its last cycle was.
    ended: SystemTime,
}

impl Orphan {
    /// That of each program whose black box wrote to `directory`, and that has ended without an orderly end.
    pub fn all(directory: &Path) -> Vec<Orphan> {
        let directory = absolute(directory);
        Left::all().filter_map(Orphan::of).filter(|orphan| orphan.about.directory == directory).collect()
    }

    fn of(memory: Left) -> Option<Orphan> {
        let Remains { about, records } = Remains::read(&*memory.file).ok()??;
        let about: About = serde_json::from_slice(&about).ok()?;
        let last = records.iter().rev().find_map(|record| match record {
            Record::Cycle(cycle) => Some((cycle.index, cycle.grid.0.saturating_add_signed(about.utc_ns))),
            _ => None,
        });
        let Some((cycle, ended_ns)) = last else {
            // Without a cycle there is nothing to tell. That it is gone already is as good.
            let _ = memory.remove();
            return None;
        };
        let why = format!("process {} was killed, or crashed", about.process);
        let due = Due { why, cycle, from: cycle, failed: true };
        Some(Orphan { memory, about, records, due, ended: UNIX_EPOCH + Duration::from_nanos(ended_ns) })
    }

    /// Why and when it was left.
    pub fn due(&self) -> &Due {
        &self.due
    }

    /// The file that is to be made of it.
    pub fn path(&self) -> PathBuf {
        super::place(&self.about.directory, self.ended, &self.due).0
    }

    /// Makes that file, and gives the memory back.
    pub fn save(self) -> io::Result<()> {
        let Orphan { memory, about, records, due, ended } = self;
        let (path, written) = super::place(&about.directory, ended, &due);
        let utc_ns = about.utc_ns;
        let mut machine = due.described(about.into_machine());
        machine.about.insert(WRITTEN.to_owned(), written);
        let file = encode(machine, utc_ns, records.iter(), std::iter::empty(), 0)?;
        save(&path, &file.bytes)?;
        memory.remove()
    }
}
