//! Requests and replies as their blocks make them, against the codec.

use std::net::Ipv4Addr;

use super::turns::{Cyclic, Read, Turns};
use crate::mapping::{Block, Mapping, Places};
use crate::plan::{UnidriveDrive, Via};
use crate::profile::Outputs;
use crate::wire::{ADU_MAX, Header, Registers, RegistersBuffer, Request, Response, function};
use crate::words::ControlWord;
use crate::{Role, Width};

const HEADER: Header = Header { transaction: 0x1234, unit: 255 };
const OUTPUTS: Outputs = Outputs { control: ControlWord(0x8183), reference: 0x0102_0304 };

/// The usual mapping, and that of menu 0.
fn mappings() -> [Mapping; 2] {
    [Via::Direct, Via::Menu0 { first: 3 }].map(|via| {
        let drive = UnidriveDrive { via, ..UnidriveDrive::new("u", Ipv4Addr::LOCALHOST) };
        Mapping::new(&drive).unwrap()
    })
}

/// The message of the codec that writes and reads these blocks.
fn message(write: Option<&Block>, read: Option<&Block>) -> Vec<u8> {
    let mut data = RegistersBuffer::new();
    for role in write.iter().flat_map(|block| &block.roles) {
        let value = if *role == Role::Control { OUTPUTS.control.0.into() } else { OUTPUTS.reference as u32 };
        assert!(data.push_raw(write.unwrap().width, value));
    }
    let data = data.registers();
    let request = match (write, read) {
        (Some(write), Some(read)) => {
            Request::ReadWrite { read: read.address, count: read.registers, write: write.address, data }
        }
        (Some(write), None) => Request::Write { address: write.address, data },
        (None, Some(read)) => Request::Read { address: read.address, count: read.registers },
        (None, None) => unreachable!(),
    };
    let mut out = [0; ADU_MAX];
    let length = request.emit(HEADER, &mut out);
    out[..length].to_vec()
}

#[test]
fn the_request_of_any_two_blocks_equals_that_of_the_codec_over_any_earlier_bytes() {
    let mut random = fastrand::Rng::with_seed(5);
    for mapping in mappings() {
        let turns = Turns::new(mapping.clone());
        let writes = mapping.writes().iter().zip(turns.writes).map(Some).chain([None]);
        for write in writes {
            // A request has one of the two at least.
            let reads = turns.reads.iter().zip(0..).map(Some).chain(write.map(|_| None));
            for read in reads {
                let mut out = [0; ADU_MAX];
                random.fill(&mut out);
                let cyclic = Cyclic {
                    write: write.and_then(|(_, write)| write),
                    read: read.map(|(read, _)| *read),
                    confirms: false,
                };
                let length = usize::from(cyclic.emit(HEADER, OUTPUTS, &mut out));
                let block = read.map(|(_, turn)| &mapping.reads()[mapping.read_in(turn)]);
                let message = message(write.map(|(block, _)| block), block);
                assert_eq!(out[..length], *message);
                // The same with other values first.
                let is_all = mapping.reads().len() == 1 && cyclic.is_both();
                assert_eq!(turns.is_only(&cyclic), is_all);
                if is_all {
                    let others = Outputs { control: ControlWord(1), reference: -1 };
                    cyclic.emit(Header { transaction: 7, ..HEADER }, others, &mut out);
                    assert_eq!(usize::from(Cyclic::refill(HEADER.transaction, OUTPUTS, &mut out)), length);
                    assert_eq!(out[..length], *message);
                }
            }
        }
    }
}

#[test]
fn the_turns_are_those_of_the_mapping() {
    let [direct, menu_0] = mappings().map(Turns::new);
    let places = |turns: &Turns| turns.reads.iter().map(|read| read.places()).collect::<Vec<_>>();
    let of = |role| places(&direct).iter().filter(|places| places.has(role)).count();
    let roles = [Role::Status, Role::Speed, Role::Shown(0), Role::Trip, Role::Reference, Role::Control];
    assert_eq!(roles.map(of), [4, 4, 1, 1, 1, 1]);
    assert!(places(&direct)[0].has(Role::Status) && places(&direct)[1].has(Role::Speed));
    assert!(places(&menu_0).len() == 1 && places(&menu_0)[0].have(Places::FRONT));
}

#[test]
fn only_the_whole_reply_to_this_request_is_expected() {
    let [_, menu_0] = mappings();
    let read: Read = Turns::new(menu_0.clone()).reads[0];
    let count = menu_0.reads()[0].roles.len();
    let mut data = RegistersBuffer::new();
    (0..count).for_each(|value| assert!(data.push_raw(Width::Long, value as u32)));
    let data: Registers<'_> = data.registers();
    let mut bytes = [0; ADU_MAX];
    let size = Response::ReadWritten { data }.emit(HEADER, &mut bytes);
    let values = |bytes| read.values(HEADER, function::READ_WRITE, bytes);
    assert_eq!(values(&bytes[..size]), Some(data));
    assert_eq!(values(&[]), None, "nothing");
    assert_eq!(values(&bytes[..size - 1]), None, "not all of it");
    assert_eq!(values(&bytes[..size + 1]), None, "more than it");
    // Id, protocol, length, unit, function, number of bytes.
    for at in 0..Read::FRONT {
        for bit in 0..8 {
            let mut bytes = bytes;
            bytes[at] ^= 1 << bit;
            assert_eq!(
                read.values(HEADER, function::READ_WRITE, &bytes[..size]),
                None,
                "byte {at}, bit {bit}"
            );
        }
    }
}
