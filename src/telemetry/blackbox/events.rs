//! What led up to it, in words: what changed from cycle to cycle, and the last cycles as a table.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::num::NonZeroU32;
use std::ops::RangeInclusive;

use serde::Serialize;

use super::file::{Axis, Channel, Header};
use crate::axis::{Command, Link};
use crate::cycle::record::{
    CycleRecord, DriveRecord, Lateness, Record, ReferenceRecord, Reply, SkippedRecord, Stage,
};
use crate::telemetry::summary::{decimals, plain, plural, reported};
use crate::time::{Ns, S, three_digits};

/// Something that changed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// The cycle.
    pub cycle: u64,
    /// Seconds from the failure; negative before it.
    pub at_s: f64,
    /// The drive; `None` = the loop.
    pub drive: Option<String>,
    /// What, in words; of what happened several times, the first one.
    pub what: String,
    /// How often.
    pub times: u64,
    /// The cycle of the last time.
    pub until: u64,
    /// The longest delay, ns; null for what is no delay.
    pub worst_ns: Option<u64>,
}

/// What a record adds.
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

/// A column of names is no wider: formatting panics beyond 65 535.
const WIDEST_NAME: usize = 64;

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
                let mut news = match known.replace(*drive) {
                    Some(known) => changes(&header.axes[axis], &known, drive),
                    None => vec![News::change(format!("{}, {}{}", drive.link, drive.state, running(drive)))],
                };
                let fault = |code| header.axes[axis].fault(code);
                let emergency = drive.emergency().map(|one| one.described(fault(one.code.into())));
                news.extend(emergency.map(News::change));
                (drive.index, axis, news)
            }
            Record::Monitor(_) => continue,
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

/// What is new with the clock that leads the grid.
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
        Reply::Unsent => disturbance("not sent: refused by the operating system"),
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
    if before.inhibited != now.inhibited {
        found.push(format!("hardware enable (STO) {}", if now.inhibited { "missing" } else { "present" }));
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

/// The events as text: what happened, and around the failure the last `cycles` cycles of the loop and of the drives
/// that it happened to.
pub fn text(header: &Header, records: &[Record], cycles: u64) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = write(&mut text, header, records, cycles);
    // The file may be anybody's, and its names are not to steer a terminal.
    text.retain(|c| c == '\n' || !c.is_control());
    text
}

fn write(text: &mut String, header: &Header, records: &[Record], cycles: u64) -> std::fmt::Result {
    let machine = header.machine.as_deref().unwrap_or("a machine built in code");
    writeln!(text, "black box of {machine}, written {} by fieldbeat {}", header.written, header.program)?;
    writeln!(text, "{}, in cycle {} ({} a cycle)", header.why, header.cycle, Ns(header.period_ns))?;
    let host = [&header.kernel, &header.preemption, &header.cpu].map(|fact| fact.as_deref().unwrap_or("?"));
    writeln!(text, "host: {}", host.join(", "))?;
    let [first, last] = [records.first(), records.last()].map(|record| record.map(Record::index));
    let (Some(first), Some(last)) = (first, last) else {
        return writeln!(text, "it holds no cycle");
    };
    writeln!(
        text,
        "cycles {first} ... {last}: {:.3} s before it, {:.3} s after it; {}",
        -seconds(header, first),
        seconds(header, last),
        plural(records.len() as u64, "record")
    )?;
    writeln!(text, "\nwhat happened (0 s: the failure)")?;
    let events = events(header, records);
    let wide = header.axes.iter().map(|axis| axis.name.len()).max().unwrap_or(0).clamp(4, WIDEST_NAME);
    for one in &events {
        let who = one.drive.as_deref().unwrap_or("loop");
        write!(text, "{:>+10.4} s  cycle {:<10} {who:wide$}  {}", one.at_s, one.cycle, one.what)?;
        if one.times > 1 {
            write!(text, " ... {} times until cycle {}", one.times, one.until)?;
            if let Some(worst_ns) = one.worst_ns {
                write!(text, ", at most {}", short(worst_ns))?;
            }
        }
        writeln!(text)?;
    }
    let shown = around(header, cycles);
    let loops = records.iter().filter_map(|record| match record {
        Record::Cycle(cycle) if shown.contains(&cycle.index) => Some(cycle),
        _ => None,
    });
    write!(text, "\nthe loop, us\n{:>12} {:>9}", "cycle", "woke")?;
    for stage in Stage::ALL {
        write!(text, " {:>9}", stage.name())?;
    }
    if header.reference.is_some() {
        write!(text, " {:>9} {:>9}", "phase", "step")?;
    }
    writeln!(text)?;
    let led: BTreeMap<u64, &ReferenceRecord> = (records.iter())
        .filter_map(|record| match record {
            Record::Reference(led) if shown.contains(&led.index) => Some((led.index, led)),
            _ => None,
        })
        .collect();
    for cycle in loops {
        write!(text, "{:>12} {:>9.1}", cycle.index, us(cycle.wake_ns))?;
        for ns in cycle.stages_ns {
            write!(text, " {:>9.1}", us(ns))?;
        }
        if let Some(led) = led.get(&cycle.index) {
            let error = led.error_ns.map_or("-".to_owned(), |ns| format!("{:.1}", f64::from(ns) / 1e3));
            write!(text, " {error:>9} {:>9.1}", f64::from(led.step_ns) / 1e3)?;
        }
        writeln!(text)?;
    }
    courses(header, records, &events, cycles).iter().try_for_each(|course| write_course(text, course))
}

