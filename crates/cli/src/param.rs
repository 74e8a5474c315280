//! `fieldbeat param`: parameters of a drive, read, written and listed.

mod list;

use clap::{Args, Subcommand};
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_core::axis::{CallError, NotationError, ParameterAccess, ParameterError};
use fieldbeat_tools::Drive;
use serde_json::{Value, json};

use super::interrupt::Interrupt;
use super::reach::Reach;
use super::{Stop, print};
use list::List;

/// Arguments of `param`.
#[derive(Debug, Args)]
pub struct Param {
    #[command(subcommand)]
    what: ParamCommand,
}

#[derive(Debug, Subcommand)]
enum ParamCommand {
    /// Reads a parameter, or several of a Unidrive in one request.
    Get(Get),
    /// Writes a parameter and reads it back, or several of a Unidrive in one request.
    Set(Set),
    /// Lists the parameters that the drive has.
    List(List),
}

/// The mistake in an address, or in its value.
fn wrong(drive: &Drive, access: &'static str, address: &str) -> impl Fn(NotationError) -> Stop {
    let request = ParameterAccess { access, ..ParameterAccess::read(&drive.drive, address) };
    move |error| failed(ParameterError::Notation { request: Box::new(request.clone()), error })
}

#[derive(Debug, Args)]
struct Get {
    #[command(flatten)]
    drive: Drive,
    /// The address as the drive's manual writes it: 0x20A8, 0x20A8.rom, .min, .max, .default of a LinMot, 06.042 of a
    /// Unidrive, 0x6041:0 (with a type 0x6041:0.u16, all subindices 0x1C12:ca) of a drive on EtherCAT, AC, R:3 or
    /// 0x01/1/7.text of a MOONS', C0061, C0039/2 (a subcode), C0150.u16 or 1/3 (a record) of a Lenze, or a name.
    address: String,
    /// Of a Unidrive: so many parameters that follow one another, in one request.
    #[arg(long, value_name = "N", default_value_t = 1, hide_default_value = true)]
    count: usize,
    /// Print one JSON object, or an array of them with --count.
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
    /// In the unit in which `param get` shows it, with the unit or without: 1500, "1500 rpm"; of a parameter without
    /// one a whole number. Or its bits as 0x...., or true and false. Several values are those of the parameters of a
    /// Unidrive that follow one another, in one request.
    #[arg(required = true, allow_negative_numbers = true, value_name = "VALUE")]
    values: Vec<String>,
    /// VALUE is a count, as sent on the wire.
    #[arg(long)]
    raw: bool,
    /// Print one JSON object, or an array of them for several values.
    #[arg(long)]
    json: bool,
}

impl Param {
    /// Does it.
    pub fn run(self) -> Result<(), Stop> {
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        match self.what {
            ParamCommand::Get(get) => get.run(&interrupt),
            ParamCommand::Set(set) => set.run(&interrupt),
            ParamCommand::List(list) => list.run(&interrupt),
        }
    }
}

impl Get {
    fn run(self, interrupt: &Interrupt) -> Result<(), Stop> {
        let Get { drive, address, count, json } = &self;
        let check = |notation: &dyn Notation| {
            let known = match count {
                1 => notation.read(address).map(drop),
                count => notation.block(address, *count).map(drop),
            };
            known.map_err(wrong(drive, "read", address))
        };
        let reach = Reach::open(drive, check, interrupt)?;
        if *count != 1 {
            let values = reach.access().read_several(address, *count).map_err(failed)?;
            return tell_all(&reach, &values, *json);
        }
        let (raw, text) = reach.access().read_shown(address).map_err(failed)?;
        tell(&reach, address, raw, &text, *json)
    }
}

impl Set {
    fn run(self, interrupt: &Interrupt) -> Result<(), Stop> {
        match &self.values[..] {
            [value] => self.set_one(value, interrupt),
            values => self.set_several(values, interrupt),
        }
    }

    /// The raw value that is meant.
    fn count(&self, notation: &dyn Notation, address: &str, value: &str) -> Result<u64, NotationError> {
        match self.raw {
            true => notation.value(address, value),
            false => notation.in_unit(address, value),
        }
    }

