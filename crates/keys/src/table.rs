//! A table of a TOML file, read key by key, so that every mistake names its line and what would be right.
//!
//! A getter returns `None` for a key that is absent, and for one that is wrong after noting the mistake on the
//! [`Page`]: reading goes on with the default, and all mistakes are found in one pass. The keys that were asked for are
//! the keys that exist; [`Table::finish`] reports all others. Knows nothing of drives.

use std::fmt;
use std::ops::{Bound, RangeBounds};

use toml::Spanned;
use toml::de::{DeString, DeTable, DeValue};

use super::form::{Form, Noted, Range, listed};
use super::key::Key;
use super::page::{Page, Place, shorten};
use super::value;
use fieldbeat_core::axis::PlanFault;
use fieldbeat_core::time::Ns;

/// Everything above zero.
pub const POSITIVE: (Bound<f64>, Bound<f64>) = (Bound::Excluded(0.0), Bound::Unbounded);

/// A table, and behind it the tables that fill in what it leaves out, key by key.
#[derive(Debug)]
pub struct Table<'a> {
    page: &'a Page<'a>,
    /// The first one is the table itself, present or not.
    layers: Vec<Layer<'a>>,
    /// Keys that no layer behind the first may give.
    own: &'static [&'static str],
    /// Others may fill in what it leaves out.
    has_defaults: bool,
    known: Vec<&'static str>,
}

#[derive(Clone, Debug)]
struct Layer<'a> {
    path: String,
    line: usize,
    entries: Option<&'a DeTable<'a>>,
}

/// A key that was found, and its value.
type Entry<'a> = (&'a Spanned<DeString<'a>>, &'a Spanned<DeValue<'a>>);

impl<'a> Layer<'a> {
    /// The value of `key`; dots lead into sub-tables.
    fn get(&self, key: &str) -> Option<Entry<'a>> {
        let (tables, key) = key.rsplit_once('.').unwrap_or(("", key));
        let mut entries = self.entries?;
        for table in tables.split('.').filter(|table| !table.is_empty()) {
            entries = entries.get(table)?.get_ref().as_table()?;
        }
        entries.get_key_value(key)
    }

    fn path_to(&self, key: &str) -> String {
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
        let key = match !key.is_empty() && key.chars().all(plain) {
            true => key.to_owned(),
            false => format!("\"{}\"", shorten(key).unwrap_or_default()),
        };
        if self.path.is_empty() { key } else { format!("{}.{key}", self.path) }
    }
}

