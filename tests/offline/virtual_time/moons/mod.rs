//! MOONS' drives in the whole loop, in virtual time: what the conformance suite does not ask of a protocol.
//!
//! | file | what |
//! |---|---|
//! | `mod` | a machine of drives that the test shares with the world, and what came to them |
//! | `lost` | masters that die, and come back; drives that take no stop at the end |
//! | `drives` | what a drive is and has: versions, encoders, inputs |
//! | `around` | moves over the end of the counts |
//! | `edges` | what the command word does, packet by packet |
//! | `long` | an hour of packets by two clocks |

mod around;
mod drives;
mod edges;
mod long;
mod lost;

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::axis::{Command, Feedback, Jog, Link, Move, Outcome, Profile, Target};
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, Homing, HomingMethod, MoonsDrive, Originator};
use fieldbeat::sim::{FaultPlan, SimDrive, Simulated, Truth, WorldOptions};
use fieldbeat::telemetry::Numbers;
use fieldbeat::time::MS;
use fieldbeat::{Flow, Master, Plan, Simulation, Time};
use fieldbeat_core::cycle::bound;
use fieldbeat_sim::ethernet_ip::{MoonsSettings, MoonsSim};

use crate::between::{Between, Message, Sender, Shared};

/// Where the master is.
pub const BIND: Ipv4Addr = Ipv4Addr::new(10, 0, 5, 1);
/// The port of packets.
pub const IO_PORT: u16 = 2_222;
/// The number of the socket of packets, of a simulated drive.
const PACKETS: usize = 1;
/// Where a packet to a drive has the command word.
const WORD: usize = 24;

pub const PROFILE: Profile = Profile { velocity: 5.0, acceleration: 50.0, deceleration: 50.0 };

/// The address of drive `index`.
pub fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 0, 5, 2 + index as u8)
}

/// A drive as usual here.
pub fn drive(index: usize) -> MoonsDrive {
    let mut drive = MoonsDrive::new(format!("m{index}"), address(index));
    drive.axis.profile = PROFILE;
    drive.axis.stop.deceleration = 50.0;
    drive.axis.jog_deadman = None;
    drive.homing = Some(Homing {
        method: HomingMethod::Seek,
        input: 0x4CB2,
        velocity: 2.0,
        acceleration: 50.0,
        distance: -2.0,
    });
    drive
}

/// A packet as it came to a drive.
#[derive(Clone, Copy, Debug)]
pub struct Came {
    pub at: Time,
    pub word: u32,
}

/// A drive, and what came to it.
pub struct Tapped {
    pub drive: MoonsSim,
    pub came: Vec<Came>,
    /// Its packets are lost.
    pub mute: bool,
    /// Those to it, with this command word, are lost: so many.
    pub lose: Option<(u32, u32)>,
    /// How many packets it has sent.
    pub sent: u64,
    /// The master's ends of its TCP connections.
    pub connected: Vec<SocketAddrV4>,
}

/// A drive that the world and the test share.
pub type Tap = Shared<Tapped>;

/// A drive to which nothing has come.
pub fn tap(settings: MoonsSettings) -> Tap {
    Shared::new(Tapped {
        drive: MoonsSim::new(settings),
        came: Vec::new(),
        mute: false,
        lose: None,
        sent: 0,
        connected: Vec::new(),
    })
}

fn word(bytes: &[u8]) -> u32 {
    let word = bytes.get(WORD..WORD + 4).and_then(|bytes| bytes.try_into().ok());
    word.map_or(0, u32::from_le_bytes)
}

impl Between for Tapped {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut self.drive
    }

    fn run(&mut self, now: Time, send: &mut Sender<'_>) {
        let Tapped { drive, mute, sent, .. } = self;
        drive.run(now, &mut |socket, to, bytes| {
            *sent += u64::from(socket == PACKETS);
            if socket != PACKETS || !*mute {
                send(socket, to, bytes);
            }
        });
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        if message.socket == PACKETS {
            let word = word(message.bytes);
            if let Some((lost, left @ 1..)) = self.lose
                && lost == word
            {
                self.lose = Some((lost, left - 1));
                return None;
            }
            self.came.push(Came { at: message.now, word });
        }
        message.reaches(&mut self.drive, reply)
    }

    fn connect(&mut self, now: Time, from: SocketAddrV4) -> bool {
        let accepts = self.drive.connect(now, from);
        if accepts {
            self.connected.push(from);
        }
        accepts
    }

    fn disconnected(&mut self, now: Time, from: SocketAddrV4) {
        self.connected.retain(|one| *one != from);
        self.drive.disconnected(now, from);
    }
}

/// A machine of such drives.
pub struct Moons {
    pub sim: Simulation,
    pub taps: Vec<Tap>,
    /// The slot 0 of the grid.
    origin: Time,
}

impl Moons {
    /// These drives, each simulated as its plan expects it.
    pub fn new(drives: Vec<MoonsDrive>) -> Moons {
        Moons::with(drives, |_| ())
    }

