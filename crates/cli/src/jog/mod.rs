//! `fieldbeat jog`: a panel in the terminal that operates the axes of a running master, or of one of its own.

mod enabling;
mod hold;
mod panel;
mod terminal;
#[cfg(test)]
mod tests;
mod view;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use crossbeam_channel::RecvTimeoutError;
use fieldbeat_control::{HOLD_EVERY, OperateError, Order};
use fieldbeat_core::cycle::Plan;

use self::enabling::{Enabling, EnablingDevice};
use self::panel::{Panel, Want};
use self::terminal::{LOOK_EVERY, Terminal};
use super::interrupt::Interrupt;
use super::masters::Wanted;
use super::operating::{Left, Reached, described, place_of};
use super::output::both;
use super::serving::Guarding;
use super::{Stop, load, print};

/// How often the panel looks at the axes, and is drawn.
const SHOW_EVERY: Duration = Duration::from_millis(50);

/// A turn of the panel that took longer has hung: its process was stopped, or its terminal takes nothing.
const LONGEST_TURN: Duration = Duration::from_millis(300);

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

/// The name of its operator.
const COMMAND: &str = "jog";

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
    #[command(flatten)]
    guarding: Guarding,
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
            Some(running) => Reached::remote(&running, COMMAND)?,
            None if self.pid.is_some() => return Err(Stop::failed(wanted.missing())),
            None => Reached::alone(plan, self.guarding, &interrupt, COMMAND)?,
        };
        reached.take().map_err(Stop::failed)?;
        let result = self.operate(&mut reached, selected, device, &interrupt);
        let (left, ended) = reached.go();
        both(result, both(show(left), ended))
    }

    /// The index of the axis to begin with, if the numbers can be right.
    fn check(&self, plan: &Plan) -> Result<usize, Stop> {
        let axes = plan.axes();
        let index = self.axis.as_ref().map_or(Ok(0), |name| place_of(&self.config, plan, name))?;
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
        reached.take().map_err(Stop::failed)?;
        let file = self.config.file_name().unwrap_or_default().to_string_lossy();
        let title = match &reached.pid {
            Some(pid) => format!("the master (pid {pid}) of {file}"),
            None => format!("no master runs: this panel is the master of {file}"),
        };
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
        let mut operation = Operation { reached, jog: None, begun: Instant::now() };
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
            operation.reached.look().map_err(Stop::failed)?;
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
    reached: &'a mut Reached,
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
                    self.reached.operator.stop()
                }
                Want::Command(axis, order) => self.reached.operator.command(axis, order).map(|_| {
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
            (None, Some(velocity)) => self.reached.operator.jog(panel.selected, velocity).map(|number| {
                self.jog = Some((number, velocity, Instant::now()));
            }),
            (Some((number, velocity, held)), Some(wanted)) if velocity == wanted => {
                if held.elapsed() < HOLD_EVERY {
                    return Ok(());
                }
                self.jog = Some((number, velocity, Instant::now()));
                self.reached.operator.hold(number)
            }
            (Some((number, ..)), _) => {
                self.jog = None;
                panel.end_hold(self.now(), None);
                self.reached.operator.release(number)
            }
        };
        self.note(panel, done)
    }

    /// Looks at the axes.
    fn look(&mut self, panel: &mut Panel) -> Result<(), Stop> {
        let state = self.reached.operator.state(panel.noticed()).map_err(Stop::failed)?;
        if state.operator.is_none() {
            // The panel has hung for too long. What it operated is stopped, and moves again only by new keys.
            self.jog = None;
            let why = match self.reached.take() {
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

    /// Shows a refusal, which has stopped everything; other failures end the panel.
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

/// Prints how the axes were left.
fn show(left: Left) -> Result<(), Stop> {
    let Some((facts, state)) = left else { return Ok(()) };
    facts.iter().zip(&state.axes).try_for_each(|(facts, axis)| print(described(facts, axis)))
}
