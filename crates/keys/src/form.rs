//! What the keys of a configuration take, as the reader states it: the schema is made from these forms, so that it
//! cannot differ from what is read.

use std::collections::BTreeMap;
use std::ops::{Bound, RangeBounds};

use super::key::Key;
use super::value;

/// What a key takes.
#[derive(Clone, Debug, PartialEq)]
pub enum Form {
    /// `true` or `false`.
    Flag,
    /// `false` only: what is shown otherwise is not.
    False,
    /// One of these words.
    Words(Vec<String>),
    /// Text that this regular expression matches, if there is one.
    Text(Option<&'static str>),
    /// A whole number.
    Integer(Range),
    /// One of these whole numbers.
    Numbers(Vec<i128>),
    /// A number.
    Number(Range),
    /// A time: text with a unit.
    Time,
    /// A list of so many elements.
    List(Box<Form>, [Option<usize>; 2]),
    /// A table whose keys are recorded below its own path.
    Table,
    /// A list of such tables.
    Tables,
    /// A table with these keys only; those that are `true` are required.
    Fields(Vec<(&'static str, Form, bool)>),
    /// One of several forms.
    Either(Vec<Form>),
}

/// Between which numbers a value lies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// It is not below.
    pub low: Bound<f64>,
    /// It is not above.
    pub high: Bound<f64>,
}

impl Range {
    /// Any number.
    pub const ALL: Range = Range { low: Bound::Unbounded, high: Bound::Unbounded };

    /// The same range in `f64`, which holds each bound of this program.
    pub fn of<T: Copy>(range: &impl RangeBounds<T>, number: impl Fn(T) -> f64 + Copy) -> Range {
        let bound = |bound: Bound<&T>| bound.map(|bound| number(*bound));
        Range { low: bound(range.start_bound()), high: bound(range.end_bound()) }
    }

    /// Where an end depends on other keys, nothing is said of it.
    fn merge(&mut self, other: Range) {
        for (end, other) in [(&mut self.low, other.low), (&mut self.high, other.high)] {
            if *end != other {
                *end = Bound::Unbounded;
            }
        }
    }
}

impl Form {
    /// One of these words.
    pub fn words<'a>(words: impl IntoIterator<Item = &'a str>) -> Form {
        Form::Words(words.into_iter().map(str::to_owned).collect())
    }

    /// One word.
    pub fn word(word: &str) -> Form {
        Form::words([word])
    }

    /// A whole number in this range.
    pub fn integer(range: impl RangeBounds<i128>) -> Form {
        Form::Integer(Range::of(&range, |bound: i128| bound as f64))
    }

    /// A number in this range.
    pub fn number(range: impl RangeBounds<f64>) -> Form {
        Form::Number(Range::of(&range, |bound: f64| bound))
    }

    /// One of these whole numbers.
    pub fn numbers(numbers: impl IntoIterator<Item = i128>) -> Form {
        Form::Numbers(numbers.into_iter().collect())
    }

    /// One of two forms.
    pub fn or(self, other: Form) -> Form {
        match self {
            Form::Either(mut forms) => {
                forms.push(other);
                Form::Either(forms)
            }
            one => Form::Either(vec![one, other]),
        }
    }

    /// A list of `least` to `most` of these.
    pub fn list(self, least: usize, most: usize) -> Form {
        Form::List(Box::new(self), [Some(least), Some(most)])
    }

    /// A list of any length.
    pub fn any_list(self) -> Form {
        Form::List(Box::new(self), [None, None])
    }

    /// Whether both say the same of a value, but for the ends of a range.
    fn merge(&mut self, other: &Form) -> bool {
        match (self, other) {
            (Form::Integer(range), Form::Integer(other)) | (Form::Number(range), Form::Number(other)) => {
                range.merge(*other);
                true
            }
            (one, other) => one == other,
        }
    }
}

/// A key of the record.
#[derive(Clone, Debug, PartialEq)]
pub struct Noted {
    /// Its declaration.
    pub key: Key,
    /// The forms of its value; several where that depends.
    pub forms: Vec<Form>,
    /// The table has to have it.
    pub required: bool,
    /// It cannot stand in the table of defaults.
    pub own: bool,
}

/// The keys of all tables of a file, by the path of their table and in the order in which they are read.
#[derive(Debug, Default)]
pub struct Record {
    tables: BTreeMap<String, Vec<Noted>>,
    /// Tables that others fill in: the path of the table of defaults, and that of what it is for.
    defaults: BTreeMap<String, String>,
}

impl Record {
    /// The keys of the table at `path`.
    pub fn keys(&self, path: &str) -> &[Noted] {
        self.tables.get(path).map_or(&[], Vec::as_slice)
    }

    /// The path of the tables for which the one at `path` has defaults.
    pub fn defaults_for(&self, path: &str) -> Option<&str> {
        self.defaults.get(path).map(String::as_str)
    }

    pub(super) fn note_defaults(&mut self, path: &str, of: &str) {
        self.defaults.insert(path.to_owned(), of.to_owned());
    }

    /// Notes that there is such a key.
    pub(super) fn note(&mut self, path: &str, key: Key) -> &mut Noted {
        let keys = self.tables.entry(path.to_owned()).or_default();
        let at = keys.iter().position(|noted| noted.key.name == key.name).unwrap_or_else(|| {
            keys.push(Noted { key, forms: Vec::new(), required: false, own: false });
            keys.len() - 1
        });
        let noted = &mut keys[at];
        if noted.key.means.is_empty() {
            noted.key = key;
        }
        noted
    }
}

impl Noted {
    pub(super) fn takes(&mut self, form: &Form) {
        if !self.forms.iter_mut().any(|known| known.merge(form)) {
            self.forms.push(form.clone());
        }
    }
}

/// One of the words of a list.
pub fn listed<T>(words: &[(&str, T)]) -> (Form, String) {
    let words = || words.iter().map(|(word, _)| *word);
    (Form::words(words()), value::alternatives(words()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_that_depends_on_other_keys_is_not_stated() {
        let mut record = Record::default();
        for most in [4, 5] {
            record.note("bus", "phase".into()).takes(&Form::integer(0..=most));
        }
        record.note("bus", "phase".into()).takes(&Form::word("off"));
        let [key] = record.keys("bus") else { panic!("one key") };
        let from_zero = Range { low: Bound::Included(0.0), high: Bound::Unbounded };
        assert_eq!(key.forms, [Form::Integer(from_zero), Form::word("off")]);
    }

    #[test]
    fn keys_keep_the_order_in_which_they_are_read() {
        let mut record = Record::default();
        for name in ["period", "core", "period"] {
            record.note("cycle", name.into());
        }
        assert_eq!(
            record.keys("cycle").iter().map(|noted| noted.key.name).collect::<Vec<_>>(),
            ["period", "core"]
        );
        assert!(record.keys("bus").is_empty());
    }
}
