//! Slaves that another hand describes: the segment of a real coupler with its terminals, slaves without a processor,
//! and such that compare, hold back, or answer late. Each row comes up and works, or is refused by name.
//!
//! The rows are configurations as a user writes them.

use fieldbeat::axis::{Command, Link};
use fieldbeat::bus::ethercat::Terminals;
use fieldbeat::config::{Configuration, parse};
use fieldbeat::internals::bus::ethercat::wire::frame::{Builder, Command as Frame};
use fieldbeat::sim::{SimSegment, WorldOptions};
use fieldbeat::time::MS;
use fieldbeat::{Master, Simulation};

use super::{LINE, Machine};

/// Cycles in which such a segment comes up.
const UP: u64 = 20_000;
/// A drive that is moved by positions.
const DRIVE: &str = "[[bus.drive]]\nname = \"k\"\npdo.outputs = \"0x1701\"\n";

/// The machine of a bus with these tables in it.
fn machine(tables: &str) -> Machine {
    let text = format!("[[bus]]\nprotocol = \"ethercat\"\ninterface = \"{LINE}\"\n{tables}");
    let Configuration { plan, simulation } = parse(&text, "strict.toml").unwrap_or_else(|errors| {
        panic!("{text}: {:?}", errors.iter().map(ToString::to_string).collect::<Vec<_>>())
    });
    let count = plan.axes().len();
    let master = Master::from_plan(plan);
    let sim: Simulation =
        master.simulate_with(simulation.build(), WorldOptions::default()).expect("it is sound");
    Machine { sim, count }
}

/// A drive with these keys of `simulate`, and how long it took to come up.
fn drive_up(keys: &str) -> (Machine, u64) {
    let mut machine = machine(&format!("{DRIVE}simulate = {{ {keys} }}\n"));
    let took = machine.until(keys, UP, |machine| machine.feedback(0).link == Link::Online);
    machine.done(0, Command::Enable);
    machine.assert_no_misuse();
    (machine, took)
}

/// The same, and to its orderly end: what the master does is what real hardware tolerates.
fn drive_up_and_down(keys: &str) {
    drive_up(keys).0.end_well();
}

/// Why the drive with these keys is not there in the end.
fn drive_refused(keys: &str) -> String {
    let mut machine = machine(&format!("{DRIVE}simulate = {{ {keys} }}\n"));
    machine.run(UP);
    let end = machine.sim.finish();
    end.drives[0].not_connected.clone().expect("it is not online")
}

fn device(name: &str, kind: &str, data: &str, more: &str) -> String {
    format!("[[bus.device]]\nname = \"{name}\"\n{data}\nsimulate = {{ type = \"{kind}\"{more} }}\n")
}

fn outputs(machine: &mut Machine, name: &str) -> Terminals {
    let terminals: Terminals = machine.sim.device(name).expect("it is a terminal");
    machine.until(name, UP, |_| terminals.inputs().operational);
    terminals
}

const OUT: &str = "outputs = { start = 0x0F00, length = 1 }";
const IN: &str = "inputs = { start = 0x1000, length = 1 }";

/// A coupler, an input and an output terminal that are wired to each other, and a drive behind them.
fn terminals(outputs_type: &str, inputs_type: &str, of_drive: &str) -> String {
    [
        device("coupler", "EK1100", "", ""),
        device("in", inputs_type, IN, ""),
        device("out", outputs_type, OUT, ", wired_to = \"in\""),
        format!("{DRIVE}{of_drive}"),
    ]
    .concat()
}

/// Outputs are seen at the inputs that they are wired to, through this mask.
fn outputs_are_seen(tables: &str, mask: u8) {
    let mut machine = machine(tables);
    let mut out = outputs(&mut machine, "out");
    let seen = outputs(&mut machine, "in");
    for byte in [0x5A, 0xA5, 0xFF, 0x00] {
        out.write(&[byte]).unwrap();
        machine.run(10);
        assert_eq!(seen.inputs().bytes(), [byte & mask], "{byte:#x}");
    }
    machine.online();
    machine.done(0, Command::Enable);
    machine.end_well();
}

#[test]
fn a_coupler_and_its_terminals_come_up_and_outputs_are_seen_at_inputs() {
    outputs_are_seen(&terminals("EL2008", "EL1008", ""), 0xFF);
}

#[test]
fn terminals_of_two_and_four_bits_take_a_byte_each() {
    outputs_are_seen(&terminals("EL2004", "EL1004", ""), 0x0F);
    outputs_are_seen(&terminals("EL2002", "EL1008", ""), 0x03);
    outputs_are_seen(&terminals("EL2008", "EL1002", ""), 0x03);
}

#[test]
fn a_drive_behind_another_port_of_the_coupler_comes_up() {
    let behind = "simulate.behind = { slave = \"coupler\", port = 2 }\n";
    outputs_are_seen(&terminals("EL2008", "EL1008", behind), 0xFF);
}

/// Cables of 500 ns: as a line, the last drive would be 1.5 us off.
#[test]
fn clocks_in_two_branches_have_one_time() {
    let last = DRIVE.replace("\"k\"", "\"last\"") + "simulate.behind = { slave = \"coupler\", port = 2 }\n";
    let mut machine = machine(&(terminals("EL2008", "EL1008", "") + &last));
    machine.online();
    let now = machine.sim.world().now();
    let [first, last] = machine.look(|line| [3, 4].map(|place| line.slave(place).unwrap().system_time(now)));
    assert!(first.abs_diff(last) < 200, "{first} {last}");
    machine.end_well();
}

