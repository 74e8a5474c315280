//! Lenze drives on a PROFIBUS wire under the whole loop in virtual time: what the conformance suite does not ask of a
//! protocol.
//!
//! | file | what |
//! |---|---|
//! | `mod` | a machine of drives on one wire |
//! | `turns` | from the first telegram to a motor that turns, at each rate |
//! | `names` | what is wrong is reported by name, and disturbs nobody else |
//! | `loss` | drives, telegrams and ports that are lost; noise and other masters |
//! | `evidence` | Done means that the drive did it |
//! | `parameters` | codes and records, by each path |
//! | `tap` | drives that the test shares with the world |
//! | `rate` | as many exchanges a second as the formula allows |

mod evidence;
mod loss;
mod names;
mod parameters;
mod rate;
pub mod tap;
pub mod turns;

use std::sync::{Arc, Mutex};

use fieldbeat::axis::{Command, Feedback, Link, Outcome, Profile};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::profibus::{LenzeDrive, ProfibusPlan};
use fieldbeat::sim::{SerialWire, Simulated, WorldOptions};
use fieldbeat::telemetry::Counters;
use fieldbeat::{CyclePlan, Master, OpenError, Plan, Simulation};
use fieldbeat_core::bus::{Notes, Opened};
use fieldbeat_core::net::Carriers;
use fieldbeat_profibus::counters::Own;
use fieldbeat_sim::profibus::{LenzeSim, Misuse, ProfibusSegment};

/// The master's port.
pub const PORT: &str = "/dev/ttyS1";

pub const PROFILE: Profile = Profile { velocity: 8.0, acceleration: 80.0, deceleration: 80.0 };

/// A drive as usual here, at address 3 and up.
pub fn drive(index: usize) -> LenzeDrive {
    let mut drive = LenzeDrive::new(format!("l{index}"), 3 + index as u8);
    drive.axis.profile = PROFILE;
    drive.axis.limits.velocity = Some(20.0);
    drive.axis.stop.deceleration = 80.0;
    drive.axis.jog_deadman = None;
    drive
}

/// A cycle of 1 ms whose window has room for two drives at 1.5 Mbit/s.
pub fn cycle() -> CyclePlan {
    CyclePlan { receive_deadline: 0.8, ..CyclePlan::default() }
}

/// A wire of this rate with so many drives.
pub fn wire(rate: u32, count: usize) -> ProfibusPlan {
    ProfibusPlan::new(PORT, rate, (0..count).map(drive).collect())
}

/// Notes on the drives of a bus, once it is open.
type Noted = Arc<Mutex<Option<Arc<dyn Notes>>>>;

/// A bus whose notes the test reads.
#[derive(Debug)]
struct NotedPlan {
    plan: ProfibusPlan,
    notes: Noted,
}

impl BusPlan for NotedPlan {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let opened = self.plan.open(period_ns, carriers)?;
        *self.notes.lock().unwrap() = opened.notes.clone();
        Ok(opened)
    }
}

/// A machine of drives on one wire.
pub struct Lenze {
    pub sim: Simulation,
    notes: Noted,
    count: usize,
}

impl Lenze {
    /// These drives, each simulated as its plan expects it.
    pub fn new(bus: ProfibusPlan, cycle: CyclePlan) -> Lenze {
        Lenze::with(bus, cycle, |_| ())
    }

    /// The same, the wire changed.
    pub fn with(bus: ProfibusPlan, cycle: CyclePlan, change: impl FnOnce(&mut ProfibusSegment)) -> Lenze {
        let mut segment = ProfibusSegment::of(&bus);
        for drive in &mut segment.drives {
            drive.motor.ramps_s = (0.01, 0.01, 0.01);
        }
        change(&mut segment);
        Lenze::on(bus, cycle, segment.wire())
    }

    /// These drives, on a wire that is there.
    pub fn on(bus: ProfibusPlan, cycle: CyclePlan, wire: SerialWire) -> Lenze {
        let count = bus.drives.len();
        let notes = Noted::default();
        let bus = NotedPlan { plan: bus, notes: Arc::clone(&notes) };
        let plan = Plan { cycle, buses: vec![Box::new(bus)], ..Plan::default() };
        let simulated = Simulated { wires: vec![wire], ..Simulated::default() };
        let sim = Master::from_plan(plan).simulate_with(simulated, WorldOptions::default());
        Lenze { sim: sim.unwrap_or_else(|error| panic!("{error}")), notes, count }
    }

    pub fn feedback(&self, index: usize) -> Feedback {
        self.sim.feedback(index)
    }

    /// Why drive `index` is not in Data_Exchange.
    pub fn note(&self, index: usize) -> Option<String> {
        self.notes.lock().unwrap().as_ref()?.get(index)
    }

    pub fn until(&mut self, what: &str, most: u64, done: impl FnMut(&Simulation) -> bool) {
        assert!(
            self.sim.run_until(most, done),
            "not within {most} cycles: {what}; {:?} {:?}",
            self.sim.feedback(0),
            self.sim.remarks()
        );
    }

    pub fn online(&mut self) {
        let count = self.count;
        let all = |sim: &Simulation| (0..count).all(|index| sim.feedback(index).link == Link::Online);
        self.until("all online", 20_000, all);
    }

    pub fn end(&mut self, index: usize, command: Command) -> Option<Outcome> {
        self.sim.execute(index, command, 20_000).unwrap_or_else(|error| panic!("{command:?}: {error}"))
    }

    pub fn done(&mut self, index: usize, command: Command) {
        let end = self.end(index, command);
        assert_eq!(end, Some(Outcome::Done), "{command:?}: {:?}", self.feedback(index));
    }

    /// Online and enabled.
    pub fn ready(&mut self) {
        self.online();
        (0..self.count).for_each(|index| self.done(index, Command::Enable));
    }

    pub fn post(&mut self, index: usize, command: Command) {
        self.sim.axis(index).post(command).unwrap_or_else(|error| panic!("{error}"));
    }

    /// Looks at a simulated drive.
    pub fn look<R>(&self, index: usize, look: impl FnOnce(&mut LenzeSim, fieldbeat::Time) -> R) -> R {
        self.sim.world().look_on(PORT, index, look).expect("it is on the wire")
    }

    /// The true speed of a motor, revolutions/s.
    pub fn speed(&self, index: usize) -> f64 {
        self.look(index, |drive, now| drive.truth(now).velocity)
    }

    /// What the master did that it must not.
    pub fn misuse(&self, index: usize) -> Misuse {
        self.look(index, |drive, _| drive.misuse())
    }

    /// The motor turns at this velocity, by its drive and in truth.
    pub fn turns(&mut self, index: usize, velocity: f64) {
        self.until("its velocity", 20_000, |sim| {
            (sim.feedback(index).status.velocity - velocity).abs() < 0.05
        });
        let speed = self.speed(index);
        assert!((speed - velocity).abs() < 0.1, "{speed}, not {velocity}: {:?}", self.feedback(index));
    }

    /// The counters at the end.
    pub fn finish(self) -> Vec<Counters> {
        self.sim.finish().drives.iter().map(|drive| drive.counters).collect()
    }
}

/// A counter that only this protocol has.
pub fn own(counters: &Counters, which: Own) -> u64 {
    counters.own[which as usize]
}
