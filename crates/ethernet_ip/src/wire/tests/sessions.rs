//! Sessions, and the opening and closing of connections.

use super::super::connection::{self, ConnectionError, Opened, closed, forward_close, timeout_factor};
use super::super::cpf::{self, Items, item};
use super::super::encapsulation::{
    self, Connected, HEADER, Identity, Listed, Malformed, Unconnected, command,
};
use super::super::{cip, message};
use super::*;

#[test]
fn tshark_forward_open_of_an_exclusive_owner() {
    let golden = hex(
        "6F 00 42 00 01 01 00 00 00 00 00 00 01 00 00 00 00 00 00 00 00 00 00 00 | 00 00 00 00 00 00 02 00 00 00 00 \
         00 B2 00 32 00 | 54 02 20 06 24 01 0A 0E 00 00 00 00 01 00 01 00 01 00 34 12 EE FF C0 00 02 00 00 00 10 27 \
         00 00 46 48 10 27 00 00 3A 48 01 04 20 04 24 66 2C 70 2C 65",
    );
    let open = with(|out| owner().emit(out));
    assert_eq!(with(|out| encapsulation::send_rr_data(out, SESSION, 1, &open, None)), golden);
    let frame = whole(&golden);
    assert_eq!((frame.header.command, frame.header.session, frame.header.context), (0x6F, SESSION, 1));
    let message = Unconnected { message: &open, outgoing: None, incoming: None };
    assert_eq!(Unconnected::parse(frame.data), Some(message));
}

#[test]
fn tshark_large_forward_open() {
    let golden = hex(
        "5B 02 20 06 24 01 0A 0E 00 00 00 00 03 00 01 00 09 00 34 12 EE FF C0 00 02 00 00 00 10 27 00 00 46 00 00 48 \
         10 27 00 00 3A 00 00 48 01 04 20 04 24 66 2C 70 2C 65",
    );
    let triad = Triad { serial: 9, ..TRIAD };
    let open = ForwardOpen { large: true, incoming_id: 0x0001_0003, triad, ..owner() };
    assert_eq!(with(|out| open.emit(out)), golden);
    // A size that the small form cannot say makes it large, and 511 does not.
    let service = |size| {
        let outgoing = Direction { size, ..open.outgoing };
        with(|out| ForwardOpen { large: false, outgoing, ..open }.emit(out))[0]
    };
    assert_eq!((service(511), service(512)), (0x54, 0x5B));
}

#[test]
fn tshark_class_3_open_and_first_transfer() {
    let golden = hex(
        "54 02 20 06 24 01 0A 0E 00 00 00 00 02 00 01 00 02 00 34 12 EE FF C0 00 03 00 00 00 40 42 0F 00 F4 43 40 42 \
         0F 00 F4 43 A3 02 20 02 24 01",
    );
    let explicit = Direction::explicit(1_000_000, 500);
    let open = ForwardOpen {
        incoming_id: 0x0001_0002,
        triad: Triad { serial: 2, ..TRIAD },
        multiplier: 3,
        outgoing: explicit,
        incoming: explicit,
        target: Target::Messages,
        ..owner()
    };
    assert_eq!(with(|out| open.emit(out)), golden);

    let golden = hex(
        "70 00 26 00 01 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 | 00 00 00 00 00 00 02 00 A1 00 04 \
         00 14 00 01 5A B1 00 12 00 01 00 3C 03 20 64 24 01 30 01 00 02 88 01 00 00 00 00",
    );
    let payload = message::Immediate::ReadAbsolute.encode();
    let request = with(|out| cip::request(out, cip::service::VENDOR, &message::PATH, &payload));
    assert_eq!(with(|out| encapsulation::send_unit_data(out, SESSION, 0x5A01_0014, 1, &request)), golden);
    let expected = Connected { connection: 0x5A01_0014, sequence: 1, message: &request };
    assert_eq!(Connected::parse(whole(&golden).data), Some(expected));
    // An unconnected message is none on a connection, and the reverse.
    assert_eq!(Unconnected::parse(whole(&golden).data), None);
    let unconnected = with(|out| encapsulation::send_rr_data(out, SESSION, 1, &request, None));
    assert_eq!(Connected::parse(whole(&unconnected).data), None);
}

