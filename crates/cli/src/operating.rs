//! Whoever operates the axes of a machine from this program: through the master that runs, or by one of its own. The
//! panel and the commands of the shell go the same way.

use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use fieldbeat_control::{AxisFacts, AxisState, OperateError, OperationState, Operator, Server, Station};
use fieldbeat_core::cycle::Plan;
use fieldbeat_master::Master;

use super::handler::serve;
use super::interrupt::{Interrupt, LOOK_EVERY};
use super::masters::Running;
use super::output::judge_end;
use super::serving::{Guarding, with_usual_black_box};
use super::{Stop, complain, run};

/// The longest that axes are waited for which their master stops.
pub const PATIENCE: Duration = Duration::from_secs(10);

/// The way to the axes.
pub struct Reached {
    /// Operates them, once it has taken them.
    pub operator: Operator,
    /// The process of the master, if that is another one.
    pub pid: Option<String>,
    /// The name of the operator.
    name: String,
    /// Where the master answers, if it is another process.
    path: Option<PathBuf>,
    master: Option<OwnMaster>,
}

/// A master of this process.
struct OwnMaster {
    master: Master,
    station: Station,
    /// Answers `fieldbeat status`, and whoever wants to know who operates.
    _control: Option<Server>,
}

/// How the axes are once nobody operates them any more, if somebody still knows.
pub type Left = Option<(Vec<AxisFacts>, OperationState)>;

impl Reached {
    /// Those of the master that runs, for `fieldbeat COMMAND`.
    pub fn remote(running: &Running, command: &str) -> Result<Reached, Stop> {
        let operator = Operator::remote(&running.path).map_err(Stop::failed)?;
        let (pid, path) = (Some(running.status["pid"].to_string()), Some(running.path.clone()));
        Ok(Reached { operator, pid, name: own_name(command), path, master: None })
    }

    /// Those of a master in this process, which it ends.
    pub fn alone(
        plan: Plan,
        guarding: Guarding,
        interrupt: &Interrupt,
        command: &str,
    ) -> Result<Reached, Stop> {
        let master = run::start(guarding.setup(with_usual_black_box(plan)), interrupt)?;
        let axes = run::all_axes(&master)?;
        let station = Station::start(axes, master.monitor()).map_err(Stop::failed)?;
        let operator = Operator::local(&station);
        // Without it all else works.
        let control = serve(&master, Some(station.clone())).ok();
        let master = Some(OwnMaster { master, station, _control: control });
        Ok(Reached { operator, pid: None, name: own_name(command), path: None, master })
    }

    /// The name of the operator, for others that want to be it.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Becomes the operator.
    pub fn take(&mut self) -> Result<(), OperateError> {
        self.operator.take(&self.name)
    }

    /// To be called often: here this program is the application. An error: the master of this process has ended.
    pub fn look(&self) -> Result<(), OperateError> {
        let Some(own) = &self.master else { return Ok(()) };
        if !own.master.is_running() || own.station.has_failed() {
            return Err(OperateError::Gone);
        }
        own.master.alive();
        Ok(())
    }

    /// Goes away: the master stops the axes and powers them off, or ends with that. Returns how they are then, and an
    /// error where a drive was left on.
    pub fn go(self) -> (Left, Result<(), Stop>) {
        let Reached { operator, name, path, master, .. } = self;
        drop(operator);
        let mut watcher = match (&path, &master) {
            (Some(path), _) => match Operator::remote(path) {
                Ok(watcher) => watcher,
                // It has ended, which was reported.
                Err(_) => return (None, Ok(())),
            },
            (_, Some(own)) => {
                own.master.stop();
                Operator::local(&own.station)
            }
            (None, None) => return (None, Ok(())),
        };
        let begun = Instant::now();
        let mut left = watcher.state(0);
        let goes_on = |state: &OperationState| match &master {
            // Its stop has bounds of its own.
            Some(own) => own.master.is_running(),
            // It learns that its operator has gone, and then stops the axes and switches them off.
            None if begun.elapsed() > PATIENCE => false,
            None => state.operator.as_ref() == Some(&name) || is_under_way(state),
        };
        while left.as_ref().is_ok_and(goes_on) {
            sleep(LOOK_EVERY);
            left = watcher.state(0);
        }
        if master.is_some() {
            // It may have ended since then.
            left = watcher.state(0);
        }
        let left = watcher.axes().ok().zip(left.ok());
        let Some(OwnMaster { master, .. }) = master else { return (left, Ok(())) };
        let run = master.finish();
        run.measured.black_boxes.iter().for_each(|written| complain(&written.to_string()));
        (left, judge_end(&run))
    }
}

/// Some command has not ended.
pub fn is_under_way(state: &OperationState) -> bool {
    state.axes.iter().any(|axis| !axis.commands.is_empty())
}

/// How an axis is, in a line.
pub fn described(facts: &AxisFacts, axis: &AxisState) -> String {
    let place = axis.position.map_or_else(String::new, |at| format!(" at {} {}", short(at), facts.unit));
    let power = if axis.powered { axis.state.as_str() } else { "power off" };
    format!("axis {}: {power}{place}", facts.name)
}

/// A number without digits that say nothing.
pub fn short(value: f64) -> String {
    let text = format!("{value:.6}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// The place of an axis in the plan of `config`.
pub fn place_of(config: &Path, plan: &Plan, name: &str) -> Result<usize, Stop> {
    let names: Vec<&str> = plan.axes().into_iter().map(|axis| axis.name.as_str()).collect();
    names.iter().position(|known| *known == name).ok_or_else(|| {
        let (config, known) = (config.display(), names.join(", "));
        Stop::usage(format!("{config} has no axis {name}; it has {known}"))
    })
}

fn own_name(command: &str) -> String {
    format!("fieldbeat {command} (pid {})", std::process::id())
}
