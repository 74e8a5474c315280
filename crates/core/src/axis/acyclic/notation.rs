//! What a protocol adds to acyclic access: how its drives write addresses and values, and lists of their parameters.

use std::fmt::Debug;
use std::ops::ControlFlow;
use std::time::Duration;

use thiserror::Error;

use super::values::{Place, Values};
use super::{Answer, Call, CallError, Carrier, PostError, Series, long};
#[cfg(test)]
use super::{Integer, values::Counts};

/// The time limit of one parameter access, unless the notation sets another: a drive answers within milliseconds, but a
/// busy host may hold up every exchange of it.
const LIMIT: Duration = Duration::from_secs(5);

/// How the drives of a protocol write addresses and values.
pub trait Notation: Debug + Send + Sync {
    /// The protocol's name, as in the configuration.
    fn protocol(&self) -> &'static str;

    /// The place at `address`.
    fn place(&self, address: &str) -> Result<Place, NotationError>;

    /// The kind of the values at `address`, as far as it is known.
    fn values(&self, address: &str) -> Values {
        self.place(address).map_or_else(|_| Values::Unknown { form: String::new() }, |place| place.values)
    }

    /// The call that reads `address`.
    fn read(&self, address: &str) -> Result<Call, NotationError> {
        self.place(address)?.read
    }

    /// The call that writes the raw `value` to `address`.
    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let Place { write, values, .. } = self.place(address)?;
        let call = write?;
        match call.service {
            long::STORE => Ok(call),
            _ => Ok(Call { value: values.written(value)?, ..call }),
        }
    }

    /// The raw value of `text` for `address`: a count as on the wire, its bits, or a word.
    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let Place { write, values, .. } = self.place(address)?;
        write.and_then(|_| values.raw(text))
    }

    /// The raw value of `text` for `address` in the unit in which [`show`](Self::show) shows it; its bits and its words
    /// are as they are.
    fn in_unit(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        in_unit(self, address, text)
    }

    /// The raw value of `address` as a number in its own type, if the type is known.
    fn number(&self, address: &str, raw: u64) -> i64 {
        self.values(address).number(raw)
    }

    /// A raw value of `address` as people read it.
    fn show(&self, address: &str, raw: u64) -> String {
        self.values(address).show(raw)
    }

    /// The answer of a drive to a read of `address`, as people read it.
    fn show_answer(&self, address: &str, answer: &Answer) -> String {
        self.show(address, answer.value)
    }

    /// The meaning of a status of the drive.
    fn reason(&self, status: u32) -> String;

    /// The time limit of `call`.
    fn limit(&self, _call: &Call) -> Duration {
        LIMIT
    }

    /// The addresses that show what a write to `address` has set.
    fn read_back(&self, address: &str) -> Vec<String> {
        vec![address.to_owned()]
    }

    /// Whether a drive that returns `read` for `address` has the value that was `written`.
    fn is_same(&self, address: &str, written: u64, read: u64) -> bool {
        self.number(address, written) == self.number(address, read)
    }

    /// Reads `address` if its value may be longer than a raw value: its first eight bytes, and its text. `None`: it is
    /// no such address.
    fn read_long(&self, carrier: &dyn Carrier, address: &str) -> Option<Result<(u64, String), CallError>> {
        let Place { read, values, .. } = self.place(address).ok().filter(|place| place.values.are_bytes())?;
        let call = read.ok()?;
        let read = long::read(carrier, call.address, self.limit(&call));
        Some(read.map(|bytes| (long::raw(&bytes), values.text(&bytes))))
    }

    /// The calls that write `text` to `address` if its value may be longer than a raw value. `None`: it is no such
    /// address, or no value of it.
    fn write_long(&self, address: &str, text: &str) -> Option<Vec<Call>> {
        let Place { write, values, .. } = self.place(address).ok()?;
        let call = write.ok().filter(|call| call.service == long::STORE || values.are_bytes())?;
        Some(long::write(call.address, &values.bytes(text)?))
    }

    /// `count` parameters that the drive reads or writes in one request, from `address` on.
    fn block(&self, _address: &str, _count: usize) -> Result<Block, NotationError> {
        Err(NotationError::Alone)
    }

    /// How the parameters that are `wanted` are listed. An error is a mistake in what is wanted.
    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        Err(wanted.refused("does not list its parameters"))
    }

    /// A parameter of a list with what the drive has answered to a read of it.
    fn listed(&self, row: Listed, answer: &Answer) -> Listed {
        Listed { raw: Some(answer.value), ..row }
    }
}

