//! What a run leaves behind: the summary of a run, its report, recordings, black boxes, and the numbers of a running
//! machine for others.
//!
//! | module | what |
//! |---|---|
//! | `archive` | a run as a file, from which pages are drawn and with which later runs are compared |
//! | `blackbox` | the last cycles, written to a file when something fails |
//! | `compare` | two runs: what is worse, better, or not different |
//! | `failures` | what counts as a failure of a drive |
//! | `file` | files that are whole or not there |
//! | `hgrm` | a histogram as the tools of HdrHistogram read it |
//! | `metrics` | the numbers of a running machine, over HTTP |
//! | `page` | a run as one HTML file |
//! | `plots` | the plots of a run |
//! | `recording` | a recording for the tools of others |
//! | `report` | a directory with all of it |
//! | `summary` | the `--json` object and the text of a run |
//! | `table` | tables of text |
//! | `log` | the log of the loop's inputs in a recording |
//! | `style` | colours of a terminal |

pub mod archive;
pub mod blackbox;
pub mod compare;
pub mod failures;
pub mod file;
pub mod hgrm;
pub mod log;
pub mod metrics;
pub mod page;
pub mod plots;
pub mod recording;
pub mod report;
pub mod style;
pub mod summary;
pub mod table;

pub use self::summary::Summary;
