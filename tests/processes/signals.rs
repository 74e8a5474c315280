//! Ctrl-C, SIGTERM and SIGHUP at any moment, every other signal that ends a process by default, nohup, and Ctrl-Z.

use std::path::{Path, PathBuf};
use std::process;
use std::thread::sleep;

use fieldbeat::Master;
use fieldbeat::axis::{Command, Profile, StopCause};
use libc::{SIGCONT, SIGHUP, SIGINT, SIGTERM, SIGTSTP, SIGTTIN, SIGTTOU};
use serde_json::Value;

use super::support::{self, Ended, LONG, Machine, PROGRAM, Program, assert_sums, carried, drive};
use super::{MS, are_powered_off, assert_powered_off, await_status, master, online, serve};

/// A demo whose control socket is its own, so that its progress can be read.
struct Demo {
    directory: PathBuf,
    program: Program,
}

/// How far a demo is, at least.
#[derive(Clone, Copy, Debug)]
enum Stage {
    /// A signal ends it in order.
    Begun,
    /// It has chosen its period.
    Chosen,
    /// Its master runs.
    Running,
    /// A drive is there.
    SomeOnline,
    /// A drive is switched on.
    SomeEnabled,
    /// A LinMot is on its way to where it swings.
    SettingOut,
    /// One swings, and a Unidrive has felt its load.
    Swinging,
}

/// Its sockets are where nobody else has any; root looks below TMPDIR, too.
fn own<'a>(directory: &Path, command: &'a mut process::Command) -> &'a mut process::Command {
    command.env("XDG_RUNTIME_DIR", directory).env("XDG_STATE_HOME", directory).env("TMPDIR", directory)
}

/// It ended without a failure, or says that a busy host had starved it, or what the demo feeds its axes by: that alone;
/// or, if it was hurried, what of its drives has power still. Returns whether there is such a line.
#[track_caller]
fn expect_order(ended: &Ended, hurried: bool) -> bool {
    let is_known = |cause: &str| {
        ["stream underrun)", "setpoint too old)", "jog not renewed)"]
            .iter()
            .any(|known| cause.starts_with(known))
    };
    let last = ended.err.lines().last().and_then(|line| line.strip_prefix("fieldbeat: ")).unwrap_or_default();
    let fed = last.starts_with("stopped: ") && last.split('(').skip(1).all(is_known);
    let late = last.starts_with("lost on the way: ") || last.starts_with("not online: ");
    let left = hurried && last.starts_with("drive ") && last.contains(" at the end (");
    ended.expect(i32::from(fed || late || left));
    fed || late || left
}

impl Demo {
    /// A demo that is so far. One that a busy host starves ends before that, says so, and is followed by another one.
    fn at(stage: Stage, directory: PathBuf, drives: &str) -> Demo {
        for _ in 0..3 {
            let mut command = process::Command::new(PROGRAM);
            command.args(["demo", "--drives", drives, "--json", "--for", "2min"]);
            let program = Program::spawn(own(&directory, &mut command));
            let mut demo = Demo { directory: directory.clone(), program };
            if demo.reaches(stage) {
                return demo;
            }
            demo.ends();
        }
        panic!("no demo comes to {stage:?}")
    }

    /// The drives, once they can be listed.
    fn drives(&self) -> Vec<Value> {
        let mut status = process::Command::new(PROGRAM);
        let ended = Program::spawn(own(&self.directory, status.args(["status", "--json"]))).end();
        match ended.code {
            Some(0) => ended.json()["summary"]["drives"].as_array().unwrap().clone(),
            _ => Vec::new(),
        }
    }

    fn reaches(&mut self, stage: Stage) -> bool {
        self.program.await_handler(SIGTERM);
        let online = |drive: &Value| drive["link"] == "online";
        let position =
            |drive: &Value| drive["position"].as_f64().filter(|_| drive["protocol"] == "linudp-v2");
        let has_turned = |drive: &Value| {
            drive["protocol"] == "modbus-tcp" && drive["monitor"][0]["max"].as_f64() > Some(0.0)
        };
        let is_there = |drives: &[Value]| match stage {
            Stage::Begun | Stage::Chosen => true,
            Stage::Running => !drives.is_empty(),
            Stage::SomeOnline => drives.iter().any(online),
            Stage::SomeEnabled => drives.iter().any(|drive| drive["state"] == "OperationEnabled"),
            Stage::SettingOut => drives.iter().filter_map(position).any(|at| at > 20.0),
            Stage::Swinging => {
                drives.iter().filter_map(position).any(|at| at > 210.0) && drives.iter().any(has_turned)
            }
        };
        match stage {
            Stage::Begun => return true,
            Stage::Chosen => {
                self.program.await_text("fieldbeat: cycle of ");
                return true;
            }
            _ => {}
        }
        let mut reached = false;
        let done = support::until(LONG, || {
            reached = is_there(&self.drives());
            reached || !self.program.is_running()
        });
        assert!(done, "{stage:?}: {:?}", self.drives());
        reached
    }

