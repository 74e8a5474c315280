//! Commands of the program that only one protocol has. Each is defined in the package of its protocol, as one of its
//! `TOOLS`: the program adds them to its own, and gives them its drives, its output and its signals as a [`Program`].
//! For the program only: clap's types show here.

use std::fmt::Display;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use clap::{ArgMatches, Args, Command, FromArgMatches};

use fieldbeat_core::axis::acyclic::{Access, Notation, Progress};
use fieldbeat_core::axis::{Axis, AxisPlan};

/// A command, with its subcommands.
#[derive(Clone, Copy, Debug)]
pub struct Tool {
    /// The name.
    pub name: &'static str,
    /// The purpose, in one sentence without its point.
    pub about: &'static str,
    /// Adds its subcommands.
    pub subcommands: fn(Command) -> Command,
    /// Does it.
    pub run: fn(&ArgMatches, &dyn Program) -> Result<(), Stop>,
}

impl Tool {
    /// The command of clap.
    pub fn command(&self) -> Command {
        let command = Command::new(self.name).subcommand_required(true).arg_required_else_help(true);
        (self.subcommands)(command).about(self.about)
    }
}

/// The arguments of a tool as its own type.
pub fn arguments<T: FromArgMatches>(matches: &ArgMatches) -> Result<T, Stop> {
    T::from_arg_matches(matches).map_err(Stop::usage)
}

/// A table for people: a column is as wide as its widest cell.
pub fn table<const N: usize>(head: [&str; N], rows: impl IntoIterator<Item = [String; N]>) -> String {
    let rows: Vec<[String; N]> = std::iter::once(head.map(str::to_owned)).chain(rows).collect();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; N] = std::array::from_fn(width);
    let line = |row: &[String; N]| {
        let cells = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}"));
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// Why a command ended otherwise than well: what to print, and the exit code.
#[derive(Debug)]
pub struct Stop {
    /// The exit code.
    pub code: u8,
    /// One line for each reason.
    pub message: String,
}

impl Stop {
    /// Bad arguments or configuration: nothing was sent.
    pub fn usage(message: impl ToString) -> Stop {
        Stop { code: 2, message: message.to_string() }
    }

    /// The run failed.
    pub fn failed(message: impl ToString) -> Stop {
        Stop { code: 1, message: message.to_string() }
    }
}

/// Which drive.
#[derive(Debug, Args)]
pub struct Drive {
    /// The configuration of the machine.
    pub config: PathBuf,
    /// The name of the drive.
    pub drive: String,
    /// The process id of its master, where several of this configuration run.
    #[arg(long, value_name = "PID")]
    pub pid: Option<u32>,
}

/// The program around a tool.
pub trait Program {
    /// The way to a drive: through the master that runs, or by one of its own that reads and moves nothing.
    fn reach(&self, drive: &Drive) -> Result<Box<dyn Reached>, Stop>;

    /// A master of its own for one drive, which it may move. Refused next to a master that runs, and where `check`
    /// finds that what is wanted of the axis cannot be: nothing was sent then. Its drive has a guardian unless
    /// `no_guardian` is set.
    fn own(
        &self,
        drive: &Drive,
        no_guardian: bool,
        check: Check<'_>,
    ) -> Result<Box<dyn OwnMaster + '_>, Stop>;

    /// Prints to standard output.
    fn print(&self, text: &dyn Display) -> Result<(), Stop>;

    /// A line of its own on standard error.
    fn complain(&self, line: &str);

    /// Whether its end was requested.
    fn is_interrupted(&self) -> bool;

    /// Shows how far a transfer is until it is dropped; breaks the transfer off if its end was requested.
    fn meter(&self) -> Box<dyn FnMut(Progress) -> ControlFlow<()> + '_>;

    /// Whether a file of that name can be written, before there is anything to write. Leaves nothing behind.
    fn can_save(&self, path: &Path) -> io::Result<()>;

    /// Writes a file whole or not at all.
    fn save(&self, path: &Path, bytes: &[u8]) -> io::Result<()>;
}

/// The check of a wish before anything is sent: by the axis as configured, and by its protocol.
pub type Check<'a> = &'a dyn Fn(&AxisPlan, &dyn Notation) -> Result<(), Stop>;

/// A drive that can be reached.
pub trait Reached {
    /// The name, its notation and the carrier of its calls.
    fn access(&self) -> Access<'_>;
}

/// Lets a little time pass. An error: the drive is to be stopped.
pub type Pause<'a> = &'a mut dyn FnMut() -> Result<(), Stop>;

/// The work on a drive.
pub type Task<'a> = &'a mut dyn FnMut(&mut Axis, Pause<'_>) -> Result<(), Stop>;

/// A master with one drive, of which nothing was requested yet.
pub trait OwnMaster {
    /// That drive.
    fn axis(&mut self) -> &mut Axis;

    /// Waits for the drive, refuses one that somebody else has switched on, and carries out `task`. Whatever comes of
    /// it, the drive is ramped down and switched off then. At the end its position is printed.
    fn run(self: Box<Self>, task: Task<'_>) -> Result<(), Stop>;
}
