//! The masters that run on this computer, as far as this user may reach their control sockets, and which of them a
//! command means.

use std::path::{Path, PathBuf};

use fieldbeat_config::demo::{DEMO_FILE, is_demo};
use fieldbeat_control::{AskError, ask, place};
use serde_json::{Value, json};

use super::Stop;

/// A master that runs.
#[derive(Debug)]
pub struct Running {
    /// The control socket.
    pub path: PathBuf,
    /// The answer to the first request.
    pub status: Value,
}

/// Which master is meant.
#[derive(Clone, Copy, Debug)]
pub struct Wanted<'a> {
    /// The one of this configuration; `None`: the one that runs.
    pub config: Option<&'a Path>,
    /// The one with this process id.
    pub pid: Option<u32>,
}

impl Running {
    /// The demo in one process, which has its configuration built in.
    fn is_demo(&self) -> bool {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let config = self.status["config"].as_str();
        name.starts_with("demo") && config.is_none_or(|config| config.starts_with(DEMO_FILE))
    }

    /// The machine of the master, and its process.
    fn name(&self) -> String {
        let config = self.status["config"].as_str().unwrap_or("the demo");
        format!("{config} (pid {})", self.status["pid"])
    }
}

impl Wanted<'_> {
    /// The one master that is meant. `Ok(None)`: none runs.
    pub fn find(self) -> Result<Option<Running>, Stop> {
        let (mut living, refused) = answering(&place::find(self.config));
        // The demo has a socket of its own, whichever way its configuration is named.
        if living.is_empty() && self.config.is_some_and(is_demo) {
            living = all();
            living.retain(Running::is_demo);
        }
        living.retain(|running| self.pid.is_none_or(|pid| running.status["pid"] == pid));
        match (living.len(), refused) {
            (0, Some(error)) if !is_gone(&error) => Err(Stop::failed(error)),
            (0 | 1, _) => Ok(living.pop()),
            _ => Err(Stop::usage(format!("several masters run: {}; choose one by --pid", names(&living)))),
        }
    }

    /// The message where none was found.
    pub fn missing(self) -> String {
        if let (None, (_, Some(error))) = (self.pid, answering(&place::find(self.config))) {
            return error.to_string();
        }
        let mut what = "no master".to_owned();
        if let Some(config) = self.config {
            what += &format!(" of {}", config.display());
        }
        if let Some(pid) = self.pid {
            what += &format!(" with pid {pid}");
        }
        what += " runs";
        match &others()[..] {
            "" if nix::unistd::geteuid().is_root() => format!("{what}; start it with `fieldbeat run`"),
            "" => format!("{what}; start it with `fieldbeat run`, or find that of another user with sudo"),
            others => format!("{what}; {others}"),
        }
    }
}

/// There is no process any more.
fn is_gone(error: &AskError) -> bool {
    matches!(error, AskError::Nobody(_) | AskError::Dead(_))
}

/// The masters that do run, where another one was meant; empty: none.
pub fn others() -> String {
    match &all()[..] {
        [] => String::new(),
        [one] => format!("the master of {} runs", one.name()),
        several => format!("other masters run: {}", names(several)),
    }
}

fn all() -> Vec<Running> {
    answering(&place::find(None)).0
}

fn names(masters: &[Running]) -> String {
    masters.iter().map(Running::name).collect::<Vec<_>>().join(", ")
}

/// Those that answer, and why the last of the others does not.
fn answering(paths: &[PathBuf]) -> (Vec<Running>, Option<AskError>) {
    let (mut living, mut refused) = (Vec::new(), None);
    for path in paths {
        match question(path) {
            Ok(status) => living.push(Running { path: path.clone(), status }),
            Err(error) => refused = Some(error),
        }
    }
    (living, refused)
}

/// The status of the master at `path`.
pub fn question(path: &Path) -> Result<Value, AskError> {
    ask(path, &json!({ "ask": "status" }))
}
