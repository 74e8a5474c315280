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

pub mod blackbox;
pub mod causes;
pub mod file;
pub mod hgrm;
pub mod histograms;
pub mod metrics;
mod monitor;
pub mod plots;
mod recorder;
pub mod report;
pub mod summary;
mod table;
pub mod timeline;

pub use histograms::{Histograms, Quantiles};
pub use monitor::Monitor;
pub use recorder::{DriveEmergency, Measured, Recorder, Recording};
pub use summary::Summary;
