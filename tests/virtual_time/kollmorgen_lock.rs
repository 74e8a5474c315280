//! The grid follows the clock of a line: over the real bus, the whole bring-up included, and with every slot looked at
//! from the first sample on.
//!
//! A frame that leaves at a slot of the grid passes the reference a while later, and there `ahead_of_sync_ns` are left
//! to SYNC0.

use std::sync::{Arc, Mutex};

use fieldbeat::axis::Link;
use fieldbeat::bus::Cycle;
use fieldbeat::bus::ethercat::object::Family;
use fieldbeat::bus::ethercat::sim::EthercatSim;
use fieldbeat::bus::ethercat::wire::registers::AlState;
use fieldbeat::bus::ethercat::{EthercatPlan, KollmorgenDrive};
use fieldbeat::cycle::status::ReferenceStatus;
use fieldbeat::cycle::{CyclePlan, Plan};
use fieldbeat::master::Master;
use fieldbeat::sim::world::WorldOptions;
use fieldbeat::simulation::Simulation;
use fieldbeat::time::{MS, S, Time, US};

const LINE: &str = "local:line";
/// The reference is set and has stood still for so long; then it is locked.
const LOCKED_WITHIN_NS: u64 = 2 * S;
const WITHIN_NS: i64 = 5 * US as i64;
/// Other clocks of the line keep to the reference.
const TOGETHER_NS: i64 = 1_000;

/// A line whose clocks drift, under a grid that follows the first of them.
struct Led {
    sim: Simulation,
    /// The slots, as an application sees them.
    seen: Arc<Mutex<Vec<Cycle>>>,
    period_ns: u64,
    ahead_ns: u64,
    drift_ppm: Vec<f64>,
    /// From a slot until a frame that was sent there passes the reference, ns.
    way_ns: u64,
}

impl Led {
    fn new(period_ns: u64, ahead_ns: Option<u64>, drift_ppm: &[f64]) -> Led {
        let drive = |(place, _)| KollmorgenDrive::new(format!("d{place}"), place, Family::S700);
        let mut line = EthercatPlan::new(LINE, (0..).zip(drift_ppm).map(drive).collect());
        line.simulate.drift_ppm = drift_ppm.to_vec();
        line.ahead_of_sync_ns = ahead_ns;
        let delay_ns = line.simulate.delay_ns;
        let cycle = CyclePlan { period_ns, reference: Some(line.name.clone()), ..CyclePlan::default() };
        let plan = Plan { source: None, cycle, buses: vec![Box::new(line)], groups: Vec::new() };
        let seen = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&seen);
        // Each wake-up is late by another bit.
        let options = WorldOptions { wake_ns: (period_ns / 10).min(40 * US), ..WorldOptions::default() };
        let way_ns = options.latency_ns + delay_ns;
        let sim = Master::from_plan(plan)
            .with_task(move |cycle, _| log.lock().unwrap().push(*cycle))
            .simulate(options)
            .unwrap();
        let ahead_ns = ahead_ns.unwrap_or(period_ns / 2);
        Led { sim, seen, period_ns, ahead_ns, drift_ppm: drift_ppm.to_vec(), way_ns }
    }

    fn reference(&self) -> ReferenceStatus {
        self.sim.status().reference.unwrap()
    }

    fn newest(&self) -> Cycle {
        *self.seen.lock().unwrap().last().unwrap()
    }

    fn look<R>(&self, look: impl FnOnce(&mut EthercatSim, Time) -> R) -> R {
        self.sim.world().look(LINE, look).unwrap()
    }

    /// How late the newest slot is by the reference, ns.
    fn error(&self) -> i64 {
        let (passes, period) = (self.newest().grid + self.way_ns, self.period_ns as i64);
        let shown = self.look(|line, now| {
            let since = now.0.wrapping_sub(passes.0) as i64 as f64 * (1.0 + self.drift_ppm[0] * 1e-6);
            line.slave(0).unwrap().line_time(now).wrapping_sub(since.round() as i64 as u64)
        });
        let late = (shown as i64 + self.ahead_ns as i64).rem_euclid(period);
        if late > period / 2 { late - period } else { late }
    }

    /// How far the clock of each other slave is from the reference, ns.
    fn apart(&self) -> Vec<i64> {
        self.look(|line, now| {
            let times: Vec<_> =
                (0..self.drift_ppm.len()).map(|n| line.slave(n).unwrap().line_time(now)).collect();
            times.iter().map(|time| time.wrapping_sub(times[0]) as i64).collect()
        })
    }

    /// How much earlier than wanted SYNC0 of each slave is, seen from a frame that leaves at the newest slot, ns.
    fn syncs(&self) -> Vec<i64> {
        let (passes, period) = (self.newest().grid + self.way_ns, self.period_ns as i64);
        self.look(|line, now| {
            let off = |n| {
                let next = now + line.slave(n).unwrap().sync0_in_ns(now).expect("SYNC0 is on");
                let ahead = (next.0.wrapping_sub(passes.0) as i64 - self.ahead_ns as i64).rem_euclid(period);
                if ahead > period / 2 { ahead - period } else { ahead }
            };
            (0..self.drift_ppm.len()).map(off).collect()
        })
    }

    fn run_until(&mut self, most_ns: u64, what: &str, done: impl Fn(&Led) -> bool) {
        let end = self.sim.world().now() + most_ns;
        while !done(self) {
            assert!(self.sim.world().now() < end, "not {what}: {:?}", self.reference());
            self.sim.step();
        }
    }

    fn run_for(&mut self, ns: u64, mut each: impl FnMut(&Led)) {
        let end = self.sim.world().now() + ns;
        while self.sim.world().now() < end {
            self.sim.step();
            each(self);
        }
    }

    /// No slot is a hundredth of the period off a period behind the one before it.
    fn assert_steps(&self) {
        for pair in self.seen.lock().unwrap().windows(2) {
            let slots = pair[1].index - pair[0].index;
            let step = pair[1].grid.since(pair[0].grid).abs_diff(slots * self.period_ns);
            assert!(step <= self.period_ns / 100, "{pair:?}");
        }
    }
}

