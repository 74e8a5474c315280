//! Drives that tell their speed and no position, on a bus with connections and counters of its own: LinMot drives on a LinUDP
//! bus, of which the loop is told no more than that.

use std::any::Any;
use std::os::fd::RawFd;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use fieldbeat::axis::acyclic::{AcyclicEnds, Notation};
use fieldbeat::axis::{AxisPlan, FaultNames, MonitorChannel, PlanFault};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::bus::{Bus, BusPlan, Cycle, OpenError, OwnCounter, Report, Slot, Strangers};
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
        self.plan.faults(period_ns)
    }

    fn describe(&self, period_ns: u64) -> Vec<String> {
        self.plan.describe(period_ns)
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        let bus = self.plan.open(period_ns, carriers)?;
        let truth = vec![Report::default(); self.plan.drives.len()];
        Ok(Box::new(SpeedBus { bus, truth, of: self.clone() }))
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

struct SpeedBus {
    bus: Box<dyn Bus>,
    /// What the drives told it.
    truth: Vec<Report>,
    of: Speeds,
}

impl SpeedBus {
    /// Lets the bus do its work with what its drives told it, then takes from the reports what such a drive would not tell.
    fn blind<R>(&mut self, slots: &mut [Slot], work: impl FnOnce(&mut dyn Bus, &mut [Slot]) -> R) -> R {
        for (Slot { report, .. }, truth) in slots.iter_mut().zip(&self.truth) {
            (report.position, report.demand) = (truth.position, truth.demand);
            (report.velocity, report.current) = (truth.velocity, truth.current);
        }
        let done = work(&mut *self.bus, slots);
        let factor = self.of.percent.load(Ordering::Relaxed) as f64 / 100.0;
        let mut replies = self.of.replies.lock().unwrap();
        for ((slot, truth), replies) in slots.iter_mut().zip(&mut self.truth).zip(&mut *replies) {
            let report = &mut slot.report;
            *replies += u64::from(report.at != truth.at);
            *truth = *report;
            report.velocity *= factor;
            (report.position, report.demand, report.current) = (f64::NAN, f64::NAN, f64::NAN);
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

    fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        self.blind(slots, |bus, slots| bus.receive(cycle, slots))
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.blind(slots, |bus, slots| bus.prepare(cycle, slots));
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        self.bus.shut_down(cycle, slots)
    }

    fn strangers(&self) -> Strangers {
        self.bus.strangers()
    }

    fn native(&mut self, index: usize) -> Option<Box<dyn Any + Send>> {
        self.bus.native(index)
    }

    fn notes(&self) -> Option<LinkNotes> {
        Some(self.of.notes.clone())
    }

    fn acyclic(&mut self, index: usize) -> Option<AcyclicEnds> {
        self.bus.acyclic(index)
    }
}
