//! The plan of a bus as a [`BusPlan`].

use super::bus::ProfibusBus;
use super::counters::{OWN, Own};
use super::diagnosis::DIAGNOSIS;
use super::fields::layout;
use super::notation::Codes;
use super::plan::{LenzeDrive, ProfibusPlan};
use super::profile;
use super::wire::telegram;
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, FoundRunning, PlanFault};
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{BusFacts, BusPlan, DriveFacts, Grid, OpenError, Opened, ReplyWithin, drives};
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

    fn turn_faults(&self, grid: Grid) -> Vec<(usize, PlanFault)> {
        self.schedule_faults(grid)
    }

    fn facts(&self, grid: Grid) -> BusFacts {
        let drive = |((index, drive), [request_ns, end_ns]): ((usize, &LenzeDrive), [u64; 2])| DriveFacts {
            reply_within: ReplyWithin::Turn { request_ns, end_ns },
            // A telegram that is repeated stays what it is, and what is new in it would be ignored.
            before_stop: 1,
            watchdog_ns: drive.watchdog_ns(),
            monitored: drive.shown(),
            ..DriveFacts::on_wire(drive.address, index, profile::capabilities(drive))
        };
        let drives = self.drives.iter().enumerate().zip(self.turns(grid)).map(drive);
        BusFacts {
            // What the wire takes is laid on the grid: `turn_faults`.
            load: Some(Load::new(Medium::Serial, Way::Port(self.device.clone()), [0; 2])),
            own_counters: &OWN,
            wire_us: Some(Own::WireUs as usize),
            diagnosis: &DIAGNOSIS,
            ..BusFacts::new(super::PROTOCOL, Codes, drives.collect())
        }
    }

    fn describe(&self, grid: Grid) -> Vec<String> {
        let drives = (0..self.drives.len()).map(|index| self.describe_drive(index));
        drives.chain([self.describe_wire(), self.describe_round(grid)]).collect()
    }

    fn native_layout(&self, index: usize) -> NativeLayout {
        self.drives.get(index).map_or_else(NativeLayout::default, layout)
    }

    fn open(&self, _period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        ProfibusBus::open(self, carriers)
    }

    /// The other drives are not parametrised: each needs its master.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.show = [const { None }; MONITOR_CHANNELS];
        Some(Box::new(ProfibusPlan { drives: vec![drive], ..self.clone() }))
    }

    /// The drives have to be its own, since their number decides what fits on the wire.
    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        if wanted.drives.is_some() {
            return None;
        }
        let mut plan = ProfibusPlan { device: wanted.interface(&self.device), ..self.clone() };
        plan.drives.iter_mut().for_each(|drive| wanted.schedule(&mut drive.axis, 0));
        Some(Box::new(plan))
    }
}
