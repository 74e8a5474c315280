//! Parameters by path C: a request that is written to a record, and the response that is read from it.
//!
//! Several codes go in one request. A text that is too long for a response is read in parts.

use super::super::plan::{Numbers, ParameterPath};
use super::super::target::{BROKEN, Kind, NO_CALL, Parameter, Target, UNREACHABLE, number};
use super::super::wire::Writer;
use super::super::wire::base_mode::{
    Address, Attribute, Format, Outcome, RECORD, Response, Values, put_read, put_write,
};
use super::super::wire::errors::ErrorNumber;
use super::super::wire::msac1::Record;
use super::transfer::Transfer;
use crate::axis::acyclic::Posted;
use crate::axis::acyclic::long::{Kept, MOST, raw};

/// The most parameters of a request. 39 would fit into a response (sheet, 3); a turn has bounded work.
pub(super) const BATCH: usize = 16;
/// Characters of a part of a text.
const PART: usize = 16;

/// What follows a response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// It is that of another request: its own is read later.
    Again,
    /// There is more to request.
    Further,
    /// The same for all calls.
    Over(Result<u64, u32>),
    /// For each call [its own](Requests::result).
    Each,
}

/// A text so far.
#[derive(Debug)]
struct Text {
    bytes: [u8; MOST],
    size: usize,
    /// It is read in parts.
    parts: bool,
}

/// The parameter requests to one drive.
#[derive(Debug)]
pub(super) struct Requests {
    record: Record,
    axis: u8,
    numbers: Numbers,
    /// The number of the last request.
    reference: u8,
    /// The calls in it, a bit each.
    asked: u16,
    text: Option<Text>,
    results: [Result<u32, u32>; BATCH],
}

impl Requests {
    pub(super) fn new(path: ParameterPath) -> Requests {
        let (record, axis, numbers) = match path {
            ParameterPath::Msac1 { slot, index, axis, numbers } => (Record { slot, index }, axis, numbers),
            _ => (Record { slot: 0, index: RECORD }, 0, Numbers::default()),
        };
        let results = [Ok(0); BATCH];
        Requests { record, axis, numbers, reference: 0, asked: 0, text: None, results }
    }

    /// Whether a code can be in a request; an error is a status.
    pub(super) fn admit(&self, parameter: Parameter, write: bool) -> Result<(), u32> {
        match self.numbers.index(parameter.code) {
            None => Err(UNREACHABLE),
            Some(_) if write && parameter.kind() == Kind::Text => Err(NO_CALL),
            Some(_) => Ok(()),
        }
    }

    /// For this call, and others behind it.
    pub(super) fn begin(&mut self, first: &Posted) {
        let is_text = matches!(
            Target::unpack(first.call.address),
            Some(Target::Parameter(parameter)) if parameter.kind() == Kind::Text
        );
        self.text = is_text.then_some(Text { bytes: [0; MOST], size: 0, parts: false });
    }

