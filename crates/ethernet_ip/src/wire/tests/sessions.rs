//! Sessions, and the opening and closing of connections.

use super::super::cip;
use super::super::connection::{ConnectionError, Opened, closed, forward_close, timeout_factor};
use super::super::cpf::{self, Items, item};
use super::super::encapsulation::{self, Connected, HEADER, Identity, Listed, Malformed, Unconnected};
use super::*;

#[test]
fn a_size_that_the_small_form_of_an_opening_cannot_say_makes_it_large() {
    let service = |size| {
        let outgoing = Direction { size, ..owner().outgoing };
        ForwardOpen { outgoing, ..owner() }.message()[0]
    };
    assert_eq!((service(511), service(512)), (0x54, 0x5B));
    assert_eq!((timeout_factor(0), timeout_factor(7), timeout_factor(255)), (4, 512, 512));
}

#[test]
fn paths_are_those_of_the_sheet_in_an_opening_and_without_data_in_a_close() {
    // tshark
    let golden = hex("4E 02 20 06 24 01 0A 0E 01 00 34 12 EE FF C0 00 04 00 20 04 24 66 2C 70 2C 65");
    assert_eq!(forward_close(TRIAD, owner().target), golden);
    let (key, any) = (Key { vendor: 60, product_code: 3 }, Key::default());
    for (access, version, data, key, golden) in [
        (Access::Owner, Version::V2, &[0, 0][..], any, "06 20 04 24 66 2C 70 2C 65 80 01 00 00"),
        // Half a word is filled up.
        (Access::Owner, Version::V2, &[1, 2, 3], any, "07 20 04 24 66 2C 70 2C 65 80 02 01 02 03 00"),
        (Access::InputOnly, Version::V1, &[], any, "04 20 04 24 66 2C 67 2C 64"),
        (Access::ListenOnly, Version::V2, &[], any, "04 20 04 24 66 2C 68 2C 65"),
        (Access::Owner, Version::V2, &[], key, "09 34 04 3C 00 00 00 03 00 00 00 20 04 24 66 2C 70 2C 65"),
    ] {
        let target = Target::Assemblies { access, version };
        let open = ForwardOpen { target, configuration: data, key, ..owner() };
        assert_eq!(open.message()[41..], hex(golden), "{golden}");
    }
    // The longest that is taken, and one more.
    let longest = [7; cip::DATA_MAX + 1];
    let open = |configuration| ForwardOpen { configuration, key, ..owner() }.message();
    assert_eq!(open(&longest), open(&longest[1..]));
    let open = open(&longest);
    assert_eq!(usize::from(open[41]) * 2, open.len() - 42);
    // Segments have 16 bits only where 8 do not do.
    let path =
        [Segment::Class(0xFF), Segment::Instance(0x100), Segment::Attribute(0xABCD), Segment::Point(1)];
    let request = cip::request(0x0E, &path, &[9]);
    assert_eq!(request, hex("0E 06 20 FF 25 00 00 01 31 00 CD AB 2C 01 09"));
}

/// tshark: the reply to the opening.
const OPENED: &str =
    "D4 00 00 00 13 00 01 5A 01 00 01 00 01 00 34 12 EE FF C0 00 10 27 00 00 10 27 00 00 00 00";

#[test]
fn tshark_reply_to_forward_open() {
    let golden = hex(OPENED);
    let opened = Opened {
        outgoing_id: OUTGOING_ID,
        incoming_id: INCOMING_ID,
        outgoing_api_us: 10_000,
        incoming_api_us: 10_000,
    };
    assert_eq!(Opened::parse(&reply(&golden), TRIAD), Ok(opened));
    for other in
        [Triad { serial: 2, ..TRIAD }, Triad { vendor: 1, ..TRIAD }, Triad { originator: 1, ..TRIAD }]
    {
        assert_eq!(Opened::parse(&reply(&golden), other), Err(ConnectionError::Other));
    }
    // Each interval of 0, each shorter answer, an answer to something else.
    for interval in [20, 24] {
        let mut never = golden.clone();
        never[interval..interval + 4].fill(0);
        assert_eq!(Opened::parse(&reply(&never), TRIAD), Err(ConnectionError::Interval));
    }
    for size in 4..28 {
        assert_eq!(Opened::parse(&reply(&golden[..size]), TRIAD), Err(ConnectionError::Short), "{size}");
    }
    assert_eq!(closed(&reply(&golden), TRIAD), Err(ConnectionError::Other));
    let mut other = golden.clone();
    other[0] = 0x8E;
    assert_eq!(Opened::parse(&reply(&other), TRIAD), Err(ConnectionError::Other));
}

