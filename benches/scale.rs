//! What a drive costs, 1 to 256 of them.
//!
//! - **The loop without a socket**: the real engine, bus and stations over a null carrier that answers from memory. A cycle is
//!   everything from the end of one sleep to the begin of the next: send, receive, health, exchange, prepare, records and
//!   feedback. Cycles follow each other without sleeping, and once more paced at 1 kHz with the core asleep in between, where
//!   caches are cold. The carrier's own time is measured alone, in turns with the loop, and taken off.
//! - **The loop with acyclic calls**: the same, with a parameter read back to back on each of 32 drives, in turns with the loop
//!   without them; and how many reads a second that comes to, there and on sockets at 1 kHz.
//! - **The loop on sockets** against a bare `sendto` / `recvfrom` loop over the same bytes, cycle by cycle in turns: time
//!   from waking up until done, and processor time.
//! - **System calls a cycle**, counted at full speed where the loop makes them: in its clock and its carrier. That these
//!   counters see every call is proved by running the loop once more under `strace`, whose count must be the same.

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::process::{Command, ExitCode, Stdio};
use std::sync::Arc;
use std::time::Duration;

use fieldbeat::axis::acyclic::{Acyclic, CallTicket};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::upid;
use fieldbeat::bus::linudp::wire::{
    ControlWord, MainState, RESPONSE_MAX, Request, RequestDef, Response, ResponseDef, RtcBlock, RtcCommand,
    StateVar, StatusWord,
};
use fieldbeat::cycle::Wait;
use fieldbeat::net::{Carriers, Datagrams, Os, Outbox, Received, Sent, UdpOptions};
use fieldbeat::rt::{Granted, MonotonicClock, Regions};
use fieldbeat::time::{MS, Ns, US};
use serde_json::json;
use support::rig::{self, Calls, Pace, Rig, Side};
use support::stats::{Interval, Line, Sample, median, over_rounds};
use support::{Args, Report, Steal, in_turns, shown};

/// Budget of the loop without a socket, ns a drive: the slope of the straight line.
const LOOP_NS: f64 = 250.0;
/// How far a point may be from the line, as a share.
const STRAIGHT: f64 = 0.25;

/// Budget of system calls a cycle.
fn calls_allowed(drives: usize) -> f64 {
    8.0 + drives as f64 / 64.0
}

/// This variable of the environment makes the program the child that strace looks at, with so many drives.
const TRACED: &str = "FIELDBEAT_BENCH_TRACED_DRIVES";
/// Cycles that strace looks at.
const TRACED_CYCLES: u64 = 50;

fn main() -> ExitCode {
    if let Some(drives) = std::env::var(TRACED).ok().and_then(|drives| drives.parse().ok()) {
        traced(drives);
        return ExitCode::SUCCESS;
    }
    let args = Args::parse("scale");
    let granted = rig::introduce("scale: what a drive costs");
    let mut report = Report::default();
    let drives: &[usize] = if args.quick { &[1, 8, 64, 256] } else { &[1, 2, 4, 8, 16, 32, 64, 128, 256] };
    let without = without_socket(args.quick, drives, &mut report);
    let reads = with_reads(&granted, args.quick, &mut report);
    let on_sockets = on_sockets(&granted, args.quick, drives, &mut report);
    strace(&granted, args.quick, &mut report);
    for ((drives, without), on) in drives.iter().zip(without).zip(on_sockets) {
        report.append(json!({
            "drives": drives,
            "loop_ns": without.back_to_back.value,
            "loop_ns_interval": without.back_to_back.ends(),
            "loop_paced_ns": without.paced.value,
            "loop_paced_ns_interval": without.paced.ends(),
            "carrier_ns": without.carrier,
            "sockets_ns": on.ours,
            "bare_ns": on.bare,
            "sockets_ratio": on.ratio.map(|ratio| ratio.value),
            "sockets_ratio_interval": on.ratio.map(|ratio| ratio.ends()),
            "sockets_cpu_ns": on.ours_cpu,
            "bare_cpu_ns": on.bare_cpu,
            "sockets_cpu_ratio": on.cpu_ratio.map(|ratio| ratio.value),
            "syscalls_per_cycle": on.calls,
            "steal_ms": on.steal_ms,
        }));
    }
    report.append(reads);
    report.finish(&args)
}