    /// Makes the request of those calls that have not ended, with a number of its own.
    pub(super) fn build(&mut self, calls: &[Option<Posted>], writes: bool, transfer: &mut Transfer) {
        self.reference = self.reference.checked_add(1).unwrap_or(1);
        self.asked = 0;
        let scalar = Address { attribute: Attribute::Value, count: 0, index: 0, subindex: 0 };
        let mut addresses = [scalar; BATCH];
        let mut values = [(Format::U32, [0; 4]); BATCH];
        let mut count = 0;
        for (place, posted) in calls.iter().enumerate().take(BATCH) {
            let Some(posted) = posted else { continue };
            let Some(Target::Parameter(parameter)) = Target::unpack(posted.call.address) else { continue };
            let index = self.numbers.index(parameter.code).unwrap_or_default();
            let subindex = parameter.sub.into();
            let (Some(address), Some(value)) = (addresses.get_mut(count), values.get_mut(count)) else {
                break;
            };
            *address = Address { index, subindex, count: u8::from(subindex > 0), ..scalar };
            *value = (format(parameter.kind()), (posted.call.value as u32).to_be_bytes());
            self.asked |= 1 << place;
            count += 1;
        }
        if let (Some(text), [first, ..]) = (self.text.as_ref().filter(|text| text.parts), &mut addresses) {
            (first.count, first.subindex) = (PART as u8, text.size as u16);
        }
        let (reference, axis) = (self.reference, self.axis);
        let addresses = addresses.get(..count).unwrap_or_default();
        transfer.write(self.record, |out: &mut Writer<'_>| {
            if !writes {
                return put_read(reference, axis, addresses, out);
            }
            let mut parameters = [(scalar, Values { format: Format::U32, bytes: &[] }); BATCH];
            for ((parameter, address), (format, raw)) in parameters.iter_mut().zip(addresses).zip(&values) {
                let bytes = raw.get(4 - format.size().unwrap_or(4)..).unwrap_or_default();
                *parameter = (*address, Values { format: *format, bytes });
            }
            put_write(reference, axis, parameters.get(..count).unwrap_or_default(), out);
        });
    }

    /// Makes the request to read the response.
    pub(super) fn read_response(&self, transfer: &mut Transfer) {
        transfer.read(self.record);
    }

    /// What became of the call at this place, as the last response says. An error is a status.
    pub(super) fn result(&self, place: usize) -> Result<u64, u32> {
        self.results.get(place).map_or(Err(BROKEN), |result| result.map(u64::from))
    }

    /// A response. A text is kept in `read`.
    pub(super) fn respond(
        &mut self,
        bytes: &[u8],
        calls: &[Option<Posted>],
        writes: bool,
        read: &mut Kept,
    ) -> Next {
        if bytes.first().is_some_and(|reference| *reference != self.reference) {
            return Next::Again;
        }
        let Ok(response) = Response::parse(bytes) else { return Next::Over(Err(BROKEN)) };
        let is_its = response.head.write == writes
            && response.head.axis == self.axis
            && u32::from(response.count) == self.asked.count_ones();
        if !is_its {
            return Next::Over(Err(BROKEN));
        }
        let mut outcomes = response.outcomes();
        if self.text.is_some() {
            let outcome = outcomes.next();
            return outcome.map_or(Next::Over(Err(BROKEN)), |outcome| self.text(outcome, calls, read));
        }
        let asked = self.asked;
        let places = self.results.iter_mut().enumerate().filter(|(place, _)| asked >> place & 1 != 0);
        for ((_, result), outcome) in places.zip(outcomes) {
            *result = match outcome {
                Outcome::Failed { error, .. } => Err(number(error)),
                Outcome::Written if writes => Ok(0),
                Outcome::Read(values) if !writes => values.get(0).map(|value| value as u32).ok_or(BROKEN),
                Outcome::Written | Outcome::Read(_) => Err(BROKEN),
            };
        }
        Next::Each
    }

    /// A text, or a part of it.
    fn text(&mut self, outcome: Outcome<'_>, calls: &[Option<Posted>], read: &mut Kept) -> Next {
        let Some(text) = &mut self.text else { return Next::Over(Err(BROKEN)) };
        let (whole, bytes) = match outcome {
            Outcome::Read(Values { bytes, .. }) if !text.parts => (bytes.len(), bytes),
            Outcome::Read(Values { bytes, .. }) => {
                let room = text.bytes.get_mut(text.size..).unwrap_or_default();
                room.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
                text.size = MOST.min(text.size + bytes.len());
                if bytes.len() == PART && text.size < MOST {
                    return Next::Further;
                }
                (text.size, text.bytes.get(..text.size).unwrap_or_default())
            }
            Outcome::Failed { error: ErrorNumber::TOO_LONG, .. } if !text.parts => {
                text.parts = true;
                return Next::Further;
            }
            // It ended with the part before.
            Outcome::Failed { error: ErrorNumber::SUBINDEX, .. } if text.size > 0 => {
                (text.size, text.bytes.get(..text.size).unwrap_or_default())
            }
            Outcome::Failed { error, .. } => return Next::Over(Err(number(error))),
            Outcome::Written => return Next::Over(Err(BROKEN)),
        };
        if let Some(posted) = calls.first().and_then(Option::as_ref) {
            *read = Kept::of_read(posted, whole, bytes);
        }
        Next::Over(Ok(raw(bytes)))
    }
}

/// How a number is written.
fn format(kind: Kind) -> Format {
    match kind {
        Kind::I8 => Format::I8,
        Kind::U8 => Format::U8,
        Kind::I16 => Format::I16,
        Kind::U16 => Format::U16,
        Kind::Own | Kind::I32 | Kind::Text => Format::I32,
        Kind::U32 => Format::U32,
    }
}
