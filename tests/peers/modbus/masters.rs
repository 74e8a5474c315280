//! Our master, and servers of others that know nothing of drives. The test is the drive behind their registers.

use std::net::SocketAddrV4;
use std::time::Duration;

use fieldbeat::Master;
use fieldbeat::axis::{Axis, Command, Jog, ParameterError, State};
use fieldbeat::bus::modbus::{Mapped, Native, Parameter, UnidriveDrive, Width};
use fieldbeat::telemetry::Counters;
use fieldbeat_modbus::counters::Own;

use super::Library::{Libmodbus, Pymodbus};
use super::{Library, PORT, drive, long, plan};
use crate::peer::Peer;
use crate::support::{LONG, Machine, until};

// Addresses as the SI-Ethernet guide makes them, counted by hand.
const LOAD: u16 = 0x01A3; // 04.020
const CONTROL: u16 = 0x0281; // 06.042
const CONTROL_ENABLE: u16 = 0x0282; // 06.043
const TRIP: u16 = 0x03FB; // 10.020
const STATUS: u16 = 0x040F; // 10.040
const MODBUS_TIMEOUT: u16 = 0x05E4; // 15.009, of whatever unit
const REFERENCE: u16 = 0x4078; // 01.021
const SPEED: u16 = 0x412D; // 03.002
const FIRST: u16 = 0x47E4; // 20.021
const THIRD: u16 = 0x47E6; // 20.023
const FIFTH: u16 = 0x47E8; // 20.025

/// What they have no registers for.
const MISSING: &str = "150.001.long";

const HEALTHY: u16 = 1 << 0;
const ACTIVE: u16 = 1 << 1;
const STANDSTILL: u16 = 1 << 2;

/// So many exchanges at least.
const EXCHANGES: u64 = 3000;

fn mapped(menu: u8, number: u8) -> Mapped {
    Mapped { parameter: Parameter::new(menu, number), width: Width::Long, decimals: 0 }
}

/// A drive with two parameters besides, which do not overlap in registers.
fn machine_drive(address: SocketAddrV4) -> UnidriveDrive {
    let mut drive = drive(address);
    drive.map.also = vec![mapped(20, 21), mapped(20, 23)];
    drive
}

fn server(library: Library, machine: &Machine, options: &[&str]) -> (Peer, SocketAddrV4) {
    let address = SocketAddrV4::new(machine.ip(11), PORT);
    let mut peer = library.start("server", machine, address, options);
    peer.set(STATUS, &[HEALTHY | STANDSTILL]);
    (peer, address)
}

fn counters(master: &Master) -> Counters {
    master.numbers().drives[0].counters
}

/// How many requests the master greets a new server with. They are counted by the server only.
fn handshake(library: Library, machine: &Machine, options: &[&str]) -> u64 {
    let (mut peer, address) = server(library, machine, options);
    let mut drive = machine_drive(address);
    // So seldom that both ends are counted in between.
    drive.axis.divisor = 1_000;
    let master = Master::from_plan(plan(drive)).start().unwrap();
    let mut handshake = None;
    let found = until(LONG, || {
        let before = counters(&master);
        std::thread::sleep(Duration::from_millis(20));
        let total = peer.numbers("counts")[0];
        std::thread::sleep(Duration::from_millis(20));
        let after = counters(&master);
        let is_settled = before == after && after.sent == after.answered && after.sent >= 2;
        handshake = is_settled.then(|| total - after.sent);
        is_settled
    });
    assert!(found, "{:?}", counters(&master));
    master.finish();
    handshake.unwrap()
}

/// Waits until the server's registers hold these values from here on.
fn await_registers(peer: &mut Peer, address: u16, values: &[u16]) {
    let arrived = until(LONG, || peer.registers(address, values.len()) == values);
    assert!(arrived, "{address:#06x}: {:?}, not {values:?}", peer.registers(address, values.len()));
}

fn await_feedback(axis: &Axis, what: &str, is_there: impl Fn(&fieldbeat::Feedback) -> bool) {
    assert!(until(LONG, || is_there(&axis.feedback())), "{what}: {:?}", axis.feedback());
}

