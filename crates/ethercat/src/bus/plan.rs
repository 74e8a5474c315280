//! The plan of a segment as a [`BusPlan`], and the interface that it names.

use std::io::ErrorKind;

use super::EthercatBus;
use crate::counters::OWN;
use crate::diagnosis::DIAGNOSIS;
use crate::fields::layout;
use crate::image::Image;
use crate::object::Objects;
use crate::other::listen;
use crate::plan::{EthercatPlan, KollmorgenDrive, Owner};
use crate::scan::{Busy, Shown, require_idle};
use crate::wire::frame::ETHERTYPE;
use crate::{PROTOCOL, faults, profile};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, FoundRunning, PlanFault};
use fieldbeat_core::bus::load::{Load, Medium, Way};
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{BusFacts, BusPlan, DriveFacts, Grid, OpenError, Opened};
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_core::net::{Carriers, Frames, Lock, Place};
use fieldbeat_core::rt::rights::grant;

/// The interface of `plan`, with its lock; no other master has frames there.
pub(super) fn open(
    plan: &EthercatPlan,
    carriers: &dyn Carriers,
) -> Result<(Box<dyn Frames>, Lock), OpenError> {
    let (bus, interface) = (plan.name.clone(), plan.interface.clone());
    let lock = carriers.lock(Place::Interface(&interface)).map_err(|why| {
        let what = format!("interface {interface}");
        OpenError::InUse { bus: bus.clone(), what, why }
    })?;
    let mut net = carriers.frames(&interface, ETHERTYPE).map_err(|source| {
        let (bus, interface, remedy) = (bus.clone(), interface.clone(), remedy(&source));
        OpenError::Interface { bus, interface, source, remedy }
    })?;
    match listen(&interface, &mut *net) {
        Some(mac) => Err(OpenError::OtherMaster { bus, interface, mac: Shown(&mac).to_string() }),
        None => Ok((net, lock)),
    }
}

/// The remedy for an interface that cannot be used.
fn remedy(source: &std::io::Error) -> String {
    let known = match source.kind() {
        ErrorKind::PermissionDenied => {
            return format!("{}, or run it as root", grant("cap_sys_nice,cap_ipc_lock,cap_net_raw"));
        }
        ErrorKind::NotFound => "correct interface",
        _ => no_descriptor(source).unwrap_or(
            "look at interface: a network interface like \"eth1\", or \"local:NAME\" for simulated drives",
        ),
    };
    known.to_owned()
}

impl BusPlan for EthercatPlan {
    /// By the place of its outputs in the frame.
    fn drive_in(&self, frame: &[u8], at: usize) -> Option<usize> {
        let slaves = self.slaves();
        let clock = slaves.iter().any(|(_, slave)| slave.sync);
        let (image, offsets) = Image::new(&slaves, 0, [0; 6], clock, self.lrw)?;
        let number = image.frames().iter().position(|own| own.bytes().len() == frame.len())?;
        let at = u16::try_from(at).ok()?;
        slaves.iter().zip(offsets).find_map(|((owner, _), offsets)| match owner {
            Owner::Drive(index) if offsets.frame == number && offsets.outputs.contains(&at) => Some(*index),
            _ => None,
        })
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        EthercatPlan::faults(self, period_ns)
    }

    fn facts(&self, grid: Grid) -> BusFacts {
        let drive = |drive: &KollmorgenDrive| {
            let (place, can) = (drive.slave.place, profile::capabilities(drive, grid.period_ns));
            DriveFacts {
                watchdog_ns: drive.slave.watchdog.ns(),
                monitored: drive.shown(),
                ..DriveFacts::on_wire(place, place.into(), can)
            }
        };
        let slaves = self.slaves();
        let has_clock = slaves.iter().any(|(_, slave)| slave.sync);
        let load = Image::new(&slaves, 0, [0; 6], has_clock, self.lrw).map(|(image, _)| Load {
            frames: image.frames().iter().map(|frame| frame.bytes().len()).collect(),
            ..Load::new(Medium::Frames, Way::Interface(self.interface.clone()), [0; 2])
        });
        BusFacts {
            devices: self.devices.iter().map(|device| device.name.clone()).collect(),
            has_clock,
            is_one_frame: true,
            load,
            own_counters: &OWN,
            fault_names: |code| u16::try_from(code).ok().and_then(faults::name),
            silence_faults: |code| code == u32::from(faults::Fault::SYNCHRONISATION.code),
            diagnosis: &DIAGNOSIS,
            ..BusFacts::new(PROTOCOL, Objects, self.drives.iter().map(drive).collect())
        }
    }

    fn describe(&self, grid: Grid) -> Vec<String> {
        EthercatPlan::describe(self, grid.period_ns)
    }

    fn native_layout(&self, index: usize) -> NativeLayout {
        self.drives.get(index).map_or_else(NativeLayout::default, layout)
    }

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        EthercatBus::open(self, period_ns, carriers)
    }

    fn require_idle(&self, carriers: &dyn Carriers) -> Result<(), OpenError> {
        let (mut net, _lock) = open(self, carriers)?;
        let (bus, interface) = (self.name.clone(), self.interface.clone());
        match require_idle(&mut *net) {
            // Whatever else is wrong there the start reports, with its remedy.
            Ok(()) => Ok(()),
            Err(Busy::Other(mac)) => {
                Err(OpenError::OtherMaster { bus, interface, mac: Shown(&mac).to_string() })
            }
            Err(Busy::Running { place, state }) => {
                let what = format!("the slave at place {place} of its segment is in {state}");
                Err(OpenError::Running { bus, what })
            }
        }
    }

    /// The whole segment has to come up for one drive: the plan is reduced to this drive, the others stay in INIT.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.show = [None; MONITOR_CHANNELS];
        Some(Box::new(EthercatPlan { drives: vec![drive], devices: Vec::new(), ..self.clone() }))
    }

    fn variant(&self, wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        Some(Box::new(EthercatPlan::variant(self, wanted)?))
    }
}
