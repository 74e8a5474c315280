//! What a soak test has to keep to, and whether it does: each criterion by its name, its value and its limit.

use serde::Serialize;

use super::progress::Progress;
use fieldbeat_config::soak::SoakPlan;
use fieldbeat_core::time::{Ns, US, three_digits};
use fieldbeat_record::archive::Archive;
use fieldbeat_record::compare::{percent, significant};
use fieldbeat_record::summary::{Carried, Share};
use fieldbeat_telemetry::bins::Bins;
use fieldbeat_telemetry::parts::together;
use fieldbeat_telemetry::signals::{ROUND_TRIP, WAKE};

/// One criterion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Judged {
    /// The name, as its key is called.
    pub criterion: &'static str,
    /// The drive that it is about; null: the whole machine.
    pub drive: Option<String>,
    /// The found value; null: it could not be found.
    pub value: Option<f64>,
    /// The most that is good.
    pub limit: f64,
    /// Of both; empty for counts.
    pub unit: String,
    /// It is kept.
    pub passed: bool,
    /// The remark.
    pub note: String,
}

/// The unit of shares and ratios, which are shown as per cent.
const SHARE: &str = "share";

impl Judged {
    fn new(criterion: &'static str, value: Option<f64>, limit: f64) -> Judged {
        // Without a value there is nothing that is wrong.
        let passed = value.is_none_or(|value| value <= limit);
        Judged { criterion, drive: None, value, limit, unit: String::new(), passed, note: String::new() }
    }

    fn share(criterion: &'static str, value: Option<f64>, limit: f64) -> Judged {
        Judged::new(criterion, value, limit).unit(SHARE)
    }

    fn count(criterion: &'static str, value: u64, limit: u64) -> Judged {
        Judged::new(criterion, Some(value as f64), limit as f64)
    }

    /// A share with which a period counts as carried, under the name of its key.
    fn carried(share: &Share) -> Judged {
        let criterion = match share.what {
            "late" => "max_late_share",
            "skipped" => "max_skipped_share",
            _ => "max_unanswered_share",
        };
        let judged = Judged::share(criterion, Some(share.value()), share.tolerated);
        let drive = share.drive.clone();
        let note = format!("{} of {}", share.count, share.of);
        Judged { passed: !share.is_exceeded(), drive, ..judged.note(note) }
    }

    fn of(self, drive: &str) -> Judged {
        Judged { drive: Some(drive.to_owned()), ..self }
    }

    fn unit(self, unit: impl Into<String>) -> Judged {
        Judged { unit: unit.into(), ..self }
    }

    fn note(self, note: impl Into<String>) -> Judged {
        Judged { note: note.into(), ..self }
    }

    /// The name with the drive.
    pub fn name(&self) -> String {
        match &self.drive {
            Some(drive) => format!("{} of {drive}", self.criterion),
            None => self.criterion.to_owned(),
        }
    }

    /// A value with its unit.
    pub fn text(&self, value: Option<f64>) -> String {
        let Some(value) = value else { return "not known".to_owned() };
        if self.unit == SHARE {
            return percent(value);
        }
        format!("{} {}", significant(value), self.unit).trim_end().to_owned()
    }

    /// The result in one word.
    pub fn word(&self) -> &'static str {
        match (self.passed, self.value) {
            (false, _) => "FAILED",
            (true, Some(_)) => "kept",
            (true, None) => "-",
        }
    }

    /// One line: value and limit.
    pub fn line(&self) -> String {
        let note = if self.note.is_empty() { String::new() } else { format!("; {}", self.note) };
        format!("{}: {}, at most {}{note}", self.name(), self.text(self.value), self.text(Some(self.limit)))
    }
}

