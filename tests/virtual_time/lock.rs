//! The grid follows the clock of a bus: locked from any phase, in small steps, and with nothing else of the cycle
//! disturbed.

use std::any::Any;
use std::collections::VecDeque;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex};

use fieldbeat::axis::acyclic::{AcyclicEnds, Notation};
use fieldbeat::axis::{AxisPlan, Link, MonitorChannel, PlanFault};
use fieldbeat::bus::desired::Capabilities;
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::bus::{Bus, BusPlan, Cycle, OpenError, Slot, Unmatched};
use fieldbeat::cycle::status::ReferenceStatus;
use fieldbeat::cycle::{CyclePlan, Overrun, Plan};
use fieldbeat::master::{Master, MasterError};
use fieldbeat::net::Carriers;
use fieldbeat::rt::{Granted, Regions};
use fieldbeat::sim::SimDrive;
use fieldbeat::sim::world::{World, WorldOptions};
use fieldbeat::simulation::Simulation;
use fieldbeat::telemetry::Summary;
use fieldbeat::time::{MS, S, Time, US};

use super::support::drive;

/// A clock on a bus, beside the one of the world.
struct Clocked {
    /// Where the bus looks when it is, once there is a world.
    world: Option<World>,
    ppm: f64,
    /// It begins so far behind the begin of the world, ns.
    phase_ns: u64,
    /// Where in its period it wants a slot.
    target_ns: u64,
    /// In which slots it is not seen.
    lost: Box<dyn Fn(u64) -> bool + Send>,
    /// What is added to what is seen in a slot.
    wrong: Box<dyn Fn(u64) -> i64 + Send>,
    /// An answer is taken in so many cycles later.
    later: usize,
    leads: u64,
    asked: u64,
}

impl Default for Clocked {
    fn default() -> Clocked {
        Clocked {
            world: None,
            ppm: 0.0,
            phase_ns: 0,
            target_ns: 100 * US,
            lost: Box::new(|_| false),
            wrong: Box::new(|_| 0),
            later: 0,
            leads: 0,
            asked: 0,
        }
    }
}

impl Clocked {
    /// What it shows at `at`.
    fn shows(&self, at: Time) -> f64 {
        let since = at.since(WorldOptions::default().start);
        self.phase_ns as f64 + since as f64 * (1.0 + self.ppm * 1e-6)
    }

    /// How late a slot at `grid` is by it.
    fn error(&self, shown: f64, period_ns: u64) -> i64 {
        let period = period_ns as i64;
        let late = (shown.round() as i64 - self.target_ns as i64).rem_euclid(period);
        if late > period / 2 { late - period } else { late }
    }
}

/// A bus of a clock and a device, and no drives.
#[derive(Clone)]
struct ClockPlan {
    name: &'static str,
    clock: Arc<Mutex<Clocked>>,
    devices: Vec<&'static str>,
}

impl std::fmt::Debug for ClockPlan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name)
    }
}

fn none() -> LinUdpPlan {
    LinUdpPlan::new([10, 9, 0, 1].into(), Vec::new())
}

impl BusPlan for ClockPlan {
    fn name(&self) -> &str {
        self.name
    }

    fn protocol(&self) -> &'static str {
        "clock"
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        Vec::new()
    }

    fn faults(&self, _: u64) -> Vec<(usize, PlanFault)> {
        Vec::new()
    }

    fn describe(&self, _: u64) -> Vec<String> {
        Vec::new()
    }

    fn open(&self, period_ns: u64, _: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        Ok(Box::new(ClockBus { plan: self.clone(), period_ns, told: VecDeque::with_capacity(4) }))
    }

    fn capabilities(&self, _: usize) -> Capabilities {
        unreachable!("it has no drives")
    }

    fn monitored(&self, _: usize) -> [Option<MonitorChannel>; 4] {
        [const { None }; 4]
    }

    fn notation(&self) -> Arc<dyn Notation> {
        none().notation()
    }

    fn reaching(&self, _: usize) -> Option<Box<dyn BusPlan>> {
        None
    }

    fn simulate(&self) -> Vec<Box<dyn SimDrive>> {
        Vec::new()
    }

    fn has_clock(&self) -> bool {
        true
    }

    fn devices(&self) -> Vec<&str> {
        self.devices.clone()
    }
}

struct ClockBus {
    plan: ClockPlan,
    period_ns: u64,
    /// What the cycles saw that were not asked for it yet, the newest last.
    told: VecDeque<Option<i64>>,
}

impl Bus for ClockBus {
    fn name(&self) -> &str {
        self.plan.name
    }

