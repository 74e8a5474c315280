//! Plain I/O: a slave without a mailbox, digital and analogue terminals in one image.
//!
//! Each output is wired to the input with its number, if there is one. While no outputs are valid all of them are
//! off.
//!
//! | bytes | what |
//! |---|---|
//! | 0- | digital, a bit each, filled up to a whole byte |
//! | after them | analogue, 16 bits each |

use super::Application;
use super::codec::objects::{Object, Pdo};
use super::codec::registers::{AlState, SyncManager, code};
use super::codec::sii::Identity;
use super::esc::Esc;
use super::hardware::Settings;
use super::sii::Contents;
use fieldbeat_core::time::Time;

/// Where the outputs begin; the inputs follow their three buffers.
const OUTPUTS_AT: u16 = 0x1000;
/// The PDOs of its digital and analogue terminals, and the objects in them: outputs, inputs.
const OUTPUTS: [(u16, u16); 2] = [(0x1600, 0x7000), (0x1601, 0x7010)];
const INPUTS: [(u16, u16); 2] = [(0x1A00, 0x6000), (0x1A01, 0x6010)];

/// How many terminals of each kind there are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Terminals {
    /// Bits.
    pub digital: u8,
    /// Words.
    pub analogue: u8,
}

impl Terminals {
    /// Bytes of the digital ones.
    fn digital_bytes(self) -> usize {
        usize::from(self.digital).div_ceil(8)
    }

    /// Bytes of all.
    pub fn bytes(self) -> usize {
        self.digital_bytes() + 2 * usize::from(self.analogue)
    }

    /// The PDOs: digital terminals by bytes, analogue ones by words.
    fn pdos(self, objects: [(u16, u16); 2], manager: u8) -> Vec<(Pdo, u8)> {
        let counts = [(self.digital_bytes() as u8, 8), (self.analogue, 16)];
        let pdo = |((index, object), (count, bits))| {
            let entries: Vec<_> = (1..=count).map(|n| (Object::new(object, n), bits)).collect();
            (!entries.is_empty()).then_some((Pdo { index, entries }, manager))
        };
        objects.into_iter().zip(counts).filter_map(pdo).collect()
    }
}

/// A coupler with terminals.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Coupler {
    /// Outputs.
    pub outputs: Terminals,
    /// Inputs.
    pub inputs: Terminals,
}

impl Coupler {
    /// A slave with this coupler behind it, described in its EEPROM; `settings` gives the rest.
    pub fn slave(self, name: &'static str, identity: Identity, settings: Settings) -> Esc {
        let sii = self.contents(name, identity).image();
        Esc::new(Settings { sii, ..settings }, Box::new(self))
    }

    /// The content of its EEPROM.
    pub fn contents(self, name: &'static str, identity: Identity) -> Contents {
        let managers = self.managers();
        let inputs_manager = managers.len().saturating_sub(1) as u8;
        let fmmus = managers.iter().map(|manager| if manager.is_output() { 1 } else { 2 }).collect();
        Contents {
            name,
            identity,
            fmmus,
            managers,
            inputs: self.inputs.pdos(INPUTS, inputs_manager),
            outputs: self.outputs.pdos(OUTPUTS, 0),
            ..Contents::default()
        }
    }

    /// The SyncManagers in order, outputs first; none for a missing direction.
    pub fn managers(self) -> Vec<SyncManager> {
        let (outputs, inputs) = (self.outputs.bytes() as u16, self.inputs.bytes() as u16);
        let inputs_at = OUTPUTS_AT + (3 * outputs).next_multiple_of(0x100);
        [
            SyncManager::on(OUTPUTS_AT, outputs, SyncManager::OUTPUTS | SyncManager::WATCHDOG),
            SyncManager::on(inputs_at, inputs, SyncManager::INPUTS),
        ]
        .into_iter()
        .filter(|manager| manager.length > 0)
        .collect()
    }
}

impl Application for Coupler {
    fn mailbox(&mut self, _request: &[u8], _reply: &mut Vec<u8>) -> bool {
        false
    }

    fn may_enter(&mut self, _now: Time, state: AlState) -> Result<(), u16> {
        if state == AlState::Boot { Err(code::NO_BOOT) } else { Ok(()) }
    }

