//! A recording as a trace of events in JSON, which Perfetto, chrome://tracing and Speedscope open: the stages of each
//! cycle and the commands of each axis as spans, late cycles and events as instants.

use std::collections::BTreeMap;
use std::io::{self, Write};

use serde_json::{Map, Value, json};

use super::reading::Entry;
use fieldbeat_core::cycle::record::Stage;

/// Process numbers: they group the tracks.
const LOOP: u32 = 1;
const AXES: u32 = 2;

/// Tracks of the loop.
const STAGES: u32 = 1;
const LATE: u32 = 2;

/// The trace while it is written.
pub struct Trace<W: Write> {
    out: W,
    /// Where an event follows, or the first one.
    separator: &'static str,
    begin_ns: Option<u64>,
    /// The number of each axis' track.
    axes: BTreeMap<String, u32>,
    /// What the commands were that have begun, by axis and id, and when.
    running: BTreeMap<(String, u64), (u64, Map<String, Value>)>,
    events: u64,
}

impl<W: Write> std::fmt::Debug for Trace<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trace").field("events", &self.events).finish_non_exhaustive()
    }
}

impl<W: Write> Trace<W> {
    /// A trace to `out`.
    pub fn new(mut out: W) -> io::Result<Trace<W>> {
        write!(out, "{{\"displayTimeUnit\":\"ns\",\"traceEvents\":[")?;
        let (axes, running) = (BTreeMap::new(), BTreeMap::new());
        let mut trace = Trace { out, separator: "\n", begin_ns: None, axes, running, events: 0 };
        trace.name("process_name", LOOP, 0, "loop")?;
        trace.name("thread_name", LOOP, STAGES, "stages")?;
        trace.name("thread_name", LOOP, LATE, "late cycles")?;
        trace.name("process_name", AXES, 0, "axes")?;
        Ok(trace)
    }

    fn put(&mut self, event: &Value) -> io::Result<()> {
        self.out.write_all(self.separator.as_bytes())?;
        self.separator = ",\n";
        self.events += 1;
        serde_json::to_writer(&mut self.out, event).map_err(io::Error::from)
    }

    /// Names a process or one of its tracks.
    fn name(&mut self, what: &str, process: u32, track: u32, name: &str) -> io::Result<()> {
        self.put(&json!({ "ph": "M", "name": what, "pid": process, "tid": track, "args": { "name": name } }))
    }

    fn span(
        &mut self,
        (process, track): (u32, u32),
        (begin_ns, ns): (u64, u64),
        name: &str,
        about: impl Into<Value>,
    ) -> io::Result<()> {
        let (ts, dur) = (self.micros(begin_ns), ns as f64 * 1e-3);
        self.put(&json!({
            "ph": "X", "name": name, "pid": process, "tid": track, "ts": ts, "dur": dur, "args": about.into(),
        }))
    }

    fn instant(
        &mut self,
        (process, track): (u32, u32),
        at_ns: u64,
        name: &str,
        about: impl Into<Value>,
    ) -> io::Result<()> {
        let ts = self.micros(at_ns);
        self.put(&json!({
            "ph": "i", "s": "t", "name": name, "pid": process, "tid": track, "ts": ts, "args": about.into(),
        }))
    }

    /// Microseconds since the first message.
    fn micros(&self, at_ns: u64) -> f64 {
        (at_ns as i64).wrapping_sub(self.begin_ns.unwrap_or(at_ns) as i64) as f64 * 1e-3
    }

    fn track(&mut self, axis: &str) -> io::Result<(u32, u32)> {
        if let Some(track) = self.axes.get(axis) {
            return Ok((AXES, *track));
        }
        let track = self.axes.len() as u32 + 1;
        self.axes.insert(axis.to_owned(), track);
        self.name("thread_name", AXES, track, axis)?;
        Ok((AXES, track))
    }

    /// Takes a message in.
    pub fn enter(&mut self, entry: &Entry) -> io::Result<()> {
        let now = entry.utc_ns;
        self.begin_ns.get_or_insert(now);
        let cycle = entry.number("cycle");
        match &*entry.topic.name {
            "/cycle" => {
                let mut at = now.saturating_add(entry.number("wake_ns"));
                for stage in Stage::ALL {
                    let ns = entry.number(&format!("{}_ns", stage.name()));
                    self.span((LOOP, STAGES), (at, ns), stage.name(), json!({ "cycle": cycle }))?;
                    at = at.saturating_add(ns);
                }
            }
            "/skipped" => {
                let about = json!({ "cycle": cycle, "slots": entry.number("count") });
                self.instant((LOOP, LATE), now, "skipped", about)?;
            }
            "/late" => {
                let about = json!({
                    "cycle": cycle, "what": entry.text("what"), "delay_ns": entry.number("delay_ns"),
                    "stage": entry.text("stage"), "drive": entry.text("drive"),
                });
                let ns = entry.number("delay_ns");
                self.span((LOOP, LATE), (now, ns), &entry.text("cause"), about)?;
            }
            "/commands" if entry.number("step") == 1 => {
                let axis = entry.text("axis_name");
                let mut about = Map::new();
                for field in ["command_name", "target", "velocity", "acceleration", "deceleration"] {
                    let text = entry.text(field);
                    if !text.is_empty() {
                        about.insert(field.to_owned(), text.into());
                    }
                }
                self.running.insert((axis, entry.number("id")), (now, about));
            }
            "/events" => self.event(entry, cycle)?,
            _ => {}
        }
        Ok(())
    }

    fn event(&mut self, entry: &Entry, cycle: u64) -> io::Result<()> {
        let (axis, id) = (entry.text("axis_name"), entry.number("id"));
        let track = self.track(&axis)?;
        let text = entry.text("text");
        match self.running.remove(&(axis, id)) {
            Some((begun, mut about)) if entry.text("kind") == "ended" => {
                about.insert("id".to_owned(), id.into());
                about.insert("outcome".to_owned(), text.into());
                let ns = entry.utc_ns.saturating_sub(begun);
                self.span(track, (begun, ns), &entry.text("command"), about)
            }
            _ => {
                let about = json!({ "cycle": cycle, "text": text, "code": entry.number("code") });
                self.instant(track, entry.utc_ns, &entry.text("kind"), about)
            }
        }
    }

    /// Ends the trace: commands that still run end with it. Returns how many events it has, and what it was written to.
    pub fn finish(mut self, end_ns: u64) -> io::Result<(u64, W)> {
        for ((axis, id), (begun, mut about)) in std::mem::take(&mut self.running) {
            let track = self.track(&axis)?;
            let name = about.get("command_name").and_then(Value::as_str).unwrap_or_default().to_owned();
            about.insert("id".to_owned(), id.into());
            about.insert("outcome".to_owned(), "not ended".into());
            self.span(track, (begun, end_ns.saturating_sub(begun)), &name, about)?;
        }
        writeln!(self.out, "\n]}}")?;
        self.out.flush()?;
        Ok((self.events, self.out))
    }
}
