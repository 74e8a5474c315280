//! What all benches share.
//!
//! | file | what |
//! |---|---|
//! | `mod` | arguments, turns, budgets, the JSON file, stolen time |
//! | `stats` | quantiles, and ratios with bootstrap intervals |
//! | `rig` | the loop driven by hand on a real-time thread |
//! | `fleet`, `unidrive`, `line` | the drives it runs; a Unidrive, and a line of Kollmorgen drives, that answer from memory |
//! | `bare` | the bare loop that it is measured against, and the loop in turns with a rival |
//! | `libmodbus` | a client over libmodbus that takes turns with the loop |
//! | `null`, `counted` | carriers without a network; those of the operating system, counting system calls |
//!
//! Absolute times say little on a shared machine. So each contender runs in short slices, in turns with its rivals, on
//! the same core, priority and grid; what is judged is the ratio, with an interval that comes from the slices.

pub mod bare;
pub mod counted;
pub mod fleet;
pub mod libmodbus;
pub mod line;
pub mod null;
pub mod rig;
pub mod stats;
pub mod unidrive;

use std::fmt::Display;
use std::path::PathBuf;
use std::process::ExitCode;

use fieldbeat::rt::host;
use serde_json::{Map, Value, json};

use stats::Interval;

/// The command line of a bench.
#[derive(Debug)]
pub struct Args {
    /// Short slices and few of them: a look, not a verdict.
    pub quick: bool,
    /// Where the numbers go.
    json: Option<PathBuf>,
}

impl Args {
    /// Reads the command line of the bench `name`; says what is allowed and ends the program if it is something else.
    ///
    /// A plain word chooses benches by a part of their name, as in `cargo bench jitter`: the others end at once.
    pub fn parse(name: &str) -> Args {
        let mut args = Args { quick: false, json: None };
        let mut chosen = None;
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            match word.as_str() {
                // From cargo.
                "--bench" => {}
                "--quick" => args.quick = true,
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
    eprintln!("{mistake}; usage: cargo bench [NAME] -- [--quick] [--json FILE]");
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

/// `numbers` of one bench, and what is held against its budgets.
#[derive(Debug, Default)]
pub struct Report {
    numbers: Map<String, Value>,
    list: Vec<Value>,
    verdicts: Vec<String>,
    missed: bool,
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

    /// A time or a ratio of times: missed only if the whole interval is beyond the budget.
    pub fn time(&mut self, what: impl Display, interval: Option<Interval>, budget: f64, unit: &str) {
        let Some(Interval { value, low, high }) = interval else {
            return self.verdicts.push(format!("  unmeasured  {what} <= {budget} {unit}"));
        };
        let word = match () {
            () if low > budget => "MISSED    ",
            () if high > budget => "undecided ",
            () => "kept      ",
        };
        self.missed |= low > budget;
        self.verdicts.push(format!("  {word}  {what} <= {budget} {unit}: {value:.3} [{low:.3}, {high:.3}]"));
    }

    /// A count: missed if it is wrong.
    pub fn count(&mut self, what: impl Display, kept: bool) {
        self.missed |= !kept;
        self.verdicts.push(format!("  {}  {what}", if kept { "kept      " } else { "MISSED    " }));
    }

    /// Prints the verdicts, writes the JSON file and gives the exit code: 1 if a budget was missed.
    pub fn finish(self, args: &Args) -> ExitCode {
        println!("\nbudgets (a time is missed only if its whole interval is beyond):");
        self.verdicts.iter().for_each(|line| println!("{line}"));
        if let Some(path) = &args.json {
            let numbers = if self.list.is_empty() { Value::Object(self.numbers) } else { json!(self.list) };
            let text = format!("{numbers:#}\n");
            if let Err(error) = std::fs::write(path, text) {
                eprintln!("cannot write {}: {error}; name another file", path.display());
                return ExitCode::from(2);
            }
        }
        ExitCode::from(u8::from(self.missed))
    }
}
