//! Wake-up latency of the loop, without a guard and with the automatic one, against `cyclictest` (rt-tests): same core,
//! policy, priority and period, in turns.
//!
//! Ours is the real loop on a thread made by the real code, without a drive. Plain, it runs once more with a Lenze
//! drive on a PROFIBUS wire of this host: the only bus that sends in the middle of a cycle must not move the next
//! wake-up.
//!
//! Both read CLOCK_MONOTONIC right after an absolute `clock_nanosleep`; cyclictest tells every single latency in ns
//! (`-v -N`), so that nothing is rounded or cut off. A slot that was passed over counts as a late wake-up, as in the
//! loop's own telemetry. cyclictest passes over slots too but does not tell of them: they follow from the latency
//! before them, and are added here.

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::fs::File;
use std::process::{Command, ExitCode, Stdio};

use fieldbeat::time::{MS, Ns, S, US};
use fieldbeat::{CyclePlan, Guard};
use fieldbeat_core::cycle::record::{CycleRecord, Record, SkippedRecord};
use fieldbeat_core::net::Os;
use fieldbeat_core::rt::Granted;
use serde_json::json;
use support::fleet::{Fleet, Side};
use support::rig::{self, Calls, Pace, Rig};
use support::stats::{Interval, Sample};
use support::{Args, Report, Steal, in_turns, shown};

const PERIODS_NS: [u64; 3] = [4 * MS, MS, 250 * US];

/// Slots of the grid, as the loop counted them.
#[derive(Debug, Default)]
struct Slots {
    planned: u64,
    executed: u64,
    skipped: u64,
}

fn main() -> ExitCode {
    let args = Args::parse("jitter");
    let (rounds, slice_ns) = if args.quick { (8, 3 * S / 10) } else { (40, S / 2) };
    let granted = rig::introduce("jitter: wake-up latency against cyclictest");
    let rival = cyclictest(&granted, MS, 10);
    if let Err(why) = &rival {
        println!("no ratios: {why}");
    }
    let mut report = Report::default();
    for period_ns in PERIODS_NS {
        period(&granted, period_ns, rounds, slice_ns / period_ns, rival.is_ok(), &mut report);
    }
    report.finish(&args)
}

