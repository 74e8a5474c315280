//! What led up to it, in words: what changed from cycle to cycle; the last cycles as a table.

mod courses;
mod text;

use std::collections::BTreeMap;

use serde::Serialize;

pub use self::courses::{Course, Row, courses};
pub use self::text::text;
use super::file::{Axis, Header};
use crate::summary::plural;
use fieldbeat_core::axis::{Command, EventKind, Link};
use fieldbeat_core::cycle::record::{
    CycleRecord, DriveRecord, Lateness, Record, ReferenceRecord, Reply, SkippedRecord, Stage,
};
use fieldbeat_core::time::{Ns, S, three_digits};

/// Something that changed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// The cycle.
    pub cycle: u64,
    /// Seconds from the failure; negative before it.
    pub at_s: f64,
    /// The drive; `None` = the loop.
    pub drive: Option<String>,
    /// The event in words; of one that happened several times, the first one.
    pub what: String,
    /// How often.
    pub times: u64,
    /// The cycle of the last time.
    pub until: u64,
    /// The longest delay, ns; null for what is no delay.
    pub worst_ns: Option<u64>,
}

/// The news of a record.
struct News {
    what: String,
    /// A disturbance: its kind, and how long it was, ns. `None` = a change of state.
    disturbance: Option<(&'static str, Option<u64>)>,
}

impl News {
    fn change(what: String) -> News {
        News { what, disturbance: None }
    }

