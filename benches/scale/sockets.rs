//! The loop on sockets, ports and segments of this host, and the whole process.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use fieldbeat::Wait;
use fieldbeat::telemetry::{DriveEnd, Numbers};
use fieldbeat::time::{MS, Ns, US};
use fieldbeat_core::cycle::record::{DriveRecord, Record};
use fieldbeat_core::rt::Granted;
use fieldbeat_core::rt::Usage;
use fieldbeat_ethernet_ip as ethernet_ip;
use fieldbeat_linudp as linudp;
use serde_json::{Value, json};

use super::counted::{COMPARED, DRIVES_OF_64, TERMINALS_OF_64};
use crate::support::bare::{Duel, Outcome, Rival};
use crate::support::budgets::{self, Budgets};
use crate::support::counted::CountedNet;
use crate::support::fleet::{Fleet, Side};
use crate::support::rig::{self, Calls, Count, Pace, Rig};
use crate::support::stats::{Interval, Sample, median};
use crate::support::whole::Whole;
use crate::support::{Report, Steal, lenze, packets, shown};

/// MOONS' drives on sockets against the bare loop.
pub const MOONS_DUEL: usize = 32;

/// All kinds in one cycle: 32 LinMots and a segment of 8 Kollmorgens in every cycle, 32 MOONS' drives, 8 Unidrives and
/// a wire of 4 Lenze drives in every fourth.
const ALL_KINDS: Fleet =
    Fleet { linmots: 32, unidrives: 8, every: 4, segment: 8, terminals: 0, moons: 32, lenzes: 4 };

/// Both kinds in one cycle.
pub const TOGETHER: Fleet = Fleet { linmots: 32, unidrives: 32, every: 8, ..Fleet::NONE };

/// Drives of the segments on sockets: alone, and against the bare loop.
const SEGMENT_ALONE: usize = 16;
const SEGMENT_DUEL: usize = 4;

/// Of the loop on sockets; times are ns a drive and cycle.
pub struct OnSockets {
    pub ours: Option<f64>,
    pub bare: Option<f64>,
    pub ratio: Option<Interval>,
    pub ours_cpu: Option<f64>,
    pub bare_cpu: Option<f64>,
    pub cpu_ratio: Option<Interval>,
    pub calls: Option<f64>,
    pub steal_ms: Option<u64>,
}

pub fn on_sockets(
    granted: &Granted,
    quick: bool,
    drives: &[usize],
    budgets: &Budgets,
    report: &mut Report,
) -> Vec<OnSockets> {
    let (rounds, cycles) = if quick { (3, 40) } else { (15, 100) };
    println!("\nthe loop on sockets against the bare loop, ns a drive and cycle, medians of {rounds} rounds");
    println!(
        "  drives   period   ours done  last bare reply   ratio                 \
         ours CPU   bare CPU   ratio                 calls a cycle"
    );
    let mut table = Vec::new();
    for &count in drives {
        let steal = Steal::begin();
        let [mut ours, mut bare, mut ours_cpu, mut bare_cpu] = [const { Sample::new() }; 4];
        let mut calls = CallsOnSockets::default();
        for _ in 0..rounds {
            let Some(duel) = duel(granted, Fleet::linmots(count), period(count), cycles) else { continue };
            ours.push(duel.ours.busy);
            bare.push(duel.theirs.busy);
            ours_cpu.push(duel.ours.cpu);
            bare_cpu.push(duel.theirs.cpu);
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
            calls: calls.p50(),
            steal_ms: steal.ms(),
        };
        let whole = |value: Option<f64>| shown(value.map(|value| value.round()));
        println!(
            "  {count:6} {:>8} {:>11} {:>16}   {:20} {:>9} {:>10}   {:20} {:>8}; steal {} ms",
            Ns(period(count)).to_string(),
            whole(row.ours),
            whole(row.bare),
            shown(row.ratio),
            whole(row.ours_cpu),
            whole(row.bare_cpu),
            shown(row.cpu_ratio),
            shown(row.calls),
            shown(row.steal_ms)
        );
        if COMPARED.contains(&count) {
            calls.check(&format!("{count} {}", linudp::PROTOCOL), budgets, report);
        }
        table.push(row);
    }
    table
}

/// System calls on sockets, cycle by cycle.
#[derive(Default)]
struct CallsOnSockets {
    made: Sample,
    own: Sample,
    all: Count,
}

