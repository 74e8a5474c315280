//! Terminals: digital outputs in the registers of the controller, several SyncManagers in one direction, and what a
//! slave's SII has instead.

use fieldbeat::CyclePlan;
use fieldbeat::axis::Link;
use fieldbeat::bus::ethercat::{Area, Device, EthercatPlan, Family, SlavePlan, Terminals};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::ethercat::{EthercatSegment, EthercatSim, Model, SlaveSettings};
use fieldbeat::sim::{SimSegment, WorldOptions};
use fieldbeat_core::net::frames::MAC;
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command, position};
use fieldbeat_ethercat::wire::registers::address;

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

/// Its outputs, two bytes, come back as its inputs, and the drive takes part, too.
fn moves(segment: impl Into<EthercatSegment>) {
    let mut machine = Machine::new(segment);
    let mut io = machine.sim.device::<Terminals>("io").unwrap();
    machine.online();
    machine.until("operational", 3_000, |_| io.inputs().operational);
    for outputs in [[0xA5, 0x5A], [0x01, 0x80]] {
        io.write(&outputs).unwrap();
        machine.run(4);
        assert_eq!(io.inputs().bytes(), outputs);
    }
    assert_eq!(machine.feedback(0).link, Link::Online);
}

#[test]
fn a_segment_without_a_drive_moves_its_outputs_and_names_what_is_missing() {
    let mut plan = with(vec![area(0x0F00, 2)], vec![area(0x1000, 2)]);
    plan.drives.clear();
    plan.devices[0].slave.place = 0;
    let mut machine = Machine::new(plan);
    let mut io = machine.sim.device::<Terminals>("io").unwrap();
    machine.until("operational", 3_000, |_| io.inputs().operational);
    for outputs in [[0xA5, 0x5A], [0x01, 0x80]] {
        io.write(&outputs).unwrap();
        machine.run(4);
        assert_eq!(io.inputs().bytes(), outputs);
    }
    machine.sim.world().cut(LINE, Some(0));
    machine.until("lost", 1_000, |_| !io.inputs().operational);
    machine.sim.world().cut(LINE, None);
    machine.until("back", 5_000, |_| io.inputs().operational);
    assert_eq!(machine.end().len(), 0);
}

#[test]
fn the_sample_of_a_coupler_with_terminals_comes_into_operation() {
    let sample =
        include_str!("../../../rt-config/terminals.toml").replace("\"eth1\"", &format!("\"{LINE}\""));
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
    let mut frame = vec![0; 64];
    let mut builder = Builder::new(&mut frame, BROADCAST, MAC).unwrap();
    builder.push_with(Command::Apwr(position(2), address::sync_manager(0) + 6), 0, &[0]).unwrap();
    let at = builder.push(Command::Aprd(position(2), 0x0F00), 0, 1).unwrap();
    builder.finish();
    machine.sim.world().look(LINE, |line: &mut EthercatSim, now| line.pass(now, &mut frame)).unwrap();
    assert_eq!(frame[at.data()], [0xA5]);
    let end = machine.sim.finish();
    let reported: Vec<_> = end.devices.into_iter().map(|device| device.not_operational).collect();
    assert_eq!(reported, [const { None }; 4]);
}

#[test]
fn an_analogue_terminal_with_a_mailbox_comes_up_and_its_inputs_live() {
    let slave = SlavePlan {
        mailbox: Some([area(0x1000, 128), area(0x1080, 128)]),
        inputs: vec![area(0x1180, 8)],
        ..SlavePlan::new(1)
    };
    let device = Device { name: "analogue".into(), slave };
    let plan =
        EthercatPlan { devices: vec![device], ..EthercatPlan::new(LINE, vec![drive(0, Family::S700)]) };
    let mut segment = EthercatSegment::from(plan);
    let model = SlaveSettings { model: Some(Model::El3102), ..SlaveSettings::default() };
    segment.settings.slaves.insert(1, model);
    let mut machine = Machine::new(segment);
    let terminal: Terminals = machine.sim.device("analogue").unwrap();
    machine.online();
    machine.until("operational", 3_000, |_| terminal.inputs().operational);
    let value = || i16::from_le_bytes([terminal.inputs().bytes()[2], terminal.inputs().bytes()[3]]);
    let before = value();
    machine.run(100);
    assert_eq!(value().wrapping_sub(before), 100, "1 a millisecond");
    machine.end_well();
}

#[test]
fn all_areas_of_a_direction_move_in_the_order_of_the_list() {
    for fmmus in [3, 4, 5] {
        let plan = with(vec![area(0x0F00, 1), area(0x0F02, 1)], vec![area(0x1000, 2)]);
        let mut segment = EthercatSegment::from(plan);
        segment.settings.fmmus = vec![8, fmmus];
        moves(segment);
    }
    moves(with(vec![area(0x1000, 2)], vec![area(0x1100, 1), area(0x1200, 1)]));
}

#[test]
fn areas_that_follow_each_other_share_an_fmmu() {
    let mut segment =
        EthercatSegment::from(with(vec![area(0x0F00, 1), area(0x0F01, 1)], vec![area(0x1000, 2)]));
    segment.settings.fmmus = vec![8, 2];
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
            "its SII has 1 bytes of outputs at 0x0f00, and the configuration 2: correct the configuration, or use \
             check_sii = false",
        ),
        (
            with(vec![area(0x0F00, 1)], inputs()),
            "its SII has outputs at 0x0f01, 1 bytes, which the configuration leaves out: add them",
        ),
        (
            with(vec![area(0x0F00, 1), area(0x0F04, 1)], inputs()),
            "its SII has outputs at 0x0f01, 1 bytes, and the configuration at 0x0f04: correct the configuration",
        ),
        (
            with(vec![area(0x0F00, 1), area(0x0F01, 1)], vec![area(0x1000, 2), area(0x1100, 1)]),
            "its SII has no inputs at 0x1100: correct the configuration, or the order of the segment",
        ),
    ] {
        assert_eq!(refused(plan, there()), format!("place 1: {why}"));
    }
}
