//! Round trip of one drive, for each protocol and both ways of waiting: our loop against a bare loop, and against what else speaks
//! that protocol or carries as much: `sockperf under-load` for datagrams, a blocking client over libmodbus for Modbus TCP.
//!
//! Ours and the bare loop run on the same thread in turns, cycle by cycle, each with a drive of its own that is in
//! operation, in the same wait mode: every millisecond one of them has its exchange. Both stamp before the call that
//! sends and after the one that receives, and the same bytes go both ways.
//!
//! A Unidrive's exchange is one request with function 23: everything cyclic is in menu 0. The client over libmodbus takes its turn
//! with the two: on the same grid, by `clock_nanosleep`, on the same core and at the same priority, in a process of its own.
//!
//! sockperf sends at the same rate to the same kind of server, on the same core: a drive that answers in its protocol. Yet
//! it is no cyclic loop: one of its threads spins between the messages and never lets the core fall asleep, another one
//! receives. So its round trip is held against ours in wait mode "spin".

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::net::SocketAddrV4;
use std::process::{Command, ExitCode, Stdio};

use fieldbeat::bus::modbus;
use fieldbeat::cycle::Wait;
use fieldbeat::net::Os;
use fieldbeat::rt::Granted;
use fieldbeat::sim::{FaultPlan, SimDrive};
use fieldbeat::time::{MS, S, Time};
use serde_json::{Value, json};
use support::bare::Duel;
use support::fleet::{self, Fleet, Side};
use support::libmodbus::Libmodbus;
use support::rig::{self, Calls};
use support::stats::{Interval, Sample};
use support::{Args, Report, Steal, in_turns, shown};

/// Every so often one of the contenders has its exchange.
const TURN_NS: u64 = MS;
/// Budgets.
const BARE_P50_RATIO: f64 = 1.05;
const SOCKPERF_P50_RATIO: f64 = 1.0;
const LIBMODBUS_P50_RATIO: f64 = 1.0;

/// One protocol in one wait mode.
#[derive(Debug)]
struct Match<'a> {
    protocol: &'static str,
    mode: &'static str,
    fleet: Fleet,
    wait: Wait,
    with: Option<&'a Libmodbus>,
    ours: Sample,
    bare: Sample,
    libmodbus: Sample,
    planned: u64,
    executed: u64,
    skipped: u64,
    sent: u64,
    answered: u64,
    missed: u64,
}

fn main() -> ExitCode {
    let args = Args::parse("round_trip");
    let (rounds, cycles, seconds) = if args.quick { (10, 400, 1) } else { (30, 1_000, 1) };
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
    let mut matches = [
        Match::new("linudp-v2", Fleet::linmots(1), Wait::Poll, None),
        Match::new("linudp-v2", Fleet::linmots(1), Wait::Spin, None),
        Match::new(modbus::PROTOCOL, Fleet::unidrives(1), Wait::Poll, libmodbus.as_ref()),
        Match::new(modbus::PROTOCOL, Fleet::unidrives(1), Wait::Spin, libmodbus.as_ref()),
    ];
    let mut rival = Sample::default();
    in_turns(rounds, matches.len() + 1, |who| match matches.get_mut(who) {
        Some(slice) => slice.run(&granted, cycles),
        None if with_sockperf => match sockperf(&granted, seconds) {
            Ok(slice) => rival.push(slice),
            Err(why) => println!("a slice without sockperf: {why}"),
        },
        None => {}
    });

    let steal_ms = steal.ms();
    let mut report = Report::default();
    for protocol in matches.chunks(2) {
        let [poll, spin] = protocol else { continue };
        let name = poll.protocol;
        println!(
            "\n{name}, 1 drive, an exchange a millisecond, {rounds} rounds, steal {} ms",
            shown(steal_ms)
        );
        println!("  round trip, ns  {:>26} {:>26} {:>18}", "ours", "bare loop", "ours / bare");
        protocol.iter().for_each(Match::print);
        let (mut object, spinning) = (poll.judge(&mut report), spin.judge(&mut report));
        // The default wait mode speaks for the protocol.
        object["spin"] = spinning;
        object["steal_ms"] = json!(steal_ms);
        match name {
            modbus::PROTOCOL => {
                against("libmodbus", protocol, |one| &one.libmodbus, &mut object);
                for one in protocol {
                    let what = format!("{name} {}: p50 / libmodbus p50", one.mode);
                    report.time(what, one.ours.ratio(&one.libmodbus, 0.5), LIBMODBUS_P50_RATIO, "");
                }
            }
            _ => {
                against("sockperf", protocol, |_| &rival, &mut object);
                let what = format!("{name} spin: p50 / sockperf p50");
                report.time(what, spin.ours.ratio(&rival, 0.5), SOCKPERF_P50_RATIO, "");
            }
        }
        report.enter(name, object);
    }
    report.finish(&args)
}

