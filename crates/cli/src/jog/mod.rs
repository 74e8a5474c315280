//! `fieldbeat jog`: a panel in the terminal that operates the axes of a running master, or of one of its own.

mod enabling;
mod hold;
mod panel;
mod terminal;
#[cfg(test)]
mod tests;
mod view;

use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use crossbeam_channel::RecvTimeoutError;
use fieldbeat_control::{
    AxisFacts, HOLD_EVERY, OperateError, OperationState, Operator, Order, Server, Station,
};
use fieldbeat_core::cycle::Plan;
use fieldbeat_master::Master;
use fieldbeat_record::blackbox::default_directory;

use self::enabling::{Enabling, EnablingDevice};
use self::panel::{Panel, Want, short};
use self::terminal::{LOOK_EVERY, Terminal};
use super::handler::serve;
use super::interrupt::Interrupt;
use super::masters::Wanted;
use super::output::{both, judge_end};
use super::{Stop, complain, load, print, run};

/// How often the panel looks at the axes, and is drawn.
const SHOW_EVERY: Duration = Duration::from_millis(50);

/// A turn of the panel that took longer has hung: its process was stopped, or its terminal takes nothing.
const LONGEST_TURN: Duration = Duration::from_millis(300);

/// The longest that the axes are waited for at the end.
const PATIENCE: Duration = Duration::from_secs(10);

/// The command.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// A panel in the terminal: enable, home, step and hold-to-run, through the running master or by one of its own.
    Jog(Jog),
}

impl Command {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let Command::Jog(jog) = self;
        jog.run()
    }
}

/// Arguments of `jog`.
#[derive(Debug, Args)]
pub struct Jog {
    /// The configuration of the machine. If its master runs, with --allow-control, the panel operates that; else it
    /// runs the master itself.
    config: PathBuf,
    /// The axis to begin with.
    #[arg(long, value_name = "NAME")]
    axis: Option<String>,
    /// The velocity of jogs and steps, in the units of the axis per second; without it a tenth of its profile.
    #[arg(long, value_name = "UNITS/S")]
    velocity: Option<f64>,
    /// The distance of a step, in the units of the axis.
    #[arg(long, value_name = "UNITS")]
    step: Option<f64>,
    /// A button or pedal at this computer, as the kernel names it below /dev/input, that has to be held while anything
    /// moves.
    #[arg(long, value_name = "PATH")]
    enable_device: Option<PathBuf>,
    /// The process id of the master, where several of this configuration run.
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
}

impl Jog {
    /// Runs the panel.
    pub fn run(self) -> Result<(), Stop> {
        let plan = load(&self.config)?;
        let selected = self.check(&plan)?;
        let device = self.enable_device.as_deref().map(EnablingDevice::open).transpose()?;
        terminal::require()?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let wanted = Wanted { config: Some(&self.config), pid: self.pid };
        let mut reached = match wanted.find()? {
            Some(running) => Reached::remote(&running.path, &running.status["pid"].to_string())?,
            None if self.pid.is_some() => return Err(Stop::failed(wanted.missing())),
            None => Reached::alone(plan, &interrupt)?,
        };
        let result = self.operate(&mut reached, selected, device, &interrupt);
        let ended = reached.leave();
        both(result, ended)
    }

    /// The index of the axis to begin with, if the numbers can be right.
    fn check(&self, plan: &Plan) -> Result<usize, Stop> {
        let axes = plan.axes();
        let index = match &self.axis {
            None => 0,
            Some(name) => axes.iter().position(|axis| axis.name == *name).ok_or_else(|| {
                let known: Vec<&str> = axes.iter().map(|axis| axis.name.as_str()).collect();
                Stop::usage(format!(
                    "{} has no axis {name}; it has {}",
                    self.config.display(),
                    known.join(", ")
                ))
            })?,
        };
        let Some(axis) = axes.get(index) else {
            return Err(Stop::usage(format!("{} has no axis to jog", self.config.display())));
        };
        for (option, value) in [("--velocity", self.velocity), ("--step", self.step)] {
            if value.is_some_and(|value| !(value.is_finite() && value > 0.0)) {
                return Err(Stop::usage(format!("{option} must be a number above 0")));
            }
        }
        if let (Some(velocity), Some(most)) = (self.velocity, axis.limits.velocity)
            && velocity > most
        {
            let unit = axis.units.unit;
            return Err(Stop::usage(format!(
                "--velocity {velocity}: axis {} is limited to {most} {unit}/s; give less",
                axis.name
            )));
        }
        Ok(index)
    }

