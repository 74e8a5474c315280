//! A capture as a file: pcapng (draft-ietf-opsawg-pcapng), little-endian, times in ns.

use std::io::{self, Write};

use super::Direction;

/// Kinds of blocks.
pub(super) mod block {
    /// A section begins.
    pub const SECTION: u32 = 0x0A0D_0D0A;
    /// An interface.
    pub const INTERFACE: u32 = 1;
    /// A packet without a time.
    pub const SIMPLE: u32 = 3;
    /// A packet.
    pub const PACKET: u32 = 6;
}

/// Options of blocks.
pub(super) mod option {
    /// Of any block: none follows.
    pub const END: u16 = 0;
    /// Of any block: a comment.
    pub const COMMENT: u16 = 1;
    /// Of a section: the program that wrote it.
    pub const PROGRAM: u16 = 4;
    /// Of an interface: its name ...
    pub const NAME: u16 = 2;
    /// ... what it is ...
    pub const DESCRIPTION: u16 = 3;
    /// ... the unit of its times ...
    pub const RESOLUTION: u16 = 9;
    /// ... and so many seconds that are added to them.
    pub const OFFSET: u16 = 14;
    /// Of a packet: its direction in the lowest two bits.
    pub const FLAGS: u16 = 2;
}

/// The number that shows the order of the bytes of a section.
pub(super) const ORDER: u32 = 0x1A2B_3C4D;
/// Times in 10^-9 s.
const NANOSECONDS: u8 = 9;

/// Writes a capture.
#[derive(Debug)]
pub struct Writer<W> {
    out: W,
    block: Vec<u8>,
    packets: u64,
}

impl<W: Write> Writer<W> {
    /// Begins the only section, by this program.
    pub fn new(out: W, program: &str, comment: &str) -> io::Result<Writer<W>> {
        let mut writer = Writer { out, block: Vec::new(), packets: 0 };
        writer.block(block::SECTION, |body| {
            body.extend(ORDER.to_le_bytes());
            // Version 1.0, of unknown length.
            body.extend([1, 0, 0, 0]);
            body.extend([0xFF; 8]);
            put(body, option::PROGRAM, program.as_bytes());
            put(body, option::COMMENT, comment.as_bytes());
            put(body, option::END, &[]);
        })?;
        Ok(writer)
    }

    /// One more interface; they count from 0.
    pub fn interface(
        &mut self,
        link_type: u16,
        name: &str,
        description: &str,
        comment: &str,
    ) -> io::Result<()> {
        self.block(block::INTERFACE, |body| {
            body.extend(link_type.to_le_bytes());
            // Nothing is cut off.
            body.extend([0; 6]);
            put(body, option::NAME, name.as_bytes());
            put(body, option::DESCRIPTION, description.as_bytes());
            put(body, option::COMMENT, comment.as_bytes());
            put(body, option::RESOLUTION, &[NANOSECONDS]);
            put(body, option::END, &[]);
        })
    }

    /// A packet of an interface, ns of UTC.
    pub fn packet(
        &mut self,
        interface: u32,
        utc_ns: u64,
        direction: Direction,
        bytes: &[u8],
    ) -> io::Result<()> {
        self.packets += 1;
        self.block(block::PACKET, |body| {
            body.extend(interface.to_le_bytes());
            body.extend(((utc_ns >> 32) as u32).to_le_bytes());
            body.extend((utc_ns as u32).to_le_bytes());
            // Of so many bytes so many are here.
            body.extend((bytes.len() as u32).to_le_bytes());
            body.extend((bytes.len() as u32).to_le_bytes());
            padded(body, bytes);
            put(body, option::FLAGS, &(direction as u32).to_le_bytes());
            put(body, option::END, &[]);
        })
    }

    /// How many packets were written, and where to.
    pub fn finish(mut self) -> io::Result<(u64, W)> {
        self.out.flush()?;
        Ok((self.packets, self.out))
    }

    fn block(&mut self, kind: u32, body: impl FnOnce(&mut Vec<u8>)) -> io::Result<()> {
        self.block.clear();
        self.block.extend(kind.to_le_bytes());
        self.block.extend([0; 4]);
        body(&mut self.block);
        let length = (self.block.len() as u32 + 4).to_le_bytes();
        self.block[4..8].copy_from_slice(&length);
        self.block.extend(length);
        self.out.write_all(&self.block)
    }
}

fn put(body: &mut Vec<u8>, option: u16, value: &[u8]) {
    // What is longer has no place; names and comments of ours are not.
    let value = value.get(..usize::from(u16::MAX)).unwrap_or(value);
    body.extend(option.to_le_bytes());
    body.extend((value.len() as u16).to_le_bytes());
    padded(body, value);
}

fn padded(body: &mut Vec<u8>, bytes: &[u8]) {
    body.extend(bytes);
    body.resize(body.len().next_multiple_of(4), 0);
}
