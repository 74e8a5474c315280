//! The bare loop that ours is measured against, and ours in turns with a rival, cycle by cycle: the bare loop on the
//! same thread, or another client.

use std::cell::RefCell;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, SocketAddrV4, TcpStream, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd, RawFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fieldbeat::Wait;
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::ControlWord;
use fieldbeat::bus::modbus::{ControlWord as UnidriveControl, StatusWord, UnidriveDrive};
use fieldbeat::telemetry::Numbers;
use fieldbeat::time::{S, Time};
use fieldbeat_core::cycle::record::{DriveRecord, Record, Stage};
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::net::{Carriers, Datagrams, Frames, Os, UdpOptions};
use fieldbeat_core::rt::Granted;
use fieldbeat_core::rt::{Clock, MonotonicClock, Regions};
use fieldbeat_ethercat::wire::frame::{Command, FRAME_MAX, datagrams};
use fieldbeat_linudp::wire::{REQUEST_MAX, Request, ResponseDef, ResponseView};
use fieldbeat_modbus::wire::{ADU_MAX, HEADER, Response};
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;

use super::bare_wire::BareWire;
use super::fleet::{self, Fleet, Side};
use super::libmodbus::{Client, Libmodbus};
use super::rig::{self, Calls, Count, Pace, Rig, give_up, thread_cpu_ns};
use super::{handshake, unidrive};

/// What one loop measured.
#[derive(Debug, Default)]
pub struct Measured {
    /// From before the call that sends to after the one that receives, ns.
    pub round_trips: Vec<u64>,
    /// From the end of the sleep on, ns: ours until it sleeps again, the bare loop's until the last reply.
    pub busy: Vec<u64>,
    /// On a PROFIBUS wire, ns: our send phase, and from the end of the sleep until the bare loop has sent its first
    /// request.
    pub sending: Vec<u64>,
    /// Processor time from one sleep's begin to the next one's, ns.
    pub cpu: Vec<u64>,
    /// System calls, the sleep included; ours only.
    pub calls: Vec<Count>,
}

impl Measured {
    fn note(&mut self, record: &Record) {
        if let Record::Drive(DriveRecord { rtt_ns: Some(rtt_ns), .. }) = record {
            self.round_trips.push(u64::from(rtt_ns.get()));
        }
    }
}

/// What is to be measured.
pub struct Duel<'a> {
    /// What the loop's thread got.
    pub granted: &'a Granted,
    /// The drives of our loop, and of the bare one; libmodbus has one Unidrive.
    pub fleet: Fleet,
    /// How ours waits, and the bare loop; libmodbus always blocks.
    pub wait: Wait,
    /// The period of each.
    pub period_ns: u64,
    /// So many cycles.
    pub cycles: usize,
    /// The carriers of our loop, and where its system calls are counted.
    pub carriers: &'a (dyn Carriers + Sync),
    /// See `carriers`.
    pub calls: &'a Calls,
    /// Who takes turns with it.
    pub rival: Rival<'a>,
}

/// Who ours is held against.
#[derive(Clone, Copy, Debug)]
pub enum Rival<'a> {
    /// The bare loop, on the same thread.
    Bare,
    /// The client over libmodbus, a process of its own with one Unidrive.
    Libmodbus(&'a Libmodbus),
}

/// What came of it.
#[derive(Debug)]
pub struct Outcome {
    /// Ours.
    pub ours: Measured,
    /// The rival; of the client over libmodbus only the round trips.
    pub theirs: Measured,
    /// The end of our loop.
    pub end: Numbers,
}

