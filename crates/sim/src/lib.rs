//! Simulated drives: what all of them share, and a folder for each protocol.
//!
//! A simulated drive knows the wire of its protocol and the manuals, not the master's station.
//!
//! | file | what |
//! |---|---|
//! | `linudp`, `modbus`, `ethercat`, `ethernet_ip`, `profibus` | the drives of a protocol: its wire from the other end |
//! | `plan` | the simulated drives of a machine as configured |
//! | `physics` | an axis: setpoint generator, mass, limits, following error |
//! | `power` | a power drive: a motor on its setpoint generator, hardware enable, standing fault, the advance of time |
//! | `fault` | seeded fault injection |
//! | `keys` | how a configuration writes faults |
//! | `wire` | a segment and the faults of its wire |
//! | `serial` | drives on one serial wire, and the faults of that |
//! | `drives` | drives with an address of their own, their sockets and clocks |
//! | `server` | the threads that serve simulated drives and segments on real sockets |
//! | `world` | virtual time, and an in-memory network with the same drives |

mod drives;
pub mod ethercat;
pub mod ethernet_ip;
pub mod fault;
pub mod keys;
pub mod linudp;
pub mod modbus;
pub mod physics;
mod plan;
mod power;
pub mod profibus;
pub mod serial;
pub mod server;
#[cfg(test)]
mod testing;
mod wire;
pub mod world;

use std::any::Any;
use std::fmt::Debug;
use std::net::SocketAddrV4;

pub use plan::SimPlan;
pub use serial::{SerialWire, SimSerial};
pub use world::{World, WorldOptions};

use fieldbeat_core::axis::PlanFault;
use fieldbeat_core::time::Time;

/// The kind of transport of a simulated drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Carrier {
    /// Datagrams, each whole.
    #[default]
    Datagrams,
    /// Connections: bytes in order, split anywhere.
    Stream,
}

/// A simulated drive: the same object behind a real socket and in virtual time.
pub trait SimDrive: Send {
    /// The address that it listens at.
    fn address(&self) -> SocketAddrV4;

    /// The faults between it and the master.
    fn faults(&self) -> FaultPlan;

    /// Its transport.
    fn carrier(&self) -> Carrier {
        Carrier::Datagrams
    }

    /// Its sockets in addition to the one at [`address`](Self::address), which has the number 0: these have 1, 2 ... in
    /// this order. At most one of all is a stream's.
    fn more_sockets(&self) -> Vec<(Carrier, SocketAddrV4)> {
        Vec::new()
    }

    /// The number of the datagram socket at whose port it also takes what is sent to everybody, 255.255.255.255.
    fn everybody(&self) -> Option<usize> {
        None
    }

    /// A datagram to everybody. It answers by [`run`](Self::run).
    fn receive_of_all(&mut self, _now: Time, _from: SocketAddrV4, _bytes: &[u8]) {}

    /// As [`receive`](Self::receive), at the socket of this number.
    fn receive_at(
        &mut self,
        _socket: usize,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.receive(now, from, bytes, reply)
    }

    /// When it wants to run by its own clock; queried after every other call. It runs once a microsecond at most.
    fn next_due(&self) -> Option<Time> {
        None
    }

    /// Its own clock has come to that. What it sends then goes out by `send`: from the socket of this number, to
    /// this destination. On a stream that is the peer of a connection.
    fn run(&mut self, _now: Time, _send: &mut dyn FnMut(usize, SocketAddrV4, &[u8])) {}

    /// Takes one datagram, or bytes that came on the connection of `from`, split anywhere. Writes the answer into
    /// `reply` (cleared by the caller) and returns its destination, or `None` for no answer.
    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4>;

    /// A connection from `from` is requested; false refuses it. For streams only, like the three below. No two
    /// connections at a time have the same `from`.
    fn connect(&mut self, _now: Time, _from: SocketAddrV4) -> bool {
        true
    }

    /// Whether the drive itself ends the connection of `from` after its answer; called after each `receive`, and for
    /// each connection after each `run`.
    fn hangs_up(&mut self, _from: SocketAddrV4) -> bool {
        false
    }

    /// The accepted connection of `from` has ended, by either side; called once for each. Nothing more comes from
    /// there. For connections that a restart ends, it is called before the restart.
    fn disconnected(&mut self, _now: Time, _from: SocketAddrV4) {}

    /// Gives an answer the identity of another one.
    fn mislabel(&self, _reply: &mut [u8]) {}

    /// Power cycle: everything volatile is lost.
    fn restart(&mut self, now: Time);

    /// Its hardware enable (STO) is open until then: power goes off, and does not come on.
    fn open_sto(&mut self, until: Time);
}

/// The true state of a simulated drive, whatever it reports and whatever its master knows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Truth {
    /// Its power stage is on.
    pub powered: bool,
    /// It has its reference.
    pub homed: bool,
    /// Position of the motor, counts of the drive.
    pub position: f64,
    /// Velocity of the motor, counts/s.
    pub velocity: f64,
}

