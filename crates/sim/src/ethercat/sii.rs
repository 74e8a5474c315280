//! The EEPROM of a slave (SII): the contents of an image, and access to it by registers (ETG.1000.4, 6.4;
//! ETG.2010).

use super::codec::objects::Pdo;
use super::codec::registers::SyncManager;
use super::codec::sii::{COE, Identity, bit, category, check, word};
use super::slave::{SiiContent, SiiSettings};
use fieldbeat_core::time::Time;

/// In `size`: 2 KiB.
const KIBIT_16: u16 = 15;

/// Mailboxes as the SII has them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mailboxes {
    /// Start and length of the one that the master writes.
    pub out: (u16, u16),
    /// The same of the one that the master reads.
    pub input: (u16, u16),
    /// AoE, EoE, CoE and so on, a bit each.
    pub protocols: u16,
}

/// The contents of an image.
#[derive(Clone, Debug, Default)]
pub struct Contents {
    /// The name of the type.
    pub name: &'static str,
    /// The slave's identity.
    pub identity: Identity,
    /// The serial number.
    pub serial: u32,
    /// The alias; 0: none.
    pub alias: u16,
    /// The mailboxes, if there are any.
    pub mailboxes: Option<Mailboxes>,
    /// The use of each FMMU: 1 outputs, 2 inputs, 3 the state of the mailbox.
    pub fmmus: Vec<u8>,
    /// The SyncManagers.
    pub managers: Vec<SyncManager>,
    /// The input PDOs, each with its SyncManager.
    pub inputs: Vec<(Pdo, u8)>,
    /// The output PDOs, each with its SyncManager.
    pub outputs: Vec<(Pdo, u8)>,
}

impl Contents {
    /// The words of the image.
    pub fn image(&self) -> Vec<u16> {
        let mut words = vec![0; word::CATEGORIES];
        words[word::ALIAS] = self.alias;
        words[word::CHECK] = check(&words);
        let Identity { vendor, product, revision } = self.identity;
        let numbers = [vendor, product, revision, self.serial];
        for (at, number) in (word::VENDOR..).step_by(2).zip(numbers) {
            (words[at], words[at + 1]) = (number as u16, (number >> 16) as u16);
        }
        if let Some(Mailboxes { out, input, protocols }) = self.mailboxes {
            words[word::MAILBOXES..=word::PROTOCOLS]
                .copy_from_slice(&[out.0, out.1, input.0, input.1, protocols]);
        }
        (words[word::SIZE], words[word::VERSION]) = (KIBIT_16, 1);
        self.categories(&mut words);
        words
    }

    fn categories(&self, words: &mut Vec<u16>) {
        let name = &self.name.as_bytes()[..self.name.len().min(255)];
        let strings = [&[1, name.len() as u8][..], name].concat();
        append(words, category::STRINGS, &strings);
        append(words, category::GENERAL, &self.general());
        append(words, category::FMMU, &self.fmmus);
        let managers: Vec<u8> = self.managers.iter().flat_map(|manager| entry(*manager)).collect();
        append(words, category::SYNC_MANAGERS, &managers);
        for (kind, pdos) in [(category::TX_PDO, &self.inputs), (category::RX_PDO, &self.outputs)] {
            let bytes: Vec<u8> = pdos.iter().flat_map(|(pdo, manager)| pdo_entry(pdo, *manager)).collect();
            append(words, kind, &bytes);
        }
        words.push(category::END);
    }

    /// The name is text 1; SDOs are there if CoE is.
    fn general(&self) -> [u8; 32] {
        let mut general = [0; 32];
        general[3] = 1;
        general[5] = u8::from(self.mailboxes.is_some_and(|mailboxes| mailboxes.protocols & COE != 0));
        general
    }
}

/// A PDO in its category.
fn pdo_entry(pdo: &Pdo, manager: u8) -> Vec<u8> {
    let [low, high] = pdo.index.to_le_bytes();
    let mut bytes = vec![low, high, pdo.entries.len() as u8, manager, 0, 0, 0, 0];
    for (object, bits) in &pdo.entries {
        let [low, high] = object.index.to_le_bytes();
        bytes.extend([low, high, object.sub, 0, 0, *bits, 0, 0]);
    }
    bytes
}