impl Duel<'_> {
    /// Lets our loop and its rival run in turns: each has its own grid, half a period behind that of the other, and its
    /// own drives, all in operation and served by one thread. Whatever the machine does in between, it does to both,
    /// and each finds the caches as the other has left them.
    ///
    /// # Errors
    ///
    /// What kept the rival from measuring.
    pub fn fight(&self) -> Result<Outcome, String> {
        let (side, fleet) = match self.rival {
            Rival::Bare => (Side::Bare, self.fleet),
            Rival::Libmodbus(_) => (Side::Libmodbus, Fleet::unidrives(1)),
        };
        let (mut simulated, theirs) = (self.fleet.simulate(Side::Ours), fleet.simulate(side));
        simulated.drives.extend(theirs.drives);
        simulated.segments.extend(theirs.segments);
        simulated.wires.extend(theirs.wires);
        let server = rig::serve(simulated, self.granted);
        let outcome = match self.rival {
            Rival::Bare => rig::on_loop_thread(|_| self.against_bare()),
            Rival::Libmodbus(libmodbus) => {
                let client = libmodbus.start(self.granted)?;
                rig::on_loop_thread(|_| self.against_libmodbus(client))
            }
        };
        drop(server);
        match outcome {
            Ok(outcome) => outcome.map_err(|error| error.to_string()),
            Err(error) => give_up(error),
        }
    }

    fn rig(&self) -> Rig {
        let Duel { fleet, wait, period_ns, .. } = *self;
        let cycle = rig::exchange_cycle(period_ns, wait);
        Rig::new(cycle, fleet.buses(Side::Ours), Pace::Grid, self.carriers, Arc::clone(self.calls))
    }

    fn against_bare(&self) -> io::Result<Outcome> {
        let mut rig = self.rig();
        let mut bare = BareLoop::open(self.fleet, self.wait, self.period_ns)?;
        bare.enable()?;
        // A segment that gets no frames for two cycles is in operation no more.
        let mut bare_ran = Ok(None);
        rig.enable_with(|grid| {
            if bare_ran.is_ok() && self.fleet.segment > 0 {
                bare_ran = bare.cycle(grid + self.period_ns / 2, true, |_| {});
            }
        });
        bare_ran?;
        let (ours, theirs) = self.turns(&mut rig, &mut bare)?;
        rig.settle();
        Ok(Outcome { ours, theirs, end: rig.end() })
    }

    fn against_libmodbus(&self, mut client: Client) -> io::Result<Outcome> {
        let mut rig = self.rig();
        rig.enable();
        client.run(rig.grid() + 4 * self.period_ns + self.period_ns / 2, self.period_ns, self.cycles)?;
        let mut ours = Measured::default();
        for _ in 0..self.cycles {
            rig.turn(|record| ours.note(&record));
        }
        rig.settle();
        let round_trips = client.end().map_err(io::Error::other)?;
        Ok(Outcome { ours, theirs: Measured { round_trips, ..Measured::default() }, end: rig.end() })
    }

    fn turns(&self, rig: &mut Rig, bare: &mut BareLoop) -> io::Result<(Measured, Measured)> {
        let (mut ours, mut theirs) = (Measured::default(), Measured::default());
        for _ in 0..self.cycles {
            let (before, executed) = (thread_cpu_ns(), rig.status().executed);
            let mut sending = None;
            let turn = rig.turn(|record| {
                ours.note(&record);
                if let Record::Cycle(cycle) = record {
                    sending = Some(u64::from(cycle.stages_ns[Stage::Send as usize]));
                }
            });
            let between = thread_cpu_ns();
            let grid = rig.grid() + self.period_ns / 2;
            let busy = bare.cycle(grid, true, |reply| theirs.round_trips.push(reply.rtt_ns))?;
            let after = thread_cpu_ns();
            // Only pairs that both were executed and answered.
            if let Some(busy) = busy
                && rig.status().executed > executed
            {
                ours.busy.push(turn.busy_ns);
                ours.calls.push(turn.calls);
                ours.cpu.push(between - before);
                theirs.busy.push(busy);
                theirs.cpu.push(after - between);
                if let Some((ours_ns, bare_ns)) = sending.zip(bare.sending_ns) {
                    ours.sending.push(ours_ns);
                    theirs.sending.push(bare_ns);
                }
            }
        }
        Ok((ours, theirs))
    }
}

/// The least that any master has to do: sleep until the grid point, drop what came too late, `send` to each drive that
/// is due, then `ppoll` and `recv` until all have answered or nine tenths of the period are over. It sends the bytes
/// that the loop sends to a drive in operation, looks at none of the replies', and judges nothing. On a PROFIBUS wire
/// it waits for an answer until the slot time is over, and the next request follows after the idle time.
struct BareLoop {
    wait: Wait,
    period_ns: u64,
    fleet: Fleet,
    turn: u32,
    socket: Option<UdpSocket>,
    linmots: Vec<(SocketAddrV4, Time)>,
    streams: Vec<TcpStream>,
    unidrives: Vec<Requested>,
    segment: Option<BareSegment>,
    wire: Option<BareWire>,
    /// From the end of the last sleep until the first request was on the wire, if there is one.
    sending_ns: Option<u64>,
}