impl<'a> Table<'a> {
    /// The file as a whole.
    pub fn root(page: &'a Page<'a>, entries: &'a DeTable<'a>) -> Table<'a> {
        Table::new(page, Layer { path: String::new(), line: 1, entries: Some(entries) })
    }

    fn new(page: &'a Page<'a>, layer: Layer<'a>) -> Table<'a> {
        Table { page, layers: vec![layer], own: &[], has_defaults: false, known: Vec::new() }
    }

    /// Lets `defaults` fill in what this table leaves out, sub-tables key by key, all but the keys in `own`.
    pub fn over(mut self, defaults: &Table<'a>, own: &'static [&'static str]) -> Table<'a> {
        self.page.record(|record| record.note_defaults(&defaults.layers[0].path, &self.layers[0].path));
        self.layers.extend(defaults.layers.iter().cloned());
        (self.own, self.has_defaults) = (own, true);
        self
    }

    /// Where `key` (dots lead into sub-tables) has its value from, or would have to stand.
    pub fn place(&self, key: &str) -> Place {
        let found = self.layers.iter().find_map(|layer| Some(self.place_in(layer, key, layer.get(key)?)));
        found.unwrap_or_else(|| self.place_without(key))
    }

    fn place_in(&self, layer: &Layer<'a>, key: &str, (at, value): Entry<'a>) -> Place {
        let span = value.span();
        // The span of a table with a header of its own is that header, which says nothing new.
        let header = value.get_ref().is_table()
            && self.page.text.get(span.clone()).is_none_or(|text| !text.starts_with('{'));
        Place {
            line: self.page.line(at.span().start),
            key: layer.path_to(key),
            value: if header { None } else { self.page.snippet(span) },
        }
    }

    fn place_without(&self, key: &str) -> Place {
        let layer = &self.layers[0];
        Place { line: layer.line, key: layer.path_to(key), value: None }
    }

    /// Where it stands.
    pub fn line(&self) -> usize {
        self.layers[0].line
    }

    /// Notes a mistake at `key` (dots lead into sub-tables).
    pub fn fault(&self, key: &str, message: impl Into<String>) {
        self.page.report(self.place(key), message);
    }

    /// Notes what is wrong with the plan that was read from it.
    pub fn faults(&self, faults: impl IntoIterator<Item = PlanFault>) {
        for PlanFault { key, message } in faults {
            self.fault(key, message);
        }
    }

    /// Notes a mistake at a place found earlier.
    pub fn report(&self, place: &Place, message: impl Into<String>) {
        self.page.report(place.clone(), message);
    }

    /// Whether any layer gives `key`, right or wrong.
    pub fn gives(&self, key: &str) -> bool {
        self.layers.iter().any(|layer| layer.get(key).is_some())
    }

    /// Notes a mistake if a required key is absent.
    fn require(&self, key: Key) {
        let is_own = !self.has_defaults || self.own.contains(&key.name);
        self.record(key, |noted| noted.required |= is_own);
        self.page.report(self.place_without(key.name), format!("missing; {}", key.hint()));
    }

    /// Records what is known of `key`, where a record is kept.
    fn record(&self, key: Key, note: impl FnOnce(&mut Noted)) {
        self.page.record(|record| {
            let noted = record.note(&self.layers[0].path, key);
            noted.own |= self.own.contains(&key.name);
            note(noted);
        });
    }

    fn find(&mut self, key: Key) -> Option<(usize, Entry<'a>)> {
        let name = key.name;
        if !self.known.contains(&name) {
            self.known.push(name);
            self.record(key, |_| {});
        }
        let layers = if self.own.contains(&name) { 1 } else { self.layers.len() };
        let layers = self.layers[..layers].iter().enumerate();
        let found = layers.filter_map(|(index, layer)| Some((index, layer.get(name)?))).next();
        if found.is_none() && key.is_required() {
            self.require(key);
        }
        found
    }

    /// A value of this form; `Err` says what it must be.
    pub fn read<T>(
        &mut self,
        key: Key,
        form: Form,
        read: impl FnOnce(&DeValue<'a>) -> Result<T, String>,
    ) -> Option<T> {
        self.record(key, |noted| noted.takes(&form));
        let (layer, entry) = self.find(key)?;
        match read(entry.1.get_ref()) {
            Ok(value) => Some(value),
            Err(message) => {
                self.page.report(self.place_in(&self.layers[layer], key.name, entry), message);
                None
            }
        }
    }

    /// The same, where `Err` says only what is wrong: behind it stands what the key is for.
    fn read_with_hint<T>(
        &mut self,
        key: Key,
        form: Form,
        read: impl FnOnce(&DeValue<'a>) -> Result<T, String>,
    ) -> Option<T> {
        self.read(key, form, |value| read(value).map_err(|why| format!("{why}; {}", key.hint())))
    }

    /// The same, or this word: then `Some(None)`.
    pub fn read_or<T>(
        &mut self,
        key: Key,
        form: Form,
        word: &str,
        read: impl FnOnce(&DeValue<'a>) -> Result<T, String>,
    ) -> Option<Option<T>> {
        self.read_with_hint(key, form.or(Form::word(word)), |value| match value.as_str() {
            Some(text) if text == word => Ok(None),
            _ => read(value).map(Some).map_err(|why| format!("{why}, or \"{word}\"")),
        })
    }

    /// `true` or `false`.
    pub fn flag(&mut self, key: Key) -> Option<bool> {
        self.read_with_hint(key, Form::Flag, |value| value.as_bool().ok_or("must be true or false".into()))
    }

    /// Text that passes `check`, which the regular expression `pattern` shows at a distance.
    pub fn text<T>(
        &mut self,
        key: Key,
        pattern: impl Into<Option<&'static str>>,
        hint: &str,
        check: impl FnOnce(&str) -> Option<T>,
    ) -> Option<T> {
        self.read(key, Form::Text(pattern.into()), |value| {
            value.as_str().and_then(check).ok_or_else(|| format!("must be {hint}"))
        })
    }

    /// One of a few words.
    pub fn word<T: Copy>(&mut self, key: Key, words: &[(&str, T)]) -> Option<T> {
        let (form, list) = listed(words);
        self.read(key, form, |value| {
            let known = words.iter().find(|(word, _)| Some(*word) == value.as_str());
            known.map(|(_, meaning)| *meaning).ok_or_else(|| format!("must be {list}"))
        })
    }

    /// A whole number.
    pub fn integer<T: TryFrom<i128>>(&mut self, key: Key, range: impl RangeBounds<i128>) -> Option<T> {
        self.read_with_hint(key, whole_form(&range), |value| whole(integer(value), &range, "a whole number"))
    }

    /// A whole number, or `"any"`: then `Some(None)`.
    pub fn integer_or_any<T: TryFrom<i128>>(
        &mut self,
        key: Key,
        range: impl RangeBounds<i128>,
    ) -> Option<Option<T>> {
        self.read_or(key, whole_form(&range), "any", |value| whole(integer(value), &range, "a whole number"))
    }

    /// A count, or the time that so many of what comes every `every_ns` take, rounded up.
    pub fn count<T: TryFrom<i128>>(
        &mut self,
        key: Key,
        range: impl RangeBounds<i128>,
        every_ns: u64,
    ) -> Option<T> {
        self.read_with_hint(key, whole_form(&range).or(Form::Time), |value| {
            let time = value.as_str().and_then(value::duration);
            let number = integer(value).or(time.map(|ns| i128::from(ns.div_ceil(every_ns.max(1)))));
            whole(number, &range, "a whole number or a time like \"50ms\"")
        })
    }

    /// A list of whole numbers up to `highest`, at most so many; none if the key is absent or wrong.
    pub fn integers(&mut self, key: Key, most: usize, highest: u16) -> Vec<u16> {
        let one = |value: &DeValue<'_>| {
            integer(value).and_then(|value| u16::try_from(value).ok()).filter(|value| *value <= highest)
        };
        let form = Form::integer(0..=highest.into()).list(0, most);
        let list = self.read(key, form, |value| {
            let wrong = || format!("must be a list of at most {most} whole numbers, 0 to {highest}");
            list(value, ..=most, one).ok_or_else(wrong)
        });
        list.unwrap_or_default()
    }

    /// Bytes, at most so many; `None` if the key is absent.
    pub fn byte_list(&mut self, key: Key, most: usize) -> Option<Vec<u8>> {
        let bytes = self.integers(key, most, u16::from(u8::MAX));
        self.gives(key.name).then(|| bytes.into_iter().map(|byte| byte as u8).collect())
    }

    /// Bytes, zeros behind them; `None` if the key is absent.
    pub fn bytes<const N: usize>(&mut self, key: Key) -> Option<[u8; N]> {
        let list = self.byte_list(key, N)?;
        Some(std::array::from_fn(|place| list.get(place).copied().unwrap_or(0)))
    }

    /// `false`, or up to `N` of what `one` reads and `form` shows; else it is `wrong`.
    pub fn some_of<T, const N: usize>(
        &mut self,
        key: Key,
        form: Form,
        wrong: &str,
        one: impl FnMut(&DeValue<'a>) -> Result<T, String>,
    ) -> Option<[Option<T>; N]> {
        self.read(key, Form::False.or(form.list(1, N)), |value| match value.as_bool() {
            Some(false) => Ok([const { None }; N]),
            _ => up_to(value, wrong, one),
        })
    }

    /// A finite number, with or without a decimal point.
    pub fn number(&mut self, key: Key, range: impl RangeBounds<f64>) -> Option<f64> {
        let form = Form::Number(Range::of(&range, |bound| bound));
        self.read_with_hint(key, form, |value| {
            let number = number(value).ok_or("must be a number")?;
            inside(number, &range, |bound| bound)
        })
    }

    /// Two rising numbers, `[lowest, highest]`.
    pub fn interval(&mut self, key: Key) -> Option<(f64, f64)> {
        self.read_with_hint(key, Form::Number(Range::ALL).list(2, 2), |value| {
            match list(value, 2..=2, number).as_deref() {
                Some(&[low, high]) if low < high => Ok((low, high)),
                Some(_) => Err("must rise: [lowest, highest]".into()),
                None => Err("must be two numbers, [lowest, highest]".into()),
            }
        })
    }

    /// A time in ns.
    pub fn time(&mut self, key: Key, range: impl RangeBounds<u64>) -> Option<u64> {
        self.read_with_hint(key, Form::Time, |value| time(value, &range))
    }

    /// A time in ns, or `"off"`: then `Some(None)`.
    pub fn time_or_off(&mut self, key: Key, range: impl RangeBounds<u64>) -> Option<Option<u64>> {
        self.read_or(key, Form::Time, "off", |value| time(value, &range))
    }

    /// What `read` makes of a sub-table, which is empty if it is absent. Unknown keys in it are mistakes.
    pub fn table<T>(&mut self, key: impl Into<Key>, read: impl FnOnce(&mut Table<'a>) -> T) -> T {
        let mut table = self.sub_table(key);
        let result = read(&mut table);
        table.finish();
        result
    }

    /// Whether keys are recorded: then what is absent is read all the same.
    pub fn is_recorded(&self) -> bool {
        self.page.is_recorded()
    }

    /// The same of a sub-table whose function is off without it.
    pub fn optional<T>(
        &mut self,
        key: &'static str,
        read: impl FnOnce(&mut Table<'a>) -> Option<T>,
    ) -> Option<T> {
        if !self.gives(key) && !self.page.is_recorded() {
            self.later(key);
            return None;
        }
        let table = self.layers.iter().find_map(|layer| layer.get(key));
        let is_table = table.is_none_or(|(_, value)| value.get_ref().is_table());
        // What is no table has no keys that could be missing.
        self.table(key, |table| if is_table { read(table) } else { None })
    }

    /// A sub-table whose keys are read elsewhere.
    pub fn sub_table(&mut self, key: impl Into<Key>) -> Table<'a> {
        let key = key.into();
        self.find(key);
        self.record(key, |noted| noted.takes(&Form::Table));
        let name = key.name;
        let mut layers = Vec::new();
        for layer in &self.layers {
            let Some(entry) = layer.get(name) else { continue };
            match entry.1.get_ref() {
                DeValue::Table(entries) => layers.push(Layer {
                    path: layer.path_to(name),
                    line: self.page.line(entry.0.span().start),
                    entries: Some(entries),
                }),
                _ => {
                    let message = format!("must be a table: {name} = {{ ... }}");
                    self.page.report(self.place_in(layer, name, entry), message);
                }
            }
        }
        if layers.is_empty() {
            let own = &self.layers[0];
            layers.push(Layer { path: own.path_to(name), line: own.line, entries: None });
        }
        Table { page: self.page, layers, own: &[], has_defaults: self.has_defaults, known: Vec::new() }
    }

    /// The tables under `[[key]]`, in order. Where keys are recorded, there is one, so that all are read.
    pub fn tables(&mut self, key: Key) -> Vec<Table<'a>> {
        self.record(key, |noted| noted.takes(&Form::Tables));
        let Some((layer, entry)) = self.find(key) else {
            let own = &self.layers[0];
            let layer = Layer { path: own.path_to(key.name), line: own.line, entries: None };
            return self.page.is_recorded().then(|| Table::new(self.page, layer)).into_iter().collect();
        };
        let path = self.layers[layer].path_to(key.name);
        let elements = entry.1.get_ref().as_array().map_or(&[][..], |array| array);
        let tables: Vec<Table<'a>> = elements
            .iter()
            .filter_map(|element| {
                let line = self.page.line(element.span().start);
                let entries = Some(element.get_ref().as_table()?);
                Some(Table::new(self.page, Layer { path: path.clone(), line, entries }))
            })
            .collect();
        if tables.is_empty() || tables.len() != elements.len() {
            let place = self.place_in(&self.layers[layer], key.name, entry);
            self.page.report(place, format!("must be a list of tables: write [[{path}]]"));
        }
        tables
    }

    /// The same table, to be read a second time for what else is in it; unknown keys are found by the first one.
    pub fn again(&self) -> Table<'a> {
        Table { layers: self.layers.clone(), known: Vec::new(), ..*self }
    }

    /// The table at `key` is read elsewhere.
    pub fn later(&mut self, key: &'static str) {
        self.find(key.into());
    }

    /// Reports every key that nobody asked for.
    pub fn finish(self) {
        for (index, layer) in self.layers.iter().enumerate() {
            for (key, _) in layer.entries.into_iter().flat_map(|entries| entries.iter()) {
                let place = Place {
                    line: self.page.line(key.span().start),
                    key: layer.path_to(key.get_ref()),
                    value: None,
                };
                let key: &str = key.get_ref();
                if index > 0 && self.own.contains(&key) {
                    let home = &self.layers[0].path;
                    self.page.report(place, format!("cannot be shared; write it in each [[{home}]]"));
                } else if !self.known.contains(&key) {
                    let valid = self.known.iter().filter(|known| index == 0 || !self.own.contains(known));
                    self.page.report(place, unknown(key, valid.copied().collect()));
                }
            }
        }
    }
}

/// Keys that had another name, and their new one.
const RENAMED: [(&str, &str); 3] =
    [("inhibit", "sto"), ("inhibit_for", "sto_for"), ("inhibit_after", "sto_after")];

/// Keys that are gone: why.
const GONE: [(&str, &str); 1] = [("send", "one system call sends all requests of a cycle")];

fn unknown(key: &str, valid: Vec<&str>) -> String {
    if let Some((_, why)) = GONE.iter().find(|(old, _)| *old == key) {
        return format!("this key is gone: {why}; remove it");
    }
    if let Some((_, new)) = RENAMED.iter().find(|(old, new)| *old == key && valid.contains(new)) {
        return format!("its name is {new} now");
    }
    let meant = match value::closest(key, valid.iter().copied()) {
        Some(meant) => format!("did you mean {meant}? "),
        None => String::new(),
    };
    format!("no such key; {meant}valid here: {}", valid.join(", "))
}

/// Puts what was read in the place of a default.
pub fn set<T>(place: &mut T, read: Option<T>) {
    if let Some(value) = read {
        *place = value;
    }
}

/// The elements of a list of so many.
pub fn elements<'v, 'a>(
    value: &'v DeValue<'a>,
    count: impl RangeBounds<usize>,
) -> Option<impl Iterator<Item = &'v DeValue<'a>>> {
    let array = value.as_array().filter(|array| count.contains(&array.len()))?;
    Some(array.iter().map(Spanned::get_ref))
}

/// What `one` makes of each element of a list of so many.
pub fn list<T>(
    value: &DeValue<'_>,
    count: impl RangeBounds<usize>,
    one: impl Fn(&DeValue<'_>) -> Option<T>,
) -> Option<Vec<T>> {
    elements(value, count)?.map(one).collect()
}

/// What `one` makes of each element of a list of 1 to `N`; else it is `wrong`.
pub fn up_to<'a, T, const N: usize>(
    value: &DeValue<'a>,
    wrong: &str,
    mut one: impl FnMut(&DeValue<'a>) -> Result<T, String>,
) -> Result<[Option<T>; N], String> {
    let mut all = [const { None }; N];
    for (place, value) in all.iter_mut().zip(elements(value, 1..=N).ok_or(wrong)?) {
        *place = Some(one(value)?);
    }
    Ok(all)
}

/// A time in ns within `range`.
pub fn time(value: &DeValue<'_>, range: &impl RangeBounds<u64>) -> Result<u64, String> {
    let ns = value
        .as_str()
        .and_then(value::duration)
        .ok_or("must be a time like \"250us\", \"1ms\" or \"0.5s\"")?;
    within_times(ns, range)
}

/// The time `ns` if it is within `range`.
pub fn within_times(ns: u64, range: &impl RangeBounds<u64>) -> Result<u64, String> {
    inside(ns, range, |bound| Ns(bound).to_string())
}

/// A whole number within `range`.
pub fn integer(value: &DeValue<'_>) -> Option<i128> {
    let integer = value.as_integer()?;
    i128::from_str_radix(integer.as_str(), integer.radix()).ok()
}

fn whole_form(range: &impl RangeBounds<i128>) -> Form {
    Form::Integer(Range::of(range, |bound| bound as f64))
}

/// The whole number that was read, if it is within `range`.
fn whole<T: TryFrom<i128>>(
    number: Option<i128>,
    range: &impl RangeBounds<i128>,
    what: &str,
) -> Result<T, String> {
    let number = number.ok_or_else(|| format!("must be {what}"))?;
    inside(number, range, |bound| bound)?;
    T::try_from(number).map_err(|_| "is out of range".into())
}

/// A finite number.
pub fn number(value: &DeValue<'_>) -> Option<f64> {
    let number = match value {
        DeValue::Float(float) => float.as_str().parse().ok()?,
        _ => integer(value)? as f64,
    };
    number.is_finite().then_some(number)
}

fn inside<T: PartialOrd + Copy, D: fmt::Display>(
    value: T,
    range: &impl RangeBounds<T>,
    show: impl Fn(T) -> D,
) -> Result<T, String> {
    let wrong = match (range.start_bound(), range.end_bound()) {
        (Bound::Included(&low), _) if value < low => format!("must be at least {}", show(low)),
        (Bound::Excluded(&low), _) if value <= low => format!("must be above {}", show(low)),
        (_, Bound::Included(&high)) if value > high => format!("must be at most {}", show(high)),
        (_, Bound::Excluded(&high)) if value >= high => format!("must be below {}", show(high)),
        _ => return Ok(value),
    };
    Err(wrong)
}
