//! `fieldbeat replay`: a recorded run through the same loop in virtual time, compared bit by bit.

use std::path::PathBuf;

use clap::Args;
use fieldbeat_replay::{Difference, LogEnd, Recorded, Replay as Machine, ReplayError, Verdict};
use serde_json::json;

use super::output::both;
use super::{Stop, complain, print};

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub struct Replay {
    /// A recording of a run with `--record FILE --record-wire`.
    file: PathBuf,
    /// Repeat up to this cycle only.
    #[arg(long, value_name = "CYCLE")]
    until: Option<u64>,
    /// Print the result as one JSON object.
    #[arg(long)]
    json: bool,
}

impl Replay {
    /// Repeats it.
    pub fn run(self) -> Result<(), Stop> {
        let recorded =
            Recorded::open(&self.file).and_then(Recorded::require_revision).map_err(Stop::usage)?;
        let machine = recorded.replay().map_err(|why| match why {
            // It was a machine, so its buses can be built: the log is not of it.
            ReplayError::Open(_) => Stop::failed(why),
            why => Stop::usage(why),
        })?;
        let mut machine = match self.until {
            Some(cycle) => machine.until(cycle),
            None => machine,
        };
        let verdict = machine.run();
        if let Some(other) = machine.other_plan() {
            complain(&format!("{}: its plan is another one to this program: {other}", self.file.display()));
        }
        let end = machine.log_end();
        let cut = self.cut(&end);
        let printed = match self.json {
            true => print(object(&verdict, &machine, cut.as_deref())),
            false => self.print(&verdict, &machine),
        };
        both(printed, self.judge(&verdict, cut))
    }

    fn print(&self, verdict: &Verdict, machine: &Machine) -> Result<(), Stop> {
        let Some(last) = verdict.last else { return print("no cycle is recorded") };
        let drives = machine.plan().axes().len();
        let equal = if verdict.difference.is_none() { "equal" } else { "equal before the difference" };
        print(format_args!(
            "cycles up to {last}, {drives} drives: {} telegrams with {} bytes are {equal}",
            verdict.telegrams, verdict.bytes
        ))
    }

    /// Why the record ends where it does, if that is not the end of the run.
    fn cut(&self, end: &LogEnd) -> Option<String> {
        match end {
            LogEnd::CutAt(_) => {
                Some("there was no room for more: its disk or this host was too slow for the wire".to_owned())
            }
            LogEnd::Broken(why) => Some(why.clone()),
            // A program that was killed.
            LogEnd::Unknown if self.until.is_none() => Some("it has no end".to_owned()),
            _ => None,
        }
    }

    fn judge(&self, verdict: &Verdict, cut: Option<String>) -> Result<(), Stop> {
        let file = self.file.display();
        if let Some(difference) = &verdict.difference {
            return Err(Stop::failed(format!("{file}: {difference}")));
        }
        let Some(last) = verdict.last else {
            let why = cut.unwrap_or("record a longer run".to_owned());
            return Err(Stop::failed(format!("{file} has no cycle: {why}")));
        };
        if let Some(other) = &verdict.other_inputs {
            return Err(Stop::failed(format!("{file}: no telegram differs, but in {other}")));
        }
        match (self.until, cut) {
            (Some(until), cut) if until > last => {
                let why = cut.unwrap_or("the run ended there".to_owned());
                Err(Stop::failed(format!("{file} ends with cycle {last}, before cycle {until}: {why}")))
            }
            (None, Some(why)) => {
                complain(&format!("{file} ends with cycle {last}: {why}"));
                Ok(())
            }
            _ => Ok(()),
        }
    }
}

fn object(verdict: &Verdict, machine: &Machine, cut: Option<&str>) -> serde_json::Value {
    let where_it_is = |difference: &Difference| {
        let Difference { cycle, drive, .. } = difference;
        json!({ "cycle": cycle, "drive": drive, "what": difference.to_string() })
    };
    json!({
        "equal": verdict.last.is_some() && verdict.is_equal(),
        "last": verdict.last,
        "telegrams": verdict.telegrams,
        "bytes": verdict.bytes,
        "difference": verdict.difference.as_ref().map(where_it_is),
        "other_inputs": verdict.other_inputs.as_ref().map(where_it_is),
        "other_plan": machine.other_plan(),
        "cut": cut,
    })
}
