//! The slave information, SII: the content of a slave's EEPROM (ETG.2010; ETG.1000.4, 6.4).
//!
//! It is read word by word through two registers, and it may be absent or wrong: a configuration is checked against it,
//! not made from it.

use super::registers::SyncManager;

/// Word addresses.
pub mod word {
    /// Vendor, product, revision, serial number: 32 bits each.
    pub const VENDOR: u16 = 0x08;
    /// See [`VENDOR`].
    pub const PRODUCT: u16 = 0x0A;
    /// See [`VENDOR`].
    pub const REVISION: u16 = 0x0C;
    /// The serial number.
    pub const SERIAL: u16 = 0x0E;
    /// Offset and size of the mailbox that the master writes.
    pub const MAILBOX_OUT: u16 = 0x18;
    /// Offset and size of the mailbox that the master reads.
    pub const MAILBOX_IN: u16 = 0x1A;
    /// [`Protocols`](super::Protocols).
    pub const PROTOCOLS: u16 = 0x1C;
    /// The first category.
    pub const CATEGORIES: u16 = 0x40;
}

/// Values of the owner register: taken from the slave's processor ...
pub const FORCE: u8 = 2;
/// ... given to the master ...
pub const MASTER: u8 = 0;
/// ... and to the slave's processor.
pub const PROCESSOR: u8 = 1;

/// Whether the processor owns it, or works with it: the owner register and the one behind it.
pub fn is_processors(owner: &[u8]) -> bool {
    owner.iter().take(2).any(|byte| byte & 1 != 0)
}

/// Why it cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It belongs to the slave's processor.
    Owned,
    /// A command does not end.
    Busy,
    /// A command fails.
    Refused,
    /// The slave has not loaded it.
    Unloaded,
    /// The checksum is wrong.
    Checksum,
    /// It returns data of another address.
    Address,
    /// It was never written.
    Blank,
}

/// The bytes that start a read from `word` on, for the control register and the address after it.
pub const fn read(word: u16) -> [u8; 6] {
    let ([a, b], [c, d]) = (Status::READ.to_le_bytes(), word.to_le_bytes());
    [a, b, c, d, 0, 0]
}

/// Control and status of the SII.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status(pub u16);

impl Status {
    /// The command that reads.
    pub const READ: u16 = 0x0100;
    /// Ends a command that failed.
    pub const IDLE: u16 = 0x0000;

    /// It reads, or writes.
    pub const fn busy(self) -> bool {
        self.0 & 1 << 15 != 0
    }

    /// A read returns eight bytes, otherwise four.
    pub const fn reads_eight(self) -> bool {
        self.0 & 1 << 6 != 0
    }

    /// The command failed, the checksum is wrong, or nothing is loaded.
    pub const fn error(self) -> bool {
        self.failed() || self.unsound()
    }

    /// The error that it shows.
    pub const fn fault(self) -> Fault {
        match self.0 {
            status if status & 1 << 12 != 0 => Fault::Unloaded,
            status if status & 1 << 11 != 0 => Fault::Checksum,
            _ => Fault::Refused,
        }
    }

    /// The command failed.
    pub const fn failed(self) -> bool {
        self.0 & (1 << 13 | 1 << 14) != 0
    }

    /// The slave has not loaded it, or its checksum is wrong.
    pub const fn unsound(self) -> bool {
        self.0 & (1 << 11 | 1 << 12) != 0
    }
}

/// The mailbox protocols of a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Protocols(pub u16);

impl Protocols {
    /// CANopen.
    pub const fn coe(self) -> bool {
        self.0 & 1 << 2 != 0
    }
}

/// The identity of a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Identity {
    /// The vendor.
    pub vendor: u32,
    /// The product code.
    pub product: u32,
    /// The revision.
    pub revision: u32,
}

/// A category of the SII.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Category {
    /// The type.
    pub kind: u16,
    /// Words of it.
    pub words: u16,
}