/// A Unidrive and its exchange.
struct Requested {
    /// While the drive comes up, and then.
    idle: Message,
    on: Message,
    transaction: u16,
    sent: Time,
    reply: [u8; ADU_MAX],
    /// A reply has so many bytes, so many are still to come.
    length: usize,
    owed: usize,
}

struct Message {
    bytes: [u8; ADU_MAX],
    length: usize,
}

/// One reply.
struct Reply<'a> {
    rtt_ns: u64,
    bytes: &'a [u8],
    of: Of,
}

/// Whose it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Of {
    Linmot,
    Unidrive,
    Segment,
    Wire,
}

/// Processor time of the bare loop alone, ns a cycle, on the calling thread.
pub fn alone(fleet: Fleet, wait: Wait, period_ns: u64, cycles: u64) -> io::Result<u64> {
    let mut bare = BareLoop::open(fleet, wait, period_ns)?;
    bare.enable()?;
    let mut grid = MonotonicClock::read();
    let mut cycle = |bare: &mut BareLoop| {
        // A slot that was missed is passed over.
        grid = (grid + period_ns).max(MonotonicClock::read());
        bare.cycle(grid, true, |_| {})
    };
    // It has found its pace.
    for _ in 0..50 {
        cycle(&mut bare)?;
    }
    let before = thread_cpu_ns();
    for _ in 0..cycles {
        cycle(&mut bare)?;
    }
    Ok((thread_cpu_ns() - before) / cycles)
}

impl BareLoop {
    fn open(fleet: Fleet, wait: Wait, period_ns: u64) -> io::Result<BareLoop> {
        let socket = match fleet.linmots {
            0 => None,
            _ => Some(UdpSocket::bind(fleet::master(Side::Bare))?),
        };
        if let Some(socket) = &socket {
            socket.set_nonblocking(true)?;
        }
        let plan = fleet.modbus(Side::Bare);
        let streams = handshake::connect(&plan)?;
        for stream in &streams {
            stream.set_nonblocking(true)?;
        }
        Ok(BareLoop {
            wait,
            period_ns,
            fleet,
            turn: 0,
            socket,
            linmots: (0..fleet.linmots).map(|index| (fleet::address(Side::Bare, index), Time(0))).collect(),
            streams,
            unidrives: plan.drives.iter().map(Requested::new).collect(),
            segment: (fleet.segment > 0).then(|| BareSegment::open(fleet, wait, period_ns)).transpose()?,
            wire: match &fleet.profibus(Side::Bare)[..] {
                [] => None,
                [plan] => Some(BareWire::open(plan, wait, period_ns)?),
                _ => return Err(io::Error::other("the bare loop has one wire at most")),
            },
            sending_ns: None,
        })
    }

