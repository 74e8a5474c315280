//! A recording as tables of comma-separated values: one of each topic, or one of all axes side by side.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use csv::Writer;

use super::reading::{Entry, Topic};

/// The columns of an axis in the table of all axes.
const SHOWN: [&str; 7] =
    ["position", "demand", "following_error", "velocity", "current", "state_name", "fault"];

/// The topics of axes, and those of their monitored variables.
const AXES: &str = "/axes/";

/// A table of each topic, in a directory.
#[derive(Debug)]
pub struct PerTopic<'a> {
    directory: &'a Path,
    tables: HashMap<String, Writer<BufWriter<File>>>,
    /// The files of the tables.
    made: Vec<PathBuf>,
    begin_ns: Option<u64>,
}

impl<'a> PerTopic<'a> {
    /// Tables in `directory`, which is made if it is missing.
    pub fn new(directory: &'a Path) -> io::Result<PerTopic<'a>> {
        std::fs::create_dir_all(directory)?;
        Ok(PerTopic { directory, tables: HashMap::new(), made: Vec::new(), begin_ns: None })
    }

    /// Takes a message in.
    pub fn enter(&mut self, entry: &Entry) -> io::Result<()> {
        let begin_ns = *self.begin_ns.get_or_insert(entry.utc_ns);
        let table = match self.tables.get_mut(&entry.topic.name) {
            Some(table) => table,
            None => {
                let mut path = self.directory.join(file_name(&entry.topic.name));
                // Two topics never share a file: `/axes/x/native` and that of an axis `x_native`.
                while self.made.contains(&path) {
                    path.set_extension("2.csv");
                }
                let file = File::create_new(&path).map_err(|why| named(&path, &why))?;
                self.made.push(path);
                let mut table = Writer::from_writer(BufWriter::new(file));
                let fields = entry.topic.fields().map(|field| heading(&entry.topic, "", &field));
                table.write_record(std::iter::once("time [s]".to_owned()).chain(fields)).map_err(below)?;
                self.tables.entry(entry.topic.name.clone()).or_insert(table)
            }
        };
        table
            .write_record(std::iter::once(seconds(begin_ns, entry.utc_ns)).chain(entry.texts()))
            .map_err(below)
    }

    /// Ends all tables. Returns how many there are.
    pub fn finish(&mut self) -> io::Result<usize> {
        self.tables.values_mut().try_for_each(Writer::flush)?;
        Ok(self.tables.len())
    }

    /// Removes the tables again, so that they are not in the way of the next ones.
    pub fn withdraw(self) {
        drop(self.tables);
        for path in self.made {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The name of a topic's table.
fn file_name(topic: &str) -> String {
    let letter = |letter: char| if letter.is_alphanumeric() || "-._".contains(letter) { letter } else { '_' };
    let name: String = topic.trim_matches('/').chars().map(letter).collect();
    format!("{}.csv", name.trim_start_matches('.'))
}

/// The error below that of the table: its kind says whether the disk is full, or the reader gone.
fn below(error: csv::Error) -> io::Error {
    match error.into_kind() {
        csv::ErrorKind::Io(error) => error,
        other => io::Error::other(format!("{other:?}")),
    }
}

fn named(path: &Path, why: &io::Error) -> io::Error {
    io::Error::new(why.kind(), format!("{}: {why}", path.display()))
}

/// One table: a row a cycle, the values of all axes side by side. The axes are those of the first cycle.
pub struct Wide<W: Write> {
    table: Writer<W>,
    /// The column of each axis.
    axes: BTreeMap<String, usize>,
    headings: Vec<String>,
    /// The row of the cycle that is under way.
    row: Option<(u64, String, Vec<String>)>,
    begin_ns: Option<u64>,
    begun: bool,
}

impl<W: Write> std::fmt::Debug for Wide<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Wide").field("axes", &self.axes).finish_non_exhaustive()
    }
}

impl<W: Write> Wide<W> {
    /// A table to `out`.
    pub fn new(out: W) -> Wide<W> {
        let table = Writer::from_writer(out);
        let headings = vec!["time [s]".to_owned(), "cycle".to_owned()];
        Wide { table, axes: BTreeMap::new(), headings, row: None, begin_ns: None, begun: false }
    }

    /// Takes a message in; only those of axes show.
    pub fn enter(&mut self, entry: &Entry) -> io::Result<()> {
        let Some(axis) = entry.topic.name.strip_prefix(AXES).filter(|name| !name.contains('/')) else {
            return Ok(());
        };
        let begin_ns = *self.begin_ns.get_or_insert(entry.utc_ns);
        let cycle = entry.number("cycle");
        if self.row.as_ref().is_some_and(|(of, ..)| *of != cycle) {
            self.end_row()?;
        }
        if !self.begun && !self.axes.contains_key(axis) {
            self.axes.insert(axis.to_owned(), self.headings.len());
            let headings = SHOWN.map(|field| heading(&entry.topic, &format!("{axis}."), field));
            self.headings.extend(headings);
        }
        let Some(place) = self.axes.get(axis) else { return Ok(()) };
        let time = seconds(begin_ns, entry.utc_ns);
        let (.., row) = self.row.get_or_insert_with(|| (cycle, time, Vec::new()));
        row.resize(self.headings.len() - 2, String::new());
        for (cell, field) in row[place - 2..].iter_mut().zip(SHOWN) {
            *cell = entry.text(field);
        }
        Ok(())
    }

    fn end_row(&mut self) -> io::Result<()> {
        let Some((cycle, time, mut row)) = self.row.take() else { return Ok(()) };
        if !std::mem::replace(&mut self.begun, true) {
            self.table.write_record(&self.headings).map_err(below)?;
        }
        row.resize(self.headings.len() - 2, String::new());
        self.table.write_record([time, cycle.to_string()].into_iter().chain(row)).map_err(below)
    }

    /// Ends the table.
    pub fn finish(mut self) -> io::Result<()> {
        self.end_row()?;
        self.table.flush()
    }
}

/// Since the begin of the recording.
fn seconds(begin_ns: u64, utc_ns: u64) -> String {
    format!("{:.9}", (utc_ns as i64).wrapping_sub(begin_ns as i64) as f64 * 1e-9)
}

/// The name of a field, with its unit.
fn heading(topic: &Topic, before: &str, field: &str) -> String {
    let about = |key: &str| topic.about.get(key).map(String::as_str).filter(|unit| !unit.is_empty());
    let unit = match field {
        "position" | "demand" | "following_error" => about("unit"),
        "velocity" => about("unit_velocity"),
        "current" => about("unit_current"),
        // That of a monitored variable stands under its own name.
        _ if topic.name.ends_with("/monitors") => {
            topic.monitored(field).map(|(_, unit)| unit.as_str()).filter(|unit| !unit.is_empty())
        }
        _ => None,
    };
    unit.map_or_else(|| format!("{before}{field}"), |unit| format!("{before}{field} [{unit}]"))
}