    fn memory(&self, _: &mut Regions) {}

    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, cycle: &Cycle, _: &mut [Slot]) {
        let clock = self.plan.clock.lock().unwrap();
        let Some(world) = &clock.world else { return };
        let sent = world.now();
        let shown = clock.shows(sent) - sent.since(cycle.grid) as f64;
        let error = clock.error(shown, self.period_ns) + (clock.wrong)(cycle.index);
        let seen = !(clock.lost)(cycle.index);
        self.told.push_back(seen.then_some(error));
    }

    fn receive(&mut self, _: &Cycle, _: &mut [Slot]) {}

    fn prepare(&mut self, _: &Cycle, _: &mut [Slot]) {}

    fn shut_down(&mut self, _: &Cycle, _: &mut [Slot]) -> bool {
        true
    }

    fn unmatched(&self) -> Unmatched {
        Unmatched::default()
    }

    fn native(&mut self, _: usize) -> Option<Box<dyn Any + Send>> {
        None
    }

    fn acyclic(&mut self, _: usize) -> Option<AcyclicEnds> {
        None
    }

    fn lead(&mut self) {
        self.plan.clock.lock().unwrap().leads += 1;
    }

    fn phase_error(&mut self) -> Option<i64> {
        let mut clock = self.plan.clock.lock().unwrap();
        clock.asked += 1;
        if self.told.len() > clock.later { self.told.pop_front()? } else { None }
    }

    fn device(&mut self, index: usize) -> Option<Box<dyn Any + Send>> {
        Some(Box::new(Inputs(index)))
    }
}

/// The process data of a device.
#[derive(Debug, PartialEq)]
struct Inputs(usize);

/// A machine whose grid is led by a clock, and what its slots were.
struct Led {
    sim: Simulation,
    clock: Arc<Mutex<Clocked>>,
    seen: Arc<Mutex<Vec<Cycle>>>,
    period_ns: u64,
}

fn bus(name: &'static str, clock: Clocked) -> ClockPlan {
    ClockPlan { name, clock: Arc::new(Mutex::new(clock)), devices: Vec::new() }
}

fn plan(period_ns: u64, buses: Vec<Box<dyn BusPlan>>) -> Plan {
    let cycle = CyclePlan {
        period_ns,
        reference: Some("line".to_owned()),
        overrun: Overrun::Skip { max_skip: 1_000 },
        max_skip_rate: 1.0,
        ..CyclePlan::default()
    };
    Plan { source: None, cycle, buses, groups: Vec::new() }
}

impl Led {
    fn new(period_ns: u64, clock: Clocked) -> Led {
        Led::beside(period_ns, clock, Vec::new())
    }

    /// With other buses before it.
    fn beside(period_ns: u64, clock: Clocked, mut buses: Vec<Box<dyn BusPlan>>) -> Led {
        let line = bus("line", clock);
        let clock = Arc::clone(&line.clock);
        buses.push(Box::new(line));
        let seen = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&seen);
        let sim = Master::from_plan(plan(period_ns, buses))
            .with_task(move |cycle, _| log.lock().unwrap().push(*cycle))
            // Late by up to a tenth of the period, each time another bit.
            .simulate(WorldOptions { wake_ns: period_ns / 10, ..WorldOptions::default() })
            .unwrap();
        clock.lock().unwrap().world = Some(sim.world().clone());
        Led { sim, clock, seen, period_ns }
    }

    fn run_for(&mut self, ns: u64) {
        let end = self.sim.world().now() + ns;
        while self.sim.world().now() < end {
            self.sim.step();
        }
    }

    fn reference(&self) -> ReferenceStatus {
        self.sim.status().reference.unwrap()
    }

    /// The largest true error of the slots from `from` on, by the clock itself.
    fn worst(&self, from: usize) -> u64 {
        let clock = self.clock.lock().unwrap();
        let errors = self.seen.lock().unwrap()[from..]
            .iter()
            .map(|cycle| clock.error(clock.shows(cycle.grid), self.period_ns).unsigned_abs())
            .max();
        errors.unwrap()
    }

    /// How many slots were executed.
    fn executed(&self) -> usize {
        self.seen.lock().unwrap().len()
    }

    /// No slot is a hundredth of the period off a period behind the one before it, and nothing is lost count of.
    fn assert_grid(&self) {
        let (status, most) = (self.sim.status(), self.period_ns / 100);
        for pair in self.seen.lock().unwrap().windows(2) {
            let slots = pair[1].index - pair[0].index;
            let distance = pair[1].grid.since(pair[0].grid);
            assert!(distance.abs_diff(slots * self.period_ns) <= most, "{pair:?}");
            assert_eq!(pair[1].deadline, pair[1].grid + self.period_ns / 2);
        }
        assert_eq!(status.planned, status.executed + status.skipped, "{status:?}");
        let histograms = &self.sim.measured().histograms;
        assert_eq!(histograms.wake.len(), status.planned, "{status:?}");
        let reference = self.reference();
        assert_eq!(reference.samples + reference.silent, status.executed, "{reference:?}");
        assert!(reference.step_max.ns <= most);
        // What the records said is what the loop has counted.
        let phase = &histograms.reference;
        assert_eq!(phase.is_empty(), reference.error_max.ns == 0);
        assert!(phase.len() <= reference.samples && phase.equivalent(phase.max(), reference.error_max.ns));
        // The jitter of the wake-ups is not what it follows.
        assert!(status.jitter_max.ns > 0 && status.jitter_max.ns <= self.period_ns / 10 + US);
    }
}

