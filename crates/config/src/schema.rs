//! The JSON schema of a configuration, for editors that complete keys and flag mistakes while somebody types.
//!
//! It is made from what the reader states while it reads: each key with its declaration, and what it takes. What a
//! schema cannot express is left to `fieldbeat check`: ranges of times, and what depends on other keys.

use std::cell::RefCell;
use std::ops::Bound;

use serde_json::{Map, Value, json};
use toml::de::{DeTable, DeValue};

use crate::PROTOCOLS;
use fieldbeat_keys::Protocol;
use fieldbeat_keys::form::{Form, Noted, Range, Record};
use fieldbeat_keys::page::Page;
use fieldbeat_keys::table::{Table, integer, number};
use fieldbeat_keys::value::TIME;

/// What stands around the bus of a protocol while its keys are recorded. Ranges that depend on other keys differ
/// between the two.
const SURROUNDINGS: [(&str, &str); 2] = [
    ("[cycle]\nperiod = \"1ms\"\n", ""),
    (
        "[cycle]\nperiod = \"2ms\"\n",
        "[bus.defaults]\nscale = 3.0\ninvert = true\noffset = 1.0\ndivisor = 3\nlimits.position = [-7, 9]\n",
    ),
];

/// The schema (draft 7, which taplo reads).
pub fn schema() -> Value {
    let records = PROTOCOLS.each_ref().map(record);
    let definitions: Map<String, Value> = PROTOCOLS
        .iter()
        .zip(&records)
        .map(|(protocol, record)| {
            let builder = Builder { record, protocol: protocol.name };
            (protocol.name.to_owned(), builder.object("bus"))
        })
        .collect();
    let common = Builder { record: &records[0], protocol: "" };
    let mut root = common.object("");
    root["properties"]["bus"] = buses();
    root["$schema"] = "http://json-schema.org/draft-07/schema#".into();
    root["title"] = "Fieldbeat: the configuration of a machine".into();
    root["definitions"] = definitions.into();
    root
}

/// All keys that the reader of a protocol knows. What is absent is read all the same while it is recorded.
pub(crate) fn record(protocol: &Protocol) -> Record {
    let record = RefCell::default();
    for (before, behind) in SURROUNDINGS {
        let text = format!("{before}[[bus]]\nprotocol = \"{}\"\n{behind}", protocol.name);
        let page = Page::new("", &text).recorded(&record);
        // What is wrong with values keeps no key from being read.
        match page.parse() {
            Ok(entries) => drop(super::machine(Table::root(&page, &entries), |_, _| {})),
            Err(why) => unreachable!("{why}"),
        }
    }
    record.into_inner()
}

/// `[[bus]]`: its protocol says which keys it has.
fn buses() -> Value {
    let reference = |name: &str| json!({ "$ref": format!("#/definitions/{name}") });
    let names = PROTOCOLS.each_ref().map(|protocol| protocol.name);
    let of_protocol = names.map(|name| {
        let is = json!({ "properties": { "protocol": { "const": name } }, "required": ["protocol"] });
        json!({ "if": is, "then": reference(name) })
    });
    // Everything passes, and an editor that does not know `if` finds all keys.
    let any: Vec<Value> = std::iter::once(json!({})).chain(names.map(reference)).collect();
    json!({
        "type": "array",
        "minItems": 1,
        "items": {
            "type": "object",
            "properties": {
                "protocol": { "enum": names, "description": super::PROTOCOL.description() },
            },
            "required": ["protocol"],
            "allOf": of_protocol,
            "anyOf": any,
        },
    })
}

/// The schema of the tables of one record.
struct Builder<'a> {
    record: &'a Record,
    protocol: &'static str,
}

