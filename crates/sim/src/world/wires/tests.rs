//! A master's port in a world.

use super::*;
use crate::Simulated;
use crate::serial::tests::wire_at;
use crate::testing::Slave;
use crate::world::WorldOptions;
use fieldbeat_core::net::{Carriers, Parity, Rs485};
use fieldbeat_core::rt::{Clock, PollSet};
use fieldbeat_core::time::{MS, S, US};

const PORT: &str = "/dev/ttyUSB0";
const BYTE: u64 = 22 * US;

fn wire(port: &str) -> SerialWire {
    wire_at(port, &[7, 9])
}

fn world(faults: &FaultPlan) -> World {
    let wire = |port| SerialWire { faults: faults.clone(), ..wire(port) };
    world_of(vec![wire(PORT), wire("/dev/ttyUSB1")])
}

fn world_of(wires: Vec<SerialWire>) -> World {
    World::new(
        Simulated { wires, ..Simulated::default() },
        WorldOptions { read_ns: 0, ..WorldOptions::default() },
    )
    .unwrap()
}

fn open(world: &World) -> Box<dyn Serial> {
    let mut port = world.serial(PORT, &Slave::LINE).unwrap();
    until_open(world, &mut *port);
    port
}

fn until_open(world: &World, port: &mut dyn Serial) {
    for _ in 0..100 {
        if port.opened().is_some() {
            return;
        }
        world.advance(100 * MS);
    }
    panic!("{:?}", port.notes().get(0));
}

fn read(port: &mut dyn Serial) -> Vec<u8> {
    let mut room = [0; 64];
    port.receive(0, &mut room).unwrap().map_or(Vec::new(), |(_, count)| room[..count].to_vec())
}

#[test]
fn an_exchange_takes_its_bits_and_wakes_the_waiting_at_its_end() {
    let world = world(&FaultPlan::default());
    let mut port = open(&world);
    let begin = world.now();
    assert_eq!(port.send(0, &Slave::request(7, 5)), Ok((begin, 3)));
    assert_eq!((port.unsent(), port.receive(0, &mut [0; 4])), (Ok(2), Ok(None)));
    let mut set = PollSet::default();
    let end = begin + (6 * BYTE + 22 * US);
    assert!(!world.clock().wait(&mut set, end - 3 * BYTE));
    // A bus that looks meanwhile finds what there is.
    world.advance(BYTE);
    assert_eq!(read(&mut *port), [135]);
    assert!(world.clock().wait(&mut set, begin + S));
    assert_eq!((world.now(), read(&mut *port)), (end, vec![5, 1]));
    assert_eq!((port.unsent(), world.delivered()), (Ok(0), 2));
    assert_eq!(world.look_on(PORT, 1, |slave: &mut Slave, _| slave.received.len()), Some(6));
    assert_eq!(world.look_on("/dev/ttyUSB1", 1, |slave: &mut Slave, _| slave.received.len()), Some(0));
    assert_eq!(world.look_on(PORT, 2, |slave: &mut Slave, _| slave.number), None);
}

#[test]
fn at_12_mbit_s_an_exchange_takes_its_bits_too_and_its_echo() {
    let line = SerialLine { rate: 12_000_000, ..Slave::LINE };
    let world = world_of(vec![SerialWire { line, echo: true, ..wire(PORT) }]);
    // Who switches the direction makes no difference on the wire.
    let mut port = world.serial(PORT, &SerialLine { rs485: Rs485::Driver, ..line }).unwrap();
    until_open(&world, &mut *port);
    let begin = world.now();
    port.send(0, &Slave::request(7, 5)).unwrap();
    assert!(world.clock().wait(&mut PollSet::default(), begin + S));
    // 33 bits of 1000 / 12 ns, twice, and the slave's time.
    world.advance(2_750 + 22 * US + 2_750 - 1 - world.now().since(begin));
    assert_eq!(read(&mut *port), [7, 5, !5, 135, 5]);
    world.advance(1);
    assert_eq!(read(&mut *port), [1]);
}

#[test]
fn a_full_driver_takes_more_as_it_sends_and_nothing_is_lost() {
    let world = world(&FaultPlan::default());
    let mut port = open(&world);
    let bytes: Vec<u8> = (0..5_000_u32).map(|n| (n % 251) as u8).collect();
    let mut send = |from: usize| port.send(0, &bytes[from..]).unwrap().1;
    let taken = send(0);
    // One of them has begun.
    assert_eq!((taken, send(taken), send(taken + 1)), (4_096, 1, 0));
    world.advance(100 * BYTE);
    assert_eq!(send(4_097), 100);
    world.advance(3_000 * BYTE);
    assert_eq!((send(4_197), port.unsent()), (803, Ok(5_000 - 3_101)));
    world.advance(2_000 * BYTE);
    assert_eq!(world.look_on(PORT, 0, |slave: &mut Slave, _| slave.received == bytes), Some(true));
}

