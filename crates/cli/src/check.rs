//! `fieldbeat check`: the plan in words, or as JSON.

use std::path::PathBuf;

use clap::Args;
use fieldbeat_config as config;
use fieldbeat_config::ConfigError;

use fieldbeat_core::rt::host::rt_throttling;
use fieldbeat_doctor::port::blocked;
use serde_json::json;

use super::{Stop, print};

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct Check {
    /// The configuration.
    config: PathBuf,
    /// Print one JSON object: the plan, or with mistakes only `errors`.
    ///
    /// Keys of a plan: `source`, `cycle`, `buses`, `drives` (each with `name`, `protocol`, `address`,
    /// `stop_bound_cycles`, `stop_bound_ns`, `drive_watchdog_ns`, `if_master_dies` and more), `groups`, and `errors`,
    /// empty unless this host cannot carry the plan. Each error has `file`, `line`, `key`, `value` and `message`. With
    /// errors the exit code is 2.
    #[arg(long)]
    json: bool,
}

impl Check {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let plan = match config::load(&self.config) {
            Ok(read) => read.plan,
            Err(errors) => {
                if self.json {
                    print(json!({ "errors": errors.iter().collect::<Vec<_>>() }))?;
                }
                return Err(Stop::usage(errors));
            }
        };
        // What cannot work on this host is refused here too, with the plan above it.
        let throttling = rt_throttling();
        let starving =
            throttling.and_then(|throttling| fieldbeat_core::cycle::starvation(&plan.cycle, &throttling));
        let refusal = starving.or_else(|| blocked(&plan));
        if self.json {
            let file = self.config.display().to_string();
            let of_host = |message| ConfigError::of_file(file, message);
            let errors: Vec<ConfigError> = refusal.clone().map(of_host).into_iter().collect();
            print(fieldbeat_config::json::json(&plan, &errors))?;
        } else {
            for line in fieldbeat_config::describe::describe(&plan) {
                print(line)?;
            }
        }
        refusal.map_or(Ok(()), |why| Err(Stop::usage(why)))
    }
}