#[test]
fn from_any_phase_and_drift_it_is_locked_within_two_seconds() {
    for period_ns in [250 * US, 500 * US, MS, 4 * MS] {
        for ppm in [-100.0, 0.0, 100.0] {
            for part in 0..8 {
                let clock = Clocked { ppm, phase_ns: part * period_ns / 8 + 17, ..Clocked::default() };
                let mut led = Led::new(period_ns, clock);
                led.run_for(2 * S);
                let locked = led.executed();
                led.run_for(S / 2);
                led.assert_grid();
                let (worst, reference) = (led.worst(locked), led.reference());
                assert!(worst <= 5 * US, "{period_ns} ns, {ppm} ppm, {part}/8: {worst} ns");
                assert!(reference.locked && reference.losses == 0, "{reference:?}");
                assert_eq!((led.sim.status().skipped, reference.silent), (0, 0));
            }
        }
    }
}

#[test]
fn a_phase_of_half_a_period_takes_steps_of_a_hundredth_and_no_larger_ones() {
    let clock = Clocked { phase_ns: 600 * US, ..Clocked::default() };
    let mut led = Led::new(MS, clock);
    led.run_for(S);
    led.assert_grid();
    assert_eq!(led.reference().step_max.ns, 10 * US);
    let steps: Vec<u64> = led
        .seen
        .lock()
        .unwrap()
        .windows(2)
        .map(|pair| pair[1].grid.since(pair[0].grid).abs_diff(MS))
        .collect();
    let largest = steps.iter().filter(|step| **step == 10 * US).count();
    assert!((25..=50).contains(&largest), "{largest}");
    assert!(steps[500..].iter().all(|step| *step <= 1));
}

#[test]
fn cycles_without_a_sample_and_skipped_slots_steer_nothing() {
    for period_ns in [500 * US, MS, 4 * MS] {
        let clock = Clocked {
            ppm: 100.0,
            phase_ns: period_ns / 3,
            lost: Box::new(|slot| slot % 5 == 3),
            ..Clocked::default()
        };
        let mut led = Led::new(period_ns, clock);
        let mut random = fastrand::Rng::with_seed(period_ns);
        let mut run = |led: &mut Led| {
            for turn in 0..4 * S / period_ns {
                if turn % 50 == 7 {
                    led.sim.world().delay_next_wake(random.u64(0..4 * period_ns));
                }
                led.sim.step();
            }
            led.executed()
        };
        let locked = run(&mut led);
        run(&mut led);
        let (status, reference) = (*led.sim.status(), led.reference());
        assert!(status.skipped > 20 && reference.silent > 100, "{status:?}");
        assert_eq!(status.planned, status.executed + status.skipped);
        assert_eq!(reference.samples + reference.silent, status.executed);
        for pair in led.seen.lock().unwrap().windows(2) {
            let slots = pair[1].index - pair[0].index;
            let off = pair[1].grid.since(pair[0].grid).abs_diff(slots * period_ns);
            assert!(off <= period_ns / 100);
            assert!(off == 0 || pair[0].index % 5 != 3, "{pair:?}");
        }
        assert!(reference.locked && reference.losses == 0, "{reference:?}");
        assert!(led.worst(locked) <= 5 * US, "{} ns", led.worst(locked));
    }
}

#[test]
fn a_sample_that_comes_a_cycle_late_locks_as_well() {
    for period_ns in [250 * US, MS, 4 * MS] {
        for later in [1, 2] {
            let clock = Clocked { ppm: -100.0, phase_ns: period_ns / 2, later, ..Clocked::default() };
            let mut led = Led::new(period_ns, clock);
            led.run_for(2 * S);
            let locked = led.executed();
            led.run_for(S);
            led.assert_grid();
            assert!(led.reference().locked && led.worst(locked) <= 5 * US, "{}", led.worst(locked));
        }
    }
}

