//! Parameters: typed values at addresses in the drive's own notation.

use std::fmt::Debug;
use std::marker::PhantomData;
use std::sync::Arc;
use std::time::Duration;

use thiserror::Error;

use super::{Acyclic, Answer, Call, CallError, CallTicket, Carrier, PostError};

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
crate::errors::debug_as_display!(NotationError);

/// Why a parameter was not read or written.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum ParameterError {
    /// Nothing was sent.
    #[error("drive {drive}: {access} {address}: {error}")]
    Notation {
        /// The drive.
        drive: String,
        /// The access: read or write.
        access: &'static str,
        /// Its address.
        address: String,
        /// The reason.
        error: NotationError,
    },
    /// The queue did not accept it.
    #[error(transparent)]
    Post(#[from] PostError),
    /// The drive refused.
    #[error("drive {drive}: {access} {address}{}: {reason}", of(.value))]
    Refused {
        /// The drive.
        drive: String,
        /// The access: read or write.
        access: &'static str,
        /// Its address.
        address: String,
        /// The value that was to be written.
        value: Option<String>,
        /// The drive's status.
        status: u32,
        /// The meaning of the status.
        reason: String,
    },
    /// It was not carried out.
    #[error("drive {drive}: {access} {address}{}: {why}", of(.value))]
    Failed {
        /// The drive.
        drive: String,
        /// The access: read or write.
        access: &'static str,
        /// Its address.
        address: String,
        /// The value that was to be written.
        value: Option<String>,
        /// The reason.
        why: CallError,
    },
}
crate::errors::debug_as_display!(ParameterError);

fn of(value: &Option<String>) -> String {
    value.as_ref().map_or(String::new(), |value| format!(" = {value}"))
}

/// A type that a parameter may have: it takes the low bits of the raw value.
pub trait Scalar: Copy {
    /// From the raw value.
    fn from_raw(raw: u64) -> Self;
    /// To the raw value.
    fn to_raw(self) -> u64;
}

macro_rules! scalars {
    ($($name:ty: $unsigned:ty),*) => {$(
        impl Scalar for $name {
            fn from_raw(raw: u64) -> $name {
                raw as $name
            }
            fn to_raw(self) -> u64 {
                u64::from(self as $unsigned)
            }
        }
    )*};
}

scalars!(u8: u8, i8: u8, u16: u16, i16: u16, u32: u32, i32: u32, u64: u64, i64: u64);

impl Scalar for bool {
    /// Bit 0.
    fn from_raw(raw: u64) -> bool {
        raw & 1 != 0
    }
    fn to_raw(self) -> u64 {
        u64::from(self)
    }
}

impl Scalar for f32 {
    fn from_raw(raw: u64) -> f32 {
        f32::from_bits(raw as u32)
    }
    fn to_raw(self) -> u64 {
        u64::from(self.to_bits())
    }
}

/// The result of a write.
impl Scalar for () {
    fn from_raw(_raw: u64) {}
    fn to_raw(self) -> u64 {
        0
    }
}

/// The parameters of one drive, for any number of threads.
///
/// An address is written as in the drive's manual; LinUDP: `0x20A8` is the value in RAM, `0x20A8.rom`, `.min`,
/// `.max` and `.default` its variants, and `.both` writes RAM and ROM. All calls here block or poll on normal
/// threads; the loop carries out one step per cycle, in the request that goes out anyway.
#[derive(Clone, Debug)]
pub struct Parameters(Acyclic);

impl Parameters {
    pub(super) fn new(acyclic: Acyclic) -> Parameters {
        Parameters(acyclic)
    }

    /// The queue of calls below.
    pub fn acyclic(&self) -> &Acyclic {
        &self.0
    }

    /// Reads a parameter and waits for it.
    pub fn read<T: Scalar>(&self, address: &str) -> Result<T, ParameterError> {
        self.post_read(address)?.wait()
    }

    /// Writes a parameter and waits until the drive has taken it. While the power of the drive is on, a parameter that
    /// may command it is [refused](CallError::Commands).
    pub fn write<T: Scalar>(&self, address: &str, value: T) -> Result<(), ParameterError> {
        self.post_write(address, value)?.wait()
    }

    /// Requests a parameter and returns at once.
    pub fn post_read<T: Scalar>(&self, address: &str) -> Result<ParameterTicket<T>, ParameterError> {
        let asked = Asked::read(self.0.axis(), address);
        let call = self.0.notation().read(address).map_err(|error| asked.wrong(error))?;
        self.post(asked, call)
    }

