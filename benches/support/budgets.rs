//! `benches/budgets.csv`: what may be counted at most, one line a scenario, with the reason.
//!
//! A line that begins with `#` is a comment. The columns are those of [`COLUMNS`]; the reason is the last one and may
//! hold commas. What `--count` counts is written by `--count --write-budgets`; the rest by hand, since it follows from
//! the calls that a cycle has to make.

use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The header of the file.
const COLUMNS: &str = "scenario,today,budget,why";
/// What a count may grow by until somebody has to look, by what it ends with: the compiler always moves a few
/// instructions, and the linker a few addresses. All else holds exactly.
const MARGINS: [(&str, f64); 2] = [(INSTRUCTIONS, 1.03), (MISSES, 1.05)];
/// A count so far below its budget, as a share of it, hides the next increase.
const SLACK: f64 = 0.10;
/// The comment with the compiler and the profile that the instructions were counted with.
const COMPILER: &str = "# Instructions counted with ";

/// The file.
#[derive(Debug)]
pub struct Budgets {
    comments: Vec<String>,
    rows: Vec<Row>,
}

#[derive(Debug)]
struct Row {
    scenario: String,
    today: f64,
    budget: f64,
    why: String,
}

impl Budgets {
    /// Reads the file.
    ///
    /// # Errors
    ///
    /// The line that is wrong.
    pub fn read() -> Result<Budgets, String> {
        let path = path();
        let text = std::fs::read_to_string(&path)
            .map_err(|error| format!("cannot read {}: {error}", path.display()))?;
        let is_comment = |line: &&str| line.starts_with('#');
        let comments = text.lines().filter(is_comment).map(str::to_owned).collect();
        let mut lines = text.lines().enumerate().filter(|(_, line)| !is_comment(line));
        let wrong = |place: usize, line: &str| format!("{}:{}: {line:?}", path.display(), place + 1);
        match lines.next() {
            Some((_, COLUMNS)) => {}
            other => return Err(format!("{}: {other:?} is not {COLUMNS}", path.display())),
        }
        let rows = lines.map(|(place, line)| row(line).ok_or_else(|| wrong(place, line)));
        Ok(Budgets { comments, rows: rows.collect::<Result<_, _>>()? })
    }

    /// The budget of `scenario`.
    pub fn of(&self, scenario: &str) -> Option<f64> {
        Some(self.rows.iter().find(|row| row.scenario == scenario)?.budget)
    }

    /// Whether `count` is within the budget of `scenario`, and a line that says so. A scenario without a budget is not.
    pub fn compare(&self, scenario: &str, count: f64) -> (bool, String) {
        let Some(budget) = self.of(scenario) else {
            return (false, format!("{scenario}: {count} has no line in {}", path().display()));
        };
        let mut line = format!("{scenario}: {count} <= {budget}");
        if margin(scenario).is_some() && count < budget * (1.0 - SLACK) {
            let _ = write!(line, "; more than {:.0} % below: lower the budget", SLACK * 100.0);
        }
        (count <= budget, line)
    }

    /// The compiler that the instructions were counted with, if it is not this one.
    pub fn other_compiler(&self) -> Option<String> {
        let taken = self.comments.iter().find_map(|line| line.strip_prefix(COMPILER))?;
        let this = compiler().ok()?;
        (taken != this).then(|| format!("the budgets were taken with {taken}\nthis is            {this}"))
    }

    /// Enters what was counted today, and a budget: instructions and misses have a margin. The reason stays.
    pub fn enter(&mut self, scenario: &str, today: f64) {
        let budget = margin(scenario).map_or(today, |margin| (today * margin).ceil());
        match self.rows.iter_mut().find(|row| row.scenario == scenario) {
            Some(row) => (row.today, row.budget) = (today, budget),
            None => {
                let why = String::new();
                self.rows.push(Row { scenario: scenario.to_owned(), today, budget, why });
            }
        }
    }

    /// Drops the rows of `bench` that are counted no more. Those of sockets are written by hand.
    pub fn retain(&mut self, bench: &str, is_counted: impl Fn(&String) -> bool) {
        let (all, by_hand) = (format!("{bench}/"), format!("{bench}/sockets/"));
        self.rows.retain(|Row { scenario, .. }| {
            !scenario.starts_with(&all) || scenario.starts_with(&by_hand) || is_counted(scenario)
        });
    }

    /// Writes the file, with this compiler.
    ///
    /// # Errors
    ///
    /// It cannot be written, or rustc does not say which one it is.
    pub fn write(&self) -> Result<(), String> {
        let compiler = compiler().map_err(|error| format!("cannot run rustc -V: {error}"))?;
        let mut text = String::new();
        for line in &self.comments {
            let line = if line.starts_with(COMPILER) { &format!("{COMPILER}{compiler}") } else { line };
            let _ = writeln!(text, "{line}");
        }
        let _ = writeln!(text, "{COLUMNS}");
        for Row { scenario, today, budget, why } in &self.rows {
            let _ = writeln!(text, "{scenario},{today},{budget},{why}");
        }
        let path = path();
        std::fs::write(&path, text).map_err(|error| format!("cannot write {}: {error}", path.display()))
    }
}

/// What a row of instructions ends with: a drive and cycle.
pub const INSTRUCTIONS: &str = "instructions";
/// What a row of misses of the simulated first-level cache for data ends with: a drive and cycle.
pub const MISSES: &str = "first-level misses";
/// What a row of system calls ends with: a cycle of all drives.
pub const CALLS: &str = "system calls";
/// What a row of those of them ends with that a cycle makes on sockets whenever replies come.
pub const OWN_CALLS: &str = "own system calls";
/// The row of allocations and frees, of all cycles that were counted.
pub const ALLOCATIONS: &str = "all/allocations";
/// That of page faults of a loop whose memory is locked.
pub const PAGE_FAULTS: &str = "all/page faults";

fn margin(scenario: &str) -> Option<f64> {
    MARGINS.into_iter().find(|(what, _)| scenario.ends_with(what)).map(|(_, margin)| margin)
}

fn row(line: &str) -> Option<Row> {
    let mut columns = line.splitn(4, ',');
    let scenario = columns.next()?.to_owned();
    let mut number = || columns.next()?.parse().ok();
    Some(Row { scenario, today: number()?, budget: number()?, why: columns.next()?.to_owned() })
}

fn path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("budgets.csv")
}

/// What of a profile changes the code, and the header of what it says of one package.
const CODE_GENERATION: [&str; 5] = ["lto", "codegen-units", "opt-level", "panic", "[profile.release.package"];

/// The compiler, and what the profile of a release says of code generation.
fn compiler() -> io::Result<String> {
    let said = Command::new("rustc").arg("-V").output()?;
    let version = String::from_utf8_lossy(&said.stdout).trim().to_owned();
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("../Cargo.toml");
    let manifest = std::fs::read_to_string(manifest).unwrap_or_default();
    // Profiles that a bench is built with; `bench` inherits from `release`.
    let mut is_part = false;
    let is_part_of_profile = |line: &&str| {
        if line.starts_with('[') {
            is_part = line.starts_with("[profile.release") || line.starts_with("[profile.bench");
        }
        is_part && CODE_GENERATION.iter().any(|part| line.starts_with(part))
    };
    let profile: Vec<_> = manifest.lines().map(str::trim).filter(is_part_of_profile).collect();
    Ok(format!("{version}; {}", profile.join(" ")))
}