#[test]
fn a_clock_that_jumps_or_falls_silent_loses_the_lock_and_finds_it_again() {
    let clock = Clocked {
        lost: Box::new(|slot| (3_000..3_200).contains(&slot)),
        wrong: Box::new(|slot| if slot == 1_500 { 400_000 } else { 0 }),
        ..Clocked::default()
    };
    let mut led = Led::new(MS, clock);
    led.run_for(2 * S);
    assert!(led.reference().locked && led.reference().losses == 0, "one wrong sample is no lost lock");
    assert_eq!(led.reference().error_max.ns, 400_000, "but it counts");
    led.clock.lock().unwrap().phase_ns += 300 * US;
    led.run_for(10 * MS);
    let reference = led.reference();
    assert_eq!((reference.locked, reference.losses), (false, 1));
    led.run_for(900 * MS);
    assert!(led.reference().locked);
    led.run_for(250 * MS);
    let reference = led.reference();
    assert_eq!((reference.locked, reference.losses), (false, 2), "silent for 100 cycles");
    led.run_for(200 * MS);
    assert!(led.reference().locked);
    led.assert_grid();
}

#[test]
fn one_bus_leads_and_no_other_one_is_asked() {
    let other = bus("other", Clocked { ppm: 500.0, ..Clocked::default() });
    let asked = Arc::clone(&other.clock);
    let mut led = Led::beside(MS, Clocked { ppm: 100.0, ..Clocked::default() }, vec![Box::new(other)]);
    led.run_for(S);
    led.assert_grid();
    let of = |clock: &Mutex<Clocked>| {
        let clock = clock.lock().unwrap();
        (clock.leads, clock.asked)
    };
    assert_eq!(of(&asked), (0, 0));
    assert_eq!(of(&led.clock), (1, led.sim.status().executed), "once a cycle");
}

#[test]
fn without_a_reference_nobody_leads_and_the_grid_is_its_own() {
    let line = bus("line", Clocked { ppm: 500.0, ..Clocked::default() });
    let clock = Arc::clone(&line.clock);
    let mut plan = plan(MS, vec![Box::new(line)]);
    plan.cycle.reference = None;
    assert_eq!(plan.records_a_cycle(), 1);
    let mut sim = Master::from_plan(plan).simulate(WorldOptions::default()).unwrap();
    clock.lock().unwrap().world = Some(sim.world().clone());
    sim.run(500);
    let clock = clock.lock().unwrap();
    assert_eq!((clock.leads, clock.asked, sim.status().reference), (0, 0, None));
    assert!(sim.measured().histograms.reference.is_empty());
}

#[test]
fn drives_of_another_bus_are_asked_on_the_grid_that_is_led() {
    let drives = LinUdpPlan::new([10, 0, 0, 1].into(), (0..3).map(drive).collect());
    let clock = Clocked { ppm: 100.0, phase_ns: 700 * US, ..Clocked::default() };
    let mut led = Led::beside(MS, clock, vec![Box::new(drives)]);
    led.run_for(3 * S);
    led.assert_grid();
    let status = *led.sim.status();
    let numbers = led.sim.finish();
    assert_eq!((status.missed, status.skipped), (0, 0));
    for drive in &numbers.drives {
        assert_eq!((drive.feedback.link, drive.losses), (Link::Online, 0));
        // What is owed at the end is the one exchange that the last cycle may have left.
        assert!(drive.counters.sent - drive.counters.answered <= 1 && drive.counters.sent > 2_900);
        assert!(drive.peaks.send_jitter.ns <= 100 * US + US, "{:?}", drive.peaks);
    }
}

