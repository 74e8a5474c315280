//! Parameters: typed values at addresses in the drive's own notation.

use std::marker::PhantomData;
use std::sync::Arc;

use super::notation::{Access, Notation, ParameterAccess, ParameterError};
use super::queue::{Acyclic, CallTicket};
use super::{Answer, Call, CallError, PostError};

impl Acyclic {
    /// The parameters.
    pub fn parameters(&self) -> Parameters {
        Parameters(self.clone())
    }
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

    /// Reads `count` parameters that follow one another, from `address` on, in one request, and waits for them. Only a
    /// Unidrive does that: others refuse it.
    pub fn read_several<T: Scalar>(&self, address: &str, count: usize) -> Result<Vec<T>, ParameterError> {
        let read = self.access().read_several(address, count)?;
        Ok(read.into_iter().map(|(_, raw)| T::from_raw(raw)).collect())
    }

    /// Writes these values to parameters that follow one another, from `address` on, in one request, and waits until
    /// the drive has taken them. It takes them in their order up to the first one that it refuses, which the error
    /// names. While the power of the drive is on, all are [refused](CallError::Commands) if one of them may command it.
    /// Only a Unidrive does that: others refuse it.
    pub fn write_several<T: Scalar>(&self, address: &str, values: &[T]) -> Result<(), ParameterError> {
        let raw: Vec<u64> = values.iter().map(|value| value.to_raw()).collect();
        self.access().write_several(address, &raw)
    }

    fn access(&self) -> Access<'_> {
        Access { drive: self.0.axis(), notation: &**self.0.notation(), carrier: &self.0 }
    }

    /// Requests a parameter and returns at once.
    pub fn post_read<T: Scalar>(&self, address: &str) -> Result<ParameterTicket<T>, ParameterError> {
        let request = ParameterAccess::read(self.0.axis(), address);
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
        let request = ParameterAccess::write(self.0.axis(), address, self.0.notation().show(address, raw));
        let call = self.0.notation().write(address, raw).map_err(|error| request.wrong(error))?;
        self.post(request, call)
    }

    fn post<T: Scalar>(
        &self,
        request: ParameterAccess,
        call: Call,
    ) -> Result<ParameterTicket<T>, ParameterError> {
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
    request: ParameterAccess,
    notation: Arc<dyn Notation>,
    ticket: CallTicket,
    value: PhantomData<T>,
}

impl<T: Scalar> ParameterTicket<T> {
    /// The result, once, if it has ended. Never waits.
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
