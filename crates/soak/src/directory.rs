//! The directory of a soak test: its checkpoint while it runs, and its report at the end.
//!
//! | file | what |
//! |---|---|
//! | `checkpoint.json` | the test so far, each minute anew and when an axis is given up; `--resume` goes on from it |
//! | `index.html` | the page: verdict, criteria, plots |
//! | `run.json` | what a later run is compared with |

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender};
use serde::Deserialize;
use thiserror::Error;

use super::criteria::Judged;
use super::progress::{FORMAT, Progress};
use fieldbeat_core::time::S;
use fieldbeat_record::archive::Archive;
use fieldbeat_record::file::save;
use fieldbeat_record::page::{Page, Row, Table, VERDICT, whole};
use fieldbeat_record::report::CHECKPOINT;
use fieldbeat_record::summary::Carried;

const PAGE: &str = "index.html";
const RUN: &str = "run.json";

/// A disk that does not take the last files within this time does not hold up the end.
const PATIENCE: Duration = Duration::from_secs(30);

/// Why a test cannot begin or go on there. The message ends with the remedy.
#[derive(Error)]
pub enum DirectoryError {
    /// There is a test already.
    #[error(
        "{there} holds a soak test already: go on with `--resume {there}`, or name another directory",
        there = .0.display()
    )]
    Taken(PathBuf),
    /// There is the report of another run.
    #[error("{} holds a report already, which the test would replace: name another directory", .0.display())]
    Report(PathBuf),
    /// It cannot be written to.
    #[error("directory {}: cannot write there: {error}; name one that this user may write to", .directory.display())]
    Unwritable {
        /// The directory.
        directory: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// There is no test.
    #[error("cannot read {}: {error}; --resume names the directory of a soak test that was begun", .file.display())]
    Unread {
        /// The checkpoint.
        file: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// The checkpoint is none.
    #[error("{} is damaged: {why}; begin a new test in another directory", .file.display())]
    Damaged {
        /// The checkpoint.
        file: PathBuf,
        /// The part that does not fit.
        why: String,
    },
    /// It was made with another configuration.
    #[error(
        "{} was begun with another configuration (line {line} differs): resume it with that one, or begin a \
         new test in another directory",
        .directory.display()
    )]
    Configuration {
        /// The directory.
        directory: PathBuf,
        /// The first line that differs.
        line: usize,
    },
}
fieldbeat_core::debug_as_display!(DirectoryError);

/// A directory.
#[derive(Clone, Debug)]
pub struct Directory(PathBuf);

impl Directory {
    /// The directory of a test that begins, with its first checkpoint.
    pub fn create(path: &Path, progress: &Progress) -> Result<Directory, DirectoryError> {
        let directory = Directory(path.to_owned());
        if path.join(CHECKPOINT).exists() {
            return Err(DirectoryError::Taken(path.to_owned()));
        }
        if [PAGE, RUN].iter().any(|file| path.join(file).exists()) {
            return Err(DirectoryError::Report(path.to_owned()));
        }
        let unwritable = |error| DirectoryError::Unwritable { directory: path.to_owned(), error };
        directory.write(progress).map_err(unwritable)?;
        Ok(directory)
    }

    /// The directory of a test that goes on with this configuration, and how far it is.
    pub fn resume(path: &Path, configuration: &str) -> Result<(Directory, Progress), DirectoryError> {
        let file = path.join(CHECKPOINT);
        let text = fs::read_to_string(&file)
            .map_err(|error| DirectoryError::Unread { file: file.clone(), error })?;
        let damaged = |why: String| DirectoryError::Damaged { file: file.clone(), why };
        /// The fields that every form has.
        #[derive(Deserialize)]
        struct Form {
            format: u64,
        }
        let form: Form = serde_json::from_str(&text).map_err(|error| damaged(error.to_string()))?;
        if form.format != u64::from(FORMAT) {
            return Err(damaged(format!(
                "form {}, not {FORMAT}: of another version of this program",
                form.format
            )));
        }
        let progress: Progress = serde_json::from_str(&text).map_err(|error| damaged(error.to_string()))?;
        if progress.configuration != configuration {
            let (old, new) = (progress.configuration.lines(), configuration.lines());
            let same = old.zip(new).take_while(|(old, new)| old == new).count();
            return Err(DirectoryError::Configuration { directory: path.to_owned(), line: same + 1 });
        }
        Ok((Directory(path.to_owned()), progress))
    }

