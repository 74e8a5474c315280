//! The link layer.

use super::super::fc::FunctionCode;
use super::super::sap::Service;
use super::super::telegram::{Malformed, token};
use super::*;

/// The reply of a slave to a request.
fn reply_to(request: Head, fc: u8) -> Head {
    Head { da: request.sa, sa: request.da, dsap: request.ssap, ssap: request.dsap, fc: FunctionCode(fc) }
}

#[test]
fn pyprofibus_fdl_status_token_and_a_diagnosis_as_sd2_and_sd3() {
    let request = Service::FdlStatus.head(SLAVE, MASTER, true, true);
    golden("10 07 02 49 52 16", request, &[]);
    golden("10 02 07 00 09 16", reply_to(request, 0x00), &[]);
    assert_eq!(token(MASTER, MASTER).to_vec(), hex("DC 02 02"));
    let read = Next::Telegram { telegram: Telegram::Token { da: MASTER, sa: MASTER }, size: 3 };
    assert_eq!(Next::parse(&token(MASTER, MASTER)), read);
    // Eight bytes are the same as SD2 and SD3.
    let head = reply_to(Service::SlaveDiag.head(SLAVE, MASTER, true, false), 0x08);
    let data = hex("02 05 00 FF 00 82");
    golden("68 0B 0B 68 82 87 08 3E 3C 02 05 00 FF 00 82 13 16", head, &data);
    let sd3 = hex("A2 82 87 08 3E 3C 02 05 00 FF 00 82 13 16");
    assert_eq!(frame(&sd3), Frame { head, data: &data });
}

#[test]
fn each_broken_byte_has_its_name() {
    let good = hex("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16");
    for (at, value, why, drop) in [
        // Up to the second 68.
        (0, 0x00, Malformed::Start, 3),
        (2, 8, Malformed::Length, 1),
        (3, 0x69, Malformed::Length, 1),
        (9, 2, Malformed::Check, 13),
        (11, 0x40, Malformed::Check, 13),
        (12, 0x17, Malformed::End, 13),
    ] {
        let mut bytes = good.clone();
        bytes[at] = value;
        assert_eq!(Next::parse(&bytes), Next::Malformed { why, drop }, "{at}");
    }
    for length in [0, 3, 250, 255] {
        let mut bytes = good.clone();
        bytes[1..3].fill(length);
        assert_eq!(Next::parse(&bytes), Next::Malformed { why: Malformed::Length, drop: 1 }, "{length}");
    }
    for bit in 0..8 * good.len() {
        let mut bytes = good.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        assert!(matches!(Next::parse(&bytes), Next::Malformed { .. }), "bit {bit}");
    }
    // Access points that the telegram has no room for, and a token that cannot have one.
    for text in ["10 87 02 49 D2 16", "68 04 04 68 87 82 6D 3C B2 16", "DC 82 02"] {
        let bytes = hex(text);
        let drop = bytes.len();
        assert_eq!(Next::parse(&bytes), Next::Malformed { why: Malformed::Length, drop }, "{text}");
    }
}

/// That all that fits is sent, and nothing more, is of the fuzz target `profibus_wire`.
#[test]
fn missing_bytes_of_a_telegram_are_counted() {
    for service in [Service::DataExchange, Service::SetPrm] {
        let whole = emitted(|out| service.head(SLAVE, MASTER, false, true).emit(&[1, 2, 3], out));
        for size in 1..whole.len() {
            match Next::parse(&whole[..size]) {
                Next::Incomplete { at_least } if size < 4 => assert!(size + at_least <= whole.len()),
                Next::Incomplete { at_least } => assert_eq!(size + at_least, whole.len()),
                other => panic!("{other:?}"),
            }
        }
    }
}
