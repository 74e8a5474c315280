//! The LinUDP V2 telegram, both directions: bytes <-> values.
//!
//! Knows no state, clock, socket or allocation, and does not interpret a telegram: the station decides which reply
//! belongs to which request, and the drive what it does with a request.
//!
//! Both directions begin with the same eight bytes, the *request definition* and the *response definition*, both
//! little-endian like everything else. One bit a block; the blocks follow in bit order, only those whose bit is set
//! (LinUDP V2 manual, 4.4).
//!
//! | bit | request: master to drive | bytes | | bit | response: drive to master | bytes |
//! |---|---|---|---|---|---|---|
//! | 0 | control word | 2 | | 0 | status word | 2 |
//! | 1 | motion command: header, 15 words | 32 | | 1 | state variable | 2 |
//! | 2 | real-time config, 4 words | 8 | | 2 | actual position, 0.1 um | 4 |
//! | | | | | 3 | demand position, 0.1 um | 4 |
//! | | | | | 4 | current, mA | 2 |
//! | | | | | 5 | warn word | 2 |
//! | | | | | 6 | error code | 2 |
//! | | | | | 7 | four monitoring channels | 16 |
//! | | | | | 8 | real-time config, 4 words | 8 |
//!
//! One exception: the real-time-config block of a response is present if the *request* carried one, whatever bit 8
//! says (seen by two independent masters on real drives).
//!
//! [`Request`] and [`Response`] are the plain values; [`ResponseView`], the master's, checks a datagram's length once
//! and reads single blocks.

/// Words are shown in hexadecimal, like in the manual.
macro_rules! debug_as_hex {
    ($($word:ident),*) => {
        $(impl fmt::Debug for $word {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!(stringify!($word), "({:#06x})"), self.0)
            }
        })*
    };
}

/// The numbers that are known, `NAME = number, "in words";`.
macro_rules! named {
    ($of:ident $($(#[$doc:meta])* $name:ident = $code:literal, $text:literal;)*) => {
        impl $of {
            $($(#[$doc])* pub const $name: $of = $of($code);)*

            /// All that are known.
            pub const ALL: &[$of] = &[$($of::$name),*];

            /// In words; `None` for one that is not known.
            pub const fn name(self) -> Option<&'static str> {
                match self.0 {
                    $($code => Some($text),)*
                    _ => None,
                }
            }
        }
    };
}

mod faults;
mod request;
mod response;
mod rtc;
mod words;

use std::fmt;

use thiserror::Error;

pub use faults::{ErrorCode, WarnWord};
pub use request::Request;
pub use response::{Front, Response, ResponseView};
pub use rtc::{Refusal, RtcBlock, RtcCommand, RtcStatus};
pub use words::{ControlWord, MainState, StateVar, StatusWord};

/// Bytes of the parts of a telegram. The blocks have no fixed offset.
mod field {
    /// Both definitions; the first block follows.
    pub const HEADER: usize = 8;

    pub const CONTROL: usize = 2;
    pub const MOTION: usize = 32;
    pub const CONFIG: usize = super::RtcBlock::SIZE;
    pub const PARAMETERS: usize = 30;
    /// Response blocks 0 ... 3.
    pub const FRONT: usize = 12;

    /// Bytes of response blocks 0 ... 7, in bit order.
    pub const RESPONSE: [u8; 8] = [2, 2, 4, 4, 2, 2, 2, 16];

    /// Bytes of each combination of response blocks 0 ... 7: the offset of a block is one look-up.
    pub const RESPONSE_SUM: [u8; 256] = {
        let mut sums = [0; 256];
        let mut definition = 1_usize;
        while definition < 256 {
            let without_lowest = definition & (definition - 1);
            sums[definition] = sums[without_lowest] + RESPONSE[definition.trailing_zeros() as usize];
            definition += 1;
        }
        sums
    };
}

/// The shortest request with a control word, and the shortest reply, bytes.
pub const SHORTEST: [usize; 2] = [field::HEADER + field::CONTROL, field::HEADER];

/// The longest request that the definitions can describe, bytes.
pub const REQUEST_MAX: usize = field::HEADER + field::CONTROL + field::MOTION + field::CONFIG;
/// The longest response that the definitions can describe, bytes, without padding.
pub const RESPONSE_MAX: usize = field::HEADER + field::RESPONSE_SUM[0xFF] as usize + field::CONFIG;

/// The common part of both definitions, the set of the blocks of a telegram.
macro_rules! definitions {
    ($($name:ident),*) => {
        $(impl $name {
            /// All blocks of `other` are in `self`.
            pub const fn contains(self, other: $name) -> bool {
                self.0 & other.0 == other.0
            }

            /// The blocks of both.
            pub const fn with(self, other: $name) -> $name {
                $name(self.0 | other.0)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!(stringify!($name), "({:#x})"), self.0)
            }
        })*
    };
}
definitions!(RequestDef, ResponseDef);

/// The blocks of a request (LinUDP V2 manual, 4.4.1). The reserved bits 3 ... 31 are kept as they come.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct RequestDef(pub u32);

impl RequestDef {
    /// No block: a status request.
    pub const NONE: RequestDef = RequestDef(0);
    /// Control word.
    pub const CONTROL: RequestDef = RequestDef(1 << 0);
    /// Motion command.
    pub const MOTION: RequestDef = RequestDef(1 << 1);
    /// Real-time config.
    pub const CONFIG: RequestDef = RequestDef(1 << 2);
    /// Bits without a known block; a master sends 0.
    pub const RESERVED: RequestDef = RequestDef(!0b111);

    /// Bytes of a whole request, both definitions included. Reserved bits add nothing.
    pub const fn size(self) -> usize {
        let control = if self.contains(RequestDef::CONTROL) { field::CONTROL } else { 0 };
        let motion = if self.contains(RequestDef::MOTION) { field::MOTION } else { 0 };
        let config = if self.contains(RequestDef::CONFIG) { field::CONFIG } else { 0 };
        field::HEADER + control + motion + config
    }
}

/// The blocks of a response (LinUDP V2 manual, 4.4.2). The reserved bits 9 ... 31 are kept as they come.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct ResponseDef(pub u32);

impl ResponseDef {
    /// No block at all.
    pub const NONE: ResponseDef = ResponseDef(0);
    /// Status word.
    pub const STATUS: ResponseDef = ResponseDef(1 << 0);
    /// State variable.
    pub const STATE: ResponseDef = ResponseDef(1 << 1);
    /// Actual position.
    pub const ACTUAL: ResponseDef = ResponseDef(1 << 2);
    /// Demand position.
    pub const DEMAND: ResponseDef = ResponseDef(1 << 3);
    /// Current.
    pub const CURRENT: ResponseDef = ResponseDef(1 << 4);
    /// Warn word.
    pub const WARN: ResponseDef = ResponseDef(1 << 5);
    /// Error code.
    pub const ERROR: ResponseDef = ResponseDef(1 << 6);
    /// The four monitoring channels.
    pub const MONITOR: ResponseDef = ResponseDef(1 << 7);
    /// Real-time config. If it is set together with [`RequestDef::CONFIG`], the exception above does not matter.
    pub const CONFIG: ResponseDef = ResponseDef(1 << 8);
    /// Status, state and positions.
    pub const FRONT: ResponseDef = ResponseDef(0xF);
    /// Status, state, positions, current, warnings and error: everything that a cycle needs.
    pub const CYCLIC: ResponseDef = ResponseDef(0x7F);

    /// Bytes of a whole response to `request`, both definitions included, without padding.
    pub const fn size(self, request: RequestDef) -> usize {
        self.at(ResponseDef::CONFIG) + if request.contains(RequestDef::CONFIG) { field::CONFIG } else { 0 }
    }

    /// The offset of one of the blocks, after those of the lower bits.
    pub const fn at(self, block: ResponseDef) -> usize {
        field::HEADER + field::RESPONSE_SUM[(self.0 & (block.0 - 1) & 0xFF) as usize] as usize
    }
}

/// Why a datagram is not a telegram.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum ParseError {
    /// The definitions need more bytes than it has.
    #[error(
        "{have} bytes where the definitions need {need}: not a LinUDP V2 telegram, or cut off on its way"
    )]
    TooShort {
        /// The fewest bytes that would be enough.
        need: usize,
        /// The bytes that it has.
        have: usize,
    },
}
fieldbeat_core::debug_as_display!(ParseError);