/// What the server holds arrives in the feedback and in the native inputs.
fn reads(peer: &mut Peer, axis: &Axis, native: &Native) {
    // 150.0 rpm backwards, 12.3 % load.
    peer.set(SPEED, &long(-1500));
    peer.set(LOAD, &[123]);
    peer.set(FIRST, &long(-70_000));
    peer.set(THIRD, &long(i32::MAX));
    await_feedback(axis, "speed", |feedback| (feedback.status.velocity + 2.5).abs() < 1e-9);
    await_feedback(axis, "load", |feedback| {
        feedback.status.monitor[0].is_some_and(|load| (load - 12.3).abs() < 1e-9)
    });
    await_feedback(axis, "state", |feedback| feedback.status.state == State::ReadyToSwitchOn);
    assert!(until(LONG, || (native.also(0), native.also(1)) == (Some(-70_000), Some(i32::MAX))));
    let status = native.inputs().status().unwrap();
    assert_eq!((status.0, native.inputs().get(fieldbeat::bus::modbus::Role::Speed)), (5, Some(-1500)));
}

/// What the master writes arrives in the server.
fn writes(peer: &mut Peer, axis: &mut Axis) {
    let enable = axis.post(Command::Enable).unwrap();
    // Enabled, run forward, by remote reference, automatic.
    await_registers(peer, CONTROL, &[0x0183]);
    peer.set(STATUS, &[HEALTHY | ACTIVE | STANDSTILL]);
    axis.wait(enable, "Enable", LONG).unwrap();
    // It obeys the control word and watches the master.
    assert_eq!(peer.registers(CONTROL_ENABLE, 1), [1]);
    assert_eq!(peer.registers(MODBUS_TIMEOUT, 1), [20_000]);
    peer.set(STATUS, &[HEALTHY | ACTIVE]);
    for (velocity, control) in [(2.5, 0x0183), (-1200.0, 0x0189)] {
        axis.post(Command::Jog(Jog { velocity, acceleration: 10_000.0 })).unwrap();
        // Tenths of revolutions a minute; the direction stands in the control word. The last one needs both registers.
        await_registers(peer, REFERENCE, &long((velocity.abs() * 600.0) as i32));
        await_registers(peer, CONTROL, &[control]);
    }
}

/// Acyclic calls, of parameters that a user program may take for references: while power is off.
fn calls(peer: &mut Peer, axis: &Axis) {
    let parameter = axis.parameter();
    parameter.write("20.025.long", -123_456).unwrap();
    assert_eq!(peer.registers(FIFTH, 2), long(-123_456));
    parameter.write("18.011.word", 4711).unwrap();
    assert_eq!(peer.registers(18 * 100 + 10, 1), [4711]);
    peer.set(FIFTH, &long(654_321));
    assert_eq!(parameter.read::<i32>("20.025.long").unwrap(), 654_321);
    let refused = parameter.read::<i32>(MISSING).unwrap_err();
    assert!(matches!(refused, ParameterError::Refused { status: 2, .. }), "{refused}");
}