    fn process(&mut self, _now: Time, outputs: &[u8], inputs: &mut [u8]) {
        inputs.fill(0);
        let split = |terminals: Terminals, length: usize| terminals.digital_bytes().min(length);
        let (bits, words) = outputs.split_at(split(self.outputs, outputs.len()));
        let (input_bits, input_words) = inputs.split_at_mut(split(self.inputs, inputs.len()));
        for n in 0..usize::from(self.outputs.digital.min(self.inputs.digital)) {
            let is_on = bits.get(n / 8).is_some_and(|byte| byte >> (n % 8) & 1 != 0);
            if let Some(byte) = input_bits.get_mut(n / 8).filter(|_| is_on) {
                *byte |= 1 << (n % 8);
            }
        }
        for (input, output) in input_words.chunks_exact_mut(2).zip(words.chunks_exact(2)) {
            input.copy_from_slice(output);
        }
    }

    fn trim(&self, outputs: &mut [u8]) {
        let bits = self.outputs.digital % 8;
        let last = self.outputs.digital_bytes().checked_sub(1);
        if let Some(byte) = last.and_then(|last| outputs.get_mut(last)).filter(|_| bits > 0) {
            *byte &= (1 << bits) - 1;
        }
    }

    fn sense(&self, levels: &[u8], inputs: &mut [u8]) {
        for n in 0..usize::from(self.inputs.digital) {
            let is_on = levels.get(n / 8).is_some_and(|byte| byte >> (n % 8) & 1 != 0);
            if let Some(byte) = inputs.get_mut(n / 8) {
                *byte = *byte & !(1 << (n % 8)) | u8::from(is_on) << (n % 8);
            }
        }
    }

    fn check_sizes(&self, outputs: usize, inputs: usize) -> Result<(), u16> {
        if outputs != self.outputs.bytes() {
            return Err(code::OUTPUTS);
        }
        if inputs == self.inputs.bytes() { Ok(()) } else { Err(code::INPUTS) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDENTITY: Identity = Identity { vendor: 2, product: 0x044C_2C52, revision: 1 };

    fn coupler() -> Coupler {
        let terminals = |digital, analogue| Terminals { digital, analogue };
        Coupler { outputs: terminals(12, 2), inputs: terminals(10, 1) }
    }

    #[test]
    fn its_image_has_bits_and_then_words() {
        let coupler = coupler();
        let wrong = [(5, 4), (6, 5), (6, 4)].map(|(outputs, inputs)| coupler.check_sizes(outputs, inputs));
        assert_eq!(wrong, [Err(0x001D), Err(0x001E), Ok(())]);
        let managers: Vec<_> = coupler.managers().iter().map(|manager| manager.to_bytes()).collect();
        assert_eq!(managers, [[0x00, 0x10, 6, 0, 0x64, 0, 1, 0], [0x00, 0x11, 4, 0, 0x20, 0, 1, 0]]);
        let contents = coupler.contents("EK", IDENTITY);
        assert_eq!(contents.fmmus, [1, 2]);
        assert_eq!((contents.outputs.len(), contents.inputs.len()), (2, 2));
        let words = Pdo { index: 0x1A01, entries: vec![(Object::new(0x6010, 1), 16)] };
        assert_eq!(contents.inputs[1], (words, 1));
        assert!(Coupler::default().managers().is_empty());
        let full = Terminals { digital: 255, analogue: 255 };
        assert_eq!(full.bytes(), 32 + 510);
    }

    #[test]
    fn inputs_follow_the_outputs_with_their_number() {
        let mut coupler = coupler();
        let mut inputs = [0xEE; 4];
        coupler.process(Time(0), &[0xA5, 0xFF, 0x34, 0x12, 0x78, 0x56], &mut inputs);
        assert_eq!(inputs, [0xA5, 0x03, 0x34, 0x12], "bits that no terminal has stay off");
        coupler.process(Time(0), &[], &mut inputs);
        assert_eq!(inputs, [0; 4], "no outputs count");
        coupler.process(Time(0), &[1], &mut []);
    }
}
