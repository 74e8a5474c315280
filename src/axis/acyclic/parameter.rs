//! Parameters: typed values at addresses in the drive's own notation.

use std::fmt::Debug;
use std::marker::PhantomData;
use std::sync::Arc;
use std::time::Duration;

use thiserror::Error;

use super::list::{ListError, Listing, Wanted};
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

    /// Reads `address` if its value may be longer than a raw value: its first eight bytes, and its text. `None`: it is
    /// no such address.
    fn read_long(&self, _carrier: &dyn Carrier, _address: &str) -> Option<Result<(u64, String), CallError>> {
        None
    }

    /// How the parameters that are `wanted` are listed. An error is a mistake in what is wanted.
    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        Err(ListError::Wanted(format!("drive {} does not list its parameters", wanted.drive)))
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

    fn wrong(&self, error: NotationError) -> ParameterError {
        ParameterError::Notation { request: Box::new(Request { value: None, ..self.clone() }), error }
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
    #[error("{request}: {why}")]
    Failed {
        /// The access.
        request: Request,
        /// The reason.
        why: CallError,
    },
}
crate::errors::debug_as_display!(ParameterError);

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
///
/// ```
/// # use fieldbeat::{Master, Plan};
/// # use std::time::Duration;
/// # use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
/// # use fieldbeat::sim::WorldOptions;
/// # let drives = ["x", "y"].into_iter().zip(10..).map(|(name, host)| LinUdpDrive::new(name, [10, 0, 0, host].into()));
/// # let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
/// # let setup = Master::from_plan(Plan { buses: vec![Box::new(bus)], ..Plan::default() });
/// # let master = setup.simulate(WorldOptions::default())?.into_master(20.0)?;
/// # master.wait_online(Duration::from_secs(30))?;
/// let parameters = master.parameter("x")?;
/// // The home position, in RAM; 0.1 um.
/// let home: i32 = parameters.read("0x13C7")?;
/// parameters.write("0x13C7", home + 10_000)?;
/// assert_eq!(parameters.read::<i32>("0x13C7")?, home + 10_000);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
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
        let request = Request::read(self.0.axis(), address);
        let call = self.0.notation().read(address).map_err(|error| request.wrong(error))?;
        self.post(request, call)
    }

    /// Sends a value and returns at once.
    pub fn post_write<T: Scalar>(
        &self,
        address: &str,
        value: T,
    ) -> Result<ParameterTicket<()>, ParameterError> {
        let raw = value.to_raw();
        let request = Request::write(self.0.axis(), address, self.0.notation().show(address, raw));
        let call = self.0.notation().write(address, raw).map_err(|error| request.wrong(error))?;
        self.post(request, call)
    }

    fn post<T: Scalar>(&self, request: Request, call: Call) -> Result<ParameterTicket<T>, ParameterError> {
        let notation = Arc::clone(self.0.notation());
        let ticket = match self.0.post(call, notation.limit(&call)) {
            // In the same words as from the loop.
            Err(PostError::Refused { why, .. }) => return Err(request.failed(why, &*notation)),
            posted => posted?,
        };
        Ok(ParameterTicket { request, notation, ticket, value: PhantomData })
    }
}

/// A read or write under way. If dropped before its end, it is cancelled.
#[derive(Debug)]
pub struct ParameterTicket<T> {
    request: Request,
    notation: Arc<dyn Notation>,
    ticket: CallTicket,
    value: PhantomData<T>,
}

impl<T: Scalar> ParameterTicket<T> {
    /// Its result, once, if it has ended. Never waits.
    pub fn poll(&mut self) -> Option<Result<T, ParameterError>> {
        let result = self.ticket.poll()?;
        Some(self.verdict(result))
    }

    /// Waits for its result.
    pub fn wait(mut self) -> Result<T, ParameterError> {
        let result = self.ticket.wait();
        self.verdict(result)
    }

    fn verdict(&self, result: Result<Answer, CallError>) -> Result<T, ParameterError> {
        let value = result.map(|answer| T::from_raw(answer.value));
        value.map_err(|why| self.request.failed(why, &*self.notation))
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
        let request = Request::read(self.drive, address);
        let call = self.notation.read(address).map_err(|error| request.wrong(error))?;
        self.carry_out(&request, call)
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
        let call = self.notation.write(address, raw).map_err(|error| request.wrong(error))?;
        self.carry_out(&request, call)?;
        Ok(raw)
    }

    fn carry_out(&self, request: &Request, call: Call) -> Result<u64, ParameterError> {
        let series = self.carrier.run(&[call], self.notation.limit(&call));
        match series.answers.first() {
            Some(answer) => Ok(answer.value),
            None => Err(request.failed(series.failed.unwrap_or(CallError::Gone), self.notation)),
        }
    }
}
