//! Clients of others, and our simulated drive: it is strict, and no generic server.

use std::io::{Read, Write};
use std::net::{SocketAddrV4, TcpListener, TcpStream};
use std::thread::{sleep, spawn};
use std::time::Duration;

use fieldbeat_sim::modbus::UnidriveSettings;

use super::Library::{Libmodbus, Pymodbus};
use super::{Library, PORT, serve};
use crate::peer::Peer;
use crate::support::{LONG, Machine, until};

/// The most registers of a request, and 22.001 with 32-bit access: 80 parameters begin there.
const MOST: u16 = 120;
const SETUP: u16 = 0x4000 + 22 * 100;

/// Passes on what comes for `to`, both ways, a byte at a time.
fn dribble(listen: SocketAddrV4, to: SocketAddrV4) {
    let pass = |mut from: TcpStream, mut to: TcpStream| {
        let mut byte = [0];
        while from.read_exact(&mut byte).is_ok() && to.write_all(&byte).is_ok() {
            // So that no two are in one segment.
            sleep(Duration::from_micros(100));
        }
        let _ = to.shutdown(std::net::Shutdown::Both);
    };
    let listener = TcpListener::bind(listen).unwrap();
    spawn(move || {
        let (client, _) = listener.accept().unwrap();
        let drive = TcpStream::connect(to).unwrap();
        for stream in [&client, &drive] {
            stream.set_nodelay(true).unwrap();
        }
        let back = (drive.try_clone().unwrap(), client.try_clone().unwrap());
        spawn(move || pass(back.0, back.1));
        pass(client, drive);
    });
}

#[track_caller]
fn expect(client: &mut Peer, line: &str, answer: &str) {
    assert_eq!(client.ask(line), answer, "{line}");
}

/// The examples of the manual and of the SI-Ethernet guide: 20.021 ... 20.026, which are 32 bits each.
fn examples(client: &mut Peer) {
    expect(client, "write 0x47E4 0 12345 0 12345 0 12345", "ok 6");
    expect(client, "read 0x47E4 6", "ok 0 12345 0 12345 0 12345");
    // The next parameter is one address further, and two registers.
    expect(client, "write 0x47E7 0 1 65535 65534 1 0", "ok 6");
    expect(client, "read 0x47E8 2", "ok 65535 65534");
    expect(client, "both 0x47E7 6 0x47E4 0 1 0 2 0 3", "ok 0 1 65535 65534 1 0");
    expect(client, "read 0x47E4 12", "ok 0 1 0 2 0 3 0 1 65535 65534 1 0");
    // 16 bits of the same.
    expect(client, "read 0x07E8 1", "ok 65534");
    expect(client, "one 0x0282 1", "ok");
    expect(client, "read 0x0282 1", "ok 1");
}

fn limits(client: &mut Peer) {
    let zeros = |count: u16| vec!["0"; count.into()].join(" ");
    let (most, more) = (zeros(MOST), MOST + 2);
    expect(client, &format!("write {SETUP} {most}"), "ok 120");
    expect(client, &format!("read {SETUP} {MOST}"), &format!("ok {most}"));
    expect(client, &format!("both {SETUP} {MOST} {SETUP} {most}"), &format!("ok {most}"));
    for line in [
        format!("read {SETUP} {}", MOST + 1),
        format!("read {SETUP} {more}"),
        format!("write {SETUP} {}", zeros(more)),
        format!("both {SETUP} {more} {SETUP} 0 0"),
        // No address, half a parameter, one that there is not, a single register of 32 bits.
        "read 0x8078 1".into(),
        "read 0x47E4 3".into(),
        "read 2280 1".into(),
        "one 0x47E4 5".into(),
    ] {
        expect(client, &line, "exception 2");
    }
    expect(client, "input 0x47E4 2", "exception 1");
}

