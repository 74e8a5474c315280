//! Instructions of one scenario, counted by callgrind (Debian: valgrind).
//!
//! A bench that counts starts itself once for each scenario under callgrind, which collects only what `callgrind`
//! marks.
//!
//! The count is the same in each run on each host: the child's clock is virtual, it makes no thread and needs no right,
//! its environment is empty, and glibc is set to use the string functions of the plain architecture instead of those
//! that the host's processor chooses.
//!
//! No crate does this. iai-callgrind and gungraun need a runner program of exactly their own version to be installed,
//! and count whole benchmark functions; what is left of them here is one command and one line of its output.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::process::{Command, ExitCode, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use serde_json::json;

use super::budgets::{ALLOCATIONS, Budgets, CALLS, INSTRUCTIONS, MISSES};
use super::{Args, Report, rig, shown};

#[path = "../../tests/support/counting.rs"]
mod counting;

/// The requests of watched code to it are counted.
#[global_allocator]
static ALLOCATOR: counting::Counting = counting::Counting;

/// The benches that count instructions.
pub const BENCHES: [&str; 2] = ["scale", "wire"];

/// This variable of the environment makes the program the child that callgrind looks at, for this scenario.
const COUNTED: &str = "FIELDBEAT_BENCH_COUNTED";
/// glibc without what a processor may have or not: its string functions are chosen when it is loaded.
const PLAIN_GLIBC: &str = "glibc.cpu.hwcaps=-AVX,-AVX2,-AVX2_Usable,-AVX_Fast_Unaligned_Load,-AVX512F,\
    -AVX512VL,-AVX512BW,-BMI1,-BMI2,-LZCNT,-MOVBE,-ERMS,-FSRM,-FMA,-FMA4,-SSSE3,-SSE4_1,-SSE4_2";
/// Caches that callgrind simulates, in bytes, ways and bytes of a line: first level for data, and second level, which
/// it calls the last one.
const CACHES: [&str; 3] = ["--cache-sim=yes", "--D1=32768,8,64", "--LL=524288,8,64"];

/// What one child runs.
#[derive(Clone, Copy, Debug)]
pub struct Scenario {
    /// What it is about.
    pub protocol: &'static str,
    /// What of it, unless that is the usual.
    pub part: Option<&'static str>,
    /// Drives that share one cycle.
    pub drives: usize,
    /// Couplers and terminals in it.
    pub terminals: usize,
    /// Whether its misses of the caches are counted, too.
    pub caches: Caches,
    /// Of its cycles the one with most instructions, in place of the mean.
    pub worst: bool,
}

/// Whether caches are simulated, which takes three times as long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Caches {
    No,
    /// With `--misses` only.
    OnRequest,
    /// Those of the first level have a budget.
    Yes,
}

/// What the child has run.
#[derive(Clone, Copy, Debug)]
pub struct Ran {
    /// So many cycles.
    pub cycles: u64,
    /// Allocations and frees in them.
    pub allocations: u64,
    /// System calls in them; `None`: there are no sockets.
    pub calls: Option<u64>,
}

/// Of a drive and cycle; where there are terminals, of a slave and cycle.
#[derive(Clone, Copy, Debug)]
struct Counts {
    instructions: f64,
    allocations: u64,
    /// System calls of a cycle of all drives.
    calls: Option<f64>,
    /// First level for data, and second level.
    misses: Option<[f64; 2]>,
}

impl Counts {
    /// The misses of the first level, where they have a budget.
    fn first_level(&self, scenario: &Scenario) -> Option<f64> {
        let [first, _] = self.misses.filter(|_| scenario.caches == Caches::Yes)?;
        Some((first * 10.0).round() / 10.0)
    }
}

