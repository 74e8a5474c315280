//! The count of system calls, proved by strace.

use std::io;
use std::process::{Command, Stdio};
use std::sync::Arc;

use fieldbeat::Wait;
use fieldbeat::time::MS;
use fieldbeat_core::rt::Granted;

use super::counted::{DRIVES_OF_64, TERMINALS_OF_64};
use super::sockets::{MOONS_DUEL, TOGETHER};
use crate::support::counted::CountedNet;
use crate::support::fleet::{Fleet, Side};
use crate::support::rig::{self, Calls, Pace, Rig};
use crate::support::{Report, lenze};

/// Cycles that strace looks at.
const TRACED_CYCLES: u64 = 50;

/// This variable of the environment makes the program the child that strace looks at, with these drives.
pub const TRACED: &str = "FIELDBEAT_BENCH_TRACED_DRIVES";

/// Runs the loop in a child under strace and compares the counts of system calls.
pub fn strace(granted: &Granted, quick: bool, report: &mut Report) {
    println!("\nthe count of system calls, proved by strace over {TRACED_CYCLES} cycles");
    let drives: &[usize] = if quick { &[8] } else { &[1, 8, 64, 256] };
    let fleets = drives.iter().map(|count| (format!("{count} drives"), Fleet::linmots(*count)));
    let others = [
        ("one Unidrive", Fleet::unidrives(1)),
        ("LinMots and Unidrives together", TOGETHER),
        ("a segment of one", Fleet::segment(1)),
        ("a segment with terminals", Fleet::with_terminals(DRIVES_OF_64, TERMINALS_OF_64)),
        ("32 MOONS' drives", Fleet::moons(MOONS_DUEL)),
        ("a wire", Fleet::lenzes(lenze::A_WIRE)),
    ];
    for (what, fleet) in fleets.chain(others.map(|(what, fleet)| (what.to_owned(), fleet))) {
        match strace_of(granted, fleet) {
            Ok((counted, seen)) => {
                println!("  {what}: counted {counted}, strace saw {seen}");
                report.check(format!("{what}: strace sees as many calls as were counted"), counted == seen);
            }
            Err(why) => println!("  {what}: not proved: {why}"),
        }
    }
}

fn strace_of(granted: &Granted, fleet: Fleet) -> Result<(u64, u64), String> {
    // The drives live in this process: only the loop is traced.
    let _server = rig::serve(fleet.simulate(Side::Ours), granted);
    let directory = std::env::temp_dir().join(format!("fieldbeat-scale-{}", std::process::id()));
    std::fs::create_dir_all(&directory).map_err(|error| error.to_string())?;
    let result = strace_into(&directory, fleet);
    // Nothing depends on its removal.
    let _ = std::fs::remove_dir_all(&directory);
    result
}

fn strace_into(directory: &std::path::Path, fleet: Fleet) -> Result<(u64, u64), String> {
    let own = std::env::current_exe().map_err(|error| error.to_string())?;
    let output = Command::new("strace")
        .args(["-ff", "-e", "signal=none", "-o"])
        .arg(directory.join("calls"))
        .arg(own)
        .env(TRACED, fleet.to_string())
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
pub fn traced(fleet: Fleet) {
    let counted = Calls::default();
    let carriers = CountedNet::new(&counted);
    let calls = rig::on_loop_thread(|_| {
        // Under strace a call takes some 50 us. A segment and a wire have to be brought up.
        let period_ns = if fleet.segment + fleet.lenzes > 0 { 4 * MS } else { 20 * MS };
        let cycle = rig::exchange_cycle(period_ns, Wait::Poll);
        let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), Pace::Grid, &carriers, Arc::clone(&counted));
        rig.enable();
        let _ = std::os::unix::process::parent_id();
        let calls: u64 = (0..TRACED_CYCLES).map(|_| rig.turn(|_| {}).calls.made).sum();
        let _ = std::os::unix::process::parent_id();
        calls
    });
    println!("{}", calls.unwrap_or_else(|error| rig::give_up(error)));
}
