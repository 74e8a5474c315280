//! A response, drive to master: as a plain value, and as the master reads it in a datagram.

use super::{
    ErrorCode, Fill, ParseError, RequestDef, ResponseDef, RtcBlock, StateVar, StatusWord, WarnWord,
    definitions, field,
};

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
        let need = response.at(ResponseDef::CONFIG);
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

    /// The first four blocks, which each reply to a master has; all of them 0 where one is missing.
    #[inline]
    pub fn front(&self) -> Front {
        let blocks = chunk(self.bytes, field::HEADER).filter(|_| self.response.contains(ResponseDef::FRONT));
        blocks.map(Front::from_bytes).unwrap_or_default()
    }

    #[inline]
    fn block<const N: usize>(&self, block: ResponseDef) -> Option<[u8; N]> {
        self.response.contains(block).then(|| chunk(self.bytes, self.response.at(block)))?
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
        let bytes = self.block::<16>(ResponseDef::MONITOR)?;
        let (channels, _) = bytes.as_chunks();
        Some(std::array::from_fn(|channel| u32::from_le_bytes(channels[channel])))
    }

    /// The answer on the real-time-config channel: present if the request carried a block, and if the datagram has
    /// it.
    #[inline]
    pub fn config(&self) -> Option<RtcBlock> {
        let block = || chunk(self.bytes, self.response.at(ResponseDef::CONFIG));
        self.request.contains(RequestDef::CONFIG).then(block)?.map(RtcBlock::from_bytes)
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
        let position = |block| view.block(block).map(i32::from_le_bytes);
        Ok(Response {
            request_def: view.request,
            response_def: view.response,
            status: view.status(),
            state: view.state(),
            actual: position(ResponseDef::ACTUAL),
            demand: position(ResponseDef::DEMAND),
            current: view.current(),
            warn: view.warn(),
            error: view.error(),
            monitor: view.monitor(),
            config: view.config(),
        })
    }

    /// Bytes that [`emit`](Self::emit) writes, 8 ... `RESPONSE_MAX`.
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

/// `N` bytes from `at` on.
#[inline]
fn chunk<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..at + N)?.first_chunk().copied()
}
