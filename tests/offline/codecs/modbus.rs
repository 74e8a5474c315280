//! Modbus TCP of a Unidrive: requests of the master as the drive reads them, answers of the drive as the master reads
//! them, addresses, and the numbers of both; the parameters of the drive against the catalogue, over the wire.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat_core::time::Time;
use fieldbeat_modbus::parameter::catalogue::{self, Access};
use fieldbeat_modbus::parameter::{self, Addressing, Parameter, Width};
use fieldbeat_modbus::trips::Trip;
use fieldbeat_modbus::wire::{
    self, ExceptionCode, Header, Registers, Request, RequestError, RequestFault, Response,
};
use fieldbeat_modbus::words::{ControlWord, StatusWord};
use fieldbeat_sim::SimDrive;
use fieldbeat_sim::modbus::codec::{self, Exception, control, function, status, trip};
use fieldbeat_sim::modbus::{UnidriveSettings, UnidriveSim};
use proptest::prelude::*;

/// Whole registers, up to so many.
fn registers(most: usize) -> impl Strategy<Value = Vec<u8>> {
    prop::collection::vec(any::<[u8; 2]>(), 0..=most).prop_map(|registers| registers.concat())
}

/// The request of the master, as the drive reads it.
fn to_drive<'a>(request: &Request<'a>) -> codec::Request<'a> {
    match *request {
        Request::Read { address, count } => codec::Request::Read { address, count },
        Request::WriteOne { address, value } => {
            codec::Request::WriteOne { address, value: value.to_be_bytes() }
        }
        Request::Write { address, data } => codec::Request::Write { address, data: data.bytes() },
        Request::ReadWrite { read, count, write, data } => {
            codec::Request::ReadWrite { read, count, write, data: data.bytes() }
        }
    }
}

proptest! {
    #[test]
    fn a_request_of_the_master_is_the_same_to_the_drive(
        (transaction, unit) in any::<(u16, u8)>(),
        [first, second, third] in any::<[u16; 3]>(),
        data in registers(120),
    ) {
        let data = Registers::new(&data).unwrap();
        for request in [
            Request::Read { address: first, count: second },
            Request::WriteOne { address: first, value: second },
            Request::Write { address: first, data },
            Request::ReadWrite { read: first, count: second, write: third, data },
        ] {
            let mut bytes = [0; wire::ADU_MAX + 20];
            let size = request.emit(Header { transaction, unit }, &mut bytes);
            prop_assert_eq!(codec::message(&bytes[..size + 20]), Ok(Some(size)));
            prop_assert_eq!(codec::message(&bytes[..size - 1]), Ok(None));
            let (header, content) = codec::request(&bytes[..size]).unwrap();
            prop_assert_eq!(header, codec::Header { transaction, unit, function: request.function() });
            prop_assert_eq!(content, to_drive(&request));
        }
    }

    #[test]
    fn any_bytes_are_a_message_and_a_request_to_both_or_to_none(
        protocol in prop_oneof![9 => Just(0_u16), 1 => any::<u16>()],
        function in prop_oneof![Just(3_u8), Just(6), Just(16), Just(23), any::<u8>()],
        head in prop::collection::vec(0..12_u8, 0..12),
        data in prop::collection::vec(any::<u8>(), 0..30),
        more in -3_i32..4,
    ) {
        let length = (2 + head.len() + data.len()) as i32 + more;
        let mut bytes = vec![0, 42];
        bytes.extend(protocol.to_be_bytes());
        bytes.extend((length as u16).to_be_bytes());
        bytes.extend([255, function]);
        bytes.extend(&head);
        bytes.extend(&data);
        let size = wire::frame(&bytes);
        prop_assert_eq!(codec::message(&bytes).ok(), size.ok());
        if let Ok(Some(size)) = size {
            match (Request::parse(&bytes[..size]), codec::request(&bytes[..size])) {
                (Ok((_, master)), Ok((_, drive))) => prop_assert_eq!(to_drive(&master), drive),
                (Err(RequestError { fault, .. }), Ok((_, drive))) => {
                    prop_assert_eq!((fault, drive), (RequestFault::Unsupported, codec::Request::Unsupported));
                }
                (Err(RequestError { fault, .. }), Err(_)) => prop_assert_eq!(fault, RequestFault::Malformed),
                (Ok(master), Err(_)) => prop_assert!(false, "{:?}", master),
            }
        }
    }

    #[test]
    fn an_answer_of_the_drive_is_the_same_to_the_master(
        (transaction, unit) in any::<(u16, u8)>(),
        [address, count] in any::<[u16; 2]>(),
        data in registers(120),
    ) {
        let registers = Registers::new(&data).unwrap();
        let written = codec::Response::Written { address, what: count };
        let refused = |function, code| Response::Exception { function, code };
        for (function, answer, expected) in [
            (function::READ, codec::Response::Data(&data), Response::Read { data: registers }),
            (function::WRITE_ONE, written, Response::WriteOne { address, value: count }),
            (function::WRITE, written, Response::Written { address, count }),
            (function::READ_WRITE, codec::Response::Data(&data), Response::ReadWritten { data: registers }),
            (3, codec::Response::Exception(Exception::Address), refused(3, ExceptionCode::ADDRESS)),
            (16, codec::Response::Exception(Exception::Function), refused(16, ExceptionCode::FUNCTION)),
        ] {
            let mut bytes = Vec::new();
            codec::respond(codec::Header { transaction, unit, function }, answer, &mut bytes);
            prop_assert_eq!(wire::frame(&bytes), Ok(Some(bytes.len())));
            prop_assert_eq!(Response::parse(&bytes), Ok((Header { transaction, unit }, expected)));
        }
    }
}