fn write_course(text: &mut String, Course { name, unit, monitor, rows }: &Course) -> std::fmt::Result {
    writeln!(text, "\ndrive {name}, {unit}")?;
    write!(
        text,
        "{:>12} {:>9} {:>9} {:>11} {:>19} {:>12} {:>12} {:>12} {:>9}",
        "cycle", "reply", "RTT us", "link", "state", "position", "demand", "velocity", "current A"
    )?;
    let titles: Vec<String> = (monitor.iter())
        .map(|channel| format!("{} {}", channel.name, channel.unit).trim_end().to_owned())
        .collect();
    let widths: Vec<usize> = titles.iter().map(|title| title.chars().count().clamp(9, WIDEST_NAME)).collect();
    for (title, wide) in titles.iter().zip(&widths) {
        write!(text, " {title:>wide$}")?;
    }
    writeln!(text)?;
    for row in rows {
        let rtt = row.rtt_ns.map_or("-".to_owned(), |ns| format!("{:.1}", us(ns.get())));
        write!(
            text,
            "{:>12} {:>9} {rtt:>9} {:>11} {:>19} {:>12} {:>12} {:>12} {:>9}",
            row.cycle,
            row.reply,
            row.link,
            row.state,
            decimals(row.position, 4),
            decimals(row.demand, 4),
            decimals(row.velocity.map(f64::from), 2),
            decimals(row.current.map(f64::from), 2)
        )?;
        for (value, wide) in row.monitor.iter().zip(&widths) {
            let value = value.map_or("-".to_owned(), |value| plain(value).to_string());
            write!(text, " {value:>wide$}")?;
        }
        writeln!(text)?;
    }
    Ok(())
}

fn us(ns: u32) -> f64 {
    f64::from(ns) / 1e3
}

/// A drive from cycle to cycle.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Course {
    /// Its name.
    pub name: String,
    /// Its user unit.
    pub unit: String,
    /// Its monitored variables.
    pub monitor: Vec<Channel>,
    /// Its cycles.
    pub rows: Vec<Row>,
}

/// A drive in a cycle.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Which.
    pub cycle: u64,
    /// What became of its exchange.
    pub reply: String,
    /// The round trip.
    pub rtt_ns: Option<NonZeroU32>,
    /// The link as judged.
    pub link: String,
    /// State of the drive.
    pub state: String,
    /// Actual position, user units; `None` = the drive reports none, like the three below.
    pub position: Option<f64>,
    /// Demand position, user units.
    pub demand: Option<f64>,
    /// Actual velocity, user units/s.
    pub velocity: Option<f32>,
    /// Motor current, A.
    pub current: Option<f32>,
    /// Its monitored variables, in the order of [`Course::monitor`]; `None` = nothing in this cycle.
    pub monitor: Vec<Option<f64>>,
}

