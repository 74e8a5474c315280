//! What the loop reports: histograms, how the axes moved, why cycles were late. A normal thread, fed by a ring; the
//! loop never waits for it. What files of it hold is in `fieldbeat-record`.
//!
//! | file | what |
//! |---|---|
//! | `thread` | the thread that empties the ring |
//! | `tap` | further readers of the records |
//! | `sink` | what takes all of them down, on a thread of its own |
//! | `histograms` | every quantity, and the quantiles that its sample supports |
//! | `signals` | the names, units and scales of all that is measured |
//! | `timeline` | the largest values over time |
//! | `motion` | how the axes moved, and what happened to them |
//! | `stretches` | values over the time of a run in bounded memory |
//! | `causes` | why a cycle was late |
//! | `bins` | a histogram as a short list |
//! | `parts` | the histograms of a run, part by part |
//! | `log` | the log of a machine's inputs: how it begins |
//! | `monitor` | a reader of a machine, for any thread |
//!
//! Counts and maxima come from the loop itself and are exact; quantiles come from here.

pub mod bins;
pub mod causes;
pub mod histograms;
pub mod log;
pub mod monitor;
pub mod motion;
pub mod parts;
pub mod signals;
pub mod sink;
mod stretches;
pub mod tap;
pub mod thread;
pub mod timeline;

pub use self::causes::{Cause, Causes, Judged, Tally};
pub use self::histograms::{DriveHistograms, Histograms, Quantiles, Quantity};
pub use self::monitor::Monitor;
pub use self::motion::{AxisMotion, Band, Happened, Largest, Mark, Marks, Motion, Moved};
pub use self::sink::{Feed, Sink};
pub use self::sink::{Recorded, WireSummary};
pub use self::thread::{DriveEmergency, Failure, Measured, Run, Written};
pub use self::thread::{Gathered, Keep, TelemetryThread};
pub use self::timeline::{Stretch, Timeline};
pub use fieldbeat_core::bus::counters::{BusClock, Counters, Unmatched};
pub use fieldbeat_core::cycle::engine::LoopPanic;
pub use fieldbeat_core::cycle::record::Stage;
pub use fieldbeat_core::cycle::status::{
    AtEnd, Condition, DeviceEnd, DriveEnd, Numbers, ReferenceStatus, Status, StopRequest,
};
pub use fieldbeat_core::drive::numbers::{Extent, Peak, Peaks};
