//! A run that never was, for what reads runs.

use std::sync::Arc;

use fieldbeat_core::axis::{Link, State};
use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, Record, Reply, measured, short};
use fieldbeat_core::cycle::status::{DriveEnd, Numbers, Peak};
use fieldbeat_core::cycle::{CyclePlan, Plan};
use fieldbeat_core::rt::Granted;
use fieldbeat_linudp::{LinUdpDrive, LinUdpPlan};
use fieldbeat_telemetry::{Measured, Run};

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
    let mut end = Numbers::default();
    (end.status.planned, end.status.executed, end.status.wake_max) = (cycles, cycles, wake_max);
    let mut drive = DriveEnd::default();
    (drive.name, drive.protocol, drive.peaks.rtt) = (name.to_owned(), "linudp-v2", rtt);
    end.drives = vec![drive];
    let granted =
        Granted { policy: "SCHED_OTHER", priority: 0, core: None, memory_locked: false, missing: Vec::new() };
    Run::new(Arc::new(plan), granted, end, all, None)
}
