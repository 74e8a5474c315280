//! `fieldbeat axis`: one command of one axis, through the master that runs or by one of its own.
//!
//! The process is the operator of the axes for as long as its command lasts, under the rules of the panel: nothing
//! moves once it is gone. A command that has come to its own end leaves the axes of a running master as they are, so
//! that the next one finds its axis enabled and homed. Whatever ends the process sooner stops them and powers them off.

use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use fieldbeat_control::{
    Act, AxisFacts, AxisState, Ended, Goal, HOLD_EVERY, Notice, OperateError, OperationState, Order,
};
use serde_json::{Value, json};

use super::interrupt::{Interrupt, LOOK_EVERY};
use super::masters::Wanted;
use super::operating::{PATIENCE, Reached, described, is_under_way, place_of};
use super::output::both;
use super::reach::BringUp;
use super::serving::Guarding;
use super::{Stop, load, print, span};

/// The name of the operator.
const COMMAND: &str = "axis";

/// Arguments of `axis`.
#[derive(Debug, Args)]
pub struct Axis {
    /// The configuration of the machine. If its master runs, with --allow-control, the command goes through that.
    config: PathBuf,
    /// The name of the axis.
    name: String,
    #[command(subcommand)]
    does: Does,
    /// Print one JSON object: how the command ended, and how the axis is.
    #[arg(long, global = true)]
    json: bool,
    /// The process id of the master, where several of this configuration run.
    #[arg(long, value_name = "PID", global = true)]
    pid: Option<u32>,
    #[command(flatten)]
    guarding: Guarding,
}

#[derive(Debug, Subcommand)]
enum Does {
    /// Power on. It stays on when the command has ended; needs a running master.
    Enable,
    /// Power off at once: a motion ends without a ramp.
    Disable,
    /// The drive's own homing.
    Home {
        #[command(flatten)]
        enabled: Enabled,
    },
    /// A move to a position.
    MoveTo {
        /// The position, in the units of the axis.
        #[arg(allow_negative_numbers = true, value_parser = number)]
        position: f64,
        #[command(flatten)]
        along: Along,
        #[command(flatten)]
        first: First,
    },
    /// A move by a distance.
    MoveBy {
        /// The distance, in the units of the axis; below 0 backwards.
        #[arg(allow_negative_numbers = true, value_parser = number)]
        distance: f64,
        #[command(flatten)]
        along: Along,
        #[command(flatten)]
        first: First,
    },
    /// A velocity for a time, after which the axis ramps down.
    Jog {
        /// The velocity, in the units of the axis per second; below 0 backwards.
        #[arg(allow_negative_numbers = true, value_parser = number)]
        velocity: f64,
        /// For so long.
        #[arg(long = "for", value_name = "TIME", value_parser = span)]
        duration: Duration,
        #[command(flatten)]
        first: First,
    },
    /// Ramps the axis down, whoever operates it. It stays enabled.
    Stop,
    /// Resets a fault of the drive, and the stop of the axis. Power stays off.
    Reset,
}

#[derive(Debug, Args)]
struct Enabled {
    /// Enable the axis first, unless it is. If no master runs, this command is the master, and ends with power off.
    #[arg(long)]
    enable: bool,
}

#[derive(Debug, Args)]
struct First {
    #[command(flatten)]
    enabled: Enabled,
    /// Home the axis first, unless it is homed.
    #[arg(long)]
    home: bool,
}

#[derive(Debug, Args)]
struct Along {
    /// The velocity, in the units of the axis per second; without it that of its profile.
    #[arg(long, value_name = "UNITS/S", allow_negative_numbers = true, value_parser = above_zero)]
    velocity: Option<f64>,
    /// The acceleration and deceleration, in the units of the axis per second squared; without it those of its profile.
    #[arg(long, value_name = "UNITS/S2", allow_negative_numbers = true, value_parser = above_zero)]
    acceleration: Option<f64>,
}

fn number(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.parse().ok();
    number.filter(|number| number.is_finite()).ok_or_else(|| "must be a number, as 12.5 or -3".to_owned())
}

