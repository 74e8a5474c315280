//! Devices as they can be bought: a coupler, a branch, terminals (Beckhoff). Their SII and their process memory are
//! their own, whatever a plan says.
//!
//! Product codes are the type number and 2C52h or 3052h. Revisions are plausible ones.

use super::codec::objects::{Object, Pdo};
use super::codec::registers::SyncManager;
use super::codec::sii::{COE, Identity};
use super::coupler::{Coupler, Terminals};
use super::sii::{Contents, Mailboxes};

const BECKHOFF: u32 = 2;
/// Where the outputs of a digital terminal are: a byte and a SyncManager for each eight.
const DIGITAL_OUTPUTS: u16 = 0x0F00;
/// Their control byte: buffered, written by the master, with the watchdog.
const DIGITAL: u8 = 0x44;
/// Where its inputs are, with the control byte 0: buffered, read by the master.
const DIGITAL_INPUTS: u16 = 0x1000;

/// A device of a simulated segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// A coupler: no process data, no mailbox.
    Ek1100,
    /// A junction: two further branches.
    Ek1122,
    /// Two digital inputs.
    El1002,
    /// Four.
    El1004,
    /// Eight.
    El1008,
    /// Sixteen, behind one SyncManager.
    El1809,
    /// Two digital outputs.
    El2002,
    /// Four.
    El2004,
    /// Eight.
    El2008,
    /// Sixteen, behind two SyncManagers.
    El2809,
    /// Two analogue inputs, with a mailbox and objects.
    El3102,
}

/// A model, its name, product code and revision, its digital outputs and inputs.
type Row = (Model, &'static str, u32, u32, (u8, u8));

const ROWS: [Row; 11] = [
    (Model::Ek1100, "EK1100", 0x044C_2C52, 0x0011_0000, (0, 0)),
    (Model::Ek1122, "EK1122", 0x0462_2C52, 0x0012_0000, (0, 0)),
    (Model::El1002, "EL1002", 0x03EA_3052, 0x0010_0000, (0, 2)),
    (Model::El1004, "EL1004", 0x03EC_3052, 0x0010_0000, (0, 4)),
    (Model::El1008, "EL1008", 0x03F0_3052, 0x0010_0000, (0, 8)),
    (Model::El1809, "EL1809", 0x0711_3052, 0x0011_0000, (0, 16)),
    (Model::El2002, "EL2002", 0x07D2_3052, 0x0010_0000, (2, 0)),
    (Model::El2004, "EL2004", 0x07D4_3052, 0x0010_0000, (4, 0)),
    (Model::El2008, "EL2008", 0x07D8_3052, 0x0010_0000, (8, 0)),
    (Model::El2809, "EL2809", 0x0AF9_3052, 0x0011_0000, (16, 0)),
    (Model::El3102, "EL3102", 0x0C1E_3052, 0x0012_0000, (0, 0)),
];

impl Model {
    /// All of them, by their names in a configuration.
    pub const ALL: [(&'static str, Model); ROWS.len()] = {
        let mut all = [("", Model::Ek1100); ROWS.len()];
        let mut n = 0;
        while n < all.len() {
            all[n] = (ROWS[n].1, ROWS[n].0);
            n += 1;
        }
        all
    };

    fn row(self) -> Row {
        ROWS[self as usize]
    }

    /// The name.
    pub fn name(self) -> &'static str {
        self.row().1
    }

    /// The identity.
    pub fn identity(self) -> Identity {
        let (_, _, product, revision, _) = self.row();
        Identity { vendor: BECKHOFF, product, revision }
    }

    /// Whether the device has no processor.
    pub fn is_emulated(self) -> bool {
        self != Model::El3102
    }

    /// Port types: a coupler has one port more than a terminal, a junction two.
    pub(super) fn ports(self) -> u8 {
        match self {
            Model::Ek1100 => 0x3B,
            Model::Ek1122 => 0xFA,
            _ => 0x0A,
        }
    }

    /// The digital channels.
    pub(super) fn terminals(self) -> Coupler {
        let (outputs, inputs) = self.row().4;
        let digital = |digital| Terminals { digital, analogue: 0 };
        Coupler { outputs: digital(outputs), inputs: digital(inputs) }
    }

    /// The content of its EEPROM.
    pub(super) fn contents(self) -> Contents {
        let contents = Contents { name: self.name(), identity: self.identity(), ..Contents::default() };
        if self == Model::El3102 {
            return analogue(contents);
        }
        let (outputs, inputs) = self.row().4;
        let mut managers: Vec<_> = (0..u16::from(outputs).div_ceil(8))
            .map(|n| SyncManager::on(DIGITAL_OUTPUTS + n, 1, DIGITAL))
            .collect();
        if inputs > 0 {
            managers.push(SyncManager::on(DIGITAL_INPUTS, u16::from(inputs).div_ceil(8), 0));
        }
        let channel = |pdo: u16, object: u16, n: u8, manager| {
            let entries = vec![(Object::new(object + 0x10 * u16::from(n), 1), 1)];
            (Pdo { index: pdo + u16::from(n), entries }, manager)
        };
        Contents {
            fmmus: managers.iter().map(|manager| if manager.is_output() { 1 } else { 2 }).collect(),
            managers,
            outputs: (0..outputs).map(|n| channel(0x1600, 0x7000, n, n / 8)).collect(),
            inputs: (0..inputs).map(|n| channel(0x1A00, 0x6000, n, 0)).collect(),
            ..contents
        }
    }
}

/// Two channels, each a status of 16 bits and a value of 16; no outputs, but a SyncManager for them. Addresses, lengths
/// and PDOs are assumed, as analogue terminals with 16 bits of status usually have them.
fn analogue(contents: Contents) -> Contents {
    let channel = |n: u16| {
        let (data, pdo) = (0x6000 + 0x10 * n, 2 * n);
        // Underrange, overrange, two limits, error, a gap; state and toggle of the PDO; the value.
        let status = [(1, 1), (2, 1), (3, 2), (5, 2), (7, 1)].map(|(sub, bits)| (data, sub, bits));
        let rest = [(0, 0, 7), (0x1800 + pdo, 7, 1), (0x1800 + pdo, 9, 1), (data, 0x11, 16)];
        let entries =
            status.into_iter().chain(rest).map(|(index, sub, bits)| (Object::new(index, sub), bits));
        (Pdo { index: 0x1A00 + pdo, entries: entries.collect() }, 3)
    };
    Contents {
        mailboxes: Some(Mailboxes { out: (0x1000, 128), input: (0x1080, 128), protocols: COE }),
        fmmus: vec![1, 2, 3],
        managers: vec![
            SyncManager::on(0x1000, 128, SyncManager::MAILBOX_OUT),
            SyncManager::on(0x1080, 128, SyncManager::MAILBOX_IN),
            SyncManager { activate: 0, ..SyncManager::on(0x1100, 0, SyncManager::OUTPUTS) },
            SyncManager::on(0x1180, 8, SyncManager::INPUTS),
        ],
        inputs: vec![channel(0), channel(1)],
        ..contents
    }
}
