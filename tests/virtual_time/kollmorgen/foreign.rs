//! Segments that another master left behind, as configurations: drive, coupler and terminals, in any state.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::Terminals;
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::{SimSegment, WorldOptions};
use fieldbeat::time::MS;
use fieldbeat::{Master, Simulation};
use fieldbeat_ethercat::wire::frame::{Builder, Command as Frame};

use super::{LINE, Machine, UP};

/// A drive that is moved by positions.
const DRIVE: &str = "[[bus.drive]]\nname = \"k\"\npdo.outputs = \"0x1701\"\n";
const OUT: &str = "outputs = { start = 0x0F00, length = 1 }";
const IN: &str = "inputs = { start = 0x1000, length = 1 }";

/// The machine of a bus with these tables in it, as a user writes them.
pub fn machine_of(tables: &str) -> Machine {
    let text = format!("[[bus]]\nprotocol = \"ethercat\"\ninterface = \"{LINE}\"\n{tables}");
    let Configuration { plan, simulation, .. } = parse(&text, "foreign.toml").unwrap_or_else(|errors| {
        panic!("{text}: {:?}", errors.iter().map(ToString::to_string).collect::<Vec<_>>())
    });
    let count = plan.axes().len();
    let master = Master::from_plan(plan);
    let sim: Simulation =
        master.simulate_with(simulation.build(), WorldOptions::default()).expect("it is sound");
    Machine { sim, count }
}

/// A drive that was left like this, and how long it took to come up.
fn drive_up(keys: &str) -> (Machine, u64) {
    let mut machine = machine_of(&format!("{DRIVE}simulate = {{ {keys} }}\n"));
    let took = machine.until(keys, UP, |machine| machine.feedback(0).link == Link::Online);
    machine.done(0, Command::Enable);
    machine.assert_no_misuse();
    (machine, took)
}

fn device(name: &str, kind: &str, data: &str, more: &str) -> String {
    format!("[[bus.device]]\nname = \"{name}\"\n{data}\nsimulate = {{ type = \"{kind}\"{more} }}\n")
}

fn outputs(machine: &mut Machine, name: &str) -> Terminals {
    let terminals: Terminals = machine.sim.device(name).expect("it is a terminal");
    machine.until(name, UP, |_| terminals.inputs().operational);
    terminals
}

/// Outputs are seen at the inputs that they are wired to.
fn outputs_are_seen(tables: &str) {
    let mut machine = machine_of(tables);
    let mut out = outputs(&mut machine, "out");
    let seen = outputs(&mut machine, "in");
    for byte in [0x5A, 0xA5, 0xFF, 0x00] {
        out.write(&[byte]).unwrap();
        machine.run(10);
        assert_eq!(seen.inputs().bytes(), [byte], "{byte:#x}");
    }
    machine.online();
    machine.done(0, Command::Enable);
    machine.end_well();
}

#[test]
fn a_segment_that_another_master_left_is_taken_over() {
    let (_, fresh) = drive_up("");
    for left in ["op", "safeop", "watchdog", "unwatched"] {
        let (machine, took) = drive_up(&format!("left = \"{left}\""));
        // One in OP gives the segment its time, to which the grid is led by a 2000th: half a period at most.
        let led = if matches!(left, "op" | "unwatched") { 1_000 } else { 0 };
        assert!(took <= fresh + fresh / 10 + led, "{left}: {took} cycles, and {fresh} of a fresh one");
        machine.end_well();
        // All of them, and each has the station address of its neighbour.
        let of = |keys: &str| format!(", left = \"{left}\"{keys}");
        outputs_are_seen(
            &[
                device("coupler", "EK1100", "", &of("")),
                device("in", "EL1008", IN, &of("")),
                device("out", "EL2008", OUT, &of(", wired_to = \"in\"")),
                format!("{DRIVE}simulate.left = \"{left}\"\n"),
            ]
            .concat(),
        );
    }
}

/// The time of the watchdog, which that master has switched off, is part of what it left.
#[test]
fn outputs_that_another_master_left_without_a_watchdog_go_off_when_this_one_dies() {
    let left = |keys: &str| format!(", left = \"unwatched\"{keys}");
    let mut machine = machine_of(
        &[
            device("coupler", "EK1100", "", &left("")),
            device("in", "EL1008", IN, &left("")),
            device("out", "EL2008", OUT, &left(", wired_to = \"in\"")),
        ]
        .concat(),
    );
    let mut out = outputs(&mut machine, "out");
    out.write(&[0x5A]).unwrap();
    machine.run(10);
    let now = machine.sim.world().now();
    let driven = [90, 110].map(|ms| {
        machine.look(|line| {
            // Of anybody, with nothing in it.
            let mut frame = vec![0; 64];
            let mut builder = Builder::new(&mut frame, [0xFF; 6], [0; 6]).unwrap();
            builder.push(Frame::Nop, 0, 1).unwrap();
            builder.finish();
            line.pass(now + ms * MS, &mut frame);
            line.slave(2).unwrap().driven().to_vec()
        })
    });
    assert_eq!(driven, [vec![0x5A], vec![]], "100 ms, as its SII and power-on have it");
}
