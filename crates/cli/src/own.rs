//! A master of its own for one drive, which it moves: switched on, and ramped down and switched off at the end.

use std::thread::sleep;
use std::time::{Duration, Instant};

use fieldbeat_core::axis::{Axis, Link};
use fieldbeat_core::bus::diagnosis::NOT_YET;
use fieldbeat_master::Master;
use fieldbeat_tools::{Check, Drive, OwnMaster, Task};

use super::interrupt::{Interrupt, LOOK_EVERY};
use super::masters::Wanted;
use super::output::{both, judge_end};
use super::serving::Guarding;
use super::{Stop, print, reach, run};

/// A drive that is there answers sooner.
const PATIENCE: Duration = Duration::from_secs(5);

/// The master and its one drive.
pub struct Own<'a> {
    master: Master,
    axis: Axis,
    interrupt: &'a Interrupt,
}

impl<'a> Own<'a> {
    /// Starts it; refused next to a master that runs, and by `check`.
    pub fn start(
        drive: &Drive,
        guarding: Guarding,
        check: Check<'_>,
        interrupt: &'a Interrupt,
    ) -> Result<Own<'a>, Stop> {
        let Drive { config, drive, pid } = drive;
        let (plan, notation) = reach::find(config, drive)?;
        if let Some(axis) = plan.axes().into_iter().find(|axis| axis.name == *drive) {
            check(axis, &*notation)?;
        }
        if reach::running(Wanted { config: Some(config), pid: *pid }, drive)?.is_some() {
            let why = "a master runs, and it alone moves its drives: end it first";
            return Err(Stop::failed(format!("drive {drive}: {why}")));
        }
        let Some(plan) = plan.alone(drive) else {
            return Err(Stop::failed(format!("drive {drive} cannot be reached alone")));
        };
        let master = run::start(guarding.setup(Master::from_plan(plan)), interrupt)?;
        let axis = master.axis(drive).map_err(Stop::failed)?;
        Ok(Own { master, axis, interrupt })
    }
}

impl OwnMaster for Own<'_> {
    fn axis(&mut self) -> &mut Axis {
        &mut self.axis
    }

    fn run(self: Box<Self>, task: Task<'_>) -> Result<(), Stop> {
        let Own { master, mut axis, interrupt } = *self;
        await_idle(&master, &axis, interrupt)?;
        let done = task(&mut axis, &mut || {
            if interrupt.is_set() {
                return Err(Stop::failed("interrupted"));
            }
            if !master.is_running() {
                return Err(Stop::failed("the master has ended: start again"));
            }
            sleep(LOOK_EVERY);
            master.alive();
            Ok(())
        });
        let interrupted = interrupt.is_set();
        // Whatever came of it: down a ramp, and off.
        master.stop();
        while master.is_running() {
            sleep(LOOK_EVERY);
        }
        let feedback = axis.feedback();
        let ended = judge_end(&master.finish());
        let name = axis.name();
        let done = match done {
            Ok(()) => {
                let position = feedback.status.position;
                print(format_args!("drive {name}: {position:.4} {}", axis.plan().units.unit))
            }
            Err(_) if interrupted => {
                let left = match feedback.status.state.is_powered() {
                    false => "switched off".to_owned(),
                    true => format!("left in {}", feedback.status.state),
                };
                Err(Stop::failed(format!("drive {name}: interrupted; ramped down and {left}")))
            }
            Err(stop) => Err(stop),
        };
        both(done, ended)
    }
}

/// Waits for the drive, of which nothing was requested yet; refuses one that somebody else has switched on.
fn await_idle(master: &Master, axis: &Axis, interrupt: &Interrupt) -> Result<(), Stop> {
    let begun = Instant::now();
    while axis.feedback().link != Link::Online {
        if interrupt.is_set() {
            return Err(Stop::failed("interrupted; nothing was moved"));
        }
        if begun.elapsed() > PATIENCE {
            let (name, why) = (axis.name(), master.not_connected(0));
            let why = why.as_deref().unwrap_or(NOT_YET);
            return Err(Stop::failed(format!("drive {name} cannot be reached: {why}")));
        }
        sleep(LOOK_EVERY);
        master.alive();
    }
    let found = axis.feedback();
    if found.status.state.is_powered() || found.status.moving {
        return Err(Stop::failed(format!(
            "drive {} is switched on ({}): another master moves it; end that first",
            axis.name(),
            found.status.state
        )));
    }
    Ok(())
}
