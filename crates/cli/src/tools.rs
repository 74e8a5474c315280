//! The commands that protocols add, and what they get of the program.

use std::fmt::Display;
use std::io;
use std::ops::ControlFlow;
use std::path::Path;

use clap::error::ErrorKind;
use clap::{ArgMatches, Command, FromArgMatches, Subcommand};
use fieldbeat_core::axis::acyclic::{Access, Progress};
use fieldbeat_record::file::{Place, save};
use fieldbeat_tools::{Check, Drive, OwnMaster, Program, Reached, Stop, Tool};

use super::interrupt::Interrupt;
use super::meter::Meter;
use super::own::Own;
use super::reach::Reach;
use super::serving::Guarding;
use super::{complain, print};

/// One of them, with its arguments.
#[derive(Debug)]
pub struct Added {
    tool: &'static Tool,
    matches: ArgMatches,
}

/// Those of all protocols.
const ALL: [&[Tool]; 5] = [
    fieldbeat_linudp::config::TOOLS,
    fieldbeat_modbus::config::TOOLS,
    fieldbeat_ethercat::config::TOOLS,
    fieldbeat_ethernet_ip::config::TOOLS,
    fieldbeat_profibus::config::TOOLS,
];

fn all() -> impl Iterator<Item = &'static Tool> {
    ALL.into_iter().flatten()
}

impl Added {
    /// Does it.
    pub fn run(self) -> Result<(), Stop> {
        let host = Host { interrupt: Interrupt::catch().map_err(Stop::failed)? };
        (self.tool.run)(&self.matches, &host)
    }
}

impl FromArgMatches for Added {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Added, clap::Error> {
        let found = matches.subcommand();
        let added = found.and_then(|(name, matches)| {
            let tool = all().find(|tool| tool.name == name)?;
            Some(Added { tool, matches: matches.clone() })
        });
        added.ok_or_else(|| clap::Error::new(ErrorKind::InvalidSubcommand))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Added::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Subcommand for Added {
    fn augment_subcommands(command: Command) -> Command {
        all().fold(command, |command, tool| command.subcommand(tool.command()))
    }

    fn augment_subcommands_for_update(command: Command) -> Command {
        Added::augment_subcommands(command)
    }

    fn has_subcommand(name: &str) -> bool {
        all().any(|tool| tool.name == name)
    }
}

/// This program.
struct Host {
    interrupt: Interrupt,
}

impl Program for Host {
    fn reach(&self, drive: &Drive) -> Result<Box<dyn Reached>, Stop> {
        Ok(Box::new(Reach::open(drive, |_| Ok(()), &self.interrupt)?))
    }

    fn own(
        &self,
        drive: &Drive,
        no_guardian: bool,
        check: Check<'_>,
    ) -> Result<Box<dyn OwnMaster + '_>, Stop> {
        Ok(Box::new(Own::start(drive, Guarding::new(no_guardian), check, &self.interrupt)?))
    }

    fn print(&self, text: &dyn Display) -> Result<(), Stop> {
        print(text)
    }

    fn complain(&self, line: &str) {
        complain(line);
    }

    fn is_interrupted(&self) -> bool {
        self.interrupt.is_set()
    }

    fn meter(&self) -> Box<dyn FnMut(Progress) -> ControlFlow<()> + '_> {
        Box::new(Meter::new(&self.interrupt).watch())
    }

    fn can_save(&self, path: &Path) -> io::Result<()> {
        Place::of_file(path).map(drop)
    }

    fn save(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        save(path, bytes)
    }
}

impl Reached for Reach {
    fn access(&self) -> Access<'_> {
        Reach::access(self)
    }
}
