//! The configuration as far as it is answered: its text, with a comment for each line, and what the reader says of it.

use std::collections::HashMap;

use fieldbeat_config as config;
use fieldbeat_config::ConfigError;
use fieldbeat_config::schema::schema;
use serde_json::Value;
use toml::de::DeTable;

/// The widest line of a comment.
const WIDTH: usize = 100;

/// A table of the file.
#[derive(Clone, Debug)]
pub struct Block {
    /// `cycle`, `bus` or `bus.drive`.
    pub path: &'static str,
    /// The keys with their values in TOML, in order.
    pub lines: Vec<(String, String)>,
}

impl Block {
    /// A table without keys.
    pub fn new(path: &'static str) -> Block {
        Block { path, lines: Vec::new() }
    }

    /// The value of a key, without quotes.
    pub fn answer(&self, key: &str) -> Option<String> {
        let (_, value) = self.lines.iter().find(|(known, _)| known == key)?;
        Some(serde_json::from_str::<String>(value).unwrap_or_else(|_| value.clone()))
    }
}

/// The schema of the keys of one protocol, and the tables so far.
pub struct Draft {
    schema: Value,
    protocol: &'static str,
    head: String,
    pub blocks: Vec<Block>,
}

impl Draft {
    /// Nothing is answered yet.
    pub fn new(protocol: &'static str, head: String) -> Draft {
        Draft { schema: schema(), protocol, head, blocks: Vec::new() }
    }

    /// The schema's entry of a key.
    fn stated(&self, path: &str, key: &str) -> Option<&Value> {
        let (table, path) = match path.split_once('.') {
            None if path == "bus" => (format!("/definitions/{}", self.protocol), ""),
            Some(("bus", list)) => (format!("/definitions/{}/properties/{list}/items", self.protocol), ""),
            _ => ("/properties".to_owned(), path),
        };
        let dotted = if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
        let mut at = match path.is_empty() {
            true => self.schema.pointer(&table)?.get("properties")?,
            false => self.schema.pointer(&table)?,
        };
        let mut parts = dotted.split('.').peekable();
        while let Some(part) = parts.next() {
            at = at.get(part)?;
            if parts.peek().is_some() {
                at = at.get("properties")?;
            }
        }
        Some(at)
    }

    /// An answer as a value of TOML: text where the key takes nothing else, or where it is no other value.
    pub fn value(&self, path: &str, key: &str, answer: &str) -> String {
        let is_text = |form: &Value| {
            form["type"] == "string"
                || form["enum"].as_array().is_some_and(|all| all.iter().all(Value::is_string))
        };
        let only_text = self.stated(path, key).is_some_and(|stated| match stated["anyOf"].as_array() {
            Some(forms) => forms.iter().all(is_text),
            None => is_text(stated),
        });
        let is_value = || {
            let text = format!("value = {answer}");
            DeTable::parse(&text).is_ok_and(|table| table.get_ref().len() == 1)
        };
        if !only_text && is_value() { answer.to_owned() } else { quoted(answer) }
    }

    /// The comment of a key: what it is, in which range, and its default.
    fn comment(&self, path: &str, key: &str) -> Vec<String> {
        let Some(stated) = self.stated(path, key) else { return Vec::new() };
        let common = || &self.schema["properties"]["bus"]["items"]["properties"][key];
        let stated = if stated["description"].is_null() { common() } else { stated };
        let mut text = stated["description"].as_str().unwrap_or_default().to_owned();
        if !text.contains(" ... ") {
            text += &range(stated).unwrap_or_default();
        }
        // They stand around keys and values in the reference, and are nothing in TOML.
        wrapped(&text.replace('`', ""))
    }

    /// The whole text; and the line of each key, by the place of its table.
    pub fn render(&self) -> (String, HashMap<(usize, String), usize>) {
        let mut lines: Vec<String> = wrapped(&self.head);
        let mut places = HashMap::new();
        for (index, block) in self.blocks.iter().enumerate() {
            let header =
                if block.path == "cycle" { "[cycle]".to_owned() } else { format!("[[{}]]", block.path) };
            lines.extend([String::new(), header]);
            for (key, value) in &block.lines {
                lines.extend(self.comment(block.path, key));
                lines.push(format!("{key} = {value}"));
                places.insert((index, key.clone()), lines.len());
            }
        }
        (lines.join("\n") + "\n", places)
    }

    /// The reader's mistake in the newest key; none if it takes it. A mistake of a key that is not there belongs to one
    /// of its table if that is the remedy.
    pub fn newest_mistake(&self) -> Option<String> {
        let (text, places) = self.render();
        let block = self.blocks.len().checked_sub(1)?;
        let (key, _) = self.blocks[block].lines.last()?;
        let line = places.get(&(block, key.clone())).copied();
        let mistakes = config::parse(&text, "").err()?;
        let is_its = |mistake: &&ConfigError| {
            mistake.line == line
                || mistake.value.is_none() && key.contains('.') && mistake.message.contains(key)
        };
        mistakes.iter().find(is_its).map(|mistake| mistake.message.clone())
    }

    /// The reader's mistakes in the whole, a line each, with `file` as its name.
    pub fn mistakes(&self, file: &str) -> Option<String> {
        config::parse(&self.render().0, file).err().map(|mistakes| mistakes.to_string())
    }
}

/// Text as TOML has it: as JSON does, but for the one control character that JSON lets through.
fn quoted(text: &str) -> String {
    Value::from(text).to_string().replace('\u{7f}', "\\u007f")
}

/// Between which numbers the value is.
fn range(stated: &Value) -> Option<String> {
    let forms = stated["anyOf"].as_array().map_or(std::slice::from_ref(stated), Vec::as_slice);
    let of = |end: &str| forms.iter().find_map(|form| form.get(end).and_then(Value::as_f64));
    Some(match (of("minimum"), of("exclusiveMinimum"), of("maximum")) {
        (Some(low), _, Some(high)) => format!(" Range: {low} ... {high}."),
        (_, Some(low), None) => format!(" Above {low}."),
        (_, Some(low), Some(high)) => format!(" Above {low}, up to {high}."),
        (Some(low), _, None) => format!(" At least {low}."),
        _ => return None,
    })
}

/// Lines of a comment.
fn wrapped(text: &str) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= WIDTH => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(format!("# {word}")),
        }
    }
    lines
}
