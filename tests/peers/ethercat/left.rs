//! Our master on a segment that another master was killed on while its drives turned.

use std::process::Command;
use std::time::Duration;

use fieldbeat::bus::ethercat::{EthercatPlan, Family};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Overrun, Plan};

use super::{WIRE, at_master, cable, master, segment, serve, soem};
use crate::support::{Cable, LONG, Machine, Program};

/// Cycles of 2 ms until all drives are online on a segment that has just been switched on, or was left.
fn cycles_to_online(plan: EthercatPlan) -> u64 {
    let cycle = CyclePlan {
        period_ns: 2 * MS,
        receive_deadline: 0.8,
        overrun: Overrun::Skip { max_skip: 2_000 },
        max_skip_rate: 1.0,
        reference: Some(plan.name.clone()),
        ..CyclePlan::default()
    };
    let plan = Plan { source: None, cycle, buses: vec![Box::new(plan)], groups: Vec::new() };
    let master = Master::from_plan(plan).start().unwrap();
    master.wait_online(LONG).unwrap_or_else(|error| panic!("{error}: {:?}", master.numbers()));
    let executed = master.numbers().status.executed;
    let mut axis = master.axis("d1").unwrap();
    axis.enable().unwrap();
    axis.jog(1.0).unwrap();
    std::thread::sleep(Duration::from_millis(300));
    assert!(axis.feedback().status.velocity > 0.5, "{:?}", axis.feedback());
    axis.stop().unwrap();
    axis.disable().unwrap();
    master.finish();
    executed
}

fn is_taken_over(test: u8, peer: impl Fn(&str) -> Command) {
    let (_machine, cable) = (Machine::new(test), cable(test));
    let segment = || segment(Family::S700, 2, false);
    let online = || at_master(&cable, || cycles_to_online(segment().plan));
    let left = serve(&cable, segment());
    let mut holding = Program::spawn(&mut peer(&cable.master));
    holding.await_text("holding");
    holding.kill();
    // Their watchdogs take the slaves to SAFEOP, with an error.
    std::thread::sleep(Duration::from_millis(500));
    let taken_over = online();
    drop(left);
    let _fresh = serve(&cable, segment());
    let fresh = online();
    assert!(taken_over < fresh + fresh / 2 + 200, "{taken_over} cycles, {fresh} on a fresh segment");
    eprintln!("{taken_over} cycles, {fresh} on a fresh segment");
}

#[test]
#[ignore = "needs root, iproute2 and a package registry: builds the crate ethercrab"]
fn a_segment_that_ethercrab_left_in_op_is_taken_over() {
    let peer = master::build();
    is_taken_over(50, |namespace| {
        let mut command = Cable::command(namespace, peer.to_str().unwrap());
        command.args([WIRE, "2", "hold"]);
        command
    });
}

#[test]
#[ignore = "needs root, iproute2, python3 and pysoem"]
fn a_segment_that_soem_left_in_op_is_taken_over() {
    is_taken_over(51, |namespace| soem::program(namespace, "hold"));
}
