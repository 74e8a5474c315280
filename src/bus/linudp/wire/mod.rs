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

mod rtc;
mod words;

use std::fmt;

use thiserror::Error;

pub use rtc::{Refusal, RtcBlock, RtcCommand, RtcStatus};
pub use words::{ControlWord, ErrorCode, MainState, StateVar, StatusWord, WarnWord};

/// Offsets in the telegram and in its blocks. The blocks themselves have no fixed offset.
mod field {
    use std::ops::Range;

    pub const REQUEST_DEFINITION: Range<usize> = 0..4;
    pub const RESPONSE_DEFINITION: Range<usize> = 4..8;
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
        let mut definition = 0;
        while definition < 256 {
            let mut bit = 0;
            while bit < 8 {
                if definition >> bit & 1 == 1 {
                    sums[definition] += RESPONSE[bit];
                }
                bit += 1;
            }
            definition += 1;
        }
        sums
    };
}

/// The longest request that the definitions can describe, bytes.
pub const REQUEST_MAX: usize = field::HEADER + field::CONTROL + field::MOTION + field::CONFIG;
/// The longest response that the definitions can describe, bytes, without padding.
pub const RESPONSE_MAX: usize = field::HEADER + field::RESPONSE_SUM[0xFF] as usize + field::CONFIG;

/// What both definitions have, the set of the blocks of a telegram.
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
        self.config_at() + if self.contains(RequestDef::CONFIG) { field::CONFIG } else { 0 }
    }

    const fn motion_at(self) -> usize {
        field::HEADER + if self.contains(RequestDef::CONTROL) { field::CONTROL } else { 0 }
    }

    const fn config_at(self) -> usize {
        self.motion_at() + if self.contains(RequestDef::MOTION) { field::MOTION } else { 0 }
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
        self.config_at() + if request.contains(RequestDef::CONFIG) { field::CONFIG } else { 0 }
    }

    /// The offset of one of the blocks 0 ... 7, after those of the lower bits.
    const fn at(self, block: ResponseDef) -> usize {
        field::HEADER + field::RESPONSE_SUM[(self.0 & (block.0 - 1) & 0xFF) as usize] as usize
    }

    const fn config_at(self) -> usize {
        field::HEADER + field::RESPONSE_SUM[(self.0 & 0xFF) as usize] as usize
    }
}

/// Why a datagram is not a telegram.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum ParseError {
    /// Its definitions need more bytes than it has.
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
crate::errors::debug_as_display!(ParseError);

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
struct Fill<'a>(&'a mut [u8]);

impl Fill<'_> {
    #[inline]
    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
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

/// `N` bytes from `at` on.
#[inline]
fn chunk<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..)?.first_chunk().copied()
}

/// `N` bytes from `at` on, those that the datagram does not have as 0.
fn padded<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    let mut block = [0; N];
    let tail = bytes.get(at..).unwrap_or_default();
    block.iter_mut().zip(tail).for_each(|(byte, sent)| *byte = *sent);
    block
}

/// Both definitions, raw.
fn definitions(bytes: &[u8]) -> Result<(u32, u32), ParseError> {
    let Some(header) = bytes.first_chunk::<{ field::HEADER }>() else {
        return Err(ParseError::TooShort { need: field::HEADER, have: bytes.len() });
    };
    let mut words = [[0; 4]; 2];
    words[0].copy_from_slice(&header[field::REQUEST_DEFINITION]);
    words[1].copy_from_slice(&header[field::RESPONSE_DEFINITION]);
    Ok((u32::from_le_bytes(words[0]), u32::from_le_bytes(words[1])))
}

/// A response in a datagram, as the master sees it: long enough for its definitions. Bytes after its blocks are
/// padding, possibly left over from an earlier response, and are never read.
#[derive(Clone, Copy, Debug)]
pub struct ResponseView<'a> {
    bytes: &'a [u8],
    request: RequestDef,
    response: ResponseDef,
}