fn above_zero(text: &str) -> Result<f64, String> {
    let number = number(text).ok().filter(|number| *number > 0.0);
    number.ok_or_else(|| "must be a number above 0".to_owned())
}

/// It did not end as Done.
struct Cut {
    /// As `--json` has it.
    how: &'static str,
    why: String,
}

/// It was done, in words.
type Done = Result<String, Cut>;

/// The way that the axes are left.
enum Way {
    /// They were left in order, and this one is so.
    Left(Box<(AxisFacts, AxisState)>),
    /// Others have them.
    Apart,
    /// This process goes away from them.
    Goes,
}

impl Cut {
    fn refused(why: impl ToString) -> Cut {
        Cut { how: "refused", why: why.to_string() }
    }

    fn lost(why: impl ToString) -> Cut {
        Cut { how: "lost", why: why.to_string() }
    }
}

impl From<OperateError> for Cut {
    fn from(error: OperateError) -> Cut {
        match error {
            OperateError::Refused(why) => Cut::refused(why),
            error => Cut::lost(error),
        }
    }
}

/// As `--json` has it.
const INTERRUPTED: &str = "interrupted";

impl Does {
    fn name(&self) -> &'static str {
        match self {
            Does::Enable => "enable",
            Does::Disable => "disable",
            Does::Home { .. } => "home",
            Does::MoveTo { .. } => "move-to",
            Does::MoveBy { .. } => "move-by",
            Does::Jog { .. } => "jog",
            Does::Stop => "stop",
            Does::Reset => "reset",
        }
    }

    /// It makes sense by a master that ends with it: what ends motion and faults does, and what is to move says that
    /// power may come on for it.
    fn goes_alone(&self) -> bool {
        match self {
            Does::Enable => false,
            Does::Home { enabled } => enabled.enable,
            Does::MoveTo { first, .. } | Does::MoveBy { first, .. } | Does::Jog { first, .. } => {
                first.enabled.enable
            }
            Does::Disable | Does::Stop | Does::Reset => true,
        }
    }
}

impl Along {
    fn move_of(&self, target: Goal) -> Order {
        Order::Move { target, velocity: self.velocity, acceleration: self.acceleration }
    }
}

impl Axis {
    /// Does it.
    pub fn run(self) -> Result<(), Stop> {
        let plan = load(&self.config)?;
        place_of(&self.config, &plan, &self.name)?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let wanted = Wanted { config: Some(&self.config), pid: self.pid };
        let mut reached = match wanted.find()? {
            Some(running) => Reached::remote(&running, COMMAND)?,
            None if self.pid.is_some() => return Err(Stop::failed(wanted.missing())),
            None if !self.does.goes_alone() => return Err(self.needs_master(&wanted.missing())),
            None => Reached::alone(plan, self.guarding, &interrupt, COMMAND)?,
        };
        let (done, way) = self.operate(&mut reached, &interrupt)?;
        let (left, ended) = match way {
            Way::Left(left) => (Some(*left), Ok(())),
            Way::Apart => (None, Ok(())),
            Way::Goes => {
                let (left, ended) = reached.go();
                let of_axis = left.and_then(|(facts, state)| {
                    let at = self.find(&facts)?;
                    Some((facts.get(at)?.clone(), state.axes.get(at)?.clone()))
                });
                (of_axis, ended)
            }
        };
        both(self.report(done, left.as_ref()), ended)
    }

    fn needs_master(&self, missing: &str) -> Stop {
        let alone = match self.does {
            Does::Enable => "",
            _ => ", or add --enable: then this command is the master",
        };
        let config = self.config.display();
        Stop::failed(format!("{missing}; `fieldbeat run {config} --allow-control` takes this command{alone}"))
    }

    fn find(&self, facts: &[AxisFacts]) -> Option<usize> {
        facts.iter().position(|facts| facts.name == self.name)
    }

