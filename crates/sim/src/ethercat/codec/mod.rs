//! The slave's reading of the wire: frames, registers, the SII, the mailbox, objects and CiA 402.
//!
//! Written from the manuals and ETG.1000, by another hand than the master's codec, and without an item of it: a field
//! that one of them misreads does not agree with itself. `tests/offline/codecs` compares the two.
//!
//! | file | what |
//! |---|---|
//! | `frame` | datagrams of a frame, and their commands (ETG.1000.4, 5.3, 5.4) |
//! | `registers` | addresses, AL states and codes, FMMUs, SyncManagers (ETG.1000.4, 6; Section II of the ET1100) |
//! | `sii` | words, categories, checksum and status of the EEPROM (ETG.1000.6, 5.4; ETG.2010) |
//! | `mailbox` | mailbox messages, emergencies, SDO requests and answers (ETG.1000.4, 5.6; ETG.1000.6, 5.6) |
//! | `objects` | the dictionary of a drive, its fixed PDOs, modes and fault codes (CAN and EtherCAT manuals) |
//! | `cia402` | control word and status word (CiA 402-2; CAN manual) |
//!
//! All numbers are little-endian but the Ethertype.

#![expect(missing_docs, reason = "names are those of the documents")]

/// Public constants of one type.
macro_rules! constants {
    ($kind:ty: $($name:ident = $value:expr;)*) => {
        $(pub const $name: $kind = $value;)*
    };
}

pub mod cia402;
pub mod frame;
pub mod mailbox;
pub mod objects;
pub mod registers;
pub mod sii;

/// The number at an offset, of two bytes. The bytes must be there.
fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

/// The number at an offset, of four bytes. The bytes must be there.
fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from(u16_at(bytes, at)) | u32::from(u16_at(bytes, at + 2)) << 16
}