    /// Takes the first checkpoint back: the test did not begin.
    pub fn withdraw(&self) {
        // What cannot be removed says at the next test what it is.
        let _ = fs::remove_file(self.0.join(CHECKPOINT));
        // Only if nothing else is there.
        let _ = fs::remove_dir(&self.0);
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The page of its report.
    pub fn page(&self) -> PathBuf {
        self.0.join(PAGE)
    }

    fn write(&self, progress: &Progress) -> io::Result<()> {
        save(&self.0.join(CHECKPOINT), serde_json::to_string(progress)?.as_bytes())
    }

    fn write_report(&self, page: &str, run: &Archive) -> io::Result<()> {
        save(&self.0.join(RUN), run.to_json().as_bytes())?;
        save(&self.0.join(PAGE), page.as_bytes())
    }
}

/// The files to write.
#[derive(Debug)]
enum Work {
    Checkpoint(Box<Progress>),
    Report(String, Box<Archive>),
}

/// Writes checkpoints on a thread of its own: the axes need their setpoints while a disk takes its time.
#[derive(Debug)]
pub struct Writer {
    work: Option<Sender<Work>>,
    results: Receiver<io::Result<()>>,
    thread: Option<JoinHandle<()>>,
    directory: Directory,
    /// The number of files under way, and since when none of them was finished.
    pending: u64,
    since: Instant,
    /// The number of files that could not be written.
    lost: u64,
}

impl Writer {
    /// A writer into this directory. `prepare` runs first on its thread.
    pub fn start(directory: Directory, prepare: impl FnOnce() + Send + 'static) -> io::Result<Writer> {
        // One that is written, and one that waits.
        let (work, queue) = crossbeam_channel::bounded::<Work>(1);
        let (report, results) = crossbeam_channel::unbounded();
        let there = directory.clone();
        let thread = std::thread::Builder::new().name("fb-checkpoint".into()).spawn(move || {
            prepare();
            for work in queue {
                let result = match work {
                    Work::Checkpoint(progress) => there.write(&progress),
                    Work::Report(page, run) => there.write_report(&page, &run),
                };
                if report.send(result).is_err() {
                    return;
                }
            }
        })?;
        Ok(Writer {
            work: Some(work),
            results,
            thread: Some(thread),
            directory,
            pending: 0,
            since: Instant::now(),
            lost: 0,
        })
    }

    /// The number of checkpoints that could not be written since the last call.
    pub fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    /// Has a checkpoint written, without waiting for it. Returns one line if it, or one before, could not be.
    pub fn checkpoint(&mut self, progress: Progress) -> Option<String> {
        let earlier = self.look();
        self.send(Work::Checkpoint(Box::new(progress))).or(earlier)
    }

    fn send(&mut self, work: Work) -> Option<String> {
        match self.work.as_ref().map(|queue| queue.try_send(work)) {
            Some(Ok(())) => {
                if self.pending == 0 {
                    self.since = Instant::now();
                }
                self.pending += 1;
                None
            }
            // The next one has it all; only a disk that takes nothing for long loses something.
            _ if self.since.elapsed() < PATIENCE => None,
            _ => {
                self.since = Instant::now();
                Some(self.failed(&format!("its disk does not answer for {} s", PATIENCE.as_secs())))
            }
        }
    }

    /// One line if a checkpoint could not be written meanwhile.
    pub fn look(&mut self) -> Option<String> {
        let mut line = None;
        while let Ok(result) = self.results.try_recv() {
            (self.pending, self.since) = (self.pending - 1, Instant::now());
            if let Err(error) = result {
                line = Some(self.failed(&error.to_string()));
            }
        }
        line
    }

    fn failed(&mut self, why: &str) -> String {
        self.lost += 1;
        let directory = self.directory.path().display();
        format!("{directory}: checkpoint not written: {why}; the test goes on, make room there")
    }

    /// Waits until all that is under way is written, but not for ever; what the last of it came to.
    fn settle(&mut self) -> Result<io::Result<()>, String> {
        let mut last = Ok(());
        while self.pending > 0 {
            let hangs = |_| format!("its disk does not answer for {} s", PATIENCE.as_secs());
            last = self.results.recv_timeout(PATIENCE).map_err(hangs)?;
            self.pending -= 1;
        }
        Ok(last)
    }

