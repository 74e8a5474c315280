//! Slaves that are not like the usual ones: such that show a device id, clocks that settle as slowly as real ones.
//! Others are rows of the conformance suite.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::{Area, Device, SlavePlan, Terminals};
use fieldbeat::sim::WorldOptions;
use fieldbeat::sim::ethercat::{EthercatSegment, EthercatSim};
use fieldbeat::time::MS;
use fieldbeat_ethercat::counters::Own;

use super::drives::left;
use super::{CyclePlan, Machine, jog, plan};

#[test]
fn a_device_id_in_the_al_status_is_no_error() {
    let slave = SlavePlan {
        outputs: vec![Area { start: 0x1000, length: 1 }],
        inputs: vec![Area { start: 0x1100, length: 1 }],
        ..SlavePlan::new(1)
    };
    // A drive, terminals of a byte either way, and another drive.
    let mut plan = plan(3);
    plan.drives.remove(1);
    plan.devices.push(Device { name: "io".into(), slave });
    let mut segment = EthercatSegment::from(plan);
    segment.settings.device_ids = true;
    let mut machine = Machine::new(segment);
    let mut terminals: Terminals = machine.sim.device("io").unwrap();
    machine.online();
    machine.each(Command::Enable);
    for index in 0..2 {
        machine.post(index, jog(2.0));
    }
    machine.run(3_000);
    assert!(terminals.inputs().operational);
    for byte in [0xA5, 0x5A] {
        terminals.write(&[byte]).unwrap();
        machine.run(4);
        assert_eq!(terminals.inputs().bytes(), [byte]);
    }
    for (index, place) in [(0, 0), (1, 2)] {
        let feedback = machine.feedback(index);
        assert!(feedback.age == 0 && (feedback.status.velocity - 2.0).abs() < 0.1, "{feedback:?}");
        assert!((machine.drive(place, |drive| drive.rpm()) - 120.0).abs() < 3.0);
    }
    for counters in machine.end() {
        assert_eq!((counters.own[Own::AlErrors as usize], counters.own[Own::WrongCount as usize]), (0, 0));
    }
}

#[test]
fn clocks_that_settle_as_slowly_as_real_ones_are_waited_for() {
    for (leads, period) in [(false, MS), (true, MS), (true, 2 * MS), (true, 4 * MS)] {
        let mut segment = EthercatSegment::from(plan(3));
        segment.settings.settling = 1_024;
        segment.settings.drift_ppm = vec![30.0, -30.0, 10.0];
        let reference = leads.then(|| segment.plan.name.clone());
        let cycle = CyclePlan { period_ns: period, reference, ..CyclePlan::default() };
        let drives = left(EthercatSim::new(&segment));
        let mut machine = Machine::on(Box::new(segment.plan), drives, cycle, WorldOptions::default());
        let took = machine.until("online", 20_000, |machine| {
            (0..3).all(|index| machine.feedback(index).link == Link::Online)
        });
        assert!(took > 2_000, "they need some thousand frames, not {took}");
        machine.each(Command::Enable);
        machine.post(1, jog(2.0));
        machine.run(300);
        machine.assert_turns(1, 2.0);
    }
}
