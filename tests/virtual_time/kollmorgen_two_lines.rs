//! Two lines in one machine: the clock of the first one leads the grid, that of the second one follows it. Each has
//! quartzes of its own, and both stay inside of what their drives bear.

use std::sync::{Arc, Mutex};

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::Cycle;
use fieldbeat::bus::ethercat::object::Family;
use fieldbeat::bus::ethercat::sim::EthercatSim;
use fieldbeat::bus::ethercat::wire::registers::AlState;
use fieldbeat::bus::ethercat::{EthercatPlan, KollmorgenDrive};
use fieldbeat::bus::{BusClock, BusPlan};
use fieldbeat::cycle::{CyclePlan, Plan};
use fieldbeat::master::Master;
use fieldbeat::sim::world::WorldOptions;
use fieldbeat::simulation::Simulation;
use fieldbeat::time::{MS, S, Time, US};

const LINES: [&str; 2] = ["local:first", "local:second"];
const DRIVES: usize = 2;
/// Drives bear a cycle of 1 ms that is off by so much (EtherCAT manual).
const WINDOW_NS: i64 = 320 * US as i64;

struct Pair {
    sim: Simulation,
    newest: Arc<Mutex<Cycle>>,
    drift_ppm: [f64; 2],
    /// From a slot until a frame that was sent there passes the reference, ns.
    way_ns: u64,
}

impl Pair {
    /// `drift_ppm`: of each line; the other drives of a line run beside its first one.
    fn new(drift_ppm: [f64; 2]) -> Pair {
        let line = |number: usize| {
            let drive =
                |place: usize| KollmorgenDrive::new(format!("d{number}{place}"), place as u16, Family::S700);
            let mut line = EthercatPlan::new(LINES[number], (0..DRIVES).map(drive).collect());
            line.name = format!("line{number}");
            line.simulate.drift_ppm = vec![drift_ppm[number], drift_ppm[number] + 7.0];
            line
        };
        let lines = [line(0), line(1)];
        let delay_ns = lines[0].simulate.delay_ns;
        let cycle = CyclePlan { reference: Some("line0".into()), ..CyclePlan::default() };
        let buses = lines.map(|line| Box::new(line) as Box<dyn BusPlan>).into();
        let plan = Plan { source: None, cycle, buses, groups: Vec::new() };
        let newest =
            Arc::new(Mutex::new(Cycle { index: 0, grid: Time(0), period_ns: MS, deadline: Time(0) }));
        let log = Arc::clone(&newest);
        let options = WorldOptions { wake_ns: 40 * US, ..WorldOptions::default() };
        let way_ns = options.latency_ns + delay_ns;
        let sim = Master::from_plan(plan)
            .with_task(move |cycle, _| *log.lock().unwrap() = *cycle)
            .simulate(options)
            .unwrap();
        Pair { sim, newest, drift_ppm, way_ns }
    }

    fn look<R>(&self, line: usize, look: impl FnOnce(&mut EthercatSim) -> R) -> R {
        self.sim.world().look(LINES[line], |line, _| look(line)).unwrap()
    }

    fn are_all(&self, state: AlState) -> bool {
        let all = |line: &mut EthercatSim| {
            (0..DRIVES).all(|place| line.slave(place).is_some_and(|slave| slave.state() == state))
        };
        self.look(0, all) && self.look(1, all)
    }

    /// How late the newest slot is by the clock of the first slave of a line, ns.
    fn error(&self, line: usize) -> i64 {
        let passes = self.newest.lock().unwrap().grid + self.way_ns;
        let (now, drift) = (self.sim.world().now(), self.drift_ppm[line]);
        let since = now.0.wrapping_sub(passes.0) as i64 as f64 * (1.0 + drift * 1e-6);
        let time = self.look(line, |line| line.slave(0).unwrap().line_time(now));
        let shown = time.wrapping_sub(since.round() as i64 as u64);
        let late = (shown + MS / 2) % MS;
        if late > MS / 2 { late as i64 - MS as i64 } else { late as i64 }
    }
}

fn both_come_up_and_stay(drift_ppm: [f64; 2]) {
    let mut pair = Pair::new(drift_ppm);
    let mut turns = 0;
    while !pair.are_all(AlState::Op) {
        pair.sim.step();
        turns += 1;
        assert!(turns < 10_000, "{drift_ppm:?}: {:?}", pair.sim.status().reference);
    }
    for index in 0..2 * DRIVES {
        assert!(pair.sim.run_until(500, |sim| sim.feedback(index).link == Link::Online));
        pair.sim.run_verb(index, Command::Enable, 2_000).unwrap().expect("it ends");
    }
    let mut worst = [0; 2];
    let end = pair.sim.world().now() + 5 * S;
    while pair.sim.world().now() < end {
        pair.sim.step();
        for (line, worst) in worst.iter_mut().enumerate() {
            *worst = pair.error(line).abs().max(*worst);
        }
    }
    assert!(worst.iter().all(|worst| *worst <= WINDOW_NS / 2), "{drift_ppm:?}: {worst:?} ns");
    assert!(pair.are_all(AlState::Op), "nobody fell");
    let status = pair.sim.status().reference.unwrap();
    assert!(status.locked && status.losses == 0 && status.error_ns.abs() <= 5 * US as i64, "{status:?}");
    let operational: Vec<_> = (0..2 * DRIVES).map(|index| pair.sim.feedback(index)).collect();
    assert!(operational.iter().all(|one| one.is_operational() && one.status.fault == 0), "{operational:#?}");

    // Each line tells how far the grid is from where its drives want it.
    let told = pair.sim.finish();
    for (clock, worst) in told.clocks.into_iter().zip(worst) {
        let BusClock { error_ns, locked, error_max_ns, window_ns } = clock.expect("it has a clock");
        assert!(locked && window_ns == WINDOW_NS as u64);
        let error = error_ns.expect("it is seen");
        assert!(error.abs() <= WINDOW_NS / 2 && error.unsigned_abs() <= error_max_ns, "{error}");
        // Since its lock, which may have been before the first drive was in OP.
        assert!(error_max_ns + 2_000 >= worst as u64, "{error_max_ns} and {worst} ns");
    }
}

#[test]
fn a_line_that_leads_and_one_that_follows_come_up_and_stay_in_their_windows() {
    for drift_ppm in [[20.0, -80.0], [-100.0, 100.0], [50.0, 0.0]] {
        both_come_up_and_stay(drift_ppm);
    }
}
