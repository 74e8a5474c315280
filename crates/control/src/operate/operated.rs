//! One axis under an operator: its commands that have not ended, how it is stopped, and what it reports.

use super::request::{AxisFacts, AxisLacks, AxisState, CommandEnd, Ended, Goal, Order};
use fieldbeat_core::axis::command::Jog;
use fieldbeat_core::axis::limits::check_command;
use fieldbeat_core::axis::{
    Abort, Axis, AxisError, BegunBy, Command, CommandId, EventKind, Link, MonitorChannel, Move, Outcome,
    Profile, StopThen, Target,
};

/// An axis and what is under way.
#[derive(Debug)]
pub struct Operated {
    axis: Axis,
    facts: AxisFacts,
    /// The commands that have not ended.
    open: Vec<(CommandId, &'static str)>,
    /// The stop that has not ended: while there is one, only a power off is accepted.
    stopping: Option<CommandId>,
    /// At the end of that stop its power goes off.
    then_off: bool,
}

impl Operated {
    /// An axis without an operator. `monitors`: what its drive reports in addition.
    pub fn new(axis: Axis, monitors: Vec<MonitorChannel>) -> Operated {
        let facts = facts(&axis, &monitors);
        Operated { axis, facts, open: Vec::new(), stopping: None, then_off: false }
    }

    /// The facts of the axis.
    pub fn facts(&self) -> &AxisFacts {
        &self.facts
    }

    /// Whether something is under way that the operator before has left.
    pub fn is_under_way(&self) -> bool {
        self.then_off || !self.open.is_empty()
    }

    /// Posts a command; its end is an event.
    pub fn command(&mut self, order: Order) -> Result<CommandId, String> {
        if self.stopping.is_some() && order != Order::Disable {
            return Err(self.is_stopping());
        }
        // One is enough, and leaves room for stops among the commands that act at once.
        if let Some(id) = self.disabling().filter(|_| order == Order::Disable) {
            return Ok(id);
        }
        self.post(self.meant(order))
    }

    /// Whether the axis does that, and within its limits, whatever state it is in.
    pub fn check(&self, order: Order) -> Result<(), String> {
        self.check_command(&self.meant(order))
    }

    /// The same of a velocity.
    pub fn check_jog(&self, velocity: f64) -> Result<(), String> {
        self.check_command(&self.jogging(velocity)?)
    }

    fn check_command(&self, command: &Command) -> Result<(), String> {
        check_command(self.axis.plan(), self.axis.lacks(), command).map_err(|failure| {
            let (axis, command) = (self.facts.name.clone(), command.name());
            AxisError::Refused { axis, command, failure }.to_string()
        })
    }

    fn meant(&self, order: Order) -> Command {
        match order {
            Order::Enable => Command::Enable,
            Order::Disable => Command::Disable,
            Order::Home => Command::Home,
            Order::Move { target, velocity, acceleration } => {
                let usual = self.axis.profile();
                let profile = Profile {
                    velocity: velocity.unwrap_or(usual.velocity),
                    acceleration: acceleration.unwrap_or(usual.acceleration),
                    deceleration: acceleration.unwrap_or(usual.deceleration),
                };
                let target = match target {
                    Goal::To(position) => Target::Absolute(position),
                    Goal::By(distance) => Target::Relative(distance),
                };
                Command::Move(Move { target, profile })
            }
            Order::ResetFault => Command::ResetFault,
            Order::Reset => Command::Reset,
        }
    }

    /// Begins a velocity, which the dead-man time of the axis ends unless it is renewed.
    pub fn jog(&mut self, velocity: f64) -> Result<CommandId, String> {
        if self.stopping.is_some() {
            return Err(self.is_stopping());
        }
        self.post(self.jogging(velocity)?)
    }

    fn jogging(&self, velocity: f64) -> Result<Command, String> {
        match &self.facts.lacks.jog {
            Some(why) => Err(format!("axis {} does not jog: {why}", self.facts.name)),
            None => Ok(Command::Jog(Jog { velocity, acceleration: self.axis.profile().acceleration })),
        }
    }

    /// Renews the velocity of its jog.
    pub fn renew(&mut self, velocity: f64) -> Result<(), AxisError> {
        self.axis.set_velocity(velocity)
    }

    /// The power off that has not ended.
    fn disabling(&self) -> Option<CommandId> {
        self.open.iter().find(|(_, name)| *name == Command::Disable.name()).map(|(id, _)| *id)
    }