    /// The same, each changed.
    pub fn with(drives: Vec<MoonsDrive>, change: impl Fn(&mut MoonsSettings)) -> Moons {
        let simulated = |drive: &MoonsDrive| {
            let mut settings = MoonsSettings::of(drive);
            change(&mut settings);
            tap(settings)
        };
        let taps = drives.iter().map(simulated).collect();
        Moons::of(drives, taps, Originator::at(BIND), WorldOptions::default())
    }

    /// A master of drives that are there.
    pub fn of(
        drives: Vec<MoonsDrive>,
        taps: Vec<Tap>,
        originator: Originator,
        options: WorldOptions,
    ) -> Moons {
        let shared: Vec<_> = taps.iter().map(|tap| Box::new(tap.clone()) as Box<dyn SimDrive>).collect();
        let origin = options.start + options.read_ns + 2 * MS;
        let bus = EthernetIpPlan { originator, ..EthernetIpPlan::new(BIND, drives) };
        let plan = Plan { buses: vec![Box::new(bus)], ..Plan::default() };
        let sim = Master::from_plan(plan).simulate_with(Simulated::from(shared), options);
        Moons { sim: sim.unwrap_or_else(|error| panic!("{error}")), taps, origin }
    }

    /// The master's process dies without an end, and another one starts so many milliseconds later.
    pub fn replaced(self, drives: Vec<MoonsDrive>, originator: Originator, ms: u64) -> Moons {
        let now = self.sim.world().now();
        let Moons { taps, sim, .. } = self;
        drop(sim);
        for tap in &taps {
            let connected = std::mem::take(&mut tap.lock().connected);
            connected.into_iter().for_each(|from| tap.lock().drive.disconnected(now, from));
        }
        let options = WorldOptions { start: now + ms * MS, ..WorldOptions::default() };
        Moons::of(drives, taps, originator, options)
    }

    pub fn feedback(&self, index: usize) -> Feedback {
        self.sim.feedback(index)
    }

    pub fn run(&mut self, cycles: u64) {
        self.sim.run(cycles);
    }

    pub fn until(&mut self, what: &str, most: u64, done: impl FnMut(&Simulation) -> bool) {
        assert!(
            self.sim.run_until(most, done),
            "not within {most} cycles: {what}; {:?}",
            self.sim.feedback(0)
        );
    }

    pub fn online(&mut self) {
        let count = self.taps.len();
        let all = |sim: &Simulation| (0..count).all(|index| sim.feedback(index).link == Link::Online);
        self.until("all online", 10_000, all);
    }

    pub fn end(&mut self, index: usize, command: Command) -> Option<Outcome> {
        self.sim.execute(index, command, 20_000).unwrap_or_else(|error| panic!("{command:?}: {error}"))
    }

    pub fn done(&mut self, index: usize, command: Command) {
        let end = self.end(index, command);
        assert_eq!(end, Some(Outcome::Done), "{command:?}: {:?}", self.feedback(index));
    }

    /// Online, enabled and homed.
    pub fn ready(&mut self) {
        self.online();
        for index in 0..self.taps.len() {
            self.done(index, Command::Enable);
            self.done(index, Command::Home);
        }
    }

    /// The end of the master, in order.
    pub fn ended(self) -> Numbers {
        self.ended_at().1
    }

    /// The same, and when it was over.
    pub fn ended_at(mut self) -> (Time, Numbers) {
        self.sim.stop();
        let ended = (0..60_000).any(|_| self.sim.step() == Flow::End);
        assert!(ended, "no end");
        (self.sim.world().now(), self.sim.finish())
    }

    pub fn post(&mut self, index: usize, command: Command) {
        self.sim.axis(index).post(command).unwrap_or_else(|error| panic!("{error}"));
    }

    pub fn mute(&self, index: usize, mute: bool) {
        self.taps[index].lock().mute = mute;
    }

    pub fn truth(&self, index: usize) -> Truth {
        let now = self.sim.world().now();
        self.taps[index].lock().drive.truth(now)
    }

    /// What has come to the drive since it had so many packets.
    pub fn came(&self, index: usize, first: usize) -> Vec<Came> {
        self.taps[index].lock().came[first..].to_vec()
    }

    pub fn count(&self, index: usize) -> usize {
        self.taps[index].lock().came.len()
    }

    /// The slot of the grid in which something came to a drive.
    pub fn slot(&self, at: Time) -> u64 {
        at.since(self.origin) / MS
    }

    /// The stop bound that `check` states.
    pub fn bound(&self, index: usize) -> u64 {
        bound::stop_bound(self.sim.plan(), index)
    }

    pub fn io(&self, index: usize) -> SocketAddrV4 {
        SocketAddrV4::new(address(index), IO_PORT)
    }
}

pub fn go(position: f64) -> Command {
    Command::Move(Move { target: Target::Absolute(position), profile: PROFILE })
}

pub fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: 50.0 })
}

/// The command words that came one after the other, without those that were held on.
pub fn edges(came: &[Came]) -> Vec<u32> {
    let mut words: Vec<u32> = came.iter().map(|came| came.word).collect();
    words.dedup();
    words
}
