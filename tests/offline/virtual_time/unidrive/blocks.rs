//! Several parameters in one request.

use fieldbeat::axis::{CallError, ParameterError};
use fieldbeat_core::axis::Call;
use fieldbeat_core::axis::acyclic::Access;
use fieldbeat_core::axis::acyclic::long::{self, LOAD, PART, READ_SEVERAL, STORE};

use super::*;
use crate::virtual_time::carrier::{Turning, Turns};

impl Turns for Bench {
    fn sim(&mut self) -> &mut Simulation {
        &mut self.sim
    }
}

fn with<R>(b: &mut Bench, does: impl FnOnce(Access<'_>) -> R) -> R {
    let notation = std::sync::Arc::clone(b.sim.axis(0).acyclic().notation());
    let carrier = Turning::new(b, 0);
    does(Access { drive: "u0", notation: &*notation, carrier: &carrier })
}

fn write(b: &mut Bench, address: &str, values: &[i32]) -> Result<(), ParameterError> {
    let values: Vec<u64> = values.iter().map(|value| u64::from(value.cast_unsigned())).collect();
    with(b, |access| access.write_several(address, &values))
}

fn read(b: &mut Bench, address: &str, count: usize) -> Result<Vec<(String, i32)>, ParameterError> {
    let read = with(b, |access| access.read_several(address, count))?;
    Ok(read.into_iter().map(|(address, raw)| (address, raw as u32 as i32)).collect())
}

/// The requests by this function since the last look, from the unit identifier on, but for the cyclic ones.
fn requests(b: &Bench, function: u8) -> Vec<Vec<u8>> {
    let received = std::mem::take(&mut b.tap(0).received);
    let wanted = |bytes: &Vec<u8>| bytes[7] == function && bytes[8..10] != CYCLIC;
    received.into_iter().filter(wanted).map(|bytes| bytes[6..].to_vec()).collect()
}

/// What is cyclic is read from 00.011 on, or by function 23.
const CYCLIC: [u8; 2] = [0x40, 0x0A];

fn bench() -> Bench {
    let mut b = Bench::new(1, Via::Menu0 { first: 11 }, |_, _| {});
    b.online();
    b
}

#[test]
fn three_parameters_are_written_and_read_by_the_telegrams_of_the_manual() {
    let mut b = bench();
    requests(&b, 0);
    write(&mut b, "20.021", &[12_345; 3]).unwrap();
    // Unidrive M701, manual, page 129: function 16, from the unit on.
    let mut telegram = vec![0xFF, 0x10, 0x47, 0xE4, 0x00, 0x06, 0x0C];
    telegram.extend([0x00, 0x00, 0x30, 0x39].repeat(3));
    assert_eq!(requests(&b, function::WRITE), [telegram]);
    let all = |value: i32| ["20.021", "20.022", "20.023"].map(|address| (address.to_owned(), value));
    assert_eq!(read(&mut b, "20.021", 3).unwrap(), all(12_345));
    assert_eq!(requests(&b, function::READ), [[0xFF, 0x03, 0x47, 0xE4, 0x00, 0x06]]);
    // In 16 bits where all are known to have so many, and where it is said.
    write(&mut b, "20.001", &[-1, 2, -3]).unwrap();
    let [words] = &requests(&b, function::WRITE)[..] else { panic!("one request") };
    assert_eq!(words[..7], [0xFF, 0x10, 0x07, 0xD0, 0x00, 0x03, 0x06]);
    assert_eq!(words[7..], [0xFF, 0xFF, 0, 2, 0xFF, 0xFD]);
    let longs = read(&mut b, "20.001.long", 2).unwrap();
    assert_eq!(longs, [("20.001.long".to_owned(), -1), ("20.002.long".to_owned(), 2)]);
    assert_eq!(requests(&b, function::READ), [[0xFF, 0x03, 0x47, 0xD0, 0x00, 0x04]]);
    // One of them is one.
    write(&mut b, "20.030", &[7]).unwrap();
    assert_eq!(read(&mut b, "20.030", 1).unwrap(), [("20.030".to_owned(), 7)]);
}

#[test]
fn a_refused_parameter_of_a_block_is_named_and_those_before_it_are_written() {
    let mut b = bench();
    let refused = write(&mut b, "01.022", &[100, 600_000, 300]).unwrap_err().to_string();
    assert!(refused.starts_with("drive u0: write 01.023 = 60000.0 rpm "), "{refused}");
    let parts = ["did not take it and gave no error code", "; those before it were written"];
    assert!(parts.iter().all(|part| refused.contains(part)), "{refused}");
    let values: Vec<i32> = read(&mut b, "01.022", 3).unwrap().into_iter().map(|(_, value)| value).collect();
    assert_eq!(values, [100, 0, 0]);
    // The first one: nothing was written.
    let refused = write(&mut b, "01.022", &[-600_000, 1]).unwrap_err().to_string();
    assert!(refused.contains("write 01.022 = ") && !refused.contains("those before"), "{refused}");
    // A hole: the whole request.
    let refused = read(&mut b, "20.039", 4).unwrap_err().to_string();
    assert!(refused.starts_with("drive u0: read 20.039 ... 20.042: exception 02h"), "{refused}");
    let refused = write(&mut b, "20.039", &[1, 2, 3, 4]).unwrap_err().to_string();
    assert!(refused.starts_with("drive u0: write 20.039 ... 20.042 = 1 "), "{refused}");
    assert!(refused.contains("exception 02h"), "{refused}");
    // And nothing is sent of what has no telegram.
    requests(&b, 0);
    for (address, count) in [("20.001", 0), ("20.021", 61), ("20.001.word", 121), ("20.098", 200), ("06", 2)]
    {
        assert!(matches!(read(&mut b, address, count), Err(ParameterError::Notation { .. })), "{address}");
    }
    assert_eq!(requests(&b, function::READ), [[0_u8; 6]; 0]);
}

#[test]
fn one_that_may_command_a_drive_with_power_refuses_all_and_is_named() {
    let mut b = bench();
    b.done(0, Command::Enable);
    requests(&b, 0);
    for (address, values, named) in [
        ("02.010", &[1, 2][..], "02.010 = "),
        ("02.011", &[100, 200], "02.012 = "),
        ("03.007", &[1, 2, 3, 4], "03.009 = "),
        ("06.041", &[0, 0], "06.041"),
    ] {
        let refused = write(&mut b, address, values).unwrap_err().to_string();
        let parts = [format!("drive u0: write {named}"), "disable the axis first".to_owned()];
        assert!(parts.iter().all(|part| refused.contains(part)), "{address}: {refused}");
    }
    assert_eq!(requests(&b, function::WRITE), [[0_u8; 6]; 0]);
    write(&mut b, "03.005", &[6, 7, 8]).unwrap();
    assert_eq!(requests(&b, function::WRITE).len(), 1);
    assert_eq!(read(&mut b, "03.005", 3).unwrap().iter().map(|(_, value)| *value).sum::<i32>(), 21);
    b.done(0, Command::Disable);
    write(&mut b, "02.011", &[100]).unwrap();
}

/// As anybody may post them through the control socket.
#[test]
fn parts_without_a_whole_have_no_telegram() {
    let mut b = bench();
    requests(&b, 0);
    let block = b.sim.axis(0).acyclic().notation().block("20.021", 3).unwrap();
    let call = |service, value| Call { service, address: block.address, value };
    let whole = long::write(block.address, &[1; 12]);
    for calls in [
        vec![call(STORE, 12)],
        vec![call(LOAD, 1), call(STORE, 12)],
        vec![call(LOAD, 1), call(LOAD, 1), call(STORE, 13)],
        vec![call(LOAD, 1), call(LOAD, 1), call(STORE, 10)],
        vec![call(LOAD, 1), call(STORE, u64::MAX)],
        vec![call(LOAD, 1); 31],
        vec![call(PART, 0)],
        vec![call(READ_SEVERAL, 0)],
        vec![call(READ_SEVERAL, 61)],
        vec![call(READ_SEVERAL, u64::MAX)],
        vec![whole[0], whole[1], Call { address: block.address + 1, ..whole[2] }],
        vec![call(9, 3)],
    ] {
        let series = with(&mut b, |access| access.carrier.run(&calls, Duration::from_secs(1)));
        assert!(matches!(series.failed, Some(CallError::Refused(_))), "{calls:?}: {series:?}");
    }
    let sent = [requests(&b, function::WRITE), requests(&b, function::READ)].concat();
    assert_eq!(sent, [[0_u8; 6]; 0]);
    // Two at the same time do not mix.
    let acyclic = b.sim.axis(0).acyclic().clone();
    let limit = Duration::from_secs(1);
    let other = long::write(block.address, &[2; 12]);
    let tickets: Vec<_> =
        [&whole, &other].into_iter().flat_map(|calls| acyclic.post_series(calls, limit).unwrap()).collect();
    b.run(500);
    for mut ticket in tickets {
        assert!(ticket.poll().unwrap().is_ok());
    }
    let written: Vec<u8> = requests(&b, function::WRITE).iter().map(|bytes| bytes[7]).collect();
    assert_eq!(written, [1, 2]);
}
