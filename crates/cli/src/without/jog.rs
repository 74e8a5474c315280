//! In place of `jog` in a program that is built without it.

use clap::Subcommand;

use super::Stop;

/// No command.
#[derive(Debug, Subcommand)]
pub enum Command {}

impl Command {
    /// Is never called.
    pub fn run(self) -> Result<(), Stop> {
        match self {}
    }
}
