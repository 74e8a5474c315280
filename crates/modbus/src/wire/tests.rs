//! Golden messages. Any bytes, every split of a stream, and what is understood of it are those of the fuzz target
//! `modbus_wire`.

use super::*;

/// Transaction 42 to the drive itself, as the guides have it.
const HEADER_42: Header = Header { transaction: 42, unit: 0xFF };

/// M701 manual, page 129: function 16 writes 12345 to Pr 20.021 ... 20.023, 32 bits.
const WRITE_REQUEST: [u8; 25] = [
    0x00, 0x2A, 0x00, 0x00, 0x00, 0x13, 0xFF, 0x10, 0x47, 0xE4, 0x00, 0x06, 0x0C, 0x00, 0x00, 0x30, 0x39,
    0x00, 0x00, 0x30, 0x39, 0x00, 0x00, 0x30, 0x39,
];
const WRITE_RESPONSE: [u8; 12] = [0x00, 0x2A, 0x00, 0x00, 0x00, 0x06, 0xFF, 0x10, 0x47, 0xE4, 0x00, 0x06];

/// SI-Ethernet guide: function 23 writes the same and reads Pr 20.024 ... 20.026, 32 bits.
const READ_WRITE_REQUEST: [u8; 29] = [
    0x00, 0x2A, 0x00, 0x00, 0x00, 0x17, 0xFF, 0x17, 0x47, 0xE7, 0x00, 0x06, 0x47, 0xE4, 0x00, 0x06, 0x0C,
    0x00, 0x00, 0x30, 0x39, 0x00, 0x00, 0x30, 0x39, 0x00, 0x00, 0x30, 0x39,
];
/// The response, with 1, -2 and 15000 as what is read.
const READ_WRITE_RESPONSE: [u8; 21] = [
    0x00, 0x2A, 0x00, 0x00, 0x00, 0x0F, 0xFF, 0x17, 0x0C, 0x00, 0x00, 0x00, 0x01, 0xFF, 0xFF, 0xFF, 0xFE,
    0x00, 0x00, 0x3A, 0x98,
];

/// Modbus Application Protocol v1.1b3, 6.3 and 6.6, behind a header: three registers are read, one is written, and
/// answered by the same.
const HEADER_1: Header = Header { transaction: 1, unit: 0xFF };
const READ_REQUEST: [u8; 12] = [0, 1, 0, 0, 0, 6, 0xFF, 3, 0x00, 0x6B, 0x00, 0x03];
const READ_RESPONSE: [u8; 15] = [0, 1, 0, 0, 0, 9, 0xFF, 3, 6, 0x02, 0x2B, 0x00, 0x00, 0x00, 0x64];
const WRITE_ONE: [u8; 12] = [0, 1, 0, 0, 0, 6, 0xFF, 6, 0x00, 0x01, 0x00, 0x03];

/// SI-Ethernet guide: an exception.
const EXCEPTION: [u8; 9] = [0x00, 0x2A, 0x00, 0x00, 0x00, 0x03, 0xFF, 0x90, 0x02];

/// The answer of pymodbus 3.16.1 to a PDU that it cannot read.
const PYMODBUS_EXCEPTION: [u8; 9] = [0x00, 0x2A, 0x00, 0x00, 0x00, 0x03, 0xFF, 0x80, 0x01];

fn longs(values: &[i32]) -> RegistersBuffer {
    let mut buffer = RegistersBuffer::new();
    assert!(values.iter().all(|value| buffer.push_long(*value)));
    buffer
}

fn emitted(request: &Request<'_>, header: Header) -> Vec<u8> {
    written(request.size(), |out| request.emit(header, out))
}

fn answered(response: &Response<'_>, header: Header) -> Vec<u8> {
    written(response.size(), |out| response.emit(header, out))
}

/// The bytes that `emit` wrote.
fn written(size: usize, emit: impl Fn(&mut [u8]) -> usize) -> Vec<u8> {
    let mut bytes = [0xEE; ADU_MAX];
    assert_eq!(emit(&mut bytes), size);
    bytes[..size].to_vec()
}

