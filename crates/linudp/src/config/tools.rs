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
    arguments: LinMot::augment_args,
    run: |matches, program| arguments::<LinMot>(matches)?.run(program),
}];

/// Arguments of `linmot`.
#[derive(Debug, Args)]
struct LinMot {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
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
        match self.what {
            What::Command(command) => command.run(program),
            What::Commands(commands) => commands.run(program),
            What::Curve(does) => does.run(program),
            What::Table(does) => does.run(program),
            What::Errors(shown) => {
                with(&shown.drive, program, |services| errors(program, services, shown.json))
            }
            What::Restart(drive) => with(&drive, program, |services| {
                services.restart()?;
                done(program, services, "restarts")
            }),
            What::Software(SoftwareDoes::Stop(drive)) => with(&drive, program, |services| {
                services.stop_software()?;
                done(program, services, "its software is stopped")
            }),
            What::Software(SoftwareDoes::Start(drive)) => with(&drive, program, |services| {
                services.start_software()?;
                done(program, services, "its software runs; home it")
            }),
            What::Defaults(defaults) => with(&defaults.drive, program, |services| {
                services.reset_to_default(defaults.part)?;
                done(program, services, "the defaults take effect after a restart; home it")
            }),
        }
    }
}

impl CurveDoes {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        match self {
            CurveDoes::List(shown) => with(&shown.drive, program, |services| {
                let ids = services.curves()?;
                list(program, shown.json, ids, "no curve")
            }),
            CurveDoes::Get(CurveGet { get, id }) => {
                get.check(program)?;
                with(&get.drive, program, |services| {
                    let id = match id {
                        Some(id) => id,
                        None => only(services)?,
                    };
                    let curve = services.curve(id, &mut *program.meter())?;
                    let Some(curve) = curve else {
                        let drive = services.drive();
                        return Err(Stop::failed(format!("drive {drive} has no curve {id}")));
                    };
                    let text = curve_file::to_text(&curve).map_err(Stop::failed)?;
                    get.write(program, &text)?;
                    let setpoints = curve.setpoints.len();
                    program.print(&format_args!("curve {id}, {setpoints} setpoints: {}", get.file.display()))
                })
            }
            CurveDoes::Put(put) => {
                let curve = put.read(curve_file::load)?;
                with(&put.drive, program, |services| put_curve(program, services, &curve, &put))
            }
            CurveDoes::Delete(drive) => with(&drive, program, |services| {
                services.require_off("deleting its curves")?;
                services.delete_curves()?;
                done(program, services, "has no curves in RAM; a restart loads those in flash again")
            }),
            CurveDoes::Save(drive) => with(&drive, program, |services| save_curves(program, services)),
        }
    }
}

impl TableDoes {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        match self {
            TableDoes::List(shown) => with(&shown.drive, program, |services| {
                let ids = services.entries()?;
                list(program, shown.json, ids.iter().map(|id| id.wire()).collect(), "no entry")
            }),
            TableDoes::Get(get) => {
                get.check(program)?;
                with(&get.drive, program, |services| {
                    let table = services.table(&mut *program.meter())?;
                    get.write(program, &table_file::to_text(&table))?;
                    program.print(&format_args!("{} entries: {}", table.len(), get.file.display()))
                })
            }
            TableDoes::Put(put) => {
                let table = put.read(table_file::load)?;
                with(&put.drive, program, |services| {
                    services.require_off("writing its command table")?;
                    services.put_table(&table, &mut *program.meter())?;
                    program
                        .print(&format_args!("{} entries are in RAM, read back and compared", table.len()))?;
                    if put.save { save_table(program, services) } else { Ok(()) }
                })
            }
            TableDoes::Delete(drive) => with(&drive, program, |services| {
                services.require_off("deleting its command table")?;
                services.delete_table()?;
                done(program, services, "has no entries in RAM; a restart loads those in flash again")
            }),
            TableDoes::Save(drive) => with(&drive, program, |services| save_table(program, services)),
        }
    }
}

