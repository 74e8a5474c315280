//! The scans: of a line and of a wire on this host, without any right, of devices, and of addresses where nobody is.

use std::ffi::OsStr;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::thread::{self, JoinHandle};

use fieldbeat::sim::server::SimServer;
use fieldbeat_core::net::Place;
use libc::{SIGINT, SIGTERM};
use serde_json::Value;

use super::init::{check, init_by};
use super::support::{CABLE_NET, Cable, Ended, LONG, Machine, PROGRAM, Program};
use super::wires::{lenzes, line, moons, wire};
use super::{finish, online, patient_cycle, serve, simulation};

/// The words of each row of a table.
fn rows(table: &Ended) -> Vec<Vec<&str>> {
    table.expect(0).out.lines().map(|row| row.split_whitespace().collect()).collect()
}

/// A scan under way is interrupted.
#[track_caller]
fn interrupted(scan: Program) {
    scan.await_handler(SIGINT);
    scan.end_by(SIGINT).failed(&["interrupted"]);
}

fn scan(protocol: &str, options: &[&str]) -> Program {
    Program::start([protocol, "scan"].iter().chain(options))
}

/// A segment on this host: a coupler without terminals and two drives. `simulate` are keys of its wire.
fn segment(machine: &Machine, simulate: &str) -> (String, SimServer) {
    let interface = line(machine);
    let text = format!(
        "{}[[bus]]\nprotocol = \"ethercat\"\ninterface = \"{interface}\"\n{simulate}\n\
         [bus.defaults]\nwatchdog = \"100ms\"\n\
         [[bus.device]]\nname = \"io\"\ninputs = {{ start = 0x1000, length = 2 }}\n\
         [[bus.drive]]\nname = \"d1\"\n[[bus.drive]]\nname = \"d2\"\n",
        patient_cycle()
    );
    let config = machine.write("segment.toml", text);
    (interface, serve(&config))
}

#[test]
fn a_segment_is_printed_as_a_table_and_as_json() {
    let machine = Machine::new(161);
    let (interface, _sim) = segment(&machine, "");
    let ended = scan("ethercat", &[&interface]).end();
    let rows = rows(&ended);
    assert_eq!(ended.err, "");
    assert_eq!(rows[0][..5], ["place", "station", "state", "name", "vendor"]);
    assert_eq!(rows[2][..6], ["1", "0x0000", "INIT", "S700", "0x0000006a", "0x03000600"]);
    assert_eq!(rows[2][8..], ["CoE", "16", "0", "0", "64", "bit", "0", "1", "8/8"]);
    assert!(ended.out.contains("place 2: by default 6 bytes of outputs, 8 of inputs\n"), "{}", ended.out);
    assert!(ended.out.lines().all(|line| line == line.trim_end()), "{}", ended.out);

    let json = scan("ethercat", &[&interface, "--json"]).end().expect(0).json();
    assert_eq!(json["interface"], interface);
    let places: Vec<_> = json["slaves"].as_array().unwrap().iter().map(|slave| &slave["place"]).collect();
    assert_eq!(places, [0, 1, 2]);
    let [coupler, drive, last] = [0, 1, 2].map(|place| &json["slaves"][place]);
    assert_eq!(
        (&drive["state"], &drive["error"], &drive["clock_bits"]),
        (&"INIT".into(), &false.into(), &64.into())
    );
    assert_eq!(drive["sii"]["mailbox"]["protocols"][0], "CoE");
    assert_eq!((&drive["sii"]["outputs"], &drive["sii"]["inputs"]), (&6.into(), &8.into()));
    assert!(coupler["sii"]["mailbox"].is_null() && coupler["clock_bits"].is_null(), "{coupler}");
    assert_eq!(last["ports"][1]["link"], false);
}

#[test]
fn a_segment_that_is_silent_goes_away_or_is_not_waited_for_is_reported_in_one_line() {
    let machine = Machine::new(163);
    let (interface, silent) = segment(&machine, "simulate = { drop = 1.0 }");
    scan("ethercat", &[&interface]).end().failed(&["no slave answers; check power and cable"]);
    drop(silent);
    // A scan of it takes seconds.
    let (interface, slow) = segment(&machine, "simulate = { delay = 1.0, delay_by = \"10ms\" }");
    interrupted(scan("ethercat", &[&interface]));
    let scan = scan("ethercat", &[&interface, "--json"]);
    scan.await_handler(SIGINT);
    drop(slow);
    scan.end().failed(&["nothing serves this segment"]);
}

