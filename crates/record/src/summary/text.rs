//! The text of a run. The alternate form shows in colour what went wrong.

use std::fmt;

use super::numbers::us;
use super::{Bus, CycleNumbers, Drive, Summary, decimals, plural};
use crate::style::{BAD, paint};
use crate::table::{Cell, Table};
use fieldbeat_core::cycle::status::DeviceEnd;
use fieldbeat_core::time::{Ns, S, US, three_digits};
use fieldbeat_telemetry::histograms::Quantity;
use fieldbeat_telemetry::signals::{POSITION, ROUND_TRIP, TIME, WAKE, kept_of_loop, shown};

/// As text; the alternate form shows in colour what went wrong. Drives come first: where a terminal has few lines, they
/// are what it shows.
impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let CycleNumbers { period_ns, planned, executed, skipped, overruns, .. } = self.cycle;
        writeln!(
            f,
            "{} of {}: planned {planned} = executed {executed} + skipped {skipped}, {}",
            plural(executed, "cycle"),
            Ns(period_ns),
            plural(overruns, "overrun")
        )?;
        if !self.drives.is_empty() {
            self.drive_table(f)?;
        }
        self.bus_lines(f)?;
        writeln!(f)?;
        self.loop_table(f)?;
        self.late_lines(f)?;
        writeln!(f)?;
        self.realtime_lines(f)
    }
}

impl Summary {
    /// The drives in at most 80 columns, if their names are short. Counts that are 0 for all of them have no column.
    fn drive_table(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        type Count = (&'static str, fn(&Drive) -> u64);
        const RARE: [Count; 5] = [
            ("late", |drive| drive.late),
            ("dupl.", |drive| drive.duplicate),
            ("reject", |drive| drive.rejected),
            ("implaus.", |drive| drive.implausible),
            ("unsent", |drive| drive.unsent),
        ];
        let seen = RARE.into_iter().filter(|(_, count)| self.drives.iter().any(|drive| count(drive) > 0));
        let seen: Vec<Count> = seen.collect();
        let mut titles = vec!["drive", "state", "sent", "answered", "missed"];
        titles.extend(seen.iter().map(|(title, _)| title));
        titles.extend(["RTT p50", "p99", "max", POSITION.name]);
        let mut table = Table::new(&titles, 2..titles.len(), " ");
        for (drive, units) in self.drives.iter().zip(&self.units) {
            let state = if drive.is_online() { &drive.state } else { &drive.link };
            let is_bad = drive.fault.is_some() || drive.losses > 0 || drive.stopped_by().is_some();
            let mut row = vec![
                Cell::plain(&drive.name),
                Cell::new(state, is_bad),
                Cell::plain(drive.sent),
                Cell::plain(drive.answered),
                Cell::new(drive.missed, drive.missed > 0),
            ];
            row.extend(seen.iter().map(|(_, count)| count(drive)).map(|count| Cell::new(count, count > 0)));
            row.extend([drive.rtt_ns.p50, drive.rtt_ns.p99, drive.rtt_ns.max].map(|ns| Cell::plain(us(ns))));
            let unit = drive.position.map_or(String::new(), |_| format!(" {}", units.unit));
            row.push(Cell::plain(decimals(drive.position, 3) + &unit));
            table.row(row);
        }
        writeln!(f, "\ndrives; {} times (RTT) in {TIME}", ROUND_TRIP.name)?;
        let mut lines = table.lines(f.alternate()).into_iter();
        writeln!(f, "{}", lines.next().unwrap_or_default())?;
        for (line, drive) in lines.zip(&self.drives) {
            writeln!(f, "{line}")?;
            for note in drive.notes() {
                writeln!(f, "  {}", paint(&note, BAD, f.alternate()))?;
            }
        }
        let wide = self.drives.iter().map(|drive| drive.name.len()).max().unwrap_or(0).max(5);
        for drive in self.drives.iter().filter(|drive| drive.protocol_counters.are_any()) {
            writeln!(f, "{:wide$} {}", drive.name, drive.protocol_counters)?;
        }
        for drive in &self.drives {
            for variable in &drive.monitor {
                writeln!(f, "{:wide$} {variable}", drive.name)?;
            }
        }
        Ok(())
    }

    fn bus_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Bus { name, unmatched, dropped, receive_errors, .. } in &self.buses {
            if unmatched + dropped + receive_errors > 0 {
                writeln!(
                    f,
                    "bus {name}: {} from unknown senders, {} dropped by the kernel (receive buffer full), {}",
                    plural(*unmatched, "datagram"),
                    plural(*dropped, "datagram"),
                    plural(*receive_errors, "receive error")
                )?;
            }
        }
        for Bus { name, load_percent, .. } in &self.buses {
            if let Some(percent) = load_percent {
                writeln!(f, "bus {name}: bus load {percent:.1} %")?;
            }
        }
        // The clock that leads the grid is with the loop.
        for bus in &self.buses {
            if let Some(clock) = bus.clock.as_ref().filter(|clock| !clock.leads) {
                writeln!(f, "bus {}: its clock {clock}", bus.name)?;
            }
        }
        for DeviceEnd { name, not_operational, protocol_counters, .. } in &self.devices {
            match not_operational {
                Some(why) => {
                    let line = format!("device {name}: not in operation: {why}");
                    writeln!(f, "{}", paint(&line, BAD, f.alternate()))?;
                }
                None => writeln!(f, "device {name}: in operation")?,
            }
            if protocol_counters.are_any() {
                writeln!(f, "device {name}: {protocol_counters}")?;
            }
        }
        Ok(())
    }

