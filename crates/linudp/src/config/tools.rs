//! `fieldbeat linmot`: what only a LinMot drive has: curves, command table, error log, its software.

mod motion;

use std::io;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde_json::json;

use super::{curve as curve_file, table as table_file};
use crate::curve::Curve;
use crate::service::{CurvePut, LoggedError, Part, Saved, ServiceError, Services};
use fieldbeat_keys::error::ConfigErrors;
use fieldbeat_tools::{Drive, Program, Stop, Tool, arguments};

/// The commands that this protocol adds.
pub const TOOLS: &[Tool] = &[Tool {
    name: "linmot",
    about: "Curves, command table, error log and software of a LinMot drive",
    subcommands: LinMot::augment_subcommands,
    run: |matches, program| arguments::<LinMot>(matches)?.run(program),
}];

#[derive(Debug, Subcommand)]
enum LinMot {
    /// Curves, as CSV files.
    #[command(subcommand)]
    Curve(CurveDoes),
    /// The command table, as a TOML file.
    #[command(subcommand)]
    Table(TableDoes),
    /// Prints the error log, with the drive's own texts.
    Errors(Shown),
    /// Restarts the drive: settings that are only in RAM are lost, and it has to be homed again.
    Restart(Drive),
    /// Stops or starts motion control and application software.
    #[command(subcommand)]
    Software(SoftwareDoes),
    /// Runs one motion command by a master of its own: switches the drive on, waits for its end, switches it off.
    Command(motion::MotionArguments),
    /// Lists the motion commands, with their fields and units.
    Commands(motion::Commands),
    /// Resets a part of the parameters in flash to their defaults, which take effect after a restart.
    Defaults(Defaults),
}

#[derive(Debug, Subcommand)]
enum CurveDoes {
    /// Lists the numbers of the curves in the drive.
    List(Shown),
    /// Reads a curve into a new file.
    Get(CurveGet),
    /// Writes the curve of a file to the drive's RAM, and reads it back.
    Put(Put),
    /// Deletes all curves in the drive's RAM: it cannot delete a single one.
    Delete(Drive),
    /// Saves the curves in RAM to flash.
    Save(Drive),
}

#[derive(Debug, Subcommand)]
enum TableDoes {
    /// Lists the entries in the drive.
    List(Shown),
    /// Reads the whole command table into a new file.
    Get(Get),
    /// Writes the table of a file to the drive's RAM, and reads it back.
    Put(Put),
    /// Deletes all entries in the drive's RAM.
    Delete(Drive),
    /// Saves the table in RAM to flash.
    Save(Drive),
}

#[derive(Debug, Subcommand)]
enum SoftwareDoes {
    /// Stops both: the status word is 0 from then on, and flash can be written.
    Stop(Drive),
    /// Starts both; the drive has to be homed again.
    Start(Drive),
}

#[derive(Debug, Args)]
struct Shown {
    #[command(flatten)]
    drive: Drive,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct Get {
    #[command(flatten)]
    drive: Drive,
    /// The file to write.
    file: PathBuf,
    /// Replace the file if there is one.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Args)]
struct CurveGet {
    #[command(flatten)]
    get: Get,
    /// The number of the curve; needed if the drive has several.
    #[arg(long, value_name = "N")]
    id: Option<u16>,
}

#[derive(Debug, Args)]
struct Put {
    #[command(flatten)]
    drive: Drive,
    /// The file to read.
    file: PathBuf,
    /// Also save it to flash: the drive may be silent for minutes, and has to be homed again.
    #[arg(long)]
    save: bool,
}

#[derive(Debug, Args)]
struct Defaults {
    #[command(flatten)]
    drive: Drive,
    /// os, mc, interface or application.
    #[arg(value_parser = part)]
    part: Part,
}

fn part(word: &str) -> Result<Part, String> {
    let known = Part::WORDS.iter().find(|(known, _)| *known == word);
    known.map(|(_, part)| *part).ok_or_else(|| "must be os, mc, interface or application".to_owned())
}

impl From<ServiceError> for Stop {
    fn from(error: ServiceError) -> Stop {
        Stop::failed(error)
    }
}

impl LinMot {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        match self {
            LinMot::Command(command) => command.run(program),
            LinMot::Commands(commands) => commands.run(program),
            LinMot::Curve(does) => does.run(program),
            LinMot::Table(does) => does.run(program),
            LinMot::Errors(Shown { drive, json }) => with(&drive, program, |desk| desk.errors(json)),
            LinMot::Restart(drive) => {
                with(&drive, program, |desk| desk.done(desk.services.restart(), "restarts"))
            }
            LinMot::Software(SoftwareDoes::Stop(drive)) => with(&drive, program, |desk| {
                desk.done(desk.services.stop_software(), "its software is stopped")
            }),
            LinMot::Software(SoftwareDoes::Start(drive)) => with(&drive, program, |desk| {
                desk.done(desk.services.start_software(), "its software runs; home it")
            }),
            LinMot::Defaults(Defaults { drive, part }) => with(&drive, program, |desk| {
                let reset = desk.services.reset_to_default(part);
                desk.done(reset, "the defaults take effect after a restart; home it")
            }),
        }
    }
}

impl CurveDoes {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        match self {
            CurveDoes::List(Shown { drive, json }) => {
                with(&drive, program, |desk| desk.list(json, desk.services.curves()?, "no curve"))
            }
            CurveDoes::Get(CurveGet { get, id }) => {
                get.check(program)?;
                with(&get.drive, program, |desk| desk.get_curve(&get, id))
            }
            CurveDoes::Put(put) => {
                let curve = put.read(curve_file::load)?;
                with(&put.drive, program, |desk| desk.put_curve(&curve, put.save))
            }
            CurveDoes::Delete(drive) => with(&drive, program, |desk| {
                desk.services.require_off("deleting its curves")?;
                let deleted = desk.services.delete_curves();
                desk.done(deleted, "has no curves in RAM; a restart loads those in flash again")
            }),
            CurveDoes::Save(drive) => with(&drive, program, |desk| desk.save_curves()),
        }
    }
}