/// All criteria of a test so far. Before its end a drive that is not online, or an axis that has not moved, is no
/// failure yet.
pub fn judge(plan: &SoakPlan, progress: &Progress, ended: bool) -> Vec<Judged> {
    let Some(run) = &progress.run else { return Vec::new() };
    let limits = &plan.criteria;
    let counts = &run.counts;
    // Late cycles that cost no slot: those of overruns are counted by the slots that they skipped.
    let late = counts.late.saturating_sub(counts.overruns);
    let mut all = vec![
        Judged::share(
            "late_share",
            Some((late + counts.skipped) as f64 / counts.planned.max(1) as f64),
            limits.late_share,
        )
        .note(format!("{late} late, {} skipped of {}", counts.skipped, counts.planned)),
        Judged::count("lost_links", run.drives.iter().map(|drive| drive.losses).sum(), limits.lost_links)
            .note(named(run, |drive| drive.losses > 0)),
        by_marks("faults", run, limits.faults, |drive| {
            let of_pauses = progress.axes.get(drive).map_or(0, |axis| axis.faults_of_pauses);
            run.drives[drive].motion.marks.faults().saturating_sub(of_pauses)
        }),
        by_marks("stops", run, limits.stops, |drive| {
            let axis = progress.axes.get(drive);
            let of_pauses = axis.map_or(0, |axis| axis.stops_of_pauses);
            // A program that is killed right after the stop has counted it nowhere else.
            let was_stopped = axis.is_some_and(|axis| axis.was_stopped());
            run.drives[drive].motion.marks.stops().saturating_sub(of_pauses).max(u64::from(was_stopped))
        }),
        given_up(run, progress),
    ];
    let carried = Carried::of_archive(&plan.cycle, run);
    all.extend(carried.shares.iter().map(Judged::carried));
    for drive in &run.drives {
        let sent = drive.exchanges.sent;
        let share = (sent > 0).then(|| drive.exchanges.missed as f64 / sent as f64);
        let note = format!("{} of {sent}", drive.exchanges.missed);
        all.push(Judged::share("missed_share", share, limits.missed_share).of(&drive.name).note(note));
    }
    for (drive, axis) in run.drives.iter().zip(&plan.axes) {
        let Some(limit) = axis.following_error else { continue };
        let error = drive.motion.error_max.map(|largest| largest.value);
        all.push(Judged::new("following_error", error, limit).of(&drive.name).unit(drive.unit.clone()));
    }
    all.extend(drifts(run, limits.drift));
    let growths = progress.processes.iter().filter_map(|process| process.growth(limits.warm_up_ns));
    let most = |of: fn(&super::samples::Growth) -> f64| {
        let values: Vec<f64> = growths.clone().map(|growth| of(&growth)).collect();
        values.into_iter().reduce(f64::max)
    };
    let memory = most(|growth| growth.memory);
    let note = match memory {
        None => format!("no process ran long enough after its warm-up of {}", Ns(limits.warm_up_ns)),
        Some(_) => String::new(),
    };
    all.push(Judged::new("memory_growth", memory, limits.memory_growth).unit("MB").note(note.clone()));
    let descriptors = most(|growth| growth.descriptors);
    all.push(Judged::new("descriptor_growth", descriptors, limits.descriptor_growth).note(note));
    all.push(Judged::count("telemetry_lost", counts.lost_records, limits.telemetry_lost));
    all.push(
        Judged::count("files_lost", progress.files_lost, limits.files_lost)
            .note(if progress.files_lost > 0 { "checkpoints that were not written" } else { "" }),
    );
    if ended {
        let offline = run.drives.iter().filter(|drive| drive.link != "online").count() as u64;
        let note = named(run, |drive| drive.link != "online");
        all.push(Judged::count("offline", offline, 0).note(note));
        let unmoved =
            progress.axes.iter().zip(&run.drives).filter(|(axis, _)| axis.moves && axis.cycles == 0);
        let names: Vec<&str> = unmoved.map(|(_, drive)| drive.name.as_str()).collect();
        all.push(Judged::count("unmoved", names.len() as u64, 0).note(names.join(", ")));
        if !run.failures.is_empty() {
            let count = run.failures.len() as u64;
            all.push(Judged::count("program_failures", count, 0).note(run.failures.join("; ")));
        }
    }
    all
}

/// Axes that move no longer although nothing stopped them; those that were stopped are judged as stops.
fn given_up(run: &Archive, progress: &Progress) -> Judged {
    let reasons = run.drives.iter().zip(&progress.axes).filter_map(|(drive, axis)| {
        let why = axis.given_up.as_ref().filter(|_| !axis.was_stopped())?;
        Some(format!("{}: {why}", drive.name))
    });
    let reasons: Vec<String> = reasons.collect();
    Judged::count("given_up", reasons.len() as u64, 0).note(reasons.join("; "))
}

/// A count of each drive, together.
fn by_marks(criterion: &'static str, run: &Archive, limit: u64, count: impl Fn(usize) -> u64) -> Judged {
    let counts: Vec<u64> = (0..run.drives.len()).map(count).collect();
    let names = run.drives.iter().zip(&counts).filter(|(_, count)| **count > 0);
    let names: Vec<&str> = names.map(|(drive, _)| drive.name.as_str()).collect();
    Judged::count(criterion, counts.iter().sum(), limit).note(names.join(", "))
}

