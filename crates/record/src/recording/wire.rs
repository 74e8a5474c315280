//! The log of the loop in a recording, from which `replay` repeats the run: a topic of its own, and metadata around it.

use std::collections::BTreeMap;
use std::io::{self, Write};

use super::container::Container;
use super::schema::{Get, Table};
use super::writer::Topic;
use crate::log::layout::{BEGIN, Begin, CUT_AT, END, TOPIC};
use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_telemetry::log::LogBegin;

/// Fewer words wait for more: a message takes some 50 bytes besides.
const ENOUGH: usize = 1 << 13;

/// The log, and what was taken out of it.
pub struct Wire {
    reader: LogReader,
    topic: Topic<Vec<u8>>,
    /// Taken, and not written yet.
    words: Vec<u64>,
    bytes: Vec<u8>,
}

impl Wire {
    /// Begins it in a file that has no message yet, by a program of this version.
    pub fn begin<W: Write>(out: &mut Container<W>, log: LogBegin, version: &str) -> io::Result<Wire> {
        let LogBegin { reader, machine, plan, has_task } = log;
        out.metadata(BEGIN, &Begin::new(version, machine, plan, has_task).to_map())?;
        let table = Table::new("Wire", vec![("words".into(), Get::Bytes(|bytes: &Vec<u8>| bytes))]);
        let topic = Topic::add(out, TOPIC, &BTreeMap::new(), table)?;
        Ok(Wire { reader, topic, words: Vec::new(), bytes: Vec::new() })
    }

    /// Takes what the loop has logged since then.
    pub fn take(&mut self) {
        self.reader.take(&mut self.words);
    }

    /// Whether there is enough of it for a message.
    pub fn is_enough(&self) -> bool {
        self.words.len() >= ENOUGH
    }

    /// The bytes of the next message, with all that was taken; `None`: there is nothing.
    pub fn next(&mut self) -> Option<(&mut Topic<Vec<u8>>, &Vec<u8>)> {
        self.bytes.clear();
        self.bytes.extend(self.words.drain(..).flat_map(u64::to_le_bytes));
        (!self.bytes.is_empty()).then_some((&mut self.topic, &self.bytes))
    }

    /// The first cycle for which there was no room between the loop and this.
    pub fn cut_at(&self) -> Option<u64> {
        self.reader.ended_at()
    }

    /// Writes what stands behind it.
    pub fn end<W: Write>(&self, out: &mut Container<W>) -> io::Result<()> {
        let cut_at = self.cut_at().map(|cycle| (CUT_AT.to_owned(), cycle.to_string()));
        out.metadata(END, &cut_at.into_iter().collect())
    }
}