    fn operate(
        &self,
        reached: &mut Reached,
        selected: usize,
        mut device: Option<EnablingDevice>,
        interrupt: &Interrupt,
    ) -> Result<(), Stop> {
        let mut terminal = Terminal::take()?;
        // A terminal that answers late may have cost the operation, with which nothing was done yet.
        reached.operator.take(&own_name()).map_err(Stop::failed)?;
        let file = self.config.file_name().unwrap_or_default().to_string_lossy();
        let title = format!("{} of {file}", reached.title);
        let mut panel = Panel::new(
            title,
            reached.operator.axes().map_err(Stop::failed)?,
            selected,
            terminal.has_releases,
        );
        panel.colours = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
        panel.enabling = device.is_some().then_some(Enabling::Released);
        if let Some(velocity) = self.velocity {
            panel.velocities[selected] = velocity;
        }
        if let Some(step) = self.step {
            panel.steps[selected] = step;
        }
        let mut operation = Operation { operator: &mut reached.operator, jog: None, begun: Instant::now() };
        let mut shown: Option<Instant> = None;
        // Nor what was typed before the panel is shown.
        panel.ignore_keys(operation.now());
        let mut turned = Instant::now();
        loop {
            if turned.elapsed() > LONGEST_TURN {
                // What was typed meanwhile is still to be read.
                panel.ignore_keys(operation.now());
            }
            turned = Instant::now();
            if interrupt.is_set() || !terminal.is_there() {
                return Ok(());
            }
            if let Some(own) = &reached.master {
                if !own.master.is_running() || own.station.has_failed() {
                    return Err(Stop::failed(OperateError::Gone));
                }
                own.master.alive();
            }
            // All that came, and then what follows from it: what is older than the last of it counts for nothing.
            let mut next = terminal.events.recv_timeout(LOOK_EVERY);
            if let Some(device) = &mut device {
                let wants = panel.enable(operation.now(), device.look());
                operation.perform(&mut panel, wants)?;
            }
            while let Ok((at, event)) = next {
                if operation.event(&mut panel, at, &event)? {
                    return Ok(());
                }
                next = terminal.events.try_recv().map_err(|_| RecvTimeoutError::Timeout);
            }
            if matches!(next, Err(RecvTimeoutError::Disconnected)) {
                return Ok(());
            }
            operation.jog(&mut panel)?;
            if shown.is_none_or(|shown| shown.elapsed() >= SHOW_EVERY) {
                operation.look(&mut panel)?;
                let gone = |error| Stop::failed(format!("the terminal is gone: {error}"));
                let area = terminal.screen.size().map_err(gone)?;
                panel.fits = view::fits(ratatui::layout::Rect::new(0, 0, area.width, area.height));
                terminal.screen.draw(|frame| view::draw(frame, &panel)).map_err(gone)?;
                shown = Some(Instant::now());
            }
        }
    }
}

/// The panel and the operator of its axes, joined.
struct Operation<'a> {
    operator: &'a mut Operator,
    /// The jog that runs, its velocity, and when it was held.
    jog: Option<(u64, f64, Instant)>,
    begun: Instant,
}

impl Operation<'_> {
    fn now(&self) -> Duration {
        self.begun.elapsed()
    }

    /// Does what an event of the terminal wants; whether the panel ends.
    fn event(
        &mut self,
        panel: &mut Panel,
        at: Instant,
        event: &ratatui::crossterm::event::Event,
    ) -> Result<bool, Stop> {
        let at = at.saturating_duration_since(self.begun);
        let wants = panel.event(at, self.now(), event);
        self.perform(panel, wants)
    }

    /// Does what is wanted; whether the panel ends.
    fn perform(&mut self, panel: &mut Panel, wants: Vec<Want>) -> Result<bool, Stop> {
        for want in wants {
            let done = match want {
                Want::Quit => return Ok(true),
                Want::Stop => {
                    self.jog = None;
                    self.operator.stop()
                }
                Want::Command(axis, order) => self.operator.command(axis, order).map(|_| {
                    // Until the axes are looked at again.
                    panel.state.axes[axis].commands.push(name(order).to_owned());
                }),
            };
            self.note(panel, done)?;
        }
        Ok(false)
    }

    /// Begins, holds or ends a jog, as the run key is.
    fn jog(&mut self, panel: &mut Panel) -> Result<(), Stop> {
        let done = match (self.jog, panel.jogs(self.now())) {
            (None, None) => Ok(()),
            (None, Some(velocity)) => self.operator.jog(panel.selected, velocity).map(|number| {
                self.jog = Some((number, velocity, Instant::now()));
            }),
            (Some((number, velocity, held)), Some(wanted)) if velocity == wanted => {
                if held.elapsed() < HOLD_EVERY {
                    return Ok(());
                }
                self.jog = Some((number, velocity, Instant::now()));
                self.operator.hold(number)
            }
            (Some((number, ..)), _) => {
                self.jog = None;
                panel.end_hold(self.now(), None);
                self.operator.release(number)
            }
        };
        self.note(panel, done)
    }

    /// Looks at the axes.
    fn look(&mut self, panel: &mut Panel) -> Result<(), Stop> {
        let state = self.operator.state(panel.noticed()).map_err(Stop::failed)?;
        if state.operator.is_none() {
            // The panel has hung for too long. What it operated is stopped, and moves again only by new keys.
            self.jog = None;
            let why = match self.operator.take(&own_name()) {
                Ok(()) => "this panel was silent for too long: all axes were stopped".to_owned(),
                Err(why) => why.to_string(),
            };
            panel.end_hold(self.now(), Some(why));
        }
        if let Some((number, ..)) = self.jog
            && state.jog.is_none_or(|(running, _)| running != number)
        {
            self.jog = None;
            panel.end_hold(self.now(), Some("the jog has ended: see the events".to_owned()));
        }
        panel.take(state);
        Ok(())
    }

    /// What is refused is shown, and has stopped everything; other failures end the panel.
    fn note(&mut self, panel: &mut Panel, done: Result<(), OperateError>) -> Result<(), Stop> {
        match done {
            Err(OperateError::Refused(why)) => {
                self.jog = None;
                panel.end_hold(self.now(), Some(why));
                Ok(())
            }
            done => done.map_err(Stop::failed),
        }
    }
}