impl<'a> ResponseView<'a> {
    /// The datagram, padding included.
    #[inline]
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Checks the length of `bytes` against its own definitions.
    #[inline]
    pub fn new(bytes: &'a [u8]) -> Result<ResponseView<'a>, ParseError> {
        let (request, response) = definitions(bytes)?;
        let (request, response) = (RequestDef(request), ResponseDef(response));
        // Without the config block: a drive that leaves it out although it was requested is eight bytes short, not
        // wrong.
        let need = response.config_at();
        if bytes.len() < need {
            return Err(ParseError::TooShort { need, have: bytes.len() });
        }
        Ok(ResponseView { bytes, request, response })
    }

    /// The echo of the request definition.
    pub fn request_def(&self) -> RequestDef {
        self.request
    }

    /// The echo of the response definition.
    pub fn response_def(&self) -> ResponseDef {
        self.response
    }

    /// Its first four blocks, which each reply to a master has; one that is missing is 0.
    #[inline]
    pub fn front(&self) -> Front {
        match self.response.contains(ResponseDef::FRONT) {
            true => chunk(self.bytes, field::HEADER).map(Front::from_bytes).unwrap_or_default(),
            false => Front {
                status: self.status().unwrap_or_default(),
                state: self.state().unwrap_or_default(),
                actual: self.actual().unwrap_or_default(),
                demand: self.demand().unwrap_or_default(),
            },
        }
    }

    #[inline]
    fn block<const N: usize>(&self, block: ResponseDef) -> Option<[u8; N]> {
        if !self.response.contains(block) {
            return None;
        }
        chunk(self.bytes, self.response.at(block))
    }

    /// Status word.
    #[inline]
    pub fn status(&self) -> Option<StatusWord> {
        self.block(ResponseDef::STATUS).map(|bytes| StatusWord(u16::from_le_bytes(bytes)))
    }

    /// State variable.
    #[inline]
    pub fn state(&self) -> Option<StateVar> {
        self.block(ResponseDef::STATE).map(|bytes| StateVar(u16::from_le_bytes(bytes)))
    }

    /// Actual position, 0.1 um.
    #[inline]
    pub fn actual(&self) -> Option<i32> {
        self.block(ResponseDef::ACTUAL).map(i32::from_le_bytes)
    }

    /// Demand position, 0.1 um.
    #[inline]
    pub fn demand(&self) -> Option<i32> {
        self.block(ResponseDef::DEMAND).map(i32::from_le_bytes)
    }

    /// Set current, mA.
    #[inline]
    pub fn current(&self) -> Option<i16> {
        self.block(ResponseDef::CURRENT).map(i16::from_le_bytes)
    }

    /// Warn word.
    #[inline]
    pub fn warn(&self) -> Option<WarnWord> {
        self.block(ResponseDef::WARN).map(|bytes| WarnWord(u16::from_le_bytes(bytes)))
    }

    /// Error code.
    #[inline]
    pub fn error(&self) -> Option<ErrorCode> {
        self.block(ResponseDef::ERROR).map(|bytes| ErrorCode(u16::from_le_bytes(bytes)))
    }

    /// The monitoring channels 1 ... 4, raw: their sources are configured in the drive (UPIDs 20A8h-20ABh).
    #[inline]
    pub fn monitor(&self) -> Option<[u32; 4]> {
        self.block::<16>(ResponseDef::MONITOR).map(|bytes| {
            let mut channels = [0; 4];
            for (channel, word) in channels.iter_mut().zip(bytes.as_chunks::<4>().0) {
                *channel = u32::from_le_bytes(*word);
            }
            channels
        })
    }

    /// The answer on the real-time-config channel: present if the request carried a block, and if the datagram has
    /// it.
    #[inline]
    pub fn config(&self) -> Option<RtcBlock> {
        if !self.request.contains(RequestDef::CONFIG) {
            return None;
        }
        chunk(self.bytes, self.response.config_at()).map(RtcBlock::from_bytes)
    }
}

/// The first four blocks of a response.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Front {
    /// Status word.
    pub status: StatusWord,
    /// State variable.
    pub state: StateVar,
    /// Actual position, 0.1 um.
    pub actual: i32,
    /// Demand position, 0.1 um.
    pub demand: i32,
}

impl Front {
    #[inline]
    fn from_bytes(bytes: [u8; field::FRONT]) -> Front {
        let [a, b, c, d, actual @ .., w, x, y, z] = bytes;
        Front {
            status: StatusWord(u16::from_le_bytes([a, b])),
            state: StateVar(u16::from_le_bytes([c, d])),
            actual: i32::from_le_bytes(actual),
            demand: i32::from_le_bytes([w, x, y, z]),
        }
    }
}

/// A response as a plain value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Response {
    /// The echo of the request definition.
    pub request_def: RequestDef,
    /// The echo of the response definition.
    pub response_def: ResponseDef,
    /// Status word.
    pub status: Option<StatusWord>,
    /// State variable.
    pub state: Option<StateVar>,
    /// Actual position, 0.1 um.
    pub actual: Option<i32>,
    /// Demand position, 0.1 um.
    pub demand: Option<i32>,
    /// Set current, mA.
    pub current: Option<i16>,
    /// Warn word.
    pub warn: Option<WarnWord>,
    /// Error code.
    pub error: Option<ErrorCode>,
    /// Monitoring channels 1 ... 4, raw.
    pub monitor: Option<[u32; 4]>,
    /// Real-time config.
    pub config: Option<RtcBlock>,
}

impl Response {
    /// The blocks that the datagram's own definitions name.
    #[inline]
    pub fn parse(bytes: &[u8]) -> Result<Response, ParseError> {
        let view = ResponseView::new(bytes)?;
        Ok(Response {
            request_def: view.request,
            response_def: view.response,
            status: view.status(),
            state: view.state(),
            actual: view.actual(),
            demand: view.demand(),
            current: view.current(),
            warn: view.warn(),
            error: view.error(),
            monitor: view.monitor(),
            config: view.config(),
        })
    }