/// Appends a category, unless it is empty; its last word is filled up.
fn append(words: &mut Vec<u16>, kind: u16, bytes: &[u8]) {
    if bytes.is_empty() {
        return;
    }
    words.extend([kind, bytes.len().div_ceil(2) as u16]);
    words
        .extend(bytes.chunks(2).map(|pair| u16::from_le_bytes([pair[0], pair.get(1).copied().unwrap_or(0)])));
}

/// A SyncManager in its category.
fn entry(manager: SyncManager) -> [u8; 8] {
    let mut entry = manager.to_bytes();
    entry[7] = manager.usage();
    entry
}

/// A command to be completed at its time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Job {
    done_at: Time,
    command: u16,
    address: u32,
    word: u16,
}

/// The EEPROM and the unit that reads it.
#[derive(Debug, Default)]
pub(super) struct Eeprom {
    pub(super) words: Vec<u16>,
    access: SiiSettings,
    error: u16,
    pub(super) job: Option<Job>,
    pub(super) data: [u8; 8],
    /// The load after power-on has begun.
    loaded: bool,
    /// The address that the first read has returned.
    pub(super) slipped: Option<u32>,
    /// Reads that were completed.
    reads: u32,
}

impl Eeprom {
    pub(super) fn new(words: Vec<u16>, access: SiiSettings) -> Eeprom {
        let mut eeprom = Eeprom { words, access, ..Eeprom::default() };
        eeprom.load();
        eeprom
    }

    /// Checks the configuration area.
    fn load(&mut self) {
        let is_sound = self.words.get(word::CHECK).is_some_and(|own| *own & 0xFF == check(&self.words));
        self.error = match is_sound {
            _ if self.access.content == SiiContent::Unloaded => bit::UNLOADED,
            true => 0,
            false => bit::CHECKSUM,
        };
    }

    /// The alias in a valid image.
    pub(super) fn alias(&self) -> u16 {
        if self.error & (bit::CHECKSUM | bit::UNLOADED) != 0 { 0 } else { self.word(word::ALIAS as u32) }
    }

    /// The word there; beyond the end nothing is programmed.
    fn word(&self, address: u32) -> u16 {
        usize::try_from(address).ok().and_then(|at| self.words.get(at)).copied().unwrap_or(0xFFFF)
    }

    /// Control and status.
    pub(super) fn status(&self) -> u16 {
        let flag = |is: bool, bit: u16| if is { bit } else { 0 };
        self.error | flag(self.access.eight, bit::EIGHT) | self.job.map_or(0, |job| bit::BUSY | job.command)
    }

    /// Takes a command; the idle one ends an error. True: it is done already.
    pub(super) fn command(&mut self, now: Time, control: u16, address: u32, word: u16) -> bool {
        let command = control & bit::COMMAND;
        self.error &= bit::CHECKSUM | bit::UNLOADED;
        match command >> 8 {
            0 => {}
            2 if control & bit::WRITES == 0 => self.error |= bit::PROTECTED,
            1..=4 => self.job = Some(Job { done_at: now + self.access.busy_ns, command, address, word }),
            _ => self.error |= bit::REFUSED,
        }
        self.advance(now)
    }

    /// Completes a command whose time has come; whether there was one.
    pub(super) fn advance(&mut self, now: Time) -> bool {
        let loading_ns = if self.loaded { 0 } else { self.access.loading_ns };
        self.loaded = true;
        if loading_ns > 0 {
            self.job = Some(Job { done_at: now + loading_ns, command: 0, address: 0, word: 0 });
        }
        let Some(job) = self.job.take_if(|job| now >= job.done_at) else { return false };
        self.reads += u32::from(job.command == bit::READ);
        let SiiSettings { fails_every, content, .. } = self.access;
        let fails = fails_every > 0 && self.reads.is_multiple_of(fails_every);
        match job.command {
            0 => {}
            bit::READ if fails || content == SiiContent::Unloaded => self.fail(),
            bit::READ if self.access.slips => {
                self.access.slips = false;
                self.slipped = Some(job.address.wrapping_add(1));
                self.read(job.address.wrapping_add(1));
            }
            bit::READ => self.read(job.address),
            bit::WRITE => {
                let at = usize::try_from(job.address).ok();
                match at.and_then(|at| self.words.get_mut(at)) {
                    Some(word) => *word = job.word,
                    None => self.error |= bit::REFUSED,
                }
            }
            _ => self.load(),
        }
        true
    }

