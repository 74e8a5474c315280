//! `fieldbeat export`: a recording, or a file of the black box, for other programs.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use clap::{ArgGroup, Args};
use fieldbeat_capture::export::{Export as Exported, utc_ns};
use fieldbeat_record::blackbox::file;
use fieldbeat_record::file::save;
use fieldbeat_record::recording::blackbox::convert;
use fieldbeat_record::recording::csv::{PerTopic, Wide};
use fieldbeat_record::recording::perfetto::Trace;
use fieldbeat_record::recording::reading::{Entry, Reading, Wrong};
use fieldbeat_replay::{LogEnd, Recorded, ReplayError};

use super::{Stop, VERSION, complain};

/// Arguments of `export`.
#[derive(Debug, Args)]
#[command(after_help = "Example: fieldbeat export run.mcap --pcapng")]
#[command(group(ArgGroup::new("to").required(true).args(["csv", "perfetto", "pcapng", "mcap"])))]
pub struct Export {
    /// A recording (`--record`), or a file that the black box wrote.
    file: PathBuf,
    /// Tables for spreadsheets: a file of each topic in this directory, by default FILE without its extension; `-`
    /// prints one table of all axes.
    #[arg(long, value_name = "DIR")]
    csv: Option<Option<PathBuf>>,
    /// A trace for Perfetto or chrome://tracing: the stages of each cycle, commands, events, late cycles. By default
    /// FILE with the extension json; `-` prints it.
    #[arg(long, value_name = "OUT")]
    perfetto: Option<Option<PathBuf>>,
    /// A capture for Wireshark of all that was sent and received, from a recording with the wire (`--record-wire`). By
    /// default FILE with the extension pcapng; `-` prints it.
    #[arg(long, value_name = "OUT")]
    pcapng: Option<Option<PathBuf>>,
    /// A recording, from a file of the black box. By default FILE with the extension mcap.
    #[arg(long, value_name = "OUT")]
    mcap: Option<Option<PathBuf>>,
}

impl Export {
    /// Writes it.
    pub fn run(self) -> Result<(), Stop> {
        let name = self.file.display();
        let place = |out: Option<PathBuf>, usual| out.unwrap_or_else(|| self.file.with_extension(usual));
        // What no black box wrote may be a recording.
        let converted = match file::load(&self.file) {
            Ok((header, records)) => Some(convert(&header, &records).map_err(Stop::failed)?),
            Err(error) if matches!(error.why, file::Wrong::Foreign) => None,
            Err(file::ReadError { why: file::Wrong::Io(why), .. }) => {
                let remedy = "name a recording, or a file of the black box";
                return Err(Stop::usage(format!("cannot read {name}: {why}; {remedy}")));
            }
            Err(error) => return Err(Stop::usage(error)),
        };
        if let Some(out) = self.pcapng {
            return match converted {
                Some(_) => Err(Stop::usage(format!(
                    "{name} is a file of the black box, which has no telegrams; record the run with --record FILE \
                     --record-wire"
                ))),
                None => capture(&self.file, &place(out, "pcapng")),
            };
        }
        if let Some(out) = self.mcap {
            let out = place(out, "mcap");
            let bytes = converted.ok_or_else(|| {
                Stop::usage(format!("{name} is no file of a black box; a recording needs no --mcap"))
            })?;
            let taken = || io::Error::from(io::ErrorKind::AlreadyExists);
            let free = if out.exists() { Err(taken()) } else { Ok(()) };
            free.and_then(|()| save(&out, &bytes)).map_err(|why| refused(&out, &why))?;
            complain(&format!("{}: {} bytes", out.display(), bytes.len()));
            return Ok(());
        }
        let wrong = |wrong: Wrong| format!("{name}: {wrong}");
        let mut messages = match converted {
            Some(bytes) => Reading::of(bytes),
            None => Reading::open(&self.file).map_err(|why| Stop::usage(wrong(why)))?,
        }
        .peekable();
        // Nothing is made of a file that cannot be read at all.
        if let Some(Err(why)) = messages.next_if(|first| first.as_ref().is_err_and(Wrong::is_all)) {
            return Err(Stop::usage(wrong(why)));
        }
        let mut failed = None;
        let messages = messages.map_while(|message| message.map_err(|why| failed = Some(wrong(why))).ok());
        let prints = |out: &Path| out == Path::new("-");
        match (self.csv, self.perfetto) {
            (Some(Some(out)), _) if prints(&out) => printed(wide(messages)),
            (None, Some(Some(out))) if prints(&out) => {
                printed(events(io::stdout().lock(), messages).map(drop))
            }
            (Some(None), _) if self.file.extension().is_none() => {
                Err(Stop::usage(format!("{name} has no extension to leave out: name a directory, --csv DIR")))
            }
            (Some(directory), _) => per_topic(&place(directory, ""), messages),
            (None, Some(out)) => trace(&place(out, "json"), messages),
            (None, None) => Ok(()),
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

fn trace(out: &Path, messages: impl Iterator<Item = Entry>) -> Result<(), Stop> {
    let refused = |why: io::Error| refused(out, &why);
    let file = File::create_new(out).map_err(refused)?;
    match events(file, messages) {
        Ok(count) => {
            complain(&format!("{}: {count} events", out.display()));
            Ok(())
        }
        Err(why) => {
            // Half of it would be in the way of the next one.
            let _ = std::fs::remove_file(out);
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
        why => Stop::usage(why),
    })?;
    let utc_ns = Reading::open(file).map(utc_ns).map_err(Stop::usage)?;
    let program = format!("fieldbeat {VERSION}");
    let is_broken = if out == Path::new("-") {
        let export = Exported::new(BufWriter::new(io::stdout().lock()), &program, &plan, utc_ns);
        match export.and_then(|export| export.all(entries)) {
            Ok((_, is_broken)) => is_broken,
            Err(why) => return printed(Err(why)),
        }
    } else {
        let refused = |why: io::Error| refused(out, &why);
        let made = BufWriter::new(File::create_new(out).map_err(refused)?);
        let export = Exported::new(made, &program, &plan, utc_ns);
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
        _ => Wrong::Cut.to_string(),
    };
    Err(Stop::failed(format!("{}: {why}", file.display())))
}

/// Writes a trace. Returns how many events it has.
fn events(out: impl Write, mut messages: impl Iterator<Item = Entry>) -> io::Result<u64> {
    let mut trace = Trace::new(BufWriter::new(out))?;
    let mut end_ns = 0;
    messages.try_for_each(|message| {
        end_ns = end_ns.max(message.utc_ns);
        trace.enter(&message)
    })?;
    let (count, mut out) = trace.finish(end_ns)?;
    out.flush()?;
    Ok(count)
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
