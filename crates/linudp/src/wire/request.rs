//! A request, master to drive.

use super::{
    ControlWord, Fill, MotionBlock, ParseError, RequestDef, ResponseDef, RtcBlock, Take, definitions, field,
};

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
            () if has(RequestDef::CONFIG) => request.size() - (field::CONFIG - 2),
            () if has(RequestDef::MOTION) => request.size() - (field::MOTION - 2),
            () => request.size(),
        };
        if bytes.len() < need {
            return Err(ParseError::TooShort { need, have: bytes.len() });
        }
        let mut blocks = Take(&bytes[field::HEADER..]);
        Ok(Request {
            reserved: RequestDef(request.0 & RequestDef::RESERVED.0),
            response_def: ResponseDef(response),
            control: has(RequestDef::CONTROL).then(|| ControlWord(blocks.word())),
            motion: has(RequestDef::MOTION).then(|| MotionBlock::from_bytes(blocks.bytes())),
            config: has(RequestDef::CONFIG).then(|| RtcBlock::from_bytes(blocks.bytes())),
        })
    }

    /// Bytes that [`emit`](Self::emit) writes, 8 ... `REQUEST_MAX`.
    pub const fn size(&self) -> usize {
        self.definition().size()
    }

    /// Writes the whole request in place and returns its size; 0, and nothing written, if `out` is too short.
    #[inline(always)]
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
