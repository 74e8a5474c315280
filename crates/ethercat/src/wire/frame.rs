//! Frames and datagrams (ETG.1000.4, 5; as seen on real segments).
//!
//! | bytes | field | |
//! |---|---|---|
//! | 0-5, 6-11 | destination, source | the first slave sets bit 1 of the source's first byte |
//! | 12-13 | Ethertype | 88A4h, big-endian; everything after it is little-endian |
//! | 14-15 | length, type | bits 0-10 bytes of all datagrams, bits 12-15 = 1 |
//! | 16- | datagrams | ten bytes of header, data, working counter; then padding to 60 bytes |
//!
//! `read` has the received ones. The reply is the same frame: only data, positions, interrupts, working counters and
//! the source have changed.

mod read;

pub use self::read::{Datagram, Datagrams, FrameError, datagrams, first_datagram};

/// On the wire, big-endian.
pub const ETHERTYPE: u16 = 0x88A4;
/// Ethernet and EtherCAT header.
pub const HEADER: usize = 16;
/// The shortest frame without its check sequence. A builder pads up to it; a reader accepts shorter ones too, since
/// a virtual wire does not pad.
pub const FRAME_MIN: usize = 60;
/// The longest frame without its check sequence.
pub const FRAME_MAX: usize = 1514;
/// The most datagrams in one frame: as many as slaves of all makes accept.
pub const DATAGRAMS_MAX: usize = 15;
/// Bytes before the data of a datagram.
pub const DATAGRAM_HEADER: usize = 10;
/// Bytes of the working counter after the data.
pub const WORKING_COUNTER: usize = 2;
/// The most data of a single datagram.
pub const DATA_MAX: usize = FRAME_MAX - HEADER - DATAGRAM_HEADER - WORKING_COUNTER;

const ETHERTYPE_AT: usize = 12;
const LENGTH_AT: usize = 14;
const LENGTH_MASK: u16 = 0x07FF;
const TYPE_DATAGRAMS: u16 = 1 << 12;
/// The bit in the length of a datagram that circulated.
pub const CIRCULATED: u16 = 1 << 14;
const MORE: u16 = 1 << 15;

/// An Ethernet address.
pub type Mac = [u8; 6];

/// The customary destination: everybody.
pub const BROADCAST: Mac = [0xFF; 6];

/// The bit of a source address that the first slave sets in passing.
pub const PASSED: u8 = 1 << 1;

/// The source of a frame, as it was sent.
#[inline]
pub fn source(frame: &[u8]) -> Option<Mac> {
    let [first, rest @ ..] = *frame.get(6..)?.first_chunk::<6>()?;
    let [b, c, d, e, f] = rest;
    Some([first & !PASSED, b, c, d, e, f])
}

/// The command and the address of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Nothing.
    Nop,
    /// Reads of the slave at a position: 0 the first, counted down as it passes.
    Aprd(u16, u16),
    /// Writes to the slave at a position.
    Apwr(u16, u16),
    /// Reads of the slave at a position, then writes.
    Aprw(u16, u16),
    /// Reads of the slave with a station address.
    Fprd(u16, u16),
    /// Writes to the slave with a station address.
    Fpwr(u16, u16),
    /// Reads of the slave with a station address, then writes.
    Fprw(u16, u16),
    /// Reads of all slaves: the bits of all, or-ed.
    Brd(u16),
    /// Writes to all slaves.
    Bwr(u16),
    /// Reads of all slaves, then writes.
    Brw(u16),
    /// Reads of a logical address.
    Lrd(u32),
    /// Writes to a logical address.
    Lwr(u32),
    /// Writes the outputs of a logical address and reads its inputs.
    Lrw(u32),
    /// The slave at a position reads, all others write what it has.
    Armw(u16, u16),
    /// The slave with a station address reads, all others write what it has.
    Frmw(u16, u16),
}

impl Command {
    /// The number on the wire.
    pub const fn number(self) -> u8 {
        self.parts().0
    }

    /// The four bytes of address, as one number: for all but logical ones the station or position, and the register
    /// in the upper half.
    pub const fn address(self) -> u32 {
        self.parts().1
    }