/// The child: runs the scenario that its environment names, if it does. Returns whether it did.
pub fn is_child(scenarios: &[Scenario], run: impl FnOnce(Scenario) -> Ran) -> bool {
    let Ok(wanted) = std::env::var(COUNTED) else { return false };
    let Some(scenario) = scenarios.iter().find(|scenario| scenario.name() == wanted) else {
        rig::give_up(format!("no scenario {wanted}"));
    };
    let Ran { cycles, allocations, calls } = run(*scenario);
    let calls = calls.map_or_else(String::new, |calls| calls.to_string());
    println!("{cycles} {allocations} {calls}");
    true
}

/// From here on callgrind looks at each instruction; until then the child is ten times as fast
/// (`CALLGRIND_START_INSTRUMENTATION`).
#[cfg(target_arch = "x86_64")]
pub fn instrument() {
    request(4);
}

/// A client request of callgrind's; elsewhere than under it this does nothing (valgrind.h, callgrind.h).
#[cfg(target_arch = "x86_64")]
fn request(what: u64) {
    let request = [(b'C' as u64) << 24 | (b'T' as u64) << 16 | what, 0, 0, 0, 0, 0];
    // SAFETY: the rotations add up to two full turns, and the exchange is of a register with itself. Valgrind reads the
    // six words and writes its answer into rdx.
    unsafe {
        std::arch::asm!(
            "rol rdi, 3", "rol rdi, 13", "rol rdi, 61", "rol rdi, 51", "xchg rbx, rbx",
            in("rax") request.as_ptr(), inout("rdx") 0_u64 => _, options(nostack)
        );
    }
}

/// Callgrind looks at each instruction from the start.
#[cfg(not(target_arch = "x86_64"))]
pub fn instrument() {}

/// What was counted since the last time is a part of its own (`CALLGRIND_DUMP_STATS`).
pub fn part() {
    #[cfg(target_arch = "x86_64")]
    request(0);
}

/// Runs `cycle` as often as `cycles` says and counts what it allocates and frees. What callgrind shall count
/// is inside of [`counted`].
pub fn run(cycles: u64, mut cycle: impl FnMut()) -> Ran {
    let allocations = counting::allocations(|| (0..cycles).for_each(|_| cycle()));
    Ran { cycles, allocations, calls: None }
}

/// Counts all scenarios of a bench, prints them and compares them with their budgets, or writes these.
pub fn gate(bench: &str, args: &Args, scenarios: &[Scenario]) -> ExitCode {
    println!(
        "{bench}: instructions a drive and cycle, counted by callgrind without carriers and simulated drives"
    );
    if let Err(why) = valgrind() {
        println!("not counted: {why}");
        return ExitCode::SUCCESS;
    }
    match counts_of(scenarios, args.misses).and_then(|counts| judge(bench, args, scenarios, &counts)) {
        Ok(code) => code,
        Err(why) => rig::give_up(why),
    }
}

