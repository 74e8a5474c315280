//! The file of a recording while it is written: MCAP, in chunks with an index each, so that it can be read up to its
//! last whole chunk whatever becomes of the program.
//!
//! Chunks are not compressed: what compresses them for MCAP is C. A chunk ends after a second, or after 8 MiB.

use std::collections::BTreeMap;
use std::io::{self, Write};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions};

use super::machine::{END, MACHINE, Machine, PROGRAM};
use super::messages::{self, At, AxisRecord, CommandText, EventText, LateText, NativeValues};
use super::native::Parts;
use super::schema::Table;
use super::wire::Wire;
use crate::summary::named;
use fieldbeat_core::cycle::record::{
    CycleRecord, EventRecord, MonitorRecord, Record, ReferenceRecord, SkippedRecord,
};
use fieldbeat_core::time::{S, Time};
use fieldbeat_telemetry::causes::Judged;
use fieldbeat_telemetry::log::LogBegin;

/// A chunk ends after so many bytes. An entry for each is kept until the end of the file: some 20 bytes a topic.
const CHUNK_BYTES: u64 = 8 << 20;

/// It also ends after so much machine time.
const CHUNK_NS: u64 = S;

/// Records that wait for the one of their cycle. More are written by the time of the cycle before: that of their own
/// was lost.
const MOST_PENDING: usize = 1 << 14;

/// A topic.
#[derive(Debug)]
pub struct Topic<T> {
    channel: u16,
    sequence: u32,
    table: Table<T>,
}

/// What writes the records of one machine.
pub struct Writer<W: Write> {
    out: mcap::Writer<NoSeek<W>>,
    machine: Machine,
    axes: Vec<Topic<At<AxisRecord>>>,
    monitors: Vec<Option<Topic<At<MonitorRecord>>>>,
    natives: Vec<Option<(Topic<At<NativeValues>>, Parts)>>,
    cycle: Topic<At<CycleRecord>>,
    skipped: Topic<At<SkippedRecord>>,
    reference: Topic<At<ReferenceRecord>>,
    events: Topic<At<EventText>>,
    commands: Topic<At<CommandText>>,
    late: Topic<At<LateText>>,
    /// The log of the loop, if it is recorded, too.
    wire: Option<Wire>,
    /// Those of a cycle whose own record is still to come.
    pending: Vec<Record>,
    /// A cycle, and its instant on the grid.
    grid: (u64, Time),
    /// Of UTC, so much later than the clock of the loop, ns.
    utc_ns: i64,
    /// When the newest chunk was begun.
    chunk: Option<Time>,
    written: Written,
    /// So much of it is out, in chunks that were ended in time.
    flushed: Written,
    message: Vec<u8>,
}

/// How much was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Written {
    /// Messages, those of the log not among them.
    pub messages: u64,
    /// Bytes of the log of the loop.
    pub wire_bytes: u64,
}

impl<W: Write> std::fmt::Debug for Writer<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").field("written", &self.written).finish_non_exhaustive()
    }
}

/// Opens the topics of a file.
pub struct Topics<'a, W: Write>(pub &'a mut mcap::Writer<NoSeek<W>>);

impl<W: Write> std::fmt::Debug for Topics<'_, W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Topics")
    }
}

impl<W: Write> Topics<'_, W> {
    /// One more.
    pub fn add<T>(
        &mut self,
        topic: &str,
        about: &BTreeMap<String, String>,
        table: Table<T>,
    ) -> Result<Topic<T>, McapError> {
        let schema = self.0.add_schema(&table.full_name(), "protobuf", &table.descriptor())?;
        let channel = self.0.add_channel(schema, topic, "protobuf", about)?;
        Ok(Topic { channel, sequence: 0, table })
    }
}

/// What the operating system says, or else the library.
fn why(error: McapError) -> io::Error {
    if let McapError::Io(error) = error { error } else { io::Error::other(error) }
}

impl<W: Write> Writer<W> {
    /// Begins the file of a machine whose clock is so much earlier than UTC.
    pub fn new(out: W, machine: Machine, utc_ns: i64) -> io::Result<Writer<W>> {
        Writer::with_log(out, machine, utc_ns, None)
    }

    /// The same with the log of its loop, if there is one.
    pub fn with_log(out: W, machine: Machine, utc_ns: i64, log: Option<LogBegin>) -> io::Result<Writer<W>> {
        Writer::begin(out, machine, utc_ns, log).map_err(why)
    }

