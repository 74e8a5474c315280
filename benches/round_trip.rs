//! Round trip of one drive, for each protocol and both ways of waiting: our loop against a bare loop and against
//! `sockperf under-load`.
//!
//! Ours and the bare loop run on the same thread in turns, cycle by cycle, each with a drive of its own that is in
//! operation, in the same wait mode: every millisecond one of the two has its exchange. Both stamp before the call that
//! sends and after the one that receives, and the same bytes go both ways.
//!
//! sockperf sends at the same rate to the same kind of server, on the same core: a drive that answers in its protocol. Yet
//! it is no cyclic loop: one of its threads spins between the messages and never lets the core fall asleep, another one
//! receives. So its round trip is held against ours in wait mode "spin".

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::net::SocketAddrV4;
use std::process::{Command, ExitCode, Stdio};

use fieldbeat::cycle::Wait;
use fieldbeat::net::Os;
use fieldbeat::rt::Granted;
use fieldbeat::sim::{DatagramDrive, FaultPlan};
use fieldbeat::time::{MS, S, Time};
use serde_json::json;
use support::rig::{self, Calls, Side};
use support::stats::Sample;
use support::{Args, Report, Steal, in_turns, shown};

const PERIOD_NS: u64 = MS;
/// Budgets.
const BARE_P50_RATIO: f64 = 1.05;
const SOCKPERF_P50_RATIO: f64 = 1.0;

/// Ours and the bare loop in one wait mode.
#[derive(Debug, Default)]
struct Pair {
    ours: Sample,
    bare: Sample,
    sent: u64,
    answered: u64,
    missed: u64,
}

fn main() -> ExitCode {
    let args = Args::parse("round_trip");
    let (rounds, cycles, seconds) = if args.quick { (10, 400, 1) } else { (30, 1_000, 1) };
    let granted = rig::introduce("round_trip: one drive against a bare loop and sockperf");
    let with_sockperf = match sockperf(&granted, 1) {
        Ok(_) => true,
        Err(why) => {
            println!("no ratio to sockperf: {why}");
            false
        }
    };
    let steal = Steal::begin();
    let (mut poll, mut spin, mut rival) = (Pair::default(), Pair::default(), Sample::default());
    in_turns(rounds, 3, |who| match who {
        0 => slice(&granted, Wait::Poll, cycles, &mut poll),
        1 => slice(&granted, Wait::Spin, cycles, &mut spin),
        _ if with_sockperf => match sockperf(&granted, seconds) {
            Ok(slice) => rival.push(slice),
            Err(why) => println!("a slice without sockperf: {why}"),
        },
        _ => {}
    });

    let steal_ms = steal.ms();
    let mut report = Report::default();
    println!("\nlinudp-v2, 1 drive, 1 kHz, {rounds} rounds, steal {} ms", shown(steal_ms));
    println!("  round trip, ns  {:>26} {:>26} {:>18}", "ours", "bare loop", "ours / bare");
    for (wait, pair) in [("poll", &poll), ("spin", &spin)] {
        for (quantile, q) in [("p50", 0.5), ("p90", 0.9), ("p99", 0.99)] {
            let (ours, bare) = (shown(pair.ours.quantile(q)), shown(pair.bare.quantile(q)));
            let ratio = shown(pair.ours.ratio(&pair.bare, q));
            println!("  {wait} {quantile:10} {ours:>26} {bare:>26} {ratio:>18}");
        }
        let Pair { sent, answered, missed, .. } = pair;
        println!("  {wait} ours: sent {sent} = answered {answered} + missed {missed}");
    }
    let ratios = [&poll, &spin].map(|pair| pair.ours.ratio(&rival, 0.5));
    println!("  sockperf p50    {:>26}", shown(rival.quantile(0.5)));
    println!("  ours / sockperf p50: poll {}, spin {}", shown(ratios[0]), shown(ratios[1]));

    let mut objects = [("poll", &poll), ("spin", &spin)].map(|(wait, pair)| {
        report.count(
            format!("linudp-v2 {wait}: sent = answered + missed"),
            pair.sent == pair.answered + pair.missed,
        );
        let ratio = pair.ours.ratio(&pair.bare, 0.5);
        report.time(format!("linudp-v2 {wait}: p50 / bare p50"), ratio, BARE_P50_RATIO, "");
        json!({
            "p50_ns": pair.ours.quantile(0.5).map(|p50| p50.value),
            "p99_ns": pair.ours.quantile(0.99).map(|p99| p99.value),
            "bare_p50_ratio": ratio.map(|ratio| ratio.value),
            "bare_p50_ratio_interval": ratio.map(|ratio| ratio.ends()),
        })
    });
    for (object, ratio) in objects.iter_mut().zip(ratios) {
        object["sockperf_p50_ratio"] = json!(ratio.map(|ratio| ratio.value));
        object["sockperf_p50_ratio_interval"] = json!(ratio.map(|ratio| ratio.ends()));
    }
    report.time("linudp-v2 spin: p50 / sockperf p50", ratios[1], SOCKPERF_P50_RATIO, "");
    // The default wait mode speaks for the protocol.
    let [mut protocol, spin] = objects;
    protocol["spin"] = spin;
    protocol["steal_ms"] = json!(steal_ms);
    report.enter("linudp-v2", protocol);
    report.finish(&args)
}

/// A slice of both loops.
fn slice(granted: &Granted, wait: Wait, cycles: usize, pair: &mut Pair) {
    let duel = rig::duel(granted, 1, wait, 2 * PERIOD_NS, cycles, &Os, &Calls::default());
    pair.ours.push(duel.ours.round_trips);
    pair.bare.push(duel.bare.round_trips);
    for drive in duel.end.drives {
        pair.sent += drive.counters.sent;
        pair.answered += drive.counters.answered;
        pair.missed += drive.counters.missed;
    }
}

/// A slice of sockperf: its round trips, ns.
fn sockperf(granted: &Granted, seconds: u32) -> Result<Vec<u64>, String> {
    let address = rig::address(Side::Ours, 0);
    let server = rig::serve(vec![Box::new(SockperfServer(address))], granted);
    let log = std::env::temp_dir().join(format!("fieldbeat-round-trip-{}.csv", std::process::id()));
    let mut command = Command::new("sockperf");
    command.args(["under-load", "-i", &address.ip().to_string(), "-p", &address.port().to_string()]);
    command.args(["--mps", &(S / PERIOD_NS).to_string(), "--reply-every", "1", "--full-rtt"]);
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

impl DatagramDrive for SockperfServer {
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
