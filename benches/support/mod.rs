//! What all benches share.
//!
//! | file | what |
//! |---|---|
//! | `mod` | arguments, turns, checks, the JSON file, stolen time |
//! | `budgets` | `benches/budgets.csv`: the budgets of what is counted |
//! | `count` | instructions of one scenario, counted by callgrind |
//! | `stats` | quantiles, and ratios with bootstrap intervals |
//! | `rig` | the loop driven by hand on a real-time thread |
//! | `fleet` | the drives it runs |
//! | `unidrive`, `moons` | a Unidrive, a MOONS' drive in memory |
//! | `segment`, `lenze` | a segment of Kollmorgens, a wire of Lenze drives in memory |
//! | `bare` | the bare loop that it is measured against, and the loop in turns with a rival |
//! | `bare_wire` | the bare loop's PROFIBUS wire |
//! | `packets` | the same for class 1 packets, which answer nothing |
//! | `libmodbus` | a client over libmodbus that takes turns with the loop |
//! | `null`, `counted` | carriers without a network; those of the operating system, counting system calls |
//!
//! Absolute times say little on a shared machine. So each contender runs in short slices, in turns with its rivals, on
//! the same core, priority and grid; the ratio is printed with an interval that comes from the slices. Times and ratios
//! never fail a bench. Counts and errors do.

pub mod bare;
pub mod bare_wire;
pub mod budgets;
pub mod callgrind;
pub mod count;
pub mod counted;
pub mod fleet;
pub mod handshake;
pub mod lenze;
pub mod libmodbus;
pub mod moons;
pub mod null;
pub mod packets;
pub mod rig;
pub mod segment;
pub mod stats;
pub mod unidrive;
pub mod whole;

use std::fmt::Display;
use std::path::PathBuf;
use std::process::ExitCode;

use fieldbeat_core::rt::host;
use serde_json::{Map, Value, json};

use budgets::Budgets;

/// The command line of a bench.
#[derive(Debug)]
pub struct Args {
    /// Short slices and few of them.
    pub quick: bool,
    /// Count instructions instead of measuring times.
    pub count: bool,
    /// Write what was counted into the file of budgets instead of comparing it.
    pub write_budgets: bool,
    /// Count the misses of simulated caches, too, which takes three times as long.
    pub misses: bool,
    /// Where the numbers go.
    json: Option<PathBuf>,
}

impl Args {
    /// Reads the command line of the bench `name`; says what is allowed and ends the program if it is something else.
    ///
    /// A plain word chooses benches by a part of their name, as in `cargo bench jitter`: the others end at once.
    pub fn parse(name: &str) -> Args {
        let mut args = Args { quick: false, count: false, write_budgets: false, misses: false, json: None };
        let mut chosen = None;
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            match word.as_str() {
                // From cargo.
                "--bench" => {}
                "--quick" => args.quick = true,
                "--count" if count::BENCHES.contains(&name) => args.count = true,
                "--write-budgets" if args.count => args.write_budgets = true,
                "--misses" if args.count => args.misses = true,
                "--json" => match words.next() {
                    Some(path) => args.json = Some(path.into()),
                    None => usage("--json needs a file"),
                },
                option if option.starts_with('-') => usage(&format!("unknown option {option}")),
                part => chosen = Some(chosen.unwrap_or(false) || name.contains(part)),
            }
        }
        if chosen == Some(false) {
            std::process::exit(0);
        }
        args
    }
}

fn usage(mistake: &str) -> ! {
    eprintln!(
        "{mistake}; usage: cargo bench [NAME] -- [--quick] [--json FILE], \
         or cargo bench --bench wire|scale -- --count [--write-budgets] [--misses] [--json FILE]"
    );
    std::process::exit(2)
}

/// Runs `contenders` in turns, `rounds` times, each time beginning with another one, so that none always follows the
/// same rival.
pub fn in_turns(rounds: usize, contenders: usize, mut run: impl FnMut(usize)) {
    for round in 0..rounds {
        for turn in 0..contenders {
            run((round + turn) % contenders);
        }
    }
}

/// Time that the hypervisor took from all cores since this began.
#[derive(Debug)]
pub struct Steal(Option<u64>);

impl Steal {
    /// From now on.
    pub fn begin() -> Steal {
        Steal(host::steal_ms(None))
    }

    /// So far, ms; `None` if the kernel does not tell.
    pub fn ms(&self) -> Option<u64> {
        Some(host::steal_ms(None)?.saturating_sub(self.0?))
    }
}

/// A value, or why there is none.
pub fn shown<T: Display>(value: Option<T>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

/// The numbers of one bench, and the checks of what it counted.
#[derive(Debug, Default)]
pub struct Report {
    numbers: Map<String, Value>,
    list: Vec<Value>,
    checks: Vec<String>,
    failed: bool,
}

impl Report {
    /// Enters an object under `key`.
    pub fn enter(&mut self, key: impl Into<String>, value: Value) {
        self.numbers.insert(key.into(), value);
    }

    /// Appends an object to a bench whose numbers are a list.
    pub fn append(&mut self, value: Value) {
        self.list.push(value);
    }

    /// A count, or an identity of counts.
    pub fn check(&mut self, what: impl Display, right: bool) {
        self.failed |= !right;
        self.checks.push(format!("  {}  {what}", if right { "ok    " } else { "FAILED" }));
    }

    /// A count and its budget.
    pub fn within(&mut self, budgets: &Budgets, scenario: &str, count: f64) {
        let (is_within, what) = budgets.compare(scenario, count);
        self.check(what, is_within);
    }

    /// What is not compared here, and why. This is no failure.
    pub fn not_compared(&mut self, what: impl Display, why: impl Display) {
        self.checks.push(format!("  -       {what}: {why}"));
    }

    /// Prints the checks, writes the JSON file and gives the exit code: 1 if a check failed.
    pub fn finish(self, args: &Args) -> ExitCode {
        println!("\ncounts:");
        self.checks.iter().for_each(|line| println!("{line}"));
        if let Some(path) = &args.json {
            let numbers = if self.list.is_empty() { Value::Object(self.numbers) } else { json!(self.list) };
            let text = format!("{numbers:#}\n");
            if let Err(error) = std::fs::write(path, text) {
                eprintln!("cannot write {}: {error}; name another file", path.display());
                return ExitCode::from(2);
            }
        }
        ExitCode::from(u8::from(self.failed))
    }
}