    /// It ends in order, whatever it was doing.
    fn ends(self) {
        assert_powered_off(&self.ends_at_least(false));
    }

    /// The same, but that its drives may have power.
    fn ends_at_least(self, hurried: bool) -> Value {
        let ended = self.program.end();
        let failed = expect_order(&ended, hurried);
        let summary = ended.json();
        assert_sums(&summary);
        let mut complaints: Vec<&str> =
            ended.err.lines().filter_map(|line| line.strip_prefix("fieldbeat: ")).collect();
        complaints.truncate(complaints.len() - usize::from(failed));
        let usual = ["cycle of ", "not real-time: ", "not suspended: ", "device outputs: "];
        let is_usual = |line: &&str| usual.iter().any(|known| line.starts_with(known));
        assert!(complaints.iter().all(is_usual), "{}", ended.err);
        summary
    }
}

#[test]
fn a_signal_at_any_moment_ends_the_demo_in_order() {
    use Stage::*;
    let stages = [Begun, Chosen, Running, SomeOnline, SomeEnabled, Swinging];
    for (stage, signal) in stages.into_iter().zip([SIGINT, SIGTERM, SIGHUP].into_iter().cycle()) {
        let machine = Machine::new(129);
        let demo = Demo::at(stage, machine.path(""), "2");
        demo.program.signal(signal);
        demo.ends();
    }
}

/// Each of these ends a process by default: all are caught, and three are sent in mid-motion.
#[test]
fn every_signal_that_would_end_the_program_in_mid_motion_ends_it_in_order() {
    let sent = [libc::SIGQUIT, libc::SIGABRT, libc::SIGRTMAX()];
    let machine = Machine::new(231);
    std::thread::scope(|scope| {
        for signal in sent {
            let directory = machine.path(&signal.to_string());
            scope.spawn(move || {
                std::fs::create_dir(&directory).unwrap();
                let demo = Demo::at(Stage::SettingOut, directory, "1");
                for caught in [
                    libc::SIGALRM,
                    libc::SIGVTALRM,
                    libc::SIGPROF,
                    libc::SIGUSR2,
                    libc::SIGIO,
                    libc::SIGPWR,
                    libc::SIGSTKFLT,
                    libc::SIGXCPU,
                    libc::SIGRTMIN(),
                ] {
                    demo.program.await_handler(caught);
                }
                demo.program.signal(signal);
                demo.ends();
            });
        }
    });
}

/// Suspended, the process would leave its axes to themselves.
#[test]
fn a_master_in_mid_motion_is_not_suspended_from_its_terminal() {
    let machine = Machine::new(232);
    let mut demo = Demo::at(Stage::Swinging, machine.path(""), "2");
    for signal in [SIGTTIN, SIGTTOU, SIGTSTP] {
        demo.program.signal(signal);
    }
    demo.program.await_text("fieldbeat: not suspended: ");
    let executed = |demo: &Demo| {
        let drives = demo.drives();
        drives.first().and_then(|drive| drive["answered"].as_u64())
    };
    let before = executed(&demo);
    assert!(support::until(LONG, || executed(&demo) > before), "its cycle stands");
    demo.program.signal(SIGTERM);
    demo.ends();
}

#[test]
fn a_simulation_ends_by_any_signal_like_a_run() {
    let machine = Machine::new(233);
    let config = machine.plain(1);
    let mut sim = Program::start(["sim", config.to_str().unwrap()]);
    sim.await_text("listening");
    let ended = sim.end_by(libc::SIGQUIT);
    ended.expect(0);
    assert!(ended.out.contains("received, "), "{ended:?}");
}

#[test]
fn a_second_signal_shortens_the_waits_and_never_skips_the_stop() {
    // Whatever the second one finds: the first is hardly seen, or the axes ramp down.
    for (stage, between) in [(Stage::Begun, 0), (Stage::Swinging, 60)] {
        let are_off = || {
            let machine = Machine::new(132);
            let demo = Demo::at(stage, machine.path(""), "2");
            demo.program.signal(SIGINT);
            sleep(between * MS);
            demo.program.signal(SIGINT);
            are_powered_off(&demo.ends_at_least(true))
        };
        // 250 ms may be too little for drives of a busy host.
        assert!((0..3).any(|_| are_off()), "{stage:?}");
    }
}