fn judge(bench: &str, args: &Args, scenarios: &[Scenario], all: &[Counts]) -> Result<ExitCode, String> {
    let mut budgets = Budgets::read()?;
    let [_, first, second] = CACHES;
    println!(
        "misses are those of simulated caches ({first} {second}); those of the second level have no budget"
    );
    println!(
        "  scenario         instructions   budget  of budget  1st level  2nd level  calls a cycle  \
         allocations"
    );
    for (scenario, counts) in scenarios.iter().zip(all) {
        let budget = budgets.of(&scenario.row(bench, INSTRUCTIONS));
        let share = budget.map(|budget| format!("{:+.1} %", (counts.instructions / budget - 1.0) * 100.0));
        let [first, second] = [0, 1].map(|level| counts.misses.map(|misses| format!("{:.1}", misses[level])));
        println!(
            "  {:16} {:12.1} {:>8} {:>10} {:>10} {:>10} {:>14} {:12}",
            scenario.name(),
            counts.instructions,
            shown(budget),
            shown(share),
            shown(first),
            shown(second),
            shown(counts.calls),
            counts.allocations
        );
    }
    if args.write_budgets {
        budgets.retain(bench, |row| {
            scenarios.iter().any(|scenario| {
                [INSTRUCTIONS, MISSES, CALLS].map(|what| scenario.row(bench, what)).contains(row)
            })
        });
        for (scenario, counts) in scenarios.iter().zip(all) {
            budgets.enter(&scenario.row(bench, INSTRUCTIONS), counts.instructions);
            if let Some(misses) = counts.first_level(scenario) {
                budgets.enter(&scenario.row(bench, MISSES), misses);
            }
            if let Some(calls) = counts.calls {
                budgets.enter(&scenario.row(bench, CALLS), calls);
            }
        }
        budgets.write()?;
    }
    let mut report = Report::default();
    let allocations: u64 = all.iter().map(|counts| counts.allocations).sum();
    report.within(&budgets, ALLOCATIONS, allocations as f64);
    for (scenario, counts) in scenarios.iter().zip(all) {
        if let Some(calls) = counts.calls {
            report.within(&budgets, &scenario.row(bench, CALLS), calls);
        }
        let misses = counts.first_level(scenario).map(|misses| (MISSES, misses));
        for (what, count) in [(INSTRUCTIONS, counts.instructions)].into_iter().chain(misses) {
            let row = scenario.row(bench, what);
            match cfg!(target_arch = "x86_64") {
                true => report.within(&budgets, &row, count),
                false => report.not_compared(&row, "the budgets were taken on x86_64"),
            }
        }
        report.enter(
            scenario.row(bench, INSTRUCTIONS),
            json!({ "instructions": counts.instructions, "first_and_second_level_misses": counts.misses }),
        );
    }
    if let Some(other) = budgets.other_compiler() {
        println!("{other}");
        println!("if a budget fails for that reason only, take them again: --count --write-budgets");
    }
    Ok(report.finish(args))
}

/// Each scenario in a process of its own, as many at a time as there are cores: a count does not mind.
fn counts_of(scenarios: &[Scenario], misses: bool) -> Result<Vec<Counts>, String> {
    let next = AtomicUsize::new(0);
    let done = Mutex::new(BTreeMap::new());
    let worker = || {
        // The longest ones, which come last, begin first.
        while let Some(place) = scenarios.len().checked_sub(1 + next.fetch_add(1, Ordering::Relaxed)) {
            let counts = under_callgrind(scenarios[place], misses);
            done.lock().unwrap_or_else(|poison| poison.into_inner()).insert(place, counts);
        }
    };
    std::thread::scope(|scope| {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        (0..cores).for_each(|_| drop(scope.spawn(worker)));
    });
    done.into_inner().unwrap_or_else(|poison| poison.into_inner()).into_values().collect()
}

