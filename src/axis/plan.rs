//! One axis as configured, already checked. `config/` builds it from TOML, an embedder by hand.

use std::time::Duration;

use super::command::Profile;
use super::units::{Unit, Units};

/// What the loop and the application need to know of one axis; what only its protocol needs stands in the protocol's
/// own drive plan.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisPlan {
    /// Its name, unique in the machine.
    pub name: String,
    /// User units.
    pub units: Units,
    /// Limits in user units.
    pub limits: Limits,
    /// The profile that moves take when they name none.
    pub profile: Profile,
    /// An exchange every so many cycles, at least 1.
    pub divisor: u32,
    /// In which of these cycles, `0 .. divisor`.
    pub phase: u32,
    /// When a link counts as up and as lost.
    pub health: Health,
    /// How the axis stops when the master stops it.
    pub stop: StopPlan,
    /// What a stream that runs empty does.
    pub underrun: Underrun,
    /// What to do with a drive that is found enabled or moving.
    pub on_found_running: FoundRunning,
    /// Longest time for Enable, Disable and ResetFault.
    pub enable_timeout: Duration,
    /// Longest time for Home.
    pub home_timeout: Duration,
    /// Room in the command queue.
    pub command_queue: usize,
    /// Room in the stream, rows.
    pub stream_queue: usize,
    /// Room in the event queue.
    pub event_queue: usize,
    /// Room for the feedback of every cycle; 0 = only the newest is kept.
    pub sample_queue: usize,
}

impl AxisPlan {
    /// An axis of this name and unit with everything else as it is when a configuration says nothing of it.
    pub fn new(name: impl Into<String>, units: Units) -> AxisPlan {
        // What is usual in a unit: speed, acceleration, and the speed that counts as standstill.
        let (velocity, acceleration, standstill) = match units.unit {
            Unit::Millimetre => (100.0, 1000.0, 5.0),
            Unit::Revolution => (1.0, 10.0, 0.05),
        };
        AxisPlan {
            name: name.into(),
            units,
            limits: Limits::default(),
            profile: Profile { velocity, acceleration, deceleration: acceleration },
            divisor: 1,
            phase: 0,
            health: Health::default(),
            stop: StopPlan {
                how: StopHow::Ramp,
                deceleration: acceleration,
                then: StopThen::Disable,
                timeout: Duration::from_secs(3),
                on_timeout: StopTimeout::Disable,
                standstill,
                standstill_for: 20,
                group: None,
            },
            underrun: Underrun::Stop,
            on_found_running: FoundRunning::Stop,
            enable_timeout: Duration::from_secs(5),
            home_timeout: Duration::from_secs(60),
            command_queue: 64,
            stream_queue: 1024,
            event_queue: 256,
            sample_queue: 0,
        }
    }
}

/// Limits of an axis in user units; `None` = the drive's own limit only.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Limits {
    /// Smallest and largest position.
    pub position: Option<(f64, f64)>,
    /// Largest speed, units/s.
    pub velocity: Option<f64>,
    /// Largest acceleration and deceleration, units/s².
    pub acceleration: Option<f64>,
    /// Largest distance between two streamed rows, units.
    pub step: Option<f64>,
}

/// Link health: a leaky bucket over exchanges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Health {
    /// So many misses fill the bucket, and the link is lost.
    pub bucket: u32,
    /// So many good exchanges in a row let one miss leak away.
    pub leak: u32,
    /// So many good exchanges in a row bring a link up.
    pub gate: u32,
    /// A drive never seen, or lost, is asked this often.
    pub probe_interval: Duration,
}

impl Default for Health {
    /// Lost after 5 misses not outweighed by 20 good exchanges each, up after 10 in a row, probed every 100 ms.
    fn default() -> Health {
        Health { bucket: 5, leak: 20, gate: 10, probe_interval: Duration::from_millis(100) }
    }
}

/// How the master stops an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StopPlan {
    /// The way down.
    pub how: StopHow,
    /// Deceleration of the ramp, units/s².
    pub deceleration: f64,
    /// What follows standstill.
    pub then: StopThen,
    /// Longest time to standstill.
    pub timeout: Duration,
    /// What follows when standstill does not come in time.
    pub on_timeout: StopTimeout,
    /// Standstill: speed below this, units/s ...
    pub standstill: f64,
    /// ... for so many good exchanges in a row.
    pub standstill_for: u32,
    /// Axes of one group stop together; `None` = alone.
    pub group: Option<u16>,
}

/// The way to standstill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopHow {
    /// Along the stop plan's deceleration.
    Ramp,
    /// The drive's own quick stop.
    Quick,
    /// Power off at once.
    Coast,
}

/// What follows standstill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopThen {
    /// Stay powered and in position.
    Hold,
    /// Power off.
    Disable,
}

/// What follows when standstill does not come in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopTimeout {
    /// Stay powered.
    Hold,
    /// Power off.
    Disable,
}

/// What an empty stream does. It is an event in every case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Underrun {
    /// Repeat the last position with velocity 0 until rows come again.
    Hold,
    /// Go on with the last velocity for so many exchanges, then stop.
    Extrapolate(u32),
    /// Stop the axis.
    Stop,
}

/// What to do with a drive that is found enabled or moving at start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FoundRunning {
    /// Take over the control bits as found, then stop it as the stop plan says.
    Stop,
    /// Only read; touch nothing until the application decides.
    Refuse,
}