/// The motion command block: a header word and 15 parameter words, raw. [`motion`](super::motion) has their
/// meaning.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MotionBlock {
    /// Master id (bits 15-8), sub id (7-4), command count (3-0).
    pub header: u16,
    /// The parameters, unused bytes 0.
    pub parameters: [u8; field::PARAMETERS],
}

impl MotionBlock {
    fn from_bytes(bytes: [u8; field::MOTION]) -> MotionBlock {
        let [low, high, parameters @ ..] = bytes;
        MotionBlock { header: u16::from_le_bytes([low, high]), parameters }
    }
}

/// Fills a slice from its front. Every length was checked before; excess bytes are left out.
pub(super) struct Fill<'a>(pub(super) &'a mut [u8]);

impl Fill<'_> {
    #[inline]
    pub(super) fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        if let Some((head, rest)) = std::mem::take(&mut self.0).split_first_chunk_mut() {
            *head = bytes;
            self.0 = rest;
        }
    }

    fn put_if<const N: usize>(&mut self, has: bool, bytes: [u8; N]) {
        if has {
            self.put(bytes);
        }
    }
}

/// Takes from the front of a slice; the bytes that it does not have are 0.
pub(super) struct Take<'a>(pub(super) &'a [u8]);

impl Take<'_> {
    pub(super) fn bytes<const N: usize>(&mut self) -> [u8; N] {
        let bytes = std::array::from_fn(|at| self.0.get(at).copied().unwrap_or(0));
        self.0 = self.0.get(N..).unwrap_or_default();
        bytes
    }

    pub(super) fn word(&mut self) -> u16 {
        u16::from_le_bytes(self.bytes())
    }

    pub(super) fn long(&mut self) -> u32 {
        u32::from_le_bytes(self.bytes())
    }
}

/// Both definitions, raw.
fn definitions(bytes: &[u8]) -> Result<(u32, u32), ParseError> {
    let Some([a, b, c, d, response @ ..]) = bytes.first_chunk::<{ field::HEADER }>() else {
        return Err(ParseError::TooShort { need: field::HEADER, have: bytes.len() });
    };
    Ok((u32::from_le_bytes([*a, *b, *c, *d]), u32::from_le_bytes(*response)))
}

#[cfg(test)]
mod tests;