    /// Wake-up latency, jitter and stages in one unit.
    fn loop_table(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let title = format!("loop, times in {TIME}");
        let mut table = Table::new(&[&title, "p50", "p99", "p99.9", "max"], 1..5, "  ");
        let reference = self.cycle.reference.as_ref().map(|led| &led.error_ns);
        for (kept, stage, of) in kept_of_loop([&self.wake_ns, &self.jitter_ns], reference, &self.stages_ns.0)
        {
            let mut row = vec![Cell::plain(kept.title(stage))];
            row.extend([of.p50, of.p99, of.p99_9, of.max].map(|ns| Cell::plain(us(ns))));
            table.row(row);
        }
        for line in table.lines(f.alternate()) {
            writeln!(f, "{line}")?;
        }
        if let Some(reference) = &self.cycle.reference {
            writeln!(f, "{reference}")?;
        }
        let most = self.wake_bars.iter().map(|(_, count)| *count).max().unwrap_or(0);
        if most > 0 {
            writeln!(f, "\n{} in {TIME}, cycles (bars: log scale)", WAKE.name)?;
        }
        for (end, count) in &self.wake_bars {
            // Logarithmic: the rare late ones are what a reader looks for.
            let width = (40.0 * (*count as f64).ln_1p() / (most as f64).ln_1p()).ceil() as usize;
            let bin = format!("< {}", shown(*end as f64));
            writeln!(f, "{}", format!("  {bin:>9} {count:>9} {}", "#".repeat(width)).trim_end())?;
        }
        Ok(())
    }

    fn late_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let late = &self.late;
        writeln!(f, "\n{} late by more than {}", plural(late.count, "cycle"), Ns(late.threshold_ns))?;
        for found in &late.causes {
            let worst =
                found.worst_ns.map_or(String::new(), |ns| format!(", at most {}", Ns(three_digits(ns))));
            writeln!(f, "  {:>9}  {found}{worst} (cycle {})", found.count, found.worst_cycle)?;
        }
        Ok(())
    }

    fn realtime_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let real = &self.realtime;
        let core = real.core.map_or(String::from("any core"), |core| format!("core {core}"));
        let priority = if real.priority > 0 { format!(" {}", real.priority) } else { String::new() };
        let locked = if real.memory_locked { "memory locked" } else { "memory not locked" };
        let counted = |count: Option<u64>, what| {
            count.map_or_else(|| format!("{what}s not known"), |count| plural(count, what))
        };
        writeln!(
            f,
            "loop: {}{priority} on {core}, {locked}; {}, {}; {} and {} lost",
            real.policy,
            counted(real.page_faults, "page fault"),
            counted(real.involuntary_switches, "preemption"),
            plural(real.telemetry_lost, "telemetry record"),
            plural(real.events_lost, "event")
        )?;
        let host = &self.host;
        let [kernel, preemption, cpu] =
            [&host.kernel, &host.preemption, &host.cpu].map(|fact| fact.as_deref().unwrap_or("?"));
        let steal = host.steal_ms.map_or(String::from("?"), |steal| steal.to_string());
        write!(f, "host: {kernel}, {preemption}, {cpu}; steal {steal} ms; ")?;
        writeln!(f, "other threads had the loop's core for {} ms", host.taken_ms)?;
        for recorded in &self.recordings {
            let is_bad = recorded.failure().is_some();
            writeln!(f, "{}", paint(&recorded.to_string(), BAD, is_bad && f.alternate()))?;
        }
        for written in &self.black_boxes {
            writeln!(f, "{written}")?;
        }
        for failure in &self.failures {
            writeln!(f, "{}", paint(&failure.what, BAD, f.alternate()))?;
        }
        if !real.missing.is_empty() {
            writeln!(f, "These numbers are not real-time:")?;
            for line in &real.missing {
                writeln!(f, "  {line}")?;
            }
        }
        let carried = &self.carried;
        writeln!(f, "{}", paint(&carried.to_string(), BAD, !carried.carried && f.alternate()))
    }
}

