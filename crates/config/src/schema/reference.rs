//! What the reference of docs/ says of a key: editors show the same sentences.

use serde_json::Value;
use toml::de::{DeTable, DeValue};

use fieldbeat_keys::table::{integer, number};

/// The reference that is common to all protocols.
const COMMON: &str = include_str!("../../files/configuration.md");

/// The keys of a protocol: its own page, over the common one.
#[derive(Clone, Copy, Debug)]
pub struct Reference {
    own: &'static str,
}

/// One row of the reference.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// The default as it stands there.
    default: String,
    meaning: String,
}

/// The sections with the keys of the tables below a path, the innermost first.
const SECTIONS: [(&str, &str); 8] = [
    ("bus.drive.simulate.", "[bus.drive.simulate]"),
    ("bus.simulate.", "[bus.simulate]"),
    ("bus.drive.", "[[bus.drive]]"),
    ("bus.device.", "[[bus.device]]"),
    ("bus.", "[[bus]]"),
    ("cycle.", "[cycle]"),
    ("soak.axis.", "[[soak.axis]]"),
    ("soak.criteria.", "[soak.criteria]"),
];

/// What a row of a device says whose meaning stands with the drives.
const AS_OF_A_DRIVE: &str = "as of a drive";

impl Reference {
    /// That of the protocol with this page.
    pub fn of(own: &'static str) -> Reference {
        Reference { own }
    }

    /// What stands there of the key at `path`, like `bus.drive.limits.velocity`.
    pub fn row(&self, path: &str) -> Option<Row> {
        if let Some(key) = path.strip_prefix("group.") {
            return row(COMMON, "[[group]]", key);
        }
        let (prefix, section) = SECTIONS.iter().find(|(prefix, _)| path.starts_with(prefix))?;
        let key = &path[prefix.len()..];
        let found = row(self.own, section, key).or_else(|| row(COMMON, section, key)).or_else(|| {
            let faults = section.contains("simulate");
            row(COMMON, "simulate", key).filter(|_| faults)
        })?;
        let of_drive = found.meaning.starts_with(AS_OF_A_DRIVE) && *prefix == "bus.device.";
        if !of_drive {
            return Some(found);
        }
        let meant = self.row(&format!("bus.drive.{key}"))?;
        let default = if found.default.starts_with(AS_OF_A_DRIVE) { meant.default } else { found.default };
        Some(Row { default, meaning: meant.meaning })
    }
}

impl Row {
    /// The meaning and the default, for people.
    pub fn description(&self) -> String {
        let meaning = plain(&self.meaning);
        match self.default.as_str() {
            "-" | "none" => format!("{meaning}."),
            default => format!("{meaning}. Default: {}.", plain(default)),
        }
    }

    /// The default, where it is a value and no description of one.
    pub fn default(&self) -> Option<Value> {
        let literal = self.default.strip_prefix('`')?.strip_suffix('`').filter(|text| !text.contains('`'))?;
        let text = format!("value = {literal}");
        let table = DeTable::parse(&text).ok()?;
        table.get_ref().get("value").and_then(|value| json(value.get_ref()))
    }
}

/// The row of `key` in a section of `page`.
fn row(page: &str, section: &str, key: &str) -> Option<Row> {
    let heading = format!("`{section}`\n");
    let text = page.split("\n## ").find_map(|part| part.strip_prefix(&heading))?;
    text.lines().find_map(|line| {
        let (keys, rest) = line.strip_prefix("| `")?.split_once("` | ")?;
        let mut keys = keys.split("`, `");
        let at = keys.clone().position(|known| known == key)?;
        let (default, meaning) = rest.strip_suffix(" |")?.split_once(" | ")?;
        // Several keys in a row have a default each, or one for all.
        let defaults: Vec<&str> = default.split("`, `").collect();
        let default = match defaults.len() {
            several if several > 1 && several == keys.by_ref().count() => {
                format!("`{}`", defaults[at].trim_matches('`'))
            }
            _ => default.to_owned(),
        };
        Some(Row { default, meaning: meaning.to_owned() })
    })
}

/// Text without the targets of its links.
fn plain(text: &str) -> String {
    let mut plain = String::new();
    let mut rest = text;
    while let Some((before, link)) = rest.split_once('[') {
        let Some((label, target)) = link.split_once("](") else { break };
        let Some((_, after)) = target.split_once(')').filter(|_| !label.contains(['[', ']'])) else { break };
        plain = plain + before + label;
        rest = after;
    }
    plain + rest
}

/// A value of TOML as JSON.
fn json(value: &DeValue<'_>) -> Option<Value> {
    Some(match value {
        DeValue::String(text) => text.as_ref().into(),
        DeValue::Boolean(flag) => (*flag).into(),
        DeValue::Integer(_) => i64::try_from(integer(value)?).ok()?.into(),
        DeValue::Float(_) => number(value)?.into(),
        DeValue::Array(list) => {
            list.iter().map(|value| json(value.get_ref())).collect::<Option<Vec<_>>>()?.into()
        }
        DeValue::Table(_) | DeValue::Datetime(_) => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "# Page\n\n## `[[bus]]`\n\n| key | default | meaning |\n|---|---|---|\n\
        | `rate` | `1500` | bit/s: see [below](#below) |\n| `a`, `b` | `5`, `0x10` | of the motor |\n\
        | `c`, `d` | `7` | of both |\n| `e` | `[0x80, 0]` or so | bytes |\n";

    fn of(key: &str) -> (String, Option<Value>) {
        let row = row(PAGE, "[[bus]]", key).unwrap();
        (row.description(), row.default())
    }

    #[test]
    fn a_row_has_a_meaning_and_a_default() {
        assert_eq!(of("rate"), ("bit/s: see below. Default: `1500`.".into(), Some(1500.into())));
        assert_eq!(of("b"), ("of the motor. Default: `0x10`.".into(), Some(16.into())));
        assert_eq!(of("d"), ("of both. Default: `7`.".into(), Some(7.into())));
        assert_eq!(of("e").1, None);
        assert_eq!(row(PAGE, "[[bus]]", "f"), None);
    }

    #[test]
    fn the_page_of_a_protocol_comes_before_the_common_one() {
        let reference = Reference::of(PAGE);
        let meaning = |path: &str| reference.row(path).map(|row| row.meaning);
        assert_eq!(meaning("bus.rate").as_deref(), Some("bit/s: see [below](#below)"));
        assert!(meaning("bus.name").unwrap().starts_with("name in messages"));
        assert!(meaning("cycle.period").unwrap().starts_with("period of the cycle"));
        assert!(meaning("bus.drive.simulate.seed").unwrap().starts_with("seed of the random faults"));
        assert!(meaning("group.axes").unwrap().starts_with("names of its drives"));
        assert_eq!(meaning("bus.nothing"), None);
    }
}