/// The drives that it happened to, from `cycles` cycles before the failure on.
pub fn courses(header: &Header, records: &[Record], events: &[Event], cycles: u64) -> Vec<Course> {
    let shown = around(header, cycles);
    let mut courses: Vec<Option<Course>> = vec![None; header.axes.len()];
    for axis in concerned(header, events, cycles) {
        let of = &header.axes[axis];
        let (name, unit) = (of.name.clone(), of.unit.clone());
        let monitor = of.monitor.iter().flatten().cloned().collect();
        courses[axis] = Some(Course { name, unit, monitor, rows: Vec::new() });
    }
    for record in records.iter().filter(|record| shown.contains(&record.index())) {
        match record {
            Record::Drive(drive) => {
                let Some(Some(course)) = courses.get_mut(usize::from(drive.axis)) else { continue };
                course.rows.push(Row {
                    cycle: drive.index,
                    reply: format!("{:?}", drive.reply).to_lowercase(),
                    rtt_ns: drive.rtt_ns,
                    link: drive.link.to_string(),
                    state: drive.state.to_string(),
                    position: reported(drive.position),
                    demand: reported(drive.demand),
                    velocity: Some(drive.velocity).filter(|velocity| velocity.is_finite()),
                    current: Some(drive.current).filter(|current| current.is_finite()),
                    monitor: vec![None; course.monitor.len()],
                });
            }
            Record::Monitor(of) => {
                let axis = usize::from(of.axis);
                let Some(Some(course)) = courses.get_mut(axis) else { continue };
                let Some(row) = course.rows.last_mut().filter(|row| row.cycle == of.index) else { continue };
                let values = of.shown.values().map(|value| value.and_then(reported));
                let channels = header.axes[axis].monitor.iter().zip(values);
                row.monitor =
                    channels.filter_map(|(channel, value)| channel.as_ref().map(|_| value)).collect();
            }
            Record::Reference(_) | Record::Cycle(_) | Record::Skipped(_) => {}
        }
    }
    courses.into_iter().flatten().collect()
}

/// The cycles that are shown one by one: so many before the failure, and a quarter of that after it.
fn around(header: &Header, cycles: u64) -> RangeInclusive<u64> {
    header.cycle.saturating_sub(cycles)..=header.cycle.saturating_add(cycles / 4)
}

