//! The records of a machine as messages of a file. A chunk of it has 50 ms at most, or somewhat more than 8 MiB.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::sync::Arc;

use super::container::Container;
use super::machine::{END, MACHINE, Machine, PROGRAM};
use super::messages::{self, At, AxisRecord, CommandText, EventText, LateText, NativeValues};
use super::native::Parts;
use super::recent::WireEnd;
use super::schema::{Begun, Table};
use super::wire::Wire;
use crate::summary::named;
use fieldbeat_core::cycle::record::{
    CycleRecord, EventRecord, MonitorRecord, Record, ReferenceRecord, SkippedRecord,
};
use fieldbeat_core::time::{MS, Time};
use fieldbeat_telemetry::causes::Judged;
use fieldbeat_telemetry::log::LogBegin;

/// A chunk has so much machine time at most, unless the records of cycles were lost: no more is lost with a program
/// that is killed.
const CHUNK_NS: u64 = 50 * MS;

/// Records that wait for the one of their cycle. More are written by the time of the cycle before: that of their own
/// was lost.
const MOST_PENDING: usize = 1 << 14;

/// A topic.
#[derive(Debug)]
pub struct Topic<T> {
    channel: u16,
    sequence: u32,
    /// Topics of the same type have one.
    table: Arc<Table<T>>,
}

/// The writer of the records of one machine.
pub struct Writer<W: Write> {
    out: Container<W>,
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
    every: Table<At<()>>,
    /// The first fields of the messages of a cycle, and which cycle and instant that is.
    begun: Begun,
    begun_of: (u64, Time),
    /// Those of a cycle whose own record is still to come.
    pending: Vec<Record>,
    /// A cycle, and its instant on the grid.
    grid: (u64, Time),
    /// Of UTC, so much later than the clock of the loop, ns.
    utc_ns: i64,
    /// When the newest chunk was begun.
    chunk: Option<Time>,
    written: Written,
    /// The part that is written, in chunks that were ended in time.
    flushed: Written,
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

impl<T> Topic<T> {
    /// One more topic of a file.
    pub fn add<W: Write>(
        out: &mut Container<W>,
        topic: &str,
        about: &BTreeMap<String, String>,
        table: impl Into<Arc<Table<T>>>,
    ) -> io::Result<Topic<T>> {
        let table = table.into();
        let channel = out.channel(topic, about, &table.full_name(), &table.descriptor())?;
        Ok(Topic { channel, sequence: 0, table })
    }

    /// Writes its next message, of an instant of UTC.
    pub fn send<W: Write>(&mut self, out: &mut Container<W>, utc_ns: u64, of: &T) -> io::Result<()> {
        self.send_behind(&Begun::default(), out, utc_ns, of)
    }

    /// The same of one whose first fields are known.
    fn send_behind<W: Write>(
        &mut self,
        begun: &Begun,
        out: &mut Container<W>,
        utc_ns: u64,
        of: &T,
    ) -> io::Result<()> {
        self.sequence = self.sequence.wrapping_add(1);
        out.message(self.channel, self.sequence, utc_ns, |bytes| self.table.encode_behind(begun, of, bytes))
    }
}

impl<W: Write> Writer<W> {
    /// Begins the file of a machine whose clock is so much earlier than UTC.
    pub fn new(out: W, machine: Machine, utc_ns: i64) -> io::Result<Writer<W>> {
        Writer::with_log(out, machine, utc_ns, None)
    }

