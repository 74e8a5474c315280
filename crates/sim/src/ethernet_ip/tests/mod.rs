//! The simulated drive against the sheet, frame by frame, in its own time.

mod frames;
mod messages;
mod motion;
mod noise;
mod opening;
mod packets;
mod sessions;

use std::net::{Ipv4Addr, SocketAddrV4};

use super::*;
use crate::testing::hex;
use fieldbeat_core::time::{MS, S};

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 40_000);
const DRIVE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 44_818);
/// Where packets come from and go to.
const MASTER_IO: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 2_222);

/// The path of the exclusive owner.
const OWNER: &str = "20 04 24 66 2C 70 2C 65";
const INPUT_ONLY: &str = "20 04 24 66 2C 67 2C 65";
const LISTEN_ONLY: &str = "20 04 24 66 2C 68 2C 65";
const ROUTER: &str = "20 02 24 01";

fn settings() -> MoonsSettings {
    MoonsSettings::new(DRIVE)
}

/// A drive, and a master's notion of time.
struct Bench {
    sim: MoonsSim,
    now: Time,
    /// What the drive has sent by itself: when, where to, what.
    sent: Vec<(Time, SocketAddrV4, Vec<u8>)>,
    session: u32,
    /// The counts of the packets of `Bench::send`.
    sequence: u32,
    /// The O->T id of the newest connection.
    id: u32,
}

impl Bench {
    /// With a session.
    fn new(change: impl FnOnce(&mut MoonsSettings)) -> Bench {
        let mut settings = settings();
        change(&mut settings);
        let (sim, now) = (MoonsSim::new(settings), Time(5 * S));
        let mut bench = Bench { sim, now, sent: Vec::new(), session: 0, sequence: 0, id: 0 };
        bench.session = bench.connect(MASTER);
        bench
    }

    /// A session on a new TCP connection.
    fn connect(&mut self, from: SocketAddrV4) -> u32 {
        assert!(self.sim.connect(self.now, from));
        let reply = self.raw(from, &frame(0x65, 0, &[1, 0, 0, 0]));
        word_of(&reply, 4)
    }

    /// What comes back on a TCP connection.
    fn raw(&mut self, from: SocketAddrV4, bytes: &[u8]) -> Vec<u8> {
        self.at(0, from, bytes)
    }

    /// What comes back at a socket.
    fn at(&mut self, socket: usize, from: SocketAddrV4, bytes: &[u8]) -> Vec<u8> {
        let mut reply = Vec::new();
        let to = self.sim.receive_at(socket, self.now, from, bytes, &mut reply);
        assert_eq!(to.is_some(), !reply.is_empty());
        assert!(to.is_none_or(|to| to == from));
        reply
    }

    /// The CIP reply to an unconnected message.
    fn message(&mut self, message: &[u8]) -> Vec<u8> {
        self.message_of(MASTER, self.session, message, &[]).0
    }

    /// The CIP reply, and what follows it.
    fn message_of(
        &mut self,
        from: SocketAddrV4,
        session: u32,
        message: &[u8],
        more: &[u8],
    ) -> (Vec<u8>, Vec<u8>) {
        let count = if more.is_empty() { 2 } else { 3 };
        let mut data = vec![0, 0, 0, 0, 0, 0, count, 0, 0, 0, 0, 0, 0xB2, 0];
        data.extend((message.len() as u16).to_le_bytes());
        data.extend(message);
        data.extend(more);
        let reply = self.raw(from, &frame(0x6F, session, &data));
        assert_eq!(reply[..2], [0x6F, 0]);
        assert_eq!(reply[8..12], [0; 4], "encapsulation status");
        let items = &reply[30..];
        assert_eq!(items[2..8], [0, 0, 0, 0, 0xB2, 0]);
        let length = usize::from(u16::from_le_bytes([items[8], items[9]]));
        (items[10..10 + length].to_vec(), items[10 + length..].to_vec())
    }

    /// Opens, successfully.
    fn open(&mut self, open: &Forward) -> Vec<u8> {
        let reply = self.message(&open.bytes());
        assert_eq!(reply[..4], [0xD4, 0, 0, 0], "{reply:02X?}");
        self.id = word_of(&reply, 4);
        self.sequence = 0;
        reply
    }