    fn begin(out: W, machine: Machine, utc_ns: i64, log: Option<LogBegin>) -> Result<Writer<W>, McapError> {
        let mut out = WriteOptions::new()
            .compression(None)
            .chunk_size(Some(CHUNK_BYTES))
            // A chunk is written as a whole.
            .disable_seeking(true)
            .library(concat!("fieldbeat ", env!("CARGO_PKG_VERSION")))
            .create(NoSeek::new(out))?;
        out.write_metadata(&Metadata { name: MACHINE.to_owned(), metadata: machine.about.clone() })?;
        let version = machine.about.get(PROGRAM).map_or("", String::as_str);
        let wire = log.map(|log| Wire::begin(&mut out, log, version)).transpose()?;
        let mut topics = Topics(&mut out);
        let none = BTreeMap::new();
        let (mut axes, mut monitors, mut natives) = (Vec::new(), Vec::new(), Vec::new());
        for axis in &machine.axes {
            let topic = format!("/axes/{}", axis.name);
            axes.push(topics.add(&topic, &axis.about, messages::axis())?);
            let units: BTreeMap<String, String> = axis.monitor.iter().flatten().cloned().collect();
            let names = axis.monitor.each_ref().map(|channel| channel.as_ref().map(|(name, _)| name.clone()));
            let table = messages::monitors(&names);
            let of_monitors = format!("{topic}/monitors");
            monitors.push((!units.is_empty()).then(|| topics.add(&of_monitors, &units, table)).transpose()?);
            let native = axis.native.as_ref().map(|layout| {
                let of_native = topics.add(&format!("{topic}/native"), &none, messages::native(layout))?;
                Ok::<_, McapError>((of_native, Parts::new(layout.clone())))
            });
            natives.push(native.transpose()?);
        }
        Ok(Writer {
            axes,
            monitors,
            natives,
            cycle: topics.add("/cycle", &none, messages::cycle())?,
            skipped: topics.add("/skipped", &none, messages::skipped())?,
            reference: topics.add("/reference", &none, messages::reference())?,
            events: topics.add("/events", &none, messages::events())?,
            commands: topics.add("/commands", &none, messages::commands())?,
            late: topics.add("/late", &none, messages::late())?,
            wire,
            out,
            machine,
            pending: Vec::new(),
            grid: (0, Time(0)),
            utc_ns,
            chunk: None,
            written: Written::default(),
            flushed: Written::default(),
            message: Vec::new(),
        })
    }

    /// How much was written.
    pub fn written(&self) -> Written {
        self.written
    }

    /// How much of it a failure from here on leaves in the file.
    pub fn flushed(&self) -> Written {
        self.flushed
    }

    /// The first cycle that the log of the loop has not, since there was no room for it.
    pub fn cut_at(&self) -> Option<u64> {
        self.wire.as_ref().and_then(Wire::cut_at)
    }

    /// Takes in what the loop has logged since then.
    pub fn take_log(&mut self) -> io::Result<()> {
        let Some(wire) = &mut self.wire else { return Ok(()) };
        wire.take();
        // The time of a message is that of a cycle.
        if wire.is_enough() && self.chunk.is_some() { self.write_log().map_err(why) } else { Ok(()) }
    }

    /// Ends the log of the loop with what is left of it.
    pub fn end_log(&mut self) -> io::Result<()> {
        let Some(wire) = &mut self.wire else { return Ok(()) };
        wire.take();
        let end = wire.end();
        self.write_log().and_then(|()| self.out.write_metadata(&end)).map_err(why)
    }

    /// Writes what was taken of the log.
    fn write_log(&mut self) -> Result<(), McapError> {
        let Some((topic, bytes)) = self.wire.as_mut().and_then(Wire::next) else { return Ok(()) };
        let header = header(topic, self.grid.1, self.utc_ns);
        topic.table.encode(bytes, &mut self.message);
        self.written.wire_bytes += bytes.len() as u64;
        self.out.write_to_known_channel(&header, &self.message)
    }

    /// How many records it has dropped, since others of the same native process data are missing.
    pub fn dropped(&self) -> u64 {
        self.natives.iter().flatten().map(|(_, parts)| parts.dropped()).sum()
    }

    /// Takes a record in.
    pub fn enter(&mut self, record: &Record) -> io::Result<()> {
        match record {
            Record::Cycle(cycle) => self.grid = (cycle.index, cycle.grid),
            Record::Skipped(skipped) => self.grid = (skipped.first, skipped.grid),
            _ if self.pending.len() < MOST_PENDING => {
                self.pending.push(*record);
                return Ok(());
            }
            _ => {}
        }
        let mut pending = std::mem::take(&mut self.pending);
        pending.push(*record);
        let written = pending.iter().try_for_each(|record| self.write(record));
        pending.clear();
        self.pending = pending;
        written.and_then(|()| self.end_old_chunk()).map_err(why)
    }

