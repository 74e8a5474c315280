//! Ctrl-C, SIGTERM and SIGHUP at any moment, nohup, and Ctrl-Z.

use std::process::Command;
use std::thread::sleep;

use fieldbeat::axis::{Profile, StopCause, Verb};
use fieldbeat::master::Master;
use libc::{SIGCONT, SIGHUP, SIGINT, SIGSTOP, SIGTERM};

use super::support::{self, LONG, Machine, PROGRAM, Program, assert_sums, drive};
use super::{MS, assert_powered_off, demo, master, serve};

#[test]
fn a_signal_at_any_moment_ends_the_demo_in_order() {
    // Bring-up, enable, homing, the move to the start, the wave, the profile move, and the way down.
    let moments = [0, 50, 200, 500, 900, 1300, 1700, 2500, 4300, 4700, 5000];
    for (moment, signal) in moments.into_iter().zip([SIGINT, SIGTERM, SIGHUP].into_iter().cycle()) {
        let ended = demo(&["--for", "2s"], |program| {
            program.await_handler(signal);
            sleep(moment * MS);
            program.signal(signal);
        });
        assert_eq!((ended.code, ended.signal), (Some(0), None), "{moment} ms, signal {signal}: {ended:?}");
        assert_powered_off(&ended.json());
        assert_eq!(ended.err.matches("fieldbeat: ").count(), ended.err.matches("not real-time").count());
    }
}

#[test]
fn a_second_signal_shortens_the_waits_and_never_skips_the_stop() {
    for (first, between) in [(300, 0), (1500, 5), (2500, 60), (3000, 25)] {
        let ended = demo(&["--for", "3s"], |program| {
            program.await_handler(SIGINT);
            sleep(first * MS);
            program.signal(SIGINT);
            sleep(between * MS);
            program.signal(SIGINT);
        });
        ended.expect(0);
        assert_powered_off(&ended.json());
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
         profile = { velocity = 200, acceleration = 2000 }",
    );
    let _sim = serve(&config);
    let master = Master::from_file(&config).unwrap().start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axis = master.axis("d0").unwrap();
    axis.enable().unwrap();
    axis.home().unwrap();
    let profile = Profile { velocity: 200.0, acceleration: 2000.0, ..axis.profile() };
    let target = fieldbeat::axis::Target::Absolute(1900.0);
    axis.post(Verb::Move(fieldbeat::axis::Move { target, profile })).unwrap();
    assert!(support::until(LONG, || axis.feedback().velocity > 150.0), "{:?}", axis.feedback());
    master.stop_handle().stop();
    assert!(support::until(LONG, || axis.feedback().stopped == Some(StopCause::Shutdown)));
    let begin = axis.feedback().position;
    let run = master.finish();
    let end = run.end.drives[0].feedback;
    assert!(end.position - begin > 150.0, "{begin} mm -> {end:?}");
    assert!(!end.state.is_powered());
}

#[test]
fn a_run_that_waits_for_drives_can_be_ended() {
    let machine = Machine::new(6);
    let config = machine.plain(2);
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        let master = master(&config, &["--json"]);
        master.await_handler(signal);
        sleep(300 * MS);
        master.signal(signal);
        let ended = master.end();
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
    let mut command = Command::new(PROGRAM);
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
    assert!(support::until(LONG, || sim.stats()[0].received > before + 500), "it ended");
    master.signal(SIGINT);
    master.end().expect(0);
}

/// Ctrl-Z, or a debugger: the grid goes on without the process, and every slot is accounted for.
#[test]
fn a_master_that_was_stopped_counts_what_it_missed() {
    let machine = Machine::new(18);
    for (file, max_skip, code) in [("patient.toml", 100_000, 0), ("strict.toml", 100, 1)] {
        let config = machine.config(file, 1, &format!("max_skip = {max_skip}"), "");
        let _sim = serve(&config);
        let mut master = master(&config, &["--for", "3s", "--json"]);
        master.await_text("all drives online");
        master.signal(SIGSTOP);
        sleep(800 * MS);
        master.signal(SIGCONT);
        let ended = master.end();
        ended.expect(code);
        let summary = ended.json();
        assert_sums(&summary);
        assert!(summary["cycle"]["skipped"].as_u64().unwrap() > 300, "{summary}");
        assert!(summary["cycle"]["overruns"].as_u64().unwrap() > 0);
        // The drive was not asked meanwhile, so it cannot have missed anything.
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