    /// One cycle; `take` gets each reply. Returns the time from the end of the sleep to the last one, if all came.
    fn cycle(&mut self, grid: Time, on: bool, mut take: impl FnMut(Reply<'_>)) -> io::Result<Option<u64>> {
        let mut request = [0; REQUEST_MAX];
        let control = Some(if on { ControlWord::ON } else { ControlWord::BASE });
        let blocks = Request { response_def: ResponseDef::CYCLIC, control, ..Request::default() };
        let length = blocks.emit(&mut request);
        let phase = self.turn % self.fleet.every;
        self.turn = self.turn.wrapping_add(1);
        // What a reply may come on; the LinMots' socket first, if there is one, and the segment's and the
        // wire's last.
        let port = self.wire.as_ref().map(BareWire::port);
        let mut set: Vec<PollFd<'_>> = Vec::with_capacity(3 + self.streams.len());
        set.extend(self.socket.as_ref().map(|socket| PollFd::new(socket.as_fd(), PollFlags::POLLIN)));
        let streams_at = set.len();
        set.extend(self.streams.iter().map(|stream| PollFd::new(stream.as_fd(), PollFlags::empty())));
        let segment_at = set.len();
        let segment_fd = self.segment.as_ref().and_then(|segment| segment.fd);
        set.extend(segment_fd.map(|fd| PollFd::new(fd, PollFlags::POLLIN)));
        let wire_at = set.len();
        set.extend(port.as_ref().map(|port| PollFd::new(port.as_fd(), PollFlags::POLLIN)));

        MonotonicClock.sleep_until(grid);
        let woke = MonotonicClock::read();
        let deadline = grid + self.period_ns / 10 * 9;
        let mut reply = [0; 128];
        let mut linmots_left = self.linmots.len();
        if let Some(socket) = &self.socket {
            // One late reply would otherwise be taken for the next one, that for the one after it, and so on for ever.
            while socket.recv_from(&mut reply).is_ok() {}
            for (peer, sent) in &mut self.linmots {
                *sent = MonotonicClock::read();
                socket.send_to(&request[..length], *peer)?;
            }
        }
        let mut unidrives_left = 0;
        for (index, (stream, requested)) in self.streams.iter().zip(&mut self.unidrives).enumerate() {
            if index as u32 % self.fleet.every == phase && requested.owed == 0 {
                requested.ask(stream, on)?;
            }
            // Those of earlier cycles too: their connections have to be empty before the next request.
            if requested.owed > 0 {
                set[streams_at + index].set_events(PollFlags::POLLIN);
                unidrives_left += 1;
            }
        }
        let mut segments_left = 0;
        if let Some(segment) = &mut self.segment {
            segment.send()?;
            segments_left = 1;
        }
        let mut turns_left = 0;
        if let Some(wire) = &mut self.wire {
            turns_left = wire.begin(phase)?;
            self.sending_ns = Some(MonotonicClock::read().since(woke));
        }
        let (mut now, mut last) = (woke, woke);
        while linmots_left + unidrives_left + segments_left + turns_left > 0 && now < deadline {
            if self.wait == Wait::Poll {
                let begin = MonotonicClock::read();
                let overdue_at = self.wire.as_ref().and_then(|wire| wire.overdue_at(begin));
                let rest = overdue_at.map_or(deadline, |at| at.min(deadline)).since(begin);
                let timeout = TimeSpec::new((rest / S) as _, (rest % S) as _);
                ppoll(&mut set, Some(timeout), None)?;
            }
            let is_ready = |at: usize| self.wait == Wait::Spin || set[at].any().unwrap_or(true);
            while let Some(socket) = self.socket.as_ref().filter(|_| linmots_left > 0 && is_ready(0)) {
                let Some((length, from)) = unless_blocked(socket.recv_from(&mut reply))? else { break };
                last = MonotonicClock::read();
                linmots_left -= 1;
                if let SocketAddr::V4(from) = from
                    && let Some((_, sent)) = fleet::index_of(from).and_then(|index| self.linmots.get(index))
                {
                    take(Reply { rtt_ns: last.since(*sent), bytes: &reply[..length], of: Of::Linmot });
                }
            }
            for (index, (stream, requested)) in self.streams.iter().zip(&mut self.unidrives).enumerate() {
                if requested.owed > 0 && is_ready(streams_at + index) && requested.receive(stream)? {
                    last = MonotonicClock::read();
                    unidrives_left -= 1;
                    let bytes = &requested.reply[..requested.length];
                    take(Reply { rtt_ns: last.since(requested.sent), bytes, of: Of::Unidrive });
                }
            }
            if let Some(segment) = self.segment.as_mut().filter(|_| segments_left > 0 && is_ready(segment_at))
                && let Some((at, rtt_ns, bytes)) = segment.receive()
            {
                last = at;
                segments_left = 0;
                take(Reply { rtt_ns, bytes, of: Of::Segment });
            }
            if let Some(wire) = self.wire.as_mut().filter(|_| turns_left > 0 && is_ready(wire_at))
                && let Some((at, rtt_ns)) = wire.receive()?
            {
                last = at;
                turns_left -= 1;
                take(Reply { rtt_ns, bytes: wire.answer(), of: Of::Wire });
                wire.send()?;
            }
            for (poll, requested) in set[streams_at..].iter_mut().zip(&self.unidrives) {
                if requested.owed == 0 {
                    poll.set_events(PollFlags::empty());
                }
            }
            now = MonotonicClock::read();
        }
        Ok((linmots_left + unidrives_left + segments_left + turns_left == 0).then(|| last.since(woke)))
    }

    /// Cycles until all drives are in operation: each switches on from a low control word only.
    fn enable(&mut self) -> io::Result<()> {
        let mut grid = MonotonicClock::read();
        let (mut linmots, mut unidrives) = (0, 0);
        for cycle in 0..20_000 {
            grid = (grid + self.period_ns).max(MonotonicClock::read());
            if cycle % self.fleet.every == 0 {
                (linmots, unidrives) = (0, 0);
            }
            self.cycle(grid, cycle >= 20 * self.fleet.every, |reply| match reply.of {
                Of::Linmot => linmots += usize::from(is_operational(reply.bytes)),
                Of::Unidrive => unidrives += usize::from(is_active(reply.bytes)),
                // They are already.
                Of::Segment | Of::Wire => {}
            })?;
            let ended = (cycle + 1) % self.fleet.every == 0;
            let all = self.linmots.len() * self.fleet.every as usize;
            if ended && linmots == all && unidrives == self.unidrives.len() {
                return Ok(());
            }
        }
        Err(io::Error::other("the simulated drives do not come into operation"))
    }
}

/// A segment: its last frame of the time when it came into operation, sent again with another index and the time of its
/// slot.
struct BareSegment {
    tap: Arc<Mutex<Tap>>,
    fd: Option<BorrowedFd<'static>>,
    /// The loop that brought it up.
    _rig: Rig,
    /// Where its datagrams have their indices; our time, and what it was when the frame was sent.
    indices: Vec<usize>,
    time: Option<(usize, u32)>,
    first: Time,
    index: u8,
    sent: Time,
    room: Box<[u8; FRAME_MAX]>,
}

/// A carrier, and what was sent last.
struct Tap {
    net: Box<dyn Frames>,
    frame: Vec<u8>,
}

struct Tapped(Arc<Mutex<Tap>>);

/// The carriers of the operating system; keeps hold of the one that is opened.
#[derive(Default)]
struct Taps(RefCell<Option<Arc<Mutex<Tap>>>>);

impl Carriers for Taps {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(ErrorKind::Unsupported.into())
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        let net = Os::default().frames(interface, ethertype)?;
        let tap = Arc::new(Mutex::new(Tap { net, frame: Vec::with_capacity(FRAME_MAX) }));
        self.0.replace(Some(Arc::clone(&tap)));
        Ok(Box::new(Tapped(tap)))
    }
}

