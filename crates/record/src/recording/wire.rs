//! The log of the loop in a recording, from which `replay` repeats the run: a topic of its own, and metadata around it.

use std::collections::BTreeMap;
use std::io::{self, Write};

use super::container::Container;
use super::messages;
use super::recent::WireEnd;
use super::schema::{Get, Table};
use super::writer::Topic;
use crate::log::layout::{BEGIN, Begin, CUT_AT, END, LINK_TOPIC, TOPIC};
use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_core::logged::{LinkPassed, LinkTap};
use fieldbeat_core::time::Time;
use fieldbeat_telemetry::log::LogBegin;

/// Fewer words wait for more: a message takes some 50 bytes besides.
const ENOUGH: usize = 1 << 13;

/// The log, and what was taken out of it.
pub struct Wire {
    reader: LogReader,
    topic: Topic<Vec<u8>>,
    link: LinkTap,
    of_link: Topic<LinkPassed>,
    /// Events of the link thread that were lost.
    lost: u64,
    /// Taken, and not written yet.
    words: Vec<u64>,
    bytes: Vec<u8>,
}

impl Wire {
    /// Begins it in a file that has no message yet, by a program of this version.
    pub fn begin<W: Write>(out: &mut Container<W>, log: LogBegin, version: &str) -> io::Result<Wire> {
        let LogBegin { reader, link, machine, plan, has_task } = log;
        out.metadata(BEGIN, &Begin::new(version, machine, plan, has_task).to_map())?;
        let (topic, of_link) = (topic(out)?, link_topic(out)?);
        Ok(Wire { reader, topic, link, of_link, lost: 0, words: Vec::new(), bytes: Vec::new() })
    }

    /// Writes the end of a log whole, at one instant, in a file that has no message yet, and whose clock is so much
    /// earlier than UTC.
    pub fn put<W: Write>(out: &mut Container<W>, of: &WireEnd, utc_ns: i64) -> io::Result<()> {
        out.metadata(BEGIN, &of.begin)?;
        let (mut topic, mut of_link) = (topic(out)?, link_topic(out)?);
        let utc = |at: Time| at.0.saturating_add_signed(utc_ns);
        of.link.iter().try_for_each(|passed| of_link.send(out, utc(passed.at), passed))?;
        for words in &of.words {
            let bytes: Vec<u8> = words.iter().copied().flat_map(u64::to_le_bytes).collect();
            topic.send(out, utc(of.at), &bytes)?;
        }
        out.metadata(END, &cut(of.cut_at))
    }

    /// Takes what the loop has logged since then.
    pub fn take(&mut self) {
        self.reader.take(&mut self.words);
    }

    /// Writes what the link thread has had on connections since then. Returns how many messages that were.
    pub fn put_link<W: Write>(&mut self, out: &mut Container<W>, utc_ns: i64) -> io::Result<u64> {
        let (passed, lost) = self.link.take();
        self.lost = lost;
        for of in &passed {
            self.of_link.send(out, of.at.0.saturating_add_signed(utc_ns), of)?;
        }
        Ok(passed.len() as u64)
    }

    /// How many of its events were lost.
    pub fn lost(&self) -> u64 {
        self.lost
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
        out.metadata(END, &cut(self.cut_at()))
    }
}

/// The topic of a log.
fn topic<W: Write>(out: &mut Container<W>) -> io::Result<Topic<Vec<u8>>> {
    let table = Table::new("Wire", vec![("words".into(), Get::Bytes(|bytes: &Vec<u8>| bytes))]);
    Topic::add(out, TOPIC, &BTreeMap::new(), table)
}

/// That of what the link thread has on connections.
fn link_topic<W: Write>(out: &mut Container<W>) -> io::Result<Topic<LinkPassed>> {
    Topic::add(out, LINK_TOPIC, &BTreeMap::new(), messages::link())
}

/// The metadata behind a log that ends before this cycle.
fn cut(at: Option<u64>) -> BTreeMap<String, String> {
    at.map(|cycle| (CUT_AT.to_owned(), cycle.to_string())).into_iter().collect()
}