    /// The same with the log of its loop, if there is one.
    pub fn with_log(out: W, machine: Machine, utc_ns: i64, log: Option<LogBegin>) -> io::Result<Writer<W>> {
        let mut out = Container::begin(out)?;
        out.metadata(MACHINE, &machine.about)?;
        // A program that is killed leaves at least an empty recording.
        out.flush()?;
        let version = machine.about.get(PROGRAM).map_or("", String::as_str);
        let wire = log.map(|log| Wire::begin(&mut out, log, version)).transpose()?;
        let none = BTreeMap::new();
        let (mut axes, mut monitors, mut natives) = (Vec::new(), Vec::new(), Vec::new());
        let of_axis = Arc::new(messages::axis());
        for axis in &machine.axes {
            let topic = format!("/axes/{}", axis.name);
            axes.push(Topic::add(&mut out, &topic, &axis.about, Arc::clone(&of_axis))?);
            let units: BTreeMap<String, String> = axis.monitor.iter().flatten().cloned().collect();
            let names = axis.monitor.each_ref().map(|channel| channel.as_ref().map(|(name, _)| name.clone()));
            let table = messages::monitors(&names);
            let of_monitors = format!("{topic}/monitors");
            monitors.push(
                (!units.is_empty()).then(|| Topic::add(&mut out, &of_monitors, &units, table)).transpose()?,
            );
            let native = axis.native.as_ref().map(|layout| {
                let of_native =
                    Topic::add(&mut out, &format!("{topic}/native"), &none, messages::native(layout))?;
                Ok::<_, io::Error>((of_native, Parts::new(layout.clone())))
            });
            natives.push(native.transpose()?);
        }
        Ok(Writer {
            axes,
            monitors,
            natives,
            cycle: Topic::add(&mut out, "/cycle", &none, messages::cycle())?,
            skipped: Topic::add(&mut out, "/skipped", &none, messages::skipped())?,
            reference: Topic::add(&mut out, "/reference", &none, messages::reference())?,
            events: Topic::add(&mut out, "/events", &none, messages::events())?,
            commands: Topic::add(&mut out, "/commands", &none, messages::commands())?,
            late: Topic::add(&mut out, "/late", &none, messages::late())?,
            wire,
            out,
            machine,
            every: messages::every(),
            begun: Begun::default(),
            begun_of: (0, Time(0)),
            pending: Vec::new(),
            grid: (0, Time(0)),
            utc_ns,
            chunk: None,
            written: Written::default(),
            flushed: Written::default(),
        })
    }

    /// Writes the end of a log, before all messages.
    pub fn put_wire(&mut self, of: &WireEnd) -> io::Result<()> {
        Wire::put(&mut self.out, of, self.utc_ns)
    }

    /// How much was written.
    pub fn written(&self) -> Written {
        self.written
    }

    /// How much of it a failure from here on leaves in the file.
    pub fn flushed(&self) -> Written {
        self.flushed
    }

    /// About how many bytes the end of the file has.
    pub fn summary(&self) -> u64 {
        self.out.summary()
    }

    /// The first cycle that the log of the loop has not, since there was no room for it.
    pub fn cut_at(&self) -> Option<u64> {
        self.wire.as_ref().and_then(Wire::cut_at)
    }

    /// Takes in what the loop has logged since then.
    pub fn take_log(&mut self) -> io::Result<()> {
        let Some(wire) = &mut self.wire else { return Ok(()) };
        wire.take();
        self.written.messages += wire.put_link(&mut self.out, self.utc_ns)?;
        // The time of a message is that of a cycle.
        if wire.is_enough() && self.chunk.is_some() { self.write_log() } else { Ok(()) }
    }

    /// Ends the log of the loop with what is left of it.
    pub fn end_log(&mut self) -> io::Result<()> {
        let Some(wire) = &mut self.wire else { return Ok(()) };
        wire.take();
        self.written.messages += wire.put_link(&mut self.out, self.utc_ns)?;
        self.write_log()?;
        self.wire.as_ref().map_or(Ok(()), |wire| wire.end(&mut self.out))
    }

    /// Writes what was taken of the log.
    fn write_log(&mut self) -> io::Result<()> {
        let Some((topic, bytes)) = self.wire.as_mut().and_then(Wire::next) else { return Ok(()) };
        self.written.wire_bytes += bytes.len() as u64;
        topic.send(&mut self.out, self.grid.1.0.saturating_add_signed(self.utc_ns), bytes)
    }

    /// How many records it has dropped, since others of the same native process data are missing, or which the link
    /// thread has lost.
    pub fn dropped(&self) -> u64 {
        let of_link = self.wire.as_ref().map_or(0, Wire::lost);
        self.natives.iter().flatten().map(|(_, parts)| parts.dropped()).sum::<u64>() + of_link
    }

    /// Takes a record in.
    pub fn enter(&mut self, record: &Record) -> io::Result<()> {
        // The slot behind it, if that is known.
        let next = match record {
            Record::Cycle(cycle) => {
                self.grid = (cycle.index, cycle.grid);
                Some(cycle.index + 1)
            }
            Record::Skipped(skipped) => {
                self.grid = (skipped.first, skipped.grid);
                Some(skipped.first.saturating_add(skipped.count))
            }
            _ if self.pending.len() < MOST_PENDING => {
                self.pending.push(*record);
                return Ok(());
            }
            _ => None,
        };
        let mut pending = std::mem::take(&mut self.pending);
        let written = pending.iter().chain([record]).try_for_each(|record| self.write(record));
        pending.clear();
        self.pending = pending;
        written?;
        next.map_or(Ok(()), |next| self.end_chunk_before(next))
    }