/// Brings the line up and looks at every slot from the first sample on.
fn lock(period_ns: u64, ahead_ns: Option<u64>, drift_ppm: &[f64]) {
    let what = format!("{period_ns} ns, {drift_ppm:?} ppm");
    let mut led = Led::new(period_ns, ahead_ns, drift_ppm);
    led.run_until(5 * S, "seen", |led| led.reference().samples > 0);
    led.run_for(LOCKED_WITHIN_NS, |_| {});
    led.run_for(S / 2, |led| {
        let error = led.error();
        assert!(error.abs() <= WITHIN_NS, "{what}: {error} ns off");
    });
    assert!(led.reference().locked && led.reference().losses == 0, "{what}: {:?}", led.reference());
    let slaves = led.drift_ppm.len();
    led.run_until(20 * S, "online", |led| (0..slaves).all(|n| led.sim.feedback(n).link == Link::Online));
    led.run_for(S / 2, |led| {
        let error = led.error();
        assert!(error.abs() <= WITHIN_NS, "{what}: {error} ns off");
        for (n, apart) in led.apart().into_iter().enumerate() {
            assert!(apart.abs() <= TOGETHER_NS, "{what}: slave {n} is {apart} ns off");
        }
        for (n, off) in led.syncs().into_iter().enumerate() {
            assert!(off.abs() <= WITHIN_NS + TOGETHER_NS, "{what}: SYNC0 of slave {n} is {off} ns off");
        }
    });
    led.assert_steps();
    let reference = led.reference();
    assert!(
        reference.locked && reference.losses == 0 && reference.silent < reference.samples,
        "{reference:?}"
    );
    assert!(reference.step_max.ns <= period_ns / 100, "{what}: {reference:?}");
    for n in 0..slaves {
        let state = led.look(|line, _| line.slave(n).unwrap().state());
        assert_eq!((state, led.sim.feedback(n).age), (AlState::Op, 0), "{what}: slave {n}");
    }
    // What woke up late is not what it follows.
    assert!(led.sim.status().jitter_max.ns > period_ns.min(400 * US) / 40, "{:?}", led.sim.status());
}

#[test]
fn a_reference_that_runs_fast_or_slow_leads_the_grid_at_every_period() {
    for period_ns in [250 * US, MS, 4 * MS] {
        for ppm in [100.0, -100.0] {
            lock(period_ns, None, &[ppm]);
        }
    }
}

#[test]
fn clocks_that_drift_against_the_reference_keep_to_it_and_so_does_sync0() {
    for period_ns in [250 * US, MS, 4 * MS] {
        lock(period_ns, Some(period_ns / 3), &[100.0, -100.0, 30.0, 0.0]);
        lock(period_ns, None, &[-100.0, 100.0, 0.0]);
    }
}
