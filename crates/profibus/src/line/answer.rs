//! What has arrived, and whether it answers a request.

use super::Job;
use crate::other::Sign;
use crate::wire::telegram::{self, Frame, Head, Malformed, Telegram};

/// Bit 6 of a function code: a request.
const REQUEST: u8 = 1 << 6;
/// Bits 5 and 4 of the function code of an answer: the kind of station; 0 is a slave.
const STATION: u8 = 0x30;
/// Functions of answers: none (OK), refused (UE, RR, RS), data (DL, DH), taken without data (NR).
const OK: u8 = 0;
const REFUSED: std::ops::RangeInclusive<u8> = 1..=3;
const DATA_LOW: u8 = 0x8;
const DATA_HIGH: u8 = 0xA;
const NO_DATA: u8 = 0x9;
/// Bytes of a telegram before its data.
pub(super) const HEAD: usize = 7;
/// The difference of the heads of both priorities, behind a byte.
const PRIORITY: u64 = ((DATA_LOW ^ DATA_HIGH) as u64) << (8 * HEAD);

/// Bytes of an answer around its data, and of one with a usual diagnosis.
pub(super) const ANSWER: u8 = 9;
const DIAGNOSIS: u8 = 64;

/// A request, as far as its answer is recognised by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected {
    /// The usual answer before its data, of low priority, as a number; 0: there is none.
    usual: u64,
    /// The station.
    pub da: u8,
    /// The service access point, and ours.
    pub(super) saps: Option<(u8, u8)>,
    /// The bare acknowledgement answers it.
    acknowledge: bool,
    /// The data are so many bytes; `None`: any number.
    data: Option<u8>,
    /// The number of bytes of the longest likely one.
    pub(super) longest: u8,
}

/// A telegram that has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Incoming<'a> {
    /// The answer to the request that was under way, which ends with it.
    Answer(Job, Answer<'a>),
    /// Something that answers nothing.
    Other(Other),
}

/// An answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer<'a> {
    /// The bare acknowledgement, or OK or NR without data: the request was taken.
    Acknowledged,
    /// Data.
    Data {
        /// Of high priority.
        high: bool,
        /// The data.
        data: &'a [u8],
    },
    /// Refused, with this function (UE, RR, RS).
    Refused(u8),
}

/// A telegram that answers nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Other {
    /// A telegram: of this station, if it says one.
    Unrelated(Unrelated, Option<u8>),
    /// No telegram, while an answer was expected or not.
    Malformed { why: Malformed, expected: bool },
    /// A telegram of the master at this address.
    Master { address: u8, sign: Sign },
    /// An own telegram, which the adapter returns.
    Own,
}

/// Why a telegram answers nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Unrelated {
    /// To another station.
    Station,
    /// From a station that was not requested.
    Turn,
    /// Of another service, or of a kind that does not answer it.
    Kind,
    /// Nothing is under way.
    Late,
}

impl Expected {
    /// The request without a service access point of the master at `own` to the station at `da`, which answers with so
    /// many bytes of data.
    pub fn exchange(da: u8, own: u8, data: u8) -> Expected {
        let le = data.wrapping_add(3);
        let head = [telegram::SD2, le, le, telegram::SD2, own, da, DATA_LOW, 0];
        let usual = if data > 0 { u64::from_le_bytes(head) } else { 0 };
        let longest = data.saturating_add(ANSWER);
        Expected { usual, data: Some(data), longest, ..Expected::service(da, None, false) }
    }

    /// That of a service at these access points; `acknowledge`: the bare acknowledgement answers it.
    pub fn service(da: u8, saps: Option<(u8, u8)>, acknowledge: bool) -> Expected {
        // An acyclic answer may have any length, a diagnosis is short.
        let longest = if acknowledge { u8::MAX } else { DIAGNOSIS };
        Expected { usual: 0, da, saps, acknowledge, data: None, longest }
    }

    /// The bytes are the usual answer to Data_Exchange, and no more: whether it is of high priority. Anything else is
    /// parsed.
    #[inline]
    pub(super) fn is_usual(&self, bytes: &[u8]) -> Option<bool> {
        // Without the byte behind the head.
        let differs = (u64::from_le_bytes(*bytes.first_chunk()?) ^ self.usual) << 8;
        let [_, le, ..] = self.usual.to_le_bytes();
        let (covered, end) = bytes.get(HEAD - 3..)?.split_last_chunk::<2>()?;
        let is_usual = bytes.len() == usize::from(le) + 6
            && differs & !PRIORITY == 0
            && *end == [telegram::sum(covered), telegram::ED];
        is_usual.then_some(differs != 0)
    }

    /// Whether a telegram answers it, and how.
    pub(super) fn judge<'a>(&self, telegram: Telegram<'a>, own: u8) -> Result<Answer<'a>, Other> {
        let unrelated = |why, from| Err(Other::Unrelated(why, from));
        match telegram {
            Telegram::Acknowledge if self.acknowledge => Ok(Answer::Acknowledged),
            Telegram::Acknowledge => unrelated(Unrelated::Kind, None),
            // With the own address: from an adapter that returns it, or of a master with the same address.
            Telegram::Token { da, sa } => {
                let sign = if da == sa { Sign::Token } else { Sign::Passed };
                Err(Other::Master { address: sa, sign })
            }
            Telegram::Data(Frame { head, .. }) if head.fc.0 & REQUEST != 0 => {
                Err(Other::Master { address: head.sa, sign: Sign::Request })
            }
            Telegram::Data(Frame { head, .. }) if head.da != own => {
                unrelated(Unrelated::Station, Some(head.sa))
            }
            Telegram::Data(Frame { head, .. }) if head.sa != self.da => {
                unrelated(Unrelated::Turn, Some(head.sa))
            }
            Telegram::Data(Frame { head, .. }) if head.fc.0 & STATION != 0 => {
                Err(Other::Master { address: head.sa, sign: Sign::Answer })
            }
            Telegram::Data(frame) => {
                self.answer(&frame).ok_or(Other::Unrelated(Unrelated::Kind, Some(frame.head.sa)))
            }
        }
    }

    /// The slave's answer.
    fn answer<'a>(&self, frame: &Frame<'a>) -> Option<Answer<'a>> {
        let Head { dsap, ssap, fc, .. } = frame.head;
        let same_service = self.saps == ssap.zip(dsap);
        // What has no such service cannot name it.
        let same_or_none = same_service || (dsap, ssap) == (None, None);
        let fits = self.data.is_none_or(|length| frame.data.len() == usize::from(length));
        match fc.0 {
            DATA_LOW | DATA_HIGH if same_service && fits => {
                Some(Answer::Data { high: fc.0 == DATA_HIGH, data: frame.data })
            }
            function if REFUSED.contains(&function) && same_or_none => Some(Answer::Refused(function)),
            NO_DATA if self.acknowledge && frame.data.is_empty() && same_or_none => {
                Some(Answer::Acknowledged)
            }
            OK if same_or_none && (self.acknowledge || self.data == Some(0)) => Some(Answer::Acknowledged),
            _ => None,
        }
    }
}
