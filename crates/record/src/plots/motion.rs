//! How one axis moved: position and demand, following error, velocity, each as the extremes of every step of time; and
//! what happened to it.

use super::chart::Chart;
use super::scale::Scale;
use crate::archive::{Archive, Drive};
use crate::compare::significant;
use crate::summary::plural;
use fieldbeat_core::time::Ns;
use fieldbeat_telemetry::motion::{Band, Happened, Mark, Moved};

/// A quantity of a stretch.
type Quantity = fn(&Moved) -> Option<Band>;

/// The plots of a drive's axis; empty if it reported nothing.
pub fn plot(run: &Archive, drive: &Drive) -> String {
    let (unit, name) = (&drive.unit, &drive.name);
    let axis = Axis { run, drive };
    let mut plots = String::new();
    let position: [(Quantity, _, _); 2] =
        [(Moved::demand, "c4 thick", "demand position"), (Moved::position, "c0", "actual position")];
    plots += &axis.plot(&format!("position-{name}"), &format!("position ({unit})"), &position);
    let error: [(Quantity, _, _); 1] = [(Moved::error, "c1", "following error: demand less actual")];
    plots += &axis.plot(&format!("error-{name}"), &format!("following error ({unit})"), &error);
    let velocity: [(Quantity, _, _); 1] = [(Moved::velocity, "c2", "actual velocity")];
    plots += &axis.plot(&format!("velocity-{name}"), &format!("velocity ({unit}/s)"), &velocity);
    plots
}

struct Axis<'a> {
    run: &'a Archive,
    drive: &'a Drive,
}

impl Axis<'_> {
    fn plot(&self, id: &str, title: &str, quantities: &[(Quantity, &str, &str)]) -> String {
        let (run, motion) = (self.run, &self.drive.motion);
        let stretches = motion.stretches();
        let bands = || quantities.iter().flat_map(|(of, ..)| stretches.iter().filter_map(*of));
        if bands().next().is_none() {
            return String::new();
        }
        let values = bands().flat_map(|Band { low, high }| [f64::from(low), f64::from(high)]);
        let y = Scale::around(values, 4, title);
        let (time, unit_ns) = Scale::run(run.length_ns());
        let step = motion.width() as f64 * run.period_ns as f64 / unit_ns;
        let mut chart = Chart::new(time, y, 150);
        for Mark { cycle, what } in motion.marks.iter() {
            let at_ns = cycle * run.period_ns;
            let class = if what.is_trouble() { "alarm" } else { "quiet" };
            let words = format!("{} at {}", happened(self.drive, what), Ns(at_ns));
            chart.event(class, at_ns as f64 / unit_ns, &words);
        }
        for (of, class, what) in quantities {
            for (first, row) in unbroken(stretches, *of) {
                let points: Vec<(f64, f64, f64)> = (row.iter().enumerate())
                    .map(|(place, Band { low, high })| {
                        // The middle of the step; the last one may be cut off by the end.
                        let middle = step * ((first + place) as f64 + 0.5);
                        (middle, f64::from(*low), f64::from(*high))
                    })
                    .collect();
                chart.band(class, &points);
            }
            if quantities.len() > 1 {
                chart.explain(class, what);
            }
        }
        chart.finish(id, "")
    }
}

/// What happened, in words.
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
            "largest following error {} {} after {}",
            significant(largest.value),
            drive.unit,
            Ns(largest.cycle * period_ns)
        ),
        None => "no following error: the drive reports no positions, or was never enabled".to_owned(),
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
