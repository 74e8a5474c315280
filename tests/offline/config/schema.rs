//! The schema against the reader: each range, word, form and default that it states is the reader's.

use std::collections::BTreeMap;

use fieldbeat::config::parse;
use fieldbeat_config::schema;
use serde_json::Value;

use super::machine;

/// Where a key of the schema can be set: the section of a machine, and the path in messages.
const PLACES: [(&str, &str, &str, &str); 14] = [
    ("cycle", "cycle", "/properties/cycle", ""),
    ("bus", "bus", "/definitions/linudp-v2", "drive"),
    ("drive", "bus.drive", "/definitions/linudp-v2/properties/drive/items", ""),
    ("unidrive-bus", "bus", "/definitions/modbus-tcp", "drive"),
    ("unidrive", "bus.drive", "/definitions/modbus-tcp/properties/drive/items", ""),
    ("ethercat-bus", "bus", "/definitions/ethercat", "drive device"),
    ("ethercat", "bus.drive", "/definitions/ethercat/properties/drive/items", ""),
    ("ethercat-device", "bus.device", "/definitions/ethercat/properties/device/items", ""),
    ("moons-bus", "bus", "/definitions/ethernet-ip", "drive"),
    ("moons", "bus.drive", "/definitions/ethernet-ip/properties/drive/items", ""),
    ("lenze-bus", "bus", "/definitions/profibus-dp", "drive"),
    ("lenze", "bus.drive", "/definitions/profibus-dp/properties/drive/items", ""),
    ("soak-axis", "soak.axis", "/properties/soak/properties/axis/items", "drive"),
    ("soak-criteria", "soak.criteria", "/properties/soak/properties/criteria", ""),
];

/// The keys that each machine here has already.
const SET: [&str; 8] =
    ["name", "address", "bind", "protocol", "interface", "device", "rate", "limits.velocity"];

/// The keys that the schema states below a table, by their dotted names.
fn keys<'a>(table: &'a Value, before: &str, found: &mut BTreeMap<String, &'a Value>) {
    for (name, key) in table["properties"].as_object().into_iter().flatten() {
        let name = format!("{before}{name}");
        if key["properties"].is_object() {
            keys(key, &format!("{name}."), found);
        } else {
            found.insert(name, key);
        }
    }
}

/// What the reader says of `key = value` there; none if it takes it.
fn said(section: &str, path: &str, key: &str, value: &str) -> Option<String> {
    let mistakes = parse(&machine(section, &format!("{key} = {value}")), "m.toml").err()?;
    let at = format!(": {path}.{key}");
    let lines = mistakes.to_string();
    lines.lines().find(|line| line.contains(&at)).map(str::to_owned)
}

/// Whether the reader refuses the value itself, and not its company.
fn is_of_the_value(message: &str) -> bool {
    ["must be", "is out of range", "has an unknown"].iter().any(|words| message.contains(words))
}

/// Whether it refuses a number by one of its own bounds.
fn is_of_the_range(message: &str) -> bool {
    ["must be at least ", "must be above ", "must be at most ", "must be below "].iter().any(|words| {
        let bound = message.split_once(words).map_or("", |(_, bound)| bound);
        bound.starts_with(|first: char| first.is_ascii_digit() || first == '-')
    })
}

/// The places with all their keys that no machine here has already.
fn visit(mut check: impl FnMut(&str, &str, &str, &Value)) {
    let schema = schema();
    for (section, path, at, without) in PLACES {
        let mut found = BTreeMap::new();
        keys(schema.pointer(at).expect(at), "", &mut found);
        assert!(found.len() > 1, "{at}");
        let other = |key: &str| {
            let first = key.split('.').next().unwrap_or_default();
            without.split(' ').any(|name| name == first) || first == "defaults" || SET.contains(&key)
        };
        for (key, stated) in found.into_iter().filter(|(key, _)| !other(key)) {
            check(section, path, &key, stated);
        }
    }
}

/// The forms that a key may have, each on its own.
fn forms(stated: &Value) -> Vec<&Value> {
    stated["anyOf"].as_array().map_or_else(|| vec![stated], |forms| forms.iter().collect())
}

