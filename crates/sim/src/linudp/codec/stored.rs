//! Curves and command table entries, as they are transferred and stored.

use super::Motion;

/// Bytes of the info block of a curve.
pub const INFO_SIZE: usize = 70;
/// Bytes of a setpoint.
pub const SETPOINT_SIZE: usize = 4;
/// Object type of a position over time.
const TIME: u16 = 0x0003;
/// Object type of a position over an encoder.
const CAM: u16 = 0x0103;

/// A curve: equidistant setpoints over its length.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Curve {
    pub id: u16,
    /// A position over time; else an encoder cam.
    pub is_time: bool,
    /// 10 us, or increments of a cam.
    pub length: u32,
    /// 0.1 um.
    pub setpoints: Vec<i32>,
}

impl Curve {
    /// The curve of an info block, whose padding is not read, and of its data; `None` if they are no curve.
    pub fn parse(info: &[u8], data: &[u8]) -> Option<Curve> {
        let word = |at: usize| Some(u16::from_le_bytes(*info.get(at..)?.first_chunk()?));
        let length = u32::from_le_bytes(*info.get(32..INFO_SIZE)?.first_chunk()?);
        let (setpoints, rest) = data.as_chunks::<SETPOINT_SIZE>();
        let kind = word(2)?;
        let is_valid = usize::from(word(0)?) == INFO_SIZE
            && (kind == TIME || kind == CAM)
            && usize::from(word(4)?) == setpoints.len()
            && setpoints.len() >= 2
            && rest.is_empty()
            && usize::from(word(6)?) == SETPOINT_SIZE;
        let setpoints = setpoints.iter().map(|bytes| i32::from_le_bytes(*bytes)).collect();
        is_valid.then_some(Curve { id: word(30)?, is_time: kind == TIME, length, setpoints })
    }

    /// The position after this share of its length, in 0.1 um: straight lines between the setpoints.
    pub fn position_at(&self, share: f64) -> f64 {
        let last = self.setpoints.len() - 1;
        let at = (share * last as f64).clamp(0.0, last as f64);
        let index = (at as usize).min(last - 1);
        let [from, to] = [index, index + 1].map(|index| f64::from(self.setpoints[index]));
        from + (to - from) * (at - index as f64)
    }
}

/// Bytes of a command table entry.
pub const ENTRY_SIZE: usize = 64;
/// The version of an entry.
const VERSION: u16 = 0xA701;
/// The link of an entry that has none.
const NO_LINK: u16 = 0xFFFF;

/// A command table entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry([u8; ENTRY_SIZE]);

impl Entry {
    /// `None`: another version.
    pub fn parse(bytes: [u8; ENTRY_SIZE]) -> Option<Entry> {
        (Entry(bytes).word(0) == VERSION).then_some(Entry(bytes))
    }

    /// The entry that follows it.
    pub fn link(&self) -> Option<u16> {
        Some(self.word(2)).filter(|link| *link != NO_LINK)
    }

    /// The motion command; its count has no meaning.
    pub fn command(&self) -> Motion {
        let mut parameters = [0; 30];
        parameters.copy_from_slice(&self.0[6..36]);
        Motion { header: self.word(4), parameters }
    }

    fn word(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.0[at], self.0[at + 1]])
    }
}
