//! `fieldbeat scope`: a running master in the browser, and the same page of a master in this process.

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::sleep;

use clap::{Args, Subcommand};
use fieldbeat_config::demo::is_demo;
use fieldbeat_control::{About, Operator, Watch, Watched, place};
use fieldbeat_core::rt::confine::{Keep, give_up_rights};
use fieldbeat_record::metrics::{Address, address};
use fieldbeat_scope::{Control, Endpoint, Server, Source};
use fieldbeat_telemetry::Monitor;

use super::interrupt::{Interrupt, LOOK_EVERY};
use super::masters::Wanted;
use super::{Stop, complain, print};

/// Where the page is, unless another address is given.
const PORT: &str = "9465";

/// The command.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// A page in the browser of a running master: axes, cycle, trigger, cursors, export.
    Scope(Scope),
}

impl Command {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let Command::Scope(scope) = self;
        scope.run()
    }
}

/// Arguments of every command that runs a master: the same page of that one.
#[derive(Debug, Args)]
pub struct Page {
    /// Meanwhile serve a page for the browser at ADDR, or for this computer only; see `fieldbeat scope --help`.
    #[arg(long, value_name = "ADDR", value_parser = address, num_args = 0..=1, default_missing_value = PORT)]
    scope: Option<Address>,
}

/// It can be had.
#[derive(Debug)]
pub struct Served(Option<Endpoint>);

/// Answers for as long as it is held.
#[derive(Debug)]
pub struct Held(#[expect(dead_code, reason = "it is only held")] Option<Server>);

impl Page {
    /// Finds out whether it can be had, before anything is sent.
    pub fn prepare(self) -> Result<Served, Stop> {
        self.scope.map(bind).transpose().map(Served)
    }
}

impl Served {
    /// Answers with the cycles of the master behind `monitor`, if that is wanted.
    pub fn serve(self, monitor: &Monitor) -> Result<Held, Stop> {
        self.0.map(|endpoint| serve_own(endpoint, monitor)).transpose().map(Held)
    }
}

/// Arguments of `scope`.
#[derive(Debug, Args)]
pub struct Scope {
    /// The configuration of the master; it may be started later, and again.
    config: PathBuf,
    /// Where the page is served; a port alone is for this computer only, NAME:PORT for browsers that use another name
    /// of this computer. Beyond this computer the printed address has a token.
    #[arg(long, value_name = "ADDR", value_parser = address, default_value = PORT)]
    listen: Address,
    /// The process id of the master, where several of one configuration run.
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
    /// Let the page command the axes of a master that runs with --allow-control. The printed address then always has a
    /// token.
    #[arg(long)]
    control: bool,
}

impl Scope {
    /// Serves the page up to a signal.
    pub fn run(self) -> Result<(), Stop> {
        let Scope { config, listen, pid, control } = self;
        if !config.exists() {
            let why =
                format!("{}: there is no such file; name the configuration of the master", config.display());
            return Err(Stop::usage(why));
        }
        // Several of them are refused before anything is served.
        Wanted { config: Some(&config), pid }.find()?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let other = Other { config, pid };
        let control = control.then(|| Arc::new(other.clone()) as Arc<dyn Control>);
        let endpoint = Endpoint::bind(listen, control).map_err(Stop::usage)?;
        give_up_rights(Keep::Files);
        announce(&endpoint, |line| print(line))?;
        let server = endpoint.serve(other, None).map_err(Stop::failed)?;
        while !interrupt.is_set() {
            if server.has_failed() {
                return Err(Stop::failed(
                    "internal error: the scope panicked; start it again, and report it",
                ));
            }
            sleep(LOOK_EVERY);
        }
        Ok(())
    }
}

/// Says where the page is.
fn announce(endpoint: &Endpoint, say: impl Fn(&str) -> Result<(), Stop>) -> Result<(), Stop> {
    say(&format!("scope at {}", endpoint.url()))?;
    if !endpoint.address().ip().is_loopback() {
        complain(match endpoint.has_control() {
            true => {
                "whoever has this address, with its token, can MOVE the machine: enable, home and step its \
                 axes; nothing is encrypted"
            }
            false => "whoever has this address, with its token, can watch the machine; nothing is encrypted",
        });
    }
    Ok(())
}

/// A master in another process.
#[derive(Clone)]
struct Other {
    config: PathBuf,
    pid: Option<u32>,
}

impl Other {
    fn missing(&self) -> String {
        format!("no master of {} runs; start it with `fieldbeat run`", self.config.display())
    }

    /// The sockets that it may have. The demo has one of its own, whichever way its configuration is named.
    fn sockets(&self) -> Vec<PathBuf> {
        let named =
            |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("demo"));
        let found = place::find(Some(&self.config));
        match found.is_empty() && is_demo(&self.config) {
            true => place::find(None).into_iter().filter(named).collect(),
            false => found,
        }
    }
}

impl Control for Other {
    fn operator(&self) -> Result<Operator, String> {
        let wanted = Wanted { config: Some(&self.config), pid: self.pid };
        let found = wanted.find().map_err(|stop| stop.message)?.ok_or_else(|| self.missing())?;
        Operator::remote(&found.path).map_err(|error| error.to_string())
    }
}

impl Source for Other {
    fn open(&mut self) -> Result<(About, Watched), String> {
        let mut why = self.missing();
        for path in self.sockets() {
            match Watched::open(&path) {
                Ok((about, watched)) if self.pid.is_none_or(|pid| pid == about.pid) => {
                    return Ok((about, watched));
                }
                Ok(_) => {}
                Err(error) => why = error.to_string(),
            }
        }
        Err(why)
    }
}

/// The master of this process.
struct Own(Watch);

impl Source for Own {
    fn open(&mut self) -> Result<(About, Watched), String> {
        self.0.clone().local()
    }
}

/// Serves the page of the master behind `monitor`.
fn serve_own(endpoint: Endpoint, monitor: &Monitor) -> Result<Server, Stop> {
    announce(&endpoint, |line| {
        complain(line);
        Ok(())
    })?;
    endpoint.serve(Own(Watch::new(monitor)), monitor.granted().core).map_err(Stop::failed)
}

/// The address of a page that only looks, if it is to be had.
fn bind(address: Address) -> Result<Endpoint, Stop> {
    Endpoint::bind(address, None).map_err(Stop::usage)
}
