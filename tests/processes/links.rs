//! Drives that are lost, come back, or were never there.

use std::time::Duration;

use fieldbeat::Master;
use libc::{SIGCONT, SIGINT, SIGTERM};

use super::support::{Machine, assert_sums, drive, most_probes};
use super::{await_online, await_status, master, online, report, serve, simulation};

#[test]
fn a_run_with_a_lost_drive_has_failed_and_names_it() {
    let machine = Machine::new(4);
    // A second of silence for d0, ten seconds for d1.
    let config = machine.config("m.toml", 2, "", Machine::LOST_SOON);
    let text = std::fs::read_to_string(&config).unwrap();
    let text = text.replace("name = \"d1\"", "name = \"d1\"\nhealth.bucket = \"10s\"");
    machine.write("m.toml", &text);
    // Only d0 is killed: each has its own simulation.
    let one = machine.config("one.toml", 1, "", "");
    let (head, first) = text.split_once("[[bus.drive]]").unwrap();
    let second = first.split_once("[[bus.drive]]").unwrap().1;
    let other = machine.write("other.toml", format!("{head}[[bus.drive]]{second}"));
    let (victim, _survivor) = (simulation(&one), simulation(&other));
    let mut master = online(&config, &["--json"]);
    victim.kill();
    master.await_text("drive d0: lost");
    let _again = simulation(&one);
    master.await_text("drive d0: back online");
    let ended = master.end_by(SIGTERM);
    let last = ended.expect(1).err.lines().last().unwrap();
    assert!(
        last.starts_with("fieldbeat: lost on the way: d0 (its replies have ended, or were lost: "),
        "{}",
        ended.err
    );
    let summary = ended.json();
    assert_sums(&summary);
    assert!(drive(&summary, "d0")["losses"].as_u64() >= Some(1), "{summary}");
    assert_eq!(drive(&summary, "d0")["stopped"], "link lost");
    assert_eq!(
        (&drive(&summary, "d1")["losses"], &drive(&summary, "d1")["link"]),
        (&0.into(), &"online".into())
    );
}

#[test]
fn without_drives_a_run_fails_and_names_them_in_its_report_too() {
    let machine = Machine::new(5);
    let config = machine.plain(2);
    let place = machine.path("report");
    let ended = master(&config, &["--for", "500ms", "--json", "--report", place.to_str().unwrap()]).end();
    let said = ended.expect(1).err_but_host();
    let why = "not online: d0, d1";
    assert!(
        said.starts_with(&format!("fieldbeat: {why} (nothing has ever come from it: look at ")),
        "{said}"
    );
    assert_eq!(said.lines().count(), 1, "{said}");
    let summary = ended.json();
    assert_sums(&summary);
    for name in ["d0", "d1"] {
        let drive = drive(&summary, name);
        assert_eq!((&drive["link"], &drive["answered"]), (&"unseen".into(), &0.into()));
        assert!(drive["rtt_ns"]["p50"].is_null() && drive["rtt_ns"]["max"].is_null(), "{drive}");
        // Probes, not one request in each of the cycles.
        assert!((1..=most_probes(&summary)).contains(&drive["sent"].as_u64().unwrap()), "{summary}");
    }
    assert!(report::texts(&report::read(&place, "index.html")).iter().any(|text| text == why));
}

#[test]
fn a_run_and_a_program_that_waits_name_the_same_remedy_for_replies_that_are_late() {
    let machine = Machine::new(185);
    let late = "simulate = { delay = 1.0, delay_by = \"50ms\" }";
    let config = machine.config("late.toml", 1, "", late);
    let _sim = serve(&config);
    let ended = master(&config, &["--for", "1s"]).end();
    let said = ended.expect(1).err_but_host();
    let why = said.trim_end().strip_prefix("fieldbeat: not online: ").unwrap_or_else(|| panic!("{said}"));
    assert!(why.starts_with("d0 (its replies come too late: raise reply_within, "), "{why}");
    let own = Master::from_file(&config).unwrap().start().unwrap();
    let error = own.wait_online(Duration::from_secs(1)).unwrap_err();
    assert_eq!(error.to_string(), format!("not online after 1s: {why}"));
}

/// Nobody else is there to take them: what `run` gets and shows is not lost.
#[test]
fn events_are_taken_by_the_run_and_none_counts_as_lost() {
    let machine = Machine::new(237);
    let few = format!("{}\nevent_queue = 8", Machine::LOST_SOON);
    let config = machine.config("few.toml", 1, "", &few);
    let sim = simulation(&config);
    let master = online(&config, &["--json"]);
    for time in 1..=3 {
        sim.hold();
        await_status(&config, |summary| drive(summary, "d0")["losses"] == time);
        sim.signal(SIGCONT);
        await_online(&config);
    }
    let ended = master.end_by(SIGINT);
    // It lost a drive.
    let summary = ended.expect(1).json();
    assert_eq!(summary["realtime"]["events_lost"], 0, "{summary}");
}
