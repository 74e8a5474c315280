//! Start-up telegrams, byte by byte: what each master has to send with the same settings.

use super::{OWN, PKW, PLAIN, watchdog_factors};

/// DA and SA are followed by service access points.
const WITH_SAPS: u8 = 0x80;
/// Bits and functions of a function code.
const REQUEST_COUNTED_FIRST: u8 = 0x60;
const FUNCTION: u8 = 0x0F;
const FDL_STATUS: u8 = 9;
/// Functions of high priority, and the same of low priority: SRD, SDN.
const PRIORITIES: [(u8, u8); 2] = [(0xD, 0xC), (0x6, 0x4)];
const ALL: u8 = 127;

/// Who gets a telegram, its function code and its data with its service access points; whether these are there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Telegram {
    pub to: u8,
    pub from: u8,
    pub function: u8,
    pub has_saps: bool,
    pub data: Vec<u8>,
}

impl Telegram {
    /// `None`: a token, or a bare acknowledgement.
    pub fn of(bytes: &[u8]) -> Option<Telegram> {
        let head = match bytes[0] {
            0x68 => 4,
            0x10 | 0xA2 => 1,
            _ => return None,
        };
        let [to, from, function, data @ .., _, _] = &bytes[head..] else { panic!("{bytes:02X?}") };
        let (has_saps, data) = (to & WITH_SAPS != 0, data.to_vec());
        Some(Telegram { to: to & !WITH_SAPS, from: from & !WITH_SAPS, function: *function, has_saps, data })
    }

    fn is_fdl_status(&self) -> bool {
        self.function & FUNCTION == FDL_STATUS
    }

    pub fn is_data_exchange(&self) -> bool {
        !self.has_saps && !self.is_fdl_status()
    }
}

/// The bytes of a telegram from DA to the last byte of its data as SD1, or as SD2.
fn whole(body: &[u8]) -> Vec<u8> {
    let sum = body.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
    let length = body.len() as u8;
    let head = if length == 3 { vec![0x10] } else { vec![0x68, length, length, 0x68] };
    [&head, body, &[sum, 0x16]].concat()
}

/// FDL status of this station.
pub fn fdl_status(of: u8) -> Vec<u8> {
    whole(&[of, OWN, 0x49])
}

/// Global_Control with this command to all.
pub fn global_control(command: u8) -> Vec<u8> {
    whole(&[ALL | WITH_SAPS, OWN | WITH_SAPS, 0x46, 58, 62, command, 0])
}

pub const TOKEN: [u8; 3] = [0xDC, OWN, OWN];

/// From the first telegram to a drive to its first Data_Exchange, in which nothing is commanded.
pub fn start_up(address: u8) -> Vec<Vec<u8>> {
    let [first, second] = watchdog_factors();
    let service = |function: u8, sap: u8, data: &[u8]| {
        whole(&[&[address | WITH_SAPS, OWN | WITH_SAPS, function, sap, 62], data].concat())
    };
    let (configuration, outputs): (&[u8], usize) =
        if address == PLAIN { (&[0xF3], 8) } else { (&[0xF3, 0xF1], 12) };
    let parameters = [0x88, first, second, 11, 0x00, 0x82, 0, 0x80, 0, 0];
    vec![
        service(0x6D, 60, &[]),
        service(0x5D, 61, &parameters),
        service(0x7D, 62, configuration),
        service(0x5D, 60, &[]),
        whole(&[&[address, OWN, 0x7D], &vec![0; outputs][..]].concat()),
    ]
}

/// The same with low priority, but for Data_Exchange.
pub fn low(telegram: Vec<u8>) -> Vec<u8> {
    match Telegram::of(&telegram) {
        Some(of) if of.has_saps => {
            let mut body = telegram[4..telegram.len() - 2].to_vec();
            let function = body[2] & FUNCTION;
            let (_, low) = PRIORITIES.into_iter().find(|(high, _)| *high == function).unwrap();
            body[2] = body[2] & !FUNCTION | low;
            whole(&body)
        }
        _ => telegram,
    }
}

/// The same as SD2, if it is SD3.
pub fn as_sd2(telegram: &[u8]) -> Vec<u8> {
    if telegram[0] == 0xA2 { whole(&telegram[1..telegram.len() - 2]) } else { telegram.to_vec() }
}

/// The start-up of a drive as a master did it, without what it sent again because no answer came, and without FDL
/// status: from the last diagnosis whose count begins anew, up to the first Data_Exchange.
pub fn started(requests: &[Vec<u8>], address: u8) -> Vec<Vec<u8>> {
    let mut started: Vec<Vec<u8>> = Vec::new();
    for request in requests {
        let Some(telegram) = Telegram::of(request).filter(|of| of.to == address && !of.is_fdl_status())
        else {
            continue;
        };
        if telegram.function & 0xF0 == REQUEST_COUNTED_FIRST {
            started.clear();
        }
        if started.last() != Some(request) {
            started.push(request.clone());
        }
        if telegram.is_data_exchange() {
            break;
        }
    }
    started
}

/// Every FDL status of these requests is what it should be; the stations.
pub fn searched(requests: &[Vec<u8>]) -> Vec<u8> {
    let status = |request: &&Vec<u8>| Telegram::of(request).is_some_and(|of| of.is_fdl_status());
    let station = |request: &Vec<u8>| {
        let station = request[1];
        assert_eq!(*request, fdl_status(station));
        station
    };
    requests.iter().filter(status).map(station).collect()
}

/// That what this file makes is what the fact sheet has.
#[test]
fn they_are_those_of_the_sheet() {
    let bytes = |text: &str| -> Vec<u8> {
        text.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
    };
    assert_eq!(fdl_status(7), bytes("10 07 02 49 52 16"));
    assert_eq!(global_control(0), bytes("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16"));
    assert_eq!(global_control(2), bytes("68 07 07 68 FF 82 46 3A 3E 02 00 41 16"));
    let [diagnosis, parameters, configuration, ..] = &start_up(7)[..] else { panic!() };
    assert_eq!(*diagnosis, bytes("68 05 05 68 87 82 6D 3C 3E F0 16"));
    // With 10 s: 4 * 250 * 10 ms.
    assert_eq!(*parameters, bytes("68 0F 0F 68 87 82 5D 3D 3E 88 04 FA 0B 00 82 00 80 00 00 74 16"));
    assert_eq!(*configuration, bytes("68 07 07 68 87 82 7D 3E 3E F3 F1 E6 16"));
    assert_eq!(start_up(PKW).len(), 5);
    assert_eq!(low(global_control(0)), bytes("68 07 07 68 FF 82 44 3A 3E 00 00 3D 16"));
    assert_eq!(low(diagnosis.clone()), bytes("68 05 05 68 87 82 6C 3C 3E EF 16"));
    let answer = bytes("A2 82 87 08 3E 3C 02 05 00 FF 00 82 13 16");
    assert_eq!(as_sd2(&answer), bytes("68 0B 0B 68 82 87 08 3E 3C 02 05 00 FF 00 82 13 16"));
}
