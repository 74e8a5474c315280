//! What a protocol adds to acyclic access: how its drives write addresses and values, and lists of their parameters.

use std::fmt::Debug;
use std::ops::ControlFlow;
use std::time::Duration;

use thiserror::Error;

use super::{Answer, Call, CallError, Carrier, PostError, Series};

/// The time limit of one parameter access, unless the notation sets another: a drive answers within milliseconds, but a
/// busy host may hold up every exchange of it.
const LIMIT: Duration = Duration::from_secs(5);

/// How the drives of a protocol write addresses and values.
pub trait Notation: Debug + Send + Sync {
    /// The protocol's name, as in the configuration.
    fn protocol(&self) -> &'static str;

    /// The call that reads `address`.
    fn read(&self, address: &str) -> Result<Call, NotationError>;

    /// The call that writes the raw `value` to `address`.
    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError>;

    /// The raw value of `text` for `address`.
    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError>;

    /// The raw value of `address` as a number in its own type, if the type is known.
    fn number(&self, address: &str, raw: u64) -> i64;

    /// A raw value of `address` as people read it.
    fn show(&self, address: &str, raw: u64) -> String;

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

    /// Reads `address` if its value may be longer than a raw value, or the drive says what it is: its first eight
    /// bytes, and its text. `None`: it is no such address.
    fn read_long(&self, _carrier: &dyn Carrier, _address: &str) -> Option<Result<(u64, String), CallError>> {
        None
    }

    /// The calls that write `text` to `address` if its value may be longer than a raw value. `None`: it is no such
    /// address, or no value of it.
    fn write_long(&self, _address: &str, _text: &str) -> Option<Vec<Call>> {
        None
    }

    /// How the parameters that are `wanted` are listed. An error is a mistake in what is wanted.
    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        Err(ListError::Wanted(format!("drive {} does not list its parameters", wanted.drive)))
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

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        Ok(Call { address: address.parse().unwrap(), ..Call::default() })
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        Ok(Call { value, ..self.read(address)? })
    }

    fn value(&self, _address: &str, text: &str) -> Result<u64, NotationError> {
        Ok(text.parse().unwrap())
    }

    fn number(&self, _address: &str, raw: u64) -> i64 {
        raw.cast_signed()
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
pub struct Request {
    /// The drive.
    pub drive: String,
    /// The access: read or write.
    pub access: &'static str,
    /// Its address.
    pub address: String,
    /// The value that was to be written.
    pub value: Option<String>,
}

impl std::fmt::Display for Request {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "drive {}: {} {}", self.drive, self.access, self.address)?;
        self.value.as_ref().map_or(Ok(()), |value| write!(f, " = {value}"))
    }
}

impl Request {
    /// To read `address`.
    pub fn read(drive: &str, address: &str) -> Request {
        Request { drive: drive.to_owned(), access: "read", address: address.to_owned(), value: None }
    }

    /// To write `value` to `address`.
    pub fn write(drive: &str, address: &str, value: String) -> Request {
        Request { access: "write", value: Some(value), ..Request::read(drive, address) }
    }

    pub(super) fn wrong(&self, error: NotationError) -> ParameterError {
        ParameterError::Notation { request: Box::new(Request { value: None, ..self.clone() }), error }
    }

