//! `fieldbeat param`: parameters of a drive, read, written and listed.

mod list;

use clap::{Args, Subcommand};
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_core::axis::{CallError, NotationError, ParameterError, Request};
use fieldbeat_tools::Drive;
use serde_json::json;

use super::interrupt::Interrupt;
use super::reach::Reach;
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

/// The way to read or write `address` of a drive, once `check` has nothing against it.
fn reach_to(
    drive: &Drive,
    access: &'static str,
    address: &str,
    check: impl FnOnce(&dyn Notation) -> Result<(), NotationError>,
    interrupt: &Interrupt,
) -> Result<Reach, Stop> {
    let check = |notation: &dyn Notation| {
        check(notation).map_err(|error| {
            let request = Box::new(Request { access, ..Request::read(&drive.drive, address) });
            failed(ParameterError::Notation { request, error })
        })
    };
    Reach::open(drive, check, interrupt)
}

#[derive(Debug, Args)]
struct Get {
    #[command(flatten)]
    drive: Drive,
    /// The address as the drive's manual writes it: 0x20A8, 0x20A8.rom, .min, .max, .default of a LinMot, 06.042 of a
    /// Unidrive, 0x6041:0 (with a type 0x6041:0.u16, all subindices 0x1C12:ca) of a drive on EtherCAT, AC, R:3 or
    /// 0x01/1/7.text of a MOONS', C0061, C0039/2 (a subcode), C0150.u16 or 1/3 (a record) of a Lenze, or a name.
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
    /// Unidrive, 0x6060:0 (with a type 0x6060:0.i8) of a drive on EtherCAT, AC or R:3 of a MOONS', C0012, C0039/2 (a
    /// subcode) or C0150.u16 of a Lenze, or a name.
    address: String,
    /// A whole number, or its bits as 0x....; for a Unidrive, a MOONS' or a Lenze also a scaled value with a point,
    /// 1500.0.
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
                let reach = reach_to(&get.drive, "read", &get.address, check, &interrupt)?;
                let (raw, text) = reach.access().read_shown(&get.address).map_err(failed)?;
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
        let reach = reach_to(&self.drive, "write", &self.address, check, interrupt)?;
        let notation = reach.notation();
        let written = reach.access().write(&self.address, &self.value).map_err(|error| match error {
            // There is no axis here to disable.
            ParameterError::Failed { why: CallError::Commands, .. } if reach.is_alone() => {
                Stop::failed(format!(
                    "drive {}: write {} = {}: it may command the drive, which another master, or its own \
                     panel or terminals, has switched on: disable it there first",
                    reach.drive(),
                    self.address,
                    self.value
                ))
            }
            error => failed(error),
        })?;
        let mut values = Vec::new();
        for address in notation.read_back(&self.address) {
            let (read, text) = match reach.access().read_shown(&address) {
                Ok(read) => read,
                // What cannot be read was written all the same.
                Err(ParameterError::Refused { .. }) => (written, notation.show(&address, written)),
                Err(error) => return Err(failed(error)),
            };
            values.push((address, read, text));
        }
        let shown = || (written, notation.show(&self.address, written));
        let (shown, text) = values.first().map_or_else(shown, |(_, read, text)| (*read, text.clone()));
        tell(&reach, &self.address, shown, &text, self.json)?;
        match values.iter().find(|(address, read, _)| !notation.is_same(address, written, *read)) {
            None => Ok(()),
            Some((address, _, text)) => Err(Stop::failed(format!(
                "drive {}: {} = {} was written, and {address} is {} now; something else sets it",
                reach.drive(),
                self.address,
                self.value,
                text
            ))),
        }
    }
}

/// What is no address and no number is a mistake of whoever wrote it; the rest is the drive's, or would be.
fn failed(error: ParameterError) -> Stop {
    match error {
        ParameterError::Notation { error: NotationError::Range { .. }, .. } => Stop::failed(error),
        ParameterError::Notation { .. } => Stop::usage(error),
        _ => Stop::failed(error),
    }
}

fn tell(reach: &Reach, address: &str, raw: u64, text: &str, as_json: bool) -> Result<(), Stop> {
    if !as_json {
        return print(format_args!("{} {address}: {text}", reach.drive()));
    }
    let value = reach.notation().number(address, raw);
    print(json!({ "drive": reach.drive(), "address": address, "raw": raw, "value": value, "text": text }))
}
