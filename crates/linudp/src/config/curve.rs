//! A curve of a LinMot drive as a file: CSV with a head, a row each setpoint. Knows no drive.
//!
//! No CSV library reads this: two columns of numbers have no quotes, and a mistake has to name its line.
//!
//! What follows is the reference of docs/.
#![doc = include_str!("../../files/linmot-curve.md")]

use std::fmt::Write;
use std::path::Path;

use super::name;
use crate::curve::{Curve, CurveError, CurveKind, Dimension};
use fieldbeat_keys::error::ConfigErrors;
use fieldbeat_keys::file::{self, whole_file};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::page::{Page, Place};
use fieldbeat_keys::table::{Table, integer, list, number};
use fieldbeat_keys::value;

keys! {
    X_DIMENSION "x_dimension" = "(`26` for a time curve, `27` for a cam)":
        "the drive's number for the unit of x: 26 time, 27 encoder, 5 position";
    Y_DIMENSION "y_dimension" = "5": "the drive's number for the unit of the setpoints: 26 time, 27 "
        "encoder, 5 position";
    WIZARD "wizard" = "0": "how the vendor's tool made the curve";
    KIND "kind" = "-": "`\"time\"`, or `\"cam\"` over the counts of an encoder";
    ID "id" = "-": "number of the curve, 1 ... 100";
    LENGTH "length" = "-": "from the first setpoint to the last: ms in steps of 0.01, or counts of a cam";
    WIZARD_PARAMETERS "wizard_parameters" = "(zeros)": "7 numbers of that tool";
}