    fn disturbance(kind: &'static str, ns: Option<u64>, what: String) -> News {
        News { what, disturbance: Some((kind, ns)) }
    }
}

/// All that happened, in its order, repetitions in one line. A disturbance (a missed reply, a late wake-up) belongs
/// to the one before of its kind if nothing has changed since then, with its drive or, for the loop, with any: late
/// cycles before a lost link are not those after it. A change belongs to the same one before, on the same side of the
/// failure.
pub fn events(header: &Header, records: &[Record]) -> Vec<Event> {
    let mut known: Vec<Option<DriveRecord>> = vec![None; header.axes.len()];
    let mut found: Vec<Event> = Vec::new();
    let (the_loop, the_reference) = (header.axes.len(), header.axes.len() + 1);
    // What may be repeated: by its axis, or the loop, or what leads its grid, and its kind or its words.
    let mut disturbances: BTreeMap<(usize, &'static str), usize> = BTreeMap::new();
    let mut changed: BTreeMap<(usize, bool, String), usize> = BTreeMap::new();
    let mut led: Option<ReferenceRecord> = None;
    for record in records {
        let (cycle, place, news) = match record {
            Record::Drive(drive) => {
                let axis = usize::from(drive.axis);
                let Some(known) = known.get_mut(axis) else { continue };
                let news = match known.replace(*drive) {
                    Some(known) => changes(&header.axes[axis], &known, drive),
                    None => vec![News::change(format!("{}, {}{}", drive.link, drive.state, running(drive)))],
                };
                (drive.index, axis, news)
            }
            Record::Event(event) => {
                // The records of the drives have all else.
                let Some(EventKind::Emergency(one)) = event.kind() else { continue };
                let axis = usize::from(event.axis);
                let Some(of) = header.axes.get(axis) else { continue };
                (event.index, axis, vec![News::change(one.described(of.fault(one.code.into())))])
            }
            Record::Monitor(_) | Record::Command(_) | Record::Native(_) => continue,
            Record::Reference(now) => {
                let news = steered(header, led.replace(*now).as_ref(), now);
                (now.index, the_reference, news.into_iter().collect())
            }
            Record::Cycle(cycle) => (cycle.index, the_loop, late(header, cycle).into_iter().collect()),
            Record::Skipped(SkippedRecord { first, count, given_up_ns, woke_late, .. }) => {
                let why = if *woke_late { "the loop woke" } else { "the previous cycle ended" };
                let what = format!("{} skipped: {why} {} late", plural(*count, "slot"), short(*given_up_ns));
                (*first, the_loop, vec![News::disturbance("skipped", Some(*given_up_ns), what)])
            }
        };
        for News { what, disturbance } in news {
            let earlier = match disturbance {
                Some((kind, _)) => *disturbances.entry((place, kind)).or_insert(found.len()),
                None => *changed.entry((place, cycle >= header.cycle, what.clone())).or_insert(found.len()),
            };
            let ns = disturbance.and_then(|(_, ns)| ns);
            if let Some(one) = found.get_mut(earlier) {
                (one.times, one.until, one.worst_ns) = (one.times + 1, cycle, one.worst_ns.max(ns));
                continue;
            }
            if disturbance.is_none() {
                disturbances.retain(|(of, _), _| *of != place && *of != the_loop);
            }
            let drive = header.axes.get(place).map(|axis| axis.name.clone());
            let at_s = seconds(header, cycle);
            found.push(Event { cycle, at_s, drive, what, times: 1, until: cycle, worst_ns: ns });
        }
    }
    found
}

/// A span with three significant digits.
fn short(ns: u64) -> Ns {
    Ns(three_digits(ns))
}

fn seconds(header: &Header, cycle: u64) -> f64 {
    (cycle as f64 - header.cycle as f64) * header.period_ns as f64 / S as f64
}

fn running(drive: &DriveRecord) -> String {
    match drive.command {
        0 => String::new(),
        code => format!(", {}", command(code)),
    }
}

fn command(code: u8) -> &'static str {
    Command::NAMES.get(usize::from(code)).copied().unwrap_or(Command::NAMES[0])
}

fn late(header: &Header, cycle: &CycleRecord) -> Option<News> {
    let (kind, ns, what) = match cycle.lateness(header.late_ns, header.deadline_ns)? {
        Lateness::Wake(ns) => ("woke", ns, format!("woke {} late", short(ns))),
        Lateness::Stage(Stage::Receive, ns) => {
            ("receive", ns, format!("received until {} after the deadline", short(ns)))
        }
        Lateness::Stage(stage, ns) => {
            (stage.name(), ns, format!("stage {} took {}", stage.name(), short(ns)))
        }
        // The records of the drives say it.
        Lateness::Reply => return None,
    };
    Some(News::disturbance(kind, Some(ns), what))
}

/// The news of the clock that leads the grid.
fn steered(header: &Header, before: Option<&ReferenceRecord>, now: &ReferenceRecord) -> Option<News> {
    let name = header.reference.as_deref().unwrap_or("its reference");
    let was = before.is_some_and(|before| before.locked);
    let change = |what| Some(News::change(what));
    match (before, now.error_ns) {
        (None, _) if now.locked => change(format!("grid locked to {name}")),
        (None, _) => change(format!("grid not locked to {name}")),
        (_, Some(error_ns)) if was != now.locked => {
            let (what, side) =
                (if was { "lost" } else { "found" }, if error_ns < 0 { "early" } else { "late" });
            change(format!("lock to {name} {what}: {} {side}", short(error_ns.unsigned_abs().into())))
        }
        (_, None) if was != now.locked => change(format!("lock to {name} lost: it is silent")),
        (_, None) => Some(News::disturbance("no phase", None, format!("no phase from {name}"))),
        _ => None,
    }
}

fn changes(axis: &Axis, before: &DriveRecord, now: &DriveRecord) -> Vec<News> {
    let disturbance = |what: &'static str| Some(News::disturbance(what, None, what.to_owned()));
    let disturbance = match now.reply {
        // Probes of an absent drive are no news.
        Reply::Missed if before.link != Link::Lost && before.link != Link::Unseen => disturbance("no reply"),
        Reply::Unsent => disturbance("not sent: no connection, or refused by the operating system"),
        Reply::Suspect => disturbance("the reply may belong to an earlier request"),
        _ => None,
    };
    let mut found = Vec::new();
    if before.command != now.command {
        found.push(match now.command {
            0 => format!("{} ended", command(before.command)),
            code => format!("{} begins", command(code)),
        });
    }
    if before.state != now.state {
        found.push(format!("{} -> {}", before.state, now.state));
    }
    if before.sto_open() != now.sto_open() {
        found.push(format!("hardware enable (STO) {}", if now.sto_open() { "missing" } else { "present" }));
    }
    if before.warning != now.warning {
        found.push(format!("warning {:#06x} -> {:#06x}", before.warning, now.warning));
    }
    if before.fault != now.fault {
        found.push(format!("fault {} -> {}", axis.fault(before.fault), axis.fault(now.fault)));
    }
    if before.link != now.link {
        found.push(format!("link {} -> {}", before.link, now.link));
    }
    if before.stopped != now.stopped {
        found.push(match now.stopped {
            Some(cause) => format!("stopped: {cause}"),
            None => "stop reset".to_owned(),
        });
    }
    disturbance.into_iter().chain(found.into_iter().map(News::change)).collect()
}

#[cfg(test)]
mod tests;
