//! A machine to which everything happens that happens to machines, on real sockets: streams, jogs and moves, a drive
//! that dies and comes back, one that was never there, one that the kernel refuses to send to, unknown
//! senders, a stop in mid-motion.
//!
//! Whoever watches a loop lets it live through this. Nothing here minds how a command ends: on a busy computer it ends
//! otherwise now and then. What came of it all is counted.

use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::thread::sleep;
use std::time::Duration;

use fieldbeat::axis::{
    Acyclic, Axis, CallError, Command, CommandId, EventKind, Link, Move, Outcome, Profile, Row, Target,
};
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat_core::axis::CallTicket;
use fieldbeat_linudp::upid;
use fieldbeat_linudp::wire::RtcCommand;

use super::{LONG, Machine, simulated, until};

/// The drives that live, on two buses; the others are `dead` and `refused`.
const LIVING: [&str; 5] = ["d0", "d1", "d2", "d3", "other"];
/// The one of them that dies in every round.
pub const VICTIM: usize = 3;

/// How many [`drives`] there are.
pub const DRIVES: usize = 4;

/// Drives of every kind: one that streams, one with a slower schedule, one with a request in every cycle, and d3 with
/// all optional telegram parts. Its link shall be lost, after `victim` misses; those of the others shall not, and have
/// `bucket`.
pub fn drives(machine: &Machine, period: &str, bucket: u32, victim: u32) -> PathBuf {
    // Probes come often, because a simulated drive has to live through its silence before it answers, within the
    // window; and they are believed soon, because on a busy computer ten answers in a row are rare at the shortest
    // periods.
    let config = machine.config(
        "m.toml",
        DRIVES,
        &format!("period = \"{period}\"\nmax_skip = \"30s\""),
        &format!(
            "health = {{ bucket = {bucket}, leak = 1, gate = 3, probe_interval = \"10ms\" }}\n\
             stream = \"off\"\nunderrun = \"hold\"\n\
             no_drive_watchdog = \"accept\"\nleash = 20\nstop = {{ deceleration = 100, timeout = \"30s\" }}\n\
             simulate = {{ stream_patience = 1000 }}"
        ),
    );
    let mut text = std::fs::read_to_string(config).unwrap();
    for (drive, keys) in [
        ("d0", "divisor = 4\nstream = \"pva-configured\""),
        ("d1", "divisor = 5\nphase = 2"),
        (
            "d3",
            "divisor = 4\nphase = 3\nmonitor = true\nreply_tag = \"count\"\nhealth.bucket = VICTIM\n\
             stop = { deceleration = 20000, timeout = \"1s\" }",
        ),
    ] {
        let name = format!("name = \"{drive}\"\n");
        text = text.replace(&name, &format!("{name}{keys}\n"));
    }
    machine.write("m.toml", text.replace("VICTIM", &victim.to_string()))
}

/// The loopback refuses one address only, and one master may have it: this process, until it ends.
static HELD: OnceLock<UnixListener> = OnceLock::new();

/// Waits until no other process of these tests has the address.
fn only_one() -> UnixListener {
    let name = SocketAddr::from_abstract_name("fieldbeat-test-refused").unwrap();
    loop {
        match UnixListener::bind_addr(&name) {
            Ok(held) => return held,
            Err(error) if error.kind() == ErrorKind::AddrInUse => sleep(Duration::from_millis(20)),
            Err(error) => panic!("{error}"),
        }
    }
}

/// The same with what goes wrong on real sockets only, and with a second bus.
///
/// Nobody is at the address of `dead`: the kernel answers with an ICMP error. It refuses to send to that of `refused`,
/// the broadcast address of the loopback, since the socket is none for broadcasts; `dead` stands behind it in the
/// batch.
pub fn drives_and_errors(machine: &Machine, period: &str, bucket: u32, victim: u32) -> PathBuf {
    let text = std::fs::read_to_string(drives(machine, period, bucket, victim)).unwrap();
    let (own, dead, other) = (machine.ip(2), machine.ip(98), machine.ip(99));
    HELD.get_or_init(only_one);
    let text = text
        + &format!(
            "[[bus.drive]]\nname = \"refused\"\naddress = \"127.255.255.255\"\n\
             [[bus.drive]]\nname = \"dead\"\naddress = \"{dead}\"\n\
             [[bus]]\nname = \"second\"\nprotocol = \"linudp-v2\"\nbind = \"{own}\"\n\
             [[bus.drive]]\nname = \"other\"\naddress = \"{other}\"\ndivisor = 4\nphase = 1\nstream = \"off\"\n\
             limits = {{ position = [0, 400], velocity = 2000, acceleration = 20000 }}\n\
             health = {{ bucket = {bucket}, leak = 1, gate = 3, probe_interval = \"10ms\" }}\n"
        );
    machine.write("m.toml", text)
}

