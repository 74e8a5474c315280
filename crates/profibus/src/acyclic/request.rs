//! Parameters by path C: a request that is written to a record, and the response that is read from it.
//!
//! Several codes go in one request. A text that is too long for a response is read in parts.

use super::super::plan::{Numbers, ParameterPath};
use super::super::target::{BROKEN, Kind, Parameter, Service, Target, contradicts, number};
use super::super::wire::base_mode::{Address, Head, Outcome, RECORD, Response, Values};
use super::super::wire::errors::ErrorNumber;
use super::super::wire::msac1::Record;
use super::Read;
use super::transfer::Transfer;
use fieldbeat_core::axis::acyclic::Posted;
use fieldbeat_core::axis::acyclic::long::{MOST, raw};
use fieldbeat_core::bus::Calls;

/// The most parameters of a request. 39 would fit into a response (sheet, 3); a turn has bounded work.
pub(super) const BATCH: usize = 16;
/// Characters of a part of a text.
const PART: usize = 16;

/// The next step after a response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// It is that of another request: its own is read later.
    Again,
    /// There is more to request.
    Further,
    /// The same for all calls.
    Over(Result<Read, u32>),
    /// For each call [its own](Requests::result).
    Each,
}

/// A text that is read, so far.
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
    results: [Result<(u32, Kind), u32>; BATCH],
}

/// The code that a call is for.
pub(super) fn parameter(posted: &Posted) -> Option<Parameter> {
    Service::of(&posted.call)?.target().parameter()
}

impl Requests {
    pub(super) fn new(path: ParameterPath) -> Requests {
        let (record, axis, numbers) = match path {
            ParameterPath::Msac1 { slot, index, axis, numbers } => (Record { slot, index }, axis, numbers),
            _ => (Record { slot: 0, index: RECORD }, 0, Numbers::default()),
        };
        let results = [Ok((0, Kind::Own)); BATCH];
        Requests { record, axis, numbers, reference: 0, asked: 0, text: None, results }
    }

    /// A code can be in a request.
    pub(super) fn reaches(&self, parameter: Parameter) -> bool {
        self.numbers.index(parameter.code).is_some()
    }

    /// Another call may be in the request of the first one. Writes of a series have to end one by one, since the first
    /// that fails ends it.
    pub(super) fn joins(&self, first: &Posted, other: &Posted) -> bool {
        let both = [first, other].map(|posted| Service::of(&posted.call));
        let may_join = match both {
            [Some(Service::Read(_)), Some(Service::Read(_))] => true,
            [Some(Service::Write(..)), Some(Service::Write(..))] => first.series == 0 && other.series == 0,
            _ => false,
        };
        let is_number = |target: Target| {
            target.integer().is_some() && target.parameter().is_some_and(|code| self.reaches(code))
        };
        may_join && both.into_iter().flatten().map(Service::target).all(is_number)
    }

    /// For this call, and others behind it.
    pub(super) fn begin(&mut self, first: &Posted) {
        let service = Service::of(&first.call);
        let reads = matches!(service, Some(Service::Read(target)) if target.integer().is_none());
        self.text = reads.then_some(Text { bytes: [0; MOST], size: 0, parts: false });
    }

    /// Makes the request of those calls that have not ended, with a number of its own. A text is written as it was
    /// handed over.
    pub(super) fn build(
        &mut self,
        calls: &[Option<Posted>; BATCH],
        write: bool,
        kept: &Calls,
        transfer: &mut Transfer,
    ) {
        self.reference = self.reference.checked_add(1).unwrap_or(1);
        self.asked = (0..BATCH).filter(|place| calls[*place].is_some()).fold(0, |asked, n| asked | 1 << n);
        let Requests { reference, axis, numbers, .. } = *self;
        let part = self.text.as_ref().filter(|text| text.parts).map(|text| text.size as u16);
        let parameters = calls.iter().flatten().filter_map(|posted| {
            let service = Service::of(&posted.call)?;
            Some((service.target().parameter()?, service, posted))
        });
        let head = Head { reference, write, axis, count: self.asked.count_ones() as u8 };
        transfer.write(self.record, |out| {
            head.put(out);
            for (parameter, ..) in parameters.clone() {
                let index = numbers.index(parameter.code).unwrap_or_default();
                let (count, subindex) = match part {
                    Some(from) => (PART as u8, from),
                    None => (u8::from(parameter.sub > 0), parameter.sub.into()),
                };
                Address { count, index, subindex }.put(out);
            }
            for (parameter, service, posted) in parameters.filter(|_| write) {
                let kind = parameter.kind();
                let value = if let Service::Write(_, raw) = service { raw as u32 } else { 0 }.to_be_bytes();
                let bytes = match kind.integer() {
                    Some(integer) => value.get(4 - integer.bits as usize / 8..),
                    None => kept.loaded(posted),
                };
                Values { format: kind.into(), bytes: bytes.unwrap_or_default() }.put(out);
            }
        });
    }