fn exchange(test: u8, library: Library, options: &[&str], read_write: bool) {
    let machine = Machine::new(test);
    let handshake = handshake(library, &machine, options);
    let (mut peer, address) = server(library, &machine, options);
    let master = Master::from_plan(plan(machine_drive(address))).start().unwrap();
    let mut axis = master.axis("m").unwrap();
    axis.wait_online(LONG).unwrap();
    // Nothing is set before the first order.
    assert_eq!(peer.registers(CONTROL_ENABLE, 1), [0]);
    assert_eq!(peer.registers(MODBUS_TIMEOUT, 1), [0]);
    let native = axis.native::<Native>().unwrap();
    reads(&mut peer, &axis, &native);
    calls(&mut peer, &axis);
    writes(&mut peer, &mut axis);
    let begun = counters(&master).sent;
    let done = until(LONG, || {
        master.alive();
        counters(&master).sent >= begun + EXCHANGES
    });
    assert!(done, "{:?}", counters(&master));
    assert_eq!(axis.feedback().status.state, State::OperationEnabled);
    peer.set(TRIP, &[3]);
    peer.set(STATUS, &[STANDSTILL]);
    await_feedback(&axis, "trip", |feedback| {
        (feedback.status.state, feedback.status.fault) == (State::Fault, 3)
    });
    let end = master.finish().end.drives[0].counters;
    // Nobody watches a master that has ended in order.
    assert_eq!(peer.registers(MODBUS_TIMEOUT, 1), [0]);
    // Sent, arrived, answered: all of it once.
    let closes = options.contains(&"closes-on-read-write");
    let silent = closes || options.contains(&"ignores-read-write");
    let handshake = handshake * (1 + u64::from(closes));
    let all = until(LONG, || peer.numbers("counts")[0] == handshake + end.sent);
    let counts = peer.numbers("counts");
    assert!(all, "{counts:?}, {handshake} of them greet: {end:?}");
    assert!(end.sent - end.answered - end.missed <= 1, "one may be under way at the end: {end:?}");
    let mut expected =
        Counters { sent: end.sent, unsent: end.unsent, answered: end.answered, ..Counters::default() };
    expected.missed = silent.into();
    // A parameter that is missing, and function 23.
    expected.own[Own::Exceptions as usize] = 1 + u64::from(!read_write && !silent);
    expected.own[Own::NoReadWrite as usize] = u64::from(!read_write);
    expected.own[Own::Closed as usize] = closes.into();
    expected.own[Own::Reopened as usize] = closes.into();
    assert_eq!(end, expected);
    let [_, read, _, write, both] = counts[..] else { panic!("{counts:?}") };
    match read_write {
        // Now and then whether the values stand is read alone.
        true => assert!(both + read > EXCHANGES && both > 10 * read, "{counts:?}"),
        // Asked for once, and never again.
        false => assert!(both == 1 && read > EXCHANGES / 3 && write > EXCHANGES / 3, "{counts:?}"),
    }
}

#[test]
#[ignore = "needs cc and libmodbus (libmodbus-dev)"]
fn our_master_exchanges_with_a_server_of_libmodbus_by_one_function() {
    exchange(11, Libmodbus, &[], true);
}

#[test]
#[ignore = "needs cc and libmodbus (libmodbus-dev)"]
fn our_master_exchanges_with_a_server_of_libmodbus_that_refuses_ignores_or_closes_on_function_23() {
    for (test, option) in [(12, "no-read-write"), (21, "ignores-read-write"), (22, "closes-on-read-write")] {
        exchange(test, Libmodbus, &[option], false);
    }
}

#[test]
#[ignore = "needs python3 and pymodbus"]
fn our_master_exchanges_with_a_server_of_pymodbus_by_one_function() {
    exchange(13, Pymodbus, &[], true);
}

#[test]
#[ignore = "needs python3 and pymodbus"]
fn our_master_exchanges_with_a_server_of_pymodbus_by_pairs() {
    exchange(14, Pymodbus, &["no-read-write"], false);
}

/// pymodbus answers exception 4 for a unit that it does not have.
#[test]
#[ignore = "needs python3 and pymodbus"]
fn our_master_takes_the_unit_id_that_a_server_of_pymodbus_has_and_no_other() {
    let machine = Machine::new(15);
    let (mut peer, address) = server(Pymodbus, &machine, &["unit-1"]);
    let master = Master::from_plan(plan(drive(address))).start().unwrap();
    let refused = until(LONG, || peer.numbers("counts")[1] >= 4);
    assert!(refused && counters(&master).sent == 0, "{:?}", counters(&master));
    drop(master);
    let mut drive = drive(address);
    drive.unit = Some(1);
    let master = Master::from_plan(plan(drive)).start().unwrap();
    master.wait_online(LONG).unwrap();
    let end = master.finish().end.drives[0].counters;
    assert!(
        end.answered > 0 && end.sent - end.answered <= 1 && end.own[Own::Exceptions as usize] == 0,
        "{end:?}"
    );
}
