//! Round trip of one drive, for each protocol and both ways of waiting: our loop against a bare loop, and against what
//! else speaks that protocol or carries as much: `sockperf under-load` for datagrams, a blocking client over libmodbus
//! for Modbus TCP.
//!
//! Ours and the bare loop run on the same thread in turns, cycle by cycle, each with a drive of its own that is in
//! operation, in the same wait mode: every millisecond one of them has its exchange. Both stamp before the call that
//! sends and after the one that receives, and the same bytes go both ways.
//!
//! A Kollmorgen drive stands on a segment of its own on this host, `local:`: the bare loop sends the frame of ours
//! again and again, with the index and the time of its own.
//!
//! A Lenze drive stands on a PROFIBUS wire of its own on this host, at 12 Mbit/s: the bare loop writes the telegram of
//! ours again and again, each time as a new one, and reads until the answer is whole. The wire takes the time of its
//! bits.
//!
//! A Unidrive's exchange is one request with function 23: everything cyclic is in menu 0. The client over libmodbus has
//! its turns with ours alone: on the same grid, by `clock_nanosleep`, on the same core and at the same priority, in a
//! process of its own. Were it there while ours meets the bare loop, one of the two would always find the caches of
//! another process.
//!
//! sockperf sends at the same rate to the same kind of server, on the same core: a drive that answers in its protocol.
//! Yet it is no cyclic loop: one of its threads spins between the messages and never lets the core fall asleep, another
//! one receives. So its round trip is held against ours in wait mode "spin".

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::net::SocketAddrV4;
use std::process::{Command, ExitCode, Stdio};

use fieldbeat::Wait;
use fieldbeat::sim::{FaultPlan, SimDrive};
use fieldbeat::time::{MS, S, Time};
use fieldbeat_core::net::Os;
use fieldbeat_core::rt::Granted;
use fieldbeat_ethercat as ethercat;
use fieldbeat_modbus as modbus;
use fieldbeat_profibus as profibus;
use serde_json::{Value, json};
use support::bare::{Duel, Rival};
use support::fleet::{self, Fleet, Side};
use support::libmodbus::Libmodbus;
use support::rig::{self, Calls};
use support::stats::{Interval, Sample};
use support::{Args, Report, Steal, in_turns, shown};

/// Every so often one of the contenders has its exchange.
const TURN_NS: u64 = MS;

/// One protocol in one wait mode: ours, and who takes turns with it.
#[derive(Debug)]
struct Match<'a> {
    protocol: &'static str,
    mode: &'static str,
    fleet: Fleet,
    wait: Wait,
    rival: Rival<'a>,
    ours: Sample,
    theirs: Sample,
    planned: u64,
    executed: u64,
    skipped: u64,
    sent: u64,
    answered: u64,
    missed: u64,
}

fn main() -> ExitCode {
    let args = Args::parse("round_trip");
    let (rounds, cycles, seconds) = if args.quick { (3, 250, 1) } else { (30, 1_000, 1) };
    let granted = rig::introduce("round_trip: one drive against a bare loop, sockperf and libmodbus");
    let with_sockperf = match sockperf(&granted, 1) {
        Ok(_) => true,
        Err(why) => {
            println!("no ratio to sockperf: {why}");
            false
        }
    };
    let libmodbus = match Libmodbus::compile() {
        Ok(libmodbus) => Some(libmodbus),
        Err(why) => {
            println!("no ratio to libmodbus: {why}");
            None
        }
    };
    let steal = Steal::begin();
    let mut matches = Vec::new();
    for (wait, _) in MODES {
        matches.push(Match::new("linudp-v2", Fleet::linmots(1), wait, Rival::Bare));
        matches.push(Match::new(modbus::PROTOCOL, Fleet::unidrives(1), wait, Rival::Bare));
        matches.push(Match::new(ethercat::PROTOCOL, Fleet::segment(1), wait, Rival::Bare));
        matches.push(Match::new(profibus::PROTOCOL, Fleet::lenzes(1), wait, Rival::Bare));
        let with = libmodbus.as_ref().map(Rival::Libmodbus);
        matches.extend(with.map(|rival| Match::new(modbus::PROTOCOL, Fleet::unidrives(1), wait, rival)));
    }
    let mut from_sockperf = Sample::default();
    in_turns(rounds, matches.len() + 1, |who| match matches.get_mut(who) {
        Some(slice) => slice.run(&granted, cycles),
        None if with_sockperf => match sockperf(&granted, seconds) {
            Ok(slice) => from_sockperf.push(slice),
            Err(why) => println!("a slice without sockperf: {why}"),
        },
        None => {}
    });

    let steal_ms = steal.ms();
    let mut report = Report::default();
    for protocol in ["linudp-v2", modbus::PROTOCOL, ethercat::PROTOCOL, profibus::PROTOCOL] {
        println!(
            "\n{protocol}, 1 drive, an exchange a millisecond, {rounds} rounds, steal {} ms",
            shown(steal_ms)
        );
        println!("  round trip, ns  {:>26} {:>26} {:>18}", "ours", "rival", "ours / rival");
        let mut object = json!({ "steal_ms": steal_ms });
        for one in matches.iter().filter(|one| one.protocol == protocol) {
            one.print();
            one.judge(&mut report);
            one.enter(&mut object);
        }
        if protocol == modbus::PROTOCOL && libmodbus.is_none() {
            for (wait, _) in MODES {
                enter_ratio(part(&mut object, wait), "libmodbus", None);
            }
        }
        if protocol == "linudp-v2" {
            println!("  sockperf p50 {:>29}", shown(from_sockperf.quantile(0.5)));
            for one in matches.iter().filter(|one| one.protocol == protocol) {
                let ratio = one.ours.ratio(&from_sockperf, 0.5);
                println!("  {} ours / sockperf p50: {}", one.mode, shown(ratio));
                enter_ratio(part(&mut object, one.wait), "sockperf", ratio);
            }
        }
        report.enter(protocol, object);
    }
    report.finish(&args)
}