#[test]
fn a_refusal_says_what_the_drive_wants() {
    let refused = |general, extended, size| ConnectionError::Refused(Status { general, extended, size });
    let size = "D4 00 01 02 27 01 46 00 01 00 34 12 EE FF C0 00 00 00";
    let other = Triad { serial: 7, ..TRIAD };
    for (text, triad, expected) in [
        (size, TRIAD, Err(refused(1, Some(0x127), Some(70)))),
        // Some devices leave the triad out; that of another request is not ours.
        ("DB 00 01 01 06 01", TRIAD, Err(refused(1, Some(0x106), None))),
        (size, other, Err(ConnectionError::Other)),
    ] {
        assert_eq!(Opened::parse(&reply(&hex(text)), triad), expected, "{text}");
    }
    let status = Status { general: 1, extended: Some(0x127), size: Some(70) };
    assert_eq!(status.failure(), Some(Status::OUTGOING_SIZE));
    let said = refused(1, Some(0x127), Some(70)).to_string();
    assert_eq!(said, "wrong O->T size (0x0127): the drive wants 70 bytes");
    let end = "CE 00 00 00 01 00 34 12 EE FF C0 00 00 00";
    for (text, triad, expected) in [
        ("CE 00 01 01 07 01 01 00 34 12 EE FF C0 00 00 00", TRIAD, Err(refused(1, Some(0x107), None))),
        (end, TRIAD, Ok(())),
        (end, other, Err(ConnectionError::Other)),
        (&end[..32], TRIAD, Err(ConnectionError::Short)),
    ] {
        assert_eq!(closed(&reply(&hex(text)), triad), expected, "{text}");
    }
}

#[test]
fn status_sentences() {
    for (general, extended, size, sentence) in [
        (0, None, None, "ok (0x00)"),
        (8, None, None, "service not supported (0x08)"),
        (1, Some(0x106), None, "somebody else owns the outputs (0x0106)"),
        (1, Some(0x128), Some(58), "wrong T->O size (0x0128): the drive wants 58 bytes"),
        (
            1,
            Some(0x126),
            Some(1),
            "wrong size of the configuration data (0x0126), whose 16-bit words are at most 1",
        ),
        (1, Some(0x7777), None, "connection failure (0x01, extended 0x7777)"),
        // An extended status has its names with the general status 1 only.
        (0x1F, Some(0x106), None, "error of the vendor's own (0x1f, extended 0x0106)"),
        (0xD0, None, None, "unknown status (0xd0)"),
    ] {
        assert_eq!(Status { general, extended, size }.to_string(), sentence);
    }
    assert_eq!(encapsulation::Status::NO_SESSION.to_string(), "invalid session handle (0x0064)");
    assert_eq!(encapsulation::Status(0x77).to_string(), "unknown encapsulation status (0x0077)");
}

#[test]
fn additional_status_is_skipped_before_the_data() {
    let answer = hex("8E 00 06 03 01 00 02 00 03 00 AA BB");
    let status = Status { general: 6, extended: Some(1), size: Some(2) };
    assert_eq!(Reply::parse(&answer), Some(Reply { service: 0x0E, status, data: &[0xAA, 0xBB] }));
    // Fewer words than announced, a request, less than a header.
    assert_eq!(Reply::parse(&answer[..9]), None);
    assert_eq!(Reply::parse(&hex("0E 00 00 00")), None);
    assert_eq!(Reply::parse(&answer[..3]), None);
}

#[test]
fn opener_list_identity() {
    let request = with(|out| encapsulation::list_identity(out, 500));
    assert_eq!(request, hex("63 00 00 00 00 00 00 00 00 00 00 00 F4 01 00 00 00 00 00 00 00 00 00 00"));
    let mut golden = hex(
        "01 00 0C 00 2B 00 01 00 | 00 02 AF 12 AC 1C 01 03 00 00 00 00 00 00 00 00 | 01 00 0C 00 E9 FD 02 03 \
         60 00 15 CD 5B 07 09",
    );
    golden.extend(b"OpENer PC\0");
    let identity = Identity {
        vendor: 1,
        device_type: 12,
        product_code: 65001,
        revision: (2, 3),
        status: 0x60,
        serial: 123_456_789,
        name: "OpENer PC".into(),
    };
    let address = SocketAddrV4::new(Ipv4Addr::new(172, 28, 1, 3), 44_818);
    assert_eq!(Listed::parse(&golden), Some(Listed { address, identity: identity.clone(), state: 0 }));
    assert_eq!(Identity::parse(&golden[24..]), Some(identity));
    // A name that passes the item, though not the datagram.
    let mut lying = golden.clone();
    lying[4] -= 1;
    assert_eq!(Listed::parse(&lying), None);
    for size in 0..golden.len() {
        assert_eq!(Listed::parse(&golden[..size]), None, "{size}");
    }
}