/// Of the loop without a socket, ns a drive and cycle.
struct Without {
    back_to_back: Interval,
    paced: Interval,
    carrier: f64,
}

fn without_socket(quick: bool, drives: &[usize], report: &mut Report) -> Vec<Without> {
    let rounds = if quick { 7 } else { 21 };
    let steal = Steal::begin();
    // Medians of a cycle, ns: by number of drives, then by round.
    let mut medians: Vec<[Vec<f64>; 3]> = drives.iter().map(|_| Default::default()).collect();
    in_turns(rounds, 3 * drives.len(), |who| {
        let (place, what) = (who / 3, who % 3);
        let count = drives[place];
        // About a millisecond or two of work; at 1 kHz a tenth of a second.
        let cycles = (10_000 / count).clamp(200, 2_000);
        let slice = rig::on_loop_thread(|_| match what {
            0 => turns(count, Pace::BackToBack, cycles),
            1 => turns(count, Pace::Grid, 100),
            _ => carrier_alone(count, cycles),
        });
        let slice = slice.unwrap_or_else(|error| rig::give_up(error));
        medians[place][what].push(median(&slice));
    });

    println!(
        "\nthe loop without a socket, ns a drive and cycle; {rounds} rounds, steal {} ms",
        shown(steal.ms())
    );
    println!("  drives           back to back            paced 1 kHz   the null carrier, taken off both");
    let mut table = Vec::new();
    for (count, [loops, paced, carrier]) in drives.iter().zip(&medians) {
        let each = *count as f64;
        let without_carrier = |all: &[f64]| {
            over_rounds(rounds, |rounds| {
                let chosen =
                    |all: &[f64]| median(&rounds.iter().map(|round| all[*round]).collect::<Vec<_>>());
                (chosen(all) - chosen(carrier)) / each
            })
        };
        let row = Without {
            back_to_back: without_carrier(loops),
            paced: without_carrier(paced),
            carrier: median(carrier) / each,
        };
        println!(
            "  {count:6} {:>22} {:>22} {:12.1}",
            row.back_to_back.to_string(),
            row.paced.to_string(),
            row.carrier
        );
        table.push(row);
    }

    for (what, name) in [(0, "back to back"), (1, "paced")] {
        let line = |rounds: &[usize]| {
            let points: Vec<_> = (drives.iter().zip(&medians))
                .map(|(count, by_what)| {
                    let chosen =
                        |what: usize| median(&rounds.iter().map(|r| by_what[what][*r]).collect::<Vec<_>>());
                    (*count as f64, chosen(what) - chosen(2))
                })
                .collect();
            (Line::through(&points), points)
        };
        let slope = over_rounds(rounds, |rounds| line(rounds).0.slope);
        let (fit, _) = line(&(0..rounds).collect::<Vec<_>>());
        // Round by round: a computer that is slower for a while is slower for all points of a round.
        let bend_of = |round: usize| {
            let (fit, points) = line(&[round]);
            points.iter().map(|(x, y)| (y / fit.at(*x) - 1.0).abs()).fold(0.0, f64::max)
        };
        let bend = over_rounds(rounds, |rounds| {
            median(&rounds.iter().map(|round| bend_of(*round)).collect::<Vec<_>>())
        });
        println!(
            "  {name}: {slope} ns a drive + {:.0} ns a cycle; farthest point {:.0} % off the line",
            fit.intercept,
            bend.value * 100.0
        );
        if what == 0 {
            report.time("the loop without a socket, a drive", Some(slope), LOOP_NS, "ns");
            report.time("its farthest point off the straight line", Some(bend), STRAIGHT, "");
        }
    }
    table
}

/// So many drives read a parameter back to back.
const READING: usize = 32;
/// Reads that are under way on each of them.
const UNDER_WAY: usize = 4;

/// Keeps every drive at reading, from outside of the loop and of what is measured.
struct Readers {
    under_way: Vec<VecDeque<CallTicket>>,
    done: u64,
}

impl Readers {
    fn new(drives: usize) -> Readers {
        Readers { under_way: (0..drives).map(|_| VecDeque::new()).collect(), done: 0 }
    }