impl Category {
    /// Text.
    pub const STRINGS: u16 = 10;
    /// General.
    pub const GENERAL: u16 = 30;
    /// The use of each FMMU.
    pub const FMMU: u16 = 40;
    /// SyncManagers, eight bytes each.
    pub const SYNC_MANAGERS: u16 = 41;
    /// Inputs.
    pub const TX_PDO: u16 = 50;
    /// Outputs.
    pub const RX_PDO: u16 = 51;
    const END: u16 = 0xFFFF;

    /// Reads its two words; `None`: no further category.
    pub const fn new(words: [u8; 4]) -> Option<Category> {
        let [a, b, c, d] = words;
        let (kind, words) = (u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d]));
        if kind == Self::END { None } else { Some(Category { kind, words }) }
    }
}

/// The use of a SyncManager.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Use {
    /// None, or a manufacturer's own.
    Other(u8),
    /// The mailbox that the master writes.
    MailboxOut,
    /// The mailbox that the master reads.
    MailboxIn,
    /// Outputs.
    Outputs,
    /// Inputs.
    Inputs,
}

/// An entry of the SyncManager category.
pub fn sync_manager(entry: [u8; 8]) -> (SyncManager, Use) {
    let [a, b, c, d, control, _, enable, kind] = entry;
    let usage = match kind {
        1 => Use::MailboxOut,
        2 => Use::MailboxIn,
        3 => Use::Outputs,
        4 => Use::Inputs,
        other => Use::Other(other),
    };
    (SyncManager::new([a, b, c, d, control, 0, enable & 1, 0]), usage)
}

/// The checksum of the first 14 bytes, which is in word 7.
pub fn crc(config: &[u8; 14]) -> u8 {
    config.iter().fold(0xFF, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc, _| if crc & 0x80 != 0 { crc << 1 ^ 0x07 } else { crc << 1 })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_read_is_begun_as_real_masters_do() {
        assert_eq!(read(word::VENDOR), [0x00, 0x01, 0x08, 0x00, 0x00, 0x00]);
        let emulated = Status(0x0020);
        assert!(!emulated.busy() && !emulated.error() && !emulated.reads_eight());
        assert!(Status(0x8040).busy() && Status(0x8040).reads_eight() && Status(0x2000).error());
    }

    #[test]
    fn the_sync_managers_of_a_real_drive_are_read() {
        let entries = [
            ([0x00, 0x18, 0x00, 0x04, 0x26, 0x00, 0x01, 0x01], Use::MailboxOut, true),
            ([0x00, 0x1C, 0x00, 0x04, 0x22, 0x00, 0x01, 0x02], Use::MailboxIn, false),
            ([0x00, 0x11, 0x00, 0x00, 0x24, 0x00, 0x01, 0x03], Use::Outputs, true),
            ([0x40, 0x11, 0x00, 0x00, 0x20, 0x00, 0x01, 0x04], Use::Inputs, false),
        ];
        for (entry, usage, output) in entries {
            let (manager, read) = sync_manager(entry);
            assert_eq!((read, manager.is_output(), manager.activate), (usage, output, 1));
        }
    }

    #[test]
    fn categories_end() {
        let fmmus = Category::new([40, 0, 2, 0]);
        assert_eq!(fmmus, Some(Category { kind: Category::FMMU, words: 2 }));
        assert_eq!(Category::new([0xFF, 0xFF, 0, 0]), None);
        assert!(Protocols(0x000E).coe() && !Protocols(0x0002).coe());
    }

    #[test]
    fn the_check_is_that_of_its_polynomial() {
        // Of the start value alone: fourteen bytes of 0 divide it further.
        let mut byte_by_byte = 0xFF_u8;
        for _ in 0..14 * 8 {
            byte_by_byte =
                if byte_by_byte & 0x80 != 0 { byte_by_byte << 1 ^ 0x07 } else { byte_by_byte << 1 };
        }
        assert_eq!(crc(&[0; 14]), byte_by_byte);
        let mut changed = [0; 14];
        changed[3] = 1;
        assert_ne!(crc(&changed), crc(&[0; 14]));
    }
}