#[test]
fn the_summary_tells_who_leads_and_how_well() {
    let mut led = Led::new(MS, Clocked { ppm: 100.0, phase_ns: 300 * US, ..Clocked::default() });
    led.clock.lock().unwrap().lost = Box::new(|slot| slot % 100 == 50);
    led.run_for(5 * S);
    led.assert_grid();
    let (measured, reference) = (led.sim.measured().clone(), led.reference());
    let numbers = led.sim.finish();
    let plan = plan(MS, vec![Box::new(bus("line", Clocked::default()))]);
    let granted = Granted { policy: "", priority: 0, core: None, memory_locked: false, missing: Vec::new() };
    let summary = Summary::of(&plan, &numbers, &measured, &granted, None);
    let json = serde_json::to_value(&summary).unwrap();
    let told = &json["cycle"]["reference"];
    assert_eq!((told["bus"].as_str(), told["locked"].as_bool()), (Some("line"), Some(true)));
    assert_eq!(told["samples"].as_u64(), Some(reference.samples));
    assert_eq!(told["silent"].as_u64(), Some(reference.silent));
    assert_eq!(told["step_max_ns"].as_u64(), Some(10_000));
    assert_eq!(told["error_ns"]["max"].as_u64(), Some(reference.error_max.ns));
    assert!(told["error_ns"]["p99"].as_u64().is_some_and(|p99| p99 <= 10_000), "{told}");
    let count = told["error_ns"]["count"].as_u64().unwrap();
    assert!(count > 4_500 && count < reference.samples, "what was before the lock is not in it");
    assert!(
        summary.to_string().contains("\ngrid synchronised to bus line: locked, largest step 10 us"),
        "{summary}"
    );
}

#[test]
fn a_reference_that_cannot_lead_is_refused_with_one_line() {
    let drives = || Box::new(LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive(0)])) as Box<dyn BusPlan>;
    let clock = |name| Box::new(bus(name, Clocked::default())) as Box<dyn BusPlan>;
    let refused = |buses: Vec<Box<dyn BusPlan>>, reference: &str| {
        let mut plan = plan(MS, buses);
        plan.cycle.reference = Some(reference.to_owned());
        plan.check().map_err(|errors| errors.to_string())
    };
    let linudp = none().name().to_owned();
    let told = |text: String| Err(format!("cycle: {text}"));
    assert_eq!(refused(vec![drives(), clock("line")], "line"), Ok(()));
    assert_eq!(
        refused(vec![drives(), clock("line"), clock("b")], "lime"),
        told("reference = \"lime\" is not a bus; name one that has: line, b".into())
    );
    assert_eq!(
        refused(vec![drives()], &linudp),
        told(format!(
            "reference = {linudp:?}: a linudp-v2 bus has no clock that can lead; no bus of this machine has one: \
             leave reference out"
        ))
    );
    assert_eq!(
        refused(vec![clock("line"), clock("line")], "line"),
        told("reference = \"line\" names 2 buses; give each its own name".into())
    );
    let mut plan = plan(MS, vec![drives()]);
    plan.cycle.reference = Some("line".into());
    let refused = Master::from_plan(plan).start().unwrap_err().to_string();
    assert_eq!(refused.lines().count(), 1, "{refused}");
}

#[test]
fn a_drive_alone_keeps_the_reference_only_if_it_is_on_that_bus() {
    let drives = Box::new(LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive(0)]));
    let name = drives.drives[0].axis.name.clone();
    let plan = plan(MS, vec![drives, Box::new(bus("line", Clocked::default()))]);
    let alone = plan.alone(&name).unwrap();
    assert_eq!((alone.cycle.reference.as_ref(), alone.check()), (None, Ok(())));
    assert_eq!(plan.reaching(&name).unwrap().check(), Ok(()));
}

#[test]
fn a_device_is_taken_once_by_its_name_and_type() {
    let machine = |devices: &[&'static str]| {
        let mut line = bus("line", Clocked::default());
        line.devices = devices.to_vec();
        let drives = LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive(0)]);
        plan(MS, vec![Box::new(drives), Box::new(line)])
    };
    let mut sim = Master::from_plan(machine(&["di", "do"])).simulate(WorldOptions::default()).unwrap();
    assert_eq!(sim.device::<u32>("do"), Err(MasterError::DeviceType("do".into())));
    assert_eq!(sim.device::<Inputs>("do"), Ok(Inputs(1)), "another type has not taken it");
    assert_eq!(sim.device::<Inputs>("do"), Err(MasterError::DeviceTaken("do".into())));
    assert_eq!(sim.device::<Inputs>("di"), Ok(Inputs(0)));
    let absent = sim.device::<Inputs>("dx").unwrap_err().to_string();
    assert_eq!(absent, "there is no device dx; there are: di, do");
    let name = drive(0).axis.name;
    let taken: &'static str = name.leak();
    for (devices, refused) in [
        (&["di", "di"], "device di: its name is taken; names are unique in the machine".to_owned()),
        (&["di", taken], format!("device {taken}: its name is taken; names are unique in the machine")),
        (&["di", "d o"], "device \"d o\": its name must be 1 to 32 letters, digits, - _ or .".to_owned()),
    ] {
        assert_eq!(machine(devices).check().unwrap_err().to_string(), refused);
    }
}
