//! A key as it is declared, once, in the call that reads it.

/// A key of a configuration: its name, its default and what it is for. The call that reads it adds what it takes. The
/// schema, the tables of the manual, the questions of `init` and every message are made of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key {
    /// The name in its table.
    pub name: &'static str,
    /// The default: a value as it stands in a file, text without its quotes; words in parentheses where it follows from
    /// something else; `none` for a function that is off without the key; `-` for a key that is required.
    pub default: &'static str,
    /// What it is for, with the unit and the range, in Markdown. Messages have the first sentence of it.
    pub means: &'static str,
}

/// Declares the keys that a file reads, a constant each: `NAME "name" = "default": "what it is for";`.
#[macro_export]
macro_rules! keys {
    ($($constant:ident $name:literal = $($default:literal)+: $($means:literal)+;)*) => {
        $(
            const $constant: $crate::key::Key =
                $crate::key::key($name, concat!($($default),+), concat!($($means),+));
        )*
    };
}

/// Declares one.
pub const fn key(name: &'static str, default: &'static str, means: &'static str) -> Key {
    Key { name, default, means }
}

/// A table, whose keys are declared where they are read.
impl From<&'static str> for Key {
    fn from(name: &'static str) -> Key {
        key(name, "none", "")
    }
}

impl Key {
    /// Whether a table has to have it.
    pub fn is_required(&self) -> bool {
        self.default == "-"
    }

    /// The default, if it is a value: as it stands in a file.
    pub fn value(&self) -> Option<String> {
        let text = self.default;
        if matches!(text, "-" | "none") || text.starts_with('(') {
            return None;
        }
        let is_literal = toml::de::DeTable::parse(&format!("value = {text}")).is_ok();
        Some(if is_literal { text.to_owned() } else { format!("\"{text}\"") })
    }

    /// The default in Markdown.
    pub fn default_text(&self) -> String {
        let words = || self.default.strip_prefix('(').and_then(|text| text.strip_suffix(')'));
        match self.value() {
            Some(value) => format!("`{value}`"),
            None => words().unwrap_or(self.default).to_owned(),
        }
    }

    /// The meaning and the default as sentences, without Markdown's links.
    pub fn description(&self) -> String {
        let means = plain(self.means);
        match self.default {
            "-" | "none" => format!("{means}."),
            _ => format!("{means}. Default: {}.", plain(&self.default_text())),
        }
    }

    /// What it is for, for the end of a message: the first sentence, as plain text.
    pub fn hint(&self) -> String {
        let plain = plain(self.means).replace('`', "");
        let ends = |at: &usize| !plain[..*at].ends_with('.');
        let end = plain.match_indices(". ").map(|(at, _)| at).find(ends);
        plain[..end.unwrap_or(plain.len())].to_owned()
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_default_is_a_value_or_words() {
        for (default, value, text) in [
            ("80", Some("80"), "`80`"),
            ("1ms", Some("\"1ms\""), "`\"1ms\"`"),
            ("off", Some("\"off\""), "`\"off\"`"),
            ("[0, 5]", Some("[0, 5]"), "`[0, 5]`"),
            ("(`5` mm/s)", None, "`5` mm/s"),
            ("none", None, "none"),
            ("-", None, "-"),
        ] {
            let key = key("x", default, "");
            assert_eq!((key.value().as_deref(), key.default_text().as_str()), (value, text));
        }
    }

    #[test]
    fn a_description_has_no_links_and_a_hint_is_one_sentence() {
        let rate = key("rate", "1500", "bit/s, `1` ... 9: see [below](#below). Slower is safer");
        assert_eq!(rate.description(), "bit/s, `1` ... 9: see below. Slower is safer. Default: `1500`.");
        assert_eq!(rate.hint(), "bit/s, 1 ... 9: see below");
        assert_eq!(
            key("lists", "none", "[lowest, highest] of a [1, 2]").hint(),
            "[lowest, highest] of a [1, 2]"
        );
    }
}
