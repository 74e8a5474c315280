//! The simulated MOONS' (Applied Motion) STF and SSDC: the adapter side of EtherNet/IP, and strict.
//!
//! Knows the wire and the manuals, not the master's station; its byte code is its own.
//!
//! | file | what |
//! |---|---|
//! | `settings`, `config` | the properties of a drive, and its state at the start; its keys |
//! | `adapter` | its sockets: sessions, discovery, class 1 packets, class 3 messages |
//! | `sessions`, `items`, `cip` | encapsulation, common packet format, message router: bytes |
//! | `router` | objects and their services |
//! | `open`, `check` | an open as bytes; the table of errors |
//! | `connections` | what is open: owners, time-outs, groups |
//! | `consume`, `produce` | class 1 packets that come, and those that its own clock sends |
//! | `assembly` | inputs and outputs as bytes |
//! | `command` | the command word and its edges, host commands |
//! | `vendor`, `opcodes` | explicit messages of the vendor, type 1 and type 2 |
//! | `drive`, `report` | states, alarms, the watchdog ZS / ZA; what is reported |
//! | `motion`, `search` | moves, jogs, stops, the buffer; moves to an input, homing |
//! | `parameters`, `wiring` | parameters and registers; inputs and outputs |
//!
//! Where the manuals are silent it takes the strict side, or has a setting; `check`, `adapter`, `command`, `motion`,
//! `vendor` and `drive` name their choices. What a master meets first:
//!
//! | case | what the drive does |
//! |---|---|
//! | the first command word after an open | acts, if it is not 0 |
//! | data with the sequence count 0 at first | is not new |
//! | idle | its data does nothing: a word held over it, or that comes with it, is no edge |
//! | a move while disabled | alarm 0x1000 |
//! | a move while moving | waits in the buffer |
//! | no traffic for 500 ms (ZS) | stops with AM, and stays enabled |
//! | the connection times out | the drive stops sending and closes its TCP; the motor is left to ZS |
//! | ZS, ZA are written | count from the next power-up on, if they were saved |
//! | a power cycle | the position is 0, the alarm of a persisting cause is back |

mod adapter;
mod assembly;
mod check;
mod cip;
mod command;
pub(super) mod config;
mod connections;
mod consume;
mod drive;
mod items;
mod motion;
mod opcodes;
mod open;
mod parameters;
mod produce;
mod report;
mod router;
mod search;
mod sessions;
mod settings;
mod vendor;
mod wiring;

use std::net::{Ipv4Addr, SocketAddrV4};

pub use self::adapter::Ignored;
pub use self::drive::Refused;
pub use self::settings::{
    ClockSettings, Configuration, ConfigurationError, Edges, FirmwareSettings, HomeSwitch, IdentitySettings,
    Idle, Kind, MoonsMotorSettings, MoonsSettings, NetworkSettings, Ownership, ShortRpi, Wired,
};

use self::adapter::Adapter;
use self::connections::IO_PORT;
use self::drive::Drive;
use crate::{Carrier, FaultPlan, SimBus, SimDrive, Simulated, Truth};
use fieldbeat_core::time::Time;
use fieldbeat_ethernet_ip::plan::{EthernetIpPlan, Expected, MoonsDrive, Version};

/// The numbers of its sockets: sessions, class 1 packets, discovery.
const PACKETS: usize = 1;
const DISCOVERY: usize = 2;

/// The simulated drives of an EtherNet/IP bus.
#[derive(Clone, Debug, PartialEq)]
pub struct MoonsDrives(pub Vec<MoonsSettings>);

impl MoonsDrives {
    /// A drive with default settings for each of the bus.
    pub fn of(plan: &EthernetIpPlan) -> MoonsDrives {
        MoonsDrives(plan.drives.iter().map(MoonsSettings::of).collect())
    }
}

impl SimBus for MoonsDrives {
    fn build(&self, to: &mut Simulated) {
        to.drives
            .extend(self.0.iter().map(|drive| Box::new(MoonsSim::new(drive.clone())) as Box<dyn SimDrive>));
    }
}

impl MoonsSettings {
    /// A drive with default settings at the address of `drive`, wired as that one expects it: identity, steps of a
    /// revolution, encoder, layout, version, enable input, and a home switch half way along its homing.
    pub fn of(drive: &MoonsDrive) -> MoonsSettings {
        let mut settings = MoonsSettings::new(drive.address);
        let steps = drive.steps_per_revolution.round();
        if (1.0..=131_070.0).contains(&steps) {
            settings.motor.steps = steps as u32;
        }
        let Expected { vendor, product, serial } = drive.expected;
        let identity = &mut settings.identity;
        identity.vendor = vendor.unwrap_or(identity.vendor);
        identity.product = product.unwrap_or(identity.product);
        identity.serial = serial;
        settings.motor.encoder = drive.encoder.then_some(drive.encoder_counts_per_step);
        settings.firmware.layout = drive.layout;
        if drive.version == Some(Version::V1) {
            (settings.identity.board, settings.identity.model) = ((117, 7), (0x5F, 0));
        }
        settings.motor.enable =
            drive.enable_input.map(|input| Wired { input: input.number, closed: input.closed });
        settings.motor.home = drive.homing.map(|homing| {
            let [condition, low] = homing.input.to_be_bytes();
            let at = Wired { input: low.saturating_sub(0xB0), closed: matches!(condition, b'L' | b'F') };
            let middle = homing.distance * drive.axis.units.counts_per_unit / 2.0;
            let far = middle + f64::from(settings.motor.steps).copysign(middle) / 10.0;
            HomeSwitch { at, range: (middle.round() as i32, far.round() as i32) }
        });
        settings
    }
}