/// As the commands are called in events.
fn name(order: Order) -> &'static str {
    match order {
        Order::Enable => "enable",
        Order::Disable => "disable",
        Order::Home => "home",
        Order::Move { .. } => "move",
        Order::ResetFault => "reset fault",
        Order::Reset => "reset",
    }
}

/// The way to the axes.
struct Reached {
    operator: Operator,
    /// What is operated, for the first line of the panel.
    title: String,
    /// Where the master answers, if it is another process.
    path: Option<PathBuf>,
    master: Option<OwnMaster>,
}

/// A master of the panel's own.
struct OwnMaster {
    master: Master,
    station: Station,
    /// Answers `fieldbeat status`, and a second panel that wants to know who operates.
    _control: Option<Server>,
}

impl Reached {
    fn remote(path: &Path, pid: &str) -> Result<Reached, Stop> {
        let mut operator = Operator::remote(path).map_err(Stop::failed)?;
        operator.take(&own_name()).map_err(Stop::failed)?;
        let title = format!("the master (pid {pid})");
        Ok(Reached { operator, title, path: Some(path.to_owned()), master: None })
    }

    fn alone(plan: Plan, interrupt: &Interrupt) -> Result<Reached, Stop> {
        let setup = Master::from_plan(plan).with_black_box(default_directory());
        let master = run::start(setup, interrupt)?;
        let axes = run::all_axes(&master)?;
        let station = Station::start(axes, master.monitor()).map_err(Stop::failed)?;
        let mut operator = Operator::local(&station);
        operator.take(&own_name()).map_err(Stop::failed)?;
        // Without it the panel works all the same.
        let control = serve(&master, Some(station.clone())).ok();
        let title = "no master runs: this panel is the master".to_owned();
        let master = OwnMaster { master, station, _control: control };
        Ok(Reached { operator, title, path: None, master: Some(master) })
    }

    /// Leaves the axes to their master, which stops them and powers them off, or ends it; prints how they are then.
    fn leave(self) -> Result<(), Stop> {
        let Reached { operator, path, master, .. } = self;
        drop(operator);
        let mut watcher = match (&path, &master) {
            (Some(path), _) => match Operator::remote(path) {
                Ok(watcher) => watcher,
                // It has ended, which was reported.
                Err(_) => return Ok(()),
            },
            (_, Some(own)) => {
                own.master.stop();
                Operator::local(&own.station)
            }
            (None, None) => return Ok(()),
        };
        let begun = Instant::now();
        let mut left = watcher.state(0);
        let goes_on = |state: &OperationState| match &master {
            // Its stop has bounds of its own.
            Some(own) => own.master.is_running(),
            // It learns that its operator has left, and then stops the axes and switches them off.
            None if begun.elapsed() > PATIENCE => false,
            None => {
                state.operator.as_ref() == Some(&own_name())
                    || state.axes.iter().any(|axis| !axis.commands.is_empty())
            }
        };
        while left.as_ref().is_ok_and(goes_on) {
            sleep(LOOK_EVERY);
            left = watcher.state(0);
        }
        if master.is_some() {
            // It may have ended since then.
            left = watcher.state(0);
        }
        let shown = match (watcher.axes(), left) {
            (Ok(facts), Ok(left)) => show_axes(&facts, &left),
            _ => Ok(()),
        };
        let Some(OwnMaster { master, .. }) = master else { return shown };
        let run = master.finish();
        run.measured.black_boxes.iter().for_each(|written| complain(&written.to_string()));
        both(shown, judge_end(&run))
    }
}

/// Prints how the axes are.
fn show_axes(facts: &[AxisFacts], state: &OperationState) -> Result<(), Stop> {
    for (facts, axis) in facts.iter().zip(&state.axes) {
        let place = axis.position.map_or_else(String::new, |at| format!(" at {} {}", short(at), facts.unit));
        let power = if axis.powered { axis.state.as_str() } else { "power off" };
        print(format_args!("axis {}: {power}{place}", facts.name))?;
    }
    Ok(())
}

fn own_name() -> String {
    format!("fieldbeat jog (pid {})", std::process::id())
}