    /// How it ended, and what follows.
    fn operate(&self, reached: &mut Reached, interrupt: &Interrupt) -> Result<(Done, Way), Stop> {
        let all = reached.operator.axes().map_err(Stop::failed)?;
        let Some(index) = self.find(&all) else {
            let known: Vec<&str> = all.iter().map(|facts| facts.name.as_str()).collect();
            return Err(Stop::failed(format!(
                "the master that runs has no axis {}; it has {}: does it run another configuration?",
                self.name,
                known.join(", ")
            )));
        };
        let is_remote = reached.pid.is_some();
        let mut session = Session {
            typed: format!("fieldbeat axis {} {}", self.config.display(), self.name),
            facts: all[index].clone(),
            reached,
            interrupt,
            index,
            state: OperationState::default(),
            since: 0,
            operates: false,
        };
        let done = session.carry_out(&self.does, is_remote);
        let is_interrupted = matches!(&done, Err(cut) if cut.how == INTERRUPTED);
        if !is_remote || is_interrupted && session.operates {
            return Ok((done, Way::Goes));
        }
        if is_interrupted {
            return Ok((done, Way::Apart));
        }
        Ok(match session.hand_back() {
            Ok(axis) => (done, Way::Left(Box::new((session.facts, axis)))),
            Err(cut) => {
                let way = if session.operates { Way::Goes } else { Way::Apart };
                // What failed first is named.
                (done.and(Err(cut)), way)
            }
        })
    }

    /// Says how it ended.
    fn report(&self, done: Done, left: Option<&(AxisFacts, AxisState)>) -> Result<(), Stop> {
        let shown = left.map(|(facts, axis)| described(facts, axis));
        let (how, text) = match &done {
            Ok(text) => ("done", text.clone()),
            Err(Cut { how, why }) => (*how, why.clone()),
        };
        let printed = if self.json {
            print(self.object(how, &text, left))
        } else {
            shown.iter().filter(|_| done.is_ok()).try_for_each(print)
        };
        let judged = match (done, shown) {
            (Ok(_), _) => Ok(()),
            (Err(Cut { how: INTERRUPTED, .. }), Some(shown)) => {
                Err(Stop::failed(format!("interrupted; {shown}")))
            }
            (Err(Cut { why, .. }), _) => Err(Stop::failed(why)),
        };
        both(printed, judged)
    }

    fn object(&self, how: &str, text: &str, left: Option<&(AxisFacts, AxisState)>) -> Value {
        let mut object = json!({ "axis": self.name, "command": self.does.name(), "end": how, "text": text });
        if let (Some((facts, axis)), Value::Object(object)) = (left, &mut object) {
            let more = json!({
                "state": axis.state,
                "powered": axis.powered,
                "homed": axis.homed,
                "position": axis.position,
                "unit": facts.unit,
                "link": axis.link,
                "stopped": axis.stopped,
                "fault": axis.fault,
            });
            object.extend(
                more.as_object().into_iter().flatten().map(|(key, value)| (key.clone(), value.clone())),
            );
        }
        object
    }
}

/// The process and its axis.
struct Session<'a> {
    reached: &'a mut Reached,
    interrupt: &'a Interrupt,
    /// The text in front of a command to this axis.
    typed: String,
    facts: AxisFacts,
    index: usize,
    /// How the axes are.
    state: OperationState,
    /// The number of the last notice.
    since: u64,
    operates: bool,
}

