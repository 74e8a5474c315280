//! The version of the program, with the commit that it is built from where there is a repository of it.

use std::path::Path;
use std::process::Command;

fn main() {
    let version = env!("CARGO_PKG_VERSION");
    println!("cargo::rerun-if-changed=build.rs");
    let shown = commit().map_or(version.to_owned(), |commit| format!("{version} ({commit})"));
    println!("cargo::rustc-env=FIELDBEAT_VERSION={shown}");
}

/// The answer of `git describe` for this checkout; `None`: it is none, or in the repository of somebody else.
fn commit() -> Option<String> {
    let git = |arguments: &[&str]| {
        let output =
            Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
        Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
    };
    let top = git(&["rev-parse", "--show-toplevel"])?;
    if Path::new(&top).join("crates/cli").canonicalize().ok()? != Path::new(".").canonicalize().ok()? {
        return None;
    }
    let head = git(&["rev-parse", "--git-path", "logs/HEAD"])?;
    for changes in [head.as_str(), "../../Cargo.lock", "../../crates", "../../src"] {
        println!("cargo::rerun-if-changed={changes}");
    }
    git(&["describe", "--always", "--dirty"])
}