    /// A late cycle, once its cause is known.
    pub fn late(&mut self, judged: &Judged) -> io::Result<()> {
        let axes = &self.machine.axes;
        let text = LateText::new(judged, named(judged.cause, |axis| Some(axes.get(axis)?.name.clone())));
        let at = At { cycle: judged.index, monotonic_ns: judged.from.0, of: text };
        let header = header(&mut self.late, judged.from, self.utc_ns);
        self.late.table.encode(&at, &mut self.message);
        self.written.messages += 1;
        self.out.write_to_known_channel(&header, &self.message).map_err(why)
    }

    /// When the slot of a record was due.
    fn instant(&self, index: u64) -> Time {
        let (known, grid) = self.grid;
        if index >= known {
            grid + (index - known).saturating_mul(self.machine.period_ns)
        } else {
            grid - (known - index).saturating_mul(self.machine.period_ns)
        }
    }

    fn write(&mut self, record: &Record) -> Result<(), McapError> {
        let cycle = record.index();
        let now = self.instant(cycle);
        let (utc_ns, monotonic_ns) = (self.utc_ns, now.0);
        let message = &mut self.message;
        /// Encodes a message of a topic; its header.
        fn encode<T>(
            topic: &mut Topic<At<T>>,
            at: At<T>,
            now: Time,
            utc_ns: i64,
            message: &mut Vec<u8>,
        ) -> MessageHeader {
            topic.table.encode(&at, message);
            header(topic, now, utc_ns)
        }
        let header = match *record {
            Record::Drive(drive) => {
                let axis = usize::from(drive.axis);
                let Some(topic) = self.axes.get_mut(axis) else { return Ok(()) };
                let of = AxisRecord { drive, modulo: self.machine.axes[axis].modulo };
                encode(topic, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Monitor(of) => {
                let Some(Some(topic)) = self.monitors.get_mut(usize::from(of.axis)) else { return Ok(()) };
                encode(topic, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Reference(of) => {
                encode(&mut self.reference, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Cycle(of) => {
                encode(&mut self.cycle, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Skipped(of) => {
                encode(&mut self.skipped, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Command(of) => {
                let Some(axis) = self.machine.axes.get(usize::from(of.axis)) else { return Ok(()) };
                let of = CommandText::new(&axis.name, of);
                encode(&mut self.commands, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Native(part) => {
                let native = self.natives.get_mut(usize::from(part.axis)).and_then(Option::as_mut);
                let Some((topic, parts)) = native else { return Ok(()) };
                let Some(mut of) = parts.enter(&part) else { return Ok(()) };
                if part.inputs > 0 {
                    of.received_at_ns = (now + u64::from(part.received_ns)).0;
                }
                encode(topic, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
            Record::Event(of) => {
                let Some(of) = self.event(&of) else { return Ok(()) };
                let message = &mut self.message;
                encode(&mut self.events, At { cycle, monotonic_ns, of }, now, utc_ns, message)
            }
        };
        self.written.messages += 1;
        self.out.write_to_known_channel(&header, &self.message)
    }

    fn event(&self, event: &EventRecord) -> Option<EventText> {
        let axis = self.machine.axes.get(usize::from(event.axis))?;
        let begun_by = event.begun_by();
        let of = begun_by.and_then(|by| self.machine.axes.get(usize::from(by.axis)));
        let begun_by = (begun_by, of.map(|axis| axis.name.as_str()));
        Some(EventText::new(event.axis, &axis.name, &event.kind()?, begun_by, |code| axis.faults.name(code)))
    }

    /// A chunk that is old enough ends.
    fn end_old_chunk(&mut self) -> Result<(), McapError> {
        let (_, now) = self.grid;
        let begun = *self.chunk.get_or_insert(now);
        if now.since(begun) >= CHUNK_NS {
            self.chunk = Some(now);
            self.write_log()?;
            self.out.flush()?;
            self.flushed = self.written;
        }
        Ok(())
    }

    /// Ends the file; `lost` records are missing in it. Returns what it was written to.
    pub fn finish(mut self, lost: u64) -> io::Result<W> {
        let mut pending = std::mem::take(&mut self.pending);
        let written = pending.drain(..).try_for_each(|record| self.write(&record));
        let counts = [("lost_records", lost), ("messages", self.written.messages)];
        let metadata = counts.map(|(key, count)| (key.to_owned(), count.to_string())).into();
        written
            .and_then(|()| self.out.write_metadata(&Metadata { name: END.to_owned(), metadata }))
            .and_then(|()| self.out.finish().map(drop))
            .map_err(why)?;
        Ok(self.out.into_inner().into_inner())
    }
}

/// The header of the next message of a topic.
fn header<T>(topic: &mut Topic<T>, now: Time, utc_ns: i64) -> MessageHeader {
    topic.sequence = topic.sequence.wrapping_add(1);
    let log_time = now.0.saturating_add_signed(utc_ns);
    MessageHeader { channel_id: topic.channel, sequence: topic.sequence, log_time, publish_time: log_time }
}
