//! Telegrams of the link layer: the next one in the bytes that have arrived, and those that are sent (sheet, 5).
//!
//! | telegram | bytes |
//! |---|---|
//! | SD1, no data | `10 DA SA FC FCS 16` |
//! | SD2 | `68 LE LE 68 DA SA FC DU.. FCS 16` |
//! | SD3, eight bytes of data | `A2 DA SA FC DU FCS 16` |
//! | SD4, token | `DC DA SA` |
//! | SC, acknowledge | `E5` |
//!
//! SD2 is sent whatever the length of the data. An SD3 that arrives is the same as the SD2.

use super::Writer;
use super::fc::FunctionCode;

const SD1: u8 = 0x10;
/// The begin of a telegram with data, and its fourth byte.
pub const SD2: u8 = 0x68;
const SD3: u8 = 0xA2;
const SD4: u8 = 0xDC;
/// The acknowledge without data.
pub const SC: u8 = 0xE5;
/// The last byte of SD1, SD2 and SD3.
pub const ED: u8 = 0x16;
/// Bit 7 of an address: the data unit begins with a service access point, DSAP before SSAP.
const EXTENSION: u8 = 0x80;
/// DA, SA, FC.
const HEAD: usize = 3;
/// The values of LE of an SD2.
const LE: std::ops::RangeInclusive<usize> = 4..=249;

/// The most bytes of a telegram.
pub const MAX: usize = 255;
/// The most bytes of a data unit, service access points included.
pub const DU_MAX: usize = MAX - 9;
/// The address of all stations.
pub const BROADCAST: u8 = 127;
/// The highest address of a station.
pub const STATION_MAX: u8 = 126;

/// Room for any telegram.
pub type Buffer = [u8; MAX];

/// From whom to whom, at which service, what for. A reply has all of it in reverse.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Head {
    /// The destination, 0 ... 127.
    pub da: u8,
    /// The source, 0 ... 126.
    pub sa: u8,
    /// The service access point at the destination.
    pub dsap: Option<u8>,
    /// The service access point at the source.
    pub ssap: Option<u8>,
    /// The function of the request or reply.
    pub fc: FunctionCode,
}

impl Head {
    /// Writes the telegram and returns its size; `None` if the data are too long.
    #[inline]
    pub fn emit(&self, data: &[u8], out: &mut Buffer) -> Option<usize> {
        self.emit_with(out, |du| du.bytes(data))
    }

    /// The same, with the data that `fill` writes.
    #[inline]
    pub fn emit_with(&self, out: &mut Buffer, fill: impl FnOnce(&mut Writer<'_>)) -> Option<usize> {
        let extension = |sap: Option<u8>| if sap.is_some() { EXTENSION } else { 0 };
        let da = self.da & !EXTENSION | extension(self.dsap);
        let sa = self.sa & !EXTENSION | extension(self.ssap);
        let fc = self.fc.0;
        let (before_end, _) = out.split_last_chunk_mut::<2>()?;
        let mut writer = Writer::new(before_end);
        writer.bytes(&[SD2, 0, 0, SD2, da, sa, fc]);
        for sap in [self.dsap, self.ssap].into_iter().flatten() {
            writer.bytes(&[sap]);
        }
        fill(&mut writer);
        let end = writer.finish()?;
        let body = end - 4;
        if body == HEAD {
            let short = [SD1, da, sa, fc, sum(&[da, sa, fc]), ED];
            out.first_chunk_mut::<6>()?.copy_from_slice(&short);
            return Some(short.len());
        }
        let le = u8::try_from(body).ok()?;
        let check = sum(out.get(4..end)?);
        out[1..3].fill(le);
        out.get_mut(end..end + 2)?.copy_from_slice(&[check, ED]);
        Some(end + 2)
    }
}

/// The sum of bytes modulo 256.
#[inline]
pub fn sum(bytes: &[u8]) -> u8 {
    let (eights, rest) = bytes.as_chunks::<8>();
    let Some(last) = bytes.last_chunk::<8>() else {
        return rest.iter().fold(0, |sum, byte| sum.wrapping_add(*byte));
    };
    // Eight bytes at once, in four sums of 16 bits, which a telegram does not fill. Those of the rest come last.
    let pairs = |eight: u64| (eight & 0x00FF_00FF_00FF_00FF) + (eight >> 8 & 0x00FF_00FF_00FF_00FF);
    let rest = u64::from_le_bytes(*last).checked_shr(64 - 8 * rest.len() as u32).unwrap_or(0);
    let sums =
        eights.iter().fold(pairs(rest), |sums, eight| sums.wrapping_add(pairs(u64::from_le_bytes(*eight))));
    (sums.wrapping_mul(0x0001_0001_0001_0001) >> 48) as u8
}

/// A token.
pub const fn token(da: u8, sa: u8) -> [u8; 3] {
    [SD4, da & !EXTENSION, sa & !EXTENSION]
}

/// A telegram that has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Telegram<'a> {
    /// SC: done, without data. It does not say by whom.
    Acknowledge,
    /// SD4: the token is passed.
    Token {
        /// The next master that has it.
        da: u8,
        /// The master that had it.
        sa: u8,
    },
    /// SD1, SD2 or SD3.
    Data(Frame<'a>),
}

/// A telegram with a head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// From whom to whom.
    pub head: Head,
    /// The data, without service access points.
    pub data: &'a [u8],
}