    /// Makes the request to read the response.
    pub(super) fn read_response(&self, transfer: &mut Transfer) {
        transfer.read(self.record);
    }

    /// The outcome of the call at this place, as the last response says. An error is a status.
    pub(super) fn result(&self, place: usize) -> Result<Read, u32> {
        self.results.get(place).map_or(Err(BROKEN), |result| result.map(|(raw, kind)| (raw.into(), kind)))
    }

    /// A response. A text is kept for the calls behind it.
    pub(super) fn respond(
        &mut self,
        bytes: &[u8],
        calls: &[Option<Posted>],
        write: bool,
        kept: &mut Calls,
    ) -> Next {
        if bytes.first().is_some_and(|reference| *reference != self.reference) {
            return Next::Again;
        }
        let count = self.asked.count_ones() as u8;
        let own = Head { reference: self.reference, write, axis: self.axis, count };
        let Some(response) = Response::parse(bytes).filter(|response| response.head == own) else {
            return Next::Over(Err(BROKEN));
        };
        let mut outcomes = response.outcomes();
        if self.text.is_some() {
            let outcome = outcomes.next();
            return outcome.map_or(Next::Over(Err(BROKEN)), |outcome| self.text(outcome, calls, kept));
        }
        let asked = self.asked;
        let places = self.results.iter_mut().enumerate().filter(|(place, _)| asked >> place & 1 != 0);
        for ((place, result), outcome) in places.zip(outcomes) {
            let parameter = calls.get(place).and_then(Option::as_ref).and_then(parameter);
            *result = match (outcome, parameter) {
                (Outcome::Failed(error), _) => Err(number(error)),
                (Outcome::Written, _) if write => Ok((0, Kind::Own)),
                (Outcome::Read(values), Some(parameter)) if !write => match values.first() {
                    Some(value) => parameter.reported(values.format, value.cast_unsigned()),
                    None => Err(BROKEN),
                },
                // Or nobody waits for it.
                (Outcome::Written | Outcome::Read(_), _) => Err(BROKEN),
            };
        }
        Next::Each
    }

    /// A text, or a part of it.
    fn text(&mut self, outcome: Outcome<'_>, calls: &[Option<Posted>], kept: &mut Calls) -> Next {
        let Some(text) = &mut self.text else { return Next::Over(Err(BROKEN)) };
        if let Outcome::Read(Values { format, .. }) = outcome
            && format.size() != Some(1)
        {
            return Next::Over(Err(contradicts(Kind::Text, format)));
        }
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
            Outcome::Failed(ErrorNumber::TOO_LONG) if !text.parts => {
                text.parts = true;
                return Next::Further;
            }
            // It ended with the part before.
            Outcome::Failed(ErrorNumber::SUBINDEX) if text.size > 0 => {
                (text.size, text.bytes.get(..text.size).unwrap_or_default())
            }
            Outcome::Failed(error) => return Next::Over(Err(number(error))),
            Outcome::Written => return Next::Over(Err(BROKEN)),
        };
        if let Some(posted) = calls.first().and_then(Option::as_ref) {
            kept.keep(posted, whole, bytes);
        }
        Next::Over(Ok((raw(bytes), Kind::Own)))
    }
}
