//! Histograms of what the loop measures. A normal thread, fed by a ring; the loop never waits for it.
//!
//! | file | what |
//! |---|---|
//! | `recorder` | the thread that empties the ring into histograms |
//! | `summary` | the `--json` object and the table of a run |
//!
//! Counts and maxima come from the loop itself and are exact; quantiles come from here.

mod recorder;
pub mod summary;

pub use recorder::{Histograms, Quantiles, Recorder};
pub use summary::{Run, Summary};
