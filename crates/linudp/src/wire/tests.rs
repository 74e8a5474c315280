//! Golden telegrams and every combination of blocks. Any bytes and any padding, and what is understood of them, are
//! those of the fuzz target `telegram`.

use super::*;

/// LinUDP V2 manual, chapters 4.4 and 7, and two masters on real drives: status only, no block in the request.
const STATUS_REQUEST: [u8; 8] = [0, 0, 0, 0, 0x7F, 0, 0, 0];

/// The response: SW 0C37h, SV 08C3h, actual 12.3456 mm, demand 12.3450 mm, -250 mA, no warning, no error.
const STATUS_RESPONSE: [u8; 26] = [
    0x00, 0x00, 0x00, 0x00, 0x7F, 0x00, 0x00, 0x00, 0x37, 0x0C, 0xC3, 0x08, 0x40, 0xE2, 0x01, 0x00, 0x3A,
    0xE2, 0x01, 0x00, 0x06, 0xFF, 0x00, 0x00, 0x00, 0x00,
];

/// The same with control word 003Fh.
const CONTROL_REQUEST: [u8; 10] = [1, 0, 0, 0, 0x7F, 0, 0, 0, 0x3F, 0];

/// LinUDP V2 manual, 6.1: go to 10 mm with 1 m/s and 10 m/s2, count 1, behind control word 003Fh.
const GO_TO_REQUEST: [u8; 42] = [
    0x03, 0x00, 0x00, 0x00, 0xFF, 0x00, 0x00, 0x00, 0x3F, 0x00, 0x01, 0x01, 0xA0, 0x86, 0x01, 0x00, 0x40,
    0x42, 0x0F, 0x00, 0x40, 0x42, 0x0F, 0x00, 0x40, 0x42, 0x0F, 0x00, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
    0,
];

/// Read the RAM value of UPID 20A8h; the answer 1E0Fh.
const READ_REQUEST: [u8; 16] = [4, 0, 0, 0, 0, 1, 0, 0, 0x01, 0x11, 0xA8, 0x20, 0, 0, 0, 0];
const READ_RESPONSE: [u8; 16] = [4, 0, 0, 0, 0, 1, 0, 0, 0x01, 0x00, 0xA8, 0x20, 0x0F, 0x1E, 0, 0];

fn emitted(request: &Request) -> Vec<u8> {
    written(request.size(), |out| request.emit(out))
}

fn answered(response: &Response) -> Vec<u8> {
    written(response.size(), |out| response.emit(out))
}

/// The bytes that `emit` wrote.
fn written(size: usize, emit: impl Fn(&mut [u8]) -> usize) -> Vec<u8> {
    let mut bytes = [0xEE; REQUEST_MAX];
    assert_eq!(emit(&mut bytes), size);
    bytes[..size].to_vec()
}

fn full_request() -> Request {
    Request {
        reserved: RequestDef::NONE,
        response_def: ResponseDef(0x1FF),
        control: Some(ControlWord::ON),
        motion: Some(MotionBlock {
            header: 0x0101,
            parameters: std::array::from_fn(|index| index as u8 + 1),
        }),
        config: Some(RtcBlock { tag: 0x03, code: 0x13, words: [0x20A8, 0x1E0F, 0x8001] }),
    }
}

fn full_response() -> Response {
    Response {
        request_def: RequestDef(0b111),
        response_def: ResponseDef(0x1FF),
        status: Some(StatusWord(0x0C37)),
        state: Some(StateVar(0x08C3)),
        actual: Some(-123_456),
        demand: Some(i32::MIN),
        current: Some(-250),
        warn: Some(WarnWord(0x0080)),
        error: Some(ErrorCode(0x0086)),
        monitor: Some([1, 0x8000_0000, u32::MAX, 0x1234_5678]),
        config: Some(RtcBlock { tag: 0x0E, code: 0xC0, words: [1, 2, 3] }),
    }
}

#[test]
fn golden_requests() {
    let cyclic = Request { response_def: ResponseDef::CYCLIC, ..Request::default() };
    let mut parameters = [0; 30];
    parameters[..16].copy_from_slice(&GO_TO_REQUEST[12..28]);
    let go_to = Request {
        response_def: ResponseDef(0xFF),
        control: Some(ControlWord::ON),
        motion: Some(MotionBlock { header: 0x0101, parameters }),
        ..Request::default()
    };
    let read = RtcBlock { words: [0x20A8, 0, 0], ..RtcBlock::command(1, RtcCommand::READ_RAM) };
    for (what, request, golden) in [
        ("status only", cyclic, &STATUS_REQUEST[..]),
        ("a control word", Request { control: Some(ControlWord::ON), ..cyclic }, &CONTROL_REQUEST),
        ("go to 10 mm", go_to, &GO_TO_REQUEST),
        (
            "a parameter",
            Request { response_def: ResponseDef::CONFIG, config: Some(read), ..Request::default() },
            &READ_REQUEST,
        ),
    ] {
        assert_eq!(emitted(&request), golden, "{what}");
        assert_eq!(Request::parse(golden), Ok(request), "{what}");
    }
    assert_eq!(go_to.motion.unwrap().parameters[..4], 100_000_i32.to_le_bytes());
}