    /// Stops it, whatever it does: what was commanded before is aborted. Power stays as it is, but that a power off
    /// follows where the stop has aborted one. Returns the stop that is under way; `None`: there is nothing to stop.
    pub fn stop(&mut self) -> Option<CommandId> {
        let active = self.axis.feedback().status.state.is_powered() || !self.open.is_empty();
        if active && self.stopping.is_none() {
            // It fails if the master has ended, or if so many stops are under way that one more changes nothing.
            self.then_off |= self.disabling().is_some();
            self.stopping = self.post(Command::Stop { deceleration: None }).ok();
        }
        self.stopping
    }

    /// The same, and at the end of the stop power off, unless its stop sequence holds it.
    pub fn retire(&mut self) {
        self.stop();
        self.then_off |= self.stopping.is_some() && !self.facts.holds;
    }

    fn is_stopping(&self) -> String {
        format!("axis {} is being stopped: wait until it stands", self.facts.name)
    }

    fn post(&mut self, command: Command) -> Result<CommandId, String> {
        let id = self.axis.post(command).map_err(|error| error.to_string())?;
        self.open.push((id, command.name()));
        Ok(id)
    }

    /// The next thing that happened to it, in words.
    pub fn next_event(&mut self) -> Option<(String, Option<CommandEnd>)> {
        let event = self.axis.event()?;
        let name = event.kind.fault().and_then(|code| self.axis.fault(code).name);
        let EventKind::Ended { id, command, outcome } = event.kind else {
            return Some((self.with_begin(event.kind.described(name), event.begun_by), None));
        };
        self.open.retain(|(open, _)| *open != id);
        if self.stopping == Some(id) {
            self.stopping = None;
            if std::mem::take(&mut self.then_off) {
                // Refused, it is off already, or the stop sequence of the master has it.
                let _ = self.post(Command::Disable);
            }
        }
        // It was this stop that replaced it.
        let by_stop = matches!(outcome, Outcome::Aborted(Abort::Replaced(by)) if Some(by) == self.stopping);
        let how = match outcome {
            Outcome::Done => Ended::Done,
            Outcome::Failed(_) => Ended::Failed,
            Outcome::Aborted(_) => Ended::Aborted,
        };
        let text = match by_stop {
            true => format!("{command} ended by a stop"),
            false => self.with_begin(format!("{command} {}", outcome.described(name)), event.begun_by),
        };
        Some((text, Some(CommandEnd { command: id.0, how })))
    }

    fn with_begin(&self, text: String, begun_by: Option<BegunBy>) -> String {
        BegunBy::after(text, begun_by, begun_by.and_then(|by| self.axis.name_of(by.axis)))
    }

    /// How it is.
    pub fn state(&self) -> AxisState {
        let feedback = self.axis.feedback();
        let status = &feedback.status;
        // A drive that has not answered yet stands nowhere.
        let seen = feedback.link != Link::Unseen;
        let known = |value: f64| (seen && value.is_finite()).then_some(value);
        AxisState {
            cycle: feedback.cycle,
            age: feedback.age,
            link: feedback.link.to_string(),
            not_connected: None,
            state: status.state.to_string(),
            powered: status.state.is_powered(),
            operational: feedback.is_operational(),
            stopped: (feedback.stopped).map(|cause| self.with_begin(cause.to_string(), feedback.begun_by)),
            fault: (status.fault != 0).then(|| self.axis.fault(status.fault).to_string()),
            warning: status.warning,
            sto_open: status.sto_open,
            homed: status.homed,
            moving: status.moving,
            in_target: status.in_target,
            position: known(status.position),
            demand: known(status.demand),
            velocity: known(status.velocity),
            current: known(status.current),
            monitors: status.monitor.iter().take(self.facts.monitors.len()).copied().collect(),
            commands: self.open.iter().map(|(_, name)| (*name).to_owned()).collect(),
            stopping: self.stopping.is_some(),
        }
    }
}

fn facts(axis: &Axis, monitors: &[MonitorChannel]) -> AxisFacts {
    let (plan, lacks) = (axis.plan(), axis.lacks());
    let why = |one: Option<&str>| lacks.control.or(one).map(str::to_owned);
    let no_dead_man =
        "its jog_deadman is off, so that nothing would end a jog that is not renewed: give it a time";
    let jog = why(lacks.velocities).or_else(|| plan.jog_deadman.is_none().then(|| no_dead_man.to_owned()));
    AxisFacts {
        name: plan.name.clone(),
        protocol: axis.acyclic().notation().protocol().to_owned(),
        unit: plan.units.unit.to_string(),
        position_limits: plan.limits.position,
        velocity_limit: plan.limits.velocity,
        velocity: plan.profile.velocity,
        holds: plan.stop.then == StopThen::Hold,
        lacks: AxisLacks { enable: why(lacks.enable), home: why(lacks.homing), step: why(lacks.moves), jog },
        monitors: monitors.iter().map(|channel| (channel.name.clone(), channel.unit.to_owned())).collect(),
    }
}