#[test]
fn socket_addresses_are_big_endian_and_in_any_order() {
    let group = SocketAddrV4::new(Ipv4Addr::new(239, 192, 1, 64), 2222);
    assert_eq!(cpf::socket_address(group)[..8], hex("00 02 08 AE EF C0 01 40"));
    assert_eq!(cpf::parse_socket_address(&cpf::socket_address(group)), Some(group));
    let own = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 2222);
    let data = with(|out| {
        out.extend(hex("00 00 00 00 00 00 05 00"));
        cpf::put(out, item::INCOMING_ADDRESS, &cpf::socket_address(group));
        cpf::put(out, 0x1234, &[1, 2, 3]);
        cpf::put(out, item::OUTGOING_ADDRESS, &cpf::socket_address(own));
        cpf::put(out, item::NULL, &[]);
        cpf::put(out, item::UNCONNECTED_DATA, &[0xD4]);
    });
    let expected = Unconnected { message: &[0xD4], outgoing: Some(own), incoming: Some(group) };
    assert_eq!(Unconnected::parse(&data), Some(expected));
    // Another family, and half an address, are none.
    for (at, byte) in [(13, 10), (10, 12)] {
        let mut other = data.clone();
        other[at] = byte;
        assert_eq!(Unconnected::parse(&other).and_then(|message| message.incoming), None);
    }
    // The interface is CIP; an unconnected message is none on a connection, and the reverse.
    let mut other = data.clone();
    other[0] = 1;
    assert_eq!((Unconnected::parse(&other), Connected::parse(&data)), (None, None));
    let connected = with(|out| encapsulation::send_unit_data(out, SESSION, 7, 1, &[0x54]));
    assert_eq!(Unconnected::parse(whole(&connected).data), None);
    // Our request names a port with the same item.
    let request = with(|out| encapsulation::send_rr_data(out, SESSION, 1, &[0x54], Some(own)));
    let message = Unconnected { message: &[0x54], outgoing: None, incoming: Some(own) };
    assert_eq!(Unconnected::parse(whole(&request).data), Some(message));
}

#[test]
fn a_wrong_count_or_length_of_items_is_refused() {
    let data = with(|out| {
        out.extend([2, 0]);
        cpf::put(out, 1, &[1, 2]);
        cpf::put(out, 2, &[3]);
    });
    let kinds = |data: &[u8]| Some(Items::parse(data)?.map(|item| item.kind).collect::<Vec<_>>());
    assert_eq!(kinds(&data), Some(vec![1, 2]));
    let changed = |at: usize, byte| {
        let mut data = data.clone();
        data[at] = byte;
        kinds(&data)
    };
    for (at, byte) in [(0, 3), (1, 0xFF), (4, 9), (10, 2)] {
        assert_eq!(changed(at, byte), None, "{at}");
    }
    // Fewer items than there are: the others do not count.
    assert_eq!((changed(0, 1), changed(0, 0)), (Some(vec![1]), Some(vec![])));
}

#[test]
fn a_foreign_stream_is_known_by_its_first_bytes() {
    assert_eq!(Frame::next(b"HT"), Err(Malformed::Command(0x5448)));
    assert_eq!(Frame::next(&[0x6F, 0, 1, 0x10]), Err(Malformed::Length(4097)));
    assert_eq!(Frame::next(&[0x6F, 0, 0, 0x10]), Ok(None));
    assert_eq!(Frame::next(&[0x6F]), Ok(None));
    // A datagram is one message, whole.
    let mut one = with(|out| encapsulation::list_identity(out, 0));
    assert!(Frame::datagram(&one).is_some());
    assert_eq!(Frame::datagram(&one[..HEADER - 1]), None);
    one.push(0);
    assert_eq!(Frame::datagram(&one), None);
}