/// Parameters that follow one another, which a drive reads or writes in one request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// The address of each.
    pub addresses: Vec<String>,
    /// That of the calls.
    pub address: u32,
    /// Bytes of each value in the calls, the highest one first.
    pub bytes: usize,
}

impl Block {
    /// All of them, for messages.
    fn shown(&self) -> String {
        match &self.addresses[..] {
            [first, .., last] => format!("{first} ... {last}"),
            addresses => addresses.concat(),
        }
    }
}

/// Addresses and values that are numbers, of a drive that says nothing about them.
#[cfg(test)]
#[derive(Debug)]
pub(crate) struct Numbers;

#[cfg(test)]
impl Notation for Numbers {
    fn protocol(&self) -> &'static str {
        "numbers"
    }

    fn place(&self, address: &str) -> Result<Place, NotationError> {
        let call = Call { address: address.parse().unwrap(), ..Call::default() };
        let values = Values::Counts(Counts::all(Integer { bits: 64, signed: true }));
        Ok(Place { read: Ok(call), write: Ok(call), values })
    }

    fn show(&self, _address: &str, raw: u64) -> String {
        raw.to_string()
    }

    fn reason(&self, status: u32) -> String {
        status.to_string()
    }
}

/// A mistake in an address or a value, found before anything is sent.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum NotationError {
    /// No address of this protocol.
    #[error("not an address of this drive; write {form}")]
    Address {
        /// A correct form.
        form: &'static str,
    },
    /// This variant of the address cannot be written.
    #[error("cannot be written; write to {instead}")]
    ReadOnly {
        /// The address that can be written.
        instead: &'static str,
    },
    /// A number that this parameter cannot have.
    #[error("{value} is out of the range of its type, {low} ... {high}")]
    Range {
        /// The given value.
        value: String,
        /// The lowest.
        low: i64,
        /// The highest.
        high: i64,
    },
    /// The drive has no request for several parameters.
    #[error("this drive reads and writes one parameter at a time: give one address and one value")]
    Alone,
    /// The same of a value in a unit.
    #[error("{value} is out of the range of its type, {low} ... {high}")]
    OutOfReach {
        /// The given value.
        value: String,
        /// The lowest, with its unit.
        low: String,
        /// The highest.
        high: String,
    },
    /// Not a value of this parameter.
    #[error("{value} is not a value of this parameter; write {form}")]
    Value {
        /// The given value.
        value: String,
        /// A correct form.
        form: String,
    },
}
crate::debug_as_display!(NotationError);

/// An access to a parameter, for messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterAccess {
    /// The drive.
    pub drive: String,
    /// The access: read or write.
    pub access: &'static str,
    /// The address.
    pub address: String,
    /// The value that was to be written.
    pub value: Option<String>,
}

impl std::fmt::Display for ParameterAccess {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "drive {}: {} {}", self.drive, self.access, self.address)?;
        self.value.as_ref().map_or(Ok(()), |value| write!(f, " = {value}"))
    }
}

impl ParameterAccess {
    /// To read `address`.
    pub fn read(drive: &str, address: &str) -> ParameterAccess {
        ParameterAccess { drive: drive.to_owned(), access: "read", address: address.to_owned(), value: None }
    }

    /// To write `value` to `address`.
    pub fn write(drive: &str, address: &str, value: String) -> ParameterAccess {
        ParameterAccess { access: "write", value: Some(value), ..ParameterAccess::read(drive, address) }
    }