/// Does something with the services of a drive.
fn with(
    drive: &Drive,
    program: &dyn Program,
    what: impl FnOnce(&Services<'_>) -> Result<(), Stop>,
) -> Result<(), Stop> {
    let reach = program.reach(drive)?;
    let access = reach.access();
    let own = access.notation.protocol();
    if own != crate::PROTOCOL {
        return Err(Stop::usage(format!("drive {} speaks {own}, not {}", access.drive, crate::PROTOCOL)));
    }
    let services = Services::over(access.drive, access.carrier)?;
    what(&services)
}

fn done(program: &dyn Program, services: &Services<'_>, what: &str) -> Result<(), Stop> {
    program.print(&format_args!("drive {}: {what}", services.drive()))
}

fn list(program: &dyn Program, as_json: bool, ids: Vec<u16>, none: &str) -> Result<(), Stop> {
    if as_json {
        return program.print(&json!(ids));
    }
    match ids.is_empty() {
        true => program.print(&none),
        false => ids.iter().try_for_each(|id| program.print(id)),
    }
}

/// The number of the one curve that the drive has.
fn only(services: &Services<'_>) -> Result<u16, Stop> {
    let (ids, drive) = (services.curves()?, services.drive());
    match ids.as_slice() {
        [id] => Ok(*id),
        [] => Err(Stop::failed(format!("drive {drive} has no curve"))),
        several => {
            let known: Vec<String> = several.iter().map(u16::to_string).collect();
            Err(Stop::usage(format!("drive {drive} has curves {}; name one with --id", known.join(", "))))
        }
    }
}

fn put_curve(program: &dyn Program, services: &Services<'_>, curve: &Curve, put: &Put) -> Result<(), Stop> {
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
    let setpoints = curve.setpoints.len();
    program.print(&format_args!(
        "curve {}, {setpoints} setpoints, is in RAM, read back and compared",
        curve.id
    ))?;
    if put.save { save_curves(program, services) } else { Ok(()) }
}

fn save_curves(program: &dyn Program, services: &Services<'_>) -> Result<(), Stop> {
    save_to_flash(program, services, Services::save_curves, "its curves are in flash")
}

fn save_table(program: &dyn Program, services: &Services<'_>) -> Result<(), Stop> {
    save_to_flash(program, services, Services::save_table, "its command table is in flash")
}

/// Of a drive that may be saved, so that nobody is announced a save that is refused.
fn save_to_flash<'a>(
    program: &dyn Program,
    services: &Services<'a>,
    save: fn(&Services<'a>) -> Result<Saved, ServiceError>,
    what: &str,
) -> Result<(), Stop> {
    services.require_off("saving to flash")?;
    program.complain(&format!(
        "drive {} saves to flash: it may be silent for minutes; leave its power on, the save cannot be \
         interrupted",
        services.drive()
    ));
    let then = match save(services)? {
        Saved::Acknowledged => "; home it",
        Saved::Silently => {
            " as far as can be seen: it fell silent and came back without an error code; restart it and check"
        }
    };
    done(program, services, &format!("{what}{then}"))
}

fn errors(program: &dyn Program, services: &Services<'_>, as_json: bool) -> Result<(), Stop> {
    let log = services.error_log()?;
    if as_json {
        let mut entries = Vec::new();
        for LoggedError { code, text, hours, ms } in &log.entries {
            entries.push(json!({ "code": code, "text": text, "hours": hours, "ms": ms }));
        }
        return program.print(&json!({ "logged": log.logged, "occurred": log.occurred, "entries": entries }));
    }
    program.print(&format_args!("{} errors occurred, {} are logged", log.occurred, log.logged))?;
    for entry in &log.entries {
        let (minutes, ms) = (entry.ms / 60_000, entry.ms % 60_000);
        let seconds = f64::from(ms) / 1e3;
        program.print(&format_args!(
            "{:>6} h {minutes:02} min {seconds:06.3} s  {:04X}h  {}",
            entry.hours, entry.code, entry.text
        ))?;
    }
    Ok(())
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