/// Function 16 stops at what it does not take, and says how far it came; function 23 says nothing.
fn refusals(client: &mut Peer, library: Library) {
    let written = |count: u16| match library {
        // It compares the counts.
        Libmodbus => "error Invalid data".to_owned(),
        Pymodbus => format!("ok {count}"),
    };
    expect(client, "write 0x0071 1 9999", &written(1));
    expect(client, "both 0x0071 2 0x0071 2 9999", "ok 2 0");
    expect(client, "write 0x040F 1", &written(0));
    expect(client, "write 0x0071 0 0", "ok 2");
}

fn units(client: &mut Peer) {
    expect(client, "unit 0", "ok");
    expect(client, "read 0x47E4 2", "ok 0 1");
    // That of the onboard interface has its own menu 15: the listening port.
    expect(client, "unit 4", "ok");
    expect(client, "read 1504 1", "ok 502");
    expect(client, "unit 77", "ok");
    expect(client, "read 0x47E4 2", "exception 2");
    expect(client, "unit 255", "ok");
    expect(client, "read 1504 1", "exception 2");
}

/// The control word sets the motor going: 600 rpm backwards, and to a stand.
fn motion(client: &mut Peer) {
    let status = |client: &mut Peer| client.numbers("read 0x040F 1")[0];
    let tenths_rpm = |client: &mut Peer| {
        let registers = client.numbers("read 0x412D 2");
        (registers[0] << 16 | registers[1]) as u32 as i32
    };
    assert_eq!(status(client) & 0b111, 0b101, "healthy, not active, standing");
    expect(client, "write 0x4078 0 6000", "ok 2");
    expect(client, "one 0x0281 0x0189", "ok");
    let there = until(LONG, || (-6010..=-5990).contains(&tenths_rpm(client)));
    assert!(there && status(client) & 0b111 == 0b011, "{} {:#06x}", tenths_rpm(client), status(client));
    // Without RUN it ramps down, and holds its motor there (06.008) until ENABLE goes.
    expect(client, "one 0x0281 0x0181", "ok");
    assert!(until(LONG, || status(client) & 0b111 == 0b111), "{:#06x}", status(client));
    expect(client, "one 0x0281 0x0180", "ok");
    assert!(until(LONG, || status(client) & 0b111 == 0b101), "{:#06x}", status(client));
}

fn all_of_it(client: &mut Peer, library: Library) {
    examples(client);
    limits(client);
    refusals(client, library);
    units(client);
    motion(client);
}

fn converse(test: u8, library: Library) {
    let machine = Machine::new(test);
    let address = SocketAddrV4::new(machine.ip(11), PORT);
    let server = serve([UnidriveSettings::new(address)]);
    let mut client = library.start("client", &machine, address, &[]);
    all_of_it(&mut client, library);
    // Two requests in one segment have two replies, in order.
    assert_eq!(client.numbers("twice 0x47E4 2"), [7, 8]);
    assert_eq!(server.stop()[0].connections.accepted, 1);
    // A drive may also leave the second one unanswered; the first one's reply is its own then, too.
    let mut settings = UnidriveSettings::new(SocketAddrV4::new(machine.ip(12), PORT));
    settings.interface.pipelining = false;
    let address = settings.address;
    let _server = serve([settings]);
    let mut client = library.start("client", &machine, address, &[]);
    assert_eq!(client.numbers("twice 0x47E4 2"), [7]);
}

#[test]
#[ignore = "needs cc and libmodbus (libmodbus-dev)"]
fn a_client_of_libmodbus_operates_the_simulated_drive() {
    converse(16, Libmodbus);
}

#[test]
#[ignore = "needs python3 and pymodbus"]
fn a_client_of_pymodbus_operates_the_simulated_drive() {
    converse(17, Pymodbus);
}

#[test]
#[ignore = "needs cc, libmodbus (libmodbus-dev), python3 and pymodbus"]
fn clients_of_others_operate_the_simulated_drive_in_single_bytes() {
    for (test, library) in [(18, Libmodbus), (19, Pymodbus)] {
        let machine = Machine::new(test);
        let [address, between] = [11, 12].map(|host| SocketAddrV4::new(machine.ip(host), PORT));
        let _server = serve([UnidriveSettings::new(address)]);
        dribble(between, address);
        all_of_it(&mut library.start("client", &machine, between, &[]), library);
    }
}