fn under_callgrind(scenario: Scenario, misses: bool) -> Result<Counts, String> {
    let what = scenario.name();
    let of = |error: &dyn std::fmt::Display| format!("{what}: {error}");
    let directory = tempfile::tempdir().map_err(|error| of(&error))?;
    let path = directory.path().join("counts");
    let mut command = Command::new("valgrind");
    command.args(["--tool=callgrind", "--demangle=no", "--collect-atstart=no"]);
    command.arg(if cfg!(target_arch = "x86_64") { "--instr-atstart=no" } else { "--instr-atstart=yes" });
    command.args(["--toggle-collect=*callgrind_counts*", "--toggle-collect=*callgrind_pauses*"]);
    let caches = match scenario.caches {
        Caches::No => false,
        Caches::OnRequest => misses,
        Caches::Yes => true,
    };
    command.args(if caches { &CACHES[..] } else { &[] });
    command.arg(format!("--callgrind-out-file={}", path.display()));
    command.arg(std::env::current_exe().map_err(|error| of(&error))?);
    // What else is in the environment moves the stack, and with it what a copy of bytes takes.
    command.env_clear().env("PATH", "/usr/bin:/bin").env("GLIBC_TUNABLES", PLAIN_GLIBC).env(COUNTED, &what);
    let output = command.stdin(Stdio::null()).output().map_err(|error| of(&error))?;
    let said = String::from_utf8_lossy(&output.stdout);
    let ran: Vec<u64> = said.split_whitespace().map_while(|number| number.parse().ok()).collect();
    let [cycles, allocations, ref calls @ ..] = ran[..] else {
        let errors = String::from_utf8_lossy(&output.stderr);
        return Err(of(&format!("it ended ({}): {said}{}", output.status, errors.trim())));
    };
    let events = match scenario.worst {
        false => events(&path),
        true => worst(&path),
    };
    let events = events.map_err(|error| of(&error))?;
    let each = |names: &[&str]| {
        let all: Option<u64> = names.iter().map(|name| events.get(*name).copied()).sum();
        all.map(|all| all as f64 / (cycles * (scenario.drives + scenario.terminals) as u64) as f64)
    };
    let instructions = each(&["Ir"]).filter(|count| *count > 0.0);
    let instructions = instructions.ok_or_else(|| of(&"callgrind has counted nothing"))?;
    let misses = each(&["D1mr", "D1mw"]).zip(each(&["DLmr", "DLmw"]));
    Ok(Counts {
        // A tenth is more than enough for a reader.
        instructions: (instructions * 10.0).round() / 10.0,
        allocations,
        calls: calls.first().map(|calls| *calls as f64 / cycles as f64),
        misses: misses.map(|(first, second)| [first, second]),
    })
}

/// The totals of what callgrind has written: `events: Ir Dr ...` names them, `totals: 1 2 ...` has them, without the
/// zeros at the end.
fn events(path: &Path) -> Result<BTreeMap<String, u64>, String> {
    let text = std::fs::read_to_string(path).map_err(|error| error.to_string())?;
    let line = |key: &str| text.lines().find_map(|line| line.strip_prefix(key));
    let (names, totals) = line("events:").zip(line("totals:")).ok_or("callgrind has written no totals")?;
    let totals = totals.split_whitespace().map(|total| total.parse().unwrap_or(0));
    let totals = totals.chain(std::iter::repeat(0));
    Ok(names.split_whitespace().map(str::to_owned).zip(totals).collect())
}

/// The part with most instructions: `PATH.1`, `PATH.2` ...
fn worst(path: &Path) -> Result<BTreeMap<String, u64>, String> {
    let part = |number: u32| path.with_extension(number.to_string());
    let parts = (1..).map(part).take_while(|part| part.exists());
    let all: Vec<_> = parts.map(|part| events(&part)).collect::<Result<_, _>>()?;
    let instructions = |part: &BTreeMap<String, u64>| part.get("Ir").copied();
    all.into_iter().max_by_key(instructions).ok_or_else(|| "callgrind has written no parts".to_owned())
}

fn valgrind() -> Result<(), String> {
    match Command::new("valgrind").arg("--version").stdout(Stdio::null()).status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("valgrind --version ended ({status})")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            Err("valgrind is not installed (Debian: valgrind)".to_owned())
        }
        Err(error) => Err(format!("cannot run valgrind: {error}")),
    }
}

impl Scenario {
    /// Drives only; the caches are not simulated.
    pub const fn of(protocol: &'static str, drives: usize) -> Scenario {
        Scenario { protocol, part: None, drives, terminals: 0, caches: Caches::No, worst: false }
    }

    /// As the environment of the child and the table have it.
    pub fn name(&self) -> String {
        let Scenario { protocol, part, drives, terminals, .. } = self;
        match (part, terminals) {
            (Some(part), _) => format!("{protocol}/{drives} {part}"),
            (None, 0) => format!("{protocol}/{drives}"),
            (None, terminals) => format!("{protocol}/{drives}+{terminals}"),
        }
    }

    /// Its row in the file of budgets.
    fn row(&self, bench: &str, what: &str) -> String {
        format!("{bench}/{}/{what}", self.name())
    }
}