/// One of each.
fn requests(data: Registers<'_>) -> [Request<'_>; 4] {
    [
        Request::Read { address: 0x412D, count: 2 },
        Request::WriteOne { address: 0x0281, value: 0x0183 },
        Request::Write { address: 0x47E4, data },
        Request::ReadWrite { read: 0x400A, count: 8, write: 0x4000, data },
    ]
}

/// One of each.
fn responses(data: Registers<'_>) -> [Response<'_>; 5] {
    [
        Response::Read { data },
        Response::WriteOne { address: 0x0281, value: 0x0183 },
        Response::Written { address: 0x47E4, count: 6 },
        Response::ReadWritten { data },
        Response::Exception { function: function::READ, code: ExceptionCode::ADDRESS },
    ]
}

#[test]
fn golden_messages() {
    let (written, read) = (longs(&[12345; 3]), longs(&[1, -2, 15000]));
    let (data, read) = (written.registers(), read.registers());
    for (golden, header, request) in [
        (&WRITE_REQUEST[..], HEADER_42, Request::Write { address: 0x47E4, data }),
        (&READ_WRITE_REQUEST, HEADER_42, Request::ReadWrite { read: 0x47E7, count: 6, write: 0x47E4, data }),
        (&READ_REQUEST, HEADER_1, Request::Read { address: 0x006B, count: 3 }),
        (&WRITE_ONE, HEADER_1, Request::WriteOne { address: 1, value: 3 }),
    ] {
        assert_eq!(emitted(&request, header), golden);
        assert_eq!(Request::parse(golden), Ok((header, request)));
    }
    let three = Registers::new(&READ_RESPONSE[9..]).unwrap();
    let exception = |function, code| Response::Exception { function, code };
    for (golden, header, response) in [
        (&WRITE_RESPONSE[..], HEADER_42, Response::Written { address: 0x47E4, count: 6 }),
        (&READ_WRITE_RESPONSE, HEADER_42, Response::ReadWritten { data: read }),
        (&READ_RESPONSE, HEADER_1, Response::Read { data: three }),
        (&WRITE_ONE, HEADER_1, Response::WriteOne { address: 1, value: 3 }),
        (&EXCEPTION, HEADER_42, exception(function::WRITE, ExceptionCode::ADDRESS)),
        // It is one even if it does not say of what.
        (&PYMODBUS_EXCEPTION, HEADER_42, exception(0, ExceptionCode::FUNCTION)),
    ] {
        assert_eq!(answered(&response, header), golden);
        assert_eq!(Response::parse(golden), Ok((header, response)));
    }
}

#[test]
fn a_stream_of_another_protocol_is_reported_as_soon_as_its_field_is_there() {
    let http = b"HTTP/1.1 400";
    assert_eq!(frame(&http[..3]), Ok(None));
    assert_eq!(frame(&http[..4]), Err(FrameError::Protocol(0x5450)));
    for (length, is_one) in
        [(0_u16, false), (1, false), (2, true), (254, true), (255, false), (0xFFFF, false)]
    {
        let [high, low] = length.to_be_bytes();
        let bytes = [0, 42, 0, 0, high, low];
        assert_eq!(frame(&bytes[..5]), Ok(None));
        let wrong = Err(FrameError::Length(length));
        assert_eq!(frame(&bytes), if is_one { Ok(None) } else { wrong }, "length {length}");
    }
}

#[test]
fn the_longest_messages_are_those_of_the_standard_and_longer_ones_are_not_written() {
    let bytes = [0x5A; 256];
    let data = |registers: usize| Registers::new(&bytes[..2 * registers]).unwrap();
    let mut out = [0; ADU_MAX + 100];
    for (registers, size) in [(120, 253), (123, 259), (124, 0)] {
        let request = Request::Write { address: 0, data: data(registers) };
        assert_eq!(request.emit(HEADER_42, &mut out), size);
        assert!(size == 0 || Request::parse(&out[..size]) == Ok((HEADER_42, request)));
    }
    for (registers, size) in [(120, 257), (121, 259), (122, 0)] {
        let request = Request::ReadWrite { read: 0, count: 120, write: 0, data: data(registers) };
        assert_eq!(request.emit(HEADER_42, &mut out), size);
        assert!(size == 0 || Request::parse(&out[..size]) == Ok((HEADER_42, request)));
    }
    for (registers, size) in [(120, 249), (125, 259), (126, 0)] {
        let response = Response::Read { data: data(registers) };
        assert_eq!(response.emit(HEADER_42, &mut out), size);
        assert!(size == 0 || Response::parse(&out[..size]) == Ok((HEADER_42, response)));
    }
}