impl Tapped {
    fn lock(&self) -> MutexGuard<'_, Tap> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Frames for Tapped {
    fn fd(&self) -> Option<RawFd> {
        self.lock().net.fd()
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let mut tap = self.lock();
        tap.frame.clear();
        tap.frame.extend_from_slice(frame);
        tap.net.send(frame)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        self.lock().net.receive(room)
    }

    fn now(&mut self) -> Time {
        self.lock().net.now()
    }

    fn mac(&self) -> [u8; 6] {
        self.lock().net.mac()
    }

    fn memory(&self, regions: &mut Regions) {
        self.lock().net.memory(regions);
    }
}

impl BareSegment {
    /// A segment with all drives in operation: our loop brings it up, and is left standing.
    fn open(fleet: Fleet, wait: Wait, period_ns: u64) -> io::Result<BareSegment> {
        let taps = Taps::default();
        let cycle = rig::exchange_cycle(period_ns, wait);
        let buses: Vec<Box<dyn BusPlan>> = vec![Box::new(fleet.ethercat(Side::Bare))];
        let mut rig = Rig::new(cycle, buses, Pace::Grid, &taps, Calls::default());
        rig.enable();
        // Until it requests nothing else, as in almost all cycles.
        let tap = taps.0.into_inner().ok_or(ErrorKind::NotFound)?;
        let plain = |frame: &[u8]| {
            let last = datagrams(frame).ok()?.map_while(Result::ok).last()?;
            matches!(last.command(), Some(Command::Brd(_))).then(|| frame.to_vec())
        };
        let frame = loop {
            rig.turn(|_| {});
            let tap = tap.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(frame) = plain(&tap.frame) {
                break frame;
            }
        };
        let all = || datagrams(&frame).into_iter().flatten().map_while(Result::ok);
        let time = all().find(|datagram| matches!(datagram.command(), Some(Command::Fpwr(..))));
        let time = time
            .and_then(|time| Some((time.place.data().start, u32::from_le_bytes(*time.data.first_chunk()?))));
        let indices = all().map(|datagram| datagram.place.at + 1).collect();
        let guard = tap.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: the carrier keeps its descriptor open, and lives as long as the tap.
        let fd = guard.net.fd().map(|fd| unsafe { BorrowedFd::borrow_raw(fd) });
        drop(guard);
        Ok(BareSegment {
            tap,
            fd,
            indices,
            time,
            first: rig.grid(),
            _rig: rig,
            index: 0,
            sent: Time(0),
            room: Box::new([0; FRAME_MAX]),
        })
    }

