//! The report of a run: a directory with its page, its summary and its histograms.
//!
//! | file | what |
//! |---|---|
//! | `index.html` | verdict, plots, numbers, configuration and host on one page, which needs no other file |
//! | `summary.json` | what `--json` prints |
//! | `run.json` | what a later run is compared with |
//! | `wake.hgrm`, `jitter.hgrm`, `stage-S.hgrm` | the loop |
//! | `reference.hgrm` | phase errors of the grid, where the clock of a bus leads it |
//! | `rtt-D.hgrm`, `send-jitter-D.hgrm`, `age-D.hgrm` | drive D |
//!
//! Files of an earlier report in the same directory are removed: they would be taken for this one's.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::archive::Archive;
pub use super::archive::ArchiveError;
use super::file::{Place, save};
use super::hgrm::distribution;
use super::page::Page;
use super::summary::Drive;
use crate::summary::Summary;
use fieldbeat_core::cycle::record::Stage;
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_telemetry::Run;

/// The page and the files next to it.
const FILES: [&str; 3] = ["index.html", "summary.json", "run.json"];

/// What a soak test goes on from.
pub const CHECKPOINT: &str = "checkpoint.json";

/// The plots of earlier versions, which are on the page now.
const PLOTS: [&str; 4] = ["wake.svg", "percentiles.svg", "rtt.svg", "timeline.svg"];

/// A place for a report. Dropped without one, it leaves nothing there.
#[derive(Debug)]
pub struct Report {
    place: Place,
    /// Earlier runs, by their names.
    earlier: Vec<(String, Archive)>,
    /// Texts at the end of the page, by their titles.
    texts: Vec<(String, String)>,
}

/// Why there is no report, or not all of it. The message ends with the remedy.
#[derive(Error)]
pub enum ReportError {
    /// There is something else of that name.
    #[error("report {0} is not a directory; name one, or a place where one can be made")]
    NotADirectory(PathBuf),
    /// It is the directory of a soak test.
    #[error("report {0}: a soak test keeps its checkpoint and its report there; name another directory")]
    Soak(PathBuf),
    /// The directory cannot be made, or not written to.
    #[error(
        "report {directory}: cannot write there: {error}; {}",
        no_descriptor(.error).unwrap_or("name a directory that this user may write to")
    )]
    Directory {
        /// The directory.
        directory: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
    /// A file could not be written. Those before it are whole.
    #[error(
        "report file {file} and those after it are not written: {error}; make room there, or name another \
         directory"
    )]
    File {
        /// The file.
        file: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
    /// A file of an earlier report is still there. This one is whole.
    #[error("report file {file} belongs to an earlier run and cannot be removed: {error}; remove it")]
    Earlier {
        /// The file.
        file: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
}
fieldbeat_core::debug_as_display!(ReportError);

impl Report {
    /// Finds out whether a report can be written to `directory`, before the run: makes it, and writes a file to it and
    /// removes that again.
    pub fn create(directory: impl Into<PathBuf>) -> Result<Report, ReportError> {
        let directory = directory.into();
        if directory.exists() && !directory.is_dir() {
            return Err(ReportError::NotADirectory(directory));
        }
        if directory.join(CHECKPOINT).exists() {
            return Err(ReportError::Soak(directory));
        }
        match Place::prepare(&directory) {
            Ok(place) => Ok(Report { place, earlier: Vec::new(), texts: Vec::new() }),
            Err(error) => Err(ReportError::Directory { directory, error }),
        }
    }

    /// Where it is written.
    pub fn directory(&self) -> &Path {
        self.place.directory()
    }

    /// Compares the run with an earlier one, whose report wrote the file `run.json`: their latencies lie over each
    /// other, and a table says what is worse, better, or not different.
    pub fn compare(mut self, file: &Path) -> Result<Report, ArchiveError> {
        self.earlier.push(earlier_run(file)?);
        Ok(self)
    }

    /// Adds a text to the page, such as the configuration or what is known of the host.
    pub fn add_text(&mut self, title: impl Into<String>, text: impl Into<String>) {
        self.texts.push((title.into(), text.into()));
    }

    /// Writes the report; files of the same names are replaced, and others of an earlier report removed.
    pub fn write(&self, run: &Run, summary: &Summary) -> Result<(), ReportError> {
        let failed = |name: &str, error| ReportError::File { file: self.directory().join(name), error };
        let save = |name: &str, text: &str| {
            save(&self.directory().join(name), text.as_bytes()).map_err(|error| failed(name, error))
        };
        let [page, name, archive_name] = FILES;
        let json = serde_json::to_string(summary).map_err(|error| failed(name, error.into()))?;
        let histograms = histograms(run);
        // Before the first new one, so that the old and the new are never side by side.
        let removed = self.remove_all_but(&histograms);
        save(name, &(json + "\n"))?;
        for (name, text) in &histograms {
            save(name, text)?;
        }
        let archive = Archive::of(&run.plan, &run.end, &run.measured, summary);
        save(archive_name, &archive.to_json())?;
        save(page, &self.page(&archive, summary))?;
        removed
    }

    fn page(&self, run: &Archive, summary: &Summary) -> String {
        let page = Page {
            run,
            passed: summary.is_whole() && summary.carried.carried,
            verdict: verdict(summary),
            carried: Some(&summary.carried),
            earlier: &self.earlier,
            tables: Vec::new(),
            texts: &self.texts,
        };
        page.html()
    }

    /// Removes the files of an earlier report that are not among `kept`.
    fn remove_all_but(&self, kept: &[(String, String)]) -> Result<(), ReportError> {
        let mut result = Ok(());
        for entry in fs::read_dir(self.directory()).into_iter().flatten().flatten() {
            let name = entry.file_name();
            let stale = |name: &str| is_ours(name) && kept.iter().all(|(kept, _)| kept != name);
            if !name.to_str().is_some_and(stale) || entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                continue;
            }
            if let Err(error) = fs::remove_file(entry.path()) {
                result = Err(ReportError::Earlier { file: entry.path(), error });
            }
        }
        result
    }
}

