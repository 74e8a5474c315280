//! What the buses of all protocols do with their drives: locks, the application's ends, the faults of their plans.

use std::any::Any;
use std::net::SocketAddrV4;

use super::OpenError;
use crate::axis::acyclic::AcyclicEnds;
use crate::axis::{AxisPlan, Faults, Observer, PlanFault};
use crate::net::{Carriers, Lock, Place};

/// The application's ends of a bus.
#[derive(Debug, Default)]
pub struct Ends {
    /// Those of its drives, in slot order.
    pub drives: Vec<DriveEnds>,
    /// Those of its devices that are not drives, in the order of the plan.
    pub devices: Vec<DeviceEnds>,
}

/// The application's ends of a drive.
#[derive(Debug)]
pub struct DriveEnds {
    /// The native process data, by the type that its protocol names.
    pub native: Box<dyn Any + Send>,
    /// The acyclic access. Posted calls are carried out in slices of bounded work, and end as done, refused by the
    /// drive, or unavailable. They add no telegram to a cycle and delay none.
    pub acyclic: AcyclicEnds,
}

/// The application's ends of a device that is not a drive.
#[derive(Debug)]
pub struct DeviceEnds {
    /// The process data, by the type that its protocol names.
    pub native: Box<dyn Any + Send>,
    /// The acyclic access.
    pub acyclic: AcyclicEnds,
    /// Whether it can be reached, as the link of its feedback.
    pub observer: Observer,
}

impl Ends {
    /// Those of the next drive: of its native process data, and of its acyclic access.
    pub fn push(&mut self, native: impl Any + Send, acyclic: AcyclicEnds) {
        self.drives.push(DriveEnds { native: Box::new(native), acyclic });
    }
}

/// Locks drives of `bus` at these addresses for this master, or none of them.
pub fn lock<'a>(
    bus: &str,
    drives: impl Iterator<Item = (&'a AxisPlan, SocketAddrV4)>,
    carriers: &dyn Carriers,
) -> Result<Vec<Lock>, OpenError> {
    let lock = |(axis, address): (&AxisPlan, SocketAddrV4)| {
        carriers.lock(Place::Drive(address)).map_err(|why| {
            let what = format!("drive {} at {address}", axis.name);
            OpenError::InUse { bus: bus.to_owned(), what, why }
        })
    };
    drives.map(lock).collect()
}

/// The mistakes in the plans of drives, each with its index: with their axes, by themselves in a cycle of their own,
/// and with an address that is `same` as that of an earlier one, for the reason `taken`.
pub fn faults<D>(
    drives: &[D],
    period_ns: u64,
    axis: fn(&D) -> &AxisPlan,
    own: fn(&D, u64) -> Vec<PlanFault>,
    same: fn(&D, &D) -> bool,
    taken: &'static str,
) -> Vec<(usize, PlanFault)> {
    let of = |(index, drive): (usize, &D)| {
        let axis = axis(drive);
        let mut faults = axis.faults();
        faults.extend(own(drive, period_ns.saturating_mul(u64::from(axis.divisor))));
        let is_taken = drives[..index].iter().any(|other| same(other, drive));
        faults.wrong_if(is_taken, "address", taken);
        faults.into_iter().map(move |fault| (index, fault)).collect::<Vec<_>>()
    };
    drives.iter().enumerate().flat_map(of).collect()
}
