//! The plan of a bus as a [`BusPlan`].

use super::bus::EthernetIpBus;
use super::counters::OWN;
use super::diagnosis::DIAGNOSIS;
use super::fields::layout;
use super::notation::Addresses;
use super::plan::{Delivery, EthernetIpPlan, MoonsDrive, Originator, RPI_RANGE_NS};
use super::profile;
use super::target::Target;
use super::wire::assembly::{Version, alarms, input_size};
use super::wire::io::{COUNT, OUTGOING_MAX, OWNER_SIZE};
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_core::axis::{AxisPlan, FoundRunning, PlanFault};
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{BusFacts, BusPlan, DriveFacts, Grid, OpenError, Opened, ReplyWithin, drives};
use fieldbeat_core::net::Carriers;

impl BusPlan for EthernetIpPlan {
    fn name(&self) -> &str {
        &self.name
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

    fn facts(&self, grid: Grid) -> BusFacts {
        let drive = |drive: &MoonsDrive| DriveFacts {
            reply_within: ReplyWithin::OwnClock(drive.fresh_within_ns(grid.period_ns)),
            // An idle packet, so that the stop is an edge.
            before_stop: 1,
            watchdog_ns: drive.stops_within_ns(),
            monitored: drive.shown(),
            ..DriveFacts::at(drive.address, profile::capabilities(drive, grid.period_ns))
        };
        let is_cyclic = self.drives.iter().any(|drive| drive.cyclic);
        let around = OUTGOING_MAX - usize::from(OWNER_SIZE) + COUNT;
        let (way, bytes) = (Way::Address(*self.bind.ip()), [OUTGOING_MAX, around + input_size(Version::V1)]);
        BusFacts {
            load: is_cyclic.then_some(Load::new(Medium::Datagrams, way, bytes)),
            local: Some(self.bind),
            own_counters: &OWN,
            // Of several alarms the one that took the motor's current, as that of the lowest bit.
            fault_names: |word| {
                let cause = alarms(word).find(|alarm| alarm.fault).or_else(|| alarms(word).next());
                cause.map(|alarm| alarm.name)
            },
            diagnosis: &DIAGNOSIS,
            probe: (!is_cyclic).then(|| Target::VENDOR.read()),
            ..BusFacts::new(super::PROTOCOL, Addresses, self.drives.iter().map(drive).collect())
        }
    }

    fn describe(&self, grid: Grid) -> Vec<String> {
        self.drives.iter().map(|drive| drive.describe(self.bind, grid.period_ns)).collect()
    }

    fn native_layout(&self, index: usize) -> NativeLayout {
        self.drives.get(index).map_or_else(NativeLayout::default, layout)
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        EthernetIpBus::open(self, period_ns, carriers)
    }

    /// By explicit messages alone: they need no connection, and take the outputs from nobody who owns them.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        (drive.cyclic, drive.delivery) = (false, Delivery::PointToPoint);
        drive.axis.on_found_running = FoundRunning::Refuse;
        Some(Box::new(EthernetIpPlan { drives: vec![drive], ..self.clone() }))
    }

    /// Another host is another originator, unless it was named.
    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        let mut plan = self.clone();
        plan.bind.set_ip(wanted.address(*plan.bind.ip()));
        if self.originator == Originator::at(*self.bind.ip()) {
            plan.originator = Originator::at(*plan.bind.ip());
        }
        plan.drives = wanted.hosts(&self.drives, |drive| (&mut drive.axis, &mut drive.address));
        for drive in &mut plan.drives {
            wanted.schedule(&mut drive.axis, RPI_RANGE_NS.0);
            if !drive.outlives_a_loss(wanted.period_ns) {
                drive.multiplier = None;
            }
            drive.effect_within_ns = drive.effect_within_ns.max(drive.least_effect_ns(wanted.period_ns));
        }
        Some(Box::new(plan))
    }
}
