//! Recordings: of a run that ends, of one that is killed, on a disk that is full, and of what is newest; and what
//! `export` makes of them.

use std::path::Path;
use std::process::Command;

use fieldbeat_record::recording::reading::{Entry, Reading, Wrong};
use libc::{SIGINT, SIGUSR1};
use serde_json::Value;

use super::support::{LONG, Machine, PROGRAM, Program, drive, run, until};
use super::{await_status, end_once_measured, finish, limit_files, master, serve, with_drives};

/// All that can be read, and what is wrong with the rest.
pub fn read(path: &Path) -> (Vec<Entry>, Option<Wrong>) {
    let mut wrong = None;
    let entries = Reading::open(path).unwrap().map_while(|entry| entry.map_err(|why| wrong = Some(why)).ok());
    (entries.collect(), wrong)
}

pub fn count(entries: &[Entry], topic: &str) -> u64 {
    entries.iter().filter(|entry| entry.topic.name == topic).count() as u64
}

#[test]
fn a_recording_has_every_executed_cycle_and_what_is_native_of_chosen_drives_and_is_exported() {
    let machine = Machine::new(140);
    let config = machine.plain(3);
    let path = machine.path("run.mcap");
    let file = path.to_str().unwrap();
    // Before anything is sent, and without a file that would be in the way of the next start.
    let wrong = master(&config, &["--record", file, "--record-native", "d0,q"]).end();
    wrong.refused(&[
        "there is no drive \"q\" whose native process data could be recorded; name all, or some of: d0, d1, \
         d2",
    ]);
    assert!(!path.exists());
    master(&config, &["--record-native", "d0"]).end().refused(&["--record <FILE>"]);

    let _sim = serve(&config);
    let arguments = ["--json", "--record", file, "--record-native", "d0", "--record-native", "d2,d0"];
    let ended = end_once_measured(master(&config, &arguments), &config);
    let summary = ended.expect(0).json();
    let [recorded] = &summary["recordings"].as_array().unwrap()[..] else { panic!("{summary}") };
    assert_eq!((&recorded["lost"], &recorded["error"]), (&0.into(), &Value::Null));
    let (entries, wrong) = read(&path);
    assert!(wrong.is_none(), "{wrong:?}");
    assert_eq!(recorded["messages"], entries.len() as u64);
    let executed = summary["cycle"]["executed"].as_u64().unwrap();
    for topic in ["/axes/d0", "/axes/d1", "/cycle"] {
        assert_eq!(count(&entries, topic), executed, "{topic}");
    }
    assert_eq!(summary["late"]["count"], count(&entries, "/late"));
    for (name, is_chosen) in [("d0", true), ("d1", false), ("d2", true)] {
        let topic = format!("/axes/{name}/native");
        let of = entries.iter().filter(|entry| entry.topic.name == topic);
        let has = |field: &str| of.clone().filter(|entry| !entry.text(field).is_empty()).count() as u64;
        let end = drive(&summary, name);
        let [sent, answered, behind] = [&end["sent"], &end["answered"], &end["protocol_counters"]["behind"]]
            .map(|count| if is_chosen { count.as_u64().unwrap() } else { 0 });
        // A reply that is behind may come in the cycle of a newer one, which is recorded.
        let [outputs, inputs, words] = ["outputs", "inputs", "in_status_word"].map(has);
        assert_eq!((outputs, inputs), (sent, words), "{name}");
        assert!((answered - behind..=answered).contains(&inputs), "{name}: {inputs} of {answered}, {behind}");
    }

    run(["export", file, "--csv"]).expect(0);
    let tables = machine.path("run");
    let table = std::fs::read_to_string(tables.join("axes_d0.csv")).unwrap();
    assert_eq!(table.lines().count() as u64, executed + 1);
    let table = std::fs::read_to_string(tables.join("axes_d2_native.csv")).unwrap();
    assert_eq!(table.lines().count() as u64, count(&entries, "/axes/d2/native") + 1);
    let wide = run(["export", file, "--csv", "-"]).expect(0).out.clone();
    assert_eq!(wide.lines().count() as u64, executed + 1);
    assert!(wide.starts_with("time [s],cycle,d0.position [mm],"), "{wide}");
    let bare = machine.path("bare");
    std::fs::copy(file, &bare).unwrap();
    run(["export", bare.to_str().unwrap(), "--csv"]).refused(&["has no extension", "--csv DIR"]);
    // What is there is never replaced, and an export that fails leaves nothing in the way of the next one.
    for entry in std::fs::read_dir(&tables).unwrap() {
        let path = entry.unwrap().path();
        if !path.ends_with("axes_d1.csv") {
            std::fs::remove_file(path).unwrap();
        }
    }
    run(["export", file, "--csv"]).refused(&["axes_d1.csv", "name another place, or remove it"]);
    assert_eq!(std::fs::read_dir(&tables).unwrap().count(), 1);
    let ended = run(["run", config.to_str().unwrap(), "--record", file]);
    assert!(ended.expect(2).err.contains("exists already"), "{ended:?}");

    let mut other = std::fs::read(&path).unwrap();
    let key = b"format\x01\0\0\x001";
    let at = other.windows(key.len()).position(|bytes| bytes == key).unwrap();
    other[at + key.len() - 1] = b'9';
    let other = machine.write("other.mcap", other);
    run(["export", other.to_str().unwrap(), "--csv"])
        .refused(&["other.mcap: it was recorded by version ", " (format 9): read it with that one"]);
    assert!(!machine.path("other").exists());
}