fn named(run: &Archive, chosen: impl Fn(&fieldbeat_record::archive::Drive) -> bool) -> String {
    let names = run.drives.iter().filter(|drive| chosen(drive)).map(|drive| drive.name.as_str());
    names.collect::<Vec<_>>().join(", ")
}

/// A p99 that grows by less than this does not drift: it is noise of the host.
const NOISE_NS: u64 = 20 * US;

/// How much larger the p99 of each quantity is in the last quarter of the parts than in the first. A test that is too
/// short has none.
fn drifts(run: &Archive, limit: f64) -> Vec<Judged> {
    let quarter = run.parts.len() / 4;
    if quarter == 0 {
        return Vec::new();
    }
    let (first, last) = (together(&run.parts[..quarter]), together(&run.parts[run.parts.len() - quarter..]));
    let drift = |first: &Bins, last: &Bins| {
        let (first, last) = (first.quantile(0.99), last.quantile(0.99));
        let note = match (first, last) {
            (Some(first), Some(last)) => format!("p99 {} at first, {} at last", text(first), text(last)),
            _ => "too few samples".to_owned(),
        };
        let value = first.zip(last).map(|(first, last)| match last.saturating_sub(first) {
            0..NOISE_NS => 0.0,
            grown => grown as f64 / first.max(1) as f64,
        });
        Judged::share("drift", value, limit).note(note)
    };
    let wake = drift(&first.wake, &last.wake);
    let wake = Judged { note: format!("{}: {}", WAKE.name, wake.note), ..wake };
    let rtts = run.drives.iter().zip(first.rtt.iter().zip(&last.rtt));
    [wake]
        .into_iter()
        .chain(rtts.map(|(drive, (first, last))| {
            let judged = drift(first, last).of(&drive.name);
            Judged { note: format!("{}: {}", ROUND_TRIP.name, judged.note), ..judged }
        }))
        .collect()
}