impl TableDoes {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        match self {
            TableDoes::List(Shown { drive, json }) => with(&drive, program, |desk| {
                let ids = desk.services.entries()?;
                desk.list(json, ids.iter().map(|id| id.wire()).collect(), "no entry")
            }),
            TableDoes::Get(get) => {
                get.check(program)?;
                with(&get.drive, program, |desk| {
                    let table = desk.services.table(&mut *program.meter())?;
                    get.write(program, &table_file::to_text(&table))?;
                    program.print(&format_args!("{} entries: {}", table.len(), get.file.display()))
                })
            }
            TableDoes::Put(put) => {
                let table = put.read(table_file::load)?;
                with(&put.drive, program, |desk| {
                    desk.services.require_off("writing its command table")?;
                    desk.services.put_table(&table, &mut *program.meter())?;
                    program
                        .print(&format_args!("{} entries are in RAM, read back and compared", table.len()))?;
                    if put.save { desk.save_table() } else { Ok(()) }
                })
            }
            TableDoes::Delete(drive) => with(&drive, program, |desk| {
                desk.services.require_off("deleting its command table")?;
                let deleted = desk.services.delete_table();
                desk.done(deleted, "has no entries in RAM; a restart loads those in flash again")
            }),
            TableDoes::Save(drive) => with(&drive, program, |desk| desk.save_table()),
        }
    }
}

/// The services of a drive, and the program that says what they did.
struct Desk<'a> {
    program: &'a dyn Program,
    services: Services<'a>,
}

