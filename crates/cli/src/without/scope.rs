//! In place of `scope` in a program that is built without it.

use clap::{Args, Subcommand};
use fieldbeat_telemetry::Monitor;

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

/// No argument.
#[derive(Debug, Args)]
pub struct Page {}

/// Nothing is served.
#[derive(Debug)]
pub struct Served;

/// Nothing is held.
#[derive(Debug)]
pub struct Held;

impl Page {
    /// There is nothing to find out.
    pub fn prepare(self) -> Result<Served, Stop> {
        Ok(Served)
    }
}

impl Served {
    /// Serves nothing.
    pub fn serve(self, _monitor: &Monitor) -> Result<Held, Stop> {
        Ok(Held)
    }
}