#[test]
fn a_request_with_a_wrong_length_or_function_is_answered() {
    let error = |bytes: &[u8]| Request::parse(bytes).unwrap_err();
    // Function 4 is none of a Unidrive's.
    let other = [0, 42, 0, 0, 0, 6, 0xFF, 4, 0, 0, 0, 1];
    let expected = RequestError { header: HEADER_42, function: 4, fault: RequestFault::Unsupported };
    assert_eq!(error(&other), expected);
    // Five registers named where six are.
    let mut count = WRITE_REQUEST;
    count[11] = 5;
    let expected = RequestError { header: HEADER_42, function: 16, fault: RequestFault::Malformed };
    assert_eq!(error(&count), expected);
    // Eleven bytes named where twelve are, with either count.
    let mut bytes = READ_WRITE_REQUEST;
    bytes[16] = 11;
    assert_eq!(error(&bytes), RequestError { function: 23, ..expected });
    // Every shorter PDU of every function.
    let data = longs(&[1, 2]);
    for request in requests(data.registers()) {
        let whole = emitted(&request, HEADER_42);
        for size in 8..whole.len() {
            let mut cut = whole[..size].to_vec();
            cut[5] = (size - 6) as u8;
            assert_eq!(error(&cut), RequestError { function: request.function(), ..expected }, "{cut:x?}");
        }
    }
}

#[test]
fn a_response_with_a_wrong_length_or_function_is_rejected() {
    let data = longs(&[1, 2]);
    for response in responses(data.registers()) {
        let whole = answered(&response, HEADER_42);
        let function = response.function();
        for size in 8..whole.len() {
            let mut cut = whole[..size].to_vec();
            cut[5] = (size - 6) as u8;
            let expected = ResponseError::Length { header: HEADER_42, function };
            assert_eq!(Response::parse(&cut), Err(expected), "{cut:x?}");
        }
        // The header says more or less than there is.
        let expected = ResponseError::Frame { bytes: whole.len() - 1 };
        assert_eq!(Response::parse(&whole[..whole.len() - 1]), Err(expected));
        let mut longer = whole.clone();
        longer.push(0);
        assert_eq!(Response::parse(&longer), Err(ResponseError::Frame { bytes: whole.len() + 1 }));
    }
    // Half a register, with a byte count that agrees.
    let odd = [0, 42, 0, 0, 0, 4, 0xFF, 3, 1, 0];
    assert_eq!(Response::parse(&odd), Err(ResponseError::Length { header: HEADER_42, function: 3 }));
    let other = [0, 42, 0, 0, 0, 4, 0xFF, 4, 1, 0];
    assert_eq!(Response::parse(&other), Err(ResponseError::Function { header: HEADER_42, function: 4 }));
}

#[test]
fn a_buffer_takes_as_many_registers_as_a_drive_and_nothing_halfway() {
    let mut buffer = RegistersBuffer::new();
    assert!((0..119).all(|word| buffer.push_word(word)));
    assert!(!buffer.push_long(-1));
    assert_eq!(buffer.registers().len(), 119);
    assert!(buffer.push_word(119) && !buffer.push_word(120));
    assert!(buffer.registers().words().eq(0..REGISTERS_MAX));
    buffer.clear();
    assert!(buffer.registers().is_empty());
    assert_eq!(buffer.registers(), Registers::default());
}

#[test]
fn exceptions_have_their_names() {
    for code in [1, 2, 3, 4, 5, 6, 0x0A, 0x0B].map(ExceptionCode) {
        assert_eq!(code.to_string(), format!("exception {:02X}h {}", code.0, code.name().unwrap()));
    }
    assert_eq!(ExceptionCode(7).to_string(), "exception 07h (not in the standard)");
}