    /// Sends a value and returns at once.
    pub fn post_write<T: Scalar>(
        &self,
        address: &str,
        value: T,
    ) -> Result<ParameterTicket<()>, ParameterError> {
        let raw = value.to_raw();
        let asked = Asked::write(self.0.axis(), address, self.0.notation().show(address, raw));
        let call = self.0.notation().write(address, raw).map_err(|error| asked.wrong(error))?;
        self.post(asked, call)
    }

    fn post<T: Scalar>(&self, asked: Asked, call: Call) -> Result<ParameterTicket<T>, ParameterError> {
        let notation = Arc::clone(self.0.notation());
        let ticket = match self.0.post(call, notation.limit(&call)) {
            // In the same words as from the loop.
            Err(PostError::Refused { why, .. }) => return Err(asked.failed(why)),
            posted => posted?,
        };
        Ok(ParameterTicket { asked, notation, ticket, value: PhantomData })
    }
}

/// A read or write under way. If dropped before its end, it is cancelled.
#[derive(Debug)]
pub struct ParameterTicket<T> {
    asked: Asked,
    notation: Arc<dyn Notation>,
    ticket: CallTicket,
    value: PhantomData<T>,
}

impl<T: Scalar> ParameterTicket<T> {
    /// Its result, once, if it has ended. Never waits.
    pub fn poll(&mut self) -> Option<Result<T, ParameterError>> {
        let result = self.ticket.poll()?;
        Some(self.asked.verdict(result, &*self.notation).map(T::from_raw))
    }

    /// Waits for its result.
    pub fn wait(mut self) -> Result<T, ParameterError> {
        let result = self.ticket.wait();
        self.asked.verdict(result, &*self.notation).map(T::from_raw)
    }

    /// Waits no longer than `limit`, then cancels it.
    pub fn wait_for(mut self, limit: Duration) -> Result<T, ParameterError> {
        let result = self.ticket.wait_for(limit);
        self.asked.verdict(result, &*self.notation).map(T::from_raw)
    }

    /// Cancels it; see [`CallTicket::cancel`].
    pub fn cancel(&self) {
        self.ticket.cancel();
    }
}

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
        let asked = Asked::read(self.drive, address);
        let call = self.notation.read(address).map_err(|error| asked.wrong(error))?;
        self.carry_out(&asked, call)
    }

    /// Writes a parameter from its text.
    pub fn write(&self, address: &str, text: &str) -> Result<u64, ParameterError> {
        let asked = Asked::write(self.drive, address, text.to_owned());
        let raw = self.notation.value(address, text).map_err(|error| asked.wrong(error))?;
        let call = self.notation.write(address, raw).map_err(|error| asked.wrong(error))?;
        self.carry_out(&asked, call)?;
        Ok(raw)
    }

    fn carry_out(&self, asked: &Asked, call: Call) -> Result<u64, ParameterError> {
        let series = self.carrier.run(&[call], self.notation.limit(&call));
        let result = match (series.answers.first(), series.failed) {
            (Some(answer), _) => Ok(*answer),
            (None, why) => Err(why.unwrap_or(CallError::Gone)),
        };
        asked.verdict(result, self.notation)
    }
}

/// The request, for messages.
#[derive(Clone, Debug)]
struct Asked {
    drive: String,
    access: &'static str,
    address: String,
    value: Option<String>,
}

impl Asked {
    fn read(drive: &str, address: &str) -> Asked {
        Asked { drive: drive.to_owned(), access: "read", address: address.to_owned(), value: None }
    }

    fn write(drive: &str, address: &str, value: String) -> Asked {
        Asked { access: "write", value: Some(value), ..Asked::read(drive, address) }
    }

    fn wrong(&self, error: NotationError) -> ParameterError {
        let Asked { drive, access, address, .. } = self.clone();
        ParameterError::Notation { drive, access, address, error }
    }

    fn verdict(
        &self,
        result: Result<Answer, CallError>,
        notation: &dyn Notation,
    ) -> Result<u64, ParameterError> {
        match result {
            Ok(answer) => Ok(answer.value),
            Err(CallError::Refused(status)) => {
                let Asked { drive, access, address, value } = self.clone();
                let reason = notation.reason(status);
                Err(ParameterError::Refused { drive, access, address, value, status, reason })
            }
            Err(why) => Err(self.failed(why)),
        }
    }

    fn failed(&self, why: CallError) -> ParameterError {
        let Asked { drive, access, address, value } = self.clone();
        ParameterError::Failed { drive, access, address, value, why }
    }
}