    pub(super) fn wrong(&self, error: NotationError) -> ParameterError {
        ParameterError::Notation { request: Box::new(ParameterAccess { value: None, ..self.clone() }), error }
    }

    /// Says how far the outcome of a write is unknown.
    fn left_open(&self, why: CallError) -> &'static str {
        match (&self.value, why) {
            (Some(_), CallError::TimedOut) => "; what was to be written may have been written",
            _ => "",
        }
    }

    /// It was not carried out.
    pub fn failed(&self, why: CallError, notation: &dyn Notation) -> ParameterError {
        let request = self.clone();
        match why {
            CallError::Refused(status) => {
                ParameterError::Refused { request, status, reason: notation.reason(status) }
            }
            why => ParameterError::Failed { request, why },
        }
    }
}

/// Why a parameter was not read or written.
#[derive(Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// Nothing was sent.
    #[error("{request}: {error}")]
    Notation {
        /// The access, without a value.
        request: Box<ParameterAccess>,
        /// The reason.
        error: NotationError,
    },
    /// The queue did not accept it.
    #[error(transparent)]
    Post(#[from] PostError),
    /// The drive refused.
    #[error("{request}: {reason}")]
    Refused {
        /// The access.
        request: ParameterAccess,
        /// The drive's status.
        status: u32,
        /// The meaning of the status.
        reason: String,
    },
    /// It was not carried out.
    #[error("{request}: {why}{}", request.left_open(*why))]
    Failed {
        /// The access.
        request: ParameterAccess,
        /// The reason.
        why: CallError,
    },
}
crate::debug_as_display!(ParameterError);

/// The parameters of one drive through any carrier, as raw values.
#[derive(Clone, Copy)]
pub struct Access<'a> {
    /// The drive's name, for messages.
    pub drive: &'a str,
    /// How it writes addresses.
    pub notation: &'a dyn Notation,
    /// The carrier of its calls.
    pub carrier: &'a dyn Carrier,
}

impl std::fmt::Debug for Access<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Access").field("drive", &self.drive).finish_non_exhaustive()
    }
}

