//! The report of a run: what is in it, and all that keeps it from being written.

use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use fieldbeat::time::Ns;
use libc::SIGINT;
use serde_json::Value;

use super::support::{
    Ended, LONG, Machine, PROGRAM, Program, as_ordinary_user, assert_sums, carried, command, drive, until,
};
use super::{
    assert_silent, await_status, end_once_measured, end_once_online, limit_files, master, online, serve,
    socket, with_drives,
};

const FILES: [&str; 3] = ["index.html", "run.json", "summary.json"];

fn files(directory: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(directory).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

pub fn read(directory: &Path, file: &str) -> String {
    std::fs::read_to_string(directory.join(file)).unwrap()
}

/// Every text of a page, in its order.
pub fn texts(html: &str) -> Vec<String> {
    let options = roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() };
    let document =
        roxmltree::Document::parse_with_options(html, options).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(document.root_element().tag_name().name(), "html");
    let texts = document.descendants().filter(|node| node.is_text());
    texts.map(|node| node.text().unwrap_or_default().trim().to_owned()).collect()
}

/// The total count of a distribution. Its form is held by other readers of it.
fn total(hgrm: &str) -> u64 {
    let total = hgrm.split("Total count    =").nth(1).and_then(|rest| rest.split(']').next());
    total.and_then(|total| total.trim().parse().ok()).unwrap_or_else(|| panic!("{hgrm}"))
}

#[test]
fn a_report_holds_summary_histograms_and_a_page_and_is_compared_with_an_earlier_one() {
    let (machine, config, _sim) = with_drives(60, 12);
    let place = machine.path("reports/first");
    let ended = end_once_measured(master(&config, &["--json", "--report", place.to_str().unwrap()]), &config);
    let summary = ended.expect(0).json();
    assert_sums(&summary);

    let mut expected: BTreeSet<String> = FILES.map(String::from).into();
    let stages = ["send", "receive", "evaluate", "commands", "prepare", "publish"];
    let of_the_loop = ["wake", "jitter"].map(String::from).into_iter();
    let histograms = (of_the_loop.chain(stages.map(|stage| format!("stage-{stage}")))).chain(
        ["rtt", "send-jitter", "age"].iter().flat_map(|what| (0..12).map(move |d| format!("{what}-d{d}"))),
    );
    expected.extend(histograms.map(|name| format!("{name}.hgrm")));
    assert_eq!(files(&place), expected);

    assert_eq!(read(&place, "summary.json"), ended.out, "the very object that was printed");
    assert_eq!(total(&read(&place, "wake.hgrm")), summary["wake_ns"]["count"]);
    for (place_of, name) in ["d0", "d1"].iter().enumerate() {
        let drive = &summary["drives"][place_of];
        for (file, key) in [("rtt", "rtt_ns"), ("send-jitter", "send_jitter_ns"), ("age", "age_ns")] {
            assert_eq!(total(&read(&place, &format!("{file}-{name}.hgrm"))), drive[key]["count"], "{file}");
        }
    }
    for stage in stages {
        let counted = total(&read(&place, &format!("stage-{stage}.hgrm")));
        assert_eq!(counted, summary["stages_ns"][stage]["count"], "{stage}");
    }

    let kernel = summary["host"]["kernel"].as_str().unwrap();
    let host = summary["host"]["name"].as_str().unwrap();
    let max = &summary["wake_ns"]["max_cycle"];
    let texts = texts(&read(&place, "index.html"));
    let has = |label: &str| texts.iter().any(|text| text.contains(label));
    let (late, period) = (format!("late limit {}", Ns(carried() / 10)), format!("period {}", Ns(carried())));
    let (in_cycle, cycles) = (format!("(cycle {max})"), format!("a cycle of {}", Ns(carried())));
    for label in [
        "plain.toml",
        "passed",
        &cycles,
        host,
        kernel,
        // Each of the plots.
        "latency (us, log scale)",
        &late,
        &period,
        &in_cycle,
        "percentile (log scale)",
        "round trip of d",
        ", the worst of 12 by p",
        "50 %",
        "max",
        "receive deadline",
        "round trip (us)",
        "the other 7 drives, none of them worse",
        "time (s)",
        "largest (us)",
        "missed: ",
        "skipped: ",
        // The configuration, and what the doctor knows.
        "12 drives, 1 bus",
        "this host: ",
    ] {
        assert!(has(label), "no \"{label}\": {texts:?}");
    }
    // The plot of many drives names the worst of them.
    let named = texts.iter().filter(|text| text.starts_with('d') && text.contains(": p50 ")).count();
    assert_eq!(named, 5, "{texts:?}");
    let by = texts.iter().find(|text| text.starts_with("Worst first: 12 drives compared by p")).unwrap();
    assert!(by.ends_with(", the highest quantile that each of them supports."), "{by}");

    // The next run is compared with this one.
    let (second, earlier) = (machine.path("second"), place.join("run.json"));
    let compared = |file: &Path| {
        let files = [second.to_str().unwrap(), "--compare", file.to_str().unwrap()];
        master(&config, &[&["--report"], &files[..]].concat())
    };
    end_once_measured(compared(&earlier), &config).expect(0);
    let texts = self::texts(&read(&second, "index.html"));
    assert!(texts.iter().any(|text| text == "Compared with first"), "{texts:?}");
    assert!(texts.iter().any(|text| text.starts_with("first: p50 ")), "{texts:?}");
    // What is no earlier run is refused before anything is sent.
    let broken = machine.write("broken.json", &read(&place, "run.json")[..1_000]);
    for (file, expected) in [
        (machine.path("none.json"), "cannot read"),
        (place.join("summary.json"), "is no run.json of a report, or is damaged: missing field `format`"),
        (broken, "is no run.json of a report, or is damaged: EOF"),
    ] {
        compared(&file).end().refused(&[expected]);
    }
    master(&config, &["--compare", earlier.to_str().unwrap()]).end().refused(&["--report"]);
}

