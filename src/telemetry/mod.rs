//! What the loop reports: histograms, causes, a black box, and their reports. A normal thread, fed by a ring;
//! the loop never waits for it.
//!
//! | file | what |
//! |---|---|
//! | `recorder` | the thread that empties the ring |
//! | `histograms` | every quantity, and the quantiles that its sample supports |
//! | `timeline` | the largest values over time |
//! | `hgrm` | a histogram as the tools of HdrHistogram read it |
//! | `causes` | why a cycle was late |
//! | `blackbox` | the last cycles, written to a file when something fails |
//! | `monitor` | a reader of a machine, for any thread |
//! | `metrics` | the numbers of a running machine, over HTTP |
//! | `plots` | the plots of a run |
//! | `report` | a directory with all of it |
//! | `file` | files that are whole or not there |
//! | `summary` | the `--json` object and the text of a run |
//! | `table` | tables of text |
//!
//! Counts and maxima come from the loop itself and are exact; quantiles come from here.

#[cfg(feature = "black-box")]
pub mod blackbox;
pub(crate) mod causes;
#[cfg(any(feature = "black-box", feature = "report"))]
pub(crate) mod file;
#[cfg(feature = "report")]
pub(crate) mod hgrm;
pub(crate) mod histograms;
#[cfg(feature = "metrics")]
pub mod metrics;
mod monitor;
#[cfg(feature = "report")]
pub(crate) mod plots;
pub(crate) mod recorder;
#[cfg(feature = "report")]
pub mod report;
#[cfg(feature = "summary")]
pub mod summary;
#[cfg(feature = "summary")]
mod table;
pub(crate) mod timeline;

pub use self::causes::{Cause, Causes, Judged, Tally};
pub use self::histograms::{DriveHistograms, Histograms, Quantiles, Quantity};
pub use self::monitor::Monitor;
pub use self::recorder::{DriveEmergency, Failure, Measured, Run, Written};
pub(crate) use self::recorder::{Keep, Recorder, Recording};
#[cfg(feature = "summary")]
pub use self::summary::Summary;
pub use self::timeline::{Stretch, Timeline};
pub use crate::bus::counters::{BusClock, Counters, Unmatched};
pub use crate::cycle::engine::LoopPanic;
pub use crate::cycle::record::Stage;
pub use crate::cycle::status::{DeviceEnd, DriveEnd, Numbers, ReferenceStatus, Status};
pub use crate::drive::numbers::{Extent, Peak, Peaks};