impl Access<'_> {
    /// Reads a parameter.
    pub fn read(&self, address: &str) -> Result<u64, ParameterError> {
        self.answer(address).map(|answer| answer.value)
    }

    /// Reads a parameter: its value, and the address of the answer. It may say more of the value than the address of
    /// the request.
    pub fn answer(&self, address: &str) -> Result<Answer, ParameterError> {
        let request = ParameterAccess::read(self.drive, address);
        let call = self.notation.read(address).map_err(|error| request.wrong(error))?;
        self.carry_out(&request, &[call])
    }

    /// Reads a parameter of any length: its raw value, or the beginning of it, and its text.
    pub fn read_shown(&self, address: &str) -> Result<(u64, String), ParameterError> {
        if let Some(read) = self.notation.read_long(self.carrier, address) {
            return read.map_err(|why| ParameterAccess::read(self.drive, address).failed(why, self.notation));
        }
        let answer = self.answer(address)?;
        Ok((answer.value, self.notation.show_answer(address, &answer)))
    }

    /// Writes a parameter from its text, in the unit in which it is shown.
    pub fn write(&self, address: &str, text: &str) -> Result<u64, ParameterError> {
        self.write_raw(address, text, self.notation.in_unit(address, text))
    }

    /// The same from a count.
    pub fn write_count(&self, address: &str, text: &str) -> Result<u64, ParameterError> {
        self.write_raw(address, text, self.notation.value(address, text))
    }

    fn write_raw(
        &self,
        address: &str,
        text: &str,
        raw: Result<u64, NotationError>,
    ) -> Result<u64, ParameterError> {
        let request = ParameterAccess::write(self.drive, address, text.to_owned());
        let raw = raw.map_err(|error| request.wrong(error))?;
        let calls = match self.notation.write_long(address, text) {
            Some(calls) => calls,
            None => vec![self.notation.write(address, raw).map_err(|error| request.wrong(error))?],
        };
        self.carry_out(&request, &calls)?;
        Ok(raw)
    }

    /// Reads `count` parameters from `address` on in one request: the address of each, and its raw value.
    pub fn read_several(&self, address: &str, count: usize) -> Result<Vec<(String, u64)>, ParameterError> {
        let several = ParameterAccess::read(self.drive, address);
        let block = self.notation.block(address, count).map_err(|error| several.wrong(error))?;
        let bytes = count * block.bytes;
        let request = ParameterAccess::read(self.drive, &block.shown());
        let answers = self.run(&request, &long::read_several(block.address, count, bytes))?;
        let data = long::read_bytes(&answers);
        let values = data
            .chunks_exact(block.bytes.max(1))
            .map(|bytes| bytes.iter().fold(0, |raw: u64, byte| raw << 8 | u64::from(*byte)));
        Ok(block.addresses.into_iter().zip(values).collect())
    }

    /// Writes these raw values to parameters from `address` on, in one request. An error names the parameter that was
    /// refused; those before it were written then.
    pub fn write_several(&self, address: &str, values: &[u64]) -> Result<(), ParameterError> {
        let several = ParameterAccess { access: "write", ..ParameterAccess::read(self.drive, address) };
        let block = self.notation.block(address, values.len()).map_err(|error| several.wrong(error))?;
        let one = |place: usize| {
            let (address, raw) = (&block.addresses[place], values[place]);
            ParameterAccess::write(self.drive, address, self.notation.show(address, raw))
        };
        let mut data = Vec::new();
        for (place, address) in block.addresses.iter().enumerate() {
            let call =
                self.notation.write(address, values[place]).map_err(|error| one(place).wrong(error))?;
            let raw = call.value.to_be_bytes();
            data.extend_from_slice(&raw[raw.len() - block.bytes.min(raw.len())..]);
        }
        let shown: Vec<String> = block
            .addresses
            .iter()
            .zip(values)
            .map(|(address, raw)| self.notation.show(address, *raw))
            .collect();
        let request = ParameterAccess::write(self.drive, &block.shown(), shown.join(", "));
        let answers = match self.run(&request, &long::write(block.address, &data)) {
            Err(ParameterError::Failed { why: CallError::CommandsAt(place), .. })
                if (place as usize) < values.len() =>
            {
                return Err(one(place as usize).failed(CallError::Commands, self.notation));
            }
            answers => answers?,
        };
        let stored = answers.last().copied().unwrap_or_default();
        let place = usize::try_from(stored.value).unwrap_or(usize::MAX) / block.bytes.max(1);
        if place >= values.len() {
            return Ok(());
        }
        let mut reason = self.notation.reason(stored.status);
        if place > 0 {
            reason += "; those before it were written";
        }
        Err(ParameterError::Refused { request: one(place), status: stored.status, reason })
    }

    /// Carries out calls of which the later ones need what the earlier ones have left.
    fn run(&self, request: &ParameterAccess, calls: &[Call]) -> Result<Vec<Answer>, ParameterError> {
        let fits = calls.len() <= self.carrier.capacity();
        let limit = calls.first().map_or(LIMIT, |call| self.notation.limit(call));
        let Series { answers, failed } = match fits {
            true => self.carrier.run(calls, limit),
            false => Series { failed: Some(CallError::Full), ..Series::default() },
        };
        match failed {
            None => Ok(answers),
            Some(why) => Err(request.failed(why, self.notation)),
        }
    }

    /// The same; returns what the first one has answered.
    fn carry_out(&self, request: &ParameterAccess, calls: &[Call]) -> Result<Answer, ParameterError> {
        let first = self.run(request, calls)?.first().copied();
        first.ok_or_else(|| request.failed(CallError::Gone, self.notation))
    }
}