/// The wait modes and their names.
const MODES: [(Wait, &str); 2] = [(Wait::Poll, "poll"), (Wait::Spin, "spin")];

/// Where the numbers of a wait mode stand among those of its protocol: the default one speaks for it.
fn part(object: &mut Value, wait: Wait) -> &mut Value {
    if wait == Wait::Poll { object } else { &mut object["spin"] }
}

fn enter_ratio(object: &mut Value, who: &str, ratio: Option<Interval>) {
    object[format!("{who}_p50_ratio")] = json!(ratio.map(|ratio| ratio.value));
    object[format!("{who}_p50_ratio_interval")] = json!(ratio.map(|ratio| ratio.ends()));
}

impl<'a> Match<'a> {
    fn new(protocol: &'static str, fleet: Fleet, wait: Wait, rival: Rival<'a>) -> Match<'a> {
        Match {
            protocol,
            mode: MODES.iter().find(|(mode, _)| *mode == wait).map_or("", |(_, name)| name),
            fleet,
            wait,
            rival,
            ours: Sample::new(),
            theirs: Sample::new(),
            planned: 0,
            executed: 0,
            skipped: 0,
            sent: 0,
            answered: 0,
            missed: 0,
        }
    }

    /// A slice of both in turns.
    fn run(&mut self, granted: &Granted, cycles: usize) {
        let duel = Duel {
            granted,
            fleet: self.fleet,
            wait: self.wait,
            period_ns: 2 * TURN_NS,
            cycles,
            carriers: &Os::default(),
            calls: &Calls::default(),
            rival: self.rival,
        };
        let outcome = match duel.fight() {
            Ok(outcome) => outcome,
            Err(why) => {
                println!("a slice without {}: {why}", self.against());
                return;
            }
        };
        self.ours.push(outcome.ours.round_trips);
        self.theirs.push(outcome.theirs.round_trips);
        let status = outcome.end.status;
        self.planned += status.planned;
        self.executed += status.executed;
        self.skipped += status.skipped;
        for drive in outcome.end.drives {
            self.sent += drive.counters.sent;
            self.answered += drive.counters.answered;
            self.missed += drive.counters.missed;
        }
    }

    /// Who it is held against.
    fn against(&self) -> &'static str {
        match self.rival {
            Rival::Bare => "bare",
            Rival::Libmodbus(_) => "libmodbus",
        }
    }

    fn print(&self) {
        let (mode, rival) = (self.mode, self.against());
        for (quantile, q) in [("p50", 0.5), ("p90", 0.9), ("p99", 0.99)] {
            let (ours, theirs) = (shown(self.ours.quantile(q)), shown(self.theirs.quantile(q)));
            let ratio = shown(self.ours.ratio(&self.theirs, q));
            println!("  {mode} {quantile:10} {ours:>26} {theirs:>26} {ratio:>18}  {rival}");
        }
        let Match { planned, executed, skipped, sent, answered, missed, .. } = self;
        println!("  {mode} ours: planned {planned} = executed {executed} + skipped {skipped}");
        println!("  {mode} ours: sent {sent} = answered {answered} + missed {missed}");
    }

    /// Checks its counts.
    fn judge(&self, report: &mut Report) {
        let Match { protocol, mode, planned, executed, skipped, sent, answered, missed, .. } = *self;
        let rival = self.against();
        let what = format!("{protocol} {mode}, in turns with {rival}");
        report.check(format!("{what}: planned = executed + skipped"), planned == executed + skipped);
        report.check(format!("{what}: sent = answered + missed"), sent == answered + missed);
    }

    fn enter(&self, object: &mut Value) {
        let part = part(object, self.wait);
        let rival = self.against();
        if let Rival::Bare = self.rival {
            part["p50_ns"] = json!(self.ours.quantile(0.5).map(|p50| p50.value));
            part["p99_ns"] = json!(self.ours.quantile(0.99).map(|p99| p99.value));
        }
        enter_ratio(part, rival, self.ours.ratio(&self.theirs, 0.5));
    }
}