#[test]
fn tshark_forward_close() {
    let golden = hex("4E 02 20 06 24 01 0A 0E 01 00 34 12 EE FF C0 00 04 00 20 04 24 66 2C 70 2C 65");
    assert_eq!(with(|out| forward_close(out, TRIAD, &owner().target)), golden);
    // The data was for the opening only.
    let configuration = Configuration::new(&[0, 0]).unwrap();
    let target = Target::assemblies(Access::Owner, Version::V2, configuration);
    assert_eq!(with(|out| forward_close(out, TRIAD, &target)), golden);
}

#[test]
fn paths_of_the_other_connections() {
    let path = |access, version, data: &'static [u8], key| {
        let target = Target::assemblies(access, version, Configuration::new(data).unwrap());
        with(|out| ForwardOpen { target, key, ..owner() }.emit(out)).split_off(41)
    };
    let owner = |data| path(Access::Owner, Version::V2, data, None);
    assert_eq!(owner(&[0, 0]), hex("06 20 04 24 66 2C 70 2C 65 80 01 00 00"));
    // Half a word is filled up.
    assert_eq!(owner(&[1, 2, 3]), hex("07 20 04 24 66 2C 70 2C 65 80 02 01 02 03 00"));
    assert_eq!(path(Access::InputOnly, Version::V1, &[], None), hex("04 20 04 24 66 2C 67 2C 64"));
    assert_eq!(path(Access::ListenOnly, Version::V2, &[], None), hex("04 20 04 24 66 2C 68 2C 65"));
    let key = Key { vendor: 60, device_type: 0x102, product_code: 3, major: 0x84, minor: 5 };
    let keyed = hex("09 34 04 3C 00 02 01 03 00 84 05 20 04 24 66 2C 70 2C 65");
    assert_eq!(path(Access::Owner, Version::V2, &[], Some(key)), keyed);
    // The longest that is taken, and one more.
    let longest = [7; Configuration::MAX + 1];
    assert_eq!(Configuration::new(&longest), None);
    let configuration = Configuration::new(&longest[1..]).unwrap();
    let target = Target::assemblies(Access::Owner, Version::V2, configuration);
    let open = with(|out| ForwardOpen { target, key: Some(key), ..super::owner() }.emit(out));
    assert_eq!(usize::from(open[41]) * 2, open.len() - 42);
}

#[test]
fn segments_have_16_bits_only_where_8_do_not_do() {
    let path =
        [Segment::Class(0xFF), Segment::Instance(0x100), Segment::Attribute(0xABCD), Segment::Point(1)];
    let request = with(|out| cip::request(out, 0x0E, &path, &[9]));
    assert_eq!(request, hex("0E 06 20 FF 25 00 00 01 31 00 CD AB 2C 01 09"));
}

#[test]
fn network_parameters() {
    // 0x4846 and 0x483A are in the golden frames; 0x283A is what a group has.
    let word = |route| {
        let incoming = Direction::cyclic(10_000, 58, route);
        let open = with(|out| ForwardOpen { incoming, ..owner() }.emit(out));
        u16::from_le_bytes([open[38], open[39]])
    };
    assert_eq!(word(Route::Multicast), 0x283A);
    assert_eq!(word(Route::PointToPoint), 0x483A);
    assert_eq!(connection::incoming_size(Version::V1), 32);
    assert_eq!((timeout_factor(0), timeout_factor(7), timeout_factor(255)), (4, 512, 512));
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
    let refusal = |text: &str, triad| Opened::parse(&reply(&hex(text)), triad);
    let size = "D4 00 01 02 27 01 46 00 01 00 34 12 EE FF C0 00 00 00";
    let status = Status { general: 1, extended: Some(0x127), size: Some(70) };
    assert_eq!(refusal(size, TRIAD), Err(ConnectionError::Refused(status)));
    assert_eq!(status.failure(), Some(Status::OUTGOING_SIZE));
    assert_eq!(
        refusal(size, TRIAD).unwrap_err().to_string(),
        "wrong O->T size (0x0127): the drive wants 70 bytes"
    );
    // Some devices leave the triad out; that of another request is not ours.
    let bare = Status { general: 1, extended: Some(0x106), size: None };
    assert_eq!(refusal("DB 00 01 01 06 01", TRIAD), Err(ConnectionError::Refused(bare)));
    assert_eq!(refusal(size, Triad { serial: 7, ..TRIAD }), Err(ConnectionError::Other));

    let gone = Status { general: 1, extended: Some(0x107), size: None };
    let answer = hex("CE 00 01 01 07 01 01 00 34 12 EE FF C0 00 00 00");
    assert_eq!(closed(&reply(&answer), TRIAD), Err(ConnectionError::Refused(gone)));
    let answer = hex("CE 00 00 00 01 00 34 12 EE FF C0 00 00 00");
    assert_eq!(closed(&reply(&answer), TRIAD), Ok(()));
    assert_eq!(closed(&reply(&answer), Triad { serial: 7, ..TRIAD }), Err(ConnectionError::Other));
    assert_eq!(closed(&reply(&answer[..11]), TRIAD), Err(ConnectionError::Short));
}