/// Each device, by its socket and serial number, answers each of so many requests that come to `socket`, twice.
fn answering(socket: UdpSocket, devices: Vec<(UdpSocket, u32)>, requests: usize) -> JoinHandle<()> {
    thread::spawn(move || {
        let mut request = [0; 64];
        for _ in 0..requests {
            let (size, from) = socket.recv_from(&mut request).unwrap();
            assert_eq!((size, &request[..4]), (24, &[0x63, 0, 0, 0][..]), "ListIdentity without data");
            for (socket, serial) in &devices {
                let SocketAddr::V4(at) = socket.local_addr().unwrap() else { panic!("{from}") };
                let name = b"STF10-IP";
                let mut item = vec![1, 0, 0, 2, 0xAF, 0x12];
                item.extend(at.ip().octets());
                item.extend([0; 8]);
                item.extend([60, 0, 43, 0, 0xB0, 0, 251, 3, 0, 0]);
                item.extend(serial.to_le_bytes());
                item.push(name.len() as u8);
                item.extend(name);
                item.push(3);
                let mut answer = request[..24].to_vec();
                answer[2] = item.len() as u8 + 6;
                answer.extend([1, 0, 0x0C, 0, item.len() as u8, 0]);
                answer.extend(item);
                for _ in 0..2 {
                    socket.send_to(&answer, from).unwrap();
                }
            }
        }
    })
}

