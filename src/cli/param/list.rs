//! `fieldbeat param list`. A LinMot drive tells which parameters it has; a Unidrive is asked for each of a menu.

use clap::Args;
use fieldbeat::axis::acyclic::ParameterError;
use fieldbeat::bus::linudp;
use fieldbeat::bus::linudp::service::{Progress, Services};
use fieldbeat::bus::linudp::upid::{Upid, Usage};
use fieldbeat::bus::modbus;
use fieldbeat::bus::modbus::notation::UNREACHABLE;
use fieldbeat::bus::modbus::parameter::{Access, Addressing, Parameter};
use fieldbeat::bus::modbus::wire::ExceptionCode;
use serde_json::{Value, json};

use super::super::interrupt::Interrupt;
use super::super::meter::Meter;
use super::super::reach::Reach;
use super::super::{Stop, print};
use super::{Drive, access, failed};

/// Arguments of `param list`.
#[derive(Debug, Args)]
pub struct List {
    #[command(flatten)]
    drive: Drive,
    /// The menu of a Unidrive, 06, or of the module in a slot of it, 4.15. All that it has there is read.
    menu: Option<String>,
    /// Of a LinMot, only those whose value in flash is not their default, with that value.
    #[arg(long)]
    modified: bool,
    /// Of a LinMot, read the value in use of each, too.
    #[arg(long, conflicts_with = "modified")]
    values: bool,
    /// Of a LinMot, begin with this parameter [default: 0x0000].
    #[arg(long, value_name = "ADDRESS")]
    from: Option<String>,
    /// Print one JSON array.
    #[arg(long)]
    json: bool,
}

/// The highest number of a parameter, whatever the addressing of the drive.
const MOST: u8 = Addressing::Modified.number_max();

/// One parameter.
struct Row {
    address: String,
    name: Option<&'static str>,
    usage: Option<String>,
    raw: Option<u64>,
}

impl List {
    /// Does it.
    pub fn run(self, interrupt: &Interrupt) -> Result<(), Stop> {
        let protocol = self.drive.protocol()?;
        let (reach, rows) = match protocol {
            modbus::PROTOCOL => self.menu(interrupt)?,
            _ => self.upids(interrupt)?,
        };
        if self.json {
            let row = |row: &Row| {
                json!({
                    "address": row.address,
                    "name": row.name,
                    "usage": row.usage,
                    "raw": row.raw,
                    "value": row.raw.map(|raw| reach.notation().number(&row.address, raw)),
                })
            };
            return print(Value::Array(rows.iter().map(row).collect()));
        }
        let width = rows.iter().filter_map(|row| row.usage.as_ref()).map(|usage| usage.len().max(11)).max();
        for Row { address, name, usage, raw } in &rows {
            let mut line = address.clone();
            if let Some(width) = width {
                line += &format!("  {:<width$}", usage.as_deref().unwrap_or_default());
            }
            if let Some(raw) = raw {
                line += &format!("  {}", reach.notation().show(address, *raw));
            }
            if let Some(name) = name {
                line += &format!("  {name}");
            }
            print(line.trim_end())?;
        }
        Ok(())
    }

    /// Those that a LinMot drive names.
    fn upids(&self, interrupt: &Interrupt) -> Result<(Reach, Vec<Row>), Stop> {
        if let Some(menu) = &self.menu {
            return Err(Stop::usage(format!("drive {} has no menus; leave {menu} out", self.drive.drive)));
        }
        let from = self.from.as_deref().unwrap_or("0x0000");
        let Some(first) = Upid::parse(from) else {
            return Err(Stop::usage(format!("--from {from}: no UPID; write 0x1450, or a name")));
        };
        let reach = self.drive.reach(interrupt)?;
        reach.require_protocol(linudp::PROTOCOL)?;
        let services = Services::over(reach.drive(), reach.carrier()).map_err(Stop::failed)?;
        let mut watch = Meter::new(interrupt).watch();
        let row = |upid: Upid, usage: Option<Usage>, raw| Row {
            address: upid.to_string(),
            name: upid.known().map(|known| known.name),
            usage: usage.map(|usage| usage.to_string()),
            raw,
        };
        if self.modified {
            let modified = services.modified_upids(first, &mut watch).map_err(Stop::failed)?;
            let rows = modified.into_iter().map(|(upid, value)| row(upid, None, Some(value.into())));
            let rows = rows.collect();
            drop(watch);
            return Ok((reach, rows));
        }
        let items = services.upids(first, &mut watch).map_err(Stop::failed)?;
        let mut rows = Vec::with_capacity(items.len());
        for (done, item) in items.iter().enumerate() {
            let readable = self.values && item.usage.has(Usage::RAM_READ);
            if readable && watch(Progress { what: "read", done, of: items.len() }).is_break() {
                return Err(broken_off(&reach));
            }
            let value = readable.then(|| access(&reach).read(&item.upid.to_string()).map_err(failed));
            rows.push(row(item.upid, Some(item.usage), value.transpose()?));
        }
        drop(watch);
        Ok((reach, rows))
    }

    /// Those of a menu that a Unidrive gives.
    fn menu(&self, interrupt: &Interrupt) -> Result<(Reach, Vec<Row>), Stop> {
        let drive = &self.drive.drive;
        if self.modified || self.values || self.from.is_some() {
            return Err(Stop::usage(format!(
                "drive {drive} lists by menu, with values; leave --modified, --values and --from out"
            )));
        }
        let Some(menu) = &self.menu else {
            return Err(Stop::usage(format!(
                "drive {drive} lists by menu; name one, like 06, or 4.15 of the module in slot 4"
            )));
        };
        let Ok(first) = format!("{menu}.001").parse::<Parameter>() else {
            return Err(Stop::usage(format!("{menu}: no menu; write 06, or 4.15 of the module in slot 4")));
        };
        let reach = self.drive.reach(interrupt)?;
        let mut watch = Meter::new(interrupt).watch();
        let mut rows = Vec::new();
        for number in 0..=MOST {
            if watch(Progress { what: "read", done: number.into(), of: MOST.into() }).is_break() {
                return Err(broken_off(&reach));
            }
            let parameter = Parameter { number, ..first };
            let address = parameter.to_string();
            match access(&reach).read(&address) {
                Ok(raw) => rows.push(Row {
                    address,
                    name: parameter.known().map(|known| known.name),
                    usage: usage(parameter),
                    raw: Some(raw),
                }),
                Err(ParameterError::Refused { status, .. })
                    if status == u32::from(ExceptionCode::ADDRESS.0) => {}
                // 00.000 is nowhere, and behind the last one that has an address none has.
                Err(ParameterError::Refused { status: UNREACHABLE, .. }) if number == 0 => {}
                Err(
                    ParameterError::Refused { status: UNREACHABLE, .. } | ParameterError::Notation { .. },
                ) => {
                    break;
                }
                Err(error) => return Err(failed(error)),
            }
        }
        drop(watch);
        match rows.is_empty() {
            true => Err(Stop::failed(format!("drive {drive}: menu {menu} has no parameters"))),
            false => Ok((reach, rows)),
        }
    }
}

/// Bits and access, as far as known.
fn usage(parameter: Parameter) -> Option<String> {
    let known = parameter.known()?;
    let access = if known.access == Access::ReadOnly { "read" } else { "read write" };
    Some(format!("{} {access}", known.width.bits()))
}

fn broken_off(reach: &Reach) -> Stop {
    Stop::failed(format!("drive {}: reading its parameters was broken off", reach.drive()))
}
