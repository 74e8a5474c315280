//! The command table of a LinMot drive as a file: TOML, one `[[entry]]` each, values in user units. Knows no drive.
//!
//! What follows is the reference of docs/.
#![doc = include_str!("../../files/linmot-table.md")]

use std::collections::HashMap;
use std::fmt::Write;
use std::path::Path;

use super::name;
use crate::motion::{CATALOGUE, CommandInfo, EntryId, Field, Kind};
use crate::table::{self, Entry, PARAMETERS_SIZE, RESERVED_SIZE};
use fieldbeat_keys::error::ConfigErrors;
use fieldbeat_keys::file;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::key::{Key, key};
use fieldbeat_keys::keys;
use fieldbeat_keys::page::{Page, Place};
use fieldbeat_keys::table::{Table, integer, number};
use fieldbeat_keys::value;

keys! {
    UNUSED "unused" = "none": "for a command by its name: the words behind its last field, if a drive has "
        "other words than 0 there";
    PARAMETERS "parameters" = "none": "for a command by its number: words of 16 bits";
    INCOMPLETE "incomplete" = "false": "`true`: entries may lead to entries that do not exist, as in some "
        "drives";
    ENTRY "entry" = "(`[]` for an empty table)": "the entries";
    ID "id" = "-": "number of the entry, 1 ... 255";
    COMMAND "command" = "-": "a name that `fieldbeat linmot commands` lists, like `\"vai-go-to\"`, or the "
        "number of another command";
    COUNT "count" = "0": "the lowest 4 bits of the header of the command";
    RESERVED "reserved" = "(zeros)": "the last 10 bytes of the entry";
    NEXT "next" = "none": "number of the entry that follows, 1 ... 255; without it the sequence ends here";
}

/// Reads the command table at `path`.
pub fn load(path: impl AsRef<Path>) -> Result<table::Table, ConfigErrors> {
    let (file, text) = file::read(path.as_ref(), "a command table, for example rt-config/linmot-table.toml")?;
    parse(&text, &file)
}

/// Reads the command table `text`; messages call it `file`.
pub fn parse(text: &str, file: &str) -> Result<table::Table, ConfigErrors> {
    let page = Page::new(file, text);
    let entries = page.parse()?;
    let table = entries_of(Table::root(&page, &entries));
    page.verdict()?;
    Ok(table)
}

/// The file of a command table: what [`parse`] makes the same table of.
pub fn to_text(table: &table::Table) -> String {
    let mut text = String::new();
    if !table::dead_ends(table).is_empty() {
        text += "# Some entries lead to ones that are not there.\nincomplete = true\n\n";
    }
    if table.is_empty() {
        text += "entry = []\n";
    }
    for (index, (id, entry)) in table.iter().enumerate() {
        if index > 0 {
            text.push('\n');
        }
        write_entry(&mut text, *id, entry);
    }
    text
}

/// A line each; writing into a `String` cannot fail.
fn write_entry(text: &mut String, id: EntryId, entry: &Entry) {
    let _ = writeln!(text, "[[entry]]\nid = {}", id.wire());
    name::write(text, "", entry.name(), &entry.name);
    match CommandInfo::of(entry.header >> 4).filter(|info| is_sound(info, entry)) {
        Some(info) => {
            let _ = writeln!(text, "command = \"{}\"", info.name);
            for field in info.fields {
                write_field(text, field, field.read(&entry.parameters));
            }
            write_words(text, UNUSED.name, &entry.parameters[info.size()..]);
        }
        None => {
            let _ = writeln!(text, "command = 0x{:03X}", entry.header >> 4);
            write_words(text, PARAMETERS.name, &entry.parameters);
        }
    }
    if entry.header & 0xF != 0 {
        let _ = writeln!(text, "count = {}", entry.header & 0xF);
    }
    if entry.reserved != [0; RESERVED_SIZE] {
        let _ = writeln!(text, "reserved = {:?}", entry.reserved);
    }
    if let Some(next) = entry.next {
        let _ = writeln!(text, "next = {next}");
    }
}

/// All fields are in their ranges: the drive may hold what could not be said in their units.
fn is_sound(info: &CommandInfo, entry: &Entry) -> bool {
    info.fields.iter().all(|field| field.kind.check(field.read(&entry.parameters)).is_ok())
}

fn write_field(text: &mut String, field: &Field, wire: i64) {
    let number = match field.kind {
        Kind::Bits | Kind::Upid => format!("0x{wire:04X}"),
        kind => value::decimal(wire.into(), kind.decimals()),
    };
    let unit = match field.kind.unit() {
        "" => String::new(),
        unit => format!(" # {unit}"),
    };
    let _ = writeln!(text, "{} = {number}{unit}", field.name);
}

/// Words of 16 bits without the zeros at their end; nothing at all if all are zeros.
fn write_words(text: &mut String, key: &str, bytes: &[u8]) {
    let words = bytes.as_chunks().0.iter().map(|word| u16::from_le_bytes(*word));
    let mut words: Vec<String> = words.map(|word| format!("0x{word:04X}")).collect();
    while words.pop_if(|word| word == "0x0000").is_some() {}
    if !words.is_empty() {
        let _ = writeln!(text, "{key} = [{}]", words.join(", "));
    }
}

