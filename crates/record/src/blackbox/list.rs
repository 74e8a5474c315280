//! The black-box files of a directory: which there are, of what, and why they were written.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::Serialize;

use super::file::load_header;
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
    /// Its name in the directory.
    pub file: String,
    /// When it was written, UTC; of a file that cannot be read, when it was changed last.
    pub written: String,
    /// Its size, bytes.
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
        let ours = paths.filter(|path| path.extension().is_some_and(|ending| ending == "blackbox"));
        // One that has been removed meanwhile makes room for a newer one.
        let mut files: Vec<Entry> = ours.filter_map(|path| Entry::of(&path)).collect();
        files.sort_by(|a, b| (&b.written, &b.file).cmp(&(&a.written, &a.file)));
        Ok(Listing { directory: directory.to_owned(), files })
    }
}

impl Entry {
    fn of(path: &Path) -> Option<Entry> {
        let facts = fs::metadata(path).ok()?;
        let changed = facts.modified().unwrap_or(UNIX_EPOCH);
        let entry = Entry {
            file: path.file_name()?.to_string_lossy().into_owned(),
            written: humantime::format_rfc3339_seconds(changed).to_string(),
            bytes: facts.len(),
            machine: None,
            why: None,
            cycle: None,
            error: None,
        };
        Some(match load_header(path) {
            Ok(header) => Entry {
                written: header.written,
                machine: header.machine,
                why: Some(header.why),
                cycle: Some(header.cycle),
                ..entry
            },
            Err(error) => Entry { error: Some(error.why.to_string()), ..entry },
        })
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
    use super::super::file::{Header, encode};
    use super::*;

    #[test]
    fn the_newest_file_comes_first_and_a_damaged_one_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let save = |name: &str, bytes: &[u8]| fs::write(directory.path().join(name), bytes).unwrap();
        for (written, cycle) in [("2001-01-02T03:04:05Z", 7), ("2002-01-03T00:00:00Z", 90)] {
            let header = Header {
                why: "drive x: \x1b[2Jlink lost".into(),
                machine: (cycle == 7).then(|| "m.toml".into()),
                written: written.into(),
                cycle,
                ..Header::default()
            };
            save(&format!("{cycle}.blackbox"), &encode(&header, [].iter()));
        }
        // By its own time, which is of today.
        save("cut.blackbox", &encode(&Header::default(), [].iter())[..50]);
        save("notes.txt", b"mine");
        let listing = Listing::of(directory.path()).unwrap();
        let text = listing.to_string();
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].ends_with(": 3 black-box files"), "{text}");
        let [damaged, newer, older] = lines[2..] else { panic!("{text}") };
        assert!(damaged.contains("cut.blackbox") && damaged.ends_with("cannot be read: its end is missing"));
        assert!(newer.starts_with("2002-01-03T00:00:00Z   1  90.blackbox   -        drive x"), "{text}");
        assert!(older.ends_with("7.blackbox    m.toml   drive x: [2Jlink lost (cycle 7)"), "{text}");
        assert_eq!(Listing::of(&directory.path().join("none")).unwrap().files, []);
    }
}