/// The histograms of a run: file names and texts.
fn histograms(run: &Run) -> Vec<(String, String)> {
    let (status, histograms) = (&run.end.status, &run.measured.histograms);
    let mut files = vec![
        ("wake.hgrm".to_owned(), distribution(&histograms.wake, status.wake_max)),
        ("jitter.hgrm".to_owned(), distribution(&histograms.jitter, status.jitter_max)),
    ];
    if let Some(reference) = &status.reference {
        files.push(("reference.hgrm".to_owned(), distribution(&histograms.reference, reference.error_max)));
    }
    for stage in Stage::ALL {
        let text = distribution(histograms.stage(stage), status.stage_max[stage as usize]);
        files.push((format!("stage-{}.hgrm", stage.name()), text));
    }
    for (drive, measured) in run.end.drives.iter().zip(&histograms.drives) {
        let (name, peaks) = (&drive.name, &drive.peaks);
        files.push((format!("rtt-{name}.hgrm"), distribution(&measured.rtt, peaks.rtt)));
        let text = distribution(&measured.send_jitter, peaks.send_jitter);
        files.push((format!("send-jitter-{name}.hgrm"), text));
        files.push((format!("age-{name}.hgrm"), distribution(&measured.age, peaks.age)));
    }
    files
}

/// An earlier run, with the name by which a report calls it.
#[doc(hidden)]
pub fn earlier_run(file: &Path) -> Result<(String, Archive), ArchiveError> {
    let earlier = Archive::read(file)?;
    // The directory of an earlier report says more than the name that all of these files have.
    let directory = file.parent().and_then(Path::file_name).filter(|_| file.ends_with(FILES[2]));
    let name = directory.or(file.file_name()).unwrap_or(file.as_os_str());
    Ok((name.to_string_lossy().into_owned(), earlier))
}

/// What became of the drives, and of the program itself.
fn verdict(summary: &Summary) -> String {
    let named = |what: &str, chosen: &dyn Fn(&Drive) -> bool| {
        let names: Vec<&str> =
            summary.drives.iter().filter(|drive| chosen(drive)).map(|drive| drive.name.as_str()).collect();
        (!names.is_empty()).then(|| format!("{what}: {}", names.join(", ")))
    };
    let failures = summary.failures.iter().filter(|failure| failure.fails_run);
    let faults = [
        named("not online", &|drive| drive.losses == 0 && !drive.is_online()),
        named("lost on the way", &|drive| drive.losses > 0),
        named("stopped by an overrun", &Drive::was_overrun),
    ];
    let stopped = summary.stopped_axes().map(|axes| format!("stopped: {axes}"));
    let failures = failures.map(|failure| failure.what.clone());
    let faults: Vec<String> = faults.into_iter().flatten().chain(stopped).chain(failures).collect();
    match faults.as_slice() {
        [] => "every drive answered, none was lost on the way or stopped, and all were online at the end"
            .to_owned(),
        faults => faults.join("; "),
    }
}

/// Whether a histogram, or a plot of an earlier version, has that name; see the table above.
fn is_ours(name: &str) -> bool {
    let histogram = |name: &str| {
        ["wake", "jitter", "reference"].contains(&name)
            || ["stage-", "rtt-", "send-jitter-", "age-"].iter().any(|kind| name.starts_with(kind))
    };
    name.strip_suffix(".hgrm").is_some_and(histogram) || PLOTS.contains(&name)
}
