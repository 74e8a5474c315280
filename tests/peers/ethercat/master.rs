//! The crate ethercrab, a master that others wrote, on our simulated line.

use std::path::Path;

use fieldbeat::bus::ethercat::Family;

use super::dissector::{ABORT, Address, FRMW, LRW, Message, dissect, exchanges};
use super::{WIRE, cable, capture, said, segment, serve};
use crate::peer::package;
use crate::support::{Cable, Machine, Program};

fn turns_a_drive(test: u8, short_clocks: bool) {
    let (machine, cable) = (Machine::new(test), cable(test));
    let peer = package("ethercrab");
    let _line = serve(&cable, segment(Family::S700, 2, short_clocks));
    let mut ended = None;
    let file = capture(&cable, &machine, || {
        let mut command = Cable::command(&cable.master, peer.to_str().unwrap());
        ended = Some(Program::spawn(command.args([WIRE, "2", "turn"])).end());
    });
    let ended = ended.unwrap();
    ended.expect(0);
    let said = said(&ended);
    assert_eq!(said["slaves"], ["3"]);
    assert_eq!(said["identity"], ["0 0x2 0x44c2c52", "1 0x6a 0x3000600", "2 0x6a 0x3000600"]);
    assert_eq!(said["vendor"], ["1 0x6a", "2 0x6a"]);
    let bits = if short_clocks { "Bits32" } else { "Bits64" };
    assert_eq!(said["clock"], ["0 None".to_owned(), format!("1 {bits}"), format!("2 {bits}")]);
    for abort in &said["abort"] {
        assert!(abort.contains("0x5fff:1 aborted"), "{abort}");
    }
    assert_eq!(said["abort"].len(), 2);
    assert_eq!(said["state"], ["SAFEOP", "OP", "INIT"]);
    let states: Vec<u16> =
        said["status"].iter().map(|word| u16::from_str_radix(&word[2..], 16).unwrap() & 0x6F).collect();
    assert_eq!(states, [0x21, 0x23, 0x27, 0x21]);
    // Three a drive, and three of the coupler.
    assert_eq!(said["counter"], ["9"]);
    let moved: Vec<i32> = said["moved"][0].split(' ').map(|counts| counts.parse().unwrap()).collect();
    // 5000 counts per 250 us for half a second, less the ramp: about 9.5 million, and more where cycles are late. The
    // other one stays where it is.
    assert!(moved[0] > 5_000_000 && moved[1].abs() < 100, "{moved:?}");
    let still: i32 = said["still"][0].parse().unwrap();
    assert!(still.abs() < 1_000, "{still}");
    judge(&file);
}

/// What tshark sees of it.
fn judge(file: &Path) {
    let exchanges = exchanges(&dissect(file));
    let back: Vec<_> = exchanges.iter().filter_map(|(_, back)| back.as_ref()).collect();
    assert!(back.len() + 5 > exchanges.len(), "{} of {}", back.len(), exchanges.len());
    // The clock of the first drive, and the process data of all.
    let cycles: Vec<_> = back.iter().filter(|frame| frame.datagrams[0].command == FRMW).collect();
    let in_op = cycles.iter().filter(|frame| {
        let [clock, image, ..] = &frame.datagrams[..] else { return false };
        assert_eq!((clock.address, clock.length), (Address::Slave(0x1001, 0x0910), 8));
        assert_eq!((image.command, image.address, image.length), (LRW, Address::Logical(0), 30));
        (clock.working_counter, image.working_counter) == (2, 9)
    });
    assert!(in_op.count() > 150);
    let messages: Vec<&Message> = back.iter().flat_map(|frame| &frame.messages).collect();
    let vendor = Some((0x1018, 1));
    let reported = messages.iter().filter(|message| (message.service, message.object) == (3, vendor));
    assert_eq!(reported.map(|message| message.data).collect::<Vec<_>>(), [Some(0x6A); 2]);
    let aborts = messages.iter().filter(|message| (message.service, message.command) == (2, ABORT));
    assert_eq!(aborts.count(), 2);
    // What the drives' fixed PDOs are made of.
    let mapped = |object, data| {
        let reported =
            messages.iter().filter(|message| (message.service, message.object) == (3, Some(object)));
        assert!(reported.clone().count() >= 2, "{object:?}");
        assert!(reported.into_iter().all(|message| message.data == Some(data)), "{object:?}");
    };
    mapped((0x1702, 1), 0x606B_0020);
    mapped((0x1B03, 3), 0x6041_0010);
}

#[test]
#[ignore = "needs root, iproute2, tshark and a package registry: builds the crate ethercrab"]
fn a_master_of_others_brings_our_drives_to_op_and_turns_one() {
    turns_a_drive(31, false);
}

#[test]
#[ignore = "needs root, iproute2, tshark and a package registry: builds the crate ethercrab"]
fn our_master_runs_the_slaves_with_clocks_of_32_bits() {
    turns_a_drive(32, true);
}
