//! The drive's parameters and Q registers: what can be set, what a save keeps, and their numbers in messages.
//!
//! Facts: sheet, 3.3, 5.5, 5.7. What is out of its range is not taken: no document says that it is clamped.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use super::settings::MoonsSettings;

/// The two letters of a command.
pub(super) type Name = [u8; 2];

/// A parameter: its letters, and which one of three for HA, HL, HV and MO, else 0.
pub(super) type Key = (Name, u8);

/// All of them, as they count now and as they were saved. Those that nobody has set are 0.
#[derive(Clone, Debug)]
pub(super) struct Parameters {
    now: BTreeMap<Key, i32>,
    saved: BTreeMap<Key, i32>,
}

/// What the manual's ranges are.
fn range(name: &Name) -> RangeInclusive<i32> {
    match name {
        b"AC" | b"DE" | b"AM" | b"JA" | b"JL" | b"VE" | b"VC" | b"HA" | b"HL" | b"HV" => 1..=32_000,
        b"JS" => 0..=32_000,
        b"EG" => 1..=131_070,
        b"ZS" => 0..=10_000,
        b"ZA" => 1..=16,
        _ => i32::MIN..=i32::MAX,
    }
}

impl Parameters {
    pub(super) fn new(settings: &MoonsSettings) -> Parameters {
        let revolution = settings.motor.steps.clamp(1, 131_070) as i32;
        let mut now: BTreeMap<Key, i32> = [
            (*b"AC", 600),
            (*b"DE", 600),
            (*b"AM", 18_000),
            (*b"JA", 600),
            (*b"JL", 600),
            (*b"JS", 240),
            (*b"VE", 240),
            (*b"VC", 120),
            (*b"DI", revolution),
            (*b"EG", revolution),
            (*b"ZS", settings.firmware.zs_ms.into()),
            (*b"ZA", settings.firmware.za.into()),
        ]
        .map(|(name, value)| ((name, 0), value))
        .into();
        for index in 1..=3 {
            now.extend([((*b"HA", index), 600), ((*b"HL", index), 600), ((*b"HV", index), 240)]);
        }
        Parameters { saved: now.clone(), now }
    }

    pub(super) fn get(&self, name: &Name) -> i32 {
        self.indexed(name, 0)
    }

    pub(super) fn indexed(&self, name: &Name, index: u8) -> i32 {
        self.now.get(&(*name, index)).copied().unwrap_or_default()
    }

    /// Sets one; false: out of its range, and it stays as it was.
    pub(super) fn set(&mut self, (name, index): Key, value: i32) -> bool {
        let fits = range(&name).contains(&value);
        if fits {
            self.now.insert((name, index), value);
        }
        fits
    }

    /// Keeps all of them over a power cycle.
    pub(super) fn save(&mut self) {
        self.saved = self.now.clone();
    }

    /// Keeps this one.
    pub(super) fn save_one(&mut self, key: Key) {
        if let Some(value) = self.now.get(&key) {
            self.saved.insert(key, *value);
        }
    }

    /// Power was lost.
    pub(super) fn restart(&mut self) {
        self.now = self.saved.clone();
    }
}

/// A value as 16 bits carry it: signed, but for the steps of a revolution, which are counted in pairs.
pub(super) fn from_word(name: &Name, word: u16) -> i32 {
    if name == b"EG" { 2 * i32::from(word) } else { i32::from(word as i16) }
}

/// The 16 bits of a value.
pub(super) fn to_word(name: &Name, value: i32) -> u16 {
    if name == b"EG" { (value / 2) as u16 } else { value as u16 }
}

/// The parameter with this index in table 3. CP is printed with the index of CI.
pub(super) fn by_index(index: u8) -> Option<Name> {
    Some(*match index {
        0x1E => b"AC",
        0x16 => b"AM",
        0x18 => b"CC",
        0x19 => b"CI",
        0x10 => b"CM",
        0x1F => b"DE",
        0x42 => b"DL",
        0x26 => b"EG",
        0x2A => b"EN",
        0x20 => b"ER",
        0x2B => b"EU",
        0x12 => b"GC",
        0x04 => b"HG",
        0x05 => b"HP",
        0x1B => b"JA",
        0x1C => b"JL",
        0x55 => b"JM",
        0x1A => b"JS",
        0x49 => b"MO",
        0x01 => b"MV",
        0x71 => b"PD",
        0x72 => b"PE",
        0x21 => b"PF",
        0x5D => b"PK",
        0x44 => b"PM",
        0x59 => b"PR",
        0x3F => b"PT",
        0x06 => b"SF",
        0x45 => b"SI",
        0x4A => b"VC",
        0x1D => b"VE",
        _ => return None,
    })
}

/// Host commands of the STF, and of step-servo drives.
const STEPPER: &str =
    "AI AM AO BD BE BO CC CI CM DC DL EG EH HA HG HL HO HP HV LP LM MO PC PI PM RL SA SF SI SO SP VC ZA ZS";
const STEP_SERVO: &str = "AD AF AG AI AM AN AO AP AS AT AV AZ BD BE BO CC CM CP DC EF EG EH FX GC HA HC HL \
     HO HS HV LP LM MO PC PD PE PF PM PP RL SA SI SO SP VC";

/// Whether a drive has this host command. ZS and ZA are listed for the STF only; every drive with this interface has
/// them, since its watchdog does.
pub(super) fn is_host_command(name: &Name, is_step_servo: bool) -> bool {
    let list = if is_step_servo { STEP_SERVO } else { STEPPER };
    list.split(' ').any(|entry| entry.as_bytes() == name) || matches!(name, b"ZS" | b"ZA")
}
