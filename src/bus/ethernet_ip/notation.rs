//! How people write addresses and values of a drive.

use crate::axis::acyclic::{Call, Notation, NotationError};

/// Addresses and values of these drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Addresses;

impl Notation for Addresses {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn read(&self, _address: &str) -> Result<Call, NotationError> {
        Err(NotationError::Address { form: "AC" })
    }

    fn write(&self, _address: &str, _value: u64) -> Result<Call, NotationError> {
        Err(NotationError::Address { form: "AC" })
    }

    fn value(&self, _address: &str, _text: &str) -> Result<u64, NotationError> {
        Err(NotationError::Address { form: "AC" })
    }

    fn number(&self, _address: &str, raw: u64) -> i64 {
        raw as i64
    }

    fn show(&self, _address: &str, raw: u64) -> String {
        raw.to_string()
    }

    fn reason(&self, status: u32) -> String {
        format!("status {status:#x}")
    }
}
