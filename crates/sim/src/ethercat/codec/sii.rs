//! The EEPROM of a slave (SII).

/// Word addresses.
pub mod word {
    pub const ALIAS: usize = 0x04;
    /// The checksum of the words before it.
    pub const CHECK: usize = 0x07;
    pub const VENDOR: usize = 0x08;
    pub const PRODUCT: usize = 0x0A;
    pub const REVISION: usize = 0x0C;
    pub const SERIAL: usize = 0x0E;
    /// Start and length of the mailbox that the master writes, of the other one; and the protocols.
    pub const MAILBOXES: usize = 0x18;
    pub const PROTOCOLS: usize = 0x1C;
    pub const SIZE: usize = 0x3E;
    pub const VERSION: usize = 0x3F;
    pub const CATEGORIES: usize = 0x40;
}

/// CoE, in the protocols.
pub const COE: u16 = 1 << 2;

/// Categories.
pub mod category {
    pub const STRINGS: u16 = 10;
    pub const GENERAL: u16 = 30;
    pub const FMMU: u16 = 40;
    pub const SYNC_MANAGERS: u16 = 41;
    pub const TX_PDO: u16 = 50;
    pub const RX_PDO: u16 = 51;
    pub const END: u16 = 0xFFFF;
}

/// Bits of control and status, and the commands in them.
pub mod bit {
    /// Goes with the command to write.
    pub const WRITES: u16 = 1 << 0;
    /// The firmware emulates the EEPROM.
    pub const EMULATED: u16 = 1 << 5;
    /// A read returns eight bytes, otherwise four.
    pub const EIGHT: u16 = 1 << 6;
    pub const COMMAND: u16 = 7 << 8;
    pub const READ: u16 = 1 << 8;
    pub const WRITE: u16 = 2 << 8;
    pub const CHECKSUM: u16 = 1 << 11;
    pub const UNLOADED: u16 = 1 << 12;
    pub const REFUSED: u16 = 1 << 13;
    pub const PROTECTED: u16 = 1 << 14;
    pub const BUSY: u16 = 1 << 15;
}

/// In the owner: the processor may have it. In the byte behind it: it has it.
pub const SLAVE_OWNS: u8 = 1 << 0;
/// In the owner: it is taken from the processor.
pub const FORCED: u8 = 1 << 1;

/// Who made a slave, and what it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Identity {
    /// Its vendor.
    pub vendor: u32,
    /// Its product code.
    pub product: u32,
    /// Its revision.
    pub revision: u32,
}

/// The checksum of the first words: CRC-8, polynomial 07h, from FFh on.
pub fn check(words: &[u16]) -> u16 {
    let bytes = words.iter().take(word::CHECK).flat_map(|word| word.to_le_bytes());
    let crc = bytes.fold(0xFF_u8, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc, _| crc << 1 ^ if crc & 0x80 != 0 { 0x07 } else { 0 })
    });
    crc.into()
}
