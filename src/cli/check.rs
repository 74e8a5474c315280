//! `fieldbeat check`: the plan in words.

use std::path::PathBuf;

use clap::Args;
use fieldbeat::rt::host::rt_throttling;

use super::{Stop, load, print};

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct Check {
    /// The configuration.
    config: PathBuf,
}

impl Check {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let plan = load(&self.config)?;
        for line in fieldbeat::config::describe(&plan) {
            print(line)?;
        }
        // What cannot work on this host is refused here too, with the plan above it.
        let throttling = rt_throttling();
        match throttling.and_then(|throttling| fieldbeat::config::starvation(&plan.cycle, &throttling)) {
            Some(why) => Err(Stop::usage(why)),
            None => Ok(()),
        }
    }
}
