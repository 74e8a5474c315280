//! Datagrams of a frame, and their commands.

use std::ops::Range;

use super::u16_at;

/// The Ethertype, big-endian behind the two addresses.
pub const ETHERTYPE: u16 = 0x88A4;
/// The first byte of the source: the first slave sets this bit of it.
pub const SOURCE: usize = 6;
/// See [`SOURCE`].
pub const PASSED: u8 = 0x02;
/// Bytes of a datagram before its data, and of the working counter behind them.
pub const HEADER: usize = 10;
/// See [`HEADER`].
pub const COUNTER: usize = 2;
/// The most datagrams in a frame.
pub const DATAGRAMS_MAX: usize = 15;

const TYPE: usize = 12;
const LENGTH: usize = 14;
const FIRST: usize = 16;
/// In length and type: eleven bits of length, bit 11 is 0, type 1 is datagrams.
const LENGTH_BITS: u16 = 0x07FF;
const DATAGRAMS: u16 = 0x1;
/// In the length of a datagram: more follow.
const MORE: u16 = 1 << 15;

/// The commands of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Command {
    Nop,
    Aprd,
    Apwr,
    Aprw,
    Fprd,
    Fpwr,
    Fprw,
    Brd,
    Bwr,
    Brw,
    Lrd,
    Lwr,
    Lrw,
    Armw,
    Frmw,
}

impl Command {
    /// All of them, by their numbers.
    pub const ALL: [Command; 15] = {
        use Command::*;
        [Nop, Aprd, Apwr, Aprw, Fprd, Fpwr, Fprw, Brd, Bwr, Brw, Lrd, Lwr, Lrw, Armw, Frmw]
    };

    /// The command with this number.
    pub fn of(number: u8) -> Option<Command> {
        Command::ALL.get(usize::from(number)).copied()
    }

    /// Each slave adds 1 to the first half of its address.
    pub fn counts_slaves(self) -> bool {
        use Command::*;
        matches!(self, Aprd | Apwr | Aprw | Armw | Brd | Bwr | Brw)
    }
}

/// The places of the datagrams in a frame, up to a broken one: header, data and working counter. `None`: the frame is
/// not EtherCAT, or its length is not its own.
pub fn datagrams(frame: &[u8]) -> Option<impl Iterator<Item = Range<usize>>> {
    if frame.get(TYPE..LENGTH)? != ETHERTYPE.to_be_bytes() || frame.len() < FIRST {
        return None;
    }
    let header = u16_at(frame, LENGTH);
    let all = frame.get(..FIRST + usize::from(header & LENGTH_BITS))?;
    let mut next = (header & !LENGTH_BITS == DATAGRAMS << 12).then_some(FIRST)?..all.len();
    Some(
        std::iter::from_fn(move || {
            let length = all.get(next.clone())?.get(6..8).map(|length| u16_at(length, 0))?;
            let end = next.start + HEADER + usize::from(length & LENGTH_BITS) + COUNTER;
            let place = (end <= all.len()).then_some(next.start..end)?;
            next = if length & MORE == 0 { all.len()..all.len() } else { end..all.len() };
            Some(place)
        })
        .take(DATAGRAMS_MAX),
    )
}
