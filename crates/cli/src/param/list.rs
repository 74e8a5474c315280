//! `fieldbeat param list`: the parameters that a drive has, as far as its protocol can list them.

use clap::Args;
use fieldbeat_core::axis::Listed;
use fieldbeat_core::axis::acyclic::{ListError, Listing, Wanted};
use serde_json::{Value, json};

use super::super::interrupt::Interrupt;
use super::super::meter::Meter;
use super::super::reach::{self, Reach};
use super::super::{Stop, print};
use super::{Drive, failed};

/// Arguments of `param list`.
#[derive(Debug, Args)]
pub struct List {
    #[command(flatten)]
    drive: Drive,
    /// The menu of a Unidrive, 06, or of the module in one of its slots, 4.15. All its parameters are read. For a
    /// MOONS': parameters, registers or commands.
    menu: Option<String>,
    /// For a LinMot: list only parameters whose value in flash is not the default, with that value.
    #[arg(long)]
    modified: bool,
    /// For a LinMot, a MOONS', a Lenze or a drive on EtherCAT: also read the current value of each.
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

impl List {
    /// Does it.
    pub fn run(self, interrupt: &Interrupt) -> Result<(), Stop> {
        let (_, notation) = reach::find(&self.drive.config, &self.drive.drive)?;
        let wanted = Wanted {
            drive: &self.drive.drive,
            part: self.menu.as_deref(),
            modified: self.modified,
            values: self.values,
            from: self.from.as_deref(),
        };
        let rows = match notation.list(&wanted).map_err(not_listed)? {
            Listing::Known(rows) => rows,
            Listing::Read(read) => {
                let reach = Reach::open(&self.drive, |_| Ok(()), interrupt)?;
                read(reach.access(), &mut Meter::new(interrupt).watch()).map_err(not_listed)?
            }
        };
        if self.json {
            let row = |row: &Listed| {
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
        for Listed { address, name, usage, raw } in &rows {
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
}

fn not_listed(error: ListError) -> Stop {
    match error {
        ListError::Wanted(_) => Stop::usage(error),
        ListError::Parameter(error) => failed(error),
        ListError::Failed(_) | ListError::BrokenOff { .. } => Stop::failed(error),
    }
}
