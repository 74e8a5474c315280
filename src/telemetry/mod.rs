//! What the loop reports: histograms, causes, a black box, and their reports. A normal thread, fed by a ring;
//! the loop never waits for it.
//!
//! | file | what |
//! |---|---|
//! | `thread` | the thread that empties the ring |
//! | `tap` | further readers of the records |
//! | `sink` | what takes all of them down, on a thread of its own |
//! | `recording` | a recording for the tools of others |
//! | `failures` | what counts as a failure of a drive |
//! | `histograms` | every quantity, and the quantiles that its sample supports |
//! | `timeline` | the largest values over time |
//! | `motion` | how the axes moved, and what happened to them |
//! | `stretches` | values over the time of a run in bounded memory |
//! | `parts` | the histograms of a run, part by part |
//! | `bins` | a histogram as a short list |
//! | `hgrm` | a histogram as the tools of HdrHistogram read it |
//! | `causes` | why a cycle was late |
//! | `blackbox` | the last cycles, written to a file when something fails |
//! | `monitor` | a reader of a machine, for any thread |
//! | `metrics` | the numbers of a running machine, over HTTP |
//! | `archive` | a run as a file, from which pages are drawn and with which later runs are compared |
//! | `compare` | two runs: what is worse, better, or not different |
//! | `plots` | the plots of a run |
//! | `page` | a run as one HTML file |
//! | `report` | a directory with all of it |
//! | `file` | files that are whole or not there |
//! | `summary` | the `--json` object and the text of a run |
//! | `table` | tables of text |
//!
//! Counts and maxima come from the loop itself and are exact; quantiles come from here.

#[cfg(feature = "report")]
pub(crate) mod archive;
#[cfg(feature = "report")]
pub(crate) mod bins;
#[cfg(feature = "black-box")]
pub mod blackbox;
pub(crate) mod causes;
#[cfg(feature = "report")]
pub(crate) mod compare;
#[cfg(any(feature = "black-box", feature = "record"))]
pub(crate) mod failures;
#[cfg(any(feature = "black-box", feature = "record", feature = "report"))]
pub(crate) mod file;
#[cfg(feature = "report")]
pub(crate) mod hgrm;
pub(crate) mod histograms;
#[cfg(feature = "metrics")]
pub mod metrics;
mod monitor;
mod motion;
#[cfg(feature = "report")]
pub(crate) mod page;
#[cfg(feature = "report")]
pub(crate) mod parts;
#[cfg(feature = "report")]
pub(crate) mod plots;
#[cfg(feature = "record")]
pub mod recording;
#[cfg(feature = "report")]
pub mod report;
pub(crate) mod sink;
mod stretches;
#[cfg(feature = "summary")]
pub mod summary;
#[cfg(feature = "summary")]
mod table;
pub(crate) mod tap;
pub(crate) mod thread;
pub(crate) mod timeline;

pub use self::causes::{Cause, Causes, Judged, Tally};
pub use self::histograms::{DriveHistograms, Histograms, Quantiles, Quantity};
pub use self::monitor::Monitor;
pub use self::motion::{AxisMotion, Band, Happened, Largest, Mark, Marks, Motion, Moved};
pub(crate) use self::sink::{Feed, Sink};
pub use self::sink::{Recorded, WireSummary};
#[cfg(feature = "summary")]
pub use self::summary::Summary;
pub use self::thread::{DriveEmergency, Failure, Measured, Run, Written};
pub(crate) use self::thread::{Gathered, Keep, TelemetryThread};
pub use self::timeline::{Stretch, Timeline};
pub use crate::bus::counters::{BusClock, Counters, Unmatched};
pub use crate::cycle::engine::LoopPanic;
pub use crate::cycle::record::Stage;
pub use crate::cycle::status::{
    AtEnd, Condition, DeviceEnd, DriveEnd, Numbers, ReferenceStatus, Status, StopRequest,
};
pub use crate::drive::numbers::{Extent, Peak, Peaks};
