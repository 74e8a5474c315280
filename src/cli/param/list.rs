//! `fieldbeat param list`. A LinMot drive reports which parameters it has; each of a menu is read from a Unidrive,
//! and of a drive on EtherCAT the known objects are listed.

use clap::Args;
use fieldbeat::axis::acyclic::{Notation, ParameterError};
use fieldbeat::bus::ethercat;
use fieldbeat::bus::ethercat::object::{self, Drives, Known, Object, catalogue};
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
    /// The menu of a Unidrive, 06, or of the module in one of its slots, 4.15. All its parameters are read.
    menu: Option<String>,
    /// For a LinMot: list only parameters whose value in flash is not the default, with that value.
    #[arg(long)]
    modified: bool,
    /// For a LinMot or a drive on EtherCAT: also read the current value of each.
    #[arg(long, conflicts_with = "modified")]
    values: bool,
    /// Begin with this parameter of a LinMot [default: 0x0000], or this object of a drive on EtherCAT [default:
    /// 0x1000].
    #[arg(long, value_name = "ADDRESS")]
    from: Option<String>,
    /// Print one JSON array.
    #[arg(long)]
    json: bool,
}

/// The highest number of a parameter, whatever the addressing of the drive.
const MOST: u8 = Addressing::Modified.number_max();

/// The parameters, and the way to the drive if one was needed.
type Listed = (Option<Reach>, Vec<Row>);

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
            ethercat::PROTOCOL => self.objects(interrupt)?,
            modbus::PROTOCOL => self.menu(interrupt)?,
            _ => self.upids(interrupt)?,
        };
        let notation = reach.as_ref().map_or(&object::Objects as &dyn Notation, Reach::notation);
        if self.json {
            let row = |row: &Row| {
                json!({
                    "address": row.address,
                    "name": row.name,
                    "usage": row.usage,
                    "raw": row.raw,
                    "value": row.raw.map(|raw| notation.number(&row.address, raw)),
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
                line += &format!("  {}", notation.show(address, *raw));
            }
            if let Some(name) = name {
                line += &format!("  {name}");
            }
            print(line.trim_end())?;
        }
        Ok(())
    }

    /// Those that a LinMot drive names.
    fn upids(&self, interrupt: &Interrupt) -> Result<Listed, Stop> {
        if let Some(menu) = &self.menu {
            return Err(Stop::usage(format!("drive {} has no menus; leave {menu} out", self.drive.drive)));
        }
        let from = self.from.as_deref().unwrap_or("0x0000");
        let Some(first) = Upid::parse(from) else {
            return Err(Stop::usage(format!("--from {from}: not a UPID; write 0x1450, or a name")));
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
            return Ok((Some(reach), rows));
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
        Ok((Some(reach), rows))
    }

    /// Those that are known of drives on EtherCAT; with their values those that the drive has.
    fn objects(&self, interrupt: &Interrupt) -> Result<Listed, Stop> {
        let drive = &self.drive.drive;
        if self.modified || self.menu.is_some() {
            let why = "lists its objects; leave --modified and the menu out";
            return Err(Stop::usage(format!("drive {drive} {why}")));
        }
        let from = self.from.as_deref().unwrap_or("0x1000");
        let Some(first) = Object::parse(from) else {
            return Err(Stop::usage(format!("--from {from}: not an object; write 0x6041:0")));
        };
        let key = |object: Object| (object.index, object.sub);
        let all: Vec<&Known> = catalogue::all().filter(|known| key(known.object) >= key(first)).collect();
        let row = |known: &Known, raw| Row {
            address: known.object.to_string(),
            name: Some(known.name),
            usage: Some(usage_of(known)),
            raw,
        };
        if !self.values {
            return Ok((None, all.into_iter().map(|known| row(known, None)).collect()));
        }
        let reach = self.drive.reach(interrupt)?;
        let mut watch = Meter::new(interrupt).watch();
        let mut rows = Vec::with_capacity(all.len());
        for (done, known) in all.iter().enumerate() {
            if watch(Progress { what: "read", done, of: all.len() }).is_break() {
                return Err(broken_off(&reach));
            }
            match access(&reach).read(&known.object.to_string()) {
                Ok(raw) => rows.push(row(known, Some(raw))),
                // Another family has it, or another firmware.
                Err(ParameterError::Refused { .. }) => {}
                Err(error) => return Err(failed(error)),
            }
        }
        drop(watch);
        Ok((Some(reach), rows))
    }

    /// Those of a menu that a Unidrive gives.
    fn menu(&self, interrupt: &Interrupt) -> Result<Listed, Stop> {
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
            return Err(Stop::usage(format!(
                "{menu}: not a menu; write 06, or 4.15 of the module in slot 4"
            )));
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
            false => Ok((Some(reach), rows)),
        }
    }
}

/// Bits and access, as far as known.
fn usage(parameter: Parameter) -> Option<String> {
    let known = parameter.known()?;
    let access = if known.access == Access::ReadOnly { "read" } else { "read write" };
    Some(format!("{} {access}", known.width.bits()))
}

/// Type, access, and which drives have it if not all.
fn usage_of(known: &Known) -> String {
    let access = match known.access {
        object::Access::ReadOnly => "read",
        object::Access::ReadWrite => "read write",
        object::Access::PreOp => "read, write in PREOP",
    };
    let drives = match known.drives {
        Drives::All => "",
        Drives::S700 => ", not AKD",
        Drives::Akd => ", AKD only",
    };
    format!("{} {access}{drives}", known.kind.name())
}

fn broken_off(reach: &Reach) -> Stop {
    Stop::failed(format!("drive {}: reading its parameters was interrupted", reach.drive()))
}
