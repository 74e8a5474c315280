//! What stands in an EtherCAT bus, as people write it: numbers with `0x`, areas of memory, objects, PDOs.

use toml::de::DeValue;

use crate::object::pdo::{self, Entry, Layout};
use crate::object::{Family, Objects, Target, catalogue, string};
use crate::{Area, Expected, Start};
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::{Table, elements, integer, list, set};
use fieldbeat_keys::value::unknown;

keys! {
    VENDOR "vendor" = "(`0x6A` of a drive, `\"any\"` of a device)": "required vendor number in the SII; "
        "`\"any\"` accepts all";
    PRODUCT "product" = "(that of the type of a drive, `\"any\"` of a device)":
        "required product code in the SII; `\"any\"` accepts all";
    REVISION "revision" = "any": "required revision in the SII; `\"any\"` accepts all";
    SERIAL "serial" = "any": "required serial number in the SII of the slave; `\"any\"` accepts all. See "
        "[below](#which-slave-it-is)";
    ALIAS "alias" = "any": "required configured station alias (register 0012h, from its EEPROM), 0 ... "
        "65535";
    IDENTIFICATION "identification" = "any": "required answer to a request for its identification (AL "
        "control bit 5, code in 0134h), 0 ... 65535: its selectors, or a number stored in it";
    OUT "out" = "(`[0x1800, 16]`, of an AKD 1024 bytes; a device has none)":
        "mailbox of the slave for requests, start address and length: `[0x1800, 128]`; a device without "
        "mailboxes has no objects";
    IN "in" = "(`[0x1C00, 16]`, of an AKD 1024 bytes; a device has none)":
        "mailbox of the slave for answers, start address and length: `[0x1C00, 128]`";
}

/// The most objects in a PDO: what its subindices count comfortably.
const MOST_OBJECTS: usize = 32;
/// The most objects that are written at the start.
const MOST_START_UP: usize = 64;

/// A number, or its text with `0x`.
fn number(value: &DeValue<'_>) -> Option<i128> {
    let hex = || {
        let digits = value.as_str()?.strip_prefix("0x")?;
        let is_hex = digits.bytes().all(|byte| byte.is_ascii_hexdigit());
        i128::from_str_radix(digits, 16).ok().filter(|_| is_hex)
    };
    integer(value).or_else(hex)
}

/// What a number with `0x` looks like.
const HEX: &str = "^0x[0-9A-Fa-f]+$";

/// What [`number`] takes, up to `most`.
fn number_form(most: i128) -> Form {
    Form::integer(0..=most).or(Form::Text(Some(HEX)))
}

/// What [`word`] takes.
fn word_form() -> Form {
    number_form(u16::MAX.into())
}

fn word(value: &DeValue<'_>) -> Option<u16> {
    u16::try_from(number(value)?).ok()
}

/// Who a slave has to be.
pub(super) fn identity(table: &mut Table<'_>, of: &mut Expected) {
    const LONG: (i128, &str) = (u32::MAX as i128, "32 bits like 0x6A");
    const SHORT: (i128, &str) = (u16::MAX as i128, "16 bits");
    set(&mut of.vendor, expected(table, VENDOR, LONG));
    set(&mut of.product, expected(table, PRODUCT, LONG));
    set(&mut of.revision, expected(table, REVISION, LONG));
    set(&mut of.serial, expected(table, SERIAL, LONG));
    set(&mut of.alias, expected(table, ALIAS, SHORT));
    set(&mut of.identification, expected(table, IDENTIFICATION, SHORT));
}

/// A number up to `most` by which a slave is known, or any.
fn expected<T: TryFrom<i128>>(
    table: &mut Table<'_>,
    key: Key,
    (most, what): (i128, &str),
) -> Option<Option<T>> {
    table.read_or(key, number_form(most), "any", |value| {
        let number = number(value).and_then(|number| T::try_from(number).ok());
        number.ok_or_else(|| format!("must be a number of {what}"))
    })
}

/// `[start, bytes]`
pub(super) fn mailbox(table: &mut Table<'_>, default: Option<[Area; 2]>) -> Option<[Area; 2]> {
    let own = table.optional("mailbox", |table| {
        let [out, read] = default.unwrap_or_default();
        // A device that has one has both.
        let key = |key| if default.is_none() { Key { default: "-", ..key } } else { key };
        Some([area(table, key(OUT)).unwrap_or(out), area(table, key(IN)).unwrap_or(read)])
    });
    own.or(default)
}

fn area(table: &mut Table<'_>, key: Key) -> Option<Area> {
    table.read(key, word_form().list(2, 2), |value| match list(value, 2..=2, word).as_deref() {
        Some(&[start, length]) if (16..=1486).contains(&length) => Ok(Area { start, length }),
        _ => Err("must be its start and its bytes, 16 ... 1486: [0x1800, 16]".into()),
    })
}

/// Where something begins.
pub(super) fn start(table: &mut Table<'_>, key: Key) -> Option<u16> {
    table.read(key, word_form(), |value| {
        word(value).ok_or("must be an address of 16 bits, like 0x1100".into())
    })
}

