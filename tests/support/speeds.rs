//! Drives that tell their speed and no position, on a bus with connections and counters of its own: LinMot drives on a
//! LinUDP bus, of which the loop is told no more than that. They take torques as well, and go then as a mass without
//! friction does.

use std::any::Any;
use std::os::fd::RawFd;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use fieldbeat::axis::acyclic::{AcyclicEnds, Notation};
use fieldbeat::axis::{AxisPlan, Command, FaultNames, MonitorChannel, PlanFault};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::bus::{Bus, BusPlan, Cycle, Notes, OpenError, OwnCounter, Report, Slot, Unmatched};
use fieldbeat::net::{Carriers, LinkNotes};
use fieldbeat::rt::Regions;
use fieldbeat::sim::SimDrive;

/// What is counted: the replies, nothing, and each look as the largest of numbers.
pub const OWN: [OwnCounter; 3] = [
    OwnCounter { key: "replies", what: "replies without a position" },
    OwnCounter { key: "none", what: "nothing" },
    OwnCounter { key: "most", what: "the most" },
];

/// The bus as planned.
#[derive(Clone, Debug)]
pub struct Speeds {
    pub plan: LinUdpPlan,
    pub notes: LinkNotes,
    /// They tell their positions all the same. Under torque their demand stands where it was.
    pub positions: bool,
    /// The drives tell so many times their speed, in percent.
    pub percent: Arc<AtomicU64>,
    /// What the drives have told, each.
    pub replies: Arc<Mutex<Vec<u64>>>,
}

impl Speeds {
    pub fn new(plan: LinUdpPlan) -> Speeds {
        let drives = plan.drives.len();
        Speeds {
            plan,
            positions: false,
            notes: LinkNotes::new(drives),
            percent: Arc::new(AtomicU64::new(100)),
            replies: Arc::new(Mutex::new(vec![0; drives])),
        }
    }
}

impl BusPlan for Speeds {
    fn name(&self) -> &str {
        self.plan.name()
    }

    fn protocol(&self) -> &'static str {
        self.plan.protocol()
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.plan.axes()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        let mut faults = self.plan.faults(period_ns);
        faults.retain(|(_, fault)| fault.key != "limits.torque");
        faults
    }

    fn describe(&self, period_ns: u64) -> Vec<String> {
        self.plan.describe(period_ns)
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        let mut plan = self.plan.clone();
        // The loop alone holds them.
        plan.drives.iter_mut().for_each(|drive| drive.axis.limits.position = None);
        let bus = plan.open(period_ns, carriers)?;
        let drives = vec![Inside::default(); self.plan.drives.len()];
        Ok(Box::new(SpeedBus { bus, drives, of: self.clone() }))
    }

    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; 4] {
        self.plan.monitored(index)
    }

    fn own_counters(&self) -> &'static [OwnCounter] {
        &OWN
    }

    fn fault_names(&self) -> FaultNames {
        self.plan.fault_names()
    }

    fn notation(&self) -> Arc<dyn Notation> {
        self.plan.notation()
    }

    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        self.plan.reaching(index)
    }

    fn simulate(&self) -> Vec<Box<dyn SimDrive>> {
        self.plan.simulate()
    }
}

/// mm/s² of a per cent of the rated torque.
pub const ACCELERATION: f64 = 10.0;

struct SpeedBus {
    bus: Box<dyn Bus>,
    drives: Vec<Inside>,
    of: Speeds,
}

/// What the loop is not told of a drive.
#[derive(Clone, Debug, Default)]
struct Inside {
    /// What it told its bus.
    truth: Report,
    /// The order, while its bus is told of a velocity instead of a torque.
    order: Option<Command>,
    /// The torque that it gives, and the velocity that came of it.
    torque: f64,
    velocity: f64,
    /// Its demand from before the torque.
    demand: f64,
}

impl Inside {
    /// Goes on for the time of a cycle.
    fn go(&mut self, slot: &Slot, seconds: f64) {
        let Some(Command::Torque { slope }) = slot.order.verb else {
            (self.torque, self.velocity, self.demand) = (0.0, 0.0, self.truth.demand);
            return;
        };
        self.torque += (slot.torque - self.torque).clamp(-slope * seconds, slope * seconds);
        self.velocity += self.torque * ACCELERATION * seconds;
    }

    /// As its bus sees the slot ...
    fn enter(&mut self, slot: &mut Slot) {
        let report = &mut slot.report;
        (report.position, report.demand) = (self.truth.position, self.truth.demand);
        (report.velocity, report.current) = (self.truth.velocity, self.truth.current);
        if slot.order.verb.is_some_and(|verb| verb.takes_torques()) {
            self.order = slot.order.verb.replace(Command::Velocity { acceleration: 5_000.0 });
            // What the wire rounds to nothing is refused.
            slot.velocity = (self.velocity * 100.0).round() / 100.0;
        }
    }

    /// ... and as the loop sees it.
    fn leave(&mut self, slot: &mut Slot, positions: bool, factor: f64) {
        self.truth = slot.report;
        let torque = self.order.take();
        slot.order.verb = torque.or(slot.order.verb);
        let report = &mut slot.report;
        report.velocity *= factor;
        report.current = f64::NAN;
        match (positions, torque) {
            (false, _) => (report.position, report.demand) = (f64::NAN, f64::NAN),
            (true, Some(_)) => report.demand = self.demand,
            (true, None) => {}
        }
    }
}

impl SpeedBus {
    /// Lets the bus do its work with what its drives told it, then takes from the reports what such a drive would not
    /// tell.
    fn blind<R>(&mut self, slots: &mut [Slot], work: impl FnOnce(&mut dyn Bus, &mut [Slot]) -> R) -> R {
        for (slot, drive) in slots.iter_mut().zip(&mut self.drives) {
            drive.enter(slot);
        }
        let done = work(&mut *self.bus, slots);
        let factor = self.of.percent.load(Ordering::Relaxed) as f64 / 100.0;
        let mut replies = self.of.replies.lock().unwrap();
        for ((slot, drive), replies) in slots.iter_mut().zip(&mut self.drives).zip(&mut *replies) {
            *replies += u64::from(slot.report.at != drive.truth.at);
            drive.leave(slot, self.of.positions, factor);
            (slot.counters.own[0], slot.counters.own[2]) = (*replies, u64::MAX);
        }
        done
    }
}

impl Bus for SpeedBus {
    fn name(&self) -> &str {
        self.bus.name()
    }

    fn memory(&self, regions: &mut Regions) {
        self.bus.memory(regions);
    }

    fn fd(&self) -> Option<RawFd> {
        self.bus.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.blind(slots, |bus, slots| bus.send(cycle, slots));
    }

    fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.blind(slots, |bus, slots| bus.receive(cycle, slots));
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        for (slot, drive) in slots.iter().zip(&mut self.drives) {
            drive.go(slot, cycle.period_ns as f64 * 1e-9);
        }
        self.blind(slots, |bus, slots| bus.prepare(cycle, slots));
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        self.bus.shut_down(cycle, slots)
    }

    fn unmatched(&self) -> Unmatched {
        self.bus.unmatched()
    }

    fn native(&mut self, index: usize) -> Option<Box<dyn Any + Send>> {
        self.bus.native(index)
    }

    fn notes(&self) -> Option<Arc<dyn Notes>> {
        Some(Arc::new(self.of.notes.clone()))
    }

    fn acyclic(&mut self, index: usize) -> Option<AcyclicEnds> {
        self.bus.acyclic(index)
    }
}
