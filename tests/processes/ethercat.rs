//! `fieldbeat ethercat scan`: of a segment on this host, without any right, and of what is none.

use fieldbeat::bus::ethercat::{Area, Device, EthercatPlan, Family, KollmorgenDrive, SlavePlan, Watchdog};
use fieldbeat::sim::ethercat::{Coupler, EthercatSegment, SegmentSettings};
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::sim::{FaultPlan, SimPlan};
use fieldbeat::time::MS;
use libc::SIGINT;

use super::support::{Machine, Program, as_ordinary_user, run};

/// A segment on this host: a coupler and two drives.
struct Line {
    interface: String,
    server: SimServer,
}

impl Line {
    fn start(test: u8, faults: FaultPlan) -> Line {
        let interface = format!("local:tests-{}-{test}", std::process::id());
        let drives = [1, 2].map(|place| {
            let mut drive = KollmorgenDrive::new(format!("d{place}"), place, Family::S700);
            drive.slave.watchdog = Watchdog::After(100 * MS);
            drive
        });
        let mut plan = EthercatPlan::new(&interface, drives.into());
        let slave = SlavePlan { inputs: vec![Area { start: 0x1000, length: 2 }], ..SlavePlan::new(0) };
        plan.devices.push(Device { name: "io".into(), slave });
        let segment = EthercatSegment {
            settings: SegmentSettings { faults, ..SegmentSettings::default() },
            // Without terminals.
            devices: vec![Coupler::default()],
            ..plan.into()
        };
        let simulated = SimPlan::from(segment).build();
        Line { interface, server: SimServer::start(simulated, ServerOptions::default()).unwrap() }
    }

    /// A scan of it takes seconds.
    fn slow(test: u8) -> Line {
        Line::start(test, FaultPlan { delay: 1.0, delay_ns: 10 * MS, ..FaultPlan::default() })
    }

    fn scan(&self, options: &[&str]) -> Program {
        let words = ["ethercat", "scan", &self.interface];
        Program::start(words.iter().chain(options))
    }
}

#[test]
fn a_segment_is_printed_as_a_table_and_as_json() {
    let line = Line::start(1, FaultPlan::default());
    let ended = line.scan(&[]).end();
    ended.expect(0);
    assert_eq!(ended.err, "");
    let rows: Vec<Vec<&str>> = ended.out.lines().map(|row| row.split_whitespace().collect()).collect();
    assert_eq!(rows[0][..5], ["place", "station", "state", "name", "vendor"]);
    assert_eq!(rows[2][..6], ["1", "0x0000", "INIT", "S700", "0x0000006a", "0x03000600"]);
    assert_eq!(rows[2][8..], ["CoE", "16", "0", "0", "64", "bit", "0", "1", "8/8"]);
    assert!(ended.out.contains("place 2: by default 6 bytes of outputs, 8 of inputs\n"), "{}", ended.out);
    assert!(ended.out.lines().all(|line| line == line.trim_end()), "{}", ended.out);

    let ended = line.scan(&["--json"]).end();
    ended.expect(0);
    let json = ended.json();
    assert_eq!(json["interface"], line.interface);
    let places: Vec<_> = json["slaves"].as_array().unwrap().iter().map(|slave| &slave["place"]).collect();
    assert_eq!(places, [0, 1, 2]);
    let drive = &json["slaves"][1];
    assert_eq!(
        (&drive["state"], &drive["error"], &drive["clock_bits"]),
        (&"INIT".into(), &false.into(), &64.into())
    );
    assert_eq!(drive["sii"]["mailbox"]["protocols"][0], "CoE");
    assert_eq!((&drive["sii"]["outputs"], &drive["sii"]["inputs"]), (&6.into(), &8.into()));
    assert_eq!(json["slaves"][0]["sii"]["mailbox"], serde_json::Value::Null);
    assert_eq!(json["slaves"][0]["clock_bits"], serde_json::Value::Null);
    assert_eq!(json["slaves"][2]["ports"][1]["link"], false);
}

#[test]
fn a_segment_that_is_silent_or_goes_away_is_reported_in_one_line() {
    let silent = Line::start(2, FaultPlan { drop: 1.0, ..FaultPlan::default() });
    silent.scan(&[]).end().failed(&["no slave answers; check power and cable"]);
    let line = Line::slow(3);
    let scan = line.scan(&["--json"]);
    scan.await_handler(SIGINT);
    drop(line.server);
    scan.end().failed(&["nothing serves this segment"]);
}

#[test]
fn ctrl_c_ends_it_at_once() {
    let line = Line::slow(4);
    let scan = line.scan(&[]);
    scan.await_handler(SIGINT);
    scan.signal(SIGINT);
    scan.end().failed(&["interrupted"]);
}

#[test]
fn what_is_no_segment_is_reported_in_one_line() {
    run(["ethercat", "scan", "eth-none-here"])
        .refused(&["there is no network interface eth-none-here", "ip link"]);
    run(["ethercat", "scan", "local:"]).refused(&["a name has 1 to"]);
    run(["ethercat", "scan", "local:nobody"])
        .failed(&["nothing serves this segment; start it: fieldbeat sim CONFIG"]);
    run(["ethercat", "scan"]).refused(&["<INTERFACE>; see `fieldbeat ethercat scan --help`"]);
}

#[test]
fn an_ordinary_user_learns_which_right_is_missing_and_how_to_get_it() {
    let machine = Machine::new(161);
    let ended = Program::spawn(as_ordinary_user(&machine).args(["ethercat", "scan", "lo"])).end();
    ended.refused(&["no right for raw frames on lo (CAP_NET_RAW); grant it: sudo setcap cap_net_raw+ep /"]);
}
