//! The plan of a bus as a [`BusPlan`].

use std::net::SocketAddrV4;
use std::sync::Arc;

use super::bus::ProfibusBus;
use super::counters::{OWN, Own};
use super::diagnosis::DIAGNOSIS;
use super::fields::layout;
use super::notation::Codes;
use super::plan::{LenzeDrive, ProfibusPlan};
use super::profile;
use super::wire::telegram;
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, FoundRunning, MonitorChannel, PlanFault};
use fieldbeat_core::bus::desired::Capabilities;
use fieldbeat_core::bus::diagnosis::Row;
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{Bus, BusPlan, Grid, OpenError, OwnCounter, drives};
use fieldbeat_core::net::Carriers;

impl BusPlan for ProfibusPlan {
    /// By the address in its head.
    fn drive_in(&self, telegram: &[u8], _at: usize) -> Option<usize> {
        let address = telegram::destination(telegram)?;
        self.drives.iter().position(|drive| drive.address == address)
    }

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
        let same: fn(&LenzeDrive, &LenzeDrive) -> bool = |one, other| one.address == other.address;
        let none = |_: &LenzeDrive, _| Vec::new();
        let drives =
            drives::faults(&self.drives, period_ns, |drive| &drive.axis, none, same, super::ADDRESS_TAKEN);
        let own = self.own_faults().into_iter().map(|fault| (0, fault));
        let of_drive = |(index, drive): (usize, &LenzeDrive)| {
            self.drive_faults(drive).into_iter().map(move |fault| (index, fault))
        };
        own.chain(self.drives.iter().enumerate().flat_map(of_drive)).chain(drives).collect()
    }

    fn turn_within_ns(&self, index: usize, grid: Grid) -> Option<u64> {
        Some(self.turn_within(index, grid))
    }

    fn request_within_ns(&self, index: usize, grid: Grid) -> Option<u64> {
        Some(self.request_within(index, grid))
    }

    fn turn_faults(&self, grid: Grid) -> Vec<(usize, PlanFault)> {
        self.schedule_faults(grid)
    }

    fn describe_turns(&self, grid: Grid) -> Option<String> {
        Some(self.describe_round(grid))
    }

    fn before_stop(&self, _index: usize) -> u32 {
        // A telegram that is repeated stays what it is, and what is new in it would be ignored.
        1
    }

    fn describe(&self, _period_ns: u64) -> Vec<String> {
        let drives = (0..self.drives.len()).map(|index| self.describe_drive(index));
        drives.chain([self.describe_wire()]).collect()
    }

    fn drive_watchdog_ns(&self, index: usize) -> Option<u64> {
        self.drives.get(index)?.watchdog_ns()
    }

    fn open(&self, _period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        Ok(Box::new(ProfibusBus::open(self, carriers)?))
    }

    fn load(&self, _period_ns: u64) -> Option<Load> {
        // What the wire takes is laid on the grid: `turn_faults`.
        Some(Load {
            medium: Medium::Serial,
            way: Way::Port(self.device.clone()),
            bytes: [0; 2],
            frames: Vec::new(),
        })
    }

    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        self.drives.get(index).map_or([const { None }; MONITOR_CHANNELS], LenzeDrive::shown)
    }

    fn native_layout(&self, index: usize) -> NativeLayout {
        self.drives.get(index).map_or_else(NativeLayout::default, layout)
    }

    fn own_counters(&self) -> &'static [OwnCounter] {
        &OWN
    }

    fn wire_us(&self) -> Option<usize> {
        Some(Own::WireUs as usize)
    }

    fn capabilities(&self, index: usize, _period_ns: u64) -> Capabilities {
        profile::capabilities(&self.drives[index])
    }

    fn diagnosis(&self) -> &'static [Row] {
        &DIAGNOSIS
    }

    fn notation(&self) -> Arc<dyn Notation> {
        Arc::new(Codes)
    }

    /// The other drives are not parametrised: each needs its master.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.show = [const { None }; MONITOR_CHANNELS];
        Some(Box::new(ProfibusPlan { drives: vec![drive], ..self.clone() }))
    }

    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        Some(Box::new(ProfibusPlan::variant(self, wanted)?))
    }

    fn place(&self, index: usize) -> Option<String> {
        self.drives.get(index).map(|drive| drive.address.to_string())
    }

    fn addresses(&self) -> Vec<SocketAddrV4> {
        Vec::new()
    }
}
