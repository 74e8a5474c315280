//! The report of a run: what is in it, and all that keeps it from being written.

use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

use fieldbeat::time::Ns;
use libc::SIGINT;
use serde_json::Value;

use super::support::{
    Ended, LONG, Machine, PROGRAM, Program, as_ordinary_user, assert_sums, carried, command, drive, until,
};
use super::{assert_silent, await_status, end_once_measured, end_once_online, master, serve, socket};

const PLOTS: [&str; 4] = ["percentiles.svg", "rtt.svg", "timeline.svg", "wake.svg"];

fn files(directory: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(directory).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

fn read(directory: &Path, file: &str) -> String {
    std::fs::read_to_string(directory.join(file)).unwrap()
}

/// Every text of a plot, in the order it is drawn.
fn texts(svg: &str) -> Vec<String> {
    let document = roxmltree::Document::parse(svg).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(document.root_element().tag_name().name(), "svg");
    let texts = document.descendants().filter(|node| node.has_tag_name("text"));
    texts.map(|node| node.text().unwrap_or_default().trim().to_owned()).collect()
}

/// The total count of a distribution, after a look at all its lines.
fn total(hgrm: &str) -> u64 {
    let mut lines = hgrm.lines();
    assert_eq!(lines.next(), Some("       Value     Percentile TotalCount 1/(1-Percentile)"));
    assert_eq!(lines.next(), Some(""));
    let (rows, remarks): (Vec<_>, Vec<_>) = lines.partition(|line| !line.starts_with('#'));
    let rows: Vec<Vec<f64>> = (rows.iter())
        .map(|row| row.split_whitespace().map(|number| number.parse().unwrap()).collect())
        .collect();
    let last = rows.last().expect("something was measured");
    assert!(rows.is_sorted_by(|a, b| a[..3].iter().zip(&b[..3]).all(|(a, b)| a <= b)), "{hgrm}");
    assert_eq!((last.len(), last[1]), (3, 1.0), "{hgrm}");
    assert!(remarks[1].starts_with(&format!("#[Max     = {:12.3}, Total count", last[0])), "{hgrm}");
    last[2] as u64
}

#[test]
fn a_report_holds_summary_histograms_and_plots() {
    let machine = Machine::new(60);
    let config = machine.plain(2);
    let _sim = serve(&config);
    let place = machine.path("reports/first");
    let ended = end_once_measured(master(&config, &["--json", "--report", place.to_str().unwrap()]), &config);
    ended.expect(0);
    let summary = ended.json();
    assert_sums(&summary);

    let mut expected: BTreeSet<String> = PLOTS.map(String::from).into();
    expected.insert(String::from("summary.json"));
    let stages = ["send", "receive", "evaluate", "commands", "prepare", "publish"];
    let of_the_loop = ["wake", "jitter"].map(String::from).into_iter();
    let histograms = (of_the_loop.chain(stages.map(|stage| format!("stage-{stage}"))))
        .chain(["rtt", "send-jitter", "age"].iter().flat_map(|what| [0, 1].map(|d| format!("{what}-d{d}"))));
    expected.extend(histograms.map(|name| format!("{name}.hgrm")));
    assert_eq!(files(&place), expected);

    let json = read(&place, "summary.json");
    assert_eq!(json, ended.out, "the very object that was printed");

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
    let cycles = format!("cycles of {}", Ns(carried()));
    for (plot, labels) in [
        (
            "wake.svg",
            vec![
                String::from("latency (us, log scale)"),
                String::from("cycles"),
                format!("late limit {}", Ns(carried() / 10)),
                format!("period {}", Ns(carried())),
                format!("in cycle {max}"),
            ],
        ),
        (
            "percentiles.svg",
            vec![
                "latency (us)".into(),
                "percentile (log scale)".into(),
                "round trip of d".into(),
                ", the worst of 2 by p".into(),
                "50 %".into(),
                "90 %".into(),
                "max".into(),
                "receive deadline".into(),
            ],
        ),
        ("rtt.svg", vec!["round trip (us)".into(), "d0: p50".into(), "d1: p50".into()]),
        ("timeline.svg", vec!["time (s)".into(), "largest (us)".into(), "missed".into(), "skipped".into()]),
    ] {
        let texts = texts(&read(&place, plot));
        let has = |label: &str| texts.iter().any(|text| text.contains(label));
        for label in labels.iter().map(String::as_str).chain(["plain.toml: ", &cycles, host, kernel]) {
            assert!(has(label), "no \"{label}\" on {plot}: {texts:?}");
        }
    }
}

#[test]
fn the_plots_of_many_drives_name_the_worst_of_them() {
    let machine = Machine::new(61);
    let config = machine.plain(12);
    let _sim = serve(&config);
    let place = machine.path("report");
    let ended = end_once_measured(master(&config, &["--json", "--report", place.to_str().unwrap()]), &config);
    ended.expect(0);
    let texts = texts(&read(&place, "rtt.svg"));
    let named = texts.iter().filter(|text| text.starts_with('d') && text.contains(": p50 ")).count();
    assert_eq!(named, 5, "{texts:?}");
    assert!(texts.iter().any(|text| text == "the other 7 drives, none of them worse"), "{texts:?}");
    let by = texts.iter().find(|text| text.starts_with("Worst first: 12 drives compared by p")).unwrap();
    assert!(by.ends_with(", the highest quantile that each of them supports."), "{by}");
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
    assert!(!texts(&read(&place, "wake.svg")).is_empty());
    // Nothing of the old one is left that would pass for the new one's, and nothing of anybody else's is touched.
    assert!(of_others.iter().all(|file| read(&place, file) == "mine"));
    assert!(
        files(&place).iter().all(|file| of_others.contains(&file.as_str()) || read(&place, file) != "old")
    );
}

/// A machine without any drive to answer still has a report: of nothing measured, no curve is drawn.
#[test]
fn a_run_without_answers_is_reported() {
    let machine = Machine::new(63);
    let config = machine.plain(1);
    let place = machine.path("report");
    let ended = master(&config, &["--for", "100ms", "--json", "--report", place.to_str().unwrap()]).end();
    ended.expect(1);
    assert!(ended.err.contains("never answered: d0"), "{}", ended.err);
    for plot in PLOTS {
        texts(&read(&place, plot));
    }
    assert!(read(&place, "rtt-d0.hgrm").contains("Total count    =            0]"));
}

#[test]
fn a_file_in_the_way_is_refused_before_anything_is_sent() {
    let machine = Machine::new(64);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let file = machine.write("file", "mine");
    let below = file.join("report");
    for (place, what) in [(&file, "is not a directory"), (&below, "cannot write there: Not a directory")] {
        let ended = master(&config, &["--for", "1s", "--report", place.to_str().unwrap()]).end();
        ended.refused(&["fieldbeat: report ", place.to_str().unwrap(), what]);
    }
    assert_silent(&drive);
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine");
}

#[test]
fn a_place_of_others_is_refused_before_anything_is_sent() {
    let machine = Machine::new(65);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let locked = machine.path("locked");
    std::fs::create_dir(&locked).unwrap();
    std::fs::set_permissions(&locked, PermissionsExt::from_mode(0o555)).unwrap();
    for place in [locked.clone(), locked.join("report")] {
        let mut command = as_ordinary_user(&machine);
        command.arg("run").arg(&config).args(["--for", "1s", "--report"]).arg(place);
        Program::spawn(&mut command).end().refused(&[
            "cannot write there: Permission denied",
            "name a directory that this user may write to",
        ]);
    }
    assert_silent(&drive);
    assert_eq!(files(&locked), BTreeSet::new());
    // So that it can be removed.
    std::fs::set_permissions(&locked, PermissionsExt::from_mode(0o755)).unwrap();
}

#[test]
fn a_run_that_does_not_start_leaves_no_directory() {
    let machine = Machine::new(66);
    let config = machine.plain(1);
    let _taken = socket(machine.master());
    let place = machine.path("a/b");
    let ended = master(&config, &["--for", "1s", "--report", place.to_str().unwrap()]).end();
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
            "svg" => drop(texts(&text)),
            other => panic!("{file}: {other}"),
        }
    }
}

#[test]
fn a_file_that_may_not_grow_ends_the_report_and_nothing_else() {
    let machine = Machine::new(67);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let place = machine.path("report");
    let mut command = Command::new(PROGRAM);
    command.arg("run").arg(&config).args(["--json", "--report"]).arg(&place);
    // SAFETY: between fork and exec, system calls only.
    unsafe {
        command.pre_exec(|| {
            let small = libc::rlimit { rlim_cur: 6 << 10, rlim_max: 6 << 10 };
            match libc::setrlimit(libc::RLIMIT_FSIZE, &small) {
                0 => Ok(()),
                _ => Err(std::io::Error::last_os_error()),
            }
        });
    }
    let program = Program::spawn(&mut command);
    await_status(&config, |summary| drive(summary, "d0")["answered"].as_u64() > Some(100));
    program.signal(SIGINT);
    assert_incomplete(&program.end(), &place, "File too large");
    assert!(files(&place).contains("summary.json") && !files(&place).contains("rtt.svg"));
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
    let machine = Machine::new(68);
    let config = machine.plain(1);
    let _sim = serve(&config);
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
