//! `fieldbeat param`: parameters of a drive, read, written and listed.

mod list;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use fieldbeat::axis::acyclic::{Access, CallError, Notation, NotationError, ParameterError, Request};
use fieldbeat::bus::ethercat;
use fieldbeat::bus::ethercat::object::{Target, Type, long};
use fieldbeat::cycle::Plan;
use serde_json::json;

use super::interrupt::Interrupt;
use super::masters::Wanted;
use super::reach::{self, Reach};
use super::{Stop, print};
use list::List;

/// Arguments of `param`.
#[derive(Debug, Args)]
pub struct Param {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Reads a parameter.
    Get(Get),
    /// Writes a parameter and reads it back.
    Set(Set),
    /// Lists the parameters that the drive has.
    List(List),
}

/// Which drive.
#[derive(Debug, Args)]
pub struct Drive {
    /// The configuration of the machine.
    config: PathBuf,
    /// The name of the drive.
    drive: String,
    /// The process id of its master, where several of this configuration run.
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
}

impl Drive {
    /// Its plan without the other drives, for a master of its own that moves it; refused next to one that runs.
    pub fn alone(&self) -> Result<(Plan, String), Stop> {
        let (plan, _) = reach::find(&self.config, &self.drive)?;
        let wanted = Wanted { config: Some(&self.config), pid: self.pid };
        if reach::running(wanted, &self.drive)?.is_some() {
            let why = "a master runs, and it alone moves its drives: end it first";
            return Err(Stop::failed(format!("drive {}: {why}", self.drive)));
        }
        match plan.alone(&self.drive) {
            Some(plan) => Ok((plan, self.drive.clone())),
            None => Err(Stop::failed(format!("drive {} cannot be reached alone", self.drive))),
        }
    }

    /// What it speaks.
    fn protocol(&self) -> Result<&'static str, Stop> {
        let (_, notation) = reach::find(&self.config, &self.drive)?;
        Ok(notation.protocol())
    }

    /// The way to it.
    pub fn reach(&self, interrupt: &Interrupt) -> Result<Reach, Stop> {
        Reach::open(&self.config, &self.drive, self.pid, |_| Ok(()), interrupt)
    }

    /// The same to read or write `address`, once `check` has nothing against it.
    fn reach_to(
        &self,
        access: &'static str,
        address: &str,
        check: impl FnOnce(&dyn Notation) -> Result<(), NotationError>,
        interrupt: &Interrupt,
    ) -> Result<Reach, Stop> {
        let check = |notation: &dyn Notation| {
            check(notation).map_err(|error| {
                let request = Box::new(Request { access, ..Request::read(&self.drive, address) });
                failed(ParameterError::Notation { request, error })
            })
        };
        Reach::open(&self.config, &self.drive, self.pid, check, interrupt)
    }
}