impl Session<'_> {
    fn carry_out(&mut self, does: &Does, is_remote: bool) -> Done {
        let index = self.index;
        let command = |command| Act::Command { axis: index, command };
        let checked = match does {
            Does::Enable => Some(command(Order::Enable)),
            Does::Home { .. } => Some(command(Order::Home)),
            Does::MoveTo { position, along, .. } => Some(command(along.move_of(Goal::To(*position)))),
            Does::MoveBy { distance, along, .. } => Some(command(along.move_of(Goal::By(*distance)))),
            Does::Jog { velocity, .. } => Some(Act::Jog { axis: index, velocity: *velocity }),
            Does::Disable | Does::Stop | Does::Reset => None,
        };
        if let Some(act) = checked {
            self.reached.operator.check(act)?;
        }
        match does {
            // It waits for nobody.
            Does::Stop if is_remote => return self.stop(),
            _ => self.await_online()?,
        }
        match does {
            Does::Stop => return self.stop(),
            _ => self.take()?,
        }
        match does {
            Does::Enable => {
                self.require_unlatched()?;
                self.order(Order::Enable)
            }
            Does::Disable => self.order(Order::Disable),
            Does::Home { enabled } => {
                self.enable(enabled)?;
                self.order(Order::Home)
            }
            Does::MoveTo { position, along, first } => {
                self.make_ready(first)?;
                self.order(along.move_of(Goal::To(*position)))
            }
            Does::MoveBy { distance, along, first } => {
                self.make_ready(first)?;
                self.order(along.move_of(Goal::By(*distance)))
            }
            Does::Jog { velocity, duration, first } => {
                self.make_ready(first)?;
                self.jog(*velocity, *duration)
            }
            Does::Reset => self.reset(),
            Does::Stop => unreachable!("it takes nobody's place"),
        }
    }

    fn axis(&self) -> &AxisState {
        &self.state.axes[self.index]
    }

    /// A moment later: how the axes are, and what happened to this one. Each call is a sign of life.
    fn look(&mut self) -> Result<Vec<Notice>, Cut> {
        sleep(LOOK_EVERY);
        if self.interrupt.is_set() {
            return Err(Cut { how: INTERRUPTED, why: "interrupted; nothing was commanded".to_owned() });
        }
        self.reached.look()?;
        self.read()
    }

    fn read(&mut self) -> Result<Vec<Notice>, Cut> {
        self.state = self.reached.operator.state(self.since)?;
        if self.state.axes.len() <= self.index {
            return Err(Cut::lost("the master answers for other axes: is it another version?"));
        }
        if self.operates && self.state.operator.as_deref() != Some(self.reached.name()) {
            self.operates = false;
            return Err(Cut::lost(
                "this command was silent for too long, so that its master has stopped all axes and powered \
                 them off: look at the load of this computer",
            ));
        }
        let mut notices = std::mem::take(&mut self.state.notices);
        self.since = notices.last().map_or(self.since, |last| last.number);
        notices.retain(|notice| notice.axis == Some(self.index));
        Ok(notices)
    }

    fn await_online(&mut self) -> Result<(), Cut> {
        let mut waiting = BringUp::begun();
        self.read()?;
        while self.axis().link != "online" {
            let (name, why) = (&self.facts.name, self.axis().not_connected.clone());
            if let Some(why) = waiting.fails(why) {
                return Err(Cut::refused(format!("axis {name} is not online: {why}")));
            }
            self.look()?;
        }
        Ok(())
    }

    /// Becomes the operator, once the axes stand that the one before has left.
    fn take(&mut self) -> Result<(), Cut> {
        let begun = Instant::now();
        loop {
            match self.reached.take() {
                Ok(()) => break,
                Err(OperateError::Refused(why)) => {
                    self.look()?;
                    if self.state.operator.is_some() || begun.elapsed() > PATIENCE {
                        return Err(Cut::refused(why));
                    }
                }
                Err(error) => return Err(error.into()),
            }
        }
        self.operates = true;
        self.read().map(drop)
    }

    /// Nothing of the axis is latched.
    fn require_unlatched(&self) -> Result<(), Cut> {
        let (name, typed) = (&self.facts.name, &self.typed);
        match (self.axis().stopped.as_ref(), self.axis().fault.as_ref()) {
            (_, Some(fault)) => Err(Cut::refused(format!(
                "axis {name} has fault {fault}: remove its cause, then `{typed} reset`"
            ))),
            (Some(cause), None) => {
                Err(Cut::refused(format!("axis {name} is stopped ({cause}): `{typed} reset` first")))
            }
            (None, None) => Ok(()),
        }
    }

    /// It has power, or gets it.
    fn enable(&mut self, enabled: &Enabled) -> Result<(), Cut> {
        self.require_unlatched()?;
        if self.axis().operational {
            return Ok(());
        }
        if !enabled.enable {
            let (name, typed) = (&self.facts.name, &self.typed);
            return Err(Cut::refused(format!(
                "axis {name} is not enabled: `{typed} enable` first, or add --enable"
            )));
        }
        self.order(Order::Enable).map(drop)
    }

    /// It is ready for a motion, or is made so.
    fn make_ready(&mut self, first: &First) -> Result<(), Cut> {
        self.enable(&first.enabled)?;
        if self.axis().homed {
            return Ok(());
        }
        if first.home {
            return self.order(Order::Home).map(drop);
        }
        if self.facts.position_limits.is_some() {
            let (name, typed) = (&self.facts.name, &self.typed);
            return Err(Cut::refused(format!(
                "axis {name} has position limits and is not homed: `{typed} home` first, or add --home"
            )));
        }
        Ok(())
    }

    fn order(&mut self, order: Order) -> Done {
        let id = self.reached.operator.command(self.index, order)?;
        self.await_end(id)
    }

    /// Waits for the end of a command.
    fn await_end(&mut self, id: u64) -> Done {
        loop {
            let notices = self.look()?;
            let ended = notices.into_iter().find_map(|notice| {
                let end = notice.end.filter(|end| end.command == id)?;
                Some((end.how, notice.text))
            });
            if let Some((how, text)) = ended {
                return self.judge(how, text);
            }
        }
    }

    fn judge(&self, how: Ended, text: String) -> Done {
        let why = || format!("axis {}: {text}", self.facts.name);
        match how {
            Ended::Done => Ok(text),
            Ended::Failed => Err(Cut { how: "failed", why: why() }),
            Ended::Aborted => Err(Cut { how: "aborted", why: why() }),
        }
    }

    fn reset(&mut self) -> Done {
        let (fault, latch) = (self.axis().fault.is_some(), self.axis().stopped.is_some());
        let mut done = Ok("nothing to reset".to_owned());
        if fault {
            done = Ok(self.order(Order::ResetFault)?);
        }
        if latch {
            done = self.order(Order::Reset);
        }
        done
    }

    fn stop(&mut self) -> Done {
        self.read()?;
        let Some(id) = self.reached.operator.stop_axis(self.index)? else {
            return Ok("nothing to stop".to_owned());
        };
        self.await_end(id).map_err(|cut| match cut.how {
            INTERRUPTED => Cut { why: "interrupted; the axis goes on to stop".to_owned(), ..cut },
            _ => cut,
        })
    }

    /// Holds a velocity for so long, and waits until the axis stands.
    fn jog(&mut self, velocity: f64, duration: Duration) -> Done {
        let jog = self.reached.operator.jog(self.index, velocity)?;
        let begun = Instant::now();
        let mut held = begun;
        // What the axis says of the end of a jog that nobody has released.
        let mut said = None;
        while begun.elapsed() < duration {
            for Notice { text, end, .. } in self.look()? {
                if let Some(end) = end {
                    return self.judge(end.how, text);
                }
                said = Some(text);
            }
            if held.elapsed() >= HOLD_EVERY {
                held = Instant::now();
                match self.reached.operator.hold(jog) {
                    Err(OperateError::Refused(why)) => {
                        let why = said.unwrap_or(why);
                        return Err(Cut { how: "aborted", why: format!("axis {}: {why}", self.facts.name) });
                    }
                    held => held?,
                }
            }
        }
        self.reached.operator.release(jog)?;
        loop {
            for Notice { text, end, .. } in self.look()? {
                if let Some(end) = end.filter(|end| end.how == Ended::Failed) {
                    return self.judge(end.how, text);
                }
            }
            if self.axis().commands.is_empty() {
                return Ok("jog done".to_owned());
            }
        }
    }

    /// Leaves the axes to their master as they are, once all of them stand. Returns how this one is then.
    fn hand_back(&mut self) -> Result<AxisState, Cut> {
        if self.operates {
            let begun = Instant::now();
            while is_under_way(&self.state) && begun.elapsed() < PATIENCE {
                self.look()?;
            }
            self.reached.operator.leave()?;
            self.operates = false;
        }
        self.read()?;
        Ok(self.axis().clone())
    }
}
