//! Drives that report by a script, and a wire that records the master's requests and the replies.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::OpenError;
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::{ErrorCode, LinUdpPlan, StateVar, StatusWord, WarnWord};
use fieldbeat::sim::SimDrive;
use fieldbeat::time::Time;
use fieldbeat_core::bus::Opened;
use fieldbeat_core::net::{Carriers, Datagrams, Outbox, Received, Sent, StreamPeer, Streams, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_linudp::wire::{RESPONSE_MAX, Request, RequestDef, Response, ResponseDef};
use fieldbeat_sim::linudp::{LinMotSettings, LinMotSim};

use super::super::input::Input;

/// Replies that may be said again.
const REMEMBERED: usize = 16;

/// No buffer space available.
const ENOBUFS: i32 = 105;

/// What is shared with a drive while the machine runs.
#[derive(Debug, Default)]
pub struct Script {
    lie: Lie,
    /// So many replies more are not the truth.
    lies: u32,
    /// So many replies more are lost.
    pub silence: u32,
    /// An error of the drive, to be raised with the next request.
    pub provoke: Option<ErrorCode>,
    /// Its last replies, newest first.
    pub said: VecDeque<Vec<u8>>,
}

impl Script {
    pub fn lie(&mut self, input: &mut Input<'_>) {
        self.lie.change(input);
        self.lies = match input.byte() {
            255 => u32::MAX,
            replies => u32::from(replies) + 1,
        };
    }

    pub fn tell_the_truth(&mut self) {
        (self.lie, self.lies) = (Lie::default(), 0);
    }
}

/// What takes the place of the truth in a reply.
#[derive(Debug, Default)]
struct Lie {
    status: Option<u16>,
    state: Option<u16>,
    /// The state has the count that the drive has received.
    counts: bool,
    /// These bits of the count are wrong.
    count: u16,
    actual: Option<i32>,
    demand: Option<i32>,
    current: Option<i16>,
    warn: Option<u16>,
    error: Option<u16>,
    /// These bits of the definitions are wrong.
    definitions: (u32, u32),
    /// So many bytes are missing.
    cut: usize,
}

impl Lie {
    fn change(&mut self, input: &mut Input<'_>) {
        match input.below(12) {
            0 => self.status = Some(input.word()),
            1 => self.state = Some(input.word()),
            // As a drive in operation says it.
            2 | 3 => {
                let sub = input.byte() & 0xF0;
                self.state = Some(0x0800 | u16::from(sub));
                self.status = Some(0x0037 | u16::from(sub & 0x80) << 4 | u16::from(sub & 0x20) << 8);
                self.counts = true;
            }
            // A known state, with a status word that need not go with it.
            4 => {
                self.state = Some(u16::from(input.byte() % 22) << 8 | input.of(&[0, 0x0F]));
                self.status =
                    Some(input.of(&[0x0000, 0x0037, 0x0035, 0x0030, 0x003B, 0x0072, 0x2037, 0x1038]));
            }
            5 => self.count = u16::from(input.byte() & 0xF),
            6 => self.demand = Some(position(input)),
            7 => self.actual = Some(position(input)),
            8 => (self.current, self.warn) = (Some(input.word() as i16), Some(input.word())),
            9 => self.error = Some(input.word()),
            10 => self.definitions = (1 << input.below(32), u32::from(input.byte())),
            _ => self.cut = input.below(64),
        }
    }

    fn bend(&self, bytes: &mut Vec<u8>, received: u8) {
        let Ok(mut response) = Response::parse(bytes) else { return };
        response.status = self.status.map(StatusWord).or(response.status);
        if let Some(state) = self.state {
            let count = if self.counts { u16::from(received) } else { state & 0xF };
            response.state = Some(StateVar(state & !0xF | count));
        }
        response.state = response.state.map(|StateVar(state)| StateVar(state ^ self.count));
        response.actual = self.actual.or(response.actual);
        response.demand = self.demand.or(response.demand);
        response.current = self.current.or(response.current);
        response.warn = self.warn.map(WarnWord).or(response.warn);
        response.error = self.error.map(ErrorCode).or(response.error);
        response.request_def = RequestDef(response.request_def.0 ^ self.definitions.0);
        response.response_def = ResponseDef(response.response_def.0 ^ self.definitions.1);
        bytes.resize(RESPONSE_MAX, 0);
        let size = response.emit(bytes);
        bytes.truncate(size.saturating_sub(self.cut));
    }
}

/// Anywhere, but often where a machine is.
fn position(input: &mut Input<'_>) -> i32 {
    match input.byte() {
        edge @ 0..8 => {
            [i32::MIN, i32::MAX, 0, -1, 2_000_000, 2_000_001, -1_000_001, 1_000_000][usize::from(edge)]
        }
        8..32 => input.long() as i32,
        _ => i32::from(input.word()) * 30,
    }
}

pub struct HostileDrive {
    drive: LinMotSim,
    script: Arc<Mutex<Script>>,
    /// The count of the last motion command.
    received: u8,
}

impl SimDrive for HostileDrive {
    crate::forward_sim_drive!(drive);

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let mut script = self.script.lock().unwrap();
        if let Some(code) = script.provoke.take() {
            self.drive.provoke(code.0);
        }
        if let Some(motion) = Request::parse(bytes).ok().and_then(|request| request.motion) {
            self.received = (motion.header & 0xF) as u8;
        }
        let to = self.drive.receive(now, from, bytes, reply)?;
        if script.lies > 0 {
            script.lies = script.lies.saturating_sub(u32::from(script.lies < u32::MAX));
            script.lie.bend(reply, self.received);
        }
        script.said.push_front(reply.clone());
        script.said.truncate(REMEMBERED);
        if script.silence > 0 {
            script.silence -= 1;
            return None;
        }
        Some(to)
    }

    fn restart(&mut self, now: Time) {
        self.drive.restart(now);
    }
}