    /// What became of a write is not known.
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
        request: Box<Request>,
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
        request: Request,
        /// The drive's status.
        status: u32,
        /// The meaning of the status.
        reason: String,
    },
    /// It was not carried out.
    #[error("{request}: {why}{}", request.left_open(*why))]
    Failed {
        /// The access.
        request: Request,
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

    /// Reads a parameter: its value, and the address that has been answered. That may say more of the value than the
    /// one that was asked.
    pub fn answer(&self, address: &str) -> Result<Answer, ParameterError> {
        let request = Request::read(self.drive, address);
        let call = self.notation.read(address).map_err(|error| request.wrong(error))?;
        self.carry_out(&request, &[call])
    }

    /// Reads a parameter of any length: its raw value, or the beginning of it, and its text.
    pub fn read_shown(&self, address: &str) -> Result<(u64, String), ParameterError> {
        if let Some(read) = self.notation.read_long(self.carrier, address) {
            return read.map_err(|why| Request::read(self.drive, address).failed(why, self.notation));
        }
        let raw = self.read(address)?;
        Ok((raw, self.notation.show(address, raw)))
    }

    /// Writes a parameter from its text.
    pub fn write(&self, address: &str, text: &str) -> Result<u64, ParameterError> {
        let request = Request::write(self.drive, address, text.to_owned());
        let raw = self.notation.value(address, text).map_err(|error| request.wrong(error))?;
        let calls = match self.notation.write_long(address, text) {
            Some(calls) => calls,
            None => vec![self.notation.write(address, raw).map_err(|error| request.wrong(error))?],
        };
        self.carry_out(&request, &calls)?;
        Ok(raw)
    }

    /// Carries out calls that belong together; returns what the first one has answered.
    fn carry_out(&self, request: &Request, calls: &[Call]) -> Result<Answer, ParameterError> {
        let limit = calls.first().map_or(LIMIT, |call| self.notation.limit(call));
        let Series { answers, failed } = self.carrier.run(calls, limit);
        match (failed, answers.first()) {
            (None, Some(answer)) => Ok(*answer),
            (failed, _) => Err(request.failed(failed.unwrap_or(CallError::Gone), self.notation)),
        }
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

/// One parameter of a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its address.
    pub address: String,
    /// Its name, if it is known.
    pub name: Option<&'static str>,
    /// Size or type, and access.
    pub usage: Option<String>,
    /// Its value, if that was wanted or comes with the list.
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

/// What a list needs.
pub enum Listing {
    /// Nothing: the list is known.
    Known(Vec<Listed>),
    /// The drive.
    Read(Box<ReadList>),
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

/// Those of `rows` that the drive has, with their values.
pub fn read_listed(
    access: Access<'_>,
    watch: Watcher<'_>,
    rows: Vec<Listed>,
) -> Result<Vec<Listed>, ListError> {
    let all = rows.len();
    let mut found = Vec::with_capacity(all);
    for (done, row) in rows.into_iter().enumerate() {
        go_on(access, watch, done, all)?;
        match access.read(&row.address) {
            Ok(raw) => found.push(Listed { raw: Some(raw), ..row }),
            // Another model has it, or another firmware.
            Err(ParameterError::Refused { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(found)
}

/// Hexadecimal digits and nothing else.
pub fn bits(digits: &str) -> Option<u64> {
    u64::from_str_radix(digits, 16).ok().filter(|_| !digits.starts_with('+'))
}

/// The number that `text` means if it lies within `range`; `form` says how one is written.
pub fn within(
    number: Option<i64>,
    range: (i64, i64),
    text: &str,
    form: impl FnOnce() -> String,
) -> Result<i64, NotationError> {
    let (low, high) = range;
    match number {
        Some(number) if (low..=high).contains(&number) => Ok(number),
        Some(_) => Err(NotationError::Range { value: text.to_owned(), low, high }),
        None => Err(NotationError::Value { value: text.to_owned(), form: form() }),
    }
}

/// The count that `text` means for a parameter with so many decimals.
pub fn count(text: &str, decimals: u32) -> Option<i64> {
    match text {
        "true" => return Some(1),
        "false" => return Some(0),
        _ => {}
    }
    let Some((whole, part)) = text.split_once('.') else { return text.parse().ok() };
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let places = u32::try_from(part.len()).ok().filter(|places| *places <= decimals)?;
    if !digits(whole.strip_prefix('-').unwrap_or(whole)) || !digits(part) {
        return None;
    }
    let number: i64 = format!("{whole}{part}").parse().ok()?;
    number.checked_mul(10_i64.pow(decimals - places))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_write_that_was_not_finished_in_time_may_have_been_done() {
        let done = |request: Request, why| {
            request.failed(why, &Numbers).to_string().contains("may have been written")
        };
        let write = || Request::write("x", "1", "2".to_owned());
        assert!(done(write(), CallError::TimedOut));
        assert!(!done(write(), CallError::NotOnline));
        assert!(!done(Request::read("x", "1"), CallError::TimedOut));
    }
}
