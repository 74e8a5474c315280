//! A LinUDP bus whose calls panic when a test wants it.

use std::os::fd::RawFd;
use std::sync::{Arc, Mutex};

use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::{Cycle, OpenError};
use fieldbeat_core::bus::{Bus, BusNumbers, Opened, Slot};
use fieldbeat_core::net::Carriers;
use fieldbeat_core::rt::Regions;

/// The call of a bus that panics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Call {
    Send,
    Receive,
    Prepare,
    HelperEnded,
    Numbers,
    ShutDown,
}

/// Which call panics, and how often.
pub type Fuse = Arc<Mutex<Option<(Call, u32)>>>;

/// A LinUDP bus with a fuse.
#[derive(Clone, Debug)]
pub struct Fused {
    pub plan: LinUdpPlan,
    pub fuse: Fuse,
    /// What its helper is said to be.
    pub helper_ended: Arc<Mutex<bool>>,
    /// Its orderly end is never complete.
    pub never_ends: Arc<Mutex<bool>>,
}

impl Fused {
    pub fn new(plan: LinUdpPlan) -> Fused {
        Fused { plan, fuse: Fuse::default(), helper_ended: Arc::default(), never_ends: Arc::default() }
    }

    /// From now on so many of these calls panic.
    pub fn light(&self, call: Call, times: u32) {
        *self.fuse.lock().unwrap() = Some((call, times));
    }
}

impl BusPlan for Fused {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let Opened { bus, ends, .. } = self.plan.open(period_ns, carriers)?;
        let bus = Box::new(FusedBus { bus, of: self.clone() });
        Ok(Opened { bus, ends, notes: None, last_resort: None })
    }
}

struct FusedBus {
    bus: Box<dyn Bus>,
    of: Fused,
}

impl FusedBus {
    fn burn(&self, call: Call) {
        let mut fuse = self.of.fuse.lock().unwrap();
        if let Some((at, left)) = &mut *fuse
            && *at == call
            && *left > 0
        {
            *left -= 1;
            drop(fuse);
            // Quietly: the message of a panic is not this test's.
            std::panic::resume_unwind(Box::new("on purpose"));
        }
    }
}

impl Bus for FusedBus {
    fn memory(&self, regions: &mut Regions) {
        self.bus.memory(regions);
    }

    fn fd(&self) -> Option<RawFd> {
        self.bus.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.burn(Call::Send);
        self.bus.send(cycle, slots);
    }

    fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.burn(Call::Receive);
        self.bus.receive(cycle, slots);
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.burn(Call::Prepare);
        self.bus.prepare(cycle, slots);
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        self.burn(Call::ShutDown);
        self.bus.shut_down(cycle, slots) && !*self.of.never_ends.lock().unwrap()
    }

    fn helper_ended(&self) -> bool {
        self.burn(Call::HelperEnded);
        *self.of.helper_ended.lock().unwrap()
    }

    fn numbers(&self) -> BusNumbers {
        self.burn(Call::Numbers);
        self.bus.numbers()
    }
}