#[test]
fn an_interrupted_run_is_reported_and_an_old_report_replaced() {
    let machine = Machine::new(62);
    let config = machine.plain(1);
    let place = machine.path("report");
    std::fs::create_dir(&place).unwrap();
    let of_others = ["notes.txt", "best.hgrm", "rtt-gone.txt", "machine.svg"];
    let of_an_old_one =
        ["wake.svg", "rtt-gone.hgrm", "send-jitter-gone.hgrm", "age-gone.hgrm", "stage-old.hgrm"];
    for (files, text) in [(&of_an_old_one[..], "old"), (&of_others[..], "mine")] {
        files.iter().for_each(|file| std::fs::write(place.join(file), text).unwrap());
    }
    let _sim = serve(&config);
    let ended = end_once_online(master(&config, &["--json", "--report", place.to_str().unwrap()]));
    ended.expect(0);
    assert_eq!(read(&place, "summary.json"), ended.out);
    assert!(!texts(&read(&place, "index.html")).is_empty());
    // Nothing of the old one is left that would pass for the new one's, and nothing of anybody else's is touched.
    assert!(of_others.iter().all(|file| read(&place, file) == "mine"));
    assert!(
        files(&place).iter().all(|file| of_others.contains(&file.as_str()) || read(&place, file) != "old")
    );
}

#[test]
fn a_place_that_cannot_be_written_to_is_refused_before_anything_is_sent() {
    let machine = Machine::new(64);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let file = machine.write("file", "mine");
    let locked = machine.path("locked");
    std::fs::create_dir(&locked).unwrap();
    std::fs::set_permissions(&locked, PermissionsExt::from_mode(0o555)).unwrap();
    let no_right = ["cannot write there: Permission denied", "name a directory that this user may write to"];
    for (place, parts) in [
        (file.clone(), &["fieldbeat: report ", "is not a directory"][..]),
        (file.join("report"), &["cannot write there: Not a directory"]),
        (locked.clone(), &no_right),
        (locked.join("report"), &no_right),
    ] {
        let mut command = as_ordinary_user(&machine);
        command.arg("run").arg(&config).args(["--for", "1s", "--report"]).arg(&place);
        let ended = Program::spawn(&mut command).end();
        ended.refused(&[&[place.to_str().unwrap()], parts].concat());
    }
    assert_silent(&drive);
    assert_eq!((std::fs::read_to_string(&file).unwrap().as_str(), files(&locked).len()), ("mine", 0));
    // So that it can be removed.
    std::fs::set_permissions(&locked, PermissionsExt::from_mode(0o755)).unwrap();

    // A run that does not start leaves no directory.
    let _taken = socket(machine.master());
    let ended = master(&config, &["--for", "1s", "--report", machine.path("a/b").to_str().unwrap()]).end();
    ended.refused(&["Address already in use"]);
    assert!(!machine.path("a").exists());
}