impl CallsOnSockets {
    /// Adds those of more cycles.
    fn push(&mut self, calls: Vec<Count>) {
        self.made.push(calls.iter().map(|calls| calls.made).collect());
        self.own.push(calls.iter().map(Count::own).collect());
        calls.into_iter().for_each(|calls| self.all += calls);
    }

    /// All calls of the median cycle.
    fn p50(&self) -> Option<f64> {
        self.made.quantile(0.5).map(|p50| p50.value)
    }

    /// Holds to their budget those that are made whenever replies come. A reply that is missing at the deadline costs
    /// one more, so the quietest tenth of the cycles is compared. And no wait ends without a reason.
    fn check(&self, drives: &str, budgets: &Budgets, report: &mut Report) {
        within(report, budgets, drives, budgets::OWN_CALLS, &self.own);
        let Count { ready, taken, .. } = self.all;
        report.check(
            format!("{drives}: ended waits {ready} <= {taken} that took something in"),
            ready <= taken,
        );
    }
}

/// What the quietest tenth of the cycles makes, and its budget.
fn within(report: &mut Report, budgets: &Budgets, drives: &str, what: &str, calls: &Sample) {
    let row = format!("scale/sockets/{drives}/{what}");
    match calls.quantile(0.1) {
        Some(calls) => report.within(budgets, &row, calls.value),
        None => report.not_compared(row, "this host let too few cycles be answered"),
    }
}

/// Our loop and the bare one over `fleet`, waiting by poll. The host may not let the bare one measure.
fn duel(granted: &Granted, fleet: Fleet, period_ns: u64, cycles: usize) -> Option<Outcome> {
    let calls = &Calls::default();
    let carriers = &CountedNet::new(calls);
    let duel =
        Duel { granted, fleet, wait: Wait::Poll, period_ns, cycles, carriers, calls, rival: Rival::Bare };
    let outcome = duel.fight();
    outcome.inspect_err(|why| println!("a slice without the bare loop: {why}")).ok()
}

/// Ours against the bare loop: ratios of the medians.
struct Against {
    /// From the end of the sleep until done.
    busy: Option<Interval>,
    /// Processor time of a cycle.
    cpu: Option<Interval>,
    /// The send phase, on a wire.
    sending: Option<Interval>,
    period_ns: u64,
    steal_ms: Option<u64>,
}

impl Against {
    fn bare(granted: &Granted, fleet: Fleet, period_ns: u64, rounds: usize, cycles: usize) -> Against {
        let steal = Steal::begin();
        let [mut ours, mut bare] = [const { [const { Sample::new() }; 3] }; 2];
        for _ in 0..rounds {
            let Some(Outcome { ours: of_ours, theirs, .. }) = duel(granted, fleet, period_ns, cycles) else {
                continue;
            };
            for (samples, measured) in [(&mut ours, of_ours), (&mut bare, theirs)] {
                let [busy, cpu, sending] = samples;
                busy.push(measured.busy);
                cpu.push(measured.cpu);
                sending.push(measured.sending);
            }
        }
        let [busy, cpu, sending] = std::array::from_fn(|what| ours[what].ratio(&bare[what], 0.5));
        Against { busy, cpu, sending, period_ns, steal_ms: steal.ms() }
    }

    /// Prints it; its numbers.
    fn report(&self, what: &str, drives: usize) -> Value {
        let Against { busy, cpu, sending, period_ns, steal_ms } = self;
        print!("  {drives} drives against the bare loop, every {} each: ours / bare ", Ns(*period_ns));
        println!(
            "{}, CPU {}, send phase {}; steal {} ms",
            shown(*busy),
            shown(*cpu),
            shown(*sending),
            shown(*steal_ms)
        );
        json!({
            "duel": what,
            "duel_drives": drives,
            "sockets_ratio": busy.map(|ratio| ratio.value),
            "sockets_ratio_interval": busy.map(|ratio| ratio.ends()),
            "sockets_cpu_ratio": cpu.map(|ratio| ratio.value),
            "sockets_cpu_ratio_interval": cpu.map(|ratio| ratio.ends()),
            "send_ratio": sending.map(|ratio| ratio.value),
            "send_ratio_interval": sending.map(|ratio| ratio.ends()),
            "steal_ms": steal_ms,
        })
    }
}