#[test]
fn status_sentences() {
    let sentence = |general, extended, size| Status { general, extended, size }.to_string();
    assert_eq!(sentence(0, None, None), "ok (0x00)");
    assert_eq!(sentence(8, None, None), "service not supported (0x08)");
    assert_eq!(sentence(1, Some(0x106), None), "somebody else owns the outputs (0x0106)");
    assert_eq!(sentence(1, Some(0x128), Some(58)), "wrong T->O size (0x0128): the drive wants 58 bytes");
    assert_eq!(
        sentence(1, Some(0x126), Some(1)),
        "wrong size of the configuration data (0x0126), whose 16-bit words are at most 1"
    );
    assert_eq!(sentence(1, Some(0x7777), None), "connection failure (0x01, extended 0x7777)");
    // An extended status has its names with the general status 1 only.
    assert_eq!(sentence(0x1F, Some(0x106), None), "error of the vendor's own (0x1f, extended 0x0106)");
    assert_eq!(sentence(0xD0, None, None), "unknown status (0xd0)");
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
fn short_commands() {
    let mut golden =
        hex("65 00 04 00 00 00 00 00 00 00 00 00 07 00 00 00 00 00 00 00 00 00 00 00 01 00 00 00");
    assert_eq!(with(|out| encapsulation::register_session(out, 7)), golden);
    // The reply: the session is in its header.
    golden[4..6].copy_from_slice(&[1, 1]);
    let header = whole(&golden).header;
    assert_eq!((header.command, header.session, header.context), (command::REGISTER_SESSION, SESSION, 7));
    assert_eq!(header.status, encapsulation::Status::OK);
    let golden = hex("66 00 00 00 01 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00");
    assert_eq!(with(|out| encapsulation::unregister_session(out, SESSION)), golden);
}

#[test]
fn opener_list_identity() {
    let request = with(|out| encapsulation::list_identity(out, 500));
    assert_eq!(request, hex("63 00 00 00 00 00 00 00 00 00 00 00 F4 01 00 00 00 00 00 00 00 00 00 00"));
    let mut golden = hex(
        "01 00 0C 00 2B 00 01 00 | 00 02 AF 12 AC 1C 01 03 00 00 00 00 00 00 00 00 | 01 00 0C 00 E9 FD 02 03 60 00 \
         15 CD 5B 07 09",
    );
    golden.extend(b"OpENer PC\0");
    let identity = Identity {
        vendor: 1,
        device_type: 12,
        product_code: 65001,
        revision: (2, 3),
        status: 0x60,
        serial: 123_456_789,
        name: b"OpENer PC",
    };
    let address = SocketAddrV4::new(Ipv4Addr::new(172, 28, 1, 3), 44_818);
    assert_eq!(Listed::parse(&golden), Some(Listed { address, identity, state: 0 }));
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
    // The interface is CIP.
    let mut other = data.clone();
    other[0] = 1;
    assert_eq!(Unconnected::parse(&other), None);
    // Ours asks for a port with the same item.
    let request = with(|out| encapsulation::send_rr_data(out, SESSION, 1, &[0x54], Some(own)));
    let message = Unconnected { message: &[0x54], outgoing: None, incoming: Some(own) };
    assert_eq!(Unconnected::parse(whole(&request).data), Some(message));
}

#[test]
fn a_count_or_length_of_items_that_lies_is_refused() {
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
    assert_eq!(changed(0, 3), None);
    assert_eq!(changed(1, 0xFF), None);
    assert_eq!(changed(4, 9), None);
    assert_eq!(changed(10, 2), None);
    // Fewer items than there are: the others do not count.
    assert_eq!(changed(0, 1), Some(vec![1]));
    assert_eq!(changed(0, 0), Some(vec![]));
}

#[test]
fn what_is_no_stream_is_known_by_its_first_bytes() {
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
