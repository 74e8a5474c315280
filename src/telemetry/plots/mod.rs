//! The plots of a run, as parts of a page: SVG that takes the width it has, with its labels next to it, so that they
//! stay readable on a phone. Colours come from the page, light or dark.
//!
//! | file | what |
//! |---|---|
//! | `chart` | what all of them share: axes, curves, marks, legend |
//! | `scale` | from values to places, and the grid |
//! | `wake` | how many cycles began how late |
//! | `percentiles` | quantiles of the loop and of every drive |
//! | `timeline` | the largest values over the time of the run |
//! | `motion` | position, following error and velocity of an axis, and what happened to it |
//!
//! They show what was measured: a curve ends at the last quantile that its sample supports, and a maximum has a mark of
//! its own. A library that draws into a fixed size was in their place before (plotters): its labels shrink with the
//! plot, and its colours are fixed.

pub mod chart;
pub mod motion;
pub mod percentiles;
mod scale;
pub mod timeline;
pub mod wake;

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::Arc;

    use crate::axis::{Feedback, Link, State};
    use crate::bus::linudp::{LinUdpDrive, LinUdpPlan};
    use crate::cycle::record::{CycleRecord, DriveRecord, Record, Reply, measured, short};
    use crate::cycle::status::{DriveEnd, Numbers, Peak, Peaks, Status};
    use crate::cycle::{CyclePlan, Plan};
    use crate::rt::Granted;
    use crate::telemetry::{Measured, Run};

    /// A run of so many cycles, with a tail that grows with the cycle's number.
    pub fn run(name: &str, cycles: u64) -> Run {
        let drives = vec![LinUdpDrive::new(name, [127, 0, 0, 2].into())];
        let plan = Plan {
            source: None,
            cycle: CyclePlan::default(),
            buses: vec![Box::new(LinUdpPlan::new([127, 0, 0, 1].into(), drives))],
            groups: Vec::new(),
        };
        let mut all = Measured::new(&plan.units(), &plan.cycle, false);
        let mut random = fastrand::Rng::with_seed(1);
        let (mut wake_max, mut rtt) = (Peak::default(), Peak::default());
        for index in 0..cycles {
            let wake_ns = (1_500.0 / random.f64().max(1e-4).powf(0.4)) as u64;
            let rtt_ns = 60_000 + 8 * wake_ns;
            wake_max.see(wake_ns, index);
            rtt.see(rtt_ns, index);
            let reply = if index % 1_000 == 999 { Reply::Missed } else { Reply::Answered };
            let (link, state) = (Link::Online, State::OperationEnabled);
            let position = (index as f64 / 300.0).sin() * 40.0;
            let demand = position + 0.01 * wake_ns as f64 / 1_500.0;
            let velocity = (index as f32 / 300.0).cos() * 130.0;
            let moved = DriveRecord { link, state, position, demand, velocity, ..DriveRecord::default() };
            let drive = DriveRecord { index, reply, rtt_ns: measured(rtt_ns), ..moved };
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
            at_end: None,
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
}