/// Each side has half of it, so both fit in twice: a drive takes some 15 us of the two cores together.
fn period(drives: usize) -> u64 {
    (drives as u64 * 80 * US).next_multiple_of(MS).max(2 * MS)
}

/// Both kinds in one cycle at 1 kHz, alone; then against the bare loop.
pub fn together(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> Value {
    let (alone, rounds, cycles) = if quick { (2_000, 3, 80) } else { (20_000, 15, 240) };
    let steal = Steal::begin();
    let Alone { end, calls, on_connections, page_faults, .. } = alone_at_1_khz(granted, TOGETHER, alone);
    let period_ns = period(TOGETHER.linmots + TOGETHER.due_unidrives());
    let against = Against::bare(granted, TOGETHER, period_ns, rounds, cycles);
    let (linmots, unidrives) = end.drives.split_at(TOGETHER.linmots);
    let [linmots, unidrives] = [linmots, unidrives].map(Kind::sum);
    let status = end.status;
    let p50 = |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value);
    let Fleet { linmots: of_linmots, unidrives: of_unidrives, every, .. } = TOGETHER;
    println!(
        "\n{of_linmots} LinMots in every cycle and {of_unidrives} Unidrives in every {every}th, together at \
         1 kHz; steal {} ms",
        shown(steal.ms())
    );
    println!("  planned {} = executed {} + skipped {}", status.planned, status.executed, status.skipped);
    println!("  LinMots:   {linmots}");
    println!("  Unidrives: {unidrives}");
    println!(
        "  system calls a cycle, p50: {}, of which on connections {}",
        shown(calls.p50()),
        shown(p50(&on_connections))
    );
    println!(
        "  against the bare loop, every {} each: ours / bare {}, CPU {}",
        Ns(period_ns),
        shown(against.busy),
        shown(against.cpu)
    );
    report.check(
        format!("together: planned {} = executed + skipped", status.planned),
        status.planned == status.executed + status.skipped,
    );
    linmots.check("together, LinMots", report);
    unidrives.check("together, Unidrives", report);
    calls.check("together", budgets, report);
    within(report, budgets, "together on connections", budgets::CALLS, &on_connections);
    check_page_faults("together", page_faults, budgets, report);
    json!({
        "together": { "linmots": of_linmots, "unidrives": of_unidrives, "every": every },
        "planned": status.planned,
        "executed": status.executed,
        "skipped": status.skipped,
        "linmots_sent": linmots.sent,
        "linmots_answered": linmots.answered,
        "linmots_late": linmots.late,
        "unidrives_sent": unidrives.sent,
        "unidrives_answered": unidrives.answered,
        "syscalls_per_cycle": calls.p50(),
        "syscalls_on_connections": p50(&on_connections),
        "sockets_ratio": against.busy.map(|ratio| ratio.value),
        "sockets_ratio_interval": against.busy.map(|ratio| ratio.ends()),
        "sockets_cpu_ratio": against.cpu.map(|ratio| ratio.value),
        "steal_ms": steal.ms(),
    })
}

/// All kinds in one cycle at 1 kHz: nothing is left out, and each exchange is closed.
pub fn all_kinds(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> Value {
    let steal = Steal::begin();
    let Alone { end, calls, on_connections, ages, page_faults } =
        alone_at_1_khz(granted, ALL_KINDS, if quick { 2_000 } else { 20_000 });
    let (linmots, rest) = end.drives.split_at(ALL_KINDS.linmots);
    let (unidrives, rest) = rest.split_at(ALL_KINDS.unidrives);
    let (segment, rest) = rest.split_at(ALL_KINDS.segment);
    let (moons, lenzes) = rest.split_at(ALL_KINDS.moons);
    let kinds = [
        ("LinMots", linmots),
        ("Unidrives", unidrives),
        ("Kollmorgens", segment),
        ("MOONS", moons),
        ("Lenze drives", lenzes),
    ]
    .map(|(name, drives)| (name, Kind::sum(drives)));
    let (status, p50) = (end.status, |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value));
    println!("\nall kinds in one cycle at 1 kHz ({ALL_KINDS}); steal {} ms", shown(steal.ms()));
    println!("  planned {} = executed {} + skipped {}", status.planned, status.executed, status.skipped);
    kinds.iter().for_each(|(name, kind)| println!("  {name}: {kind}"));
    println!(
        "  system calls a cycle, p50: {}, of which on connections {}; age of MOONS' feedback, p50: {} ns",
        shown(calls.p50()),
        shown(p50(&on_connections)),
        shown(p50(&ages))
    );
    report.check(
        format!("all kinds: planned {} = executed + skipped", status.planned),
        status.planned == status.executed + status.skipped,
    );
    kinds.iter().for_each(|(name, kind)| kind.check(&format!("all kinds, {name}"), report));
    calls.check("all kinds", budgets, report);
    within(report, budgets, "all kinds on connections", budgets::CALLS, &on_connections);
    check_page_faults("all kinds", page_faults, budgets, report);
    let counted = kinds.iter().map(|(name, kind)| (*name, json!([kind.sent, kind.answered, kind.missed])));
    json!({
        "all_kinds": ALL_KINDS.to_string(),
        "planned": status.planned,
        "executed": status.executed,
        "skipped": status.skipped,
        "sent_answered_missed": counted.collect::<BTreeMap<_, _>>(),
        "syscalls_per_cycle": calls.p50(),
        "syscalls_on_connections": p50(&on_connections),
        "moons_age_ns": p50(&ages),
        "steal_ms": steal.ms(),
    })
}