#[test]
fn a_file_that_may_not_grow_fails_the_run_by_name_and_is_readable_up_to_there() {
    let (machine, config, _sim) = with_drives(142, 1);
    let path = machine.path("run.mcap");
    let mut command = Command::new(PROGRAM);
    command.arg("run").arg(&config).args(["--json", "--record-wire", "--record"]).arg(&path);
    let mut program = Program::spawn(limit_files(&mut command, 64 << 10));
    program.await_text("is not complete");
    let ended = program.end_by(SIGINT);
    let summary = ended.expect(1).json();
    let [recorded] = &summary["recordings"].as_array().unwrap()[..] else { panic!("{summary}") };
    assert!(recorded["error"].as_str().unwrap().starts_with("File too large"), "{recorded}");
    assert!(recorded["lost"].as_u64() > Some(0), "{recorded}");
    // Meanwhile, and as the reason why the run has failed.
    let lines: Vec<&str> = ended.err.lines().filter(|line| line.contains("is not complete")).collect();
    let is_clear = |line: &&str| line.contains(path.to_str().unwrap()) && line.contains("free that disk");
    assert!(lines.len() == 2 && lines.iter().all(is_clear), "{ended:?}");
    // The drives went on.
    assert_eq!(drive(&summary, "d0")["losses"], 0);
    let (_, wrong) = read(&path);
    assert!(matches!(wrong, Some(Wrong::Cut)), "{wrong:?}");
}

#[test]
fn one_that_was_removed_meanwhile_fails_the_run_by_name() {
    let (machine, config, _sim) = with_drives(253, 1);
    let path = machine.path("run.mcap");
    let master = master(&config, &["--json", "--record", path.to_str().unwrap()]);
    await_status(&config, |summary| drive(summary, "d0")["answered"].as_u64() > Some(10));
    std::fs::remove_file(&path).unwrap();
    let ended = master.end_by(SIGINT);
    let summary = ended.expect(1).json();
    assert_eq!(summary["recordings"][0]["error"], "somebody removed it while it was written; record again");
    assert!(ended.err.contains("run.mcap is not complete: somebody removed it"), "{ended:?}");
}

#[test]
fn newest_records_and_a_black_box_are_written_on_request_and_exported_and_other_files_are_refused() {
    let (machine, config, _sim) = with_drives(144, 1);
    let (newest, boxes) = (machine.path("newest.mcap"), machine.path("boxes"));
    let [record, black_box] = [&newest, &boxes].map(|path| path.to_str().unwrap());
    let options = ["--json", "--record", record, "--record-window", "1s", "--black-box", black_box];
    let mut master = master(&config, &options);
    await_status(&config, |summary| drive(summary, "d0")["answered"].as_u64() > Some(100));
    assert!(!newest.exists());
    master.signal(SIGUSR1);
    master.await_text("(requested, cycle ");
    let requested = || {
        let mut files = std::fs::read_dir(machine.path("")).unwrap().map(|entry| entry.unwrap().path());
        files.find(|path| path.to_str().unwrap().contains("newest-cycle-"))
    };
    assert!(until(LONG, || requested().is_some()));
    let summary = finish(master);
    let recorded = summary["recordings"].as_array().unwrap();
    let why: Vec<&str> = recorded.iter().map(|one| one["why"].as_str().unwrap()).collect();
    assert_eq!(why, ["requested", "end of the run"]);
    for path in [&requested().unwrap(), &newest] {
        let (entries, wrong) = read(path);
        assert!(wrong.is_none() && count(&entries, "/cycle") > 0, "{wrong:?}");
    }

    let file = summary["black_boxes"][0]["path"].as_str().unwrap();
    let (entries, wrong) = read(file.as_ref());
    assert!(wrong.is_none() && count(&entries, "/axes/d0") == count(&entries, "/cycle"), "{wrong:?}");
    let wide = run(["export", file, "--csv", "-"]).expect(0).out.clone();
    assert_eq!(wide.lines().count() as u64, count(&entries, "/cycle") + 1);
    // `blackbox` reads a recording as well: one of a request, and one of the whole run.
    for (path, why) in
        [(&requested().unwrap(), "requested, in cycle "), (&newest, "end of the run, in cycle ")]
    {
        let printed = run(["blackbox", path.to_str().unwrap()]).expect(0).out.clone();
        assert!(
            printed.lines().nth(1).unwrap().starts_with(why) && printed.contains("\ndrive d0, mm\n"),
            "{printed}"
        );
    }

    run(["export", file, "--pcapng"]).refused(&["has no telegrams", "--record FILE --record-wire"]);
    let text = machine.write("notes.txt", "mine");
    for (file, words) in [(&text, "not a recording"), (&machine.path("none"), "No such file")] {
        let ended = run(["export", file.to_str().unwrap(), "--csv", machine.path("no").to_str().unwrap()]);
        assert!(ended.expect(2).err.contains(words) && ended.err.lines().count() == 1, "{ended:?}");
    }
    assert!(!machine.path("no").exists());
}