/// A signal ends the wave, and the demo then ends the master: both ask for the same stop, which must not count as the
/// impatience of a second Ctrl-C. The ramp of 50 mm/s² from 200 mm/s takes 4 s and 400 mm; a hurried stop does not.
#[test]
fn ending_a_master_that_is_stopping_already_keeps_its_ramp() {
    let machine = Machine::new(1);
    let config = machine.config(
        "slow.toml",
        1,
        "",
        "stop = { deceleration = 50, timeout = \"30s\" }\nlimits = { position = [0, 2000] }\n\
         profile = { velocity = 200, acceleration = 2000 }\nsimulate = { start = 10 }",
    );
    let _sim = serve(&config);
    let master = Master::from_file(&config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d0").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    let profile = Profile { velocity: 200.0, acceleration: 2000.0, ..axis.profile() };
    let target = fieldbeat::axis::Target::Absolute(1900.0);
    axis.post(Command::Move(fieldbeat::axis::Move { target, profile })).unwrap();
    // It has its velocity after 10 mm. Where exchanges come late, the velocity is known less well than the position.
    assert!(support::until(LONG, || axis.feedback().status.position > 40.0), "{:?}", axis.feedback());
    let begin = axis.feedback().status.position;
    master.stop_handle().stop();
    assert!(support::until(LONG, || axis.feedback().stopped == Some(StopCause::Shutdown)));
    let run = master.finish();
    let end = run.end.drives[0].feedback;
    assert!(end.status.position - begin > 150.0, "{begin} mm -> {end:?}");
    assert!(!end.status.state.is_powered());
}

#[test]
fn a_run_that_waits_for_drives_can_be_ended() {
    let machine = Machine::new(6);
    let config = machine.plain(2);
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        let master = master(&config, &["--json"]);
        master.await_handler(signal);
        let ended = master.end_by(signal);
        ended.expect(0);
        assert_eq!(ended.err, "");
        assert_sums(&ended.json());
    }
}

#[test]
fn under_nohup_the_master_outlives_its_terminal() {
    let machine = Machine::new(7);
    let config = machine.plain(1);
    let sim = serve(&config);
    let mut command = process::Command::new(PROGRAM);
    // SAFETY: between fork and exec, one system call.
    unsafe {
        use std::os::unix::process::CommandExt;
        command.pre_exec(|| {
            libc::signal(SIGHUP, libc::SIG_IGN);
            Ok(())
        });
    }
    let mut master = Program::spawn(command.arg("run").arg(&config).arg("--json"));
    master.await_text("all drives online");
    let before = sim.stats()[0].received;
    master.signal(SIGHUP);
    assert!(support::until(LONG, || sim.stats()[0].received > before + 50), "it ended");
    master.end_by(SIGINT).expect(0);
}

/// Ctrl-Z, or a debugger: the grid goes on without the process, and every slot is accounted for. Neither the loop nor
/// its watch is to blame, although that does not wait as long; its guardian waits for longer, or is not there.
#[test]
fn a_master_that_was_stopped_counts_what_it_missed_and_is_not_stuck() {
    let machine = Machine::new(18);
    for (file, cycle, code) in [
        ("patient.toml", "max_skip = \"30s\"\nwatch_after = \"300ms\"\nguardian_after = \"60s\"", 0),
        ("strict.toml", "max_skip = \"1s\"\nguardian_after = \"off\"", 1),
    ] {
        let config = machine.config(file, 1, cycle, "");
        let _sim = serve(&config);
        let master = online(&config, &["--json"]);
        master.hold();
        sleep(1_500 * MS);
        master.signal(SIGCONT);
        // Each of the slots, but for those at both ends.
        let missed = 1_500_000_000 / carried() - 2;
        await_status(&config, |summary| summary["cycle"]["skipped"].as_u64() > Some(missed));
        let ended = master.end_by(SIGTERM);
        let summary = ended.expect(code).json();
        assert_sums(&summary);
        assert!(!ended.err.contains("stuck"), "{ended:?}");
        assert!(code != 0 || summary["failures"] == serde_json::json!([]), "{summary}");
        assert!(summary["cycle"]["overruns"].as_u64().unwrap() > 0);
        // The drive got no request meanwhile, so it cannot have missed anything.
        assert_eq!(
            (&drive(&summary, "d0")["link"], &drive(&summary, "d0")["losses"]),
            (&"online".into(), &0.into())
        );
        let last = ended.err.lines().last().unwrap();
        assert_eq!(last.starts_with("fieldbeat: stopped by an overrun: d0; "), code == 1, "{last}");
        // Skipped slots are late wake-ups, not omitted ones.
        assert!(summary["wake_ns"]["max"].as_u64().unwrap() > 500_000_000, "{summary}");
    }
}