    /// Lets time pass.
    fn pass(&mut self, ns: u64) {
        let until = self.now + ns;
        while let Some(due) = self.sim.next_due().filter(|due| *due <= until) {
            self.now = self.now.max(due);
            let (now, sent) = (self.now, &mut self.sent);
            self.sim.run(now, &mut |socket, to, bytes| {
                assert_eq!(socket, PACKETS);
                sent.push((now, to, bytes.to_vec()));
            });
        }
        self.now = until;
    }

    /// One packet of the owner.
    fn packet(&mut self, header: u32, outputs: &[u8]) {
        self.sequence += 1;
        let bytes = packet(self.id, self.sequence, self.sequence as u16, header, outputs);
        assert_eq!(self.at(PACKETS, MASTER_IO, &bytes), [0; 0]);
    }

    /// One packet with this command word, run.
    fn word(&mut self, word: u32) {
        self.packet(1, &outputs(word, &[]));
    }

    /// A command word, and 0 behind it.
    fn command(&mut self, word: u32, elements: &[(usize, i32)]) {
        self.packet(1, &outputs(word, elements));
        self.packet(1, &outputs(0, &[]));
    }

    /// Lets time pass while the owner sends 0 every 10 ms.
    fn idle_for(&mut self, ns: u64) {
        for _ in 0..ns / (10 * MS) {
            self.pass(10 * MS);
            self.word(0);
        }
    }

    /// An owner, with the first 0 sent.
    fn owned(change: impl FnOnce(&mut MoonsSettings)) -> Bench {
        let mut bench = Bench::new(change);
        bench.open(&Forward::default());
        bench.word(0);
        bench
    }

    /// An owner whose drive is enabled.
    fn enabled(change: impl FnOnce(&mut MoonsSettings)) -> Bench {
        let mut bench = Bench::owned(change);
        bench.command(0x2, &[]);
        assert_eq!(bench.status() & 1, 1);
        bench
    }

    /// Power is lost for a moment, and there is a session again afterwards.
    fn power_cycle(&mut self) {
        self.sim.disconnected(self.now, MASTER);
        self.sim.restart(self.now);
        self.pass(S);
        self.session = self.connect(MASTER);
    }

    fn status(&mut self) -> u16 {
        self.sim.truth(self.now);
        self.sim.drive.status()
    }

    fn alarm(&mut self) -> u16 {
        self.sim.truth(self.now);
        self.sim.drive.alarms
    }

    /// Commanded position, steps.
    fn position(&mut self) -> i32 {
        self.sim.truth(self.now);
        self.sim.drive.absolute()
    }

    fn velocity(&mut self) -> f64 {
        self.sim.truth(self.now).velocity
    }

    /// A type 1 or type 2 message: general status and the data of its reply.
    fn vendor(&mut self, data: &str) -> (u8, Vec<u8>) {
        let mut message = hex("3C 03 20 64 24 01 30 01");
        message.extend(hex(data));
        let reply = self.message(&message);
        assert_eq!((reply[0], reply[1], reply[3]), (0xBC, 0, 0));
        (reply[2], reply[4..].to_vec())
    }
}

/// An encapsulation frame.
fn frame(command: u16, session: u32, data: &[u8]) -> Vec<u8> {
    let [command, length] = [command, data.len() as u16].map(u16::to_le_bytes);
    [&command[..], &length, &session.to_le_bytes(), &[0; 4], b"context!", &[0; 4], data].concat()
}

