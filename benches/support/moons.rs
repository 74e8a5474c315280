//! A MOONS' drive as the benches have it, and its packets when it is a few bytes in memory.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::Duration;

use fieldbeat::axis::Limits;
use fieldbeat::bus::ethernet_ip::{MoonsDrive, command, status};
use fieldbeat::sim::SimDrive;
use fieldbeat_core::net::{HandshakeState, StreamPeer};
use fieldbeat_ethernet_ip::IO_PORT;
use fieldbeat_sim::ethernet_ip::{MoonsSettings, MoonsSim};

use super::rig::{self, Scene};

/// A drive as a machine might have it. A miss is counted, it does not end the measurement.
pub fn drive(address: Ipv4Addr) -> MoonsDrive {
    let mut drive = MoonsDrive::new(address.to_string(), address);
    drive.axis.limits = Limits { velocity: Some(50.0), ..Limits::default() };
    drive.axis.health.bucket = rig::bucket();
    drive.axis.stop.group = rig::group();
    drive.axis.enable_timeout = Duration::from_secs(60);
    drive
}

/// A packet of a drive: its header, and the 14 elements of the inputs.
pub const PACKET: usize = 20 + 4 * 14;

/// Lets the session of `peer` open its connection to the drive that it would find there, and gives the drive's first
/// packet.
pub fn open(mut peer: StreamPeer) -> io::Result<[u8; PACKET]> {
    let mut drive = MoonsSim::new(MoonsSettings::of(&drive(*peer.address.ip())));
    let from = SocketAddrV4::new(peer.bind.unwrap_or(Ipv4Addr::LOCALHOST), 50_000);
    let (mut out, mut reply, mut now) = (Vec::new(), Vec::new(), rig::now());
    drive.connect(now, from);
    let mut said = peer.handshake.begin(now, &mut out);
    // Until the session has nothing more to ask.
    while !out.is_empty() {
        if let HandshakeState::Failed(why) = said {
            return Err(io::Error::other(why));
        }
        reply.clear();
        if drive.receive(now, from, &out, &mut reply).is_none() {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        out.clear();
        said = peer.handshake.take(now, &reply, &mut out);
    }
    let mut packet = None;
    while packet.is_none() {
        now = drive.next_due().ok_or_else(|| io::Error::other("no connection was opened"))?;
        drive.run(now, &mut |_, to, bytes| {
            packet = packet.or(bytes.try_into().ok().filter(|_| to.port() == IO_PORT));
        });
    }
    packet.ok_or_else(|| io::ErrorKind::UnexpectedEof.into())
}

/// The first packet of a connection of this id, without data.
pub fn first(connection: u32) -> [u8; PACKET] {
    let mut packet = [0; PACKET];
    packet[..6].copy_from_slice(&[2, 0, 0x02, 0x80, 8, 0]);
    packet[6..10].copy_from_slice(&connection.to_le_bytes());
    packet[14..18].copy_from_slice(&[0xB1, 0, (PACKET - 18) as u8, 0]);
    packet
}

/// A drive that sends from memory: it is enabled and jogs as commanded, with another position in each packet.
#[derive(Clone, Debug)]
pub struct Canned {
    packet: [u8; PACKET],
    sequence: u32,
    word: u32,
    status: u16,
    position: u32,
}

impl Canned {
    const SEQUENCE: std::ops::Range<usize> = 10..14;
    const COUNT: std::ops::Range<usize> = 18..20;
    const STATUS: std::ops::Range<usize> = 20..22;
    /// The absolute position, and the velocity as the manual has it.
    const POSITION: std::ops::Range<usize> = 44..48;
    const VELOCITY: std::ops::Range<usize> = 52..56;
    /// The command word in a packet to it.
    const COMMAND: std::ops::Range<usize> = 24..28;
    /// One revolution a second, in steps a ms and as on the wire.
    const STEPS: u32 = 20;
    const SPEED: u32 = 240;

    /// A drive whose first packet is this one.
    pub fn new(packet: [u8; PACKET]) -> Canned {
        Canned { packet, sequence: 0, word: command::IDLE, status: 0, position: 0 }
    }

    /// Takes a packet to it.
    #[inline]
    pub fn hear(&mut self, packet: &[u8]) {
        let Some(word) = packet.get(Self::COMMAND).and_then(|word| word.try_into().ok()) else { return };
        let word = u32::from_le_bytes(word);
        if std::mem::replace(&mut self.word, word) != command::IDLE {
            return;
        }
        match word {
            command::ENABLE => self.status = status::ENABLED,
            command::DISABLE => self.status = 0,
            command::JOG => self.status |= status::JOGGING,
            command::STOP | command::STOP_FAST => self.status &= !status::JOGGING,
            _ => {}
        }
    }

    /// Its next packet.
    #[inline]
    pub fn say(&mut self) -> &[u8] {
        self.sequence = self.sequence.wrapping_add(1);
        let speed = if self.status & status::JOGGING == 0 { 0 } else { Self::SPEED };
        self.position = self.position.wrapping_add(speed / Self::SPEED * Self::STEPS);
        self.packet[Self::SEQUENCE].copy_from_slice(&self.sequence.to_le_bytes());
        self.packet[Self::COUNT].copy_from_slice(&(self.sequence as u16).to_le_bytes());
        let status = match () {
            () if rig::is_scene(Scene::Faulted) => status::FAULT | status::ALARM,
            () if rig::is_scene(Scene::Unsteady) && self.sequence & 1 == 1 => {
                self.status | status::IN_POSITION
            }
            () => self.status,
        };
        self.packet[Self::STATUS].copy_from_slice(&status.to_le_bytes());
        self.packet[Self::POSITION].copy_from_slice(&self.position.to_le_bytes());
        self.packet[Self::VELOCITY].copy_from_slice(&speed.to_le_bytes());
        &self.packet
    }
}
