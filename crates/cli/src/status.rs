//! `fieldbeat status`: a running master, through its control socket.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use clap::Args;
use fieldbeat_control::AskError;
use serde_json::Value;

use super::interrupt::{Interrupt, LOOK_EVERY};
use super::masters::{Running, Wanted, question};
use super::{Stop, print, span};

/// Arguments of `status`.
#[derive(Debug, Args)]
pub struct Status {
    /// The configuration of the master; without it, the one that runs.
    config: Option<PathBuf>,
    /// The process id of the master, where several of one configuration run.
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
    /// Print one JSON object; `summary` has the measurements so far, with the keys of `run --json`.
    #[arg(long)]
    json: bool,
    /// Repeat until Ctrl-C, once in this time (100ms or more).
    #[arg(long, value_name = "TIME", value_parser = pause, num_args = 0..=1, default_missing_value = "1s")]
    watch: Option<Duration>,
}

impl Status {
    /// Requests the status.
    pub fn run(self) -> Result<(), Stop> {
        if let Some(config) = self.config.as_ref().filter(|config| !config.exists()) {
            let why =
                format!("{}: there is no such file; name the configuration of the master", config.display());
            return Err(Stop::usage(why));
        }
        let wanted = Wanted { config: self.config.as_deref(), pid: self.pid };
        let Some(Running { path, status: first }) = wanted.find()? else {
            return Err(Stop::failed(wanted.missing()));
        };
        let Some(every) = self.watch else { return self.show(&first) };
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        self.show(&first)?;
        while !interrupt.is_set() {
            let requested = Instant::now();
            while !interrupt.is_set() && requested.elapsed() < every {
                sleep(LOOK_EVERY.min(every));
            }
            // One that ends in the middle of an answer is gone at the next request.
            match question(&path).or_else(|_| question(&path)) {
                _ if interrupt.is_set() => break,
                Ok(status) => self.show(&status)?,
                Err(AskError::Nobody(_) | AskError::Dead(_)) => {
                    return Err(Stop::failed("the master has ended"));
                }
                Err(error) => return Err(Stop::failed(error)),
            }
        }
        Ok(())
    }

    fn show(&self, status: &Value) -> Result<(), Stop> {
        if self.json {
            let mut status = status.clone();
            if let Value::Object(object) = &mut status {
                object.remove("text");
            }
            return print(status);
        }
        let config = status["config"].as_str().unwrap_or("the demo");
        let text = status["text"].as_str().unwrap_or_default().trim_end();
        let head = format!(
            "{config}, pid {}, fieldbeat {}",
            status["pid"],
            status["version"].as_str().unwrap_or("?")
        );
        if self.watch.is_some() && std::io::stdout().is_terminal() {
            let rows = terminal_size::terminal_size_of(std::io::stdout()).map_or(24, |(_, rows)| rows.0);
            let mut out = std::io::stdout().lock();
            let shown =
                write!(out, "{}", screen(&format!("{head}\n{text}"), rows)).and_then(|()| out.flush());
            return shown.map_err(|error| Stop::failed(format!("cannot write to the terminal: {error}")));
        }
        print(format_args!("{head}\n{text}"))
    }
}

/// The fastest that anybody can read.
const SHORTEST_PAUSE: Duration = Duration::from_millis(100);

fn pause(text: &str) -> Result<Duration, String> {
    let pause = span(text)?;
    if pause < SHORTEST_PAUSE {
        return Err("must be 100ms or more: each request costs the master's computer time".to_owned());
    }
    Ok(pause)
}

/// The codes that draw `text` over the one before, on a terminal of `rows` rows. It never scrolls: what has no room is
/// left out, and the cursor has the last row.
fn screen(text: &str, rows: u16) -> String {
    let room = usize::from(rows).saturating_sub(1).max(1);
    let mut lines: Vec<&str> = text.lines().collect();
    let note;
    if lines.len() > room {
        note = format!("... {} more lines: make the terminal higher", lines.len() - (room - 1));
        lines.truncate(room - 1);
        lines.push(&note);
    }
    // From the top, without wrapping what is too wide; each line to its end, and what was below.
    format!("\x1b[H\x1b[?7l{}\x1b[K\n\x1b[J\x1b[?7h", lines.join("\x1b[K\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_screen_has_no_more_lines_than_its_terminal() {
        let text = "a\nb\nc\nd\ne";
        for (rows, shown) in [
            (0, "... 5 more lines: make the terminal higher"),
            (2, "... 5 more lines: make the terminal higher"),
            (4, "a\nb\n... 3 more lines: make the terminal higher"),
            (5, "a\nb\nc\n... 2 more lines: make the terminal higher"),
            (6, text),
            (24, text),
        ] {
            let drawn = screen(text, rows);
            let plain = ["\x1b[H", "\x1b[?7l", "\x1b[K", "\x1b[J", "\x1b[?7h"];
            let plain = plain.iter().fold(drawn, |drawn, sequence| drawn.replace(sequence, ""));
            assert_eq!(plain, format!("{shown}\n"), "{rows}");
        }
    }

    #[test]
    fn an_empty_search_pauses_between_requests() {
        assert_eq!(pause("100ms"), Ok(SHORTEST_PAUSE));
        for short in ["0s", "1ns", "99ms"] {
            assert!(pause(short).is_err_and(|why| why.contains("100ms or more")), "{short}");
        }
    }
}
