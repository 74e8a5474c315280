//! The EEPROM of a slave (SII).

/// Word addresses.
pub mod word {
    constants! { usize:
        ALIAS = 0x04; CHECK = 0x07; VENDOR = 0x08; PRODUCT = 0x0A; REVISION = 0x0C; SERIAL = 0x0E;
        MAILBOXES = 0x18; PROTOCOLS = 0x1C; SIZE = 0x3E; VERSION = 0x3F; CATEGORIES = 0x40;
    }
}

/// CoE, in the protocols.
pub const COE: u16 = 1 << 2;

/// Categories.
pub mod category {
    constants! { u16:
        STRINGS = 10; GENERAL = 30; FMMU = 40; SYNC_MANAGERS = 41; TX_PDO = 50; RX_PDO = 51; END = 0xFFFF;
    }
}

/// Bits of control and status, and the commands in them.
pub mod bit {
    constants! { u16:
        WRITES = 1 << 0; EMULATED = 1 << 5; EIGHT = 1 << 6; COMMAND = 7 << 8; READ = 1 << 8; WRITE = 2 << 8;
        CHECKSUM = 1 << 11; UNLOADED = 1 << 12; REFUSED = 1 << 13; PROTECTED = 1 << 14; BUSY = 1 << 15;
    }
}

/// In the owner: the processor may have it. In the byte behind it: it has it.
pub const SLAVE_OWNS: u8 = 1 << 0;
/// In the owner: it is taken from the processor.
pub const FORCED: u8 = 1 << 1;

/// Who made a slave, and what it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Identity {
    /// The vendor.
    pub vendor: u32,
    /// The product code.
    pub product: u32,
    /// The revision.
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
