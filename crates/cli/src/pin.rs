//! `fieldbeat pin`: by what the drives of a configuration are known, as they report it now.
//!
//! The search of each protocol finds them, as it does for `init`; what it finds of a drive besides its place and its
//! type is a key that names it. Nothing is written to a drive.

use std::path::PathBuf;

use clap::Args;
use fieldbeat_config::{self as config, PROTOCOLS};
use fieldbeat_core::axis::AxisPlan;
use fieldbeat_core::bus::{BusFacts, DriveFacts};
use fieldbeat_keys::Protocol;
use fieldbeat_keys::outline::{Found, Known};
use fieldbeat_record::file::save;
use toml::de::{DeTable, DeValue};

use super::interrupt::Interrupt;
use super::{Stop, print};

/// Arguments of `pin`.
#[derive(Debug, Args)]
pub struct Pin {
    /// The configuration.
    config: PathBuf,
    /// Adds the keys to the file, each behind the name of its drive. Without this they are printed only.
    #[arg(long)]
    write: bool,
}

/// The search of one bus.
struct Search<'a> {
    protocol: &'static Protocol,
    axes: Vec<&'a AxisPlan>,
    facts: BusFacts,
    bus: &'a DeTable<'a>,
    drives: Vec<&'a DeTable<'a>>,
}

impl Pin {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        if self.write && self.config.as_os_str() == "-" {
            return Err(Stop::usage("--write changes the file of the configuration: name it in place of -"));
        }
        let loaded = config::load_machine(&self.config).map_err(Stop::usage)?;
        let file = self.config.display().to_string();
        let whole = DeTable::parse(&loaded.text).map_err(|error| Stop::usage(format!("{file}: {error}")))?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let goes_on = || !interrupt.is_set();
        let buses = tables(whole.get_ref(), "bus");
        let (mut added, mut wrong) = (Vec::new(), Vec::new());
        let plan = &loaded.configuration.plan;
        for ((own, facts), bus) in plan.buses.iter().zip(plan.facts()).zip(buses) {
            let named = |protocol: &&Protocol| protocol.name == facts.protocol;
            let Some(protocol) = PROTOCOLS.iter().find(named) else { continue };
            let search = Search { protocol, axes: own.axes(), facts, bus, drives: tables(bus, "drive") };
            search.run(&goes_on, &mut added, &mut wrong)?;
            if !goes_on() {
                return Err(Stop::failed("interrupted; nothing is written"));
            }
        }
        if self.write && !added.is_empty() {
            let text = with(&loaded.text, &added);
            config::parse(&text, &file).map_err(|why| {
                Stop::failed(format!(
                    "{why}\nthe keys do not fit behind the names of the drives: add them by hand"
                ))
            })?;
            let saved = save(&self.config, text.as_bytes());
            saved.map_err(|error| Stop::failed(format!("{file} cannot be written: {error}")))?;
            print(format_args!("{file} is written"))?;
        }
        match wrong.is_empty() {
            true => Ok(()),
            false => Err(Stop::failed(wrong.join("\n"))),
        }
    }
}

/// A line for the file, and where: behind this byte.
type Added = (usize, String);