/// The drives to which something happened around the failure; all of them if it was to none.
fn concerned(header: &Header, events: &[Event], cycles: u64) -> Vec<usize> {
    let until = |one: &Event| one.until.saturating_add(1).saturating_add(cycles);
    let near = |one: &Event| until(one) > header.cycle && one.cycle <= header.cycle;
    let met = |axis: &usize| {
        events.iter().any(|one| near(one) && one.drive.as_ref() == Some(&header.axes[*axis].name))
    };
    let some: Vec<usize> = (0..header.axes.len()).filter(met).collect();
    if some.is_empty() { (0..header.axes.len()).collect() } else { some }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::{Emergency, State, StopCause};
    use crate::cycle::record::MonitorRecord;
    use crate::time::MS;

    fn machine() -> (Header, Vec<Record>) {
        let axis = |name: &str| Axis { name: name.into(), unit: "mm".into(), ..Axis::default() };
        let header = Header {
            why: "drive x: link lost".into(),
            cycle: 103,
            period_ns: MS,
            deadline_ns: MS / 2,
            late_ns: MS / 10,
            axes: vec![axis("x"), axis("long")],
            ..Header::default()
        };
        let mut records = Vec::new();
        for index in 96..106 {
            for axis in 0..2 {
                let mut drive = DriveRecord {
                    index,
                    axis,
                    reply: Reply::Answered,
                    link: Link::Online,
                    state: State::OperationEnabled,
                    command: 7,
                    ..DriveRecord::default()
                };
                if axis == 0 && index > 99 {
                    drive.reply = Reply::Missed;
                    if index >= 103 {
                        (drive.link, drive.stopped, drive.command) =
                            (Link::Lost, Some(StopCause::LinkLost), 0);
                    }
                }
                records.push(Record::Drive(drive));
            }
            let wake_ns = if index == 99 { 412_000 } else { 5_000 };
            records.push(Record::Cycle(CycleRecord { index, wake_ns, ..CycleRecord::default() }));
        }
        (header, records)
    }

    #[test]
    fn what_leads_the_grid_is_reported_when_it_changes_and_its_silence_once() {
        let (mut header, _) = machine();
        header.reference = Some("line".into());
        let mut records = Vec::new();
        for index in 90..106 {
            let (error_ns, locked) = match index {
                0..=91 => (Some(-20_000), false),
                95..=97 => (None, true),
                103.. => (Some(250_000), false),
                _ => (Some(300), true),
            };
            let step_ns = if index == 104 { -10_000 } else { 0 };
            records.push(Record::Reference(ReferenceRecord {
                index,
                error_ns,
                step_ns,
                locked,
                counts: true,
            }));
            records.push(Record::Cycle(CycleRecord { index, wake_ns: 412_000, ..CycleRecord::default() }));
        }
        let events = events(&header, &records);
        let of_line = events.iter().filter(|one| one.what.contains("line"));
        let found: Vec<_> = of_line.map(|one| (one.cycle, one.times, one.what.as_str())).collect();
        let expected = [
            (90, 1, "grid not locked to line"),
            (92, 1, "lock to line found: 300 ns late"),
            (95, 3, "no phase from line"),
            (103, 1, "lock to line lost: 250 us late"),
        ];
        assert_eq!(found, expected);
        // The late wake-ups are counted between the changes of the lock.
        let woke = events.iter().filter(|one| one.what.starts_with("woke"));
        let counted: Vec<_> = woke.map(|one| (one.cycle, one.times, one.until)).collect();
        assert_eq!(counted, [(90, 2, 91), (92, 11, 102), (103, 3, 105)]);
        let text = text(&header, &records, 8);
        assert!(text.lines().any(|line| line.ends_with("phase      step")), "{text}");
        assert!(
            text.lines()
                .any(|line| line.trim_start().starts_with("104 ") && line.ends_with("250.0     -10.0"))
        );
    }

    #[test]
    fn the_way_to_a_lost_link_is_reported_in_its_order() {
        let (header, records) = machine();
        let found: Vec<String> = events(&header, &records)
            .into_iter()
            .map(|one| {
                format!(
                    "{} {} {} x{}",
                    one.cycle,
                    one.drive.as_deref().unwrap_or("loop"),
                    one.what,
                    one.times
                )
            })
            .collect();
        assert_eq!(
            found,
            [
                "96 x online, OperationEnabled, follow x1",
                "96 long online, OperationEnabled, follow x1",
                "99 loop woke 412 us late x1",
                "100 x no reply x4",
                "103 x follow ended x1",
                "103 x link online -> lost x1",
                "103 x stopped: link lost x1",
            ]
        );
    }

    #[test]
    fn the_tables_show_the_drive_it_happened_to() {
        let (header, records) = machine();
        let text = text(&header, &records, 4);
        assert!(text.contains("drive x, mm") && !text.contains("drive long, mm"), "{text}");
        assert!(text.contains("   -0.0040 s  cycle 99         loop  woke 412 us late"), "{text}");
        assert!(text.contains("no reply ... 4 times until cycle 103\n"), "{text}");
    }

    #[test]
    fn repetitions_are_one_line_with_their_number_their_end_and_the_worst_of_them() {
        let (header, _) = machine();
        let mut records = Vec::new();
        // Every other reply of x is missing, long warns now and then, and the loop wakes later and later.
        for index in 60..100 {
            let reply = if index % 2 == 0 { Reply::Missed } else { Reply::Answered };
            let warning = u32::from(index % 4 == 3);
            let link = Link::Online;
            let x = DriveRecord { index, link, reply, ..DriveRecord::default() };
            let long = DriveRecord { index, link, axis: 1, warning, ..DriveRecord::default() };
            let cycle = CycleRecord { index, wake_ns: 1_000 * index as u32, ..CycleRecord::default() };
            records.extend([Record::Drive(x), Record::Drive(long)]);
            if index > 80 {
                records.push(Record::Cycle(CycleRecord { wake_ns: 4 * cycle.wake_ns, ..cycle }));
            }
        }
        let text = text(&header, &records, 0);
        for line in [
            "cycle 62         x     no reply ... 19 times until cycle 98\n",
            "cycle 63         long  warning 0x0000 -> 0x0001 ... 10 times until cycle 99\n",
            "cycle 81         loop  woke 324 us late ... 19 times until cycle 99, at most 396 us\n",
        ] {
            assert!(text.contains(line), "no {line}{text}");
        }
    }

    #[test]
    fn what_a_drive_does_not_tell_is_a_dash_and_null() {
        let (header, mut records) = machine();
        for record in &mut records {
            let Record::Drive(drive) = record else { continue };
            (drive.position, drive.demand, drive.velocity, drive.current) =
                (f64::NAN, f64::NAN, 2.5, f32::NAN);
        }
        let text = text(&header, &records, 4);
        let row = text.lines().rfind(|line| line.contains("missed")).unwrap();
        let columns: Vec<&str> = row.split_whitespace().rev().take(4).collect();
        assert_eq!((columns, text.contains("NaN")), (vec!["-", "2.50", "-", "-"], false), "{text}");
        let json = serde_json::to_value(courses(&header, &records, &[], 4)).unwrap();
        let row = &json[0]["rows"][0];
        let [position, demand, current] = ["position", "demand", "current"].map(|key| row[key].is_null());
        assert!(position && demand && current && row["velocity"] == 2.5, "{row}");
    }

    #[test]
    fn a_fault_of_the_records_has_its_name_from_the_header() {
        let (mut header, mut records) = machine();
        header.axes[1].faults.insert(30, "watchdog".into());
        for record in &mut records {
            match record {
                Record::Drive(drive) if drive.index > 101 && drive.axis == 1 => drive.fault = 30,
                Record::Drive(drive) if drive.index > 101 => drive.fault = 999,
                _ => {}
            }
        }
        let found: Vec<String> = events(&header, &records).into_iter().map(|one| one.what).collect();
        for what in ["fault none -> 0x001e (30, watchdog)", "fault none -> 0x03e7 (999)"] {
            assert!(found.iter().any(|found| found == what), "{found:?}");
        }
    }

    #[test]
    fn an_emergency_is_reported_by_its_name_when_it_came() {
        let (mut header, mut records) = machine();
        header.axes[0].faults.insert(0x4310, "motor temperature".into());
        for record in &mut records {
            if let Record::Drive(drive @ DriveRecord { axis: 0, index: 98 | 100, .. }) = record {
                let code = if drive.index == 98 { 0x4310 } else { 0 };
                drive.emergency = Some(Emergency { code, register: 8 }.into());
            }
        }
        let found: Vec<_> = events(&header, &records)
            .into_iter()
            .filter(|one| one.what.starts_with("emergency"))
            .map(|one| (one.cycle, one.what))
            .collect();
        let words = [
            "emergency 0x4310 (17168, motor temperature), register 0x08",
            "emergency: error over, register 0x08",
        ];
        assert_eq!(found, [(98, words[0].to_owned()), (100, words[1].to_owned())]);
    }

    #[test]
    fn an_empty_one_says_so() {
        let (header, _) = machine();
        assert!(text(&header, &[], 4).contains("it holds no cycle"));
    }

    #[test]
    fn any_number_and_any_name_can_be_shown() {
        let (mut header, mut records) = machine();
        let name = "\x1b[2J".repeat(20_000);
        header.axes[0].monitor[2] = Some(Channel { name: name.clone(), unit: "\x07".into() });
        header.axes[1].name = name;
        let shown = [Some(f64::MAX), Some(f64::NAN), Some(f64::MIN), None].into();
        records.insert(1, Record::Monitor(MonitorRecord { index: 96, axis: 0, shown }));
        for cycle in [0, 103, u64::MAX] {
            header.cycle = cycle;
            for record in &mut records {
                match record {
                    Record::Drive(DriveRecord { index, .. })
                    | Record::Monitor(MonitorRecord { index, .. }) => {
                        *index = (*index).max(cycle);
                    }
                    _ => {}
                }
            }
            for cycles in [0, 4, u64::MAX] {
                let text = text(&header, &records, cycles);
                assert!(text.contains("drive x, mm") && !text.contains('\x1b') && !text.contains("NaN"));
            }
        }
    }
}