/// Which parameters shall be listed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wanted<'a> {
    /// The drive's name, for messages.
    pub drive: &'a str,
    /// Those of one part, as a menu.
    pub part: Option<&'a str>,
    /// Only those whose value in flash is not the default.
    pub modified: bool,
    /// With their values.
    pub values: bool,
    /// Those from this address on.
    pub from: Option<&'a str>,
}

impl Wanted<'_> {
    /// The drive does not list this: it does something else, or cannot.
    pub fn refused(&self, why: &str) -> ListError {
        ListError::Wanted(format!("drive {} {why}", self.drive))
    }
}

/// One parameter of a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// The address.
    pub address: String,
    /// The name, if it is known.
    pub name: Option<&'static str>,
    /// Size or type, and access.
    pub usage: Option<String>,
    /// The value, if that was wanted or comes with the list.
    pub raw: Option<u64>,
}

/// The progress of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// The present activity.
    pub what: &'static str,
    /// Steps done ...
    pub done: usize,
    /// ... of so many.
    pub of: usize,
}

/// Receives the progress of a transfer; its return value can cancel it.
pub type Watcher<'a> = &'a mut dyn FnMut(Progress) -> ControlFlow<()>;

/// Makes a list by reading the drive.
pub type ReadList = dyn FnOnce(Access<'_>, Watcher<'_>) -> Result<Vec<Listed>, ListError>;

/// The requirements of a list.
pub enum Listing {
    /// Nothing: the list is known.
    Known(Vec<Listed>),
    /// The drive.
    Read(Box<ReadList>),
}

impl Listing {
    /// Known parameters; with their values, as far as the drive has them.
    pub fn of(rows: Vec<Listed>, values: bool) -> Listing {
        match values {
            false => Listing::Known(rows),
            true => Listing::Read(Box::new(move |access, watch| read_listed(access, watch, rows))),
        }
    }
}

impl std::fmt::Debug for Listing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Listing::Known(rows) => f.debug_tuple("Known").field(rows).finish(),
            Listing::Read(_) => f.write_str("Read"),
        }
    }
}

/// Why there is no list.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum ListError {
    /// Drives of this protocol do not list this; nothing was sent.
    #[error("{0}")]
    Wanted(String),
    /// A parameter was not read.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// The drive did not give its list.
    #[error("{0}")]
    Failed(String),
    /// It was cancelled.
    #[error("drive {drive}: reading its parameters was interrupted")]
    BrokenOff {
        /// The drive.
        drive: String,
    },
}
crate::debug_as_display!(ListError);

/// Reports that `done` of `of` parameters are read; an error if that cancels the list.
pub fn go_on(access: Access<'_>, watch: Watcher<'_>, done: usize, of: usize) -> Result<(), ListError> {
    match watch(Progress { what: "read", done, of }) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(ListError::BrokenOff { drive: access.drive.to_owned() }),
    }
}