#[derive(Debug, Args)]
struct Get {
    #[command(flatten)]
    drive: Drive,
    /// The address as the drive's manual writes it: 0x20A8, 0x20A8.rom, .min, .max, .default of a LinMot, 06.042 of a
    /// Unidrive, 0x6041:0 (with a type 0x6041:0.u16, all subindices 0x1C12:ca) of a drive on EtherCAT, or a name.
    address: String,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct Set {
    #[command(flatten)]
    drive: Drive,
    /// The address as the drive's manual writes it: 0x20A8 (RAM), 0x20A8.rom, 0x20A8.both of a LinMot, 06.042 of a
    /// Unidrive, 0x6060:0 (with a type 0x6060:0.i8) of a drive on EtherCAT, or a name.
    address: String,
    /// A whole number, or its bits as 0x....; for a Unidrive also a scaled value with a point, 1500.0.
    #[arg(allow_negative_numbers = true)]
    value: String,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Param {
    /// Does it.
    pub fn run(self) -> Result<(), Stop> {
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        match self.what {
            What::Get(get) => {
                let check = |notation: &dyn Notation| notation.read(&get.address).map(drop);
                let reach = get.drive.reach_to("read", &get.address, check, &interrupt)?;
                let (raw, text) = read(&reach, &get.address).map_err(failed)?;
                tell(&reach, &get.address, raw, &text, get.json)
            }
            What::Set(set) => set.run(&interrupt),
            What::List(list) => list.run(&interrupt),
        }
    }
}

impl Set {
    fn run(self, interrupt: &Interrupt) -> Result<(), Stop> {
        let check = |notation: &dyn Notation| {
            let raw = notation.value(&self.address, &self.value)?;
            notation.write(&self.address, raw).map(drop)
        };
        let reach = self.drive.reach_to("write", &self.address, check, interrupt)?;
        let notation = reach.notation();
        let written = access(&reach).write(&self.address, &self.value).map_err(|error| match error {
            // There is no axis here to disable.
            ParameterError::Failed { why: CallError::Commands, .. } if reach.is_alone() => {
                Stop::failed(format!(
                    "drive {}: write {} = {}: it may command the drive, which another master, or its own panel or \
                     terminals, has switched on: disable it there first",
                    reach.drive(),
                    self.address,
                    self.value
                ))
            }
            error => failed(error),
        })?;
        let mut values = Vec::new();
        for address in notation.read_back(&self.address) {
            let read = match access(&reach).read(&address) {
                Ok(raw) => raw,
                // What cannot be read was written all the same.
                Err(ParameterError::Refused { .. }) => written,
                Err(error) => return Err(failed(error)),
            };
            values.push((address, read));
        }
        let shown = values.first().map_or(written, |(_, read)| *read);
        tell(&reach, &self.address, shown, &notation.show(&self.address, shown), self.json)?;
        match values.iter().find(|(address, read)| !notation.is_same(address, written, *read)) {
            None => Ok(()),
            Some((address, read)) => Err(Stop::failed(format!(
                "drive {}: {} = {} was written, and {address} is {} now; something else sets it",
                reach.drive(),
                self.address,
                self.value,
                notation.show(address, *read)
            ))),
        }
    }
}

fn access(reach: &Reach) -> Access<'_> {
    Access { drive: reach.drive(), notation: reach.notation(), carrier: reach.carrier() }
}

/// What is no address and no number is a mistake of whoever wrote it; the rest is the drive's, or would be.
fn failed(error: ParameterError) -> Stop {
    match error {
        ParameterError::Notation { error: NotationError::Range { .. }, .. } => Stop::failed(error),
        ParameterError::Notation { .. } => Stop::usage(error),
        _ => Stop::failed(error),
    }
}

/// The raw value of a parameter, and its text.
fn read(reach: &Reach, address: &str) -> Result<(u64, String), ParameterError> {
    let notation = reach.notation();
    if notation.protocol() == ethercat::PROTOCOL
        && let Some(target) = Target::parse(address)
        && (target.complete || target.kind == Some(Type::Text))
    {
        return read_long(reach, address, target);
    }
    let raw = access(reach).read(address)?;
    Ok((raw, notation.show(address, raw)))
}

/// The same of an object that may be longer than a raw value: its first eight bytes are that.
fn read_long(reach: &Reach, address: &str, target: Target) -> Result<(u64, String), ParameterError> {
    let notation = reach.notation();
    let limit = notation.limit(&target.read());
    let bytes = long::read(reach.carrier(), target, limit)
        .map_err(|why| Request::read(reach.drive(), address).failed(why, notation))?;
    let text = if target.complete { long::octets(&bytes) } else { long::text(&bytes) };
    Ok((long::raw(&bytes), text))
}

fn tell(reach: &Reach, address: &str, raw: u64, text: &str, as_json: bool) -> Result<(), Stop> {
    if !as_json {
        return print(format_args!("{} {address}: {text}", reach.drive()));
    }
    let value = reach.notation().number(address, raw);
    print(json!({ "drive": reach.drive(), "address": address, "raw": raw, "value": value, "text": text }))
}