impl Search<'_> {
    /// Prints what the drives report, and adds what the file has not; what contradicts it is wrong.
    fn run(
        &self,
        goes_on: &dyn Fn() -> bool,
        added: &mut Vec<Added>,
        wrong: &mut Vec<String>,
    ) -> Result<(), Stop> {
        let search = self.protocol.outline.search;
        let axes = &self.axes;
        let found = match search.probes {
            // One by one: what is read of a drive may be a key of its own.
            true => (0..axes.len()).map(|index| self.found(index, index..index + 1, goes_on)).collect(),
            false => self.found(0, 0..axes.len(), goes_on).map(|all| vec![all; axes.len()]),
        };
        let found: Vec<Vec<Found>> = found.map_err(Stop::failed)?;
        for (index, (axis, DriveFacts { place, .. })) in axes.iter().zip(&self.facts.drives).enumerate() {
            let (name, table) = (&axis.name, self.drives.get(index));
            let Some(there) = found[index].iter().find(|found| self.is_at(found, place)) else {
                // Who else is there, or that it is left alone.
                let other = found[index].iter().find(|found| found.lines.is_empty() && search.probes);
                let no_drive = || format!("no drive of its type answers at {place}");
                wrong.push(format!("{name}: {}", other.map_or_else(no_drive, |other| other.what.clone())));
                continue;
            };
            let own = |key: &&(&'static str, String)| {
                !self.protocol.outline.drive.iter().any(|line| line.key == key.0)
            };
            let mut keys = there.lines.iter().filter(own).peekable();
            if keys.peek().is_none() {
                print(format_args!("{name}: {} reports no number by which it is known", there.what))?;
            }
            for (key, value) in keys {
                let line = format!("{key} = {value}");
                match table.and_then(|table| table.get(*key)).map(|given| is(given.get_ref(), value)) {
                    Some(true) => print(format_args!("{name}: {line}, as in the file"))?,
                    Some(false) => wrong.push(format!(
                        "{name}: {line} is what the drive reports, and not what the file has: drives or \
                         cables are exchanged, or correct {key}"
                    )),
                    None => {
                        print(format_args!("{name}: {line}"))?;
                        let name = table.and_then(|table| table.get("name"));
                        added.extend(name.map(|name| (name.span().end, line)));
                    }
                }
            }
        }
        Ok(())
    }

    /// The findings at the places of these drives.
    fn found(
        &self,
        index: usize,
        drives: std::ops::Range<usize>,
        goes_on: &dyn Fn() -> bool,
    ) -> Result<Vec<Found>, String> {
        let outline = &self.protocol.outline;
        let answer = |key: &str| {
            let own = self.drives.get(index).and_then(|table| table.get(key));
            let usual = || self.bus.get("defaults")?.get_ref().as_table()?.get(key);
            own.or_else(usual).or_else(|| self.bus.get(key)).and_then(|value| shown(value.get_ref()))
        };
        let addresses = self.facts.addresses();
        let addresses = addresses.get(drives).unwrap_or_default();
        (outline.search.run)(&Known { index, unit: outline.unit, answer: &answer }, addresses, goes_on)
    }

    /// It was found there. The usual port of an address is left out.
    fn is_at(&self, found: &Found, place: &str) -> bool {
        let outline = &self.protocol.outline;
        let key = outline.drive.first().map(|line| line.key);
        let at = found.lines.iter().find(|(known, _)| Some(*known) == key);
        at.is_some_and(|(_, at)| at == place || format!("{at}:{}", outline.search.port) == place)
    }
}

/// The tables of a list.
fn tables<'a>(table: &'a DeTable<'a>, key: &str) -> Vec<&'a DeTable<'a>> {
    let list = table.get(key).and_then(|list| list.get_ref().as_array());
    list.map(|list| list.iter().filter_map(|one| one.get_ref().as_table()).collect()).unwrap_or_default()
}

/// A value as somebody would type it.
fn shown(value: &DeValue<'_>) -> Option<String> {
    let number = || fieldbeat_keys::table::integer(value).map(|number| number.to_string());
    value.as_str().map(str::to_owned).or_else(number)
}

/// Whether the file has this number, or any.
fn is(given: &DeValue<'_>, value: &str) -> bool {
    let number = |text: &str| match text.strip_prefix("0x") {
        Some(digits) => i128::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    };
    given.as_str() == Some("any") || shown(given).is_some_and(|given| number(&given) == number(value))
}

/// The text with these lines behind the lines of these places.
fn with(text: &str, added: &[Added]) -> String {
    let mut added: Vec<&Added> = added.iter().collect();
    added.sort_by_key(|(at, _)| *at);
    let mut result = text.to_owned();
    for (at, line) in added.into_iter().rev() {
        let end = text.get(*at..).and_then(|rest| rest.find('\n')).map(|end| at + end);
        result.insert_str(end.unwrap_or(text.len()), &format!("\n{line}"));
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use toml::Spanned;

    #[test]
    fn keys_stand_behind_the_names_of_their_drives_and_comments_stay() {
        let text = "a = 1\n[[bus]]\n[[bus.drive]]\nname = \"x\"  # left\n\n[[bus.drive]]\nname = \"y\"";
        let at = |name: &str| text.find(name).map(|at| at + name.len()).unwrap();
        let added = [(at("\"y\""), "serial = 2".into()), (at("\"x\""), "serial = 1".into())];
        let expected = "a = 1\n[[bus]]\n[[bus.drive]]\nname = \"x\"  # left\nserial = 1\n\n[[bus.drive]]\n\
                        name = \"y\"\nserial = 2";
        assert_eq!(with(text, &added), expected);
    }

    #[test]
    fn a_number_is_the_same_in_each_form_and_any_is_each() {
        for (given, value, same) in
            [("0x10", "16", true), ("16", "0x00000010", true), ("\"any\"", "5", true), ("17", "16", false)]
        {
            let text = format!("key = {given}");
            let table = DeTable::parse(&text).unwrap();
            let given: &Spanned<DeValue<'_>> = table.get_ref().get("key").unwrap();
            assert_eq!(is(given.get_ref(), value), same, "{text}");
        }
    }
}
