//! `fieldbeat config`: what concerns configurations and no machine.

use clap::{Args, Subcommand};

use super::{Stop, print};

/// Arguments of `config`.
#[derive(Debug, Args)]
pub struct Config {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Prints the JSON schema of a configuration, by which editors complete keys and flag mistakes.
    Schema,
}

impl Config {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        match self.what {
            What::Schema => print(format_args!("{:#}", fieldbeat_config::schema::schema())),
        }
    }
}
