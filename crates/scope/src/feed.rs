//! Attaches to a master, hands on what it sends to all browsers, and attaches again when it has ended.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::extract::ws::Utf8Bytes;
use serde_json::{Value, json};
use tokio::sync::{broadcast, watch};

use super::samples::{Assembler, Block};
use super::signals::{plots, signals};
use fieldbeat_control::{About, Happened, NEWS_EVERY, News, Operator, Part, Watched};
use fieldbeat_core::axis::{Command, State};
use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, Record};
use fieldbeat_core::time::S;
use fieldbeat_record::blackbox::file::Header;
use fieldbeat_telemetry::signals::{COMMAND, STATE, TIME};

/// How often a master is looked for.
const LOOK_EVERY: Duration = Duration::from_millis(300);

/// A master that says nothing for so long has died, or is stopped.
const PATIENCE: Duration = Duration::from_secs(5);

/// How often the state of the axes is sent.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// Where the records come from.
pub trait Source: Send + 'static {
    /// Attaches to the master; an error says in a line why there is none.
    fn open(&mut self) -> Result<(About, Watched), String>;
}

/// The way to operate the axes of the master.
pub trait Control: Send + Sync + 'static {
    /// Another operator, who has not taken them yet; an error says in a line why there is none.
    fn operator(&self) -> Result<Operator, String>;
}

/// Something new for every browser.
#[derive(Clone, Debug)]
pub enum Update {
    /// A message of the page.
    Text(Utf8Bytes),
    /// Samples, and the time between two of them, s.
    Samples(Arc<Block>, f64),
}

/// The senders to all browsers.
#[derive(Debug)]
pub struct Feed {
    /// The updates; a browser that is slow misses the oldest.
    pub updates: broadcast::Sender<Update>,
    /// The state that every browser has to know first: the machine, or that none runs.
    pub state: watch::Sender<Utf8Bytes>,
}

impl Feed {
    /// Runs until `end`.
    pub fn run(self, mut source: impl Source, end: &AtomicBool) {
        while !end.load(Ordering::Acquire) {
            let why = match source.open() {
                Ok((about, watched)) => Attached::new(&self, about).run(watched, end),
                Err(why) => why,
            };
            self.introduce(&json!({ "waiting": why }));
            std::thread::sleep(LOOK_EVERY);
        }
    }

    /// Says what every browser has to know, once.
    fn introduce(&self, state: &Value) {
        let text = Utf8Bytes::from(state.to_string());
        if *self.state.borrow() != text {
            self.state.send_replace(text.clone());
            self.send(Update::Text(text));
        }
    }

    fn send(&self, update: Update) {
        // Without a browser nobody takes it.
        let _ = self.updates.send(update);
    }
}

/// Something that happened.
struct Event {
    cycle: u64,
    axis: Option<usize>,
    text: String,
    fault: bool,
}

/// A master that runs.
struct Attached<'a> {
    feed: &'a Feed,
    header: Header,
    drives: Vec<Option<DriveRecord>>,
    assembler: Assembler,
    /// The newest cycle.
    cycle: CycleRecord,
    /// The events since the last message about them.
    events: Vec<Event>,
    status_at: Option<Instant>,
}

impl<'a> Attached<'a> {
    fn new(feed: &'a Feed, about: About) -> Attached<'a> {
        let About { pid, epoch_ns, header, .. } = about;
        let signals = signals(&header);
        feed.introduce(&json!({ "machine": {
            "pid": pid,
            "epoch_ns": epoch_ns.to_string(),
            "config": header.machine,
            "version": header.program,
            "period_ns": header.period_ns,
            "late_ns": header.late_ns,
            "axes": header.axes.iter().map(|axis| json!({ "name": axis.name, "unit": axis.unit })).collect::<Value>(),
            "signals": signals,
            "time_unit": TIME,
            "plots": plots(&signals),
            "names": { (STATE.name): State::ALL.map(State::name), (COMMAND.name): Command::NAMES },
        }}));
        Attached {
            feed,
            drives: vec![None; header.axes.len()],
            assembler: Assembler::new(&header.axes),
            header,
            cycle: CycleRecord::default(),
            events: Vec::new(),
            status_at: None,
        }
    }

    /// Up to its end; says why that is.
    fn run(mut self, mut watched: Watched, end: &AtomicBool) -> String {
        let mut received_at = Instant::now();
        while !end.load(Ordering::Acquire) {
            match watched.part() {
                Ok(Some(part)) => {
                    received_at = Instant::now();
                    match part {
                        Part::Records(records) => self.records(&records),
                        Part::News(news) => self.news(news),
                    }
                }
                Ok(None) if received_at.elapsed() > PATIENCE => {
                    return format!("the master says nothing for {} s: is it stopped?", PATIENCE.as_secs());
                }
                Ok(None) => {}
                Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                    return "the master has ended".to_owned();
                }
                Err(error) => return format!("the master: {error}"),
            }
        }
        String::new()
    }