    const fn parts(self) -> (u8, u32) {
        const fn at(first: u16, register: u16) -> u32 {
            first as u32 | (register as u32) << 16
        }
        match self {
            Command::Nop => (0, 0),
            Command::Aprd(first, register) => (1, at(first, register)),
            Command::Apwr(first, register) => (2, at(first, register)),
            Command::Aprw(first, register) => (3, at(first, register)),
            Command::Fprd(first, register) => (4, at(first, register)),
            Command::Fpwr(first, register) => (5, at(first, register)),
            Command::Fprw(first, register) => (6, at(first, register)),
            Command::Brd(register) => (7, at(0, register)),
            Command::Bwr(register) => (8, at(0, register)),
            Command::Brw(register) => (9, at(0, register)),
            Command::Lrd(address) => (10, address),
            Command::Lwr(address) => (11, address),
            Command::Lrw(address) => (12, address),
            Command::Armw(first, register) => (13, at(first, register)),
            Command::Frmw(first, register) => (14, at(first, register)),
        }
    }

    /// The command of this number; `None`: there is none.
    pub const fn new(number: u8, address: u32) -> Option<Command> {
        let (first, register) = (address as u16, (address >> 16) as u16);
        Some(match number {
            0 => Command::Nop,
            1 => Command::Aprd(first, register),
            2 => Command::Apwr(first, register),
            3 => Command::Aprw(first, register),
            4 => Command::Fprd(first, register),
            5 => Command::Fpwr(first, register),
            6 => Command::Fprw(first, register),
            7 => Command::Brd(register),
            8 => Command::Bwr(register),
            9 => Command::Brw(register),
            10 => Command::Lrd(address),
            11 => Command::Lwr(address),
            12 => Command::Lrw(address),
            13 => Command::Armw(first, register),
            14 => Command::Frmw(first, register),
            _ => return None,
        })
    }
}

/// The position of slave `index` of the segment in a command that counts positions: it arrives there as 0.
pub const fn position(index: u16) -> u16 {
    0_u16.wrapping_sub(index)
}

/// The offsets of a datagram in its frame. They are fixed: a frame is built once and sent again with other data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Place {
    /// The first byte.
    pub at: usize,
    /// Bytes of its data.
    pub length: usize,
}

impl Place {
    /// The range of its data.
    pub const fn data(self) -> std::ops::Range<usize> {
        self.at + DATAGRAM_HEADER..self.at + DATAGRAM_HEADER + self.length
    }

    /// One past its end.
    pub const fn end(self) -> usize {
        self.at + DATAGRAM_HEADER + self.length + WORKING_COUNTER
    }
}

/// Builds a frame in place.
#[derive(Debug)]
pub struct Builder<'a> {
    out: &'a mut [u8],
    end: usize,
    last: Option<usize>,
    count: usize,
}

