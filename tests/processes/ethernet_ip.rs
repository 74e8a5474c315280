//! `fieldbeat ethernet-ip scan`: of devices on this host, of addresses where nobody is, and of what is no address.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::thread::{self, JoinHandle};

use libc::SIGINT;
use serde_json::Value;

use super::bound;
use super::init::{check, init_by};
use super::support::{CABLE_NET, Cable, LONG, Machine, PROGRAM, Program, run};

/// A device that answers each of so many ListIdentity requests, twice.
fn device(at: SocketAddrV4, serial: u32, requests: usize) -> JoinHandle<()> {
    let socket = bound(|| UdpSocket::bind(at));
    answering(socket.try_clone().unwrap(), vec![(socket, serial)], requests)
}

/// Each device, by its socket and serial number, answers each of so many requests that come to `asked`, twice.
fn answering(asked: UdpSocket, devices: Vec<(UdpSocket, u32)>, requests: usize) -> JoinHandle<()> {
    thread::spawn(move || {
        let mut request = [0; 64];
        for _ in 0..requests {
            let (size, from) = asked.recv_from(&mut request).unwrap();
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
fn devices_are_told_as_a_table_and_as_json() {
    let machine = Machine::new(162);
    let [first, second] = [40, 41].map(|host| SocketAddrV4::new(machine.ip(host), 44_818));
    let targets = [first.ip(), second.ip()].map(ToString::to_string);
    // The second one comes first: the table is in the order of addresses.
    let words = ["ethernet-ip", "scan", &targets[1], &targets[0], "--bind", "127.0.0.1"];

    let devices = [device(first, 0xC0FFEE, 2), device(second, 7, 2)];
    let ended = run(words);
    ended.expect(0);
    assert_eq!(ended.err, "");
    let rows: Vec<Vec<&str>> = ended.out.lines().map(|row| row.split_whitespace().collect()).collect();
    assert_eq!(rows.len(), 3, "{}", ended.out);
    assert_eq!(rows[0], ["address", "name", "vendor", "type", "product", "revision", "serial", "state"]);
    assert_eq!(rows[1][..3], [targets[0].as_str(), "STF10-IP", "60"]);
    assert_eq!(rows[1][6..], ["43", "176", "251.3", "0x00c0ffee", "operational"]);
    assert_eq!(rows[2][0], targets[1]);

    let json = run(words.iter().chain(&["--json"])).json();
    let found = json["devices"].as_array().unwrap();
    assert_eq!(found.len(), 2);
    assert_eq!((&found[0]["address"], &found[0]["serial"]), (&targets[0].clone().into(), &0xC0FFEE.into()));
    assert_eq!((&found[1]["state_name"], &found[1]["revision"]), (&"operational".into(), &"251.3".into()));
    for device in devices {
        device.join().unwrap();
    }
}

#[test]
fn who_does_not_answer_is_named() {
    let machine = Machine::new(163);
    let one = SocketAddrV4::new(machine.ip(40), 44_818);
    let nobody = machine.ip(41).to_string();
    let device = device(one, 1, 1);
    let ended = run(["ethernet-ip", "scan", &one.ip().to_string(), &nobody]);
    ended.expect(1);
    assert_eq!(ended.out.lines().count(), 2, "{}", ended.out);
    let silent = format!("fieldbeat: no answer from {nobody}:44818; check power, cable and address\n");
    assert_eq!(ended.err, silent);
    device.join().unwrap();
    run(["ethernet-ip", "scan", &nobody]).failed(&["no device answers; check power, cable and address"]);

    let scan = Program::start(["ethernet-ip", "scan", &nobody]);
    scan.await_handler(SIGINT);
    scan.signal(SIGINT);
    scan.end().failed(&["interrupted"]);
}

#[test]
#[ignore = "needs root and network namespaces (iproute2)"]
fn a_broadcast_finds_the_drives_on_a_cable() {
    let machine = Machine::new(224).on(CABLE_NET);
    let cable = Cable::new(224, &[40, 41]);
    let (asked, devices) = cable.among_drives(|| {
        let open = |ip| UdpSocket::bind(SocketAddrV4::new(ip, 44_818)).unwrap();
        (open(Ipv4Addr::BROADCAST), vec![(open(machine.ip(41)), 7), (open(machine.ip(40)), 0xC0FFEE)])
    });
    // A broadcast that was lost would not be waited for.
    asked.set_read_timeout(Some(LONG)).unwrap();
    // Each search asks twice.
    let devices = answering(asked, devices, 4);
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
fn what_is_no_address_is_told_in_one_line() {
    run(["ethernet-ip", "scan", "drive"]).refused(&["an IPv4 address like 192.168.1.40"]);
    run(["ethernet-ip", "scan", "--bind", "eth0"]).refused(&["eth0"]);
    run(["ethernet-ip", "scan", "127.0.0.1", "--bind", "192.0.2.1"])
        .refused(&["cannot ask from 192.0.2.1: ", "ip address shows the addresses of this computer"]);
    run(["ethernet-ip"]).expect(2);
}
