//! How people write the codes of a Lenze drive, and the calls made from them: `C0061`, `C0039/2` with a subcode.
//!
//! In a [`Call`] the service is [`READ`] or [`WRITE`], the address a packed [`Code`], the value the raw bits of an
//! integer of 32 bits.

use crate::axis::acyclic::{Call, Notation, NotationError};

/// The service of a call that reads.
pub const READ: u32 = 1;
/// The service of a call that writes.
pub const WRITE: u32 = 2;

const FORM: &str = "a code like C0061, or with a subcode C0039/2";

/// A code and its subcode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Code {
    /// Its number.
    pub code: u16,
    /// Its subcode; 0: it has none.
    pub sub: u8,
}

impl Code {
    /// As the address of a call.
    pub const fn pack(self) -> u32 {
        (self.code as u32) << 8 | self.sub as u32
    }

    /// From the address of a call.
    pub const fn unpack(address: u32) -> Code {
        Code { code: (address >> 8) as u16, sub: address as u8 }
    }

    /// From text.
    pub fn parse(text: &str) -> Result<Code, NotationError> {
        let parse = || {
            let (code, sub) = text
                .strip_prefix(['C', 'c'])?
                .split_once('/')
                .map_or_else(|| (text.get(1..), Some(0)), |(code, sub)| (Some(code), sub.parse::<u8>().ok()));
            Some(Code { code: code?.parse().ok()?, sub: sub? })
        };
        parse().ok_or(NotationError::Address { form: FORM })
    }
}

/// The notation of codes.
#[derive(Debug)]
pub struct Codes;

impl Notation for Codes {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        Ok(Call { service: READ, address: Code::parse(address)?.pack(), value: 0 })
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        Ok(Call { service: WRITE, address: Code::parse(address)?.pack(), value })
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        Code::parse(address)?;
        let range = || NotationError::Range {
            value: text.to_owned(),
            low: i64::from(i32::MIN),
            high: i64::from(i32::MAX),
        };
        text.parse::<i32>().map(|value| u64::from(value as u32)).map_err(|_| range())
    }

    fn number(&self, _address: &str, raw: u64) -> i64 {
        i64::from(raw as u32 as i32)
    }

    fn show(&self, address: &str, raw: u64) -> String {
        self.number(address, raw).to_string()
    }

    fn reason(&self, status: u32) -> String {
        format!("error {status:#x}")
    }
}
