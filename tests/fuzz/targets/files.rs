//! Files of curves and command tables: no text makes their readers panic, and whatever is read, or came from a drive,
//! is the same when it has been written and read again.

use fieldbeat::bus::linudp::curve::Curve;
use fieldbeat::bus::linudp::motion::EntryId;
use fieldbeat::bus::linudp::table::{Entry, Table};
use fieldbeat::config::linmot::{curve as curve_file, table as table_file};
use fieldbeat_linudp::curve::INFO_SIZE;
use fieldbeat_linudp::table::ENTRY_SIZE;

pub fn files(data: &[u8]) {
    let Some((kind, bytes)) = data.split_first() else { return };
    let text = String::from_utf8_lossy(bytes);
    match kind % 4 {
        0 => match curve_file::parse(&text, "curve.csv") {
            Ok(curve) => curve_survives(&curve),
            Err(errors) => assert_says_something(&errors.to_string(), "curve.csv"),
        },
        1 => match table_file::parse(&text, "table.toml") {
            Ok(table) => table_survives(&table),
            Err(errors) => assert_says_something(&errors.to_string(), "table.toml"),
        },
        2 => {
            let (info, data) = bytes.split_at(bytes.len().min(INFO_SIZE));
            if let Ok(curve) = Curve::decode(info, data) {
                curve_survives(&curve);
            }
        }
        _ => {
            let mut table = Table::new();
            // An id, then its entry.
            for bytes in bytes.chunks_exact(1 + ENTRY_SIZE) {
                if let (Ok(id), Ok(entry)) = (EntryId::new(bytes[0].into()), Entry::decode(&bytes[1..])) {
                    assert_eq!(entry.encode(), bytes[1..], "nothing of an entry is lost");
                    table.insert(id, entry);
                }
            }
            table_survives(&table);
        }
    }
}

/// Every line names the file.
fn assert_says_something(errors: &str, file: &str) {
    assert!(
        !errors.is_empty() && errors.lines().next().is_some_and(|line| line.contains(file)),
        "{errors:?}"
    );
}

fn curve_survives(curve: &Curve) {
    let (info, data) = curve.encode().unwrap_or_else(|error| panic!("{error}: {curve:?}"));
    assert_eq!(Curve::decode(&info, &data).as_ref(), Ok(curve));
    let text = curve_file::to_text(curve).unwrap_or_else(|error| panic!("{error}: {curve:?}"));
    match curve_file::parse(&text, "again.csv") {
        Ok(again) => assert_eq!(again, *curve, "{text}"),
        Err(errors) => panic!("{errors}\n{text}"),
    }
}

fn table_survives(table: &Table) {
    let text = table_file::to_text(table);
    match table_file::parse(&text, "again.toml") {
        Ok(again) => assert_eq!(again, *table, "{text}"),
        Err(errors) => panic!("{errors}\n{text}"),
    }
}