    /// A late cycle, once its cause is known.
    pub fn late(&mut self, judged: &Judged) -> io::Result<()> {
        let axes = &self.machine.axes;
        let text = LateText::new(judged, named(judged.cause, |axis| Some(axes.get(axis)?.name.clone())));
        let at = At { cycle: judged.index, monotonic_ns: judged.from.0, of: text };
        self.written.messages += 1;
        self.late.send(&mut self.out, judged.from.0.saturating_add_signed(self.utc_ns), &at)
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

    fn write(&mut self, record: &Record) -> io::Result<()> {
        let cycle = record.index();
        let now = self.instant(cycle);
        let utc_ns = now.0.saturating_add_signed(self.utc_ns);
        let monotonic_ns = now.0;
        if self.begun_of != (cycle, now) {
            self.begun.begin(&self.every, &At { cycle, monotonic_ns, of: () });
            self.begun_of = (cycle, now);
        }
        let (out, begun) = (&mut self.out, &self.begun);
        let sent = match *record {
            Record::Drive(drive) => {
                let axis = usize::from(drive.axis);
                let Some(topic) = self.axes.get_mut(axis) else { return Ok(()) };
                let of = AxisRecord { drive, modulo: self.machine.axes[axis].modulo };
                topic.send_behind(begun, out, utc_ns, &At { cycle, monotonic_ns, of })
            }
            Record::Monitor(of) => {
                let Some(Some(topic)) = self.monitors.get_mut(usize::from(of.axis)) else { return Ok(()) };
                topic.send_behind(begun, out, utc_ns, &At { cycle, monotonic_ns, of })
            }
            Record::Reference(of) => self.reference.send(out, utc_ns, &At { cycle, monotonic_ns, of }),
            Record::Cycle(of) => self.cycle.send(out, utc_ns, &At { cycle, monotonic_ns, of }),
            Record::Skipped(of) => self.skipped.send(out, utc_ns, &At { cycle, monotonic_ns, of }),
            Record::Command(of) => {
                let Some(axis) = self.machine.axes.get(usize::from(of.axis())) else { return Ok(()) };
                let of = CommandText::new(&axis.name, of);
                self.commands.send(out, utc_ns, &At { cycle, monotonic_ns, of })
            }
            Record::Native(part) => {
                let native = self.natives.get_mut(usize::from(part.axis)).and_then(Option::as_mut);
                let Some((topic, parts)) = native else { return Ok(()) };
                let Some(mut of) = parts.enter(&part) else { return Ok(()) };
                if part.inputs > 0 {
                    of.received_at_ns = (now + u64::from(part.received_ns)).0;
                }
                topic.send(out, utc_ns, &At { cycle, monotonic_ns, of })
            }
            Record::Event(of) => {
                let Some(of) = self.event(&of) else { return Ok(()) };
                self.events.send(&mut self.out, utc_ns, &At { cycle, monotonic_ns, of })
            }
        };
        self.written.messages += 1;
        sent
    }

    fn event(&self, event: &EventRecord) -> Option<EventText> {
        let axis = self.machine.axes.get(usize::from(event.axis))?;
        let begun_by = event.begun_by();
        let of = begun_by.and_then(|by| self.machine.axes.get(usize::from(by.axis)));
        let begun_by = (begun_by, of.map(|axis| axis.name.as_str()));
        Some(EventText::new(event.axis, &axis.name, &event.kind()?, begun_by, |code| axis.faults.name(code)))
    }

    /// Ends the chunk, unless the slot that comes next belongs to it.
    fn end_chunk_before(&mut self, next: u64) -> io::Result<()> {
        let begun = *self.chunk.get_or_insert(self.grid.1);
        if self.instant(next).since(begun) >= CHUNK_NS {
            self.write_log()?;
            self.out.flush()?;
            self.chunk = None;
            self.flushed = self.written;
        }
        Ok(())
    }

    /// Ends the file; `lost` records are missing in it. Returns what it was written to.
    pub fn finish(mut self, lost: u64) -> io::Result<W> {
        let mut pending = std::mem::take(&mut self.pending);
        pending.drain(..).try_for_each(|record| self.write(&record))?;
        let counts = [("lost_records", lost), ("messages", self.written.messages)];
        self.out.metadata(END, &counts.map(|(key, count)| (key.to_owned(), count.to_string())).into())?;
        self.out.finish()
    }
}