/// Simulated drives on one segment: each frame passes through all of them and comes back. The same object behind a
/// real interface and in virtual time.
///
/// A fault of the drive itself, injected when a datagram passes, hits the slaves of a segment in turn.
pub trait SimSegment: Any + Send {
    /// The master's interface, as its bus names it.
    fn interface(&self) -> &str;

    /// The interface at this end of the cable, where the master's is a real one.
    fn own_interface(&self) -> Option<&str>;

    /// The Ethertype of its frames.
    fn ethertype(&self) -> u16;

    /// The faults between the master and the first drive; each frame counts as a datagram.
    fn faults(&self) -> FaultPlan;

    /// The number of slaves.
    fn slaves(&self) -> usize;

    /// The time that a frame takes through all slaves that it reaches now and back, ns.
    fn delay_ns(&self) -> u64;

    /// Carries a frame through all slaves that it reaches, in place. False: it does not come back.
    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool;

    /// Gives a frame that comes back the identity of another one.
    fn mislabel(&self, _frame: &mut [u8]) {}

    /// Time has advanced to `now`, with or without a frame.
    fn advance(&mut self, now: Time);

    /// Cuts the cable in front of the slave at `place`, counted from 0 at the master; `None` repairs it.
    fn cut(&mut self, place: Option<usize>);

    /// The slave at `place` forwards frames without receiving them, until this is taken back.
    fn deafen(&mut self, place: usize, deaf: bool);

    /// Power cycle of the slave at `place`: everything volatile is lost.
    fn restart(&mut self, now: Time, place: usize);

    /// The hardware enable (STO) of the drive at `place` is open until then.
    fn open_sto(&mut self, place: usize, until: Time);
}

/// The simulated drives of one bus.
pub trait SimBus: Debug + Send + Sync {
    /// What contradicts itself, each with the name of its drive or device; `None`: the bus as a whole.
    fn faults(&self) -> Vec<(Option<String>, PlanFault)> {
        Vec::new()
    }

    /// Builds its drives, in the order of its plan, and adds them.
    fn build(&self, to: &mut Simulated);
}

/// The drives of a machine, simulated.
#[derive(Default)]
pub struct Simulated {
    /// Drives with an address of their own, in slot order.
    pub drives: Vec<Box<dyn SimDrive>>,
    /// Segments.
    pub segments: Vec<Box<dyn SimSegment>>,
    /// Serial wires.
    pub wires: Vec<SerialWire>,
}

impl Debug for Simulated {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Simulated")
            .field("drives", &self.drives.len())
            .field("segments", &self.segments.len())
            .field("wires", &self.wires.len())
            .finish()
    }
}

impl From<Vec<Box<dyn SimDrive>>> for Simulated {
    fn from(drives: Vec<Box<dyn SimDrive>>) -> Simulated {
        Simulated { drives, ..Simulated::default() }
    }
}

/// Seeded faults between a master and a simulated drive. All rates are probabilities per datagram, or per bytes
/// handed to a stream at once, 0 ... 1, in each direction unless stated otherwise.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FaultPlan {
    /// Seed of the random numbers; the same seed gives the same faults.
    pub seed: u64,
    /// A datagram is lost.
    pub drop: f64,
    /// A datagram comes twice.
    pub duplicate: f64,
    /// A datagram has one flipped bit; the frame of a segment is lost by that, since its check sequence is wrong.
    pub corrupt: f64,
    /// A datagram comes later, by `delay_ns`.
    pub delay: f64,
    /// The delay, ns.
    pub delay_ns: u64,
    /// A datagram is held until the next one of its direction has passed. Nothing else overtakes on a stream.
    pub reorder: f64,
    /// A request meets a drive that receives nothing for `stall_ns`, this request included: datagrams are lost, a
    /// stream waits.
    pub stall: f64,
    /// The length of a stall, ns.
    pub stall_ns: u64,
    /// A request makes the drive restart, and is lost.
    pub restart: f64,
    /// At a request, the drive's hardware enable (STO) opens for `sto_ns`.
    pub sto: f64,
    /// How long it stays open, ns.
    pub sto_ns: u64,
    /// A reply has a wrong identity: it comes from a wrong port, or, on a stream or a segment, answers something
    /// else.
    pub wrong_id: f64,
    /// Parcels on a stream come one byte at a time. No effect on datagrams.
    pub split: f64,
    /// A connection ends in the middle of a reply. No effect on datagrams.
    pub cut: f64,
    /// A segment of a stream is lost, and so is each of its repetitions. The sender's host repeats it after its
    /// retransmission timeout, 200 ms, and after twice the time each time after that; later segments of its
    /// direction wait behind it. No effect on datagrams.
    pub segment_loss: f64,
    /// A telegram on a serial wire has lost one of its bytes. No effect elsewhere.
    pub lost_byte: f64,
    /// Time from a request's arrival to its answer, ns.
    pub answer_ns: u64,
}