    fn send(&mut self) -> io::Result<()> {
        let mut tap = self.tap.lock().unwrap_or_else(PoisonError::into_inner);
        let Tap { net, frame } = &mut *tap;
        self.index = self.index.wrapping_add(1);
        for place in &self.indices {
            frame[*place] = self.index;
        }
        if let Some((place, time)) = self.time {
            let time = time.wrapping_add(net.now().since(self.first) as u32);
            frame[place..place + 4].copy_from_slice(&time.to_le_bytes());
        }
        match net.send(frame) {
            Ok(at) => self.sent = at,
            Err(unsent) => return Err(io::Error::other(format!("{unsent:?}"))),
        }
        Ok(())
    }

    /// The reply to the last frame: when it came, what it took, and its bytes.
    fn receive(&mut self) -> Option<(Time, u64, &[u8])> {
        let mut tap = self.tap.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let (at, length) = tap.net.receive(&mut self.room[..])?;
            // Another one came too late.
            if self.room[*self.indices.first()?] == self.index {
                return Some((at, at.since(self.sent), &self.room[..length]));
            }
        }
    }
}

impl Requested {
    fn new(drive: &UnidriveDrive) -> Requested {
        let (idle, on) =
            (Message::new(drive, UnidriveControl::IDLE), Message::new(drive, UnidriveControl::FORWARD));
        let length = Message::reply_length(drive);
        Requested { idle, on, transaction: 0, sent: Time(0), reply: [0; ADU_MAX], length, owed: 0 }
    }

    fn ask(&mut self, mut stream: &TcpStream, on: bool) -> io::Result<()> {
        let Message { bytes, length } = if on { &mut self.on } else { &mut self.idle };
        self.transaction = self.transaction.wrapping_add(1);
        bytes[..2].copy_from_slice(&self.transaction.to_be_bytes());
        self.sent = MonotonicClock::read();
        self.owed = self.length;
        stream.write_all(&bytes[..*length])
    }

    /// Takes in what there is; whether the reply is whole.
    fn receive(&mut self, mut stream: &TcpStream) -> io::Result<bool> {
        let begin = self.length - self.owed;
        match unless_blocked(stream.read(&mut self.reply[begin..self.length]))? {
            Some(0) => return Err(ErrorKind::UnexpectedEof.into()),
            Some(count) => self.owed -= count,
            None => {}
        }
        Ok(self.owed == 0)
    }
}

impl Message {
    fn new(drive: &UnidriveDrive, control: UnidriveControl) -> Message {
        let (bytes, length) = unidrive::request(drive, control);
        Message { bytes, length }
    }

    fn reply_length(drive: &UnidriveDrive) -> usize {
        HEADER + 2 + 2 * usize::from(unidrive::mapping(drive).reads()[0].registers)
    }
}

/// `None`: there is nothing yet.
pub fn unless_blocked<T>(result: io::Result<T>) -> io::Result<Option<T>> {
    match result {
        Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(None),
        other => other.map(Some),
    }
}

fn is_operational(reply: &[u8]) -> bool {
    ResponseView::new(reply).is_ok_and(|view| view.status().is_some_and(|status| status.operation_enabled()))
}

fn is_active(reply: &[u8]) -> bool {
    match Response::parse(reply) {
        Ok((_, Response::ReadWritten { data })) => {
            data.long(unidrive::STATUS_AT).is_some_and(|word| StatusWord(word as u16).active())
        }
        _ => false,
    }
}