/// MOONS' drives with an interval of 4 ms, each in every cycle of as much: the send phase against the bare loop over
/// the same bytes, and how old feedback is.
pub fn packets_on_sockets(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> Value {
    let (rounds, cycles, period_ns) = if quick { (3, 200, 4 * MS) } else { (15, 400, 4 * MS) };
    let fleet = Fleet::moons(MOONS_DUEL);
    let steal = Steal::begin();
    let [mut ours, mut bare, mut ages] = [const { Sample::new() }; 3];
    let mut calls = CallsOnSockets::default();
    for _ in 0..rounds {
        let (mut simulated, theirs) = (fleet.simulate(Side::Ours), fleet.simulate(Side::Bare));
        simulated.drives.extend(theirs.drives);
        let _server = rig::serve(simulated, granted);
        let counted = &Calls::default();
        let carriers = &CountedNet::new(counted);
        let duel = rig::on_loop_thread(|_| packets::duel(fleet, period_ns, cycles, carriers, counted));
        match duel.unwrap_or_else(|error| rig::give_up(error)) {
            Ok(duel) => {
                ours.push(duel.ours);
                bare.push(duel.bare);
                calls.push(duel.calls);
                ages.push(duel.ages);
            }
            Err(why) => println!("a slice without the bare loop: {why}"),
        }
    }
    let p50 = |sample: &Sample| sample.quantile(0.5).map(|p50| p50.value);
    let (ratio, bound_ns) = (ours.ratio(&bare, 0.5), period_ns / 2 + period_ns);
    println!(
        "\n{MOONS_DUEL} MOONS' drives on sockets, every {} each; {rounds} rounds, steal {} ms",
        Ns(period_ns),
        shown(steal.ms())
    );
    println!(
        "  send phase, p50: {} ns; bare loop {} ns; ratio {}; system calls a cycle {}",
        shown(p50(&ours)),
        shown(p50(&bare)),
        shown(ratio),
        shown(calls.p50())
    );
    println!(
        "  age of feedback, p50: {} ns; half an interval and a period: {bound_ns} ns",
        shown(p50(&ages))
    );
    calls.check(&format!("{MOONS_DUEL} {}", ethernet_ip::PROTOCOL), budgets, report);
    json!({
        "moons_on_sockets": MOONS_DUEL,
        "send_ns": p50(&ours),
        "bare_ns": p50(&bare),
        "send_ratio": ratio.map(|ratio| ratio.value),
        "send_ratio_interval": ratio.map(|ratio| ratio.ends()),
        "syscalls_per_cycle": calls.p50(),
        "age_ns": p50(&ages),
        "steal_ms": steal.ms(),
    })
}

/// A segment alone at 1 kHz, and the same with couplers and terminals; then a segment against the bare loop.
pub fn segments_on_sockets(
    granted: &Granted,
    quick: bool,
    budgets: &Budgets,
    report: &mut Report,
) -> [Value; 3] {
    let (alone, rounds, cycles) = if quick { (2_000, 3, 80) } else { (20_000, 15, 240) };
    let fleets = [
        ("a segment", Fleet::segment(SEGMENT_ALONE)),
        ("terminals", Fleet::with_terminals(DRIVES_OF_64, TERMINALS_OF_64)),
    ];
    let [segment, terminals] = fleets.map(|(what, fleet)| {
        println!(
            "\n{} drives and {} couplers and terminals on one segment of this host at 1 kHz",
            fleet.segment, fleet.terminals
        );
        alone_on_sockets(granted, what, fleet, alone, budgets, report)
    });
    let duel = Against::bare(granted, Fleet::segment(SEGMENT_DUEL), 2 * MS, rounds, cycles);
    [segment, terminals, duel.report("a segment", SEGMENT_DUEL)]
}

/// A wire of Lenze drives alone at 1 kHz, all of them in every cycle; then against the bare loop.
pub fn wire_on_port(granted: &Granted, quick: bool, budgets: &Budgets, report: &mut Report) -> [Value; 2] {
    let (alone, rounds, cycles) = if quick { (2_000, 3, 80) } else { (20_000, 15, 240) };
    let fleet = Fleet::lenzes(lenze::A_WIRE);
    println!("\n{} drives on one PROFIBUS wire of this host at 1 kHz", fleet.lenzes);
    let mut wire = alone_on_sockets(granted, "a wire", fleet, alone, budgets, report);
    let calls = wire["syscalls_per_cycle"].as_f64();
    let each = calls.map(|calls| (calls - 1.0) / fleet.lenzes as f64);
    println!("  system calls an exchange in addition to the sleep: {}", shown(each));
    wire["syscalls_per_exchange"] = json!(each);
    let duel = Against::bare(granted, fleet, 2 * MS, rounds, cycles);
    [wire, duel.report("a wire", fleet.lenzes)]
}

/// Drives of one kind at 1 kHz: nothing is left out or lost, and their system calls.
fn alone_on_sockets(
    granted: &Granted,
    what: &str,
    fleet: Fleet,
    cycles: usize,
    budgets: &Budgets,
    report: &mut Report,
) -> Value {
    let steal = Steal::begin();
    let Alone { end, calls, page_faults, .. } = alone_at_1_khz(granted, fleet, cycles);
    let (status, drives) = (end.status, Kind::sum(&end.drives));
    println!("  planned {} = executed {} + skipped {}", status.planned, status.executed, status.skipped);
    println!("  {drives}");
    println!("  system calls a cycle, p50: {}; steal {} ms", shown(calls.p50()), shown(steal.ms()));
    report.check(
        format!("{what}: planned {} = executed + skipped", status.planned),
        status.planned == status.executed + status.skipped,
    );
    drives.check(what, report);
    calls.check(what, budgets, report);
    check_page_faults(what, page_faults, budgets, report);
    json!({
        "alone": what,
        "drives": fleet.drives(),
        "terminals": fleet.terminals,
        "planned": status.planned,
        "executed": status.executed,
        "skipped": status.skipped,
        "sent": drives.sent,
        "answered": drives.answered,
        "missed": drives.missed,
        "syscalls_per_cycle": calls.p50(),
        "steal_ms": steal.ms(),
    })
}

/// A master with all of its threads against the bare loop.
pub fn whole_process(granted: &Granted, quick: bool) -> Vec<Value> {
    let (rounds, cycles) = if quick { (3, 1_000) } else { (11, 2_000) };
    println!(
        "\nall threads of a master at 1 kHz against the bare loop, processor time in ns a cycle, {rounds} \
         rounds"
    );
    let fleets = [
        ("3 drives on one segment", Fleet::segment(3)),
        ("4 drives on one wire, each in every fourth cycle", Fleet { every: 4, ..Fleet::lenzes(4) }),
        ("8 LinMots", Fleet::linmots(8)),
        ("16 LinMots", Fleet::linmots(16)),
    ];
    let measured = fleets.map(|(what, fleet)| {
        let steal = Steal::begin();
        let whole = Whole::measure(granted, fleet, rounds, cycles);
        let p50 = |rounds: &[f64]| (!rounds.is_empty()).then(|| median(rounds).round());
        let threads: Vec<(&str, Option<f64>)> =
            whole.threads.iter().map(|(name, sample)| (name.as_str(), p50(sample))).collect();
        let by_thread: Vec<String> =
            threads.iter().map(|(name, ns)| format!("{name} {}", shown(*ns))).collect();
        println!(
            "  {what}: ours {}, bare {}, ratio {}; {}; steal {} ms",
            shown(p50(&whole.ours)),
            shown(p50(&whole.bare)),
            shown(whole.ratio()),
            by_thread.join(", "),
            shown(steal.ms())
        );
        json!({
            "whole_process": what,
            "ours_cpu_ns": p50(&whole.ours),
            "threads_cpu_ns": threads.into_iter().collect::<BTreeMap<_, _>>(),
            "bare_cpu_ns": p50(&whole.bare),
            "whole_cpu_ratio": whole.ratio().map(|ratio| ratio.value),
            "whole_cpu_ratio_interval": whole.ratio().map(|ratio| ratio.ends()),
            "steal_ms": steal.ms(),
        })
    });
    measured.into()
}

/// A fleet without a rival.
struct Alone {
    end: Numbers,
    /// System calls of each executed cycle: all of them, and those on connections.
    calls: CallsOnSockets,
    on_connections: Sample,
    /// How old the status of each MOONS' drive is when a cycle publishes it, ns.
    ages: Sample,
    /// Of the loop's thread meanwhile; `None`: its memory is not locked.
    page_faults: Option<u64>,
}

/// So many cycles of a fleet.
fn alone_at_1_khz(granted: &Granted, fleet: Fleet, cycles: usize) -> Alone {
    let _server = rig::serve(fleet.simulate(Side::Ours), granted);
    let counted = Calls::default();
    let carriers = CountedNet::new(&counted);
    let run = rig::on_loop_thread(|granted| {
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), Pace::Grid, &carriers, Arc::clone(&counted));
        rig.enable();
        let (mut calls, mut on_them) = (Vec::with_capacity(cycles), Vec::with_capacity(cycles));
        let mut of_moons = Vec::with_capacity(cycles * fleet.moons);
        let first = fleet.drives() - fleet.lenzes - fleet.moons;
        let usage = Usage::of_thread();
        for _ in 0..cycles {
            let (executed, before) = (rig.status().executed, carriers.on_connections());
            let turn = rig.turn(|record| match record {
                Record::Drive(DriveRecord { axis, age_ns: Some(age_ns), .. })
                    if (first..first + fleet.moons).contains(&axis.into()) =>
                {
                    of_moons.push(u64::from(age_ns.get()));
                }
                _ => {}
            });
            if rig.status().executed > executed {
                calls.push(turn.calls);
                on_them.push(carriers.on_connections() - before);
            }
        }
        let page_faults = Usage::of_thread().since(usage).page_faults();
        rig.settle();
        let [mut on_connections, mut ages] = [const { Sample::new() }; 2];
        let mut all = CallsOnSockets::default();
        all.push(calls);
        ages.push(of_moons);
        on_connections.push(on_them);
        let page_faults = granted.memory_locked.then_some(page_faults);
        Alone { end: rig.end(), calls: all, on_connections, ages, page_faults }
    });
    run.unwrap_or_else(|error| rig::give_up(error))
}