#[test]
fn ranges_end_where_the_reader_ends_them() {
    let mut ends = 0;
    visit(|section, path, key, stated| {
        for form in forms(stated) {
            let whole = form["type"] == "integer";
            let step = if whole { 1.0 } else { 1e-9 };
            for (end, inside, outside) in [
                ("minimum", 0.0, -step),
                ("maximum", 0.0, step),
                ("exclusiveMinimum", step, 0.0),
                ("exclusiveMaximum", -step, 0.0),
            ] {
                let Some(bound) = form[end].as_f64() else { continue };
                // Far from zero a number has no such small step.
                let step = |by: f64| match form[end].as_i64().filter(|_| whole) {
                    Some(bound) => (bound + by as i64).to_string(),
                    None => (bound + by * bound.abs().max(1.0)).to_string(),
                };
                ends += 1;
                let refused = said(section, path, key, &step(outside));
                assert!(refused.is_some(), "{section}: {key} = {} is taken", step(outside));
                let taken = said(section, path, key, &step(inside));
                assert!(!taken.as_deref().is_some_and(is_of_the_range), "{section}: {taken:?}");
            }
        }
    });
    assert!(ends > 400, "{ends}");
}

#[test]
fn words_are_those_of_the_reader() {
    let mut words = 0;
    visit(|section, path, key, stated| {
        for form in forms(stated) {
            for word in form["enum"].as_array().into_iter().flatten().chain(form.get("const")) {
                words += 1;
                let taken = said(section, path, key, &word.to_string());
                assert!(!taken.as_deref().is_some_and(is_of_the_value), "{section}: {taken:?}");
            }
        }
        // No key takes these. Names and addresses of others have no such characters.
        let any_text =
            forms(stated).iter().any(|form| form["type"] == "string" && form["pattern"] == Value::Null);
        let not_empty = forms(stated).iter().any(|form| form["pattern"] == ".");
        if !any_text && !not_empty {
            let refused = said(section, path, key, "\"no such / word\"");
            assert!(refused.is_some(), "{section}: {key} takes any text");
        }
    });
    assert!(words > 200, "{words}");
}

#[test]
fn no_key_takes_a_value_of_another_form() {
    let samples = [
        ("boolean", "true"),
        ("boolean", "false"),
        ("integer", "1"),
        ("number", "1.5"),
        ("array", "[]"),
        ("object", "{}"),
    ];
    let mut tried = 0;
    visit(|section, path, key, stated| {
        for (kind, value) in samples {
            let json: Value = serde_json::from_str(value).unwrap();
            let may = forms(stated).iter().any(|form| {
                form["type"] == kind
                    || form["type"] == "number" && kind == "integer"
                    || form.get("const") == Some(&json)
                    || form["enum"].as_array().is_some_and(|words| words.contains(&json))
            });
            if !may {
                tried += 1;
                let refused = said(section, path, key, value);
                assert!(refused.is_some(), "{section}: {key} = {value} is taken");
            }
        }
    });
    assert!(tried > 2000, "{tried}");
}

/// Keys that are kept as they are given: without them what they concern has the default itself.
const KEPT: [&str; 2] = ["simulate.emulated", "simulate.fmmus"];

/// A key with its default reads as without it, unless it needs another key.
#[test]
fn defaults_are_those_of_the_reader() {
    let mut seen = 0;
    visit(|section, _, key, stated| {
        let Some(default) = stated.get("default").filter(|_| !KEPT.contains(&key)) else { return };
        let read = |fragment: &str| parse(&machine(section, fragment), "m.toml");
        match (read(&format!("{key} = {default}")), read("# nothing")) {
            (Ok(with), without) => {
                seen += 1;
                let without = without.unwrap_or_else(|why| panic!("{section}: {why}"));
                assert_eq!(format!("{with:?}"), format!("{without:?}"), "{section}: {key} = {default}");
            }
            (Err(why), _) => assert!(!is_of_the_value(&why.to_string()), "{section}: {why}"),
        }
    });
    assert!(seen > 300, "{seen}");
}

/// A table whose keys the specimens do not show would refuse all of them.
#[test]
fn every_table_has_keys() {
    fn visit(at: &str, value: &Value, seen: &mut usize) {
        if value["additionalProperties"] == false {
            *seen += 1;
            assert!(value["properties"].as_object().is_some_and(|keys| !keys.is_empty()), "{at}");
        }
        let fields = value.as_object().into_iter().flatten();
        fields.for_each(|(key, value)| visit(&format!("{at}/{key}"), value, seen));
        let elements = value.as_array().into_iter().flatten();
        elements.for_each(|value| visit(at, value, seen));
    }
    let mut seen = 0;
    visit("", &schema(), &mut seen);
    assert!(seen > 60, "{seen}");
}