/// One simulated MOONS' drive.
#[derive(Debug)]
pub struct MoonsSim {
    drive: Drive,
    adapter: Adapter,
    /// Does not listen until then.
    booted_at: Time,
}

impl MoonsSim {
    /// The drive as set up, listening. Its time begins with the first message.
    pub fn new(settings: MoonsSettings) -> MoonsSim {
        MoonsSim { drive: Drive::new(&settings), adapter: Adapter::new(&settings), booted_at: Time(0) }
    }

    /// Raises these bits of the alarm, as if its hardware had.
    pub fn provoke(&mut self, alarm: u16) {
        self.drive.raise(alarm);
    }

    /// The TCP connections and the CIP connections that it holds.
    pub fn connections(&self) -> (usize, usize) {
        (self.adapter.sessions.count(), self.adapter.connections.open.len())
    }

    /// What it did not answer or act on so far, on its network.
    pub fn ignored(&self) -> Ignored {
        self.adapter.ignored
    }

    /// What it was commanded and did not do.
    pub fn refused(&self) -> Refused {
        self.drive.refused
    }

    /// Its true state at `now`; its counts are steps. This counts as no message.
    pub fn truth(&mut self, now: Time) -> Truth {
        self.drive.advance(now);
        self.drive.truth()
    }

    fn at(&self, port: u16) -> SocketAddrV4 {
        SocketAddrV4::new(self.ip(), port)
    }

    fn ip(&self) -> Ipv4Addr {
        self.adapter.ip()
    }
}

impl SimDrive for MoonsSim {
    fn address(&self) -> SocketAddrV4 {
        self.adapter.settings.address
    }

    fn faults(&self) -> FaultPlan {
        self.adapter.settings.faults.clone()
    }

    fn carrier(&self) -> Carrier {
        Carrier::Stream
    }

    fn more_sockets(&self) -> Vec<(Carrier, SocketAddrV4)> {
        vec![(Carrier::Datagrams, self.at(IO_PORT)), (Carrier::Datagrams, self.address())]
    }

    fn everybody(&self) -> Option<usize> {
        Some(DISCOVERY)
    }

    fn receive_of_all(&mut self, now: Time, from: SocketAddrV4, bytes: &[u8]) {
        if now >= self.booted_at {
            self.adapter.searched(now, from, bytes);
        }
    }

    fn receive_at(
        &mut self,
        socket: usize,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.drive.advance(now);
        if now < self.booted_at {
            return None;
        }
        match socket {
            PACKETS => self.adapter.packet(now, from, bytes, &mut self.drive),
            DISCOVERY => self.adapter.datagram(bytes, reply),
            _ => self.adapter.stream(now, from, bytes, &mut self.drive, reply),
        }
        (!reply.is_empty()).then_some(from)
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.receive_at(0, now, from, bytes, reply)
    }

    fn next_due(&self) -> Option<Time> {
        self.adapter.next_due()
    }

    fn run(&mut self, now: Time, send: &mut dyn FnMut(usize, SocketAddrV4, &[u8])) {
        self.drive.advance(now);
        self.adapter.run(now, &mut self.drive, &mut |to, bytes| send(PACKETS, to, bytes));
        while let Some((to, bytes)) = self.adapter.found(now) {
            send(DISCOVERY, to, &bytes);
        }
    }

    fn connect(&mut self, now: Time, from: SocketAddrV4) -> bool {
        self.drive.advance(now);
        now >= self.booted_at && self.adapter.sessions.connect(now, from)
    }

    fn hangs_up(&mut self, from: SocketAddrV4) -> bool {
        self.adapter.sessions.hangs_up(from)
    }

    fn disconnected(&mut self, now: Time, from: SocketAddrV4) {
        self.drive.advance(now);
        self.adapter.disconnected(from);
    }

    fn mislabel(&self, reply: &mut [u8]) {
        // The connection id of a packet, the id and the count of a message on a connection, else the sender context.
        let place = match reply {
            [2, 0, 2, 0x80, ..] => 9,
            [0x70, 0, ..] => 39,
            _ => 12,
        };
        if let Some(byte) = reply.get_mut(place) {
            *byte ^= 0x80;
        }
    }

    fn restart(&mut self, now: Time) {
        self.drive.advance(now);
        self.drive.restart();
        self.adapter.restart();
        self.booted_at = now + self.adapter.settings.boot_ns;
    }

    fn open_sto(&mut self, until: Time) {
        self.drive.open_sto(until);
    }
}

#[cfg(test)]
mod tests;
