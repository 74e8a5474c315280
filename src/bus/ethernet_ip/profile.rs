//! What is desired of a drive as its outputs.

use super::plan::MoonsDrive;
use crate::bus::desired::{Capabilities, Generator};

/// What it can do.
pub(super) fn capabilities(_drive: &MoonsDrive, _period_ns: u64) -> Capabilities {
    Capabilities::of(Generator::Drive { leash: None })
}
