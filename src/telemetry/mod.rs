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
pub mod causes;
#[cfg(any(feature = "black-box", feature = "report"))]
pub mod file;
#[cfg(feature = "report")]
pub mod hgrm;
pub mod histograms;
#[cfg(feature = "metrics")]
pub mod metrics;
mod monitor;
#[cfg(feature = "report")]
pub mod plots;
mod recorder;
#[cfg(feature = "report")]
pub mod report;
#[cfg(feature = "summary")]
pub mod summary;
#[cfg(feature = "summary")]
mod table;
pub mod timeline;

pub use histograms::{Histograms, Quantiles};
pub use monitor::Monitor;
pub use recorder::{DriveEmergency, Failure, Keep, Measured, Recorder, Recording, Run, Written};
#[cfg(feature = "summary")]
pub use summary::Summary;