impl<'a> Frame<'a> {
    /// DA to the last byte of the data.
    #[inline]
    fn parse(body: &'a [u8]) -> Option<Frame<'a>> {
        let (&[da, sa, fc], mut data) = body.split_first_chunk()?;
        let mut sap = |address: u8| {
            if address & EXTENSION == 0 {
                return Some(None);
            }
            let (sap, rest) = data.split_first()?;
            data = rest;
            Some(Some(*sap))
        };
        let (dsap, ssap) = (sap(da)?, sap(sa)?);
        let head = Head { da: da & !EXTENSION, sa: sa & !EXTENSION, dsap, ssap, fc: FunctionCode(fc) };
        Some(Frame { head, data })
    }
}

/// The telegram at the front of the bytes that have arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next<'a> {
    /// Nothing yet, or the front of a telegram.
    Incomplete {
        /// How many bytes are missing, at least.
        at_least: usize,
    },
    /// A telegram.
    Telegram {
        /// It.
        telegram: Telegram<'a>,
        /// The bytes.
        size: usize,
    },
    /// No telegram.
    Malformed {
        /// Why.
        why: Malformed,
        /// How many bytes to drop.
        ///
        /// The following bytes may be the rest of the same broken telegram, and look like another one: a byte E5 in it
        /// like an acknowledge. Nothing counts until the wire was idle.
        drop: usize,
    },
}

impl<'a> Next<'a> {
    /// Looks at the front of `bytes`. What is found does not depend on how many bytes follow.
    #[inline]
    pub fn parse(bytes: &'a [u8]) -> Next<'a> {
        let Some(start) = bytes.first() else { return Next::Incomplete { at_least: 1 } };
        let size = match *start {
            SC => return Next::Telegram { telegram: Telegram::Acknowledge, size: 1 },
            SD4 => 3,
            SD1 => HEAD + 3,
            SD2 => match bytes.first_chunk() {
                // The shortest SD2 has one byte of data.
                None => return Next::Incomplete { at_least: LE.start() + 6 - bytes.len() },
                Some(&[_, le, again, SD2]) if le == again && LE.contains(&le.into()) => usize::from(le) + 6,
                Some(_) => return Next::Malformed { why: Malformed::Length, drop: 1 },
            },
            SD3 => HEAD + 8 + 3,
            _ => {
                let is_start = |byte: &u8| matches!(*byte, SC | SD1 | SD2 | SD3 | SD4);
                let drop = bytes.iter().position(is_start).unwrap_or(bytes.len());
                return Next::Malformed { why: Malformed::Start, drop };
            }
        };
        let Some(telegram) = bytes.get(..size) else {
            return Next::Incomplete { at_least: size - bytes.len() };
        };
        match whole(telegram) {
            Ok(telegram) => Next::Telegram { telegram, size },
            Err(why) => Next::Malformed { why, drop: size },
        }
    }
}

/// A telegram of a known size.
#[inline]
fn whole(telegram: &[u8]) -> Result<Telegram<'_>, Malformed> {
    let (body, check, end) = match *telegram {
        [SD4, da, sa] if (da | sa) & EXTENSION == 0 => return Ok(Telegram::Token { da, sa }),
        [SD4, ..] => return Err(Malformed::Length),
        [SD2, _, _, _, ref body @ .., check, end] | [_, ref body @ .., check, end] => (body, check, end),
        _ => return Err(Malformed::Length),
    };
    if check != sum(body) {
        return Err(Malformed::Check);
    }
    if end != ED {
        return Err(Malformed::End);
    }
    Frame::parse(body).map(Telegram::Data).ok_or(Malformed::Length)
}

/// Why bytes are no telegram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Malformed {
    /// No telegram begins with the byte: noise, another rate, or the rest of a broken telegram.
    Start,
    /// The lengths contradict each other or what is between them, or no telegram has them; or an address announces a
    /// service access point that the telegram has no room for.
    Length,
    /// The check byte is not the sum.
    Check,
    /// The last byte is not 16.
    End,
}
/// The station that a telegram is for; `None`: for none, or for all.
pub fn destination(telegram: &[u8]) -> Option<u8> {
    let address = match *telegram {
        [SD1 | SD3 | SD4, address, ..] | [SD2, _, _, SD2, address, ..] => address & !EXTENSION,
        _ => return None,
    };
    (address <= STATION_MAX).then_some(address)
}