    /// A command has failed, which stays shown until the next one.
    pub(super) fn fail(&mut self) {
        self.error |= bit::REFUSED;
    }

    fn read(&mut self, address: u32) {
        let words = if self.access.eight { 4 } else { 2 };
        for (at, pair) in self.data.chunks_mut(2).take(words).enumerate() {
            let word = usize::try_from(address).ok().and_then(|address| self.words.get(address + at));
            pair.copy_from_slice(&word.copied().unwrap_or(0xFFFF).to_le_bytes());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ethercat::codec::objects::Object;
    use crate::testing::hex;

    const T: Time = Time(5);

    /// A drive of the sheet's.
    fn contents() -> Contents {
        let entries = vec![(Object::new(0x6064, 0), 32), (Object::new(0x6041, 0), 16)];
        Contents {
            name: "S700",
            identity: Identity { vendor: 0x6A, product: 0x0300_0600, revision: 2 },
            serial: 0x1234_5678,
            alias: 7,
            mailboxes: Some(Mailboxes { out: (0x1800, 0x400), input: (0x1C00, 0x400), protocols: 4 }),
            fmmus: vec![1, 2, 3],
            managers: vec![SyncManager::on(0x1800, 0x400, 0x26), SyncManager::on(0x1C00, 0x400, 0x22)],
            inputs: vec![(Pdo { index: 0x1B03, entries }, 3)],
            outputs: Vec::new(),
        }
    }

    fn read(eeprom: &mut Eeprom, address: u32) -> [u8; 8] {
        eeprom.command(T, bit::READ, address, 0);
        eeprom.data
    }

    #[test]
    fn categories_follow_one_another_to_the_end() {
        let words = contents().image();
        let bytes: Vec<u8> = words[word::CATEGORIES..].iter().flat_map(|word| word.to_le_bytes()).collect();
        let general = format!("1E001000 000000010001 {}", "00".repeat(26));
        let expected = [
            "0A000300 0104 53373030",
            &general,
            "28000200 01020300",
            "29000800 00180004 26000101 001C0004 22000102",
            "32000C00 031B020300000000 6460000000200000 4160000000100000",
            "FFFF",
        ];
        assert_eq!(bytes, hex(&expected.concat()));
    }

    #[test]
    fn a_write_needs_its_enable_bit_and_a_reload_makes_it_count() {
        let mut eeprom =
            Eeprom::new(contents().image(), SiiSettings { busy_ns: 0, ..SiiSettings::default() });
        eeprom.command(T, 0x0200, word::ALIAS as u32, 9);
        assert_eq!(eeprom.status(), 0x4000);
        eeprom.command(T, 0, 0, 0);
        assert_eq!(eeprom.status(), 0);
        eeprom.command(T, 0x0201, word::ALIAS as u32, 9);
        assert_eq!((eeprom.status(), eeprom.alias()), (0, 9));
        // The check is that of the old alias.
        eeprom.command(T, 0x0300, 0, 0);
        assert_eq!((eeprom.status(), eeprom.alias()), (bit::CHECKSUM, 0));
        assert_eq!(eeprom.words[word::ALIAS], 9);
    }

    #[test]
    fn access_beyond_the_end_is_an_error() {
        let mut blank = Eeprom::new(Vec::new(), SiiSettings { busy_ns: 0, ..SiiSettings::default() });
        assert_eq!((blank.status(), blank.alias()), (0x0800, 0));
        assert_eq!(read(&mut blank, u32::MAX), [0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0]);
        blank.command(T, 0x0201, 3, 1);
        assert_eq!(blank.status(), 0x2800);
        blank.command(T, 0x0700, 0, 0);
        assert_eq!(blank.status(), 0x2800);
    }
}
