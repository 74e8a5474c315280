//! The plan of a bus as a [`BusPlan`].

use std::net::SocketAddrV4;
use std::sync::Arc;

use super::bus::EthernetIpBus;
use super::counters::OWN;
use super::diagnosis::DIAGNOSIS;
use super::fields::layout;
use super::notation::Addresses;
use super::plan::{Delivery, EthernetIpPlan, MoonsDrive};
use super::profile;
use super::target::Target;
use super::wire::assembly::{Version, alarms, input_size};
use super::wire::io::{COUNT, OUTGOING_MAX, OWNER_SIZE};
use fieldbeat_core::axis::acyclic::{Call, Notation};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, FaultNames, FoundRunning, MonitorChannel, PlanFault};
use fieldbeat_core::bus::desired::Capabilities;
use fieldbeat_core::bus::diagnosis::Row;
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{Bus, BusPlan, OpenError, OwnCounter, drives};
use fieldbeat_core::net::Carriers;

impl BusPlan for EthernetIpPlan {
    fn name(&self) -> &str {
        &self.name
    }

    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        let same: fn(&MoonsDrive, &MoonsDrive) -> bool = |one, other| one.address.ip() == other.address.ip();
        let taken = "is taken by another drive; one drive per IP address";
        let drives =
            drives::faults(&self.drives, period_ns, |drive| &drive.axis, MoonsDrive::faults, same, taken);
        self.own_faults().into_iter().chain(drives).collect()
    }

    fn fresh_within_ns(&self, index: usize, period_ns: u64) -> Option<u64> {
        self.drives.get(index).map(|drive| drive.fresh_within_ns(period_ns))
    }

    fn before_stop(&self, _index: usize) -> u32 {
        // An idle packet, so that the stop is an edge.
        1
    }

    fn describe(&self, period_ns: u64) -> Vec<String> {
        self.drives.iter().map(|drive| drive.describe(self.bind, period_ns)).collect()
    }

    fn drive_watchdog_ns(&self, index: usize) -> Option<u64> {
        self.drives.get(index)?.stops_within_ns()
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        EthernetIpBus::open(self, period_ns, carriers)
    }

    fn load(&self, _period_ns: u64) -> Option<Load> {
        if self.drives.iter().all(|drive| !drive.cyclic) {
            return None;
        }
        let around = OUTGOING_MAX - usize::from(OWNER_SIZE) + COUNT;
        let bytes = [OUTGOING_MAX, around + input_size(Version::V1)];
        Some(Load {
            medium: Medium::Datagrams,
            way: Way::Address(*self.bind.ip()),
            bytes,
            frames: Vec::new(),
        })
    }

    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        self.drives.get(index).map_or([const { None }; MONITOR_CHANNELS], MoonsDrive::shown)
    }

    fn native_layout(&self, index: usize) -> NativeLayout {
        self.drives.get(index).map_or_else(NativeLayout::default, layout)
    }

    fn capabilities(&self, index: usize, period_ns: u64) -> Capabilities {
        profile::capabilities(&self.drives[index], period_ns)
    }

    fn own_counters(&self) -> &'static [OwnCounter] {
        &OWN
    }

    fn fault_names(&self) -> FaultNames {
        // Of several alarms the one that took the motor's current, as that of the lowest bit.
        |word| {
            let cause = alarms(word).find(|alarm| alarm.fault).or_else(|| alarms(word).next());
            cause.map(|alarm| alarm.name)
        }
    }

    fn diagnosis(&self) -> &'static [Row] {
        &DIAGNOSIS
    }

    fn notation(&self) -> Arc<dyn Notation> {
        Arc::new(Addresses)
    }

    /// By explicit messages alone: they need no connection, and take the outputs from nobody who owns them.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        (drive.cyclic, drive.delivery) = (false, Delivery::PointToPoint);
        drive.axis.on_found_running = FoundRunning::Refuse;
        Some(Box::new(EthernetIpPlan { drives: vec![drive], ..self.clone() }))
    }

    fn probe(&self) -> Option<Call> {
        let is_without = self.drives.iter().all(|drive| !drive.cyclic);
        is_without.then(|| Target::VENDOR.read())
    }

    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        Some(Box::new(EthernetIpPlan::variant(self, wanted)?))
    }

    fn addresses(&self) -> Vec<SocketAddrV4> {
        self.drives.iter().map(|drive| drive.address).collect()
    }
}
