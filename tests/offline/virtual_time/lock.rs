//! The grid follows the clock of a segment: over the real bus, the whole bring-up included, and with every slot looked
//! at from the first sample on. What leads the grid, and what is beside it.
//!
//! A frame that leaves at a slot of the grid passes the reference a while later, and there `ahead_of_sync_ns` are left
//! to SYNC0.

use std::sync::{Arc, Mutex};

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::sim::{FaultPlan, SimPlan, WorldOptions};
use fieldbeat::telemetry::{BusClock, ReferenceStatus, Summary};
use fieldbeat::time::{MS, S, Time, US};
use fieldbeat::{Cycle, CyclePlan, Master, Plan, Simulation};
use fieldbeat_core::rt::Granted;
use fieldbeat_sim::ethercat::{AlState, EthercatSegment, EthercatSim};

use super::support::drive;

/// The reference is set and has stood still for so long; then it is locked.
const LOCKED_WITHIN_NS: u64 = 2 * S;
const WITHIN_NS: i64 = 5 * US as i64;
/// Other clocks of a segment keep to its first one.
const TOGETHER_NS: i64 = 1_000;
/// Drives allow a cycle of 1 ms that is off by so much (EtherCAT manual).
const WINDOW_NS: i64 = 320 * US as i64;

/// Segments whose clocks drift, under a grid that follows the first clock of the first of them.
struct Led {
    sim: Simulation,
    /// The slots, as an application sees them.
    seen: Arc<Mutex<Vec<Cycle>>>,
    period_ns: u64,
    ahead_ns: u64,
    /// Of each drive, by segment.
    drift_ppm: Vec<Vec<f64>>,
    /// From a slot until a frame that was sent there passes the first slave, ns.
    way_ns: u64,
}

/// The interface of a segment.
fn interface(number: usize) -> String {
    format!("local:line{number}")
}

fn segment(number: usize, drift_ppm: &[f64], ahead_ns: Option<u64>) -> EthercatSegment {
    let drive = |(place, _)| KollmorgenDrive::new(format!("d{number}{place}"), place, Family::S700);
    let mut line = EthercatPlan::new(interface(number), (0..).zip(drift_ppm).map(drive).collect());
    line.name = format!("line{number}");
    line.ahead_of_sync_ns = ahead_ns;
    let mut line = EthercatSegment::from(line);
    line.settings.drift_ppm = drift_ppm.to_vec();
    line
}

fn plan(period_ns: u64, reference: Option<&str>, buses: Vec<Box<dyn BusPlan>>) -> Plan {
    let cycle = CyclePlan { period_ns, reference: reference.map(str::to_owned), ..CyclePlan::default() };
    Plan { cycle, buses, ..Plan::default() }
}

impl Led {
    fn new(period_ns: u64, ahead_ns: Option<u64>, drift_ppm: &[f64]) -> Led {
        Led::beside(period_ns, ahead_ns, &[drift_ppm], Vec::new())
    }