fn word_of(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// The bytes of assembly 0x70.
fn outputs(word: u32, elements: &[(usize, i32)]) -> [u8; 64] {
    let mut outputs = [0; 64];
    outputs[..4].copy_from_slice(&word.to_le_bytes());
    for (element, value) in elements {
        outputs[4 * element..4 * element + 4].copy_from_slice(&value.to_le_bytes());
    }
    outputs
}

/// A class 1 packet.
fn class_1(id: u32, sequence: u32, data: &[u8]) -> Vec<u8> {
    let head = hex("02 00 02 80 08 00");
    let size = (data.len() as u16).to_le_bytes();
    [&head[..], &id.to_le_bytes(), &sequence.to_le_bytes(), &[0xB1, 0], &size, data].concat()
}

/// That of the owner.
fn packet(id: u32, sequence: u32, count: u16, header: u32, outputs: &[u8]) -> Vec<u8> {
    class_1(id, sequence, &[&count.to_le_bytes()[..], &header.to_le_bytes(), outputs].concat())
}

fn heartbeat(id: u32, sequence: u32) -> Vec<u8> {
    class_1(id, sequence, &(sequence as u16).to_le_bytes())
}

/// A Forward_Open, that of the sheet but for what a test changes.
#[derive(Clone, Debug)]
struct Forward {
    service: u8,
    produced: u32,
    serial: u16,
    vendor: u16,
    originator: u32,
    multiplier: u8,
    us: (u32, u32),
    ncp: (u32, u32),
    transport: u8,
    path: Vec<u8>,
}

impl Default for Forward {
    fn default() -> Forward {
        Forward {
            service: 0x54,
            produced: 0x0001_0001,
            serial: 1,
            vendor: 0x1234,
            originator: 0x00C0_FFEE,
            multiplier: 2,
            us: (10_000, 10_000),
            ncp: (0x4846, 0x483A),
            transport: 1,
            path: hex(OWNER),
        }
    }
}

impl Forward {
    fn input_only() -> Forward {
        Forward { serial: 20, ncp: (0x4802, 0x483A), path: hex(INPUT_ONLY), ..Forward::default() }
    }

    fn listen_only() -> Forward {
        Forward { serial: 30, path: hex(LISTEN_ONLY), ..Forward::input_only() }
    }

    /// A class 3 one.
    fn messages() -> Forward {
        Forward {
            produced: 0x0001_0002,
            serial: 2,
            multiplier: 3,
            us: (1_000_000, 1_000_000),
            ncp: (0x43F4, 0x43F4),
            transport: 0xA3,
            path: hex(ROUTER),
            ..Forward::default()
        }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = vec![self.service, 2, 0x20, 6, 0x24, 1, 0x0A, 0x0E, 0, 0, 0, 0];
        bytes.extend(self.produced.to_le_bytes());
        bytes.extend(self.serial.to_le_bytes());
        bytes.extend(self.vendor.to_le_bytes());
        bytes.extend(self.originator.to_le_bytes());
        bytes.extend([self.multiplier, 0, 0, 0]);
        let width = if self.service == 0x5B { 4 } else { 2 };
        for (us, ncp) in [(self.us.0, self.ncp.0), (self.us.1, self.ncp.1)] {
            bytes.extend(us.to_le_bytes());
            bytes.extend(&ncp.to_le_bytes()[..width]);
        }
        bytes.extend([self.transport, (self.path.len() / 2) as u8]);
        bytes.extend(&self.path);
        bytes
    }

    /// Its close.
    fn close(&self) -> Vec<u8> {
        let mut bytes = hex("4E 02 20 06 24 01 0A 0E");
        bytes.extend(self.serial.to_le_bytes());
        bytes.extend(self.vendor.to_le_bytes());
        bytes.extend(self.originator.to_le_bytes());
        bytes.extend([(self.path.len() / 2) as u8, 0]);
        bytes.extend(&self.path);
        bytes
    }
}

#[test]
fn a_drive_is_wired_as_the_plan_expects_it() {
    use fieldbeat_ethernet_ip::plan::{EnableInput, Homing, HomingMethod};
    let mut drive = MoonsDrive::new("x", *DRIVE.ip());
    drive.axis.units.counts_per_unit = -800.0;
    drive.steps_per_revolution = 1_600.0;
    drive.enable_input = Some(EnableInput { number: 3, closed: false });
    drive.homing = Some(Homing {
        method: HomingMethod::Seek,
        input: 0x4CB2,
        velocity: 1.0,
        acceleration: 1.0,
        distance: 10.0,
    });
    drive.version = Some(Version::V1);
    let settings = MoonsSettings::of(&drive);
    assert_eq!((settings.address, settings.motor.steps), (DRIVE, 1_600));
    assert_eq!(settings.motor.enable, Some(Wired { input: 3, closed: false }));
    let home = HomeSwitch { at: Wired { input: 2, closed: true }, range: (-4_000, -4_160) };
    assert_eq!(settings.motor.home, Some(home));
    assert!(!settings.identity.has_outputs());
    let bus = MoonsDrives::of(&EthernetIpPlan::new(*MASTER.ip(), vec![drive]));
    let mut built = Simulated::default();
    bus.build(&mut built);
    assert_eq!(built.drives.len(), 1);
    assert_eq!(built.drives[0].more_sockets()[0], (Carrier::Datagrams, MASTER_IO_OF_DRIVE));
}

const MASTER_IO_OF_DRIVE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 2_222);
