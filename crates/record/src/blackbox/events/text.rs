//! A black box as text: what happened, and the last cycles as tables.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::courses::around;
use super::{Course, courses, events, seconds, short};
use crate::blackbox::file::Header;
use crate::summary::{decimals, plain, plural};
use fieldbeat_core::cycle::record::{Record, ReferenceRecord, Stage};
use fieldbeat_core::time::Ns;

/// A column of names is no wider: formatting panics beyond 65 535.
const WIDEST_NAME: usize = 64;

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