fn check_page_faults(what: &str, page_faults: Option<u64>, budgets: &Budgets, report: &mut Report) {
    match page_faults {
        Some(page_faults) => report.within(budgets, budgets::PAGE_FAULTS, page_faults as f64),
        None => report.not_compared(format!("{what}: page faults"), "the memory is not locked here"),
    }
}

/// The exchanges of all drives of one kind.
struct Kind {
    sent: u64,
    answered: u64,
    missed: u64,
    late: u64,
}

impl Kind {
    fn sum(drives: &[DriveEnd]) -> Kind {
        let all = drives.iter().map(|drive| drive.counters);
        all.fold(Kind { sent: 0, answered: 0, missed: 0, late: 0 }, |sum, drive| Kind {
            sent: sum.sent + drive.sent,
            answered: sum.answered + drive.answered,
            missed: sum.missed + drive.missed,
            late: sum.late + drive.late,
        })
    }

    /// Every exchange was closed, and only once. What is missed is the host's doing.
    fn check(&self, what: &str, report: &mut Report) {
        let Kind { sent, answered, missed, .. } = self;
        report.check(
            format!("{what}: sent {sent} = answered {answered} + missed {missed}"),
            *sent == answered + missed && *answered > 0,
        );
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Kind { sent, answered, missed, late } = self;
        write!(f, "sent {sent}, answered {answered}, missed {missed}, of which came late {late}")
    }
}