/// A move to `position` that takes a second for 400 mm.
pub fn to(position: f64) -> Command {
    let profile = Profile { velocity: 400.0, acceleration: 4000.0, deceleration: 4000.0 };
    Command::Move(Move { target: Target::Absolute(position), profile })
}

/// A slow triangle around 200 mm, row by row, 1 ms each.
pub fn row(number: u64) -> Row {
    let phase = number % 2000;
    let (distance, velocity) = if phase < 1000 { (phase, 10.0) } else { (2000 - phase, -10.0) };
    Row { position: 200.0 + distance as f64 * 0.01, velocity, acceleration: 0.0, last: false }
}

/// An application of [`drives_and_errors`], and its drives.
pub struct Adventures {
    axes: Vec<Axis>,
    master: SocketAddrV4,
    config: PathBuf,
    options: ServerOptions,
    noise: UdpSocket,
    victim: Option<SimServer>,
    _living: SimServer,
    /// How the commands of each living drive ended.
    pub ends: [Ends; LIVING.len()],
    /// How its acyclic calls ended.
    pub calls: [Calls; LIVING.len()],
}

/// Acyclic calls to one drive: a read, a write and one that is refused, again and again.
#[derive(Debug, Default)]
pub struct Calls {
    under_way: Vec<CallTicket>,
    posted: u64,
    pub done: u64,
    pub refused: u64,
    pub failed: u64,
}

impl Calls {
    /// Counts what has ended, and posts as many anew.
    pub fn keep_up(&mut self, acyclic: &Acyclic) {
        let Calls { under_way, done, refused, failed, .. } = self;
        under_way.retain_mut(|ticket| match ticket.poll() {
            Some(Ok(_)) => {
                *done += 1;
                false
            }
            Some(Err(CallError::Refused(_))) => {
                *refused += 1;
                false
            }
            Some(Err(_)) => {
                *failed += 1;
                false
            }
            None => true,
        });
        while self.under_way.len() < 4 {
            let call = match self.posted % 3 {
                0 => upid::call(RtcCommand::READ_RAM, 0x1E0F, 0),
                1 => upid::call(RtcCommand::WRITE_RAM, 0x14BE, self.posted as u32),
                _ => upid::call(RtcCommand::READ_RAM, 0x9999, 0),
            };
            self.posted += 1;
            self.under_way.extend(acyclic.post(call, LONG).ok());
        }
    }
}

/// How the commands of an axis ended.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ends {
    pub done: u32,
    pub failed: u32,
    pub aborted: u32,
}

impl Ends {
    pub fn count(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Done => self.done += 1,
            Outcome::Failed(_) => self.failed += 1,
            Outcome::Aborted(_) => self.aborted += 1,
        }
    }
}

fn serve(config: &Path, options: ServerOptions, chosen: impl Fn(SocketAddrV4) -> bool) -> SimServer {
    let mut drives = simulated(config);
    drives.drives.retain(|drive| chosen(drive.address()));
    SimServer::start(drives, options).unwrap()
}

impl Adventures {
    /// Starts the drives of `config`, on threads with `options`, and waits until they are online.
    pub fn begin(machine: &Machine, config: &Path, axes: Vec<Axis>, options: ServerOptions) -> Adventures {
        let (victim, dead) = (machine.drive(VICTIM), machine.ip(98));
        let others = |address: SocketAddrV4| {
            address != victim && *address.ip() != dead && *address.ip() != Ipv4Addr::new(127, 255, 255, 255)
        };
        let mut adventures = Adventures {
            axes: axes.into_iter().filter(|axis| LIVING.contains(&axis.name())).collect(),
            master: machine.master(),
            config: config.to_owned(),
            options,
            noise: UdpSocket::bind(SocketAddrV4::new(machine.ip(200), 0)).unwrap(),
            victim: Some(serve(config, options, |address| address == victim)),
            _living: serve(config, options, others),
            ends: Default::default(),
            calls: Default::default(),
        };
        assert!(until(LONG, || adventures.axes.iter().all(|axis| axis.feedback().link == Link::Online)));
        adventures.count();
        adventures
    }

