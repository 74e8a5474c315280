//! The built program as a user runs it: its own processes, real UDP sockets on loopback, signals, and all the ways to
//! hold it wrong. Nothing here needs a privilege, and nothing asserts how fast anything is: the period is one that this
//! host carries, tolerances are seconds, and a test waits for what it needs.
//!
//! Each test owns 127.x.n.0/24, by the number n of its machine, which is unique in all of these files.

mod axis;
mod churn;
mod deaths;
mod doctor;
#[path = "../support/fuse.rs"]
mod fuse;
mod guardian;
mod hosts;
mod init;
mod jog;
mod least;
mod links;
mod linmot;
mod masters;
mod metrics;
mod mistakes;
mod operate;
mod params;
mod program;
mod recordings;
mod replay;
mod report;
mod reporting;
mod rights;
mod scans;
mod service;
mod signals;
mod soak;
mod stuck;
#[path = "../support/mod.rs"]
mod support;
mod unmatched;
mod wires;

use std::ffi::OsStr;
use std::net::{SocketAddrV4, UdpSocket};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use fieldbeat::sim::server::SimServer;
use serde_json::Value;
use support::{
    Ended, LONG, Machine, PROGRAM, Program, UNJUDGED, assert_sums, bound, period, served, simulated, until,
};

const MS: Duration = Duration::from_millis(1);

/// `command` with at most so much of a resource.
fn limit(command: &mut Command, resource: libc::__rlimit_resource_t, most: u64) -> &mut Command {
    // SAFETY: between fork and exec, system calls only.
    unsafe {
        command.pre_exec(move || {
            let limit = libc::rlimit { rlim_cur: most, rlim_max: most };
            match libc::setrlimit(resource, &limit) {
                0 => Ok(()),
                _ => Err(std::io::Error::last_os_error()),
            }
        })
    }
}

/// `command` on a disk that is full: none of its files may grow beyond so many bytes.
fn limit_files(command: &mut Command, bytes: u64) -> &mut Command {
    limit(command, libc::RLIMIT_FSIZE, bytes)
}

/// `[cycle]` of a machine that is patient with a busy host.
fn patient_cycle() -> String {
    format!(
        "[cycle]\nperiod = \"{}\"\nreceive_deadline = 0.8\nmax_skip = \"30s\"\nmax_skip_rate = 1.0\n\
         {UNJUDGED}realtime = \"off\"\n",
        period()
    )
}

fn serve(config: &std::path::Path) -> SimServer {
    served(|| simulated(config))
}

/// A machine with its configuration, and so many drives that are there.
fn with_drives(test: u8, drives: usize) -> (Machine, PathBuf, SimServer) {
    let machine = Machine::new(test);
    let config = machine.plain(drives);
    let sim = serve(&config);
    (machine, config, sim)
}

fn master(config: &std::path::Path, arguments: &[&str]) -> Program {
    let own = [OsStr::new("run"), config.as_os_str()];
    Program::start(own.into_iter().chain(arguments.iter().map(OsStr::new)))
}

/// A master whose drives are online.
#[track_caller]
fn online(config: &std::path::Path, arguments: &[&str]) -> Program {
    let mut master = master(config, arguments);
    master.await_text("all drives online");
    master
}

/// Ends a run that has not failed. Its summary, whose sums are right.
#[track_caller]
fn finish(master: Program) -> Value {
    master.signal(libc::SIGTERM);
    let summary = master.end().expect(0).json();
    assert_sums(&summary);
    summary
}

/// `fieldbeat WHAT CONFIG REST` under way; words of `what` and `rest` are separated by spaces.
fn asking(what: &str, config: &std::path::Path, rest: &str) -> Program {
    Program::start(
        what.split(' ')
            .map(OsStr::new)
            .chain([config.as_os_str()])
            .chain(rest.split_whitespace().map(OsStr::new)),
    )
}

/// The same to its end.
fn ask(what: &str, config: &std::path::Path, rest: &str) -> Ended {
    asking(what, config, rest).end()
}

fn simulation(config: &std::path::Path) -> Program {
    let mut program = Program::spawn(Command::new(PROGRAM).arg("sim").arg(config));
    program.await_text("listening");
    program
}

/// A run that has failed by the drives that it has left powered, moving or unknown, and says `parts`.
#[track_caller]
fn assert_left(ended: &Ended, parts: &[&str]) {
    ended.expect(1);
    for part in parts {
        assert!(ended.err.contains(part), "no \"{part}\": {}", ended.err);
    }
}

/// Waits until the master of `config` runs and `done` holds for its summary.
#[track_caller]
fn await_status(config: &std::path::Path, done: impl Fn(&Value) -> bool) {
    let mut last = None;
    let mut done = || {
        let ended = ask("status", config, "--json");
        let answered = ended.code == Some(0) && done(&ended.json()["summary"]);
        last = Some(ended);
        answered
    };
    assert!(until(LONG, &mut done), "{last:?}");
}

/// Waits until all of its drives are online.
#[track_caller]
fn await_online(config: &std::path::Path) {
    await_status(config, |summary| {
        summary["drives"].as_array().is_some_and(|all| all.iter().all(|drive| drive["link"] == "online"))
    });
}

/// Waits until all drives of a master have answered for a while, and ends it.
#[track_caller]
fn end_once_online(mut master: Program) -> Ended {
    master.await_text("all drives online");
    master.end_by(libc::SIGINT)
}

/// Ends a master once each of its drives has answered so often that a plot shows a curve of it, and all are compared.
#[track_caller]
fn end_once_measured(master: Program, config: &std::path::Path) -> Ended {
    await_status(config, |summary| {
        let drives = summary["drives"].as_array();
        drives.is_some_and(|all| all.iter().all(|drive| drive["rtt_ns"]["count"].as_u64() > Some(40)))
    });
    master.end_by(libc::SIGINT)
}

fn assert_powered_off(summary: &Value) {
    assert!(are_powered_off(summary), "{summary}");
}

fn are_powered_off(summary: &Value) -> bool {
    summary["drives"].as_array().unwrap().iter().all(|drive| {
        let state = drive["state"].as_str().unwrap();
        let off = ["NotReadyToSwitchOn", "SwitchOnDisabled", "ReadyToSwitchOn"];
        // Unknown: ended before it was online, so that the drive never got a request.
        let on_its_way = ["unseen", "qualifying"].contains(&drive["link"].as_str().unwrap());
        let never_asked = state == "Unknown" && on_its_way && drive["losses"] == 0;
        off.contains(&state) || never_asked
    })
}

fn socket(address: SocketAddrV4) -> UdpSocket {
    bound(|| UdpSocket::bind(address))
}

/// Nothing was sent to the drive whose socket this is.
#[track_caller]
fn assert_silent(drive: &UdpSocket) {
    drive.set_nonblocking(true).unwrap();
    let got = drive.recv_from(&mut [0; 64]);
    assert!(got.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock), "{got:?}");
}