    fn feed(&mut self, acyclics: &[Acyclic]) {
        let call = upid::call(RtcCommand::READ_RAM, 0x1E0F, 0);
        for (acyclic, under_way) in acyclics.iter().zip(&mut self.under_way) {
            while let Some(end) = under_way.front_mut().and_then(CallTicket::poll) {
                self.done += u64::from(end.is_ok());
                under_way.pop_front();
            }
            while under_way.len() < UNDER_WAY {
                match acyclic.post(call, Duration::from_secs(1)) {
                    Ok(ticket) => under_way.push_back(ticket),
                    Err(error) => rig::give_up(error),
                }
            }
        }
    }
}

/// What a parameter read back to back on each drive costs the loop, and how many come of it.
fn with_reads(granted: &Granted, quick: bool, report: &mut Report) -> serde_json::Value {
    let (rounds, cycles) = if quick { (7, 400) } else { (21, 1_000) };
    let steal = Steal::begin();
    let mut medians: [Vec<f64>; 3] = Default::default();
    let mut reads = 0;
    in_turns(rounds, 3, |what| {
        let slice = rig::on_loop_thread(|_| match what {
            0 => (turns(READING, Pace::BackToBack, cycles), 0),
            1 => reading_turns(READING, cycles),
            _ => (carrier_alone(READING, cycles), 0),
        });
        let (slice, done) = slice.unwrap_or_else(|error| rig::give_up(error));
        reads += done;
        medians[what].push(median(&slice));
    });
    let [idle, reading, carrier] = &medians;
    let of =
        |rounds: &[usize], all: &[f64]| median(&rounds.iter().map(|round| all[*round]).collect::<Vec<_>>());
    let each =
        |all: &[f64]| over_rounds(rounds, |rounds| (of(rounds, all) - of(rounds, carrier)) / READING as f64);
    let (idle, reading) = (each(idle), each(reading));
    let a_cycle = reads as f64 / (rounds * cycles * READING) as f64;
    let on_sockets = reads_on_sockets(granted, if quick { 300 } else { 3_000 });
    println!(
        "\n{READING} drives, each reading a parameter back to back, ns a drive and cycle without a socket; steal {} ms",
        shown(steal.ms())
    );
    println!("  without reads {idle}, with them {reading}; {a_cycle:.3} reads a cycle and drive");
    println!("  on sockets at 1 kHz: {} reads a second and drive", shown(on_sockets.map(f64::round)));
    report.time("the loop with a parameter read on each drive, a drive", Some(reading), LOOP_NS, "ns");
    report.count(format!("a read a cycle and drive: {a_cycle:.3} >= 0.95"), a_cycle >= 0.95);
    json!({
        "reading_drives": READING,
        "loop_ns": idle.value,
        "loop_reading_ns": reading.value,
        "loop_reading_ns_interval": reading.ends(),
        "reads_a_cycle": a_cycle,
        "reads_a_second_on_sockets": on_sockets,
        "steal_ms": steal.ms(),
    })
}

/// Busy time of each cycle, ns, with reads; and how many were done.
fn reading_turns(drives: usize, cycles: usize) -> (Vec<f64>, u64) {
    let cycle = rig::exchange_cycle(MS, Wait::Spin);
    let bus = rig::bus(Side::Ours, drives);
    let mut rig = Rig::new(cycle, Some(bus), Pace::BackToBack, &NullNet, Calls::default());
    rig.enable();
    let mut readers = Readers::new(drives);
    // The channel is learned first.
    for _ in 0..8 {
        readers.feed(rig.acyclics());
        rig.turn(|_| {});
    }
    readers.done = 0;
    let mut one = |_| {
        readers.feed(rig.acyclics());
        rig.turn(|_| {}).busy_ns as f64
    };
    let slice = (0..cycles).map(&mut one).collect();
    (slice, readers.done)
}

/// Reads a second and drive, on sockets at 1 kHz, with the simulated drives on the other core.
fn reads_on_sockets(granted: &Granted, cycles: usize) -> Option<f64> {
    let _server = rig::serve(rig::bus(Side::Ours, READING).simulate(), granted);
    let done = rig::on_loop_thread(|_| {
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let bus = rig::bus(Side::Ours, READING);
        let mut rig = Rig::new(cycle, Some(bus), Pace::Grid, &Os, Calls::default());
        rig.enable();
        let mut readers = Readers::new(READING);
        for _ in 0..cycles {
            readers.feed(rig.acyclics());
            rig.turn(|_| {});
        }
        readers.done
    });
    let done = done.ok()?;
    Some(done as f64 / READING as f64 / (cycles as f64 / 1_000.0))
}

