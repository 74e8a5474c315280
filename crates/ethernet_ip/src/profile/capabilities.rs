//! What a drive can do, as its plan says.

use crate::plan::{MOST_PER_REV, MoonsDrive, Version};
use fieldbeat_core::axis::Lacks;
use fieldbeat_core::bus::desired::{Capabilities, Generator, Ranges, Velocities};

const NO_ROWS: &str = "it makes its own profiles, and takes no rows; command moves or velocities";
const NO_TORQUE: &str = "it takes positions and velocities, no torques";
const NO_JOGS: &str = "its jogs are switched off (jog = false)";
const NO_HOMING: &str = "how it homes is not configured (homing)";
const NO_OUTPUTS: &str = "its connection has no outputs: use connection = \"owner\"";
const FIRST_VERSION: &str =
    "a drive of version \"v1\" has no outputs: its values are shown, and it takes parameter calls";

/// The demand ends exactly at its target; a step is left to its rounding.
const ARRIVAL_STEPS: f64 = 2.0;

/// The capabilities of a drive, with a packet every `rpi_ns`.
pub fn capabilities(drive: &MoonsDrive, period_ns: u64) -> Capabilities {
    let units = &drive.axis.units;
    let ends = [i32::MIN, i32::MAX].map(|count| f64::from(count) / units.counts_per_unit);
    let least = |on_wire: f64| (1.0 / on_wire.abs(), MOST_PER_REV / on_wire.abs());
    let control = match drive.version {
        Some(Version::V1) => Some(FIRST_VERSION),
        _ => (!drive.is_owned()).then_some(NO_OUTPUTS),
    };
    // A packet of the drive may be an interval old; the stop waits for its slot and for an idle packet.
    let reaction_ns = drive
        .input_rpi_ns(period_ns)
        .saturating_add(drive.rpi_ns(period_ns).saturating_mul(3))
        .saturating_add(drive.fresh_within_ns(period_ns));
    Capabilities {
        lacks: Lacks {
            control,
            rows: Some(NO_ROWS),
            torques: Some(NO_TORQUE),
            velocities: (!drive.jog).then_some(NO_JOGS),
            homing: drive.homing.is_none().then_some(NO_HOMING),
            ..Lacks::default()
        },
        // A packet counts only if its sequence count is above that of the last one.
        power_reports: 1,
        still_reports: 2,
        arrival: units.distance(ARRIVAL_STEPS).abs(),
        ranges: Ranges {
            position: (ends[0].min(ends[1]), ends[0].max(ends[1])),
            velocity: least(drive.velocity_on_wire(1.0)),
            acceleration: least(drive.acceleration_on_wire(1.0)),
        },
        ..Capabilities::of(Generator::Drive {
            velocities: drive.jog.then_some(Velocities::Own { reaction_ns }),
        })
    }
}