#[test]
fn devices_are_listed_as_a_table_and_as_json_and_silent_ones_are_named() {
    let machine = Machine::new(162);
    let _sim = serve(&moons(&machine));
    let [feeder, turret, nobody] = [40, 41, 42].map(|host| machine.ip(host).to_string());
    let scan = |more: &[&str]| scan("ethernet-ip", more);
    // The second one comes first: the table is in the order of addresses.
    let table = scan(&[&turret, &feeder, "--bind", "127.0.0.1"]).end();
    let rows = rows(&table);
    assert_eq!(table.err, "");
    assert_eq!(rows[0], ["address", "name", "vendor", "type", "product", "revision", "serial", "state"]);
    assert_eq!(rows.len(), 3, "{}", table.out);
    for (row, address, name) in [(&rows[1], &feeder, "STF10-IP"), (&rows[2], &turret, "SSDC10-IP")] {
        assert_eq!(row[..2], [address.as_str(), name]);
    }
    let found = scan(&[&turret, &feeder, "--json"]).end().expect(0).json();
    let addresses = |found: &Value| -> Vec<String> {
        let all = found["devices"].as_array().unwrap().iter();
        all.map(|one| one["address"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(addresses(&found), [&*feeder, &*turret]);
    // By a broadcast in their network.
    let bind = machine.ip(1).to_string();
    let found = scan(&["--bind", &bind, "--json"]).end().expect(0).json();
    assert_eq!(addresses(&found), [&*feeder, &*turret]);

    let ended = scan(&[&feeder, &nobody]).end();
    assert_eq!(ended.expect(1).out.lines().count(), 2, "{}", ended.out);
    let silent = format!("fieldbeat: no answer from {nobody}:44818; check power, cable and address\n");
    assert_eq!(ended.err, silent);
    scan(&[&nobody]).end().failed(&["no device answers; check power, cable and address"]);
    interrupted(scan(&[&nobody]));
}

#[test]
#[ignore = "needs root and network namespaces (iproute2)"]
fn a_broadcast_finds_the_drives_on_a_cable() {
    let machine = Machine::new(224).on(CABLE_NET);
    let cable = Cable::new(224, &[40, 41]);
    let (socket, devices) = cable.among_drives(|| {
        let open = |ip| UdpSocket::bind(SocketAddrV4::new(ip, 44_818)).unwrap();
        (open(Ipv4Addr::BROADCAST), vec![(open(machine.ip(41)), 7), (open(machine.ip(40)), 0xC0FFEE)])
    });
    // A broadcast that was lost would not be waited for.
    socket.set_read_timeout(Some(LONG)).unwrap();
    // Each search asks twice.
    let devices = answering(socket, devices, 4);
    let bind = machine.ip(1).to_string();
    let program = || Cable::command(&cable.master, PROGRAM);

    let scan = Program::spawn(program().args(["ethernet-ip", "scan", "--bind", &bind, "--json"])).end();
    let json = scan.expect(0).json();
    let found: Vec<(&Value, &Value)> = (json["devices"].as_array().unwrap().iter())
        .map(|device| (&device["address"], &device["serial"]))
        .collect();
    let [first, second] = [40, 41].map(|host| Value::from(machine.ip(host).to_string()));
    assert_eq!(found, [(&first, &0xC0FFEE.into()), (&second, &7.into())]);

    let file = machine.path("machine.toml");
    let answers = format!("{bind}\nyes\n{}", "\n".repeat(30));
    let ended = init_by(program(), &file, &["--protocol", "ethernet-ip"], answers);
    ended.expect(0);
    let lines: Vec<&str> = ended.out.lines().filter(|line| line.starts_with("  STF10-IP")).collect();
    let expected = [40, 41].map(|host| format!("  STF10-IP at {}", machine.ip(host)));
    assert_eq!(lines, expected, "{}", ended.out);
    devices.join().unwrap();
    let plan = fieldbeat::config::load(&file).unwrap_or_else(|why| panic!("{why}")).plan;
    assert_eq!(plan.axes().len(), 2);
    let text = std::fs::read_to_string(&file).unwrap();
    let addresses: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("address = ")).collect();
    assert_eq!(addresses, [first.to_string(), second.to_string()], "{text}");
    check(&file).expect(0);
}

#[test]
fn stations_are_listed_by_a_scan_that_leaves_them_as_they_are_and_a_master_alone() {
    let machine = Machine::new(204);
    let device = wire(&machine);
    let config = machine.write("lenze.toml", lenzes(&device, ""));
    let scan = |options: &[&str]| scan("profibus", &[&[device.as_str()], options].concat());
    let sim = simulation(&config);
    let table = scan(&[]).end();
    let rows = rows(&table);
    assert_eq!(rows[0], ["address", "ident", "configuration", "master", "watchdog", "state"]);
    assert_eq!((rows.len(), &rows[1][..6]), (3, &["3", "0x0082", "[0xF3,", "0xF1]", "-", "off"][..]));
    // Nobody has parametrised them, and the scan has not either.
    let found = scan(&["--json"]).end().expect(0).json();
    assert_eq!((&found["device"], &found["rate"]), (&device.as_str().into(), &1_500_000.into()));
    let stations = found["stations"].as_array().unwrap();
    let addresses: Vec<&Value> = stations.iter().map(|station| &station["address"]).collect();
    assert_eq!(addresses, [3, 4], "{found}");
    for station in stations {
        let read = (&station["ident"], &station["master"], &station["watchdog"]);
        assert_eq!(read, (&0x82.into(), &Value::Null, &false.into()), "{station}");
        assert_eq!(station["configuration"], serde_json::json!([0xF3, 0xF1]), "{station}");
        let status = station["status"].as_array().unwrap();
        assert!(status.contains(&"parametrisation requested".into()), "{station}");
    }
    interrupted(scan(&[]));

    // Next to a master of this host.
    let master = online(&config, &["--json"]);
    scan(&[]).end().refused(&[&device, "is in use by another master"]);
    finish(master);
    sim.end_by(SIGTERM).expect(0);
    scan(&[]).end().refused(&["nobody simulates the wire", "start `fieldbeat sim`"]);

    // Next to one that this host does not know: nothing is sent.
    let foreign = "simulate = { second_master = 1, second_master_every = \"100ms\" }";
    let _sim = simulation(&machine.write("foreign.toml", lenzes(&device, foreign)));
    scan(&[]).end().failed(&[&device, "another master, address 1,", "end that one first"]);
}

#[test]
fn pin_adds_what_the_connected_drives_report_and_names_what_contradicts_the_file() {
    let machine = Machine::new(164);
    let [own, linmot, unidrive, moons] = [1, 10, 20, 40].map(|host| machine.ip(host));
    let text = format!(
        "{}[[bus]]\nprotocol = \"ethercat\"\ninterface = \"{}\"\n[[bus.drive]]\nname = \"e\"  # on the left\n\
         watchdog = \"100ms\"\nsimulate = {{ serial = 10, alias = 11 }}\n\
         [[bus]]\nprotocol = \"modbus-tcp\"\n[[bus.drive]]\nname = \"u\"\naddress = \"{unidrive}:1502\"\n\
         divisor = 8\nsimulate.serial = 12000000001\n\
         [[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"{own}\"\n[[bus.drive]]\nname = \"m\"\ndivisor = 8\n\
         address = \"{moons}\"\nsimulate.serial = 13\n\
         [[bus]]\nprotocol = \"linudp-v2\"\nbind = \"{own}\"\n[[bus.drive]]\nname = \"l\"\naddress = \"{linmot}\"\n\
         serial_from = \"0x0066\"\nsimulate.serial = 14\n",
        patient_cycle(),
        line(&machine),
    );
    let config = machine.write("pin.toml", text.clone());
    let _sim = serve(&config);
    let pin = |arguments: &[&str]| {
        let own = [OsStr::new("pin"), config.as_os_str()];
        Program::start(own.into_iter().chain(arguments.iter().map(OsStr::new))).end()
    };
    let lines = [
        "e: serial = 0x0000000a",
        "e: alias = 11",
        "u: serial = 12000000001",
        "m: product = 1",
        "m: serial = 0x0000000d",
        "l: serial = 14",
    ];
    let ended = pin(&[]);
    assert_eq!(ended.expect(0).out.lines().collect::<Vec<_>>(), lines, "{}", ended.err);
    assert_eq!(std::fs::read_to_string(&config).unwrap(), text, "only printed");
    pin(&["--write"]).expect(0);
    let written = std::fs::read_to_string(&config).unwrap();
    assert!(written.contains("name = \"e\"  # on the left\nserial = 0x0000000a\nalias = 11\n"), "{written}");
    let ended = pin(&[]);
    ended.expect(0);
    assert_eq!(ended.out.matches("as in the file").count(), lines.len(), "{}", ended.out);
    machine.write("pin.toml", written.replace("alias = 11\nwatchdog", "alias = 12\nwatchdog"));
    let ended = pin(&["--write"]);
    ended.expect(1);
    let said =
        "e: alias = 11 is what the drive reports, and not what the file has: drives or cables are exchanged";
    assert!(ended.err.contains(said), "{}", ended.err);
}

#[test]
fn pin_waits_for_drives_that_answer_late_and_says_who_else_is_there() {
    let machine = Machine::new(166);
    let [own, linmot, used, unidrive, nobody] = [1, 10, 11, 20, 21].map(|host| machine.ip(host));
    let drive = |name: &str, address: String, more: &str| {
        format!("[[bus.drive]]\nname = \"{name}\"\naddress = \"{address}\"\n{more}\n")
    };
    let late =
        drive("u", format!("{unidrive}:1502"), "simulate = { serial = 12, answer_time = \"700ms\" }\n");
    let lost = drive("l", linmot.to_string(), "simulate = { serial = 14, answer_time = \"400ms\" }");
    let config = |name: &str, more: [String; 2]| {
        let [modbus, linudp] = more;
        let text = format!(
            "{}[[bus]]\nprotocol = \"modbus-tcp\"\n[bus.defaults]\ndivisor = 8\n{late}{modbus}\
             [[bus]]\nprotocol = \"linudp-v2\"\nbind = \"{own}\"\n[bus.defaults]\nserial_from = \"0x0066\"\n\
             {lost}{linudp}",
            patient_cycle()
        );
        machine.write(name, text)
    };
    let _sim = serve(&config("simulated.toml", Default::default()));
    let nobody = format!("{nobody}:1502");
    let more = [drive("n", nobody.clone(), ""), drive("o", used.to_string(), "")];
    let config = config("more.toml", more);
    let _master = Place::Drive(SocketAddrV4::new(used, 49_360)).lock().expect("nobody uses it");
    let ended = Program::start([OsStr::new("pin"), config.as_os_str()]).end();
    ended.expect(1);
    assert_eq!(ended.out.lines().collect::<Vec<_>>(), ["u: serial = 12", "l: serial = 14"], "{ended:?}");
    let [silent, other] = ended.err.lines().collect::<Vec<_>>()[..] else { panic!("{ended:?}") };
    assert_eq!(silent, format!("fieldbeat: n: no drive of its type answers at {nobody}"));
    assert!(other.starts_with(&format!("fieldbeat: o: {used} is in use by another master")), "{other}");
}
