//! `fieldbeat export`: a recording, or a file of the black box, for other programs.

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use clap::{ArgGroup, Args};
use fieldbeat_capture::export::{Export as Exported, link_of, utc_ns};
use fieldbeat_record::recording::csv::{PerTopic, Wide};
use fieldbeat_record::recording::reading::{Entry, Reading, Wrong};
use fieldbeat_replay::{LogEnd, Recorded, ReplayError};

use super::{Stop, VERSION, complain};

/// Arguments of `export`.
#[derive(Debug, Args)]
#[command(after_help = "Example: fieldbeat export run.mcap --pcapng")]
#[command(group(ArgGroup::new("to").required(true).args(["csv", "pcapng"])))]
pub struct Export {
    /// A recording (`--record`), or a file that the black box wrote.
    file: PathBuf,
    /// Tables for spreadsheets: a file of each topic in this directory, by default FILE without its extension; `-`
    /// prints one table of all axes.
    #[arg(long, value_name = "DIR")]
    csv: Option<Option<PathBuf>>,
    /// A capture for Wireshark of all that was sent and received, from a recording with the wire (`--record-wire`). By
    /// default FILE with the extension pcapng; `-` prints it.
    #[arg(long, value_name = "OUT")]
    pcapng: Option<Option<PathBuf>>,
}

impl Export {
    /// Writes it.
    pub fn run(self) -> Result<(), Stop> {
        let name = self.file.display();
        let place = |out: Option<PathBuf>, usual| out.unwrap_or_else(|| self.file.with_extension(usual));
        if let Some(out) = self.pcapng {
            return capture(&self.file, &place(out, "pcapng"));
        }
        let wrong = |wrong: Wrong| format!("{name}: {}", wrong.exported());
        let opened = Reading::open(&self.file).map_err(|why| Stop::usage(wrong(why)))?;
        let mut messages = opened.peekable();
        // Nothing is made of a file that cannot be read at all.
        if let Some(Err(why)) = messages.next_if(|first| first.as_ref().is_err_and(Wrong::is_all)) {
            return Err(Stop::usage(wrong(why)));
        }
        let mut failed = None;
        let messages = messages.map_while(|message| message.map_err(|why| failed = Some(wrong(why))).ok());
        match self.csv {
            Some(Some(out)) if out == Path::new("-") => printed(wide(messages)),
            Some(None) if self.file.extension().is_none() => {
                Err(Stop::usage(format!("{name} has no extension to leave out: name a directory, --csv DIR")))
            }
            Some(directory) => per_topic(&place(directory, ""), messages),
            None => Ok(()),
        }?;
        failed.map_or(Ok(()), |why| Err(Stop::failed(why)))
    }
}

/// One table of all axes on standard output.
fn wide(mut messages: impl Iterator<Item = Entry>) -> io::Result<()> {
    let mut table = Wide::new(io::stdout().lock());
    messages.try_for_each(|message| table.enter(&message))?;
    table.finish()
}

/// A reader that has gone away (`| head`) is no error.
pub fn printed(written: io::Result<()>) -> Result<(), Stop> {
    match written {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Stop::failed(format!("cannot write to standard output: {error}; look at where it leads")))
        }
        _ => Ok(()),
    }
}

fn per_topic(directory: &Path, mut messages: impl Iterator<Item = Entry>) -> Result<(), Stop> {
    let refused = |why: io::Error| refused(directory, &why);
    let mut tables = PerTopic::new(directory).map_err(refused)?;
    let written = messages.try_for_each(|message| tables.enter(&message));
    match written.and_then(|()| tables.finish()) {
        Ok(count) => {
            complain(&format!("{}: {count} tables", directory.display()));
            Ok(())
        }
        Err(why) => {
            tables.withdraw();
            Err(refused(why))
        }
    }
}

/// The telegrams of a recording.
fn capture(file: &Path, out: &Path) -> Result<(), Stop> {
    let opened = Recorded::open(file).and_then(Recorded::entries);
    let (plan, entries, end) = opened.map_err(|why| match why {
        ReplayError::Code { path } => Stop::usage(format!(
            "{path} is of a machine that was built in code: the addresses of its drives are not in it"
        )),
        ReplayError::NoWire { path, why } => Stop::usage(format!(
            "{path} has no telegrams{why}; record the run with --record FILE --record-wire, or start it with \
             --black-box-wire for the files of its black box"
        )),
        why => Stop::usage(why),
    })?;
    let utc_ns = Reading::open(file).map(utc_ns).map_err(Stop::usage)?;
    let link = link_of(Reading::open(file).map_err(Stop::usage)?);
    let program = format!("fieldbeat {VERSION}");
    let is_broken = if out == Path::new("-") {
        let export = Exported::new(BufWriter::new(io::stdout().lock()), &program, &plan, utc_ns, link);
        match export.and_then(|export| export.all(entries)) {
            Ok((_, is_broken)) => is_broken,
            Err(why) => return printed(Err(why)),
        }
    } else {
        let refused = |why: io::Error| refused(out, &why);
        let made = BufWriter::new(File::create_new(out).map_err(refused)?);
        let export = Exported::new(made, &program, &plan, utc_ns, link);
        let (packets, is_broken) = export.and_then(|export| export.all(entries)).map_err(|why| {
            // Half of it would be in the way of the next one.
            let _ = std::fs::remove_file(out);
            refused(why)
        })?;
        complain(&format!("{}: {packets} packets", out.display()));
        is_broken
    };
    let why = match end() {
        LogEnd::Whole if !is_broken => return Ok(()),
        LogEnd::CutAt(cycle) => format!(
            "its wire ends before cycle {cycle}, since its disk or this host was too slow: what is there was exported"
        ),
        LogEnd::Broken(why) => format!("it is damaged ({why}): what is before that was exported"),
        _ if is_broken => "it is damaged (an entry of its log): what is before that was exported".to_owned(),
        _ => Wrong::Cut.exported(),
    };
    Err(Stop::failed(format!("{}: {why}", file.display())))
}

/// Why something cannot be written, and what to do.
fn refused(out: &Path, why: &io::Error) -> Stop {
    let out = out.display();
    match why.kind() {
        io::ErrorKind::AlreadyExists => {
            Stop::usage(format!("{out}: {why}; name another place, or remove it"))
        }
        io::ErrorKind::StorageFull | io::ErrorKind::FileTooLarge => {
            Stop::failed(format!("{out}: {why}; free that disk, or name a place on another one"))
        }
        _ => Stop::usage(format!("cannot write {out}: {why}; name a place that this user may write to")),
    }
}