/// Busy time of each cycle, ns.
fn turns(drives: usize, pace: Pace, cycles: usize) -> Vec<f64> {
    let cycle = rig::exchange_cycle(MS, Wait::Spin);
    let bus = rig::bus(Side::Ours, drives);
    let mut rig = Rig::new(cycle, Some(bus), pace, &NullNet, Calls::default());
    rig.enable();
    (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
}

/// What the null carrier takes for a cycle by itself, ns.
fn carrier_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let mut carrier = NullCarrier::new(drives);
    let peers: Vec<_> = (0..drives).map(|index| rig::address(Side::Ours, index)).collect();
    let request =
        Request { response_def: ResponseDef::CYCLIC, control: Some(ControlWord::ON), ..Request::default() };
    let mut outbox = Outbox::new(&peers, request.size());
    for index in 0..drives {
        let length = request.emit(outbox.room(index));
        outbox.set_length(index, length);
    }
    let mut cycle = || {
        (0..drives).for_each(|index| outbox.post(index, true));
        let begin = MonotonicClock::read();
        carrier.send(&mut outbox);
        while let Ok(count) = carrier.receive(&mut |datagram| {
            std::hint::black_box(datagram);
        }) && count == carrier.batch()
        {}
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

/// Carriers of a network in memory where every drive answers at once.
struct NullNet;

impl Carriers for NullNet {
    fn datagrams(&self, _: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Ok(Box::new(NullCarrier::new(options.peers)))
    }
}

/// Answers each request from memory: ready to switch on, and in operation once it is switched on; always moving.
struct NullCarrier {
    /// Sender, definitions, whether it is switched on, and a read of a parameter: requests not yet answered.
    asked: Vec<(SocketAddrV4, [u8; 8], bool, Option<RtcBlock>)>,
    next: usize,
    batch: usize,
    ready: [u8; RESPONSE_MAX],
    operating: [u8; RESPONSE_MAX],
    length: usize,
    position: i32,
}

impl NullCarrier {
    /// Where the actual position is in a cyclic reply: behind definitions, status and state.
    const POSITION: std::ops::Range<usize> = 12..16;

    fn new(peers: usize) -> NullCarrier {
        let reply = |status: u16, state: StateVar, bytes: &mut [u8]| {
            let response = Response {
                request_def: RequestDef::NONE,
                response_def: ResponseDef::CYCLIC,
                status: Some(StatusWord(status)),
                state: Some(state),
                current: Some(250),
                ..Response::default()
            };
            response.emit(bytes)
        };
        let (mut ready, mut operating) = ([0; RESPONSE_MAX], [0; RESPONSE_MAX]);
        let homed = StatusWord::HOMED | StatusWord::VOLTAGE_ENABLE | StatusWord::NO_QUICK_STOP;
        reply(homed, StateVar::new(MainState::READY_TO_SWITCH_ON, 0), &mut ready);
        let on = homed | StatusWord::OPERATION_ENABLED | StatusWord::SWITCH_ON_ACTIVE;
        let moving = StateVar::new(MainState::OPERATION_ENABLED, StateVar::MOTION_ACTIVE | StateVar::HOMED);
        let length = reply(on | StatusWord::MOTION_ACTIVE, moving, &mut operating);
        // As real ones have it, so that as many calls of `receive` are made.
        let batch = (peers * 2).clamp(8, 128);
        let asked = Vec::with_capacity(peers);
        NullCarrier { asked, next: 0, batch, ready, operating, length, position: 0 }
    }
}

impl Datagrams for NullCarrier {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let at = MonotonicClock::read();
        self.asked.clear();
        self.next = 0;
        for index in 0..outbox.len() {
            if outbox.sent(index) == Sent::Posted {
                outbox.note(index, Sent::At(at));
                let bytes = outbox.bytes(index);
                if let Some((definitions, blocks)) = bytes.split_first_chunk() {
                    let on = blocks.first().is_some_and(|low| u16::from(*low) & ControlWord::SWITCH_ON != 0);
                    let read = match definitions[0] & RequestDef::CONFIG.0 as u8 {
                        0 => None,
                        _ => Request::parse(bytes).ok().and_then(|request| request.config),
                    };
                    self.asked.push((outbox.peer(index), *definitions, on, read));
                }
            }
        }
        self.position = self.position.wrapping_add(100);
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let at = MonotonicClock::read();
        let end = self.asked.len().min(self.next + self.batch);
        let count = end - self.next;
        for (from, definitions, on, read) in &self.asked[self.next..end] {
            let reply = if *on { &mut self.operating } else { &mut self.ready };
            reply[..8].copy_from_slice(definitions);
            reply[Self::POSITION].copy_from_slice(&self.position.to_le_bytes());
            let mut length = self.length;
            if let Some(read) = read {
                // Done: its count, status 0, the index, and a value.
                reply[length..length + 4].copy_from_slice(&[
                    read.tag,
                    0,
                    read.words[0] as u8,
                    (read.words[0] >> 8) as u8,
                ]);
                length += RtcBlock::SIZE;
            }
            take(Received { from: *from, at, bytes: &reply[..length], truncated: false });
        }
        self.next = end;
        Ok(count)
    }

    fn batch(&self) -> usize {
        self.batch
    }

    fn memory(&self, _: &mut Regions) {}
}

/// Of the loop on sockets; times are ns a drive and cycle.
struct OnSockets {
    ours: Option<f64>,
    bare: Option<f64>,
    ratio: Option<Interval>,
    ours_cpu: Option<f64>,
    bare_cpu: Option<f64>,
    cpu_ratio: Option<Interval>,
    calls: Option<f64>,
    steal_ms: Option<u64>,
}

fn on_sockets(granted: &Granted, quick: bool, drives: &[usize], report: &mut Report) -> Vec<OnSockets> {
    let (rounds, cycles) = if quick { (5, 40) } else { (15, 100) };
    println!("\nthe loop on sockets against the bare loop, ns a drive and cycle, medians of {rounds} rounds");
    println!(
        "  drives   period   ours done  last bare reply   ratio                 ours CPU   bare CPU   ratio                 calls a cycle"
    );
    let mut table = Vec::new();
    for &count in drives {
        let steal = Steal::begin();
        let [mut ours, mut bare, mut ours_cpu, mut bare_cpu, mut calls] = [const { Sample::new() }; 5];
        for _ in 0..rounds {
            let counted = Calls::default();
            let carriers = CountedNet(Arc::clone(&counted));
            let duel = rig::duel(granted, count, Wait::Poll, period(count), cycles, &carriers, &counted);
            ours.push(duel.ours.busy);
            bare.push(duel.bare.busy);
            ours_cpu.push(duel.ours.cpu);
            bare_cpu.push(duel.bare.cpu);
            calls.push(duel.ours.calls);
        }
        let each = |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value / count as f64);
        let row = OnSockets {
            ours: each(&ours),
            bare: each(&bare),
            ratio: ours.ratio(&bare, 0.5),
            ours_cpu: each(&ours_cpu),
            bare_cpu: each(&bare_cpu),
            cpu_ratio: ours_cpu.ratio(&bare_cpu, 0.5),
            calls: calls.quantile(0.5).map(|p50| p50.value),
            steal_ms: steal.ms(),
        };
        let whole = |value: Option<f64>| shown(value.map(|value| value.round()));
        println!(
            "  {count:6} {:>8} {:>11} {:>16}   {:20} {:>9} {:>10}   {:20} {:>8} (allowed {:.2}); steal {} ms",
            Ns(period(count)).to_string(),
            whole(row.ours),
            whole(row.bare),
            shown(row.ratio),
            whole(row.ours_cpu),
            whole(row.bare_cpu),
            shown(row.cpu_ratio),
            shown(row.calls),
            calls_allowed(count),
            shown(row.steal_ms)
        );
        report.count(
            format!(
                "{count} drives: p50 of system calls a cycle <= {:.2}: {}",
                calls_allowed(count),
                shown(row.calls)
            ),
            row.calls.is_some_and(|calls| calls <= calls_allowed(count)),
        );
        table.push(row);
    }
    table
}