    /// Bytes that [`emit`](Self::emit) writes, 8 ... [`RESPONSE_MAX`].
    pub fn size(&self) -> usize {
        self.response_def.size(self.request_def)
    }

    /// Writes the blocks of the two definitions and returns their size; 0, and nothing written, if `out` is too
    /// short. A requested block that is missing is written as 0; one that is not requested is left out.
    pub fn emit(&self, out: &mut [u8]) -> usize {
        let size = self.size();
        let Some(out) = out.get_mut(..size) else { return 0 };
        let mut out = Fill(out);
        out.put(self.request_def.0.to_le_bytes());
        out.put(self.response_def.0.to_le_bytes());
        let has = |block| self.response_def.contains(block);
        out.put_if(has(ResponseDef::STATUS), self.status.unwrap_or_default().0.to_le_bytes());
        out.put_if(has(ResponseDef::STATE), self.state.unwrap_or_default().0.to_le_bytes());
        out.put_if(has(ResponseDef::ACTUAL), self.actual.unwrap_or_default().to_le_bytes());
        out.put_if(has(ResponseDef::DEMAND), self.demand.unwrap_or_default().to_le_bytes());
        out.put_if(has(ResponseDef::CURRENT), self.current.unwrap_or_default().to_le_bytes());
        out.put_if(has(ResponseDef::WARN), self.warn.unwrap_or_default().0.to_le_bytes());
        out.put_if(has(ResponseDef::ERROR), self.error.unwrap_or_default().0.to_le_bytes());
        for channel in self.monitor.unwrap_or_default() {
            out.put_if(has(ResponseDef::MONITOR), channel.to_le_bytes());
        }
        let config = self.request_def.contains(RequestDef::CONFIG);
        out.put_if(config, self.config.unwrap_or_default().to_bytes());
        size
    }
}

/// A request as a plain value. Its definition follows from the blocks it has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Request {
    /// Reserved bits of the request definition; a master sends none.
    pub reserved: RequestDef,
    /// The blocks that the drive shall answer with.
    pub response_def: ResponseDef,
    /// Control word.
    pub control: Option<ControlWord>,
    /// Motion command.
    pub motion: Option<MotionBlock>,
    /// Real-time config.
    pub config: Option<RtcBlock>,
}

impl Request {
    /// The request definition.
    #[inline]
    pub const fn definition(&self) -> RequestDef {
        let control = if self.control.is_some() { RequestDef::CONTROL } else { RequestDef::NONE };
        let motion = if self.motion.is_some() { RequestDef::MOTION } else { RequestDef::NONE };
        let config = if self.config.is_some() { RequestDef::CONFIG } else { RequestDef::NONE };
        RequestDef(self.reserved.0 & RequestDef::RESERVED.0).with(control).with(motion).with(config)
    }

    /// Reads a request, as leniently as a drive does: masters in the field rely on it. The last block may be cut short
    /// (a motion command down to its header, a config block down to its first word), the missing bytes are 0, and bytes
    /// after the last block are ignored.
    pub fn parse(bytes: &[u8]) -> Result<Request, ParseError> {
        let (request, response) = definitions(bytes)?;
        let request = RequestDef(request);
        let has = |block| request.contains(block);
        // Both kinds of block that may be cut short need their first word.
        let need = match () {
            () if has(RequestDef::CONFIG) => request.config_at() + 2,
            () if has(RequestDef::MOTION) => request.motion_at() + 2,
            () => request.size(),
        };
        if bytes.len() < need {
            return Err(ParseError::TooShort { need, have: bytes.len() });
        }
        let (control, motion) = (padded(bytes, field::HEADER), padded(bytes, request.motion_at()));
        Ok(Request {
            reserved: RequestDef(request.0 & RequestDef::RESERVED.0),
            response_def: ResponseDef(response),
            control: has(RequestDef::CONTROL).then(|| ControlWord(u16::from_le_bytes(control))),
            motion: has(RequestDef::MOTION).then(|| MotionBlock::from_bytes(motion)),
            config: has(RequestDef::CONFIG).then(|| RtcBlock::from_bytes(padded(bytes, request.config_at()))),
        })
    }

    /// Bytes that [`emit`](Self::emit) writes, 8 ... [`REQUEST_MAX`].
    pub const fn size(&self) -> usize {
        self.definition().size()
    }

    /// Writes the whole request in place and returns its size; 0, and nothing written, if `out` is too short.
    #[inline]
    pub fn emit(&self, out: &mut [u8]) -> usize {
        let definition = self.definition();
        let size = definition.size();
        let Some(out) = out.get_mut(..size) else { return 0 };
        let mut out = Fill(out);
        out.put(definition.0.to_le_bytes());
        out.put(self.response_def.0.to_le_bytes());
        if let Some(control) = self.control {
            out.put(control.0.to_le_bytes());
        }
        if let Some(motion) = &self.motion {
            out.put(motion.header.to_le_bytes());
            out.put(motion.parameters);
        }
        if let Some(config) = self.config {
            out.put(config.to_bytes());
        }
        size
    }
}

#[cfg(test)]
mod tests;
