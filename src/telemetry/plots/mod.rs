//! The plots of a run, as SVG.
//!
//! | file | what |
//! |---|---|
//! | `sheet` | what all of them share: the page, its facts about run and host, axes, legend |
//! | `wake` | how many cycles began how late |
//! | `percentiles` | quantiles of the loop and of every drive |
//! | `timeline` | the largest values over the time of the run |
//!
//! They show what was measured: a curve ends at the last quantile that its sample supports, a maximum has a mark of its
//! own, and lost records are named.

mod percentiles;
mod sheet;
mod timeline;
mod wake;

use thiserror::Error;

use super::summary::{Run, Summary};

/// A plot could not be drawn.
#[derive(Error)]
#[error("cannot draw it: {0}")]
pub struct PlotError(String);
crate::errors::debug_as_display!(PlotError);

impl<E: std::error::Error + Send + Sync> From<plotters::drawing::DrawingAreaErrorKind<E>> for PlotError {
    fn from(error: plotters::drawing::DrawingAreaErrorKind<E>) -> PlotError {
        PlotError(error.to_string())
    }
}

/// Every plot of a run: its file name, and its SVG. `summary` is that of the run.
pub fn all(run: &Run, summary: &Summary) -> Result<[(&'static str, String); 4], PlotError> {
    Ok([
        ("wake.svg", wake::plot(run, summary)?),
        ("percentiles.svg", percentiles::of_the_run(run, summary)?),
        ("rtt.svg", percentiles::of_the_drives(run, summary)?),
        ("timeline.svg", timeline::plot(run, summary)?),
    ])
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::axis::Feedback;
    use crate::bus::linudp::{LinUdpDrive, LinUdpPlan};
    use crate::cycle::record::{CycleRecord, DriveRecord, Record, Reply, measured, short};
    use crate::cycle::status::{DriveEnd, Numbers, Peak, Peaks, Status};
    use crate::cycle::{CyclePlan, Plan};
    use crate::rt::Granted;
    use crate::telemetry::Measured;

    /// A run of so many cycles, with a tail that grows with the cycle's number.
    pub fn run(name: &str, cycles: u64) -> Run {
        let drives = vec![LinUdpDrive::new(name, [127, 0, 0, 2].into())];
        let plan = Plan {
            source: None,
            cycle: CyclePlan::default(),
            buses: vec![Box::new(LinUdpPlan::new([127, 0, 0, 1].into(), drives))],
            groups: Vec::new(),
        };
        let mut all = Measured::new(1, &plan.cycle, false);
        let mut random = fastrand::Rng::with_seed(1);
        let (mut wake_max, mut rtt) = (Peak::default(), Peak::default());
        for index in 0..cycles {
            let wake_ns = (1_500.0 / random.f64().max(1e-4).powf(0.4)) as u64;
            let rtt_ns = 60_000 + 8 * wake_ns;
            wake_max.see(wake_ns, index);
            rtt.see(rtt_ns, index);
            let reply = if index % 1_000 == 999 { Reply::Missed } else { Reply::Answered };
            let drive = DriveRecord { index, reply, rtt_ns: measured(rtt_ns), ..DriveRecord::default() };
            all.enter(&Record::Drive(drive));
            let (wake_ns, stages_ns) = (short(wake_ns), [9_000, short(rtt_ns), 500, 400, 700, 900]);
            all.enter(&Record::Cycle(CycleRecord { index, wake_ns, stages_ns, ..CycleRecord::default() }));
        }
        let status = Status { planned: cycles, executed: cycles, wake_max, ..Status::default() };
        let end = DriveEnd {
            name: name.to_owned(),
            protocol: "linudp-v2",
            feedback: Feedback::default(),
            not_connected: None,
            counters: Default::default(),
            losses: 0,
            peaks: Peaks { rtt, ..Peaks::default() },
            monitor: Default::default(),
        };
        Run {
            end: Numbers { status, drives: vec![end], ..Numbers::default() },
            measured: all,
            granted: Granted {
                policy: "SCHED_OTHER",
                priority: 0,
                core: None,
                memory_locked: false,
                missing: Vec::new(),
            },
            plan: Arc::new(plan),
            steal_ms: None,
        }
    }

    /// Every text of a plot.
    fn texts(svg: &str) -> String {
        let document = roxmltree::Document::parse(svg).unwrap();
        let texts = document.descendants().filter(|node| node.has_tag_name("text"));
        texts.map(|node| node.text().unwrap_or_default().trim().to_owned() + "\n").collect()
    }

    #[test]
    fn what_these_numbers_are_worth_stands_on_every_plot() {
        let mut run = run("x", 2_000);
        let lines = ["These numbers are not real-time", "3 telemetry records lost"];
        for (name, svg) in all(&run, &run.summary()).unwrap() {
            assert!(lines.iter().all(|line| !texts(&svg).contains(line)), "{name}");
        }
        run.granted.missing = vec![String::from("no right for SCHED_FIFO")];
        run.end.status.lost_records = 3;
        for (name, svg) in all(&run, &run.summary()).unwrap() {
            assert!(lines.iter().all(|line| texts(&svg).contains(line)), "{name}: {}", texts(&svg));
        }
    }

    #[test]
    fn a_plot_of_nothing_is_drawn_too() {
        let run = run("x", 0);
        for (_, svg) in all(&run, &run.summary()).unwrap() {
            assert!(texts(&svg).contains("0 cycles"), "{}", texts(&svg));
        }
    }

    #[test]
    fn the_maximum_is_marked_with_its_cycle() {
        let run = run("x", 2_000);
        let max = run.end.status.wake_max;
        let [(_, wake), ..] = all(&run, &run.summary()).unwrap();
        let mark = format!("max {} in cycle {}", crate::time::Ns(max.ns), max.index);
        assert!(texts(&wake).contains(&mark), "{mark}: {}", texts(&wake));
    }
}
