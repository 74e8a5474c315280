//! A parameter request of the base mode, and its response.
//!
//! Facts: sheet, 3. What they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | values of 32 bits in a response | have the format "double word", of 16 bits "word" |
//! | a text | is read whole with 0 or 1 elements, if it fits; else so many characters from the subindex on, from 0 |
//! | a request that is no request | error 0x17 for each parameter |

use super::acyclic::BLOCK;
use super::channel::TOP;
use super::codes::{Codes, Refusal, Type};
use super::drive::Drive;
use super::settings::AcyclicSettings;
use fieldbeat_profibus::Numbers;

/// Formats of values.
mod format {
    pub const WORD: [u8; 3] = [0x42, 0x03, 0x06];
    pub const DOUBLE_WORD: [u8; 3] = [0x43, 0x04, 0x07];
    pub const TEXT: u8 = 0x09;
    pub const ZERO: u8 = 0x40;
    pub const ERROR: u8 = 0x44;
    /// Bytes of a value, by format.
    pub fn size(format: u8) -> Option<usize> {
        match format {
            0x02 | 0x05 | 0x09 | 0x0A | 0x41 => Some(1),
            0x03 | 0x06 | 0x42 => Some(2),
            0x04 | 0x07 | 0x43 => Some(4),
            _ => None,
        }
    }
}

const READ: u8 = 1;
const WRITE: u8 = 2;
/// The bit of a response in which something failed.
const FAILED: u8 = 0x80;
/// The attribute "value".
const VALUE: u8 = 0x10;
/// The attribute "text", which no code has.
const TEXT: u8 = 0x30;
/// The most parameters of a request.
const PARAMETERS: usize = 39;

/// The address of a parameter.
#[derive(Clone, Copy)]
struct Place {
    attribute: u8,
    elements: u8,
    index: u16,
    subindex: u16,
}

/// Executes a request: its response.
pub(super) fn execute(bytes: &[u8], settings: &AcyclicSettings, drive: &mut Drive) -> Vec<u8> {
    let [reference, id, axis, count, rest @ ..] = bytes else {
        return vec![bytes.first().copied().unwrap_or(0), FAILED, 0, 0];
    };
    let count = usize::from(*count);
    let mut out = vec![*reference, *id, *axis, count as u8];
    let results = match places(rest, count).filter(|_| matches!(*id, READ | WRITE)) {
        None => vec![Err(Refusal::Format); count.clamp(1, PARAMETERS)],
        Some(_) if *axis > 1 => vec![Err(Refusal::Axis); count],
        Some((places, _)) if *id == READ => {
            places.iter().map(|place| read(*place, settings, drive)).collect()
        }
        Some((places, values)) => write(&places, values, settings, drive),
    };
    let failed = results.iter().any(Result::is_err);
    if failed {
        out[1] |= FAILED;
    }
    let goods = *id == READ || failed;
    for result in results {
        let before = out.len();
        match result {
            Ok(value) if goods => out.extend(value),
            Ok(_) => {}
            Err(refusal) => error(refusal, &mut out),
        }
        if out.len() > BLOCK {
            out.truncate(before);
            out[1] |= FAILED;
            error(Refusal::ResponseTooLong, &mut out);
        }
    }
    out.truncate(BLOCK);
    out
}

fn error(refusal: Refusal, out: &mut Vec<u8>) {
    out.extend([format::ERROR, 1]);
    out.extend(refusal.number().to_be_bytes());
}

/// The addresses of so many parameters, and what follows them.
fn places(bytes: &[u8], count: usize) -> Option<(Vec<Place>, &[u8])> {
    let (addresses, values) =
        bytes.split_at_checked(6 * count).filter(|_| (1..=PARAMETERS).contains(&count))?;
    let place = |bytes: &[u8; 6]| Place {
        attribute: bytes[0],
        elements: bytes[1],
        index: u16::from_be_bytes([bytes[2], bytes[3]]),
        subindex: u16::from_be_bytes([bytes[4], bytes[5]]),
    };
    Some((addresses.as_chunks().0.iter().map(place).collect(), values))
}

fn code(place: Place, settings: &AcyclicSettings) -> u16 {
    match settings.numbers {
        Numbers::FromTop => TOP.wrapping_sub(place.index),
        Numbers::Code => place.index,
    }
}

fn read(place: Place, settings: &AcyclicSettings, drive: &Drive) -> Result<Vec<u8>, Refusal> {
    let code = code(place, settings);
    match place.attribute {
        VALUE => {}
        TEXT => return Err(Refusal::NoText),
        _ => return Err(Refusal::Count),
    }
    if let Ok((Type::Text(text), _)) = Codes::describe(code, 0) {
        return part(text.as_bytes(), place, settings);
    }
    let (of, value) = drive.read(code, place.subindex)?;
    let [a, b, c, d] = value.to_be_bytes();
    match of {
        _ if place.elements > 1 => Err(Refusal::Count),
        Type::Word => Ok(vec![format::WORD[0], 1, c, d]),
        _ => Ok(vec![format::DOUBLE_WORD[0], 1, a, b, c, d]),
    }
}

/// A text, or a part of it.
fn part(text: &[u8], place: Place, settings: &AcyclicSettings) -> Result<Vec<u8>, Refusal> {
    let (from, count) = match place.elements {
        0 | 1 if place.subindex == 0 => (0, text.len()),
        count => (usize::from(place.subindex), usize::from(count)),
    };
    let rest = text.get(from..).filter(|rest| !rest.is_empty()).ok_or(Refusal::NoSubcode)?;
    let part = &rest[..rest.len().min(count)];
    if part.len() > settings.text {
        return Err(Refusal::ResponseTooLong);
    }
    let mut out = vec![format::TEXT, part.len() as u8];
    out.extend_from_slice(part);
    if out.len() % 2 != 0 {
        out.push(0);
    }
    Ok(out)
}

/// Writes all parameters whose values can be found.
fn write(
    places: &[Place],
    mut values: &[u8],
    settings: &AcyclicSettings,
    drive: &mut Drive,
) -> Vec<Result<Vec<u8>, Refusal>> {
    let mut results = Vec::with_capacity(places.len());
    for place in places {
        let value = value(&mut values);
        results.push((|| {
            let (format, value) = value.ok_or(Refusal::Format)?;
            if place.attribute != VALUE || place.elements > 1 {
                return Err(Refusal::Count);
            }
            let code = code(*place, settings);
            let (of, _) = Codes::describe(code, place.subindex)?;
            let value = match (of, value) {
                (Type::Word, [a, b]) if format::WORD.contains(&format) => u16::from_be_bytes([*a, *b]).into(),
                (Type::Fixed, [a, b, c, d]) if format::DOUBLE_WORD.contains(&format) => {
                    i32::from_be_bytes([*a, *b, *c, *d])
                }
                // Each of them is read-only.
                (Type::Text(_), _) if format == format::TEXT => 0,
                _ => return Err(Refusal::WrongType),
            };
            drive.write(code, place.subindex, value)?;
            Ok(vec![format::ZERO, 0])
        })());
    }
    results
}

/// Takes the next format and its values, and the padding behind them.
fn value<'a>(bytes: &mut &'a [u8]) -> Option<(u8, &'a [u8])> {
    let [format, count, rest @ ..] = *bytes else { return None };
    let length = format::size(*format)? * usize::from(*count);
    let (value, _) = rest.split_at_checked(length)?;
    *bytes = rest.get(length + length % 2..).unwrap_or_default();
    Some((*format, value))
}
