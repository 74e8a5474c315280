//! How one axis moved: position and demand, following error, velocity, each as the extremes of every step of time; and
//! what happened to it.

use super::chart::Chart;
use super::scale::Scale;
use crate::archive::{Archive, Drive};
use crate::compare::significant;
use crate::summary::plural;
use fieldbeat_core::drive::record::DriveRecord;
use fieldbeat_core::time::Ns;
use fieldbeat_telemetry::motion::{Band, Happened, Mark, Moved};
use fieldbeat_telemetry::signals::{FOLLOWING_ERROR, POSITION, Signal, VELOCITY};

/// A quantity of a stretch.
type Quantity = fn(&Moved) -> Option<Band>;

/// A curve: its quantity, its class, and its adjective.
type Curve = (Quantity, &'static str, &'static str);

/// The plots: what each shows.
const PLOTS: [(Signal<DriveRecord>, &[Curve]); 3] = [
    (POSITION, &[(Moved::demand, "c4 thick", "demand"), (Moved::position, "c0", "actual")]),
    (FOLLOWING_ERROR, &[(Moved::error, "c1", "")]),
    (VELOCITY, &[(Moved::velocity, "c2", "actual")]),
];

/// The plots of a drive's axis; empty if it reported nothing.
pub fn plot(run: &Archive, drive: &Drive) -> String {
    PLOTS.iter().map(|(of, curves)| plot_of(run, drive, of, curves)).collect()
}

fn plot_of(run: &Archive, drive: &Drive, of: &Signal<DriveRecord>, curves: &[Curve]) -> String {
    let motion = &drive.motion;
    let stretches = motion.stretches();
    let bands = || curves.iter().flat_map(|(quantity, ..)| stretches.iter().filter_map(*quantity));
    if bands().next().is_none() {
        return String::new();
    }
    let values = bands().flat_map(|Band { low, high }| [f64::from(low), f64::from(high)]);
    let y = Scale::around(values, 4, of.title(&drive.unit));
    let (time, unit_ns) = Scale::run(run.length_ns());
    let step = motion.width() as f64 * run.period_ns as f64 / unit_ns;
    let mut chart = Chart::new(time, y, 150);
    for Mark { cycle, what } in motion.marks.iter() {
        let at_ns = cycle * run.period_ns;
        let class = if what.is_trouble() { "alarm" } else { "quiet" };
        let words = format!("{} at {}", happened(drive, what), Ns(at_ns));
        chart.event(class, at_ns as f64 / unit_ns, &words);
    }
    for (quantity, class, what) in curves {
        for (first, row) in unbroken(stretches, *quantity) {
            let points: Vec<(f64, f64, f64)> = (row.iter().enumerate())
                .map(|(place, Band { low, high })| {
                    // The middle of the step; the last one may be cut off by the end.
                    let middle = step * ((first + place) as f64 + 0.5);
                    (middle, f64::from(*low), f64::from(*high))
                })
                .collect();
            chart.band(class, &points);
        }
        if curves.len() > 1 {
            chart.explain(class, &format!("{what} {}", of.name));
        }
    }
    chart.finish(&format!("{}-{}", of.name.replace(' ', "-"), drive.name), "")
}

/// The event in words.
pub fn happened(drive: &Drive, what: &Happened) -> String {
    match what {
        Happened::Online => "online".to_owned(),
        Happened::Lost => "link lost".to_owned(),
        Happened::State(state) => state.clone(),
        Happened::Fault(code) => match drive.fault_names.get(code) {
            Some(name) => format!("fault {code:#06x} ({code}, {name})"),
            None => format!("fault {code:#06x} ({code})"),
        },
        Happened::Stopped(cause) => format!("stopped: {cause}"),
    }
}

/// One line for the axis: how far off it was, and what happened to it.
pub fn facts(drive: &Drive, period_ns: u64) -> String {
    let marks = &drive.motion.marks;
    let error = match drive.motion.error_max {
        Some(largest) => format!(
            "largest {} {} {} after {}",
            FOLLOWING_ERROR.name,
            significant(largest.value),
            drive.unit,
            Ns(largest.cycle * period_ns)
        ),
        None => {
            format!("no {}: the drive reports no positions, or was never enabled", FOLLOWING_ERROR.name)
        }
    };
    let times = |count, what| if count > 0 { format!("; {}", plural(count, what)) } else { String::new() };
    let lost = if drive.losses > 0 {
        format!("; link lost {}", plural(drive.losses, "time"))
    } else {
        String::new()
    };
    format!("{error}{lost}{}{}", times(marks.faults(), "fault"), times(marks.stops(), "stop"))
}

/// Rows of stretches in which the quantity was seen: the place of the first, and the bands.
fn unbroken(stretches: &[Moved], of: Quantity) -> Vec<(usize, Vec<Band>)> {
    let mut rows: Vec<(usize, Vec<Band>)> = Vec::new();
    for (place, moved) in stretches.iter().enumerate() {
        match (of(moved), rows.last_mut()) {
            (None, _) => {}
            (Some(band), Some((first, row))) if *first + row.len() == place => row.push(band),
            (Some(band), _) => rows.push((place, vec![band])),
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_is_not_bridged() {
        let band = Band { low: 1.0, high: 2.0 };
        let seen = Moved::from([None, None, None, Some(band)]);
        let none = Moved::default();
        let stretches = [none, seen, seen, none, none, seen];
        let rows = unbroken(&stretches, Moved::velocity);
        assert_eq!(rows, [(1, vec![band, band]), (5, vec![band])]);
        assert_eq!(unbroken(&stretches, Moved::position), []);
    }
}
