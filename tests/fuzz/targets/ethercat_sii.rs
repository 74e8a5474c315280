//! The SII of a slave as the reader of a bring-up meets it: answers of any content, and lost ones.
//!
//! Whatever comes, the reading ends: each answer that is not lost and not busy brings it closer. What it requests are
//! the registers of the SII, and nothing else.

use fieldbeat_ethercat::sii::{Managers, Reader, Reading};
use fieldbeat_ethercat::slot::{Answer, Ask};
use fieldbeat_ethercat::wire::frame::Command;
use fieldbeat_ethercat::wire::registers::address;

use super::input::Input;

/// Looks at a busy SII until the command is repeated.
const LOOKS: u16 = 3;
/// More answers than the largest SII takes: its categories, with all words of their SyncManagers, each with its
/// repetitions.
const MOST: usize = 20_000;
const STATION: u16 = 0x1001;

pub fn ethercat_sii(data: &[u8]) {
    let mut input = Input(data);
    let mut reader = Reader::new(Managers::default(), LOOKS);
    // The word that was requested last, as a slave shows it.
    let mut shown = [0; 4];
    for _ in 0..MOST {
        let mut ask = Ask::default();
        reader.request(
            |register| Command::Fprd(STATION, register),
            |register| Command::Fpwr(STATION, register),
            &mut ask,
        );
        let mut reply = Vec::new();
        for (command, bytes) in ask.datagrams() {
            let (Command::Fprd(STATION, register) | Command::Fpwr(STATION, register)) = command else {
                panic!("{command:?}")
            };
            let end = usize::from(register) + bytes.len();
            assert!(register >= address::SII_CONTROL && end <= usize::from(address::SII_DATA) + 8);
            if let Some(word) = bytes.get(2..6).filter(|_| matches!(command, Command::Fpwr(..))) {
                shown.copy_from_slice(word);
            }
            reply = bytes.to_vec();
        }
        assert!(!ask.is_empty(), "it has something to request until its end");
        // Of an input that is over nothing is lost, and no EEPROM is busy for ever.
        let kind = input.byte() % 8;
        if kind == 1 && !input.is_over() {
            let _ = reader.receive(&[None, None]);
            continue;
        }
        let is_read = reply.len() > 6;
        if is_read {
            let bytes = input.bytes(8);
            reply.fill(0);
            reply[2..6].copy_from_slice(&shown);
            let end = reply.len().min(6 + bytes.len());
            reply[6..end].copy_from_slice(&bytes[..end - 6]);
            match kind {
                2 => reply[..2].copy_from_slice(&[input.byte(), input.byte()]),
                3 => reply[1] = 0x80,
                4 => reply[2] ^= input.byte(),
                5 => reply.truncate(input.below(15)),
                6 => reply[0] = 0x40,
                _ => {}
            }
        }
        let answer = Answer { working_counter: u16::from(kind != 7), data: &reply };
        match reader.receive(&[Some(answer), None]) {
            Reading::Busy | Reading::On => {}
            // Read, or given up.
            _ => return,
        }
    }
    panic!("it never ends: {reader:?}");
}
