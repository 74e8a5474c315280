//! The error numbers of a drive's parameters, in paths A and C (FPBA-01, G120 and G130 manuals; sheet, 1).

use std::fmt;

/// Why a drive did not carry out a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ErrorNumber(pub u16);

impl ErrorNumber {
    /// The subindex is wrong.
    pub const SUBINDEX: ErrorNumber = ErrorNumber(0x03);
    /// This interface has no right to change it.
    pub const NO_RIGHT: ErrorNumber = ErrorNumber(0x0B);
    /// The response has no room for it.
    pub const TOO_LONG: ErrorNumber = ErrorNumber(0x15);
    /// The first number of the manufacturer's own.
    const OWN: u16 = 0x65;

    /// The meaning, if known. Lenze's own list is not at hand.
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x00 => "the parameter does not exist",
            0x01 => "the parameter is read-only",
            0x02 => "a limit is exceeded",
            0x03 => "wrong subindex",
            0x04 => "the parameter is no array",
            0x05 => "wrong data type",
            0x06 => "the parameter can only be reset",
            0x07 => "the description cannot be changed",
            0x09 => "no description",
            0x0B => "no right to change it",
            0x0F => "no text array",
            0x11 => "not possible in this operating state",
            0x14 => "the value is not allowed",
            0x15 => "the response is too long",
            0x16 => "the address, attribute or count is not allowed",
            0x17 => "illegal format",
            0x18 => "the number of values is inconsistent",
            0x19 => "the axis does not exist",
            0x20 => "the text cannot be changed",
            Self::OWN.. => "the manufacturer's own",
            _ => return None,
        })
    }
}

impl fmt::Display for ErrorNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "error {:02X}h: {}", self.0, self.name().unwrap_or("not in the standard"))
    }
}