/// Those of `rows` that the drive has and that can be read, with their values.
fn read_listed(
    access: Access<'_>,
    watch: Watcher<'_>,
    mut rows: Vec<Listed>,
) -> Result<Vec<Listed>, ListError> {
    rows.retain(|row| access.notation.read(&row.address).is_ok());
    let all = rows.len();
    let mut found = Vec::with_capacity(all);
    for (done, row) in rows.into_iter().enumerate() {
        go_on(access, watch, done, all)?;
        match access.answer(&row.address) {
            Ok(answer) => found.push(access.notation.listed(row, &answer)),
            // Another model has it, or another firmware.
            Err(ParameterError::Refused { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(found)
}

/// The raw value of a text in the unit of `address`: what [`Notation::in_unit`] does of itself.
pub fn in_unit<N: Notation + ?Sized>(notation: &N, address: &str, text: &str) -> Result<u64, NotationError> {
    let is_raw = text.starts_with("0x") || matches!(text, "true" | "false");
    match notation.values(address).quantity().filter(|_| !is_raw) {
        Some(quantity) => quantity.raw(text, |count| notation.value(address, count)),
        None => notation.value(address, text),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Single numbers, and blocks of them in four bytes each.
    #[derive(Debug)]
    struct Blocks;

    impl Notation for Blocks {
        fn protocol(&self) -> &'static str {
            Numbers.protocol()
        }
        fn place(&self, address: &str) -> Result<Place, NotationError> {
            Numbers.place(address)
        }
        fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
            match value {
                ..=0xFFFF_FFFF => Numbers.write(address, value),
                _ => Err(NotationError::Value { value: value.to_string(), form: "less".to_owned() }),
            }
        }
        fn show(&self, address: &str, raw: u64) -> String {
            Numbers.show(address, raw)
        }
        fn reason(&self, status: u32) -> String {
            format!("status {status}")
        }
        fn block(&self, address: &str, count: usize) -> Result<Block, NotationError> {
            let first: u32 = address.parse().unwrap();
            let addresses = (first..).take(count).map(|address| address.to_string()).collect();
            Ok(Block { addresses, address: first, bytes: 4 })
        }
    }

    /// A drive that answers so, and the calls that it has received.
    struct Drive {
        answers: Series,
        received: std::cell::RefCell<Vec<Call>>,
        capacity: usize,
    }

    impl Carrier for Drive {
        fn run(&self, calls: &[Call], _limit: Duration) -> Series {
            self.received.borrow_mut().extend(calls);
            self.answers.clone()
        }
        fn condition(&self) -> Result<super::super::Condition, CallError> {
            Err(CallError::Gone)
        }
        fn claim(&self) -> Result<Box<dyn std::any::Any + Send>, CallError> {
            Err(CallError::Gone)
        }
        fn capacity(&self) -> usize {
            self.capacity
        }
        fn pause(&self, _time: Duration) {}
    }

    fn drive(answers: &[(u32, u64)], failed: Option<CallError>) -> Drive {
        let answer = |&(status, value)| Answer { status, address: 7, value };
        let answers = Series { answers: answers.iter().map(answer).collect(), failed };
        Drive { answers, received: Default::default(), capacity: 8 }
    }

    fn of<'a>(drive: &'a Drive, notation: &'a dyn Notation) -> Access<'a> {
        Access { drive: "x", notation, carrier: drive }
    }

    #[test]
    fn the_refused_one_of_several_values_is_named() {
        let said = |drive: &Drive| of(drive, &Blocks).write_several("7", &[1, 2, 3]).unwrap_err().to_string();
        let short = |bytes| drive(&[(0, 0), (0, 0), (256, bytes)], None);
        assert_eq!(said(&short(11)), "drive x: write 9 = 3: status 256; those before it were written");
        let open = said(&drive(&[], Some(CallError::TimedOut)));
        assert!(open.ends_with("may have been written"), "{open}");
        // Nothing is sent of what cannot be.
        let none = Drive { capacity: 2, ..drive(&[], None) };
        assert!(said(&none).contains("raise parameter_queue"));
        let wrong = of(&none, &Blocks).write_several("7", &[1, 1 << 40]).unwrap_err().to_string();
        assert_eq!(wrong, "drive x: write 8: 1099511627776 is not a value of this parameter; write less");
        let alone = of(&none, &Numbers).read_several("7", 2).unwrap_err().to_string();
        assert!(alone.starts_with("drive x: read 7: this drive reads and writes one parameter"), "{alone}");
        assert!(none.received.borrow().is_empty());
    }

    #[test]
    fn only_a_write_that_was_not_finished_in_time_may_have_been_done() {
        let done = |request: ParameterAccess, why| {
            request.failed(why, &Numbers).to_string().contains("may have been written")
        };
        let write = || ParameterAccess::write("x", "1", "2".to_owned());
        assert!(done(write(), CallError::TimedOut));
        assert!(!done(write(), CallError::NotOnline));
        assert!(!done(ParameterAccess::read("x", "1"), CallError::TimedOut));
    }
}