fn period(
    granted: &Granted,
    period_ns: u64,
    rounds: usize,
    slots_a_slice: u64,
    with_rival: bool,
    report: &mut Report,
) {
    let steal = Steal::begin();
    let [mut plain, mut guarded, mut with_wire, mut rival] = [const { Sample::new() }; 4];
    let mut slots = Slots::default();
    in_turns(rounds, 4, |who| match who {
        0 => plain.push(ours(period_ns, Guard::Off, Fleet::NONE, slots_a_slice, &mut slots)),
        1 => guarded.push(ours(period_ns, Guard::Auto, Fleet::NONE, slots_a_slice, &mut slots)),
        2 => {
            let fleet = Fleet::lenzes(1);
            let _server = rig::serve(fleet.simulate(Side::Ours), granted);
            with_wire.push(ours(period_ns, Guard::Off, fleet, slots_a_slice, &mut slots));
        }
        _ if with_rival => match cyclictest(granted, period_ns, slots_a_slice) {
            Ok(slice) => rival.push(slice),
            Err(why) => println!("a slice without cyclictest: {why}"),
        },
        _ => {}
    });
    let steal_ms = steal.ms();
    let Slots { planned, executed, skipped } = slots;

    println!(
        "\n{}: planned {planned} = executed {executed} + skipped {skipped}; steal {} ms in {rounds} rounds",
        Ns(period_ns),
        shown(steal_ms)
    );
    println!(
        "  wake-up latency, ns   {:>24} {:>24} {:>24} {:>24}",
        "plain", "guarded", "plain with a wire", "cyclictest"
    );
    for (name, q) in [("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("p99.9", 0.999)] {
        let [a, b, c, d] = [&plain, &guarded, &with_wire, &rival].map(|sample| shown(sample.quantile(q)));
        println!("  {name:20}  {a:>24} {b:>24} {c:>24} {d:>24}");
    }
    let plain_p50 = plain.ratio(&rival, 0.5);
    let plain_p99 = plain.ratio(&rival, 0.99);
    let wire_p50 = with_wire.ratio(&plain, 0.5);
    let wire_p99 = with_wire.ratio(&plain, 0.99);
    let guarded_p50 = guarded.quantile(0.5);
    let guarded_p99 = guarded.ratio(&rival, 0.99);
    println!("  plain / cyclictest     p50 {}   p99 {}", shown(plain_p50), shown(plain_p99));
    println!("  guarded / cyclictest   p99 {}", shown(guarded_p99));
    println!("  with a wire / plain    p50 {}   p99 {}", shown(wire_p50), shown(wire_p99));

    let name = Ns(period_ns);
    report.check(format!("{name}: planned = executed + skipped"), planned == executed + skipped);
    let value = |interval: Option<Interval>| interval.map(|interval| interval.value);
    let ends = |interval: Option<Interval>| interval.map(|interval| interval.ends());
    report.enter(
        period_ns.to_string(),
        json!({
            "plain_p50_ratio": value(plain_p50),
            "plain_p50_ratio_interval": ends(plain_p50),
            "plain_p99_ratio": value(plain_p99),
            "plain_p99_ratio_interval": ends(plain_p99),
            "guarded_p50_ns": value(guarded_p50),
            "guarded_p50_ns_interval": ends(guarded_p50),
            "guarded_p99_ratio": value(guarded_p99),
            "guarded_p99_ratio_interval": ends(guarded_p99),
            "with_wire_p50_ratio": value(wire_p50),
            "with_wire_p50_ratio_interval": ends(wire_p50),
            "with_wire_p99_ratio": value(wire_p99),
            "with_wire_p99_ratio_interval": ends(wire_p99),
            "planned": planned,
            "executed": executed,
            "skipped": skipped,
            "steal_ms": steal_ms,
        }),
    );
}

/// A slice of our loop: every slot's latency.
fn ours(period_ns: u64, guard: Guard, fleet: Fleet, slots: u64, counted: &mut Slots) -> Vec<u64> {
    let slice = rig::on_loop_thread(|_| {
        // The loop gives a slot up that begins later than half of the receive window, for the sake of its drives. If
        // there are none, this one gives up a slot only a whole period late, as cyclictest does.
        let receive_deadline = if fleet == Fleet::NONE { 1.99 } else { 0.9 };
        let cycle = CyclePlan { guard, receive_deadline, ..rig::cycle(period_ns) };
        let mut latencies = Vec::with_capacity(slots as usize + 64);
        let buses = fleet.buses(Side::Ours);
        let mut rig = Rig::new(cycle, buses, Pace::Grid, &Os::default(), Calls::default());
        rig.enable();
        let passed = |rig: &Rig| rig.status().executed + rig.status().skipped;
        let end = passed(&rig) + slots;
        while passed(&rig) < end {
            rig.turn(|record| match record {
                Record::Cycle(CycleRecord { wake_ns, .. }) => latencies.push(u64::from(wake_ns)),
                Record::Skipped(SkippedRecord { count, late_ns, .. }) => {
                    latencies.extend((0..count).map(|slot| late_ns.saturating_sub(slot * period_ns)));
                }
                _ => {}
            });
        }
        (latencies, rig.end())
    });
    let (latencies, end) = slice.unwrap_or_else(|error| rig::give_up(error));
    counted.planned += end.status.planned;
    counted.executed += end.status.executed;
    counted.skipped += end.status.skipped;
    latencies
}

/// A slice of cyclictest: the latency of each slot, ns.
fn cyclictest(granted: &Granted, period_ns: u64, slots: u64) -> Result<Vec<u64>, String> {
    let mut command = Command::new("cyclictest");
    // --default-system: ours does not hold the processor out of its idle states either (/dev/cpu_dma_latency).
    command.args(["-v", "-N", "-t1", "-d0", "--default-system"]);
    command.args(["-i", &(period_ns / US).to_string(), "-l", &slots.to_string()]);
    if let Some(core) = granted.core {
        command.args(["-a", &core.to_string()]);
        // Its main thread wakes up every 10 ms, and would do so on the measured core. On a virtual machine that alone
        // made the median a sixth better, since the host then waits for the next wake-up instead of switching away.
        // Ours has no such companion on its core.
        if let Some(other) = rig::other_core(granted) {
            command.arg(format!("--mainaffinity={other}"));
        }
    }
    if granted.memory_locked {
        command.arg("-m");
    }
    if granted.policy == "SCHED_FIFO" {
        command.args(["-p", &granted.priority.to_string()]);
    }
    // Into a file: whoever read a pipe meanwhile would wake up on some core.
    let path = std::env::temp_dir().join(format!("fieldbeat-jitter-{}.txt", std::process::id()));
    let file = File::create(&path).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    let output = command.stdin(Stdio::null()).stdout(file).output().map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => {
            "cyclictest is not installed: take it from your distribution (Debian: rt-tests)".to_owned()
        }
        _ => format!("cannot run cyclictest: {error}"),
    });
    let text = std::fs::read_to_string(&path).unwrap_or_default();
    // Nothing depends on its removal.
    let _ = std::fs::remove_file(&path);
    let output = output?;
    let latencies: Vec<u64> = text.lines().filter_map(latency).collect();
    if !output.status.success() || (latencies.len() as u64) < slots {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(format!(
            "cyclictest gave {} of {slots} latencies ({}): {}",
            latencies.len(),
            output.status,
            said.trim()
        ));
    }
    // A wake-up that is late by more than a period: the slots that it passed over were late too, each by a period less.
    let with_passed_over =
        |latency: u64| (0..=latency / period_ns).map(move |slot| latency - slot * period_ns);
    Ok(latencies.into_iter().flat_map(with_passed_over).collect())
}

/// Of a line `thread: cycle: latency`.
fn latency(line: &str) -> Option<u64> {
    let mut fields = line.split(':').map(str::trim);
    fields.next()?.parse::<u64>().ok()?;
    fields.next()?.parse::<u64>().ok()?;
    fields.next()?.parse().ok()
}
