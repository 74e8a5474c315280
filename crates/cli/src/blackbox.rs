//! `fieldbeat blackbox`: what led up to a failure.

use std::path::PathBuf;

use clap::Args;
use fieldbeat_record::blackbox::left::{Orphan, Other};
use fieldbeat_record::blackbox::list::Listing;
use fieldbeat_record::blackbox::{default_directory, events, file};
use serde_json::json;

use super::{Stop, complain, print, show};

/// Arguments of `blackbox`.
#[derive(Debug, Args)]
pub struct BlackBox {
    /// A file that the master wrote at a fault, a lost drive, another stop, or SIGUSR1; or any recording: what led to
    /// its end.
    #[arg(required_unless_present = "list", conflicts_with = "list")]
    file: Option<PathBuf>,
    /// List the files of the directory to which the master writes them, the newest first.
    #[arg(long)]
    list: bool,
    /// The directory to list; without it the state directory of the service, or of the user.
    #[arg(long, value_name = "DIR", requires = "list")]
    black_box: Option<PathBuf>,
    /// Show this many cycles before the failure as a table, and a quarter as many after it.
    #[arg(long, value_name = "N", default_value_t = 20)]
    cycles: u64,
    /// Print the header, the events and the tables of the drives, or the list, as one JSON object.
    #[arg(long)]
    json: bool,
}

impl BlackBox {
    /// Prints it.
    pub fn run(self) -> Result<(), Stop> {
        let Some(path) = &self.file else { return self.list() };
        let (header, records) = file::load(path).map_err(|wrong| {
            let remedy = if wrong.is_all() { "" } else { "; copy it again from where it was written" };
            Stop::usage(format!("{}: {wrong}{remedy}", path.display()))
        })?;
        if self.json {
            let happened = events::events(&header, &records);
            let drives = events::courses(&header, &records, &happened, self.cycles);
            return print(json!({ "header": header, "happened": happened, "drives": drives }));
        }
        print(events::text(&header, &records, self.cycles).trim_end())
    }

    fn list(self) -> Result<(), Stop> {
        let directory = self.black_box.unwrap_or_else(default_directory);
        // What a program that was killed has left is in no file before somebody makes one of it.
        for orphan in Orphan::all(&directory) {
            let (file, why) = (orphan.path(), orphan.due().why.clone());
            match orphan.save() {
                Ok(()) => complain(&format!("{why}: its last cycles are now in {}", file.display())),
                Err(error) => complain(&format!(
                    "{why}, and its last cycles are still in memory only: cannot write {}: {error}; free that disk, \
                     or become the user whose directory it is",
                    file.display()
                )),
            }
        }
        for process in Orphan::guarded(&directory) {
            complain(&format!(
                "process {process} was killed, or crashed, and its guardian still stops its drives: list again in some \
                 seconds"
            ));
        }
        for Other { path, directory } in Orphan::others(&directory) {
            let remedy = match directory {
                Some(directory) => format!(
                    "a program whose black box is in {0}; `fieldbeat blackbox --list --black-box {0}` makes a file \
                     of it",
                    directory.display()
                ),
                None => "another version; list its black boxes with that one, or remove it".to_owned(),
            };
            complain(&format!("{} was left by {remedy}", path.display()));
        }
        let listing = Listing::of(&directory).map_err(|error| {
            let remedy = "name a directory that this user may read, with --black-box DIR";
            Stop::usage(format!("cannot list {}: {error}; {remedy}", directory.display()))
        })?;
        if self.json {
            return print(serde_json::to_string(&listing).map_err(Stop::failed)?);
        }
        show(listing)
    }
}
