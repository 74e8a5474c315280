//! The tables of the manual, made of the keys as the reader declares them.

use std::fmt::Write;

use crate::PROTOCOLS;
use crate::schema::record;
use fieldbeat_keys::form::Record;
use fieldbeat_keys::key::Key;

/// The tables of a machine, whatever its protocols. `simulate`: the faults that simulated drives have in common.
const OF_MACHINES: [&str; 7] = ["cycle", "bus", "bus.drive", SIMULATE, "group", "soak.axis", "soak.criteria"];
/// Those that a protocol may have of its own.
const OF_PROTOCOLS: [&str; 6] =
    ["bus", "bus.drive", DEVICE, "bus.simulate", "bus.drive.simulate", "bus.device.simulate"];
const SIMULATE: &str = "simulate";
const DEVICE: &str = "bus.device";

/// Two protocols whose drives have the faults of simulated drives themselves: they are those of the segment elsewhere.
const WITH_FAULTS: [&str; 2] = ["linudp-v2", "modbus-tcp"];

/// A key with the tables in front of it, and its declaration.
type Row = (String, Key);

/// The sections of the reference of keys, each with its table in Markdown: of all machines, such as `cycle` or
/// `bus.drive`, then what the protocols have of their own, such as `linudp-v2 bus.drive`.
pub fn reference() -> Vec<(String, String)> {
    let records = PROTOCOLS.each_ref().map(record);
    let with_faults = WITH_FAULTS.map(|name| PROTOCOLS.iter().position(|protocol| protocol.name == name));
    let with_faults: Vec<&Record> = with_faults.into_iter().flatten().map(|at| &records[at]).collect();
    let faults = common(&with_faults, "bus.drive.simulate");
    let all: Vec<&Record> = records.iter().collect();
    let mut sections: Vec<(String, Vec<Row>)> = Vec::new();
    for path in OF_MACHINES {
        let rows = match path {
            SIMULATE => faults.clone(),
            _ => common(&all, path),
        };
        sections.push((path.to_owned(), rows));
    }
    for (protocol, record) in PROTOCOLS.iter().zip(&records) {
        for path in OF_PROTOCOLS {
            let known = [common(&all, path), faults.clone()].concat();
            let mut own = rows(record, path);
            own.retain(|row| !known.contains(row));
            if let Some(of_drives) = path.strip_prefix(DEVICE) {
                as_of_a_drive(&mut own, &rows(record, &format!("bus.drive{of_drives}")));
            }
            sections.push((format!("{} {path}", protocol.name), own));
        }
    }
    sections.retain(|(_, rows)| !rows.is_empty());
    sections.into_iter().map(|(section, rows)| (section, table(&rows))).collect()
}

/// The keys that all of these tables have, with one declaration.
fn common(records: &[&Record], path: &str) -> Vec<Row> {
    let mut tables = records.iter().map(|record| rows(record, path));
    let first = tables.next().unwrap_or_default();
    tables.fold(first, |mut common, table| {
        common.retain(|row| table.contains(row));
        common
    })
}

/// The keys of a table, with those of the tables in it that have no section.
fn rows(record: &Record, path: &str) -> Vec<Row> {
    let mut all = Vec::new();
    for noted in record.keys(path) {
        let Key { name, means, .. } = noted.key;
        if !means.is_empty() {
            all.push((name.to_owned(), noted.key));
        }
        let inner = format!("{path}.{name}");
        if !OF_MACHINES.contains(&inner.as_str()) && !OF_PROTOCOLS.contains(&inner.as_str()) {
            let inner = rows(record, &inner).into_iter();
            all.extend(inner.map(|(key, declared)| (format!("{name}.{key}"), declared)));
        }
    }
    all
}

/// Leaves one row of those that stand with the drives.
fn as_of_a_drive(rows: &mut Vec<Row>, of_drives: &[Row]) {
    let (same, own): (Vec<Row>, Vec<Row>) = rows.drain(..).partition(|row| of_drives.contains(row));
    *rows = own;
    if !same.is_empty() {
        let names: Vec<String> = same.into_iter().map(|(name, _)| name).collect();
        let as_there = Key { name: "", default: "(as of a drive)", means: "as of a drive" };
        rows.push((names.join("`, `"), as_there));
    }
}

fn table(rows: &[Row]) -> String {
    let mut text = "| key | default | meaning |\n|---|---|---|\n".to_owned();
    for (name, key) in rows {
        let _ = writeln!(text, "| `{name}` | {} | {} |", key.default_text(), key.means);
    }
    text
}
