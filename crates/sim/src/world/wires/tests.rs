//! A master's port in a world.

use super::*;
use crate::Simulated;
use crate::serial::tests::wire_at;
use crate::testing::Slave;
use crate::world::WorldOptions;
use fieldbeat_core::net::{Carriers, Parity};
use fieldbeat_core::rt::{Clock, PollSet};
use fieldbeat_core::time::{MS, S, US};

const PORT: &str = "/dev/ttyUSB0";
const BYTE: u64 = 22 * US;

fn world(faults: &FaultPlan) -> World {
    let wires =
        [PORT, "/dev/ttyUSB1"].map(|port| SerialWire { faults: faults.clone(), ..wire_at(port, &[7, 9]) });
    let simulated = Simulated { wires: wires.into(), ..Simulated::default() };
    World::new(simulated, WorldOptions { read_ns: 0, ..WorldOptions::default() }).unwrap()
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
    assert!(world.open_sto_on(PORT, 1, MS));
    let until = world.now() + MS;
    assert_eq!(world.look_on(PORT, 1, |slave: &mut Slave, _| slave.sto_open), Some(until));
    drop(port);
    let other = SerialLine { parity: Parity::None, ..Slave::LINE };
    let mut port = world.serial(PORT, &other).unwrap();
    until_open(&world, &mut *port);
    port.send(0, &Slave::request(7, 4)).unwrap();
    world.advance(MS);
    assert_eq!(read(&mut *port), [0; 0]);
}
