//! A peer that takes commands by lines, and one that is a package of its own.

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use crossbeam_channel::{Receiver, unbounded};

use crate::support::{LONG, checkout};

/// Builds the program of `tests/peers/NAME`, a package of its own, unless that was done already.
pub fn package(name: &str) -> PathBuf {
    let target = checkout("target/peers").join(name);
    let mut cargo = Command::new(std::env::var("CARGO").unwrap_or_else(|_| "cargo".into()));
    cargo.args(["build", "--quiet", "--release", "--locked", "--manifest-path"]);
    cargo.arg(checkout("tests/peers").join(name).join("Cargo.toml")).env("CARGO_TARGET_DIR", &target);
    let output = cargo.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    target.join(format!("release/{name}-peer"))
}

/// A program that answers lines by lines. Dropped = killed.
pub struct Peer {
    child: Child,
    lines: Receiver<String>,
    errors: PathBuf,
}

impl Peer {
    /// Starts it, and waits until it says that it is ready. Its standard error goes to this file.
    pub fn start(mut program: Command, errors: PathBuf) -> Peer {
        let file = File::create(&errors).unwrap();
        program.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(file);
        let mut child =
            program.spawn().unwrap_or_else(|error| panic!("{program:?}: {error}; .ci/run installs it"));
        let (tell, lines) = unbounded();
        let out = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            out.lines().map_while(Result::ok).take_while(|line| tell.send(line.clone()).is_ok()).count()
        });
        let peer = Peer { child, lines, errors };
        assert_eq!(peer.hear("its start"), "ready");
        peer
    }

    fn hear(&self, what: &str) -> String {
        let errors = || std::fs::read_to_string(&self.errors).unwrap_or_default();
        self.lines.recv_timeout(LONG).unwrap_or_else(|error| panic!("{what}: {error}\n{}", errors()))
    }

    /// Its answer to a line.
    pub fn ask(&mut self, line: &str) -> String {
        writeln!(self.child.stdin.as_mut().unwrap(), "{line}").unwrap();
        self.hear(line)
    }

    /// The numbers that it answers with.
    pub fn numbers(&mut self, line: &str) -> Vec<u64> {
        self.parsed(line)
    }

    /// The same, of either sign.
    pub fn integers(&mut self, line: &str) -> Vec<i64> {
        self.parsed(line)
    }

    fn parsed<N: std::str::FromStr>(&mut self, line: &str) -> Vec<N> {
        let answer = self.ask(line);
        let numbers = answer.strip_prefix("ok").unwrap_or_else(|| panic!("{line}: {answer}"));
        let parse = |number: &str| number.parse().unwrap_or_else(|_| panic!("{line}: {answer}"));
        numbers.split_whitespace().map(parse).collect()
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
