//! `fieldbeat blackbox`: what led up to a failure.

use std::path::PathBuf;

use clap::Args;
use fieldbeat::telemetry::blackbox::{file, story};
use serde_json::json;

use super::{Stop, print};

/// Arguments of `blackbox`.
#[derive(Debug, Args)]
pub struct BlackBox {
    /// A file that the master wrote at a fault, a lost drive, another stop, or SIGUSR1.
    file: PathBuf,
    /// Show this many cycles before the failure as a table, and a quarter as many after it.
    #[arg(long, value_name = "N", default_value_t = 20)]
    cycles: u64,
    /// Print header, events and the tables of the drives as one JSON object.
    #[arg(long)]
    json: bool,
}

impl BlackBox {
    /// Prints it.
    pub fn run(self) -> Result<(), Stop> {
        let (header, records) = file::load(&self.file).map_err(Stop::usage)?;
        if self.json {
            let happened = story::happenings(&header, &records);
            let drives = story::courses(&header, &records, &happened, self.cycles);
            return print(json!({ "header": header, "happened": happened, "drives": drives }));
        }
        print(story::tell(&header, &records, self.cycles).trim_end())
    }
}