#[test]
fn sixteen_outputs_behind_two_sync_managers_all_move() {
    let mut machine = machine(
        &[
            device("in", "EL1809", "inputs = { start = 0x1000, length = 2 }", ""),
            device(
                "out",
                "EL2809",
                "outputs = [{ start = 0x0F00, length = 1 }, { start = 0x0F01, length = 1 }]",
                ", wired_to = \"in\"",
            ),
            DRIVE.to_owned(),
        ]
        .concat(),
    );
    let mut out = outputs(&mut machine, "out");
    let seen = outputs(&mut machine, "in");
    for bytes in [[1, 2], [0x80, 0x40], [0xFF, 0]] {
        out.write(&bytes).unwrap();
        machine.run(10);
        assert_eq!(seen.inputs().bytes(), bytes);
    }
    machine.end_well();
}

#[test]
fn an_analogue_terminal_with_a_mailbox_comes_up_and_its_inputs_live() {
    let data =
        "mailbox = { out = [0x1000, 128], in = [0x1080, 128] }\ninputs = { start = 0x1180, length = 8 }";
    let mut machine = machine(&(device("analogue", "EL3102", data, "") + DRIVE));
    let terminal = outputs(&mut machine, "analogue");
    let value = |terminal: &Terminals| {
        i16::from_le_bytes([terminal.inputs().bytes()[2], terminal.inputs().bytes()[3]])
    };
    let before = value(&terminal);
    machine.run(100);
    assert_eq!(value(&terminal).wrapping_sub(before), 100, "1 a millisecond");
    machine.end_well();
}

#[test]
fn a_processor_that_compares_its_sync_managers_gets_those_of_its_sii() {
    drive_up_and_down("exact_managers = true, output_control = 0x24");
    drive_up_and_down("exact_managers = true, output_control = 0x64");
}

#[test]
fn an_sii_is_taken_read_and_given_back_however_slow_it_is() {
    for keys in [
        "sii.owned_by_slave = true",
        "sii.read_in_preop = true",
        "sii.owned_by_slave = true, sii.read_in_preop = true",
        "sii.eight_bytes = true",
        "sii.busy = \"5ms\"",
        "sii.loading = \"200ms\"",
        "sii.slips = true",
        "sii.fails_every = 3",
    ] {
        drive_up_and_down(keys);
    }
}

#[test]
fn an_sii_that_is_not_loaded_or_always_fails_is_refused_by_name() {
    let why = drive_refused("sii.content = \"unloaded\"");
    assert!(why.contains("it has not loaded its EEPROM"), "{why}");
    let why = drive_refused("sii.fails_every = 1");
    assert!(why.contains("refuses to be read"), "{why}");
}

#[test]
fn an_sii_with_a_wrong_checksum_is_refused_by_name() {
    let why = drive_refused("sii.content = \"wrong-check\"");
    assert!(why.contains("checksum"), "{why}");
}

/// Its identity is that of the configuration, so it comes up by that. A watchdog that is left to its SII it has not.
#[test]
fn a_senseless_sii_costs_the_watchdog_that_is_left_to_it_which_is_named() {
    let (machine, _) = drive_up("sii.content = \"garbage\"");
    let remarks = machine.sim.remarks();
    assert!(
        matches!(&remarks[..], [one] if one.starts_with("drive k: place 0: its SII has no SyncManagers")),
        "{remarks:?}"
    );
}

#[test]
fn a_watchdog_that_is_left_to_an_sii_without_one_is_named() {
    let (machine, _) = drive_up("output_control = 0x24");
    let remarks = machine.sim.remarks();
    assert!(
        matches!(&remarks[..], [one] if one.starts_with("drive k: place 0: its SII arms no watchdog")),
        "{remarks:?}"
    );
    assert_eq!(drive_up("output_control = 0x64").0.sim.remarks(), [""; 0]);
}

#[test]
fn slaves_with_two_fmmus_are_enough_and_with_one_are_refused_by_name() {
    drive_up_and_down("fmmus = 2");
    let why = drive_refused("fmmus = 1");
    assert!(why.contains("FMMU"), "{why}");
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
            0xFF,
        );
    }
}

/// The time of the watchdog, which that master has switched off, is part of what it left.
#[test]
fn outputs_that_another_master_left_without_a_watchdog_go_off_when_this_one_dies() {
    let left = |keys: &str| format!(", left = \"unwatched\"{keys}");
    let mut machine = machine(
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

#[test]
fn a_slow_mailbox_is_waited_for_and_a_lost_answer_costs_no_new_start() {
    for keys in [
        "mailbox.delay = \"300ms\"",
        "mailbox = { delay = \"1500ms\", delay_every = 5 }",
        "mailbox = { lose_every = 4, resends = false }",
        "mailbox = { lose_every = 4 }",
        "mailbox = { delay = \"2500ms\", delay_every = 6, resends = false }",
    ] {
        drive_up_and_down(keys);
    }
}

#[test]
fn clocks_of_32_bits_and_none_take_part() {
    drive_up_and_down("clock = \"short\"");
    let mut machine = machine(&format!("{DRIVE}sync = false\nsimulate.clock = \"none\"\n"));
    machine.online();
    machine.done(0, Command::Enable);
    machine.end_well();
}