const OBJECT: &str = "an object like \"0x6041:0\" or \"status-word\", with its type behind it where it is \
     not known here: \"0x3612:0.i32\"";

/// An object and its type.
pub(super) fn object(value: &DeValue<'_>) -> Result<Entry, String> {
    let text = value.as_str().ok_or_else(|| format!("must be {OBJECT}"))?;
    let names = catalogue::all().map(|known| known.name);
    let target =
        Target::parse(text).ok_or_else(|| unknown("object", text, names, &format!("must be {OBJECT}")))?;
    let kind = target.kind.ok_or_else(|| {
        let object = target.object;
        format!("{object} is not known here; write its type behind it, like \"{object}.i32\"")
    })?;
    Ok(Entry { object: target.object, kind })
}

fn objects(value: &DeValue<'_>) -> Result<Vec<Entry>, String> {
    let wrong = || format!("must be a list of 1 to {MOST_OBJECTS} objects");
    elements(value, 1..=MOST_OBJECTS).ok_or_else(wrong)?.map(object).collect()
}

/// What [`index`] takes.
fn index_form() -> Form {
    Form::integer(0x1600..=0x17FF).or(Form::integer(0x1A00..=0x1BFF)).or(Form::Text(Some(HEX)))
}

/// What [`layout`] takes.
pub(super) fn layout_form() -> Form {
    let objects = || Form::Text(None).list(1, MOST_OBJECTS);
    let whole = Form::Fields(vec![("pdo", index_form(), true), ("objects", objects(), false)]);
    index_form().or(objects()).or(whole)
}

/// A PDO that is known of `family`, one with its objects, or objects to be mapped into the PDO `free`.
pub(super) fn layout(value: &DeValue<'_>, family: Family, free: u16) -> Result<Layout, String> {
    if value.as_array().is_some() {
        return Ok(Layout { pdo: free, entries: objects(value)? });
    }
    let Some(table) = value.as_table() else { return known(value, family) };
    let unknown = table.keys().any(|key| !matches!(key.get_ref().as_ref(), "pdo" | "objects"));
    let (number, list) = (table.get("pdo"), table.get("objects"));
    match (number, list) {
        (Some(number), Some(list)) if !unknown => {
            Ok(Layout { pdo: index(number.get_ref())?, entries: objects(list.get_ref())? })
        }
        (Some(number), None) if !unknown => known(number.get_ref(), family),
        _ => Err("must be { pdo = \"0x1704\", objects = [\"0x607A:0\", \"0x6040:0\"] }".into()),
    }
}

fn known(value: &DeValue<'_>, family: Family) -> Result<Layout, String> {
    let index = index(value)?;
    let fixed = pdo::fixed(family);
    fixed.iter().find(|layout| layout.pdo == index).cloned().ok_or_else(|| {
        let list: Vec<String> = fixed.iter().map(|layout| format!("{:#06X}", layout.pdo)).collect();
        format!(
            "is not a known PDO of this type ({}); list its objects: {{ pdo = \"{index:#06X}\", objects = \
             [...] }}",
            list.join(", ")
        )
    })
}

/// The number of a PDO.
fn index(value: &DeValue<'_>) -> Result<u16, String> {
    let index = word(value).filter(|index| matches!(index, 0x1600..=0x17FF | 0x1A00..=0x1BFF));
    index.ok_or(
        "must be the number of a PDO, \"0x1702\" or \"0x1B03\", or a list of objects to be mapped".into(),
    )
}

/// What [`start_up`] takes.
pub(super) fn start_up_form() -> Form {
    let value = Form::Text(None).or(Form::integer(..));
    Form::Fields(vec![("object", Form::Text(None), true), ("value", value, true)]).list(0, MOST_START_UP)
}

/// What is written in PREOP.
pub(super) fn start_up(value: &DeValue<'_>) -> Result<Vec<Start>, String> {
    const FORM: &str = "must be a list like [{ object = \"0x35D5:1\", value = 4 }]";
    let one = |value: &DeValue<'_>| {
        let table = value.as_table().filter(|table| table.len() == 2).ok_or(FORM)?;
        let (address, value) = table.get("object").zip(table.get("value")).ok_or(FORM)?;
        let Entry { object: target, kind } = object(address.get_ref())?;
        let text = match (value.get_ref().as_str(), integer(value.get_ref())) {
            (Some(text), _) => text.to_owned(),
            (None, Some(number)) => number.to_string(),
            _ => return Err(FORM.to_owned()),
        };
        let address = format!("{target}.{}", kind.name());
        let raw = Objects.value(&address, &text).map_err(|error| format!("{target}: {error}"))?;
        Ok(match string(kind, &text).filter(|_| kind.is_string()) {
            Some(bytes) => Start::string(target, kind, bytes),
            None => Start::new(target, kind, raw),
        })
    };
    elements(value, ..=MOST_START_UP).ok_or(FORM)?.map(one).collect()
}