    fn records(&mut self, records: &[Record]) {
        for record in records {
            self.assembler.enter(record);
            match record {
                Record::Drive(drive) => {
                    if let Some(known) = self.drives.get_mut(usize::from(drive.axis)) {
                        *known = Some(*drive);
                    }
                }
                Record::Cycle(cycle) => self.cycle = *cycle,
                Record::Skipped(skipped) => {
                    let what = match skipped.count {
                        1 => "1 slot skipped".to_owned(),
                        count => format!("{count} slots skipped"),
                    };
                    self.events.push(Event { cycle: skipped.first, axis: None, text: what, fault: false });
                }
                _ => {}
            }
        }
        if let Some(block) = self.assembler.take() {
            let period_s = self.header.period_ns as f64 / S as f64;
            self.feed.send(Update::Samples(Arc::new(block), period_s));
        }
        if !self.events.is_empty() {
            // Reported before the records of its cycle, an event is dated after them.
            let events = std::mem::take(&mut self.events).into_iter().map(|event| {
                let Event { cycle, axis, text, fault } = event;
                json!({ "t": self.time(cycle), "cycle": cycle, "axis": axis, "text": text, "fault": fault })
            });
            let events: Vec<Value> = events.collect();
            self.say(&json!({ "events": events }));
        }
        if self.status_at.is_none_or(|at| at.elapsed() >= STATUS_EVERY) {
            self.status_at = Some(Instant::now());
            self.say(&json!({ "axes": self.status() }));
        }
    }

    /// When a cycle was, s of the records' clock, by the newest one.
    fn time(&self, cycle: u64) -> f64 {
        let apart = cycle as f64 - self.cycle.index as f64;
        (self.cycle.grid.0 as f64 + apart * self.header.period_ns as f64) / S as f64
    }

    fn status(&self) -> Vec<Value> {
        let status = self.drives.iter().zip(&self.header.axes).map(|(drive, of)| {
            let Some(drive) = drive else { return Value::Null };
            // What it does not report is NaN, and null here.
            json!({
                "link": drive.link.name(),
                "state": drive.state.name(),
                "command": (drive.command != 0).then(|| Command::NAMES.get(usize::from(drive.command))),
                "stopped": drive.stopped.map(|cause| cause.name()),
                "fault": (drive.fault != 0).then(|| of.fault(drive.fault).to_string()),
                "warning": (drive.warning != 0).then(|| format!("{:#06x}", drive.warning)),
                "sto_open": drive.sto_open(),
                "position": drive.reported(drive.position),
                "error": drive.following_error(of.modulo),
            })
        });
        status.collect()
    }

    fn news(&mut self, news: News) {
        let News { lost, dropped, late_count, faults, events, late } = news;
        for Happened { cycle, axis, text, fault } in events {
            self.events.push(Event { cycle, axis: Some(axis), text, fault });
        }
        for (axis, code, name) in faults {
            if let Some(axis) = self.header.axes.get_mut(axis) {
                axis.faults.insert(code, name);
            }
        }
        let late = late.into_iter().map(|late| {
            json!({ "t": self.time(late.cycle), "cycle": late.cycle, "ns": late.delay_ns, "text": late.cause })
        });
        let late: Vec<Value> = late.collect();
        self.say(&json!({ "lost": lost, "dropped": dropped, "late_count": late_count, "late": late }));
    }

    fn say(&self, message: &Value) {
        self.feed.send(Update::Text(message.to_string().into()));
    }
}

// A master that lives says something in time.
const _: () = assert!(NEWS_EVERY.as_millis() * 10 < PATIENCE.as_millis());
