//! The datagrams of a received frame.

use super::{
    CIRCULATED, Command, DATAGRAM_HEADER, ETHERTYPE, ETHERTYPE_AT, HEADER, LENGTH_MASK, MORE, Place,
    TYPE_DATAGRAMS,
};

/// Ethertype and type in the four bytes that they share with the length, and their bits there.
const KIND: u32 = (TYPE_DATAGRAMS as u32) << 16 | ETHERTYPE.swap_bytes() as u32;
const KIND_MASK: u32 = 0xF000_FFFF;

/// Why bytes are not a valid frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameError {
    /// The Ethertype or its type is another one.
    Foreign,
    /// It is too short, or a datagram does not end within it.
    Broken,
}

/// A datagram as it was received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Datagram<'a> {
    /// Where it stands.
    pub place: Place,
    /// The number on the wire; an unknown command is forwarded like `NOP`.
    pub number: u8,
    /// The four bytes of address.
    pub address: u32,
    /// As it was sent.
    pub index: u8,
    /// It circulated without passing the master: its content is old.
    pub circulated: bool,
    /// Event bits of all slaves, or-ed.
    pub interrupts: u16,
    /// The data that were read, or written.
    pub data: &'a [u8],
    /// How often it was carried out.
    pub working_counter: u16,
}

impl<'a> Datagram<'a> {
    /// The datagram at byte `at` of a frame, and whether another one follows.
    fn parse(frame: &'a [u8], at: usize, end: usize) -> Result<(Datagram<'a>, bool), FrameError> {
        let header =
            frame.get(at..end).and_then(<[u8]>::first_chunk::<DATAGRAM_HEADER>).ok_or(FrameError::Broken)?;
        let [number, index, a, b, c, d, low, high, event_low, event_high] = *header;
        let flags = u16::from_le_bytes([low, high]);
        let place = Place { at, length: usize::from(flags & LENGTH_MASK) };
        if place.end() > end {
            return Err(FrameError::Broken);
        }
        let counter = place.data().end;
        let datagram = Datagram {
            place,
            number,
            address: u32::from_le_bytes([a, b, c, d]),
            index,
            circulated: flags & CIRCULATED != 0,
            interrupts: u16::from_le_bytes([event_low, event_high]),
            data: &frame[place.data()],
            working_counter: u16::from_le_bytes([frame[counter], frame[counter + 1]]),
        };
        Ok((datagram, flags & MORE != 0))
    }

    /// The command; `None`: an unknown one.
    pub fn command(&self) -> Option<Command> {
        Command::new(self.number, self.address)
    }
}

/// The datagrams of a received frame. Each is read on request; the first error ends them.
#[derive(Clone, Debug)]
pub struct Datagrams<'a> {
    frame: &'a [u8],
    next: Option<usize>,
    end: usize,
}

/// Reads a frame; the error names a frame that is not EtherCAT.
pub fn datagrams(frame: &[u8]) -> Result<Datagrams<'_>, FrameError> {
    let header = frame.first_chunk::<HEADER>().ok_or(FrameError::Broken)?;
    let ethertype = u16::from_be_bytes([header[12], header[13]]);
    let length = u16::from_le_bytes([header[14], header[15]]);
    if ethertype != ETHERTYPE || length & !LENGTH_MASK & !(1 << 11) != TYPE_DATAGRAMS {
        return Err(FrameError::Foreign);
    }
    let says = usize::from(length & LENGTH_MASK);
    if says > frame.len() - HEADER {
        return Err(FrameError::Broken);
    }
    Ok(Datagrams { frame, next: (says > 0).then_some(HEADER), end: HEADER + says })
}

/// The number and the data of the first datagram of a received frame, if that has `N` bytes: identifies the sender
/// before all of the frame is read.
#[inline]
pub fn first_datagram<const N: usize>(frame: &[u8]) -> Option<(u8, &[u8; N])> {
    let header = frame.first_chunk::<{ HEADER + DATAGRAM_HEADER }>()?;
    let data = frame.get(HEADER + DATAGRAM_HEADER..)?.first_chunk::<N>()?;
    // Each of them whole: to check them byte by byte costs more.
    let kind = u32::from_le_bytes(*header[ETHERTYPE_AT..].first_chunk()?);
    let first = u64::from_le_bytes(*header[HEADER..].first_chunk()?);
    let length = |word: u64| word as usize & usize::from(LENGTH_MASK);
    let is_one = kind & KIND_MASK == KIND
        && length(u64::from(kind >> 16)) <= frame.len() - HEADER
        && length(first >> 48) == N;
    is_one.then_some((first as u8, data))
}

impl<'a> Iterator for Datagrams<'a> {
    type Item = Result<Datagram<'a>, FrameError>;

    fn next(&mut self) -> Option<Self::Item> {
        let at = self.next.take()?;
        match Datagram::parse(self.frame, at, self.end) {
            Ok((datagram, more)) => {
                self.next = more.then(|| datagram.place.end());
                Some(Ok(datagram))
            }
            Err(error) => Some(Err(error)),
        }
    }
}