/// The wake-ups in bins that double: each bin's upper end, ns, and its count.
pub(super) fn bars(wake: &Quantity) -> Vec<(u64, u64)> {
    let mut bars = Vec::new();
    let (mut low, mut high) = (0, US / 4);
    while low <= wake.max() && low < S {
        bars.push((high, wake.count_between(low, high - 1)));
        (low, high) = (high, high * 2);
    }
    while bars.first().is_some_and(|(_, count)| *count == 0) {
        bars.remove(0);
    }
    bars
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::Link;
    use fieldbeat_core::bus::{OwnCounter, ProtocolCounters};

    #[test]
    fn devices_have_their_state_and_the_counters_above_zero() {
        let mut summary = Summary::from(&fieldbeat_testing::runs::run("axis-1", 10));
        let own = ["al_errors", "emergencies_lost"].map(|key| OwnCounter { key, what: key });
        let device = |name: &str, not_operational, counts: [u64; 2]| {
            let mut device = DeviceEnd::default();
            (device.name, device.not_operational) = (name.into(), not_operational);
            device.protocol_counters = ProtocolCounters(own.into_iter().zip(counts).collect());
            device
        };
        summary.devices = vec![device("io", Some("no power".to_owned()), [0, 3]), device("di", None, [0, 0])];
        let text = summary.to_string();
        let lines: Vec<&str> = text.lines().filter(|line| line.starts_with("device ")).collect();
        let expected = [
            "device io: not in operation: no power",
            "device io: emergencies_lost: 3",
            "device di: in operation",
        ];
        assert_eq!(lines, expected, "{text}");
        let json = serde_json::to_value(&summary).unwrap();
        assert_eq!(json["devices"][0]["protocol_counters"]["emergencies_lost"], 3, "{json}");
    }

    #[test]
    fn the_drives_come_first_and_fit_80_columns() {
        let mut summary = Summary::from(&fieldbeat_testing::runs::run("axis-1", 2_000));
        let drive = summary.drives[0].clone();
        let (state, sent) = (String::from("OperationEnabled"), 9_999_999);
        let usual = Drive {
            link: Link::Online.to_string(),
            state,
            sent,
            answered: sent,
            position: Some(-1234.5),
            ..drive.clone()
        };
        let lost = Drive { missed: 1, losses: 1, link: Link::Lost.to_string(), position: None, ..drive };
        let fault = Drive { fault: Some(5), ..usual.clone() };
        summary.units = vec![summary.units[0]; 3];
        summary.drives = vec![usual, lost, fault];
        let text = summary.to_string();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "2000 cycles of 1 ms: planned 2000 = executed 2000 + skipped 0, 0 overruns");
        let titles: Vec<&str> = lines[3].split_whitespace().collect();
        let expected = "drive state sent answered missed RTT p50 p99 max position";
        assert_eq!(titles.join(" "), expected, "{text}");
        assert!(lines[4].starts_with("axis-1 OperationEnabled 9999999  9999999      0 "), "{text}");
        assert!(lines[4].ends_with(" -1234.500 mm") && lines[5].ends_with(" -"), "{text}");
        assert_eq!(lines[7], "  fault 0x0005 (5)");
        assert!(lines[..20].iter().all(|line| line.chars().count() <= 80), "{text}");
        // A count that is 0 for all of them has no column.
        assert!(!text.contains("dupl."), "{text}");
        summary.drives[0].duplicate = 1;
        assert!(summary.to_string().contains(" missed dupl. RTT p50 "), "{summary}");
        // Colours in the alternate form only.
        assert!(!text.contains('\x1b'), "{text:?}");
        let styled = format!("{summary:#}");
        assert!(styled.contains("\x1b[31mlost\x1b[0m"), "{styled}");
        assert!(styled.contains("  \x1b[1m\x1b[31mfault 0x0005 (5)\x1b[0m\n"), "{styled:?}");
    }
}
