//! Terminals: digital outputs in the registers of the controller, several SyncManagers in one direction, and what a
//! slave's SII has instead.

use fieldbeat::CyclePlan;
use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::{Area, Device, EthercatPlan, Family, SlavePlan, Terminals};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::WorldOptions;
use fieldbeat_ethercat::counters::Own;
use fieldbeat_ethercat::wire::frame::{Command as Datagram, position};
use fieldbeat_ethercat::wire::registers::address;
use fieldbeat_sim::ethercat::{EthercatSegment, EthercatSim};

use super::drives::left;
use super::{LINE, Machine, drive};

fn area(start: u16, length: u16) -> Area {
    Area { start, length }
}

/// A drive, and a device whose outputs are its inputs, too.
fn with(outputs: Vec<Area>, inputs: Vec<Area>) -> EthercatPlan {
    let slave = SlavePlan { outputs, inputs, ..SlavePlan::new(1) };
    let device = Device { name: "io".into(), slave };
    EthercatPlan { devices: vec![device], ..EthercatPlan::new(LINE, vec![drive(0, Family::S700)]) }
}

/// Its outputs, two bytes, come back as its inputs.
fn come_back(machine: &mut Machine) -> Terminals {
    let mut io = machine.sim.device::<Terminals>("io").unwrap();
    machine.online();
    machine.until("operational", 3_000, |_| io.inputs().operational);
    for outputs in [[0xA5, 0x5A], [0x01, 0x80]] {
        io.write(&outputs).unwrap();
        machine.run(4);
        assert_eq!(io.inputs().bytes(), outputs);
    }
    io
}

/// The same, and the drive takes part, too; nobody is accused of an error.
fn moves(segment: impl Into<EthercatSegment>) {
    let mut machine = Machine::new(segment);
    come_back(&mut machine);
    machine.done(0, Command::Enable);
    assert_eq!(machine.feedback(0).link, Link::Online);
    assert_eq!(machine.end()[0].own[Own::AlErrors as usize], 0);
}

#[test]
fn a_segment_without_a_drive_moves_its_outputs_and_names_what_is_missing() {
    let mut plan = with(vec![area(0x0F00, 2)], vec![area(0x1000, 2)]);
    plan.drives.clear();
    plan.devices[0].slave.place = 0;
    let mut machine = Machine::new(plan);
    let io = come_back(&mut machine);
    machine.sim.world().cut(LINE, Some(0));
    machine.until("lost", 1_000, |_| !io.inputs().operational);
    machine.sim.world().cut(LINE, None);
    machine.until("back", 5_000, |_| io.inputs().operational);
    assert_eq!(machine.end().len(), 0);
}

#[test]
fn the_sample_of_a_coupler_with_terminals_comes_into_operation() {
    let sample =
        include_str!("../../../../rt-config/terminals.toml").replace("\"eth1\"", &format!("\"{LINE}\""));
    let Configuration { mut plan, simulation, .. } = parse(&sample, "terminals.toml").unwrap();
    let bus = plan.buses.remove(0);
    let mut machine = Machine::on(bus, simulation.build(), plan.cycle, WorldOptions::default());
    let names = ["coupler", "switches", "valves", "pressure"];
    let mut devices = names.map(|name| machine.sim.device::<Terminals>(name).unwrap());
    assert_eq!(devices.each_ref().map(Terminals::sizes), [(0, 0), (0, 1), (1, 0), (0, 8)]);
    for device in &devices[1..] {
        machine.until("operational", 5_000, |_| device.inputs().operational);
    }
    for outputs in [0x5A, 0xA5] {
        devices[2].write(&[outputs]).unwrap();
        machine.run(6);
        assert_eq!(devices[1].inputs().bytes(), [outputs], "the switches show the valves");
    }
    // What stands there, once its SyncManager is off: an output cannot be read before.
    machine.pass(Datagram::Apwr(position(2), address::sync_manager(0) + 6), &[0]);
    assert_eq!(machine.pass(Datagram::Aprd(position(2), 0x0F00), &[0]), [0xA5]);
    let end = machine.sim.finish();
    let reported: Vec<_> = end.devices.into_iter().map(|device| device.not_operational).collect();
    assert_eq!(reported, [const { None }; 4]);
}

#[test]
fn all_areas_of_a_direction_move_in_the_order_of_the_list_and_those_side_by_side_share_an_fmmu() {
    let inputs = || vec![area(0x1000, 2)];
    for (second, fmmus) in [(0x0F02, 3), (0x0F02, 4), (0x0F02, 5), (0x0F01, 2)] {
        let mut segment = EthercatSegment::from(with(vec![area(0x0F00, 1), area(second, 1)], inputs()));
        let last = segment.plan.devices.last().unwrap().slave.place;
        (1..=last).for_each(|place| segment.settings.slaves.entry(place).or_default().fmmus = Some(fmmus));
        moves(segment);
    }
    // A device ID in the AL status is no error.
    let mut segment =
        EthercatSegment::from(with(vec![area(0x1000, 2)], vec![area(0x1100, 1), area(0x1200, 1)]));
    segment.settings.device_ids = true;
    moves(segment);
}

/// Why the device is refused by a master of one plan in a segment of the other.
fn refused(plan: EthercatPlan, there: impl Into<EthercatSegment>) -> String {
    let world = EthercatSim::new(&there.into());
    let mut machine = Machine::on(Box::new(plan), left(world), CyclePlan::default(), WorldOptions::default());
    machine.online();
    machine.run(2_000);
    let end = machine.sim.finish();
    assert_eq!(end.drives[0].not_connected, None);
    end.devices[0].not_operational.clone().expect("it is refused")
}

#[test]
fn process_data_that_the_sii_has_otherwise_are_named_with_both_values() {
    let there = || with(vec![area(0x0F00, 1), area(0x0F01, 1)], vec![area(0x1000, 2)]);
    let inputs = || vec![area(0x1000, 2)];
    for (plan, why) in [
        (
            with(vec![area(0x0F00, 2)], inputs()),
            "its SII has 1 bytes of outputs at 0x0f00, and the configuration 2: correct the configuration, \
             or use check_sii = false",
        ),
        (
            with(vec![area(0x0F00, 1)], inputs()),
            "its SII has outputs at 0x0f01, 1 bytes, which the configuration leaves out: add them",
        ),
        (
            with(vec![area(0x0F00, 1), area(0x0F04, 1)], inputs()),
            "its SII has outputs at 0x0f01, 1 bytes, and the configuration at 0x0f04: correct the \
             configuration",
        ),
        (
            with(vec![area(0x0F00, 1), area(0x0F01, 1)], vec![area(0x1000, 2), area(0x1100, 1)]),
            "its SII has no inputs at 0x1100: correct the configuration, or the order of the segment",
        ),
    ] {
        assert_eq!(refused(plan, there()), format!("place 1: {why}"));
    }
}