/// One request as it left.
#[derive(Clone, Debug)]
pub struct Requested {
    pub axis: usize,
    pub at: Time,
    pub bytes: Vec<u8>,
}

/// One datagram as it came.
#[derive(Clone, Debug)]
pub struct Came {
    pub from: SocketAddrV4,
    pub at: Time,
    pub bytes: Vec<u8>,
    pub truncated: bool,
}

/// What passed the master's socket since it was last looked at.
#[derive(Debug, Default)]
pub struct Wire {
    pub requested: Vec<Requested>,
    pub came: Vec<Came>,
    /// Requests that the operating system refused, by axis.
    pub refused: Vec<u64>,
    /// To these axes nothing can be sent.
    pub jammed: Vec<bool>,
}

impl Wire {
    pub fn clear(&mut self) {
        self.requested.clear();
        self.came.clear();
    }
}

/// A LinUDP bus with hostile drives.
#[derive(Debug)]
pub struct HostileBus {
    plan: LinUdpPlan,
    pub scripts: Vec<Arc<Mutex<Script>>>,
    pub wire: Arc<Mutex<Wire>>,
}

impl HostileBus {
    pub fn new(plan: LinUdpPlan) -> HostileBus {
        let count = plan.drives.len();
        let wire = Wire { refused: vec![0; count], jammed: vec![false; count], ..Wire::default() };
        let scripts = (0..count).map(|_| Arc::default()).collect();
        HostileBus { plan, scripts, wire: Arc::new(Mutex::new(wire)) }
    }

    /// Its drives, with these settings in slot order.
    pub fn simulated(&self, settings: Vec<LinMotSettings>) -> Vec<Box<dyn SimDrive>> {
        (settings.into_iter().zip(&self.scripts))
            .map(|(settings, script)| {
                let drive = LinMotSim::new(settings);
                Box::new(HostileDrive { drive, script: Arc::clone(script), received: 0 }) as Box<dyn SimDrive>
            })
            .collect()
    }
}

impl BusPlan for HostileBus {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        self.plan.open(period_ns, &Tapped { carriers, wire: Arc::clone(&self.wire) })
    }
}

struct Tapped<'a> {
    carriers: &'a dyn Carriers,
    wire: Arc<Mutex<Wire>>,
}

impl Carriers for Tapped<'_> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let inner = self.carriers.datagrams(bind, options)?;
        Ok(Box::new(TappedCarrier { inner, wire: Arc::clone(&self.wire) }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        self.carriers.streams(peers)
    }
}

struct TappedCarrier {
    inner: Box<dyn Datagrams>,
    wire: Arc<Mutex<Wire>>,
}

impl TappedCarrier {
    fn wire(&self) -> MutexGuard<'_, Wire> {
        self.wire.lock().unwrap()
    }
}

impl Datagrams for TappedCarrier {
    fn fd(&self) -> Option<RawFd> {
        self.inner.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let posted: Vec<usize> =
            (0..outbox.len()).filter(|index| outbox.sent(*index) == Sent::Posted).collect();
        for index in &posted {
            if self.wire().jammed[*index] {
                outbox.note(*index, Sent::Failed(ENOBUFS));
            }
        }
        self.inner.send(outbox);
        let mut wire = self.wire();
        for axis in posted {
            match outbox.sent(axis) {
                Sent::At(at) => {
                    wire.requested.push(Requested { axis, at, bytes: outbox.bytes(axis).to_vec() })
                }
                _ => wire.refused[axis] += 1,
            }
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let wire = Arc::clone(&self.wire);
        self.inner.receive(&mut |received| {
            let mut wire = wire.lock().unwrap();
            wire.came.push(Came {
                from: received.from,
                at: received.at,
                bytes: received.bytes.to_vec(),
                truncated: received.truncated,
            });
            drop(wire);
            take(received);
        })
    }

    fn batch(&self) -> usize {
        self.inner.batch()
    }

    fn dropped(&self) -> u64 {
        self.inner.dropped()
    }

    fn memory(&self, _regions: &mut Regions) {}
}