impl Builder<'_> {
    /// The table at `path`.
    fn object(&self, path: &str) -> Value {
        let keys = self.record.keys(path);
        let properties: Map<String, Value> =
            keys.iter().map(|noted| (noted.key.name.to_owned(), self.key(path, noted))).collect();
        let required: Vec<&str> =
            keys.iter().filter(|noted| noted.required).map(|noted| noted.key.name).collect();
        let mut object = json!({ "type": "object", "properties": properties, "additionalProperties": false });
        if !required.is_empty() {
            object["required"] = required.into();
        }
        object
    }

    /// The defaults for the tables at `of`: their keys, of which none is required.
    fn defaults(&self, of: &str) -> Value {
        let list = of.strip_prefix("bus.").unwrap_or(of);
        let at = format!("#/definitions/{}/properties/{list}/items/properties", self.protocol);
        let shared = self.record.keys(of).iter().filter(|noted| !noted.own).map(|noted| noted.key.name);
        let properties: Map<String, Value> =
            shared.map(|name| (name.to_owned(), json!({ "$ref": format!("{at}/{name}") }))).collect();
        json!({ "type": "object", "properties": properties, "additionalProperties": false })
    }

    fn key(&self, table: &str, noted: &Noted) -> Value {
        let key = noted.key;
        let path = if table.is_empty() { key.name.to_owned() } else { format!("{table}.{}", key.name) };
        if path == "bus.protocol" {
            return json!({ "const": self.protocol });
        }
        let mut schema = match self.record.defaults_for(&path) {
            Some(of) => self.defaults(of),
            None => self.any(&path, &noted.forms),
        };
        if !key.means.is_empty() {
            schema["description"] = key.description().into();
        }
        if let Some(default) = key.value().and_then(|text| literal(&text)) {
            schema["default"] = default;
        }
        schema
    }

    /// Any of several forms. One of them may state the others.
    fn any(&self, path: &str, forms: &[Form]) -> Value {
        let mut flat: Vec<&Form> = Vec::new();
        for form in forms {
            let parts =
                if let Form::Either(parts) = form { parts.as_slice() } else { std::slice::from_ref(form) };
            flat.extend(parts.iter().filter(|part| !flat.contains(part)).collect::<Vec<_>>());
        }
        match flat.as_slice() {
            [] => json!({}),
            [one] => self.form(path, one),
            several => {
                json!({ "anyOf": several.iter().map(|form| self.form(path, form)).collect::<Vec<_>>() })
            }
        }
    }

    fn form(&self, path: &str, form: &Form) -> Value {
        match form {
            Form::Flag => json!({ "type": "boolean" }),
            Form::False => json!({ "const": false }),
            Form::Words(words) => json!({ "enum": words }),
            Form::Numbers(numbers) => {
                let numbers: Vec<i64> =
                    numbers.iter().filter_map(|number| i64::try_from(*number).ok()).collect();
                json!({ "enum": numbers })
            }
            Form::Text(None) => json!({ "type": "string" }),
            Form::Text(Some(pattern)) => json!({ "type": "string", "pattern": pattern }),
            Form::Time => json!({ "type": "string", "pattern": TIME }),
            Form::Integer(range) => within(json!({ "type": "integer" }), range),
            Form::Number(range) => within(json!({ "type": "number" }), range),
            Form::List(element, [least, most]) => {
                let mut list = json!({ "type": "array", "items": self.form(path, element) });
                for (key, count) in [("minItems", least), ("maxItems", most)] {
                    if let Some(count) = count {
                        list[key] = (*count).into();
                    }
                }
                list
            }
            Form::Table => self.object(path),
            Form::Tables => json!({ "type": "array", "items": self.object(path) }),
            Form::Fields(fields) => {
                let properties: Map<String, Value> = fields
                    .iter()
                    .map(|(name, form, _)| ((*name).to_owned(), self.form(path, form)))
                    .collect();
                let required: Vec<&str> =
                    fields.iter().filter(|(.., required)| *required).map(|(name, ..)| *name).collect();
                json!({
                    "type": "object",
                    "properties": properties,
                    "required": required,
                    "additionalProperties": false,
                })
            }
            Form::Either(forms) => self.any(path, forms),
        }
    }
}

fn within(mut schema: Value, range: &Range) -> Value {
    // Whole bounds as people write them.
    let number = |bound: f64| if bound.fract() == 0.0 { json!(bound as i64) } else { json!(bound) };
    match range.low {
        Bound::Included(low) => schema["minimum"] = number(low),
        Bound::Excluded(low) => schema["exclusiveMinimum"] = number(low),
        Bound::Unbounded => {}
    }
    match range.high {
        Bound::Included(high) => schema["maximum"] = number(high),
        Bound::Excluded(high) => schema["exclusiveMaximum"] = number(high),
        Bound::Unbounded => {}
    }
    schema
}

/// A value as it stands in a file, as JSON.
fn literal(text: &str) -> Option<Value> {
    let text = format!("value = {text}");
    let table = DeTable::parse(&text).ok()?;
    table.get_ref().get("value").and_then(|value| json_of(value.get_ref()))
}

/// A value of TOML as JSON.
fn json_of(value: &DeValue<'_>) -> Option<Value> {
    Some(match value {
        DeValue::String(text) => text.as_ref().into(),
        DeValue::Boolean(flag) => (*flag).into(),
        DeValue::Integer(_) => i64::try_from(integer(value)?).ok()?.into(),
        DeValue::Float(_) => number(value)?.into(),
        DeValue::Array(list) => {
            list.iter().map(|value| json_of(value.get_ref())).collect::<Option<Vec<_>>>()?.into()
        }
        DeValue::Table(_) | DeValue::Datetime(_) => return None,
    })
}
