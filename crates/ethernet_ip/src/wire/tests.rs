//! Golden frames, each with its source.
//!
//! | source | what |
//! |---|---|
//! | tshark | frames that it decodes without complaint: vendor 0x1234, serial 0x00C0FFEE, session 0x101 |
//! | OpENer | what this adapter was seen to send |
//! | HCR | the examples of the Host Command Reference 920-0002 W |

use std::net::{Ipv4Addr, SocketAddrV4};

use super::cip::{Key, Reply, Segment, Status};
use super::connection::{Delivery, Direction, ForwardOpen, Target, Triad};
use super::encapsulation::Frame;
use crate::{Access, Version};

mod drive;
mod packets;
mod sessions;

const TRIAD: Triad = Triad { serial: 1, vendor: 0x1234, originator: 0x00C0_FFEE };
const SESSION: u32 = 0x101;
const OUTGOING_ID: u32 = 0x5A01_0013;
const INCOMING_ID: u32 = 0x0001_0001;

/// Bytes as they are printed; `|` is for the reader.
pub(crate) fn hex(text: &str) -> Vec<u8> {
    text.split([' ', '|', '\n'])
        .filter(|byte| !byte.is_empty())
        .map(|byte| u8::from_str_radix(byte, 16).expect(byte))
        .collect()
}

fn with(fill: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    // What is in the buffer before stays there.
    let mut out = vec![0xEE; 3];
    fill(&mut out);
    assert_eq!(out[..3], [0xEE; 3]);
    out.split_off(3)
}

/// The opening of an exclusive owner, 10 ms, 16 intervals.
fn owner() -> ForwardOpen<'static> {
    let direction = |size| Direction { rpi_us: 10_000, size, delivery: Delivery::PointToPoint };
    ForwardOpen {
        incoming_id: INCOMING_ID,
        triad: TRIAD,
        multiplier: 2,
        outgoing: direction(super::io::OWNER_SIZE),
        incoming: direction(super::connection::incoming_size(Version::V2)),
        key: Key::default(),
        target: Target::Assemblies { access: Access::Owner, version: Version::V2 },
        configuration: &[],
        large: false,
    }
}

fn whole(bytes: &[u8]) -> Frame<'_> {
    let (frame, used) = Frame::next(bytes).expect("well-formed").expect("complete");
    assert_eq!(used, bytes.len());
    frame
}

fn reply(bytes: &[u8]) -> Reply<'_> {
    Reply::parse(bytes).expect("a reply")
}
