//! One file while it is read: its text, its lines, and the mistakes found so far.

use std::cell::RefCell;
use std::fmt::{self, Display};
use std::ops::Range;

use toml::de::DeTable;

use super::error::{ConfigError, ConfigErrors};
use super::form::Record;

/// One file while it is read: its text, and the mistakes found so far.
#[derive(Debug)]
pub struct Page<'a> {
    file: &'a str,
    pub(super) text: &'a str,
    /// Offsets of the line ends.
    line_ends: Vec<usize>,
    mistakes: RefCell<Vec<ConfigError>>,
    /// Where the keys that are read are noted, if anybody wants them.
    record: Option<&'a RefCell<Record>>,
}

/// Where something stands, for a message.
#[derive(Clone, Debug)]
pub struct Place {
    /// Its line, from 1.
    pub line: usize,
    pub(super) key: String,
    pub(super) value: Option<String>,
}

impl<'a> Page<'a> {
    /// The page of `text`, which messages call `file`.
    pub fn new(file: &'a str, text: &'a str) -> Page<'a> {
        let line_ends =
            text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at).collect();
        Page { file, text, line_ends, mistakes: RefCell::default(), record: None }
    }

    /// The keys that are read from it are noted in `record`.
    pub fn recorded(self, record: &'a RefCell<Record>) -> Page<'a> {
        Page { record: Some(record), ..self }
    }

    /// Whether keys are noted: then each list of tables has one, so that all keys are read.
    pub(super) fn is_recorded(&self) -> bool {
        self.record.is_some()
    }

    pub(super) fn record(&self, note: impl FnOnce(&mut Record)) {
        if let Some(record) = self.record {
            note(&mut record.borrow_mut());
        }
    }

    /// Parses the text. With a mistake of syntax nothing behind it can be trusted, so the first one of each line is
    /// reported, and nothing else. A file that is wrong in most of its lines is no TOML at all, and only its first
    /// mistake is reported.
    pub fn parse(&self) -> Result<DeTable<'a>, ConfigErrors> {
        let (root, errors) = DeTable::parse_recoverable(self.text);
        if errors.is_empty() {
            return Ok(root.into_inner());
        }
        let mut mistakes: Vec<(usize, bool, &toml::de::Error)> = errors
            .iter()
            // A second key of one name may only be the echo of a broken line.
            .map(|error| {
                (self.line(error.span().unwrap_or(0..0).start), error.message() == "duplicate key", error)
            })
            .collect();
        mistakes.sort_by_key(|(line, echo, _)| (*line, *echo));
        mistakes.dedup_by_key(|(line, ..)| *line);
        let lines = self
            .text
            .lines()
            .map(str::trim)
            .filter(|line| !line.is_empty() && !line.starts_with('#'))
            .count();
        if let [(_, _, first), .., _] = mistakes[..]
            && mistakes.len() * 2 > lines
        {
            let mut error = self.syntax(first);
            error.message += "; most lines are wrong: is this a TOML file?";
            return Err(error.into());
        }
        Err(ConfigErrors::new(mistakes.into_iter().map(|(.., error)| self.syntax(error)).collect()))
    }

    /// In the words of `toml`, but for the slips that happen to everybody.
    fn syntax(&self, error: &toml::de::Error) -> ConfigError {
        let span = error.span().unwrap_or(0..0);
        let line = self.line(span.start);
        let reason = error.message().split(", expected").next().unwrap_or_default();
        let message = match (reason, self.snippet(span)) {
            ("duplicate key", Some(found)) => format!("{found} is set twice; keep one"),
            ("key with no value", _) => "a key needs a value: key = value".into(),
            ("string values must be quoted", None) => "a value is missing after =".into(),
            ("string values must be quoted", Some(found)) => {
                format!("{found} is not a value; write text in quotes")
            }
            (_, Some(found)) => format!("{found}: {}", error.message()),
            (_, None) => error.message().to_owned(),
        };
        ConfigError { file: self.file.to_owned(), line: Some(line), key: None, value: None, message }
    }

    /// Notes a mistake.
    pub fn report(&self, place: Place, message: impl Into<String>) {
        self.mistakes.borrow_mut().push(ConfigError {
            file: self.file.to_owned(),
            line: Some(place.line),
            key: Some(place.key),
            value: place.value,
            message: message.into(),
        });
    }

    /// `Err` with all mistakes, if there are any.
    pub fn verdict(self) -> Result<(), ConfigErrors> {
        let mistakes = self.mistakes.into_inner();
        if mistakes.is_empty() { Ok(()) } else { Err(ConfigErrors::new(mistakes)) }
    }

    pub(super) fn line(&self, offset: usize) -> usize {
        self.line_ends.partition_point(|end| *end < offset) + 1
    }

    /// A piece of the file as one short printable line.
    pub(super) fn snippet(&self, span: Range<usize>) -> Option<String> {
        let words: Vec<&str> = self.text.get(span)?.split_whitespace().collect();
        shorten(&words.join(" "))
    }
}

/// At most 40 characters on one line, none of them able to play with a terminal; `None` if nothing is left.
pub(super) fn shorten(text: &str) -> Option<String> {
    let mut short: String = text.chars().take(40).flat_map(printable).collect();
    if text.chars().nth(40).is_some() {
        short.push_str("...");
    }
    (!short.is_empty()).then_some(short)
}

fn printable(c: char) -> impl Iterator<Item = char> {
    // The quotes that `escape_debug` also escapes are harmless here.
    let keep = matches!(c, '"' | '\'' | '\\');
    let escaped = (!keep).then(|| c.escape_debug());
    keep.then_some(c).into_iter().chain(escaped.into_iter().flatten())
}

impl Place {
    /// A place outside of any table: a row of a list.
    pub fn in_row(line: usize, column: &str, value: &str) -> Place {
        Place { line, key: column.to_owned(), value: shorten(value) }
    }
}

impl Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {}", self.line)
    }
}
