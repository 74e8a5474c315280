//! The black-box files of a directory: which there are, of what, and why they were written.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::file::{changed, load_header};
use crate::summary::plural;
use crate::table::{Cell, Table};

/// The files of a directory, the newest first.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Listing {
    /// The directory.
    pub directory: PathBuf,
    /// The files.
    pub files: Vec<Entry>,
}

/// A file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Entry {
    /// The name in the directory.
    pub file: String,
    /// When it was written, UTC; of a file that cannot be read, when it was changed last.
    pub written: String,
    /// The size, bytes.
    pub bytes: u64,
    /// The configuration of its machine; null: a machine built in code, or the file cannot be read.
    pub machine: Option<String>,
    /// Why it was written.
    pub why: Option<String>,
    /// The cycle in which that happened.
    pub cycle: Option<u64>,
    /// Why the file cannot be read.
    pub error: Option<String>,
}

impl Listing {
    /// The files of `directory`, by their headers alone. A directory that does not exist has none.
    pub fn of(directory: &Path) -> io::Result<Listing> {
        let entries = match fs::read_dir(directory) {
            Ok(entries) => entries.collect::<Result<Vec<_>, _>>()?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(error),
        };
        let paths = entries.into_iter().map(|entry| entry.path());
        let ours = paths.filter(|path| path.extension().is_some_and(|ending| ending == "mcap"));
        // One that has been removed meanwhile makes room for a newer one; a recording of a run is no black box.
        let mut files: Vec<Entry> = ours.filter_map(|path| Entry::of(&path)).collect();
        files.sort_by(|a, b| (&b.written, &b.file).cmp(&(&a.written, &a.file)));
        Ok(Listing { directory: directory.to_owned(), files })
    }
}

impl Entry {
    fn of(path: &Path) -> Option<Entry> {
        let facts = fs::metadata(path).ok()?;
        let entry = Entry {
            file: path.file_name()?.to_string_lossy().into_owned(),
            written: changed(&facts),
            bytes: facts.len(),
            machine: None,
            why: None,
            cycle: None,
            error: None,
        };
        match load_header(path) {
            Ok(header) if header.why.is_empty() => None,
            Ok(header) => Some(Entry {
                written: header.written,
                machine: header.machine,
                why: Some(header.why),
                cycle: Some(header.cycle),
                ..entry
            }),
            Err(error) => Some(Entry { error: Some(error.to_string()), ..entry }),
        }
    }
}

/// A table of them.
impl fmt::Display for Listing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let files = plural(self.files.len() as u64, "black-box file");
        write!(f, "{}: {files}", self.directory.display())?;
        if self.files.is_empty() {
            return f.write_str("; --black-box DIR names another directory");
        }
        let mut table = Table::new(&["written", "kB", "file", "machine", "reason"], 1..2, "  ");
        for Entry { file, written, bytes, machine, why, cycle, error } in &self.files {
            let machine = machine.as_deref().unwrap_or("-");
            let reason = match (why, cycle, error) {
                (Some(why), Some(cycle), _) => format!("{why} (cycle {cycle})"),
                (.., error) => format!("cannot be read: {}", error.as_deref().unwrap_or("?")),
            };
            // Anybody may have written the file: its texts must not control a terminal.
            let cell = |text: &str| Cell::plain(text.replace(|c: char| c.is_control(), ""));
            let size = Cell::plain(bytes.div_ceil(1000));
            let reason = Cell::new(reason.replace(|c: char| c.is_control(), ""), error.is_some());
            table.row(vec![cell(written), size, cell(file), cell(machine), reason]);
        }
        table.lines(f.alternate()).iter().try_for_each(|line| write!(f, "\n{line}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::machine::{CYCLE, Machine, WHY, WRITTEN, of_cycle};
    use crate::recording::newest::encode;

    /// The file of a machine of which more is said.
    fn file(more: &[(&str, &str)]) -> Vec<u8> {
        let mut machine = Machine { about: of_cycle("9", 1, 1, 1), ..Machine::default() };
        machine.about.extend(more.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())));
        encode(machine, 0, std::iter::empty(), std::iter::empty(), None, 0).unwrap().bytes
    }

    #[test]
    fn the_newest_file_comes_first_and_a_damaged_one_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let save = |name: &str, bytes: &[u8]| fs::write(directory.path().join(name), bytes).unwrap();
        let why = (WHY, "drive x: \x1b[2Jlink lost");
        let older = file(&[why, (CYCLE, "7"), (WRITTEN, "2001-01-02T03:04:05Z"), ("machine", "m.toml")]);
        save("7.mcap", &older);
        save("90.mcap", &file(&[why, (CYCLE, "90"), (WRITTEN, "2002-01-03T00:00:00Z")]));
        // By its own time, which is of today.
        save("cut.mcap", &older[..older.len() - 1]);
        // Neither of them is a black box.
        save("run.mcap", &file(&[]));
        save("notes.txt", b"mine");
        let listing = Listing::of(directory.path()).unwrap();
        let text = listing.to_string();
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].ends_with(": 3 black-box files"), "{text}");
        let [damaged, newer, older] = lines[2..] else { panic!("{text}") };
        let cut = "cannot be read: its end is missing, as of a program that was killed";
        assert!(damaged.contains("cut.mcap") && damaged.ends_with(cut), "{text}");
        assert!(newer.starts_with("2002-01-03T00:00:00Z   4  90.mcap   -        drive x"), "{text}");
        assert!(older.ends_with("7.mcap    m.toml   drive x: [2Jlink lost (cycle 7)"), "{text}");
        assert_eq!(Listing::of(&directory.path().join("none")).unwrap().files, []);
    }
}