#[test]
fn golden_responses() {
    let response = Response {
        request_def: RequestDef::NONE,
        response_def: ResponseDef::CYCLIC,
        status: Some(StatusWord(0x0C37)),
        state: Some(StateVar(0x08C3)),
        actual: Some(123_456),
        demand: Some(123_450),
        current: Some(-250),
        warn: Some(WarnWord(0)),
        error: Some(ErrorCode::NONE),
        monitor: None,
        config: None,
    };
    assert_eq!(Response::parse(&STATUS_RESPONSE), Ok(response));
    assert_eq!(answered(&response), STATUS_RESPONSE);
    let config = Response::parse(&READ_RESPONSE).unwrap().config.unwrap();
    assert_eq!((config.count(), config.code, config.words[0], config.value()), (1, 0, 0x20A8, 0x1E0F));
}

#[test]
fn the_full_telegrams_have_the_places_of_the_manual() {
    // LinUDP V2 manual, 4.4.1: CW 8, MC 10, RTC 42, 50 bytes.
    let bytes = emitted(&full_request());
    assert_eq!(bytes.len(), 50);
    assert_eq!((&bytes[8..10], &bytes[10..12], bytes[42]), (&[0x3F, 0][..], &[1, 1][..], 3));
    // 4.4.2: SW 8, SV 10, actual 12, demand 16, current 20, warn 22, error 24, monitor 26, RTC 42, 50 bytes.
    let bytes = answered(&full_response());
    assert_eq!(bytes.len(), 50);
    assert_eq!((&bytes[10..12], &bytes[20..22]), (&[0xC3, 0x08][..], &[0x06, 0xFF][..]));
    assert_eq!((&bytes[24..26], &bytes[26..30], bytes[42]), (&[0x86, 0][..], &[1, 0, 0, 0][..], 0x0E));
}

#[test]
fn every_combination_of_blocks_round_trips() {
    for request_bits in 0..8 {
        for response_bits in 0..512 {
            let (request_def, response_def) = (RequestDef(request_bits), ResponseDef(response_bits));
            let full = full_request();
            let request = Request {
                reserved: RequestDef::NONE,
                response_def,
                control: full.control.filter(|_| request_def.contains(RequestDef::CONTROL)),
                motion: full.motion.filter(|_| request_def.contains(RequestDef::MOTION)),
                config: full.config.filter(|_| request_def.contains(RequestDef::CONFIG)),
            };
            assert_eq!(request.definition(), request_def);
            assert_eq!(Request::parse(&emitted(&request)), Ok(request));

            let bytes = answered(&Response { request_def, response_def, ..full_response() });
            assert_eq!(answered(&Response::parse(&bytes).unwrap()), bytes);

            // Any cut below the blocks is refused, never misread.
            let blocks = bytes.len() - if request_def.contains(RequestDef::CONFIG) { 8 } else { 0 };
            for have in 0..blocks {
                let need = if have < 8 { 8 } else { blocks };
                assert_eq!(Response::parse(&bytes[..have]), Err(ParseError::TooShort { need, have }));
            }
        }
    }
}

#[test]
fn config_is_read_if_the_request_had_it_regardless_of_response_bit_8() {
    // Request bit 2 clear, response bit 8 set: 42 bytes for 1FFh, no config block.
    let bytes = answered(&Response { request_def: RequestDef(0b011), ..full_response() });
    assert_eq!(bytes.len(), 42);
    assert_eq!(Response::parse(&bytes).unwrap().config, None);
    // Request bit 2 set, response bit 8 clear: appended all the same.
    let bytes = answered(&Response { response_def: ResponseDef(0xFF), ..full_response() });
    assert_eq!(bytes.len(), 50);
    assert_eq!(Response::parse(&bytes).unwrap().config, full_response().config);
    // The datagram is short of exactly this block: it was left out.
    for have in 42..50 {
        assert_eq!(Response::parse(&bytes[..have]).unwrap().config, None);
    }
}

#[test]
fn a_drive_takes_cut_last_blocks_and_ignores_the_tail() {
    // A motion block of header and used parameters only, as a master in the field sends it.
    let request = Request::parse(&GO_TO_REQUEST[..28]).unwrap();
    assert_eq!(Ok(request), Request::parse(&GO_TO_REQUEST));
    let stop = Request::parse(&GO_TO_REQUEST[..12]).unwrap().motion.unwrap();
    assert_eq!((stop.header, stop.parameters), (0x0101, [0; 30]));
    assert_eq!(Request::parse(&GO_TO_REQUEST[..11]), Err(ParseError::TooShort { need: 12, have: 11 }));
    // A config block of control and index only.
    let read = Request::parse(&READ_REQUEST[..12]).unwrap().config.unwrap();
    assert_eq!((read.code, read.words), (0x11, [0x20A8, 0, 0]));
    assert!(Request::parse(&READ_REQUEST[..10]).is_ok());
    assert_eq!(Request::parse(&READ_REQUEST[..9]), Err(ParseError::TooShort { need: 10, have: 9 }));
    // A motion block that is not the last one has to be whole.
    let bytes = emitted(&full_request());
    assert_eq!(Request::parse(&bytes[..41]), Err(ParseError::TooShort { need: 44, have: 41 }));
    // Longer is fine.
    let mut longer = GO_TO_REQUEST.to_vec();
    longer.extend([0xA5; 100]);
    assert_eq!(Request::parse(&longer), Request::parse(&GO_TO_REQUEST));
    // Shorter than both definitions is nothing.
    assert_eq!(Request::parse(&[0; 7]), Err(ParseError::TooShort { need: 8, have: 7 }));
}