/// The column of an axis, and the decimals of one wire count in its unit.
type Column = (&'static str, u32);

/// The decimals of x where it falls between two counts.
const FINE: u32 = 6;

/// After so many rows with mistakes the others are not read: they have the same one.
const MOST_MISTAKES: usize = 10;

/// Reads the curve at `path`.
pub fn load(path: impl AsRef<Path>) -> Result<Curve, ConfigErrors> {
    let (file, text) = file::read(path.as_ref(), "a curve, for example rt-config/linmot-curve.csv")?;
    parse(&text, &file)
}

/// Reads the curve `text`; messages call it `file`.
pub fn parse(text: &str, file: &str) -> Result<Curve, ConfigErrors> {
    // Some spreadsheets begin a file with a byte order mark.
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let head_lines = text.lines().take_while(|line| line.trim().is_empty() || line.starts_with('#'));
    let (mut head, mut first) = (String::new(), 1);
    for line in head_lines {
        // In its column, for the messages of `toml`.
        let _ = writeln!(head, "{}", line.replacen('#', " ", 1));
        first += 1;
    }
    let rows = (first..).zip(text.lines().skip(first - 1));
    let rows: Vec<(usize, &str)> = rows.filter(|(_, line)| !line.trim().is_empty()).collect();
    let Some((columns, rows)) = rows.split_first() else {
        let message = format!("{file} has no rows; a curve has a head, a line of columns and its setpoints");
        return Err(whole_file(file, None, message));
    };
    let page = Page::new(file, &head);
    let entries = page.parse()?;
    let curve = curve(&page, Table::root(&page, &entries), *columns, rows);
    page.verdict()?;
    Ok(curve)
}

/// The file of a curve: what [`parse`] makes the same curve of. Refused is what a drive would refuse.
pub fn to_text(curve: &Curve) -> Result<String, CurveError> {
    curve.check()?;
    let (usual, word) = usual(curve.kind);
    let ((x_name, x_decimals), (y_name, y_decimals)) =
        (x_column(curve.x_dimension), y_column(curve.y_dimension));
    let mut text = format!("# id = {}\n", curve.id);
    name::write(&mut text, "# ", curve.name(), &curve.name);
    let length = value::decimal(curve.x_length.into(), x_decimals);
    let _ = writeln!(text, "# kind = \"{word}\"\n# length = {length}");
    for (key, number, usual) in [
        (X_DIMENSION, curve.x_dimension.0, usual.0),
        (Y_DIMENSION, curve.y_dimension.0, Dimension::POSITION.0),
        (WIZARD, curve.wizard, 0),
    ] {
        if number != usual {
            let _ = writeln!(text, "# {} = {number}", key.name);
        }
    }
    if curve.wizard_parameters != [0; 7] {
        let _ = writeln!(text, "# wizard_parameters = {:?}", curve.wizard_parameters);
    }
    let _ = writeln!(text, "{x_name},{y_name}");
    let steps = curve.setpoints.len() as i128 - 1;
    for (index, setpoint) in (0..).zip(&curve.setpoints) {
        let fine = i128::from(curve.x_length) * 10_i128.pow(FINE - x_decimals) * index;
        let x = value::decimal((fine + steps / 2) / steps, FINE);
        let _ = writeln!(text, "{x},{}", value::decimal(i128::from(*setpoint), y_decimals));
    }
    Ok(text)
}

/// The dimension of x that goes with a kind, and the kind's word.
fn usual(kind: CurveKind) -> (Dimension, &'static str) {
    match kind {
        CurveKind::Time => (Dimension::TIME, "time"),
        CurveKind::Cam => (Dimension::ENCODER, "cam"),
    }
}

fn x_column(dimension: Dimension) -> Column {
    match dimension {
        Dimension::TIME => ("time_ms", 2),
        Dimension::ENCODER => ("encoder_counts", 0),
        Dimension::POSITION => ("x_position_mm", 4),
        _ => ("x_raw", 0),
    }
}

fn y_column(dimension: Dimension) -> Column {
    match dimension {
        Dimension::POSITION => ("position_mm", 4),
        _ => ("y_raw", 0),
    }
}

/// The whole file. What is wrong is noted on the page, and the curve is not handed out then.
fn curve(page: &Page<'_>, mut head: Table<'_>, columns: (usize, &str), rows: &[(usize, &str)]) -> Curve {
    let hint = "at most 22 printable ASCII characters";
    let name = name::read(&mut head, hint, |name| Curve::name_bytes(name).ok());
    let kind = head.word(KIND, &[("time", CurveKind::Time), ("cam", CurveKind::Cam)]);
    let x_dimension = dimension(&mut head, X_DIMENSION).or(kind.map(|kind| usual(kind).0));
    let y_dimension = dimension(&mut head, Y_DIMENSION).unwrap_or(Dimension::POSITION);
    let (x_column, y_column) = (x_dimension.map(x_column), y_column(y_dimension));
    let x_length = length(&mut head, x_column.unwrap_or(("", 0)));
    let place = head.place("length");
    let mut curve = Curve {
        id: head.integer(ID, 1..=100).unwrap_or_default(),
        kind: kind.unwrap_or(CurveKind::Time),
        name,
        x_length: x_length.unwrap_or_default(),
        x_dimension: x_dimension.unwrap_or(Dimension::TIME),
        y_dimension,
        wizard: head.integer(WIZARD, 0..=0xFFFF).unwrap_or_default(),
        wizard_parameters: wizard_parameters(&mut head).unwrap_or_default(),
        setpoints: Vec::new(),
    };
    head.finish();
    if let Some(x_column) = x_column
        && has_columns(page, columns, [x_column.0, y_column.0])
        && let Some(read) = setpoints(page, columns.0, rows, [x_column, y_column])
    {
        if let Some(x_length) = x_length {
            check_grid(page, &place, x_column, x_length, &read);
        }
        curve.setpoints = read.into_iter().map(|row| row.setpoint).collect();
    }
    curve
}

fn dimension(head: &mut Table<'_>, key: Key) -> Option<Dimension> {
    head.integer(key, 0..=0xFFFF).map(Dimension)
}

fn length(head: &mut Table<'_>, (_, decimals): Column) -> Option<u32> {
    let longest = value::decimal(u32::MAX.into(), decimals);
    head.read(LENGTH, Form::number(0.0..), |value| {
        number(value).and_then(|value| counts(value, decimals)).ok_or_else(|| {
            format!("must be a {}number, 0 to {longest}, in the unit of the first column", whole(decimals))
        })
    })
}

fn wizard_parameters(head: &mut Table<'_>) -> Option<[u32; 7]> {
    head.read(WIZARD_PARAMETERS, Form::integer(0..=u32::MAX.into()).list(7, 7), |value| {
        let list = list(value, 7..=7, |number| u32::try_from(integer(number)?).ok());
        let wrong = "must be a list of 7 whole numbers, 0 to 4294967295";
        list.and_then(|list| list.try_into().ok()).ok_or(wrong.into())
    })
}

/// What a number without decimals has to be.
fn whole(decimals: u32) -> &'static str {
    if decimals == 0 { "whole " } else { "" }
}

/// The nearest count of a value in user units; of one without decimals, the value itself or none.
fn counts<T: TryFrom<i64>>(value: f64, decimals: u32) -> Option<T> {
    let counts = (value * 10_f64.powi(decimals as i32)).round();
    let exact = decimals > 0 || counts == value;
    // Far more than any wire integer, and far less than what `f64` holds exactly.
    let counts = (exact && counts.abs() < 1e15).then_some(counts as i64)?;
    T::try_from(counts).ok()
}