impl<'a> Builder<'a> {
    /// A frame without datagrams; `None` if `out` is shorter than the shortest frame.
    pub fn new(out: &'a mut [u8], destination: Mac, source: Mac) -> Option<Builder<'a>> {
        let room = out.len().min(FRAME_MAX);
        let out = out.get_mut(..room).filter(|out| out.len() >= FRAME_MIN)?;
        out[HEADER..].fill(0);
        out[..6].copy_from_slice(&destination);
        out[6..12].copy_from_slice(&source);
        out[ETHERTYPE_AT..LENGTH_AT].copy_from_slice(&ETHERTYPE.to_be_bytes());
        Some(Builder { out, end: HEADER, last: None, count: 0 })
    }

    /// The number of bytes of data that would still fit in one more datagram; `None`: no datagram would.
    pub fn room(&self) -> Option<usize> {
        let left = self.out.len().checked_sub(self.end + DATAGRAM_HEADER + WORKING_COUNTER)?;
        (self.count < DATAGRAMS_MAX).then_some(left)
    }

    /// Appends a datagram whose data is zero; `None`, and nothing appended, if it does not fit.
    pub fn push(&mut self, command: Command, index: u8, length: usize) -> Option<Place> {
        self.room().filter(|room| length <= *room)?;
        let place = Place { at: self.end, length };
        // Bytes from before a resume, including the working counter.
        self.out[place.at..place.end()].fill(0);
        let header = &mut self.out[place.at..place.at + DATAGRAM_HEADER];
        (header[0], header[1]) = (command.number(), index);
        header[2..6].copy_from_slice(&command.address().to_le_bytes());
        header[6..8].copy_from_slice(&(length as u16).to_le_bytes());
        if let Some(last) = self.last.replace(place.at) {
            self.out[last + 7] |= (MORE >> 8) as u8;
        }
        (self.end, self.count) = (place.end(), self.count + 1);
        Some(place)
    }

    /// Appends a datagram with this data.
    pub fn push_with(&mut self, command: Command, index: u8, data: &[u8]) -> Option<Place> {
        let place = self.push(command, index, data.len())?;
        self.out[place.data()].copy_from_slice(data);
        Some(place)
    }

    /// Ends the frame; its length, padding included.
    pub fn finish(self) -> usize {
        let length = (self.end - HEADER) as u16 & LENGTH_MASK | TYPE_DATAGRAMS;
        self.out[LENGTH_AT..HEADER].copy_from_slice(&length.to_le_bytes());
        self.end.max(FRAME_MIN)
    }

    /// The present position: later datagrams may be removed back to here.
    pub const fn stem(&self) -> Stem {
        Stem { end: self.end, last: self.last, count: self.count }
    }

    /// Continues from a stem of the frame in `out`, and removes what follows it. `None` if it is not there.
    pub fn resume(out: &'a mut [u8], stem: Stem) -> Option<Builder<'a>> {
        let room = out.len().min(FRAME_MAX);
        let out = out.get_mut(..room).filter(|out| out.len() >= FRAME_MIN.max(stem.end))?;
        if let Some(last) = stem.last {
            out[last + 7] &= !((MORE >> 8) as u8);
        }
        let padding = stem.end..FRAME_MIN.max(stem.end);
        out[padding].fill(0);
        Some(Builder { out, end: stem.end, last: stem.last, count: stem.count })
    }
}

/// The constant part of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stem {
    end: usize,
    last: Option<usize>,
    count: usize,
}

/// Gives the datagram at `place` of a frame another command, or makes it do nothing for a while.
pub fn set_command(frame: &mut [u8], place: Place, command: Command) {
    if let Some(header) = frame.get_mut(place.at..place.at + DATAGRAM_HEADER) {
        header[0] = command.number();
        header[2..6].copy_from_slice(&command.address().to_le_bytes());
    }
}

/// Gives the datagram at `place` of a frame another index.
pub fn set_index(frame: &mut [u8], place: Place, index: u8) {
    if let Some(byte) = frame.get_mut(place.at + 1) {
        *byte = index;
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Of hexadecimal digits; all else is left out.
    pub(in crate::wire) fn bytes(hex: &str) -> Vec<u8> {
        let digits: Vec<u8> = hex.bytes().filter(u8::is_ascii_hexdigit).collect();
        let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
        digits.chunks(2).map(byte).collect()
    }

    /// One cycle for two drives, as sent and as returned.
    const SENT: &str = "FFFFFFFFFFFF 101010101010 88A4 4A10 \
        0E 42 0110 1009 0880 0000 0000000000000000 0000 \
        0C 43 00000100 1C80 0000 A0860100 0F00 6079FEFF 0700 00000000 0000 0000 00000000 0000 0000 0000 \
        07 44 0000 3001 0200 0000 0000 0000";
    const RETURNED: &str = "FFFFFFFFFFFF 121010101010 88A4 4A10 \
        0E 42 0110 1009 0880 0000 15BF613101000000 0200 \
        0C 43 00000100 1C80 0000 A0860100 0F00 6079FEFF 0700 40E20100 06FF 3706 FFFFFFFF 0000 3306 0600 \
        07 44 0200 3001 0200 0000 0800 0200";

    #[test]
    fn a_cycle_for_two_drives_is_built_byte_by_byte() {
        let mut out = [0xEE; FRAME_MAX];
        let mut frame = Builder::new(&mut out, BROADCAST, [0x10; 6]).unwrap();
        frame.push(Command::Frmw(0x1001, 0x0910), 0x42, 8).unwrap();
        let image = frame.push(Command::Lrw(0x0001_0000), 0x43, 28).unwrap();
        frame.push(Command::Brd(0x0130), 0x44, 2).unwrap();
        let length = frame.finish();
        out[image.data()][..12].copy_from_slice(&bytes("A0860100 0F00 6079FEFF 0700"));
        assert_eq!(out[..length], bytes(SENT));
    }

    #[test]
    fn a_reply_frame_is_parsed_byte_by_byte() {
        let frame = bytes(RETURNED);
        let read: Vec<_> = datagrams(&frame).unwrap().map(Result::unwrap).collect();
        let commands: Vec<_> = read.iter().map(|datagram| datagram.command().unwrap()).collect();
        assert_eq!(
            commands,
            [Command::Frmw(0x1001, 0x0910), Command::Lrw(0x0001_0000), Command::Brd(0x0130)]
        );
        assert_eq!(read.iter().map(|datagram| datagram.index).collect::<Vec<_>>(), [0x42, 0x43, 0x44]);
        assert_eq!(read.iter().map(|datagram| datagram.working_counter).collect::<Vec<_>>(), [2, 6, 2]);
        assert_eq!(read[0].data, 5_123_456_789_u64.to_le_bytes());
        assert_eq!(read[1].data[12..16], 123_456_i32.to_le_bytes());
        assert_eq!(read[2].address & 0xFFFF, 2, "each slave has counted it");
        assert!(read.iter().all(|datagram| !datagram.circulated));
    }

    #[test]
    fn a_short_frame_is_padded_and_the_padding_is_not_counted() {
        let mut out = [0xEE; 64];
        let mut frame = Builder::new(&mut out, BROADCAST, [0x01; 6]).unwrap();
        frame.push(Command::Brd(0), 4, 2).unwrap();
        assert_eq!(frame.finish(), FRAME_MIN);
        let sent = bytes("FFFFFFFFFFFF 010101010101 88A4 0E10 07 04 0000 0000 0200 0000 0000 0000");
        assert_eq!(out[..30], sent);
        assert!(out[30..60].iter().all(|byte| *byte == 0));
        // A virtual wire does not pad.
        for end in [30, 60] {
            let read: Vec<_> = datagrams(&out[..end]).unwrap().collect();
            assert!(matches!(read[..], [Ok(Datagram { number: 7, index: 4, data: [0, 0], .. })]));
        }
    }

    #[test]
    fn a_datagram_that_does_not_fit_is_not_begun() {
        let mut out = [0; 2_000];
        let mut frame = Builder::new(&mut out, BROADCAST, [0; 6]).unwrap();
        assert_eq!(frame.room(), Some(DATA_MAX));
        assert_eq!(frame.push(Command::Lrw(0), 0, DATA_MAX + 1), None);
        assert!(frame.push(Command::Lrw(0), 0, DATA_MAX).is_some());
        assert_eq!((frame.room(), frame.push(Command::Nop, 0, 0)), (None, None));
        assert_eq!(frame.finish(), FRAME_MAX);
        let mut frame = Builder::new(&mut out, BROADCAST, [0; 6]).unwrap();
        let pushed = (0..20).filter_map(|index| frame.push(Command::Brd(0), index, 1)).count();
        assert_eq!(pushed, DATAGRAMS_MAX);
        assert!(Builder::new(&mut [0; FRAME_MIN - 1], BROADCAST, [0; 6]).is_none());
    }

    #[test]
    fn a_broken_frame_is_reported_and_ends_there() {
        let whole = bytes(RETURNED);
        let changed = |at: usize, byte: u8| {
            let mut frame = whole.clone();
            frame[at] = byte;
            frame
        };
        assert_eq!(datagrams(&whole[..15]).unwrap_err(), FrameError::Broken);
        assert_eq!(datagrams(&changed(13, 0)).unwrap_err(), FrameError::Foreign);
        assert_eq!(datagrams(&changed(15, 0x40)).unwrap_err(), FrameError::Foreign);
        assert_eq!(datagrams(&whole[..89]).unwrap_err(), FrameError::Broken);
        // The second one is said to be longer than all the rest.
        let long = changed(36 + 6, 0xFF);
        let read: Vec<_> = datagrams(&long).unwrap().collect();
        assert_eq!(read.len(), 2);
        assert_eq!(read[1], Err(FrameError::Broken));
        // One more is said to follow the last.
        let more = changed(76 + 7, 0x80);
        let read: Vec<_> = datagrams(&more).unwrap().collect();
        assert_eq!(read.len(), 4);
        assert_eq!(read[3], Err(FrameError::Broken));
        let circulated = changed(76 + 7, 0x40);
        assert!(datagrams(&circulated).unwrap().last().unwrap().unwrap().circulated);
    }

    #[test]
    fn every_command_is_itself_again() {
        let mut known = 0;
        for number in 0..=u8::MAX {
            let Some(command) = Command::new(number, 0x0910_1001) else { continue };
            known += 1;
            assert_eq!(command.number(), number);
            assert_eq!(Command::new(number, command.address()), Some(command));
        }
        assert_eq!(known, 15);
        assert_eq!([0, 1, 2].map(position), [0, 0xFFFF, 0xFFFE]);
    }
}