/// Each side has half of it, so both fit in twice: a drive takes some 15 us of the two cores together.
fn period(drives: usize) -> u64 {
    (drives as u64 * 80 * US).next_multiple_of(MS).max(2 * MS)
}

/// The operating system's carriers, with an eye on their system calls.
struct CountedNet(Calls);

struct Counted {
    net: Box<dyn Datagrams>,
    calls: Calls,
}

impl Carriers for CountedNet {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Ok(Box::new(Counted { net: Os.datagrams(bind, options)?, calls: Arc::clone(&self.0) }))
    }
}

impl Datagrams for Counted {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        // One call for each 64 messages. One that is refused would cost one more; on loopback none is.
        let posted = (0..outbox.len()).filter(|index| outbox.sent(*index) == Sent::Posted).count();
        rig::add(&self.calls, posted.div_ceil(64) as u64);
        self.net.send(outbox);
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        rig::add(&self.calls, 1);
        self.net.receive(take)
    }

    fn batch(&self) -> usize {
        self.net.batch()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
    }
}

/// Runs the loop in a child under strace and compares the counts of system calls.
fn strace(granted: &Granted, quick: bool, report: &mut Report) {
    println!("\nthe count of system calls, proved by strace over {TRACED_CYCLES} cycles");
    let drives: &[usize] = if quick { &[8] } else { &[1, 8, 64, 256] };
    for &count in drives {
        match strace_of(granted, count) {
            Ok((counted, seen)) => {
                println!("  {count} drives: counted {counted}, strace saw {seen}");
                report.count(
                    format!("{count} drives: strace sees as many calls as were counted"),
                    counted == seen,
                );
            }
            Err(why) => println!("  {count} drives: not proved: {why}"),
        }
    }
}

