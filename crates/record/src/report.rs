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
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_telemetry::Run;
use fieldbeat_telemetry::signals::{JITTER, KEPT_OF_DRIVE, PHASE_ERROR, STAGE, WAKE, kept_of_loop};

/// The page and the files next to it.
const FILES: [&str; 3] = ["index.html", "summary.json", "run.json"];

/// The file from which a soak test goes on.
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
        /// The error of the operating system.
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
        /// The error of the operating system.
        error: io::Error,
    },
    /// A file of an earlier report is still there. This one is whole.
    #[error("report file {file} belongs to an earlier run and cannot be removed: {error}; remove it")]
    Earlier {
        /// The file.
        file: PathBuf,
        /// The error of the operating system.
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
    let once = [(&histograms.wake, status.wake_max), (&histograms.jitter, status.jitter_max)];
    let reference = status.reference.as_ref().map(|of| (&histograms.reference, of.error_max));
    let stages = histograms.stages.iter().zip(status.stage_max);
    let of_loop = kept_of_loop(once, reference, stages)
        .map(|(of, stage, (quantity, peak))| (of.file(stage), distribution(quantity, peak)));
    let of_drives = run.end.drives.iter().zip(&histograms.drives).flat_map(|(drive, measured)| {
        KEPT_OF_DRIVE.map(|(of, quantity, peak)| {
            (of.file(&drive.name), distribution(quantity(measured), peak(&drive.peaks)))
        })
    });
    of_loop.chain(of_drives).collect()
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

/// The outcome of the drives, and of the program itself.
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
    let mut of_parts = KEPT_OF_DRIVE.iter().map(|(of, ..)| of).chain([&STAGE]);
    let mut is_part = || of_parts.any(|of| name.starts_with(&format!("{}-", of.file)));
    let is_histogram = |name: &str| [WAKE, JITTER, PHASE_ERROR].iter().any(|of| of.file == name) || is_part();
    name.strip_suffix(".hgrm").is_some_and(is_histogram) || PLOTS.contains(&name)
}
