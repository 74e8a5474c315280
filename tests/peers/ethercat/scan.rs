//! `fieldbeat ethercat scan` over a real interface, and what Wireshark makes of its frames.

use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive};
use fieldbeat_core::net::{Carriers, Os};
use fieldbeat_sim::ethercat::EthercatSegment;

use super::dissector::{APRD, APWR, Address, BRD, NOP, dissect, exchanges};
use super::{ETHERTYPE, WIRE, cable, capture, segment, serve};
use crate::capture;
use crate::support::{Cable, Ended, LONG, Machine, PROGRAM, Program, UNJUDGED, command, until};

pub fn scan(cable: &Cable, options: &[&str]) -> Ended {
    let mut scan = Command::new(PROGRAM);
    scan.args(["ethercat", "scan", WIRE]).args(options);
    Program::spawn(&mut Cable::enter(&cable.master, &scan)).end()
}

#[test]
#[ignore = "needs root, iproute2 and tshark"]
fn tshark_finds_nothing_wrong_with_a_scan() {
    let (machine, cable) = (Machine::new(33), cable(33));
    let _line = serve(&cable, segment(Family::S700, 2, true));
    let mut ended = None;
    let file = capture(&cable, &machine, || ended = Some(scan(&cable, &["--json"])));
    let ended = ended.unwrap();
    ended.expect(0);
    let slaves = ended.json()["slaves"].clone();
    let reported = |key: &str| [0, 1, 2].map(|place: usize| slaves[place]["sii"][key].clone());
    assert_eq!(reported("vendor"), [2, 0x6A, 0x6A]);
    assert_eq!(reported("serial"), [0, 101, 102]);
    assert_eq!(slaves[1]["clock_bits"], 32);

    let exchanges = exchanges(&dissect(&file));
    let mut commands = 0;
    for (sent, back) in &exchanges {
        let back = back.as_ref().unwrap_or_else(|| panic!("it did not come back: {sent:?}"));
        assert_eq!((sent.datagrams[0].command, back.datagrams[0].working_counter), (NOP, 0));
        for (sent, back) in sent.datagrams.iter().zip(&back.datagrams).skip(1) {
            let (Address::Slave(first, register), Address::Slave(counted, same)) =
                (sent.address, back.address)
            else {
                panic!("{sent:?}")
            };
            // All three slaves count the position, and leave the register.
            assert_eq!((counted, same), ((first + 3) & 0xFFFF, register));
            match sent.command {
                BRD => assert_eq!(back.working_counter, 3),
                // A slave without a clock has no registers of one.
                APRD => assert!(back.working_counter == 1 || register >= 0x0900, "{back:?}"),
                // A repeated one may meet an EEPROM that is at work already.
                APWR => {
                    assert!(register == 0x0502 && back.working_counter <= 1, "{back:?}");
                    commands += back.working_counter;
                }
                other => panic!("command {other}"),
            }
        }
    }
    assert!(commands > 0, "no command of an SII");
    // The dissector reads what the program has printed.
    let features = capture::dissect(
        &file,
        "ecat.cmd == 1 && ecat.reg.features && ecat.cnt == 1",
        &[],
        &["ecat.reg.features.dcsupport", "ecat.reg.features.dc64support"],
    );
    let has_clock = |line: &&String| line.starts_with('1') || line.starts_with("True");
    assert_eq!(features.iter().filter(has_clock).count(), 2, "{features:?}");
}

#[test]
#[ignore = "needs root and iproute2"]
fn an_unusable_interface_is_reported_in_one_line() {
    let cable = cable(34);
    scan(&cable, &[]).failed(&["wire: no slave answers; check power and cable"]);
    cable.plug("down");
    scan(&cable, &[]).failed(&["wire: no cable, or nothing with power at its other end"]);
    command(&["ip", "-n", &cable.master, "link", "set", WIRE, "down"]);
    scan(&cable, &[]).failed(&["wire: the interface is down; set it up: sudo ip link set wire up"]);
}

/// Does something while another master, on the same interface, has a frame there every 2 ms.
fn beside_another<R>(cable: &Cable, run: impl FnOnce() -> R) -> R {
    let mut master = cable.at_master(|| Os::default().frames(WIRE, ETHERTYPE).unwrap());
    let end = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // BRD of the states, as a cycle has it.
        let mut frame = vec![0xFF; 6];
        frame.extend([0x10; 6]);
        frame.extend([0x88, 0xA4, 0x0E, 0x10, 7, 1, 0, 0, 0x30, 0x01, 2, 0, 0, 0, 0, 0, 0, 0]);
        frame.resize(60, 0);
        let end = &end;
        scope.spawn(move || {
            while !end.load(Ordering::Relaxed) {
                let _ = master.send(&frame);
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        let result = run();
        end.store(true, Ordering::Relaxed);
        result
    })
}

#[test]
#[ignore = "needs root and iproute2"]
fn a_scan_next_to_another_master_says_so_and_sends_nothing() {
    let cable = cable(35);
    let _line = serve(&cable, segment(Family::S700, 1, false));
    let ended = beside_another(&cable, || scan(&cable, &["--json"]));
    ended.failed(&["wire: another master (10:10:10:10:10:10) has frames on this interface; end it"]);
}

#[test]
#[ignore = "needs root and iproute2"]
fn a_master_is_not_started_next_to_another_one_and_is_stopped_by_a_later_one() {
    let (machine, cable) = (Machine::new(36), cable(36));
    let plan = EthercatPlan::new(WIRE, vec![KollmorgenDrive::new("d1", 0, Family::S700)]);
    let mut alone = EthercatSegment::from(plan);
    alone.settings.interface = Some(WIRE.into());
    let _line = serve(&cable, alone);
    let config = machine.write(
        "line.toml",
        format!(
            "[cycle]\nperiod = \"4ms\"\n\
             max_skip = \"30s\"\nmax_skip_rate = 1.0\n\
             {UNJUDGED}realtime = \"off\"\nreference = \"ethercat\"\n[[bus]]\nprotocol = \"ethercat\"\n\
             interface = \"{WIRE}\"\n[[bus.drive]]\nname = \"d1\"\nwatchdog = \"6s\"\nhealth = {{ bucket = \
             \"5s\", leak = 1 }}\n"
        ),
    );
    let master = |words: &[&str]| {
        let mut master = Command::new(PROGRAM);
        master.args(words).arg(&config);
        Cable::enter(&cable.master, &master)
    };
    let refused = "another master (10:10:10:10:10:10) already has frames on wire: end it";
    // The other one may be held up for as long as it is listened for.
    let mut ended = None;
    let is_refused = until(LONG, || {
        let run = || Program::spawn(&mut master(&["run", "--for", "1s"])).end();
        ended.insert(beside_another(&cable, run)).code == Some(2)
    });
    assert!(is_refused, "{ended:?}");
    ended.unwrap().refused(&[refused]);
    let mut running = Program::spawn(&mut master(&["run"]));
    running.await_text("all drives online");
    beside_another(&cable, || {
        running.await_text("drive d1: another master commands it: its axis is stopped")
    });
    running.end_by(libc::SIGTERM);
}