/// The report cannot be written in full: one line says so, and the summary is printed all the same.
#[track_caller]
fn assert_incomplete(ended: &Ended, place: &Path, why: &str) {
    ended.expect(1);
    assert_sums(&ended.json());
    let complaints: Vec<&str> = ended.err.lines().filter(|line| line.starts_with("fieldbeat: ")).collect();
    let [line] = complaints[..] else { panic!("{}", ended.err) };
    let begin = format!("fieldbeat: report file {}/", place.display());
    assert!(line.starts_with(&begin) && line.contains(why) && line.contains("make room there"), "{line}");
    // What is there is whole.
    for file in files(place) {
        let text = read(place, &file);
        match file.rsplit_once('.').unwrap().1 {
            "json" => drop(serde_json::from_str::<Value>(&text).unwrap()),
            "hgrm" => drop(total(&text)),
            "html" => drop(texts(&text)),
            other => panic!("{file}: {other}"),
        }
    }
}

#[test]
fn a_file_that_may_not_grow_ends_the_report_and_nothing_else() {
    let (machine, config, _sim) = with_drives(67, 1);
    let place = machine.path("report");
    let mut command = Command::new(PROGRAM);
    command.arg("run").arg(&config).args(["--json", "--report"]).arg(&place);
    let program = Program::spawn(limit_files(&mut command, 6 << 10));
    await_status(&config, |summary| drive(summary, "d0")["answered"].as_u64() > Some(100));
    program.signal(SIGINT);
    assert_incomplete(&program.end(), &place, "File too large");
    assert!(files(&place).contains("summary.json") && !files(&place).contains("index.html"));
}

/// A disk of its own.
struct Disk<'a>(&'a Path);

impl Drop for Disk<'_> {
    fn drop(&mut self) {
        command(&["umount", self.0.to_str().unwrap()]);
    }
}

#[test]
#[ignore = "needs root: mounts a small disk"]
fn a_disk_that_fills_up_meanwhile_ends_the_report_and_nothing_else() {
    let (machine, config, _sim) = with_drives(68, 1);
    let place = machine.path("disk");
    std::fs::create_dir(&place).unwrap();
    command(&["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", place.to_str().unwrap()]);
    let disk = Disk(&place);
    let report = place.join("report");
    let mut program = master(&config, &["--json", "--report", report.to_str().unwrap()]);
    program.await_text("all drives online");
    // Somebody else fills it up to a few pages.
    std::fs::write(place.join("other"), vec![0; 232 << 10]).unwrap();
    program.signal(SIGINT);
    assert_incomplete(&program.end(), &report, "No space left on device");
    // Full already at the start.
    assert!(until(LONG, || std::fs::write(place.join("rest"), vec![0; 256 << 10]).is_err()));
    let place = place.join("late");
    let ended = master(&config, &["--for", "1s", "--report", place.to_str().unwrap()]).end();
    ended.refused(&["cannot write there: No space left on device"]);
    drop(disk);
}

#[test]
fn a_run_with_more_skipped_slots_than_tolerated_is_not_carried_and_names_the_key() {
    let machine = Machine::new(194);
    let strict = |key: &str| machine.config("strict.toml", 1, key, "");
    let config = strict("max_skipped_share = 0.0");
    let _sim = serve(&config);
    let run = |place: &str| {
        let report = machine.path(place);
        let program = online(&config, &["--json", "--report", report.to_str().unwrap()]);
        // As a host that takes the processor away, for as long as 50 cycles.
        program.hold();
        std::thread::sleep(Duration::from_nanos(50 * carried()));
        program.signal(libc::SIGCONT);
        await_status(&config, |summary| summary["cycle"]["skipped"].as_u64() > Some(0));
        program.signal(SIGINT);
        (program.end(), texts(&read(&report, "index.html")))
    };
    let (ended, page) = run("skipped");
    let ended = ended.expect(1);
    let summary = ended.json();
    let carried = &summary["carried"];
    assert_eq!((carried["carried"] == false, carried["realtime"] == false), (true, true), "{carried}");
    let share = &carried["shares"][1];
    assert_eq!((&share["what"], &share["count"]), (&"skipped".into(), &summary["cycle"]["skipped"]));
    assert!(
        ended.err.contains("NOT CARRIED at ") && ended.err.contains("max_skipped_share = 1 judges"),
        "{}",
        ended.err
    );
    assert!(page.contains(&"failed".to_owned()), "{page:?}");
    assert!(page.iter().any(|text| text.contains("NOT CARRIED at ")), "{page:?}");
    // The same host, and nothing judged.
    strict("max_skipped_share = 1.0");
    let (ended, page) = run("unjudged");
    assert_eq!(ended.expect(0).json()["carried"]["carried"], true);
    assert!(page.contains(&"passed".to_owned()), "{page:?}");
}
