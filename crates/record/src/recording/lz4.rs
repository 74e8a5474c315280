//! LZ4 frames, in which the chunks of a recording are compressed: those that any LZ4 reads, of independent
//! blocks. The checksum of a chunk stands before it; a frame has none.

use std::ops::Range;

use lz4_flex::block::{self, get_maximum_output_size};
use mcap::sans_io::decompressor::{DecompressResult, Decompressor};
use mcap::{McapError, McapResult};

/// The name in MCAP.
pub const NAME: &str = "lz4";

/// The magic number of a frame, independent blocks of 4 MiB at most, and the checksum of that.
const HEAD: [u8; 7] = [0x04, 0x22, 0x4D, 0x18, 0x60, 0x70, 0x73];
const MOST: usize = 4 << 20;

/// Bit of the length of a block that is not compressed, since that would not make it shorter.
const UNCOMPRESSED: u32 = 1 << 31;

/// Appends the frame of these bytes to `out`.
pub fn compress(bytes: &[u8], out: &mut Vec<u8>) {
    out.extend(HEAD);
    for plain in bytes.chunks(MOST) {
        let head = out.len();
        let begin = head + size_of::<u32>();
        out.resize(begin + get_maximum_output_size(plain.len()), 0);
        let length = match block::compress_into(plain, &mut out[begin..]) {
            Ok(length) if length < plain.len() => {
                out.truncate(begin + length);
                length as u32
            }
            _ => {
                out.truncate(begin);
                out.extend_from_slice(plain);
                plain.len() as u32 | UNCOMPRESSED
            }
        };
        out[head..begin].copy_from_slice(&length.to_le_bytes());
    }
    out.extend([0; size_of::<u32>()]);
}

/// The next part of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Head,
    Length,
    Block { is_plain: bool },
}

/// Reads the frames of [`compress`] for the library.
#[derive(Debug)]
pub struct Decoder {
    part: Part,
    /// The bytes so far, and how many it has.
    held: Vec<u8>,
    wanted: usize,
    /// Where the bytes of the newest block are, and which of them are not given yet.
    block: Vec<u8>,
    left: Range<usize>,
}

impl Default for Decoder {
    fn default() -> Decoder {
        Decoder { part: Part::Head, held: Vec::new(), wanted: HEAD.len(), block: Vec::new(), left: 0..0 }
    }
}

impl Decoder {
    fn want(&mut self, part: Part, wanted: usize) {
        (self.part, self.wanted) = (part, wanted);
    }

    /// A part is there.
    fn enter(&mut self) -> McapResult<()> {
        let wrong = |what: &str| McapError::DecompressionError(what.to_owned());
        match self.part {
            Part::Head if self.held == HEAD => self.want(Part::Length, size_of::<u32>()),
            Part::Head if self.held.starts_with(&HEAD[..4]) => {
                return Err(McapError::UnsupportedCompression("lz4 with other options".to_owned()));
            }
            Part::Head => return Err(wrong("no LZ4 frame")),
            Part::Length => {
                let length = self.held.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes));
                match (length & !UNCOMPRESSED) as usize {
                    0 => self.want(Part::Head, HEAD.len()),
                    bytes @ ..=MOST => self.want(Part::Block { is_plain: length & UNCOMPRESSED != 0 }, bytes),
                    _ => return Err(wrong("a block of its LZ4 is too long")),
                }
            }
            Part::Block { is_plain } => {
                if self.block.is_empty() {
                    self.block = vec![0; MOST];
                }
                let length = if is_plain {
                    self.block[..self.held.len()].copy_from_slice(&self.held);
                    self.held.len()
                } else {
                    let length = block::decompress_into(&self.held, &mut self.block);
                    length.map_err(|why| wrong(&why.to_string()))?
                };
                self.left = 0..length;
                self.want(Part::Length, size_of::<u32>());
            }
        }
        self.held.clear();
        Ok(())
    }
}

impl Decompressor for Decoder {
    fn next_read_size(&self) -> usize {
        self.wanted - self.held.len()
    }

    fn decompress(&mut self, from: &[u8], to: &mut [u8]) -> McapResult<DecompressResult> {
        let mut rest = from;
        while self.left.is_empty() && !rest.is_empty() {
            let (now, behind) = rest.split_at(rest.len().min(self.wanted - self.held.len()));
            self.held.extend_from_slice(now);
            rest = behind;
            if self.held.len() == self.wanted {
                self.enter()?;
            }
        }
        let left = &self.block[self.left.clone()];
        let wrote = left.len().min(to.len());
        to[..wrote].copy_from_slice(&left[..wrote]);
        self.left.start += wrote;
        Ok(DecompressResult { consumed: from.len() - rest.len(), wrote })
    }

    fn reset(&mut self) -> McapResult<()> {
        self.want(Part::Head, HEAD.len());
        self.held.clear();
        self.left = 0..0;
        Ok(())
    }

    fn name(&self) -> &'static str {
        NAME
    }
}