    /// Several parameters, in one request.
    fn set_several(&self, values: &[String], interrupt: &Interrupt) -> Result<(), Stop> {
        let mut written = Vec::new();
        let check = |notation: &dyn Notation| {
            let block = notation.block(&self.address, values.len());
            let block = block.map_err(wrong(&self.drive, "write", &self.address))?;
            for (address, value) in block.addresses.into_iter().zip(values) {
                let known = self.count(notation, &address, value);
                let known = known.map_err(wrong(&self.drive, "write", &address))?;
                written.push((address, known));
            }
            Ok(())
        };
        let reach = Reach::open(&self.drive, check, interrupt)?;
        let notation = reach.notation();
        let raw: Vec<u64> = written.iter().map(|(_, raw)| *raw).collect();
        reach.access().write_several(&self.address, &raw).map_err(|error| not_written(&reach, error))?;
        let read = match reach.access().read_several(&self.address, raw.len()) {
            Ok(read) => read,
            // What cannot be read was written all the same.
            Err(ParameterError::Refused { .. }) => written,
            Err(error) => return Err(failed(error)),
        };
        tell_all(&reach, &read, self.json)?;
        let others = read
            .iter()
            .zip(&raw)
            .filter(|((address, read), written)| !notation.is_same(address, **written, *read));
        let lines: Vec<String> = others
            .map(|((address, read), written)| {
                let (written, read) = (notation.show(address, *written), notation.show(address, *read));
                let drive = reach.drive();
                format!(
                    "drive {drive}: {address} = {written} was written, and it is {read} now; something else \
                     sets it"
                )
            })
            .collect();
        if lines.is_empty() { Ok(()) } else { Err(Stop::failed(lines.join("\n"))) }
    }

    fn set_one(&self, value: &str, interrupt: &Interrupt) -> Result<(), Stop> {
        let check = |notation: &dyn Notation| {
            let call = self.count(notation, &self.address, value);
            let call = call.and_then(|raw| notation.write(&self.address, raw));
            call.map(drop).map_err(wrong(&self.drive, "write", &self.address))
        };
        let reach = Reach::open(&self.drive, check, interrupt)?;
        let notation = reach.notation();
        let written = match self.raw {
            true => reach.access().write_count(&self.address, value),
            false => reach.access().write(&self.address, value),
        };
        let written = written.map_err(|error| not_written(&reach, error))?;
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
                value,
                text
            ))),
        }
    }
}

/// The end of the program: an address or a number that is none is a mistake of its user; the rest is the drive's, or
/// would be.
fn failed(error: ParameterError) -> Stop {
    match error {
        ParameterError::Notation {
            error: NotationError::Range { .. } | NotationError::OutOfReach { .. },
            ..
        } => Stop::failed(error),
        ParameterError::Notation { .. } => Stop::usage(error),
        _ => Stop::failed(error),
    }
}

/// Why a write was not done.
fn not_written(reach: &Reach, error: ParameterError) -> Stop {
    match error {
        // There is no axis here to disable.
        ParameterError::Failed { request, why: CallError::Commands } if reach.is_alone() => {
            Stop::failed(format!(
                "{request}: it may command the drive, which another master, or its own panel or terminals, has \
                 switched on: disable it there first"
            ))
        }
        error => failed(error),
    }
}

fn shown(reach: &Reach, address: &str, raw: u64, text: &str) -> Value {
    let value = reach.notation().number(address, raw);
    json!({ "drive": reach.drive(), "address": address, "raw": raw, "value": value, "text": text })
}

/// Several parameters, with their raw values.
fn tell_all(reach: &Reach, values: &[(String, u64)], as_json: bool) -> Result<(), Stop> {
    let text = |address: &str, raw: u64| reach.notation().show(address, raw);
    if as_json {
        let all = values.iter().map(|(address, raw)| shown(reach, address, *raw, &text(address, *raw)));
        return print(Value::Array(all.collect()));
    }
    values.iter().try_for_each(|(address, raw)| tell(reach, address, *raw, &text(address, *raw), false))
}

fn tell(reach: &Reach, address: &str, raw: u64, text: &str, as_json: bool) -> Result<(), Stop> {
    if !as_json {
        return print(format_args!("{} {address}: {text}", reach.drive()));
    }
    print(shown(reach, address, raw, text))
}