/// The two cells of a line.
fn cells(line: &str) -> Option<[&str; 2]> {
    let (x, y) = line.split_once(',')?;
    (!y.contains(',')).then(|| [x.trim(), y.trim()])
}

/// Whether the line of columns says what the head says.
fn has_columns(page: &Page<'_>, (line, text): (usize, &str), expected: [&str; 2]) -> bool {
    let [x, y] = expected;
    let Some(found) = cells(text) else {
        let message = format!("must be the two columns {x},{y} with a comma between");
        page.report(Place::in_row(line, "columns", text), message);
        return false;
    };
    for (column, (found, expected)) in (1..).zip(found.iter().zip(expected)) {
        if *found != expected {
            let message =
                format!("must be {expected}, as in the head; convert the rows if their unit is another");
            page.report(Place::in_row(line, &format!("column {column}"), found), message);
        }
    }
    found == expected
}

/// A row that was read.
struct Row<'a> {
    line: usize,
    /// As written.
    text: &'a str,
    /// In user units.
    x: f64,
    setpoint: i32,
}

/// The rows; `None` if one of them is wrong, or there are too few or too many.
fn setpoints<'a>(
    page: &Page<'_>,
    head: usize,
    rows: &[(usize, &'a str)],
    [(x_name, _), (y_name, y_decimals)]: [Column; 2],
) -> Option<Vec<Row<'a>>> {
    let [low, high] = [i32::MIN, i32::MAX].map(|bound| value::decimal(bound.into(), y_decimals));
    let (mut read, mut mistakes) = (Vec::with_capacity(rows.len()), 0);
    for &(line, row) in rows {
        let mut report = |key, value, message: &str| {
            page.report(Place::in_row(line, key, value), message);
            mistakes += 1;
        };
        if read.len() == usize::from(u16::MAX) {
            report("row", row, "is one too many; a curve has at most 65535 setpoints");
            return None;
        }
        if let Some([x_text, y_text]) = cells(row) {
            let finite = |text: &str| text.parse::<f64>().ok().filter(|value| value.is_finite());
            let (x, y) = (finite(x_text), finite(y_text).and_then(|value| counts(value, y_decimals)));
            if x.is_none() {
                report(x_name, x_text, "must be a number; its decimals have a point");
            }
            if y.is_none() {
                report(y_name, y_text, &format!("must be a {}number, {low} to {high}", whole(y_decimals)));
            }
            read.extend(x.zip(y).map(|(x, setpoint)| Row { line, text: x_text, x, setpoint }));
        } else {
            report("row", row, "must be two numbers with a comma between; their decimals have a point");
        }
        if mistakes >= MOST_MISTAKES {
            return None;
        }
    }
    if rows.len() < 2 {
        let message = format!("have too few rows, {}; a curve has 2 to 65535 setpoints", rows.len());
        page.report(Place::in_row(head, "columns", ""), message);
        return None;
    }
    (mistakes == 0).then_some(read)
}

/// Whether the rows are where the drive will have them; else the first one that is not is found.
fn check_grid(page: &Page<'_>, length: &Place, (name, decimals): Column, x_length: u32, rows: &[Row<'_>]) {
    // What `to_text` rounds to.
    let finest = 10_f64.powi(-(FINE as i32));
    let near = |value: f64, step: f64| value.abs() <= (step / 20.0).max(finest);
    let end = f64::from(x_length) / 10_f64.powi(decimals as i32);
    let step = end / (rows.len() - 1) as f64;
    if rows.iter().enumerate().all(|(index, row)| near(row.x - step * index as f64, step)) {
        return;
    }
    let show = |value: f64| value::decimal((value / finest).round() as i128, FINE);
    if let Some(first) = rows.first()
        && !near(first.x, step)
    {
        let place = Place::in_row(first.line, name, first.text);
        return page.report(place, "must be 0: the length begins at the first setpoint");
    }
    let gaps = || rows.windows(2).map(|pair| pair[1].x - pair[0].x);
    let mut sorted: Vec<f64> = gaps().collect();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted[sorted.len() / 2];
    match gaps().zip(&rows[1..]).find(|(gap, _)| !near(gap - usual, usual)) {
        Some((gap, row)) => {
            let (gap, usual) = (show(gap), show(usual));
            let message = format!(
                "is {gap} after the row before, the others are {usual} apart: a row is missing, doubled or \
                 shifted; setpoints are equidistant"
            );
            page.report(Place::in_row(row.line, name, row.text), message);
        }
        None => {
            let last = rows.last().map_or(0.0, |row| row.x);
            let message = format!("but the last row is at {}; both must be equal", show(last));
            page.report(length.clone(), message);
        }
    }
}

#[cfg(test)]
mod tests;
