//! All drives of one bus, as a [`Bus`](crate::bus::Bus).

use super::plan::EthernetIpPlan;
use crate::bus::{Bus, OpenError};
use crate::net::Carriers;

/// Drives on one socket.
#[derive(Debug)]
pub struct EthernetIpBus;

impl EthernetIpBus {
    /// Opens the bus of `plan`, which is free of faults.
    pub fn open(
        plan: &EthernetIpPlan,
        _period_ns: u64,
        _carriers: &dyn Carriers,
    ) -> Result<Box<dyn Bus>, OpenError> {
        let drive = plan.drives.first().map(|drive| drive.axis.name.clone()).unwrap_or_default();
        Err(OpenError::Plan { bus: plan.name.clone(), drive })
    }
}