    /// Several segments, and other buses behind them.
    fn beside(
        period_ns: u64,
        ahead_ns: Option<u64>,
        drift_ppm: &[&[f64]],
        others: Vec<Box<dyn BusPlan>>,
    ) -> Led {
        let lines = drift_ppm.iter().enumerate().map(|(number, ppm)| segment(number, ppm, ahead_ns));
        let lines: Vec<_> = lines.collect();
        let delay_ns = lines[0].settings.delay_ns;
        let mut drives = SimPlan::of(&others);
        drives.buses.extend(lines.iter().map(|line| Box::new(line.clone()) as _));
        let lines = lines.into_iter().map(|line| Box::new(line.plan) as Box<dyn BusPlan>);
        let plan = plan(period_ns, Some("line0"), lines.chain(others).collect());
        let seen = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&seen);
        // Each wake-up is late by another bit.
        let options = WorldOptions { wake_ns: (period_ns / 10).min(40 * US), ..WorldOptions::default() };
        let way_ns = options.latency_ns + delay_ns;
        let sim = Master::from_plan(plan)
            .with_task(move |cycle, _| log.lock().unwrap().push(*cycle))
            .with_simulation(drives)
            .simulate(options)
            .unwrap();
        let ahead_ns = ahead_ns.unwrap_or(period_ns / 2);
        let drift_ppm = drift_ppm.iter().map(|ppm| ppm.to_vec()).collect();
        Led { sim, seen, period_ns, ahead_ns, drift_ppm, way_ns }
    }

    fn reference(&self) -> ReferenceStatus {
        self.sim.status().reference.unwrap()
    }

    fn newest(&self) -> Cycle {
        *self.seen.lock().unwrap().last().unwrap()
    }

    fn look<R>(&self, line: usize, look: impl FnOnce(&mut EthercatSim, Time) -> R) -> R {
        self.sim.world().look(&interface(line), look).unwrap()
    }

    /// A time that is off by whole periods, as the shortest way.
    fn off(&self, ns: i64) -> i64 {
        let period = self.period_ns as i64;
        let off = ns.rem_euclid(period);
        if off > period / 2 { off - period } else { off }
    }

    /// How late the newest slot is by the first clock of a segment, ns.
    fn error(&self, line: usize) -> i64 {
        let passes = self.newest().grid + self.way_ns;
        let shown = self.look(line, |slaves, now| {
            let since = now.0.wrapping_sub(passes.0) as i64 as f64 * (1.0 + self.drift_ppm[line][0] * 1e-6);
            slaves.slave(0).unwrap().system_time(now).wrapping_sub(since.round() as i64 as u64)
        });
        self.off(shown as i64 + self.ahead_ns as i64)
    }

    /// How far the clock of each slave is from that of the first one, ns.
    fn apart(&self) -> Vec<i64> {
        self.look(0, |line, now| {
            let times: Vec<_> =
                (0..self.drift_ppm[0].len()).map(|n| line.slave(n).unwrap().system_time(now)).collect();
            times.iter().map(|time| time.wrapping_sub(times[0]) as i64).collect()
        })
    }

    /// How much earlier than wanted SYNC0 of each slave is, seen from a frame that leaves at the newest slot, ns.
    fn syncs(&self) -> Vec<i64> {
        let passes = self.newest().grid + self.way_ns;
        self.look(0, |line, now| {
            let off = |n| {
                let next = now + line.slave(n).unwrap().sync0_in_ns(now).expect("SYNC0 is on");
                self.off(next.0.wrapping_sub(passes.0) as i64 - self.ahead_ns as i64)
            };
            (0..self.drift_ppm[0].len()).map(off).collect()
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

    /// All drives of all segments.
    fn online(&mut self) {
        let drives = self.drift_ppm.iter().map(Vec::len).sum();
        self.run_until(20 * S, "online", |led| (0..drives).all(|n| led.sim.feedback(n).link == Link::Online));
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

/// Brings the segment up and looks at every slot from the first sample on.
fn lock(period_ns: u64, ahead_ns: Option<u64>, drift_ppm: &[f64]) {
    let what = format!("{period_ns} ns, {drift_ppm:?} ppm");
    let mut led = Led::new(period_ns, ahead_ns, drift_ppm);
    led.run_until(5 * S, "seen", |led| led.reference().samples > 0);
    led.run_for(LOCKED_WITHIN_NS, |_| {});
    let close = |led: &Led| {
        let error = led.error(0);
        assert!(error.abs() <= WITHIN_NS, "{what}: {error} ns off");
    };
    led.run_for(S / 2, close);
    assert!(led.reference().locked && led.reference().losses == 0, "{what}: {:?}", led.reference());
    led.online();
    led.run_for(S / 2, |led| {
        close(led);
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
    for n in 0..drift_ppm.len() {
        let state = led.look(0, |line, _| line.slave(n).unwrap().state());
        assert_eq!((state, led.sim.feedback(n).age), (AlState::Op, 0), "{what}: slave {n}");
    }
    // What woke up late is not what it follows.
    assert!(led.sim.status().jitter_max.ns > period_ns.min(400 * US) / 40, "{:?}", led.sim.status());
}

#[test]
fn clocks_that_drift_against_the_reference_keep_to_it_and_so_does_sync0() {
    for period_ns in [250 * US, MS, 4 * MS] {
        lock(period_ns, Some(period_ns / 3), &[100.0, -100.0, 30.0, 0.0]);
        lock(period_ns, None, &[-100.0, 100.0, 0.0]);
    }
}

/// The clock of the first segment leads the grid, that of the second one follows it. Each has clocks of its own, and
/// both stay inside of what their drives allow.
#[test]
fn a_segment_that_leads_and_one_that_follows_come_up_and_stay_in_their_windows() {
    for ppm in [[20.0, -80.0], [-100.0, 100.0], [50.0, 0.0]] {
        let mut led = Led::beside(MS, None, &[&[ppm[0], ppm[0] + 7.0], &[ppm[1], ppm[1] + 7.0]], Vec::new());
        led.online();
        for index in 0..4 {
            led.sim.execute(index, Command::Enable, 2_000).unwrap().expect("it ends");
        }
        let worst = Mutex::new([0; 2]);
        led.run_for(5 * S, |led| {
            for (line, worst) in worst.lock().unwrap().iter_mut().enumerate() {
                *worst = led.error(line).abs().max(*worst);
            }
        });
        let worst = worst.into_inner().unwrap();
        assert!(worst.iter().all(|worst| *worst <= WINDOW_NS / 2), "{ppm:?}: {worst:?} ns");
        let status = led.reference();
        assert!(status.locked && status.losses == 0 && status.error_ns.abs() <= WITHIN_NS, "{status:?}");
        let operational: Vec<_> = (0..4).map(|index| led.sim.feedback(index)).collect();
        assert!(
            operational.iter().all(|one| one.is_operational() && one.status.fault == 0),
            "{operational:#?}"
        );
        // Each segment reports how far the grid is from where its drives want it.
        for (clock, worst) in led.sim.finish().clocks.into_iter().zip(worst) {
            let BusClock { error_ns, locked, error_max_ns, window_ns } = clock.expect("it has a clock");
            assert!(locked && window_ns == WINDOW_NS as u64);
            let error = error_ns.expect("it is seen");
            assert!(error.abs() <= WINDOW_NS / 2 && error.unsigned_abs() <= error_max_ns, "{error}");
            // Since its lock, which may have been before the first drive was in OP.
            assert!(error_max_ns + 2_000 >= worst as u64, "{error_max_ns} and {worst} ns");
        }
    }
}

#[test]
fn frames_that_are_lost_and_slots_that_are_skipped_steer_nothing() {
    let mut led = Led::new(MS, None, &[100.0]);
    led.run_until(5 * S, "locked", |led| led.reference().locked);
    assert!(
        led.sim.world().set_segment_faults(&interface(0), FaultPlan { drop: 0.2, ..FaultPlan::default() })
    );
    let mut random = fastrand::Rng::with_seed(1);
    for turn in 0..8_000 {
        if turn % 50 == 7 {
            led.sim.world().delay_next_wake(random.u64(0..4 * MS));
        }
        led.sim.step();
        assert!(led.error(0).abs() <= WITHIN_NS, "{} ns", led.error(0));
    }
    led.assert_steps();
    let (status, reference) = (*led.sim.status(), led.reference());
    assert!(status.skipped > 20 && reference.silent > 100, "{status:?}");
    assert_eq!(reference.samples + reference.silent, status.executed);
    assert!(reference.locked && reference.losses == 0, "{reference:?}");
}

#[test]
fn without_a_reference_the_grid_follows_no_clock() {
    let segment = segment(0, &[500.0], None);
    let plan = plan(MS, None, vec![Box::new(segment.plan.clone())]);
    let mut sim = Master::from_plan(plan).with_simulation(segment).simulate(WorldOptions::default()).unwrap();
    sim.run(5_000);
    assert_eq!(sim.status().reference, None);
    assert!(sim.measured().histograms.reference.is_empty());
}

#[test]
fn drives_of_another_bus_are_requested_on_the_led_grid() {
    let drives = LinUdpPlan::new([10, 0, 0, 1].into(), (0..3).map(drive).collect());
    let mut led = Led::beside(MS, None, &[&[100.0]], vec![Box::new(drives)]);
    led.run_for(3 * S, |_| {});
    assert_eq!(led.sim.status().skipped, 0);
    for drive in &led.sim.finish().drives[1..] {
        assert_eq!((drive.feedback.link, drive.losses, drive.counters.missed), (Link::Online, 0, 0));
        // What is owed at the end is the one exchange that the last cycle may have left.
        assert!(drive.counters.sent - drive.counters.answered <= 1 && drive.counters.sent > 2_900);
        assert!(drive.peaks.send_jitter.ns <= 100 * US + US, "{:?}", drive.peaks);
    }
}

#[test]
fn the_summary_says_who_leads_and_how_well() {
    let mut led = Led::new(MS, None, &[100.0]);
    led.run_for(5 * S, |_| {});
    let (measured, reference) = (led.sim.measured().clone(), led.reference());
    // What the records said is what the loop has counted.
    let phase = &measured.histograms.reference;
    let (max, exact) = (phase.max(), reference.error_max.ns);
    assert!(phase.len() <= reference.samples && max.abs_diff(exact) * 500 <= max, "{max} of {exact}");
    let numbers = led.sim.finish();
    let plan = plan(MS, Some("line0"), vec![Box::new(segment(0, &[100.0], None).plan)]);
    let granted = Granted { policy: "", priority: 0, core: None, memory_locked: false, missing: Vec::new() };
    let summary = Summary::of(&plan, &numbers, &measured, &granted, None);
    let json = serde_json::to_value(&summary).unwrap();
    let reported = &json["cycle"]["reference"];
    assert_eq!((reported["bus"].as_str(), reported["locked"].as_bool()), (Some("line0"), Some(true)));
    for (key, count) in
        [("samples", reference.samples), ("silent", reference.silent), ("step_max_ns", reference.step_max.ns)]
    {
        assert_eq!(reported[key].as_u64(), Some(count), "{reported}");
    }
    assert_eq!(reported["error_ns"]["max"].as_u64(), Some(reference.error_max.ns));
    let count = reported["error_ns"]["count"].as_u64().unwrap();
    assert!(count < reference.samples, "what was before the lock is not in it");
    assert!(
        summary.to_string().contains("\ngrid synchronised to bus line0: locked, largest step "),
        "{summary}"
    );
}

#[test]
fn a_reference_that_cannot_lead_is_refused_with_one_line() {
    let drives = || Box::new(LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive(0)])) as Box<dyn BusPlan>;
    let line = |number| Box::new(segment(number, &[0.0], None).plan) as Box<dyn BusPlan>;
    let namesake = Box::new(EthercatPlan { name: "line0".into(), ..segment(1, &[0.0], None).plan });
    let linudp = drives().name().to_owned();
    let none = "no bus of this machine has one: leave reference out";
    for (buses, reference, refused) in [
        (vec![drives(), line(0)], "line0", None),
        (
            vec![drives(), line(0), line(1)],
            "lime",
            Some("reference = \"lime\" is not a bus; name one that has: line0, line1".to_owned()),
        ),
        (
            vec![drives()],
            &*linudp,
            Some(format!("reference = {linudp:?}: a linudp-v2 bus has no clock that can lead; {none}")),
        ),
        (
            vec![line(0), namesake],
            "line0",
            Some("reference = \"line0\" names 2 buses; give each its own name".to_owned()),
        ),
    ] {
        let checked = plan(MS, Some(reference), buses).check().map_err(|errors| errors.to_string());
        assert_eq!(checked.err(), refused.map(|why| format!("cycle: {why}")));
    }
    let refused = Master::from_plan(plan(MS, Some("line"), vec![drives()])).start().unwrap_err().to_string();
    assert_eq!(refused.lines().count(), 1, "{refused}");
}

#[test]
fn a_drive_alone_keeps_the_reference_only_if_it_is_on_that_bus() {
    let drive = drive(0);
    let name = drive.axis.name.clone();
    let linudp = LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive]);
    let plan = plan(MS, Some("line0"), vec![Box::new(linudp), Box::new(segment(0, &[0.0], None).plan)]);
    let alone = plan.alone(&name).unwrap();
    assert_eq!((alone.cycle.reference.as_ref(), alone.check()), (None, Ok(())));
    assert_eq!(plan.reaching(&name).unwrap().check(), Ok(()));
    assert_eq!(plan.alone("d00").unwrap().cycle.reference.as_deref(), Some("line0"));
}