#[test]
fn every_address_is_the_same_parameter() {
    for (addressing, modified) in [(Addressing::Standard, false), (Addressing::Modified, true)] {
        for address in 0..=u16::MAX {
            let drive = codec::place(address, modified);
            let master = Parameter::from_address(address, addressing);
            let master =
                master.map(|(parameter, width)| (parameter.menu, parameter.number, width == Width::Long));
            assert_eq!(drive.map(|place| (place.menu, place.number, place.long)), master, "{address:04X}h");
        }
    }
}

#[test]
fn the_numbers_are_the_same() {
    assert_eq!((codec::ADU_MAX, codec::REGISTERS_MAX), (wire::ADU_MAX, wire::REGISTERS_MAX));
    assert_eq!(
        (codec::DRIVE_UNIT, codec::INTERFACE_UNIT),
        (parameter::DRIVE_UNIT, parameter::INTERFACE_UNIT)
    );
    // Drive, master.
    for (drive, master) in [
        (control::ENABLE, ControlWord::ENABLE),
        (control::RUN_FORWARD, ControlWord::RUN_FORWARD),
        (control::JOG_FORWARD, ControlWord::JOG_FORWARD),
        (control::RUN_REVERSE, ControlWord::RUN_REVERSE),
        (control::REVERSE, ControlWord::REVERSE),
        (control::RUN, ControlWord::RUN),
        (control::NOT_STOP, ControlWord::NOT_STOP),
        (control::AUTO, ControlWord::AUTO),
        (control::REMOTE, ControlWord::REMOTE),
        (control::JOG_REVERSE, ControlWord::JOG_REVERSE),
        (control::TRIP, ControlWord::TRIP),
        (control::RESET, ControlWord::RESET),
        (control::KEYPAD_WATCHDOG, ControlWord::KEYPAD_WATCHDOG),
        (control::IDLE, ControlWord::IDLE.0),
        (control::ENABLED, ControlWord::ENABLED.0),
        (control::FORWARD, ControlWord::FORWARD.0),
        (control::BACKWARD, ControlWord::BACKWARD.0),
        (control::IDLE | control::RESET, ControlWord::RESETTING.0),
        (status::HEALTHY, StatusWord::HEALTHY),
        (status::ACTIVE, StatusWord::ACTIVE),
        (status::ZERO_SPEED, StatusWord::ZERO_SPEED),
        (status::AT_MINIMUM, StatusWord::AT_MINIMUM),
        (status::BELOW_SPEED, StatusWord::BELOW_SPEED),
        (status::AT_SPEED, StatusWord::AT_SPEED),
        (status::ABOVE_SPEED, StatusWord::ABOVE_SPEED),
        (status::LOAD_REACHED, StatusWord::LOAD_REACHED),
        (status::CURRENT_LIMIT, StatusWord::CURRENT_LIMIT),
        (status::REGENERATING, StatusWord::REGENERATING),
        (status::REVERSE_COMMANDED, StatusWord::REVERSE_COMMANDED),
        (status::REVERSE_RUNNING, StatusWord::REVERSE_RUNNING),
        (trip::NONE, Trip::NONE.0),
        (trip::OVER_CURRENT, Trip::OVER_CURRENT.0),
        (trip::WATCHDOG, Trip::WATCHDOG.0),
        (trip::CONTROL_WORD, Trip::CONTROL_WORD.0),
        (trip::USER_RESET, Trip::USER_RESET),
        (trip::USER_CLEAR, Trip::USER_CLEAR),
    ] {
        assert_eq!(drive, master);
    }
    for slot in 1..=4 {
        let trip = Trip(trip::slot_error(slot));
        assert!(trip.is_of_silence() && trip.name().unwrap().starts_with(&format!("slot {slot} ")));
    }
}

