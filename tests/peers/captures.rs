//! What Wireshark's dissectors make of an exported capture: all five wires, recorded in virtual time.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use fieldbeat::Master;
use fieldbeat::axis::{Command, Link};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::Recorder;

use crate::capture::dissect;
use crate::support::{checkout, run};

/// The machine of the demo, its Unidrives at the usual port.
fn capture(directory: &Path) -> PathBuf {
    let text = fs::read_to_string(checkout("rt-config/demo.toml")).unwrap();
    let (config, file) = (directory.join("demo.toml"), directory.join("run.mcap"));
    fs::write(&config, text.replace(":1502", "")).unwrap();
    let recorder = Recorder::create(&file).unwrap().with_wire().unwrap();
    let setup = Master::from_file(&config).unwrap().with_recorder(recorder);
    let mut machine = setup.simulate(WorldOptions::default()).unwrap();
    let axes = machine.plan().axes().len();
    assert!(
        machine.run_until(20_000, |machine| {
            (0..axes).all(|axis| machine.feedback(axis).link == Link::Online)
        })
    );
    for axis in 0..axes {
        machine.axis(axis).post(Command::Enable).unwrap();
    }
    machine.run(2_000);
    assert!(machine.world().restart("127.77.1.11:502".parse().unwrap()));
    machine.run(6_000);
    assert!(machine.finish_recording()[0].failure().is_none());
    run(["export", file.to_str().unwrap(), "--pcapng"]).expect(0);
    file.with_extension("pcapng")
}

/// Values of the fields of each frame that the filter passes.
fn fields(file: &Path, filter: &str, fields: &[&str]) -> Vec<Vec<String>> {
    // Guesses at the payload of UDP are not part of the test.
    let options = ["-d", "udp.port==49360,data"];
    let sums = ["ip", "udp", "tcp"].map(|of| format!("{of}.check_checksum:TRUE"));
    let sums = sums.iter().flat_map(|sum| ["-o", sum]);
    let options: Vec<&str> = options.into_iter().chain(sums).collect();
    let lines = dissect(file, filter, &options, fields);
    lines.iter().map(|line| line.split('|').map(str::to_owned).collect()).collect()
}

/// The number behind `key` in a line.
fn number(line: &str, key: &str) -> Option<u64> {
    let rest = line.split_once(key)?.1;
    let (digits, radix) = rest.strip_prefix("0x").map_or((rest, 10), |digits| (digits, 16));
    let end = digits.find(|digit: char| !digit.is_digit(radix)).unwrap_or(digits.len());
    u64::from_str_radix(&digits[..end], radix).ok()
}

fn parse(field: &str) -> Option<u64> {
    number(field, "").filter(|_| !field.is_empty())
}

#[test]
#[ignore = "needs tshark"]
fn the_dissectors_find_the_fields_of_all_wires_in_an_exported_capture() {
    let directory = tempfile::tempdir().unwrap();
    let file = capture(directory.path());
    let printed = run(["decode", file.to_str().unwrap()]).expect(0).out.clone();
    let mut own = BTreeMap::<&str, Vec<&str>>::new();
    for line in printed.lines().filter(|line| line.contains(" > ")) {
        own.entry(line.split(' ').nth(1).unwrap()).or_default().push(line);
    }
    assert!(printed.lines().last().unwrap().contains(" telegrams: ") && own.len() == 5, "{:?}", own.keys());
    let of = |bus: &str, filter: &str, names: &[&str]| {
        let names = [&["frame.packet_flags_direction"], names].concat();
        let found = fields(&file, &format!("frame.interface_name == \"{bus}\" && ({filter})"), &names);
        assert!(found.len() > 500, "{bus}: {}", found.len());
        found
    };
    // Each of them, and which way it went.
    let same_ways = |bus: &str, found: &[Vec<String>]| {
        let ways = found.iter().map(|fields| if fields[0] == "0x00000002" { "out" } else { "in" });
        assert!(ways.eq(own[bus].iter().map(|line| line.split(' ').nth(2).unwrap())), "{bus}");
    };

    let trouble = "_ws.malformed || tcp.analysis.flags || ip.checksum.status == \"Bad\" || \
         udp.checksum.status == \"Bad\" || tcp.checksum.status == \"Bad\"";
    assert_eq!(fields(&file, trouble, &["frame.number", "_ws.col.Info"]), Vec::<Vec<String>>::new());

    let found = of(
        "modbus-tcp",
        "mbtcp",
        &[
            "tcp.stream",
            "mbtcp.trans_id",
            "modbus.func_code",
            "modbus.read_reference_num",
            "modbus.reference_num",
        ],
    );
    same_ways("modbus-tcp", &found);
    let mut streams = BTreeMap::<&str, u32>::new();
    for (fields, line) in found.iter().zip(&own["modbus-tcp"]) {
        assert_eq!(parse(&fields[2]), number(line, "transaction "), "{line}");
        assert_eq!(parse(&fields[3]), number(line, "of function "), "{line}");
        if line.contains(": request ") {
            let first = parse(&fields[4]).or(parse(&fields[5]));
            assert_eq!(first, number(line, "registers from "), "{line}");
        }
        *streams.entry(&fields[1]).or_default() += 1;
    }
    // Two drives, and the one that restarted.
    assert_eq!(streams.len(), 3, "{streams:?}");

    let found = of("ethercat", "ecat", &["ecat.cmd"]);
    same_ways("ethercat", &found);
    for (fields, line) in found.iter().zip(&own["ethercat"]) {
        const NAMES: [&str; 15] = [
            "NOP", "APRD", "APWR", "APRW", "FPRD", "FPWR", "FPRW", "BRD", "BWR", "BRW", "LRD", "LWR", "LRW",
            "ARMW", "FRMW",
        ];
        let names = fields[1].split(',').map(|command| NAMES[parse(command).unwrap() as usize]);
        let text = line.split_once(" ethercat: ").unwrap().1;
        let ours = text.split("; ").map(|datagram| datagram.split(' ').next().unwrap());
        assert!(names.eq(ours), "{line} {fields:?}");
    }

    let found = of("ethernet-ip", "enip", &["enip.cpf.sai.connid", "enip.cpf.sai.seq", "cipio"]);
    same_ways("ethernet-ip", &found);
    for (fields, line) in found.iter().zip(&own["ethernet-ip"]) {
        assert_eq!(parse(&fields[1]), number(line, "connection "), "{line}");
        assert_eq!(parse(&fields[2]), number(line, "sequence "), "{line}");
    }

    let found = of("linudp-v2", "udp && data", &["udp.dstport", "udp.payload"]);
    same_ways("linudp-v2", &found);
    for (fields, line) in found.iter().zip(&own["linudp-v2"]) {
        let is_request = fields[1] == "49360";
        let blocks = u32::from_str_radix(&fields[2][8..16], 16).unwrap().swap_bytes();
        let expected = if is_request { "request of" } else { "reply with" };
        assert!(line.contains(&format!("{expected} blocks {blocks:03x}h")), "{line} {fields:?}");
    }

    let found = of("profibus-dp", "user_dlt", &["data.data"]);
    same_ways("profibus-dp", &found);
    for (fields, line) in found.iter().zip(&own["profibus-dp"]) {
        let is_token = line.ends_with(": token");
        assert_eq!(fields[1].starts_with("dc"), is_token, "{line}");
        if !is_token
            && let Some((_, data)) = line.rsplit_once(": ").filter(|(front, _)| front.ends_with("ed"))
        {
            let data: String = data.split(' ').collect();
            assert!(fields[1].contains(&data), "{line} {fields:?}");
        }
    }
}