    /// Enabling, homing, a stream, jogs and moves, while unknown senders send noise; a drive that dies on its way;
    /// stops; and the drive's return.
    pub fn round(&mut self) {
        for command in [Command::Reset, Command::ResetFault, Command::Enable, Command::Home, to(200.0)] {
            self.all([Some(command); LIVING.len()]);
        }
        let mut rows = (0..).map(row);
        let mut stream = |axis: &mut Axis| {
            rows.by_ref().take(axis.stream_room().min(400)).for_each(|row| drop(axis.push_row(row)));
        };
        stream(&mut self.axes[0]);
        let _ = self.axes[0].follow();
        let _ = self.axes[1].jog(20.0);
        let _ = self.axes[2].jog(-20.0);
        let _ = self.axes[VICTIM].post(to(20.0));
        let address = self.victim.take().map(|victim| victim.stop()[0].address);
        assert!(until(LONG, || {
            stream(&mut self.axes[0]);
            let _ = self.noise.send_to(b"noise", self.master);
            self.calls[VICTIM].keep_up(self.axes[VICTIM].acyclic());
            self.axes[VICTIM].feedback().link == Link::Lost
        }));
        let stop = Some(Command::Stop { deceleration: None });
        self.all([stop, stop, Some(Command::QuickStop), None, stop]);
        self.victim = Some(serve(&self.config, self.options, |other| Some(other) == address));
        assert!(until(LONG, || self.axes[VICTIM].feedback().link == Link::Online));
    }

    /// Whether each drive has done so many commands, all calls were made, and the victim came to know both ends of
    /// them. The rounds to that are few where the host is quiet, and more where commands are aborted by what it does.
    pub fn have_done(&self, commands: u32) -> bool {
        let ends = self.ends.iter().all(|ends| ends.done >= commands);
        let calls = self.calls.iter().all(|calls| calls.done > 100 && calls.refused > 50);
        ends && calls && self.ends[VICTIM].aborted > 0 && self.calls[VICTIM].failed > 0
    }

    /// Sends d1 on a fast way; what happens to it next is for whoever watches.
    pub fn set_out(&mut self) {
        for command in [Command::Reset, Command::ResetFault, Command::Enable, Command::Home] {
            self.all([Some(command); LIVING.len()]);
        }
        let mut targets = [380.0, 20.0].into_iter().cycle();
        assert!(until(LONG, || {
            self.all([None, targets.next().map(to), None, None, None]);
            let _ = self.axes[1].post(to(targets.next().unwrap()));
            until(LONG / 60, || self.axes[1].feedback().status.velocity.abs() > 300.0)
        }));
    }

    /// The axes, in the order of the plan but for those that are not there.
    pub fn axes(&self) -> &[Axis] {
        &self.axes
    }

    /// Posts the commands and waits until they have ended.
    fn all(&mut self, commands: [Option<Command>; LIVING.len()]) {
        let mut open: Vec<Option<CommandId>> = (self.axes.iter_mut().zip(commands))
            .map(|(axis, command)| command.and_then(|command| axis.post(command).ok()))
            .collect();
        assert!(until(LONG, || {
            self.count_for(&mut open);
            open.iter().all(Option::is_none)
        }));
    }

    fn count(&mut self) {
        self.count_for(&mut [None; LIVING.len()]);
    }

    fn count_for(&mut self, open: &mut [Option<CommandId>]) {
        for (axis, calls) in self.axes.iter().zip(&mut self.calls) {
            calls.keep_up(axis.acyclic());
        }
        for ((axis, ends), open) in self.axes.iter_mut().zip(&mut self.ends).zip(open) {
            while let Some(event) = axis.event() {
                if let EventKind::Ended { id, outcome, .. } = event.kind {
                    ends.count(outcome);
                    *open = open.filter(|open| *open != id);
                }
            }
        }
    }
}