fn text(ns: u64) -> String {
    Ns(three_digits(ns)).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::AxisProgress;
    use crate::samples::{Process, Sample};
    use fieldbeat_config::soak::{AxisSoak, Pattern};
    use fieldbeat_core::time::S;
    use fieldbeat_record::Summary;
    use fieldbeat_telemetry::{Largest, Run};
    use fieldbeat_testing::runs::run;

    fn archive(run: &Run) -> Archive {
        Archive::of(&run.plan, &run.end, &run.measured, &Summary::from(run))
    }

    /// A test of one axis that keeps to all criteria.
    fn test() -> (SoakPlan, Progress) {
        let pattern = Pattern::Still(String::new());
        let axes = vec![AxisSoak { name: "x".into(), pattern, following_error: Some(1.0) }];
        let mut progress = Progress::new(String::new(), 0);
        let mut run = archive(&run("x", 40_000));
        run.drives[0].link = "online".into();
        run.drives[0].exchanges.sent = 40_000;
        progress.run = Some(run);
        progress.axes = vec![AxisProgress { moves: true, cycles: 1, ..AxisProgress::default() }];
        let samples =
            (0..100).map(|minute| Sample { at_ns: minute * 60 * S, memory_kb: 10_000, descriptors: 9 });
        progress.processes = vec![Process { samples: samples.collect(), ..Process::default() }];
        (SoakPlan { axes, ..SoakPlan::default() }, progress)
    }

    /// The lines of the criteria that fail after `change`.
    fn failed(change: impl FnOnce(&mut Progress, &mut Archive)) -> Vec<String> {
        let (plan, mut progress) = test();
        let mut run = progress.run.take().unwrap();
        change(&mut progress, &mut run);
        progress.run = Some(run);
        judge(&plan, &progress, true).iter().filter(|one| !one.passed).map(Judged::line).collect()
    }

    #[test]
    fn each_criterion_fails_alone_and_by_its_name() {
        assert_eq!(failed(|_, _| {}), Vec::<String>::new());
        let leaks = |step: u64, descriptors: u64| {
            let sample = move |minute: u64| Sample {
                at_ns: minute * 60 * S,
                memory_kb: 10_000 + step * minute,
                descriptors: 9 + descriptors * minute / 50,
            };
            (0..100).map(sample).collect::<Vec<_>>()
        };
        type Change = Box<dyn FnOnce(&mut Progress, &mut Archive)>;
        let cases: Vec<(&str, Change)> = vec![
            ("late_share: 0.50 %, at most 0.10 %; 200 late, 0 skipped of 40000", {
                Box::new(|_, run| run.counts.late = 200)
            }),
            ("late_share: 0.50 %, at most 0.10 %; 0 late, 200 skipped of 40000", {
                Box::new(|_, run| run.counts.skipped = 200)
            }),
            ("late_share: 0.50 %, at most 0.10 %; 100 late, 100 skipped of 40000", {
                // A late wake-up that skips a slot is a late cycle and a skipped slot.
                Box::new(|_, run| (run.counts.late, run.counts.overruns, run.counts.skipped) = (180, 80, 100))
            }),
            ("lost_links: 2, at most 0; x", Box::new(|_, run| run.drives[0].losses = 2)),
            ("given_up: 1, at most 0; x: axis x: moves was not carried out", {
                let why = "axis x: moves was not carried out".to_owned();
                Box::new(|progress, _| progress.axes[0].given_up = Some(why))
            }),
            ("missed_share of x: 0.50 %, at most 0.10 %; 200 of 40000", {
                Box::new(|_, run| run.drives[0].exchanges.missed = 200)
            }),
            ("following_error of x: 1.25 mm, at most 1 mm", {
                Box::new(|_, run| run.drives[0].motion.error_max = Some(Largest { value: 1.25, cycle: 7 }))
            }),
            ("memory_growth: 13.4 MB, at most 8 MB", {
                Box::new(move |progress, _| progress.processes[0].samples = leaks(200, 0))
            }),
            ("descriptor_growth: 1, at most 0", {
                Box::new(move |progress, _| progress.processes[0].samples = leaks(0, 1))
            }),
            ("telemetry_lost: 5, at most 0", Box::new(|_, run| run.counts.lost_records = 5)),
            ("files_lost: 1, at most 0; checkpoints that were not written", {
                Box::new(|progress, _| progress.files_lost = 1)
            }),
            ("offline: 1, at most 0; x", Box::new(|_, run| run.drives[0].link = "lost".into())),
            ("unmoved: 1, at most 0; x", Box::new(|progress, _| progress.axes[0].cycles = 0)),
            ("program_failures: 1, at most 0; it panicked", {
                Box::new(|_, run| run.failures.push("it panicked".into()))
            }),
        ];
        for (expected, change) in cases {
            assert_eq!(failed(change), [expected]);
        }
    }

    #[test]
    fn an_axis_given_up_fails_before_the_end_and_one_that_was_stopped_counts_as_a_stop() {
        let (plan, mut progress) = test();
        let mut failed = |why: &str| {
            progress.axes[0].given_up = Some(why.to_owned());
            judge(&plan, &progress, false)
                .iter()
                .filter(|one| !one.passed)
                .map(Judged::line)
                .collect::<Vec<_>>()
        };
        assert_eq!(failed("it timed out"), ["given_up: 1, at most 0; x: it timed out"]);
        // Even if the program was killed before it had counted the stop elsewhere.
        assert_eq!(failed("stopped: link lost"), ["stops: 1, at most 0; x"]);
    }

    #[test]
    fn a_tail_that_grows_drifts_and_noise_does_not() {
        let level = |ns: u64| Bins::from_list([(ns, 10_000)]);
        let drifts = |wake: u64, rtt: u64| {
            failed(|_, run| {
                let parts = run.parts.len();
                for (place, part) in run.parts.iter_mut().enumerate() {
                    let is_last = place >= parts * 3 / 4;
                    part.wake = level(if is_last { wake } else { 30_000 });
                    part.rtt = vec![level(if is_last { rtt } else { 100_000 })];
                }
            })
        };
        assert_eq!(drifts(49_000, 119_000), Vec::<String>::new(), "63 %, but less than 20 us; 19 %");
        let expected = "drift: 100.00 %, at most 50.00 %; wake-up latency: p99 30 us at first, 60 us at last";
        assert_eq!(drifts(60_000, 100_000), [expected]);
        let expected =
            "drift of x: 80.00 %, at most 50.00 %; round trip: p99 100 us at first, 180 us at last";
        assert_eq!(drifts(30_000, 180_000), [expected]);
    }

    #[test]
    fn before_the_end_nothing_is_missing_yet() {
        let (plan, mut progress) = test();
        progress.axes[0].cycles = 0;
        progress.run.as_mut().unwrap().drives[0].link = "unseen".into();
        assert!(judge(&plan, &progress, false).iter().all(|one| one.passed));
        progress.processes[0].samples.truncate(5);
        let judged = judge(&plan, &progress, true);
        let memory = judged.iter().find(|one| one.criterion == "memory_growth").unwrap();
        assert_eq!((memory.value, memory.word()), (None, "-"), "{memory:?}");
    }
}
