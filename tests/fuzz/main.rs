//! Driver A of the fuzz targets: replays every file of `corpus/`, then runs each target on random inputs for a moment.
//!
//! A corpus file is an input that was worth keeping; one with a name tells the story of a defect. The random inputs are
//! made from a seed, half of them by changing files of the corpus. More of them, or others:
//!
//! ```text
//! FIELDBEAT_FUZZ_SEED=7 FIELDBEAT_FUZZ_RUNS=100000 cargo test --release --test fuzz channel
//! ```
//!
//! What fails is written to a file, whose place is printed; in the corpus, under a name, it is a test from then on.

mod targets;

use std::any::Any;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};

type Target = fn(&[u8]);

#[test]
fn telegram() {
    fuzz("telegram", targets::telegram, 40_000, 80);
}

#[test]
fn modbus_wire() {
    fuzz("modbus_wire", targets::modbus_wire, 20_000, 300);
}

#[test]
fn modbus() {
    fuzz("modbus", targets::modbus, 1_500, 400);
}

#[test]
fn ethercat_wire() {
    fuzz("ethercat_wire", targets::ethercat_wire, 20_000, 300);
}

#[test]
fn ethercat_mailbox() {
    fuzz("ethercat_mailbox", targets::ethercat_mailbox, 1_500, 600);
}

#[test]
fn ethercat_sii() {
    fuzz("ethercat_sii", targets::ethercat_sii, 1_500, 600);
}

#[test]
fn ethercat() {
    fuzz("ethercat", targets::ethercat, 150, 400);
}

#[test]
fn ethernet_ip_wire() {
    fuzz("ethernet_ip_wire", targets::ethernet_ip_wire, 20_000, 200);
}

#[test]
fn profibus_wire() {
    fuzz("profibus_wire", targets::profibus_wire, 20_000, 260);
}

#[test]
fn channel() {
    fuzz("channel", targets::channel, 400, 400);
}

#[test]
fn files() {
    fuzz("files", targets::files, 2_000, 1_500);
}

#[test]
fn recording() {
    fuzz("recording", targets::recording, 300, 60);
}

#[test]
fn capture() {
    fuzz("capture", targets::capture, 3_000, 2_000);
}

#[test]
fn config() {
    fuzz("config", targets::config, 150, 4_000);
}

#[test]
fn config_keys() {
    fuzz("config_keys", targets::config_keys, 60, 100);
}

#[test]
fn machine() {
    fuzz("machine", targets::machine, 100, 300);
}

/// All files of the corpus, and so many random inputs of at most `longest` bytes.
fn fuzz(name: &str, target: Target, runs: u32, longest: usize) {
    let corpus = corpus(name);
    assert!(!corpus.is_empty(), "{name} has no corpus");
    for (path, bytes) in &corpus {
        attempt(target, bytes, || path.display().to_string());
    }
    let seed = setting("FIELDBEAT_FUZZ_SEED").unwrap_or(1);
    let runs = setting("FIELDBEAT_FUZZ_RUNS").unwrap_or(runs.into());
    let mut random = fastrand::Rng::with_seed(seed);
    for run in 0..runs {
        let bytes = input(&mut random, &corpus, longest);
        attempt(target, &bytes, || {
            let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{name}-{seed}-{run}"));
            let kept = fs::write(&path, &bytes)
                .map_or_else(|error| error.to_string(), |()| path.display().to_string());
            format!("seed {seed}, run {run}; the input: {kept}: {bytes:?}")
        });
    }
}

/// Runs the target, and says which input it was that failed.
fn attempt(target: Target, bytes: &[u8], which: impl FnOnce() -> String) {
    let result: Result<(), Box<dyn Any + Send>> = catch_unwind(AssertUnwindSafe(|| target(bytes)));
    if let Err(panic) = result {
        eprintln!("failed on {}", which());
        resume_unwind(panic);
    }
}

fn corpus(name: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus").join(name);
    let files = fs::read_dir(&directory).unwrap_or_else(|error| panic!("{}: {error}", directory.display()));
    let mut paths: Vec<PathBuf> = files.map(|file| file.unwrap().path()).collect();
    // The order of a directory is nobody's.
    paths.sort();
    paths.into_iter().map(|path| (path.clone(), fs::read(path).unwrap())).collect()
}

fn setting(name: &str) -> Option<u64> {
    std::env::var(name)
        .ok()
        .map(|value| value.parse().unwrap_or_else(|_| panic!("{name}: no number: {value}")))
}

/// Random bytes, or a file of the corpus with a few things changed.
fn input(random: &mut fastrand::Rng, corpus: &[(PathBuf, Vec<u8>)], longest: usize) -> Vec<u8> {
    if random.bool() {
        let mut bytes = vec![0; random.usize(..=longest)];
        random.fill(&mut bytes);
        return bytes;
    }
    let any = |random: &mut fastrand::Rng| corpus[random.usize(..corpus.len())].1.as_slice();
    let mut bytes = any(random).to_vec();
    for _ in 0..random.u8(1..6) {
        let at = random.usize(..=bytes.len());
        match random.u8(..5) {
            0 => bytes.insert(at, random.u8(..)),
            1 => bytes.truncate(at),
            2 => bytes.extend_from_slice(any(random)),
            3 => drop(bytes.drain(at.saturating_sub(random.usize(..8))..at)),
            _ => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = random.u8(..);
                }
            }
        }
        bytes.truncate(longest);
    }
    bytes
}