/// A slice of sockperf: its round trips, ns.
fn sockperf(granted: &Granted, seconds: u32) -> Result<Vec<u64>, String> {
    let address = fleet::address(Side::Ours, 0);
    let server = rig::serve(vec![Box::new(SockperfServer(address)) as Box<dyn SimDrive>], granted);
    let log = std::env::temp_dir().join(format!("fieldbeat-round-trip-{}.csv", std::process::id()));
    let mut command = Command::new("sockperf");
    command.args(["under-load", "-i", &address.ip().to_string(), "-p", &address.port().to_string()]);
    command.args(["--mps", &(S / TURN_NS).to_string(), "--reply-every", "1", "--full-rtt"]);
    command.args(["-t", &seconds.to_string(), "--full-log"]).arg(&log);
    if let Some(core) = granted.core {
        // The thread that spins. The one that receives goes where the kernel wants it: it has to share a core either
        // with the spinning one or with the server.
        command.args(["--sender-affinity", &core.to_string()]);
    }
    let output = command.stdin(Stdio::null()).output().map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => {
            "sockperf is not installed: take it from your distribution (Debian: sockperf)".to_owned()
        }
        _ => format!("cannot run sockperf: {error}"),
    })?;
    drop(server);
    let text = std::fs::read_to_string(&log).unwrap_or_default();
    // Nothing depends on its removal.
    let _ = std::fs::remove_file(&log);
    let round_trips: Vec<u64> = text.lines().filter_map(round_trip).collect();
    if round_trips.len() < 100 {
        let said = String::from_utf8_lossy(&output.stdout);
        let last = said.lines().last().unwrap_or_default().trim();
        return Err(format!("sockperf gave {} round trips ({}): {last}", round_trips.len(), output.status));
    }
    Ok(round_trips)
}

/// Of a line `packet, txTime(sec), rxTime(sec), rtt(usec)`.
fn round_trip(line: &str) -> Option<u64> {
    let mut fields = line.split(',').map(str::trim);
    fields.next()?.parse::<u64>().ok()?;
    let microseconds: f64 = fields.nth(2)?.parse().ok()?;
    Some((microseconds * 1e3) as u64)
}

/// Answers sockperf in its own protocol, on the socket and thread of a simulated drive.
struct SockperfServer(SocketAddrV4);

impl SockperfServer {
    /// The low byte of the flags, behind the number of eight bytes (message.h of sockperf 3).
    const FLAGS: usize = 9;
    const CLIENT: u8 = 1;
    const ANSWER_WANTED: u8 = 2;
    const WARM_UP: u8 = 4;
}

impl SimDrive for SockperfServer {
    fn address(&self) -> SocketAddrV4 {
        self.0
    }

    fn faults(&self) -> FaultPlan {
        FaultPlan::default()
    }

    fn receive(
        &mut self,
        _now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let flags = *bytes.get(Self::FLAGS)?;
        if flags & (Self::CLIENT | Self::ANSWER_WANTED | Self::WARM_UP) != Self::CLIENT | Self::ANSWER_WANTED
        {
            return None;
        }
        reply.extend_from_slice(bytes);
        reply[Self::FLAGS] = flags & !Self::CLIENT;
        Some(from)
    }

    fn restart(&mut self, _now: Time) {}

    fn open_sto(&mut self, _until: Time) {}
}