/// Does something with the services of a drive.
fn with(
    drive: &Drive,
    program: &dyn Program,
    what: impl FnOnce(&Desk<'_>) -> Result<(), Stop>,
) -> Result<(), Stop> {
    let reach = program.reach(drive)?;
    let access = reach.access();
    let own = access.notation.protocol();
    if own != crate::PROTOCOL {
        return Err(Stop::usage(format!("drive {} speaks {own}, not {}", access.drive, crate::PROTOCOL)));
    }
    what(&Desk { program, services: Services::over(access.drive, access.carrier)? })
}

impl Desk<'_> {
    /// Says what is so, once something was done.
    fn done(&self, result: Result<(), ServiceError>, what: &str) -> Result<(), Stop> {
        result?;
        self.program.print(&format_args!("drive {}: {what}", self.services.drive()))
    }

    fn list(&self, as_json: bool, ids: Vec<u16>, none: &str) -> Result<(), Stop> {
        match ids.is_empty() {
            _ if as_json => self.program.print(&json!(ids)),
            true => self.program.print(&none),
            false => ids.iter().try_for_each(|id| self.program.print(id)),
        }
    }

    fn get_curve(&self, get: &Get, id: Option<u16>) -> Result<(), Stop> {
        let (program, drive) = (self.program, self.services.drive());
        let id = id.map_or_else(|| self.only_curve(), Ok)?;
        let curve = self.services.curve(id, &mut *program.meter())?;
        let curve = curve.ok_or_else(|| Stop::failed(format!("drive {drive} has no curve {id}")))?;
        let text = curve_file::to_text(&curve).map_err(Stop::failed)?;
        get.write(program, &text)?;
        let setpoints = curve.setpoints.len();
        program.print(&format_args!("curve {id}, {setpoints} setpoints: {}", get.file.display()))
    }

    /// The number of the one curve that the drive has.
    fn only_curve(&self) -> Result<u16, Stop> {
        let (ids, drive) = (self.services.curves()?, self.services.drive());
        match ids.as_slice() {
            [id] => Ok(*id),
            [] => Err(Stop::failed(format!("drive {drive} has no curve"))),
            several => {
                let known: Vec<String> = several.iter().map(u16::to_string).collect();
                Err(Stop::usage(format!("drive {drive} has curves {}; name one with --id", known.join(", "))))
            }
        }
    }

    fn put_curve(&self, curve: &Curve, save: bool) -> Result<(), Stop> {
        let Desk { program, services } = self;
        services.require_off("writing a curve")?;
        if services.plan_curve(curve)? == CurvePut::Rebuild {
            program.complain(&format!(
                "drive {} has a curve {} of another size, and can only delete all curves at once: the others are \
                 read first and written again afterwards. If this computer fails meanwhile, restart the drive: \
                 it loads the curves in its flash, and curves that were not saved are lost",
                services.drive(),
                curve.id
            ));
        }
        services.put_curve(curve, &mut *program.meter())?;
        let (id, setpoints) = (curve.id, curve.setpoints.len());
        program
            .print(&format_args!("curve {id}, {setpoints} setpoints, is in RAM, read back and compared"))?;
        if save { self.save_curves() } else { Ok(()) }
    }

    fn save_curves(&self) -> Result<(), Stop> {
        self.save(|| self.services.save_curves(), "its curves are in flash")
    }

    fn save_table(&self) -> Result<(), Stop> {
        self.save(|| self.services.save_table(), "its command table is in flash")
    }

    /// Of a drive that may be saved, so that nobody is announced a save that is refused.
    fn save(&self, save: impl FnOnce() -> Result<Saved, ServiceError>, what: &str) -> Result<(), Stop> {
        self.services.require_off("saving to flash")?;
        self.program.complain(&format!(
            "drive {} saves to flash: it may be silent for minutes; leave its power on, the save cannot be \
             interrupted",
            self.services.drive()
        ));
        let then = match save()? {
            Saved::Acknowledged => "; home it",
            Saved::Silently => {
                " as far as can be seen: it fell silent and came back without an error code; restart it and \
                 check"
            }
        };
        self.done(Ok(()), &format!("{what}{then}"))
    }

    fn errors(&self, as_json: bool) -> Result<(), Stop> {
        let (program, log) = (self.program, self.services.error_log()?);
        if as_json {
            let entry = |error: &LoggedError| {
                let LoggedError { code, text, hours, ms } = error;
                json!({ "code": code, "text": text, "hours": hours, "ms": ms })
            };
            let entries: Vec<_> = log.entries.iter().map(entry).collect();
            return program
                .print(&json!({ "logged": log.logged, "occurred": log.occurred, "entries": entries }));
        }
        program.print(&format_args!("{} errors occurred, {} are logged", log.occurred, log.logged))?;
        for LoggedError { code, text, hours, ms } in &log.entries {
            let (minutes, seconds) = (ms / 60_000, f64::from(ms % 60_000) / 1e3);
            program.print(&format_args!(
                "{hours:>6} h {minutes:02} min {seconds:06.3} s  {code:04X}h  {text}"
            ))?;
        }
        Ok(())
    }
}

impl Get {
    /// Nothing is read for a file that will not be written.
    fn check(&self, program: &dyn Program) -> Result<(), Stop> {
        if self.file.exists() && !self.force {
            return Err(Stop::usage(format!(
                "{} exists; name another file, or replace it with --force",
                self.file.display()
            )));
        }
        program.can_save(&self.file).map_err(|why| Stop::usage(self.unwritten(&why)))
    }

    fn write(&self, program: &dyn Program, text: &str) -> Result<(), Stop> {
        let written = program.save(&self.file, text.as_bytes());
        written.map_err(|why| Stop::failed(self.unwritten(&why)))
    }

    fn unwritten(&self, why: &io::Error) -> String {
        format!("cannot write {}: {why}; name another place", self.file.display())
    }
}

impl Put {
    /// What its file says. A file that is not there is a wrong argument; what is wrong in one is what failed.
    fn read<T>(&self, load: impl FnOnce(PathBuf) -> Result<T, ConfigErrors>) -> Result<T, Stop> {
        load(self.file.clone()).map_err(|errors| match self.file.exists() {
            true => Stop::failed(errors),
            false => Stop::usage(errors),
        })
    }
}
