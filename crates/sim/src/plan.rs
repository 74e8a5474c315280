//! The simulated drives of a machine as configured, next to the machine's own plan, which knows nothing of them.

use std::any::Any;

use super::ethercat::EthercatSegment;
use super::ethernet_ip::MoonsDrives;
use super::linudp::LinMots;
use super::modbus::Unidrives;
use super::profibus::ProfibusSegment;
use super::{SimBus, Simulated};
use fieldbeat_core::bus::BusPlan;
use fieldbeat_ethercat::EthercatPlan;
use fieldbeat_keys::table::Table;

/// The simulated drives of a machine, bus by bus.
#[derive(Debug, Default)]
pub struct SimPlan {
    /// The buses that have simulated drives.
    pub buses: Vec<Box<dyn SimBus>>,
}

/// Drives that fit a bus, of the protocol that knows its plan.
type Fit = fn(&dyn BusPlan) -> Option<Box<dyn SimBus>>;
/// The same from the table of the bus, for a cycle of this period in ns.
type Read = fn(&mut Table<'_>, &dyn BusPlan, u64) -> Option<Box<dyn SimBus>>;

/// One entry a protocol.
const FITS: [Fit; 5] = [
    |bus| of_plan(bus, LinMots::of),
    |bus| of_plan(bus, Unidrives::of),
    |bus| of_plan(bus, |plan: &EthercatPlan| EthercatSegment::from(plan.clone())),
    |bus| of_plan(bus, MoonsDrives::of),
    |bus| of_plan(bus, ProfibusSegment::of),
];
const READERS: [Read; 5] = [
    |table, bus, period_ns| of_plan(bus, |plan| super::linudp::config::read(table, plan, period_ns)),
    |table, bus, period_ns| of_plan(bus, |plan| super::modbus::config::read(table, plan, period_ns)),
    |table, bus, period_ns| of_plan(bus, |plan| super::ethercat::config::read(table, plan, period_ns)),
    |table, bus, period_ns| of_plan(bus, |plan| super::ethernet_ip::config::read(table, plan, period_ns)),
    |table, bus, period_ns| of_plan(bus, |plan| super::profibus::config::read(table, plan, period_ns)),
];

/// Those of a bus, if its plan is of the type that `make` takes.
fn of_plan<P: 'static, S: SimBus + 'static>(
    bus: &dyn BusPlan,
    make: impl FnOnce(&P) -> S,
) -> Option<Box<dyn SimBus>> {
    Some(Box::new(make((bus as &dyn Any).downcast_ref()?)))
}

impl SimPlan {
    /// Drives with default settings that fit these buses. A bus of no protocol of this library has none.
    pub fn of(buses: &[Box<dyn BusPlan>]) -> SimPlan {
        let fit = |bus: &dyn BusPlan| FITS.iter().find_map(|fit| fit(bus));
        SimPlan { buses: buses.iter().filter_map(|bus| fit(&**bus)).collect() }
    }

    /// Reads how the drives of `bus` are simulated from its table, and adds them.
    #[doc(hidden)]
    pub fn read(&mut self, table: &mut Table<'_>, bus: &dyn BusPlan, period_ns: u64) {
        self.buses.extend(READERS.iter().find_map(|read| read(table, bus, period_ns)));
    }

    /// Builds the drives.
    pub fn build(&self) -> Simulated {
        let mut simulated = Simulated::default();
        self.buses.iter().for_each(|bus| bus.build(&mut simulated));
        simulated
    }
}

impl<B: SimBus + 'static> From<B> for SimPlan {
    fn from(bus: B) -> SimPlan {
        SimPlan { buses: vec![Box::new(bus)] }
    }
}