fn strace_of(granted: &Granted, drives: usize) -> Result<(u64, u64), String> {
    // The drives live in this process: only the loop is traced.
    let _server = rig::serve(rig::bus(Side::Ours, drives).simulate(), granted);
    let directory = std::env::temp_dir().join(format!("fieldbeat-scale-{}", std::process::id()));
    std::fs::create_dir_all(&directory).map_err(|error| error.to_string())?;
    let result = strace_into(&directory, drives);
    // Nothing depends on its removal.
    let _ = std::fs::remove_dir_all(&directory);
    result
}

fn strace_into(directory: &std::path::Path, drives: usize) -> Result<(u64, u64), String> {
    let own = std::env::current_exe().map_err(|error| error.to_string())?;
    let output = Command::new("strace")
        .args(["-ff", "-e", "signal=none", "-o"])
        .arg(directory.join("calls"))
        .arg(own)
        .env(TRACED, drives.to_string())
        .stdin(Stdio::null())
        .output()
        .map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => "strace is not installed (Debian: strace)".to_owned(),
            _ => format!("cannot run strace: {error}"),
        })?;
    let said = String::from_utf8_lossy(&output.stdout);
    let counted: u64 = said.trim().parse().map_err(|_| {
        format!("the child said {said:?}: {}", String::from_utf8_lossy(&output.stderr).trim())
    })?;
    // One file a thread. The loop marks the begin and the end of what counts by asking for its parent.
    for entry in std::fs::read_dir(directory).map_err(|error| error.to_string())? {
        let path = entry.map_err(|error| error.to_string())?.path();
        let text = std::fs::read_to_string(path).map_err(|error| error.to_string())?;
        let marks: Vec<_> =
            (text.lines().enumerate()).filter(|(_, line)| line.starts_with("getppid()")).collect();
        if let [(begin, _), (end, _)] = marks[..] {
            return Ok((counted, (end - begin - 1) as u64));
        }
    }
    Err("no thread with both marks".to_owned())
}

/// The child: counts what it calls between the marks.
fn traced(drives: usize) {
    let counted = Calls::default();
    let carriers = CountedNet(Arc::clone(&counted));
    let calls = rig::on_loop_thread(|_| {
        // Under strace a call takes some 50 us.
        let cycle = rig::exchange_cycle(20 * MS, Wait::Poll);
        let mut rig =
            Rig::new(cycle, Some(rig::bus(Side::Ours, drives)), Pace::Grid, &carriers, Arc::clone(&counted));
        rig.enable();
        let _ = std::os::unix::process::parent_id();
        let calls: u64 = (0..TRACED_CYCLES).map(|_| rig.turn(|_| {}).calls).sum();
        let _ = std::os::unix::process::parent_id();
        calls
    });
    println!("{}", calls.unwrap_or_else(|error| rig::give_up(error)));
}