#[test]
fn a_port_that_is_not_there_or_taken_is_said_to_be() {
    let world = world(&FaultPlan::default());
    let refused = |port| world.serial(port, &Slave::LINE).map(|_| ()).unwrap_err();
    assert_eq!(
        refused("/dev/ttyS0").to_string(),
        "no serial wire at /dev/ttyS0 in this world; there are: /dev/ttyUSB0, /dev/ttyUSB1"
    );
    let port = open(&world);
    assert_eq!(refused(PORT).kind(), io::ErrorKind::AddrInUse);
    drop(port);
    open(&world);
    assert!(!world.unplug_port("x") && !world.plug_port("x") && world.wire_injected("x").is_none());
}

#[test]
fn an_adapter_that_is_unplugged_breaks_the_port_and_is_opened_again_with_pauses() {
    let world = world(&FaultPlan::default());
    let mut port = open(&world);
    let notes = port.notes();
    for round in 0..3 {
        assert_eq!(notes.get(0), None);
        port.send(0, &Slave::request(7, 5)).unwrap();
        world.advance(4 * BYTE);
        assert!(world.unplug_port(PORT));
        assert!(world.clock().wait(&mut PollSet::default(), world.now() + S), "round {round}");
        let broken = Err(Broken::Failed(libc::EIO));
        assert_eq!((port.receive(0, &mut [0; 4]), port.send(0, b"x").map(|_| None)), (broken, broken));
        assert_eq!(port.discard(), Err(Broken::Failed(libc::EIO)));
        port.abandon(0, "it is unplugged");
        assert_eq!(port.receive(0, &mut [0; 4]), Err(Broken::Absent));
        assert_eq!(notes.get(0).unwrap(), "serial port /dev/ttyUSB0 given up: it is unplugged");
        world.advance(10 * S);
        assert!(port.opened().is_none());
        assert!(notes.get(0).unwrap().contains("plug in its adapter"), "{:?}", notes.get(0));
        assert!(world.plug_port(PORT));
        until_open(&world, &mut *port);
        assert_eq!(port.receive(0, &mut [0; 4]), Ok(None), "nothing of the old one is left");
        port.send(0, &Slave::request(9, round)).unwrap();
        world.advance(MS);
        assert_eq!(read(&mut *port)[..2], [137, round]);
    }
}

#[test]
fn faults_and_settings_of_a_wire_can_be_changed_in_between() {
    let world = world(&FaultPlan::default());
    let mut port = open(&world);
    let mut exchange = |value| {
        port.send(0, &Slave::request(7, value)).unwrap();
        world.advance(MS);
        read(&mut *port)
    };
    assert_eq!(exchange(1), [135, 1, 1]);
    assert!(world.set_wire_faults(PORT, FaultPlan { drop: 1.0, ..FaultPlan::default() }));
    assert_eq!((exchange(2), world.wire_injected(PORT).unwrap().dropped), (vec![], 1));
    assert!(world.set_wire_faults(PORT, FaultPlan::default()) && world.restart_on(PORT, 0));
    assert_eq!(exchange(3), [135, 3, 1]);
    assert!(world.inhibit_on(PORT, 1, MS));
    let until = world.now() + MS;
    assert_eq!(world.look_on(PORT, 1, |slave: &mut Slave, _| slave.inhibited), Some(until));
    drop(port);
    let other = SerialLine { parity: Parity::None, ..Slave::LINE };
    let mut port = world.serial(PORT, &other).unwrap();
    until_open(&world, &mut *port);
    port.send(0, &Slave::request(7, 4)).unwrap();
    world.advance(MS);
    assert_eq!(read(&mut *port), [0; 0]);
}

#[test]
fn thousands_of_ends_leave_a_wire_that_works_and_no_alarm() {
    let world = world(&FaultPlan::default());
    for round in 0..3_000_u64 {
        let mut port = world.serial(PORT, &Slave::LINE).unwrap();
        world.advance(round % 7 * 10 * US);
        if port.opened().is_some() {
            port.send(0, &Slave::request(7, round as u8)).unwrap();
            world.advance(round % 11 * 13 * US);
            if round % 3 == 0 {
                port.abandon(0, "again");
            }
        }
    }
    world.advance(S);
    assert_eq!(world.lock().next_due(), None);
    let mut port = open(&world);
    port.send(0, &Slave::request(9, 1)).unwrap();
    world.advance(MS);
    assert_eq!(read(&mut *port), [137, 1, 1]);
}

#[test]
fn the_same_seed_makes_the_same_bytes() {
    let stormy = FaultPlan {
        seed: 5,
        drop: 0.1,
        duplicate: 0.1,
        corrupt: 0.1,
        delay: 0.1,
        delay_ns: 3 * MS,
        reorder: 0.1,
        restart: 0.01,
        ..FaultPlan::default()
    };
    let run = |faults: &FaultPlan| {
        let world = world(faults);
        let mut port = open(&world);
        let mut got = Vec::new();
        for number in 0..250 {
            port.send(0, &Slave::request(7 + number % 2 * 2, number)).unwrap();
            world.advance(400 * US);
            got.extend(read(&mut *port));
        }
        (world.digest(), world.delivered(), got, world.wire_injected(PORT))
    };
    assert_eq!(run(&stormy), run(&stormy));
    assert_ne!(run(&stormy).0, run(&FaultPlan { seed: 6, ..stormy.clone() }).0);
}