/// Prints and enters the ratios to another rival than the bare loop.
fn against<'a>(
    who: &str,
    protocol: &'a [Match<'_>],
    rival: impl Fn(&'a Match<'_>) -> &'a Sample,
    object: &mut Value,
) {
    for one in protocol {
        let (theirs, mode) = (rival(one), one.mode);
        let ratio: Option<Interval> = one.ours.ratio(theirs, 0.5);
        println!(
            "  {who} p50 {:>30}   ours / {who} p50: {mode} {}",
            shown(theirs.quantile(0.5)),
            shown(ratio)
        );
        let entry = if one.wait == Wait::Poll { &mut *object } else { &mut object["spin"] };
        entry[format!("{who}_p50_ratio")] = json!(ratio.map(|ratio| ratio.value));
        entry[format!("{who}_p50_ratio_interval")] = json!(ratio.map(|ratio| ratio.ends()));
    }
}

impl<'a> Match<'a> {
    fn new(protocol: &'static str, fleet: Fleet, wait: Wait, with: Option<&'a Libmodbus>) -> Match<'a> {
        Match {
            protocol,
            mode: if wait == Wait::Poll { "poll" } else { "spin" },
            fleet,
            wait,
            with,
            ours: Sample::new(),
            bare: Sample::new(),
            libmodbus: Sample::new(),
            planned: 0,
            executed: 0,
            skipped: 0,
            sent: 0,
            answered: 0,
            missed: 0,
        }
    }

    /// A slice of all that take turns.
    fn run(&mut self, granted: &Granted, cycles: usize) {
        let contenders = if self.with.is_some() { 3 } else { 2 };
        // As long as with two.
        let cycles = cycles * 2 / contenders as usize;
        let duel = Duel {
            granted,
            fleet: self.fleet,
            wait: self.wait,
            period_ns: contenders * TURN_NS,
            cycles,
            carriers: &Os::default(),
            calls: &Calls::default(),
            libmodbus: self.with,
        };
        let outcome = duel.fight();
        self.ours.push(outcome.ours.round_trips);
        self.bare.push(outcome.bare.round_trips);
        self.libmodbus.push(outcome.libmodbus);
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

    fn print(&self) {
        let mode = self.mode;
        for (quantile, q) in [("p50", 0.5), ("p90", 0.9), ("p99", 0.99)] {
            let (ours, bare) = (shown(self.ours.quantile(q)), shown(self.bare.quantile(q)));
            let ratio = shown(self.ours.ratio(&self.bare, q));
            println!("  {mode} {quantile:10} {ours:>26} {bare:>26} {ratio:>18}");
        }
        let Match { planned, executed, skipped, sent, answered, missed, .. } = self;
        println!("  {mode} ours: planned {planned} = executed {executed} + skipped {skipped}");
        println!("  {mode} ours: sent {sent} = answered {answered} + missed {missed}");
    }

    /// Holds it against its budgets.
    fn judge(&self, report: &mut Report) -> Value {
        let Match { protocol, mode, planned, executed, skipped, sent, answered, missed, .. } = *self;
        report
            .count(format!("{protocol} {mode}: planned = executed + skipped"), planned == executed + skipped);
        report.count(format!("{protocol} {mode}: sent = answered + missed"), sent == answered + missed);
        if protocol == modbus::PROTOCOL {
            report.count(format!("{protocol} {mode}: none was lost"), missed == 0);
        }
        let ratio = self.ours.ratio(&self.bare, 0.5);
        report.time(format!("{protocol} {mode}: p50 / bare p50"), ratio, BARE_P50_RATIO, "");
        json!({
            "p50_ns": self.ours.quantile(0.5).map(|p50| p50.value),
            "p99_ns": self.ours.quantile(0.99).map(|p99| p99.value),
            "bare_p50_ratio": ratio.map(|ratio| ratio.value),
            "bare_p50_ratio_interval": ratio.map(|ratio| ratio.ends()),
        })
    }
}

/// A slice of sockperf: its round trips, ns.
fn sockperf(granted: &Granted, seconds: u32) -> Result<Vec<u64>, String> {
    let address = fleet::address(Side::Ours, 0);
    let server = rig::serve(vec![Box::new(SockperfServer(address))], granted);
    let log = std::env::temp_dir().join(format!("fieldbeat-round-trip-{}.csv", std::process::id()));
    let mut command = Command::new("sockperf");
    command.args(["under-load", "-i", &address.ip().to_string(), "-p", &address.port().to_string()]);
    command.args(["--mps", &(S / TURN_NS).to_string(), "--reply-every", "1", "--full-rtt"]);
    command.args(["-t", &seconds.to_string(), "--full-log"]).arg(&log);
    if let Some(core) = granted.core {
        // The thread that spins. The one that receives goes where the kernel wants it: it has to share a core either with
        // the spinning one or with the server.
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

    fn inhibit(&mut self, _until: Time) {}
}