    /// Writes the last checkpoint and the report, and waits for both.
    pub fn finish(mut self, progress: Progress, page: String) -> Result<(), String> {
        let directory = self.directory.path().display().to_string();
        let failed =
            |why: String| format!("{directory}: the report is not written: {why}; look at that disk");
        // Those before the last checkpoint do not matter any more: it has it all.
        drop(self.settle().map_err(failed)?);
        let run = progress.run.clone();
        let mut all = vec![Work::Checkpoint(Box::new(progress))];
        all.extend(run.map(|run| Work::Report(page, Box::new(run))));
        for work in all {
            self.send(work);
            let written = self.settle().map_err(failed)?;
            written.map_err(|error| failed(error.to_string()))?;
        }
        drop(self.work.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        Ok(())
    }
}

/// The page of a test.
pub fn page(
    progress: &Progress,
    judged: &[Judged],
    earlier: &[(String, Archive)],
    texts: &[(String, String)],
    carried: Option<&Carried>,
) -> String {
    let Some(run) = &progress.run else { return String::new() };
    let failed: Vec<String> = judged.iter().filter(|one| !one.passed).map(Judged::line).collect();
    let verdict = match failed.as_slice() {
        [] => format!("all {} criteria are kept, over {}", judged.len(), ran(progress)),
        failed => format!("over {}: {}", ran(progress), failed.join(" | ")),
    };
    let tables = vec![criteria(judged), axes(progress, run), processes(progress)];
    Page { run, passed: failed.is_empty(), verdict, carried, earlier, tables, texts }.html()
}

/// A gap, of which only whole seconds are known.
fn pause(s: u64) -> String {
    if s < 60 { format!("{s} s") } else { whole(s * S) }
}

/// How long it ran, in words.
pub fn ran(progress: &Progress) -> String {
    let processes = progress.processes.len() as u64;
    let gaps = match progress.gaps_s() {
        _ if processes < 2 => String::new(),
        gaps => format!(", with {} between them that nothing was measured in", pause(gaps)),
    };
    format!(
        "{} of {} in {}{gaps}",
        whole(progress.ran_ns()),
        whole(progress.length_ns),
        if processes == 1 { "1 process".to_owned() } else { format!("{processes} processes") }
    )
}

fn criteria(judged: &[Judged]) -> Table {
    let rows = judged.iter().map(|one| Row {
        good: one.value.map(|_| one.passed),
        cells: vec![
            one.name(),
            one.word().to_owned(),
            one.text(one.value),
            one.text(Some(one.limit)),
            one.note.clone(),
        ],
    });
    Table {
        title: "Criteria".into(),
        columns: vec![" criterion", VERDICT, "value", "at most", " note"],
        rows: rows.collect(),
        ..Table::default()
    }
}

fn axes(progress: &Progress, run: &Archive) -> Table {
    let rows = run.drives.iter().zip(&progress.axes).map(|(drive, axis)| {
        let word = match (&axis.given_up, axis.moves) {
            (Some(why), _) => why.clone(),
            (None, true) => "moved".into(),
            (None, false) => "not moved".into(),
        };
        let good = axis.given_up.is_some().then_some(false);
        Row { good, cells: vec![drive.name.clone(), axis.cycles.to_string(), word] }
    });
    Table {
        title: "Axes".into(),
        columns: vec![" axis", "moves", " state"],
        rows: rows.collect(),
        ..Table::default()
    }
}

fn processes(progress: &Progress) -> Table {
    let mut rows = Vec::new();
    for (place, process) in progress.processes.iter().enumerate() {
        let gap = place.checked_sub(1).map(|before| process.gap_after(&progress.processes[before]));
        let began = std::time::UNIX_EPOCH + Duration::from_secs(process.began_s);
        let of = |sample: Option<&super::samples::Sample>| {
            sample.map_or("-".to_owned(), |s| {
                format!("{:.1} MB, {}", s.memory_kb as f64 / 1000.0, s.descriptors)
            })
        };
        rows.push(Row::from(vec![
            humantime::format_rfc3339_seconds(began).to_string(),
            gap.map_or("-".to_owned(), pause),
            whole(process.from_ns),
            whole(process.ran_ns),
            of(process.samples.first()),
            of(process.samples.last()),
        ]));
    }
    Table {
        title: "Processes".into(),
        about: "Memory and descriptors are those of the first and of the last checkpoint.".into(),
        columns: vec![" began", "gap before", "from", "ran", "at first", "at last"],
        rows,
    }
}