/// The command of an entry as its file names it.
#[derive(Clone, Copy)]
enum Command {
    Named(&'static CommandInfo),
    Numbered(u16),
}

fn entries_of(mut root: Table<'_>) -> table::Table {
    let incomplete = root.flag(INCOMPLETE).unwrap_or_default();
    let mut result = table::Table::new();
    let mut places: HashMap<EntryId, Place> = HashMap::new();
    let mut leads: HashMap<(EntryId, &str), Place> = HashMap::new();
    if !root.gives("entry") {
        root.fault("entry", "missing; a command table has an [[entry]] for each entry, or is entry = []");
    }
    let empty = root
        .read(ENTRY, Form::Tables, |value| Ok(value.as_array().is_some_and(|entries| entries.is_empty())));
    let tables = if empty == Some(true) { Vec::new() } else { root.tables(ENTRY) };
    for mut table in tables {
        let id = table.integer(ID, 1..=255).and_then(|id| EntryId::new(id).ok());
        if let Some(first) = id.and_then(|id| places.get(&id)) {
            table.fault("id", format!("is already the entry of {first}; ids are unique"));
        } else if let Some(id) = id {
            places.insert(id, table.place("id"));
        }
        let Some(command) = command(&mut table) else { continue };
        if let (Some(entry), Some(id)) = (entry(&mut table, command, incomplete), id) {
            leads.extend(entry.leads_to().map(|(by, _)| ((id, by), table.place(by))));
            result.insert(id, entry);
        }
        table.finish();
    }
    for end in table::dead_ends(&result) {
        // An entry that is there but wrong was reported as that.
        let wrong = places.keys().any(|id| i64::from(id.wire()) == end.to);
        if let (false, false, Some(place)) = (incomplete, wrong, leads.get(&(end.entry, end.by))) {
            let to = end.to;
            root.report(
                place,
                format!("leads to entry {to}, which does not exist; add it or change the reference"),
            );
        }
    }
    root.finish();
    result
}

/// The command by its name or number. Without it nobody knows which other keys are right.
fn command(table: &mut Table<'_>) -> Option<Command> {
    table.read(COMMAND, Form::Text(None).or(Form::integer(0..=0xFFF)), |value| {
        match (value.as_str(), integer(value)) {
            (Some(name), _) => CommandInfo::named(name).map(Command::Named).ok_or_else(|| {
                let names = CATALOGUE.iter().map(|info| info.name);
                let meant = value::closest(name, names).map(|name| format!("did you mean \"{name}\"? "));
                let meant = meant.unwrap_or_default();
                format!("no such command; {meant}one without a name is given by its number, like 0x010")
            }),
            (None, Some(id @ 0..=0xFFF)) => Ok(Command::Numbered(id as u16)),
            _ => Err("must be a name like \"vai-go-to\", or a number up to 0xFFF".into()),
        }
    })
}

fn entry(table: &mut Table<'_>, command: Command, incomplete: bool) -> Option<Entry> {
    let hint = "at most 15 printable ASCII characters";
    let name = name::read(table, hint, |name| Entry::name_bytes(name).ok());
    let count: u16 = table.integer(COUNT, 0..=15).unwrap_or(0);
    let reserved = table.bytes::<RESERVED_SIZE>(RESERVED).unwrap_or_default();
    let next = match incomplete {
        true => table.integer(NEXT, 0..=0xFFFE),
        false => table.integer(NEXT, 1..=255),
    };
    let (mut parameters, mut whole) = ([0; PARAMETERS_SIZE], true);
    let id = match command {
        Command::Named(info) => {
            for field in info.fields {
                match self::field(table, field) {
                    Some(wire) => field.write(&mut parameters, wire),
                    None => whole = false,
                }
            }
            words(table, UNUSED, &mut parameters[info.size()..]);
            info.id
        }
        Command::Numbered(id) => {
            words(table, PARAMETERS, &mut parameters);
            id
        }
    };
    whole.then_some(Entry { next, header: id << 4 | count, parameters, name, reserved })
}

/// The wire integer of a field.
fn field(table: &mut Table<'_>, field: &Field) -> Option<i64> {
    let kind = field.kind;
    let (low, high) = kind.range();
    let [low, high] = [low, high].map(|bound| value::decimal(bound.into(), kind.decimals()));
    let range = format!("{low} to {high} {}", kind.unit());
    let range = range.trim_end();
    if !table.gives(field.name) {
        table.fault(field.name, format!("missing; a parameter of the command, {range}"));
    }
    let key = key(field.name, "(required)", "a parameter of the command");
    let form = if kind.decimals() == 0 { Form::integer(..) } else { Form::number(..) };
    table.read(key, form, |value| match kind.decimals() {
        0 => (integer(value).and_then(|value| i64::try_from(value).ok()))
            .filter(|value| kind.check(*value).is_ok())
            .ok_or_else(|| format!("must be a whole number, {range}")),
        _ => (number(value).and_then(|value| kind.wire(value).ok()))
            .ok_or_else(|| format!("must be a number, {range}")),
    })
}

/// Words of 16 bits into `parameters`, zeros behind them.
fn words(table: &mut Table<'_>, key: Key, parameters: &mut [u8]) {
    let words = table.integers(key, parameters.len() / 2, u16::MAX);
    for (place, word) in parameters.as_chunks_mut().0.iter_mut().zip(words) {
        *place = word.to_le_bytes();
    }
}

#[cfg(test)]
mod tests;