/// A drive, and the answer to its next request.
struct Drive(UnidriveSim);

const CLIENT: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 40_000);

impl Drive {
    fn new() -> Drive {
        let mut drive = UnidriveSim::new(UnidriveSettings::new(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 502)));
        assert!(drive.connect(Time(0), CLIENT));
        Drive(drive)
    }

    /// Whether the answer is as `look` says.
    fn ask(&mut self, unit: u8, request: &Request<'_>, look: impl Fn(Response<'_>) -> bool) -> bool {
        let (mut bytes, mut reply) = ([0; wire::ADU_MAX], Vec::new());
        let size = request.emit(Header { transaction: 1, unit }, &mut bytes);
        self.0.receive(Time(0), CLIENT, &bytes[..size], &mut reply);
        look(Response::parse(&reply).unwrap().1)
    }

    fn has(&mut self, parameter: Parameter) -> bool {
        let address = parameter.address(Addressing::Standard, Width::Long).unwrap();
        let read = Request::Read { address, count: 2 };
        self.ask(parameter.unit(parameter::DRIVE_UNIT), &read, |answer| {
            matches!(answer, Response::Read { .. })
        })
    }

    /// Whether it takes this value.
    fn takes(&mut self, parameter: Parameter, value: i64) -> bool {
        let address = parameter.address(Addressing::Standard, Width::Long).unwrap();
        let bytes = (value as i32).to_be_bytes();
        let write = Request::Write { address, data: Registers::new(&bytes).unwrap() };
        self.ask(parameter.unit(parameter::DRIVE_UNIT), &write, |answer| {
            matches!(answer, Response::Written { count: 2, .. })
        })
    }
}

#[test]
fn the_drive_has_the_parameters_of_the_catalogue_with_their_ranges_and_no_others() {
    for known in catalogue::all() {
        let parameter = known.parameter;
        assert!(Drive::new().has(parameter), "{parameter}");
        let writable = known.access == Access::ReadWrite;
        for (value, is_valid) in
            [(known.min, writable), (known.max, writable), (known.min - 1, false), (known.max + 1, false)]
        {
            if i32::try_from(value).is_ok() {
                assert_eq!(Drive::new().takes(parameter, value), is_valid, "{parameter} = {value}");
            }
        }
        // The sign of 16 bits that are written.
        let address = parameter.address(Addressing::Standard, Width::Word).unwrap();
        let write = Request::WriteOne { address, value: 0xFFFF };
        let (mut drive, unit) = (Drive::new(), parameter.unit(parameter::DRIVE_UNIT));
        assert!(drive.ask(unit, &write, |answer| matches!(answer, Response::WriteOne { .. })));
        let expected = if known.signed { -1 } else { 0xFFFF };
        if writable && (known.min..=known.max).contains(&expected) && known.name != "modbus-timeout" {
            let address = parameter.address(Addressing::Standard, Width::Long).unwrap();
            let read = Request::Read { address, count: 2 };
            assert!(drive.ask(unit, &read, |answer| {
                matches!(answer, Response::Read { data } if data.long(0).map(i64::from) == Some(expected))
            }));
        }
    }
    let mut drive = Drive::new();
    for (menu, number) in (1..=162).flat_map(|menu| (1..100).map(move |number| (menu, number))) {
        let parameter = Parameter::new(menu, number);
        assert_eq!(drive.has(parameter), parameter.known().is_some(), "{parameter}");
    }
}
