//! One axis of a soak test: enabled and homed when its drive is online, moved by its pattern, stopped and powered off
//! at the end, unless only its drive holds its load. An axis that was stopped, or whose drive had a fault, is left as
//! it is: nothing here restarts a motion that the master ended for a reason. The others go on. Only what the pause of a
//! test that goes on has caused is reset: a drive whose master was killed trips by its watchdog.

use super::pattern::{Shuttle, Turning, end_of, feed, to};
use super::wave::Wave;
use fieldbeat_config::soak::{Pattern, Swing};
use fieldbeat_core::axis::{
    Axis, AxisError, BegunBy, Command, CommandId, HeldBy, Link, Load, SilenceFaults, StopCause,
};
use fieldbeat_core::time::S;

/// A wave without an end in sight, s: its rows are counted exactly for as long.
const ENDLESS_S: f64 = 1e7;

/// An axis whose drive is not online by then is given up, ns.
const ONLINE_WITHIN_NS: u64 = 60 * S;

/// The longest time until a command that comes to its end has ended, ns.
const END_WITHIN_NS: u64 = 20 * S;

/// How the reason begins of an axis that was given up because it was stopped.
pub const STOPPED: &str = "stopped: ";

/// An axis.
#[derive(Debug)]
pub struct Mover {
    axis: Axis,
    pattern: Pattern,
    period_ns: u64,
    phase: Phase,
    /// Moves that came to their end, or velocities or swings that have begun.
    cycles: u64,
    /// Which faults the pause before may have caused; `None`: there was no pause.
    of_pause: Option<SilenceFaults>,
    /// One of them was reset, or is being reset.
    has_reset: bool,
    /// The next line of the log.
    said: Option<String>,
    /// Why it no longer moves.
    given_up: Option<String>,
    /// It was stopped before the pause, and given up by that.
    was_stopped: bool,
    ending: bool,
}

/// Where it is.
#[derive(Debug)]
enum Phase {
    /// Not moved at all.
    Still,
    /// The drive is not online yet.
    Waiting {
        since: Option<u64>,
    },
    /// A command is under way, and what follows it.
    Running(CommandId, &'static str, Next),
    Moving(Shuttle),
    Turning(Turning),
    /// Follows rows from then on.
    Swinging(Wave, CommandId, u64),
    /// Stopping and, if it may be, powering off, since then.
    Ending(CommandId, Next, u64),
    Ended,
}

/// The next step after a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Next {
    /// Look at the drive again.
    Wait,
    Enable,
    Home,
    Centre,
    Move,
    Disable,
    End,
}

/// The view that the axes of a stop group have of one of them, or of all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    /// It is online, or not waited for.
    online: bool,
    /// Nothing but a drive that was found running has stopped it, or what a pause caused; and it was not given up.
    tolerated: bool,
    /// It was stopped for another reason, in this process or before the pause.
    stopped: bool,
}

impl Seen {
    /// Nothing is against it.
    pub const GOOD: Seen = Seen { online: true, tolerated: true, stopped: false };

    /// Both of them.
    pub fn and(self, other: Seen) -> Seen {
        Seen {
            online: self.online && other.online,
            tolerated: self.tolerated && other.tolerated,
            stopped: self.stopped || other.stopped,
        }
    }
}

impl Mover {
    /// An axis that moves by this pattern.
    pub fn new(axis: Axis, pattern: &Pattern, period_ns: u64) -> Mover {
        let phase = match pattern {
            Pattern::Still(_) => Phase::Still,
            _ => Phase::Waiting { since: None },
        };
        let pattern = pattern.clone();
        Mover {
            axis,
            pattern,
            period_ns,
            phase,
            cycles: 0,
            of_pause: None,
            has_reset: false,
            said: None,
            given_up: None,
            was_stopped: false,
            ending: false,
        }
    }

    /// It goes on after a pause, which may have caused these faults.
    pub(super) fn resume(&mut self, is_of_pause: SilenceFaults) {
        self.of_pause = Some(is_of_pause).filter(|_| self.moves());
    }

    /// It was given up before the pause, for this reason, and stays as it is: somebody has to look at it.
    pub(super) fn stay(&mut self, why: &str) {
        if self.moves() {
            self.phase = Phase::Ended;
            self.was_stopped = why.starts_with(STOPPED);
            self.said =
                Some(format!("axis {}: moves no longer, as before the pause: {why}", self.axis.name()));
        }
    }

    /// Which faults the pause before it may have caused.
    pub(super) fn of_pause(&self) -> Option<SilenceFaults> {
        self.of_pause
    }

    /// The axis.
    pub fn axis(&self) -> &Axis {
        &self.axis
    }

    /// It is to move.
    pub fn moves(&self) -> bool {
        !matches!(self.pattern, Pattern::Still(_))
    }

    /// Moves that came to their end, or velocities or swings that have begun.
    pub fn cycles(&self) -> u64 {
        self.cycles
    }

    /// Why it no longer moves, before the end.
    pub fn given_up(&self) -> Option<&str> {
        self.given_up.as_deref()
    }

    /// It has come to its end, or was never moved.
    pub fn has_ended(&self) -> bool {
        matches!(self.phase, Phase::Still | Phase::Ended)
    }

    /// Begins the end.
    pub fn end(&mut self) {
        self.ending = true;
    }

    /// The stop group.
    pub fn group(&self) -> Option<u16> {
        self.axis.plan().stop.group
    }

    /// The view that its stop group has of it.
    pub fn seen(&self) -> Seen {
        let feedback = self.axis.feedback();
        let stands = |cause| match cause {
            StopCause::Group => false,
            StopCause::FoundRunning if matches!(self.phase, Phase::Still) => false,
            _ => !self.tolerates(cause, Seen::GOOD),
        };
        let stands = feedback.stopped.is_some_and(stands);
        let given_up = self.given_up.as_ref();
        Seen {
            online: feedback.link == Link::Online || matches!(self.phase, Phase::Ended),
            tolerated: given_up.is_none() && !stands,
            stopped: stands || self.was_stopped || given_up.is_some_and(|why| why.starts_with(STOPPED)),
        }
    }

    /// Goes on; returns what is worth a line. `group` is what its stop group sees.
    pub fn step(&mut self, now: u64, group: Seen) -> Option<String> {
        if self.has_ended() {
            while self.axis.event().is_some() {}
            return self.said.take();
        }
        let cause = self.axis.feedback().stopped;
        let stopped = cause.filter(|cause| !self.tolerates(*cause, group));
        if cause == Some(StopCause::FoundRunning) && matches!(self.phase, Phase::Running(_, _, Next::Home)) {
            self.phase = Phase::Waiting { since: Some(now) };
        }
        // A latch of before, such as that of a drive that was found running, does not show the stop of the group.
        let why = if let Some(stopped) = stopped {
            // The cause of the latch says more than the command that it ended. Nothing is commanded any more.
            let begun_by = self.axis.feedback().begun_by;
            let name = begun_by.and_then(|by| self.axis.name_of(by.axis));
            BegunBy::after(format!("{STOPPED}{stopped}"), begun_by, name)
        } else if self.waits() && group.stopped && !self.ending {
            "its stop group is stopped".to_owned()
        } else {
            match self.go_on(now, group, cause.is_some()) {
                Ok(()) => return self.said.take(),
                Err(error) => error.to_string(),
            }
        };
        self.phase = Phase::Ended;
        // An end may break off a command. A stop for another reason is one of the test, at its end too.
        if stopped == Some(StopCause::Shutdown) || self.ending && stopped.is_none() {
            return None;
        }
        self.given_up = Some(why.clone());
        Some(format!("axis {}: moves no longer: {why}", self.axis.name()))
    }

    /// Whether the axis goes on in spite of this stop: its drive, or another one of its group, was found running before
    /// it was enabled here, since the program that moved it before was killed, or had a fault that this caused.
    fn tolerates(&self, cause: StopCause, group: Seen) -> bool {
        let waits = self.waits();
        match cause {
            StopCause::FoundRunning => waits || matches!(self.phase, Phase::Running(_, _, Next::Home)),
            StopCause::DriveFault if self.axis.feedback().status.fault == 0 => waits && self.has_reset,
            StopCause::DriveFault => waits && self.has_fault_of_pause(),
            StopCause::Group => waits && group.tolerated,
            _ => false,
        }
    }

    /// It is not enabled yet, and is not being enabled.
    fn waits(&self) -> bool {
        matches!(self.phase, Phase::Waiting { .. } | Phase::Running(_, _, Next::Wait | Next::Enable))
    }

    fn has_fault_of_pause(&self) -> bool {
        self.of_pause.is_some_and(|is_of_pause| is_of_pause(self.axis.feedback().status.fault))
    }

    /// Goes on with an axis that is not stopped, or `is_stopped` for a tolerated reason.
    fn go_on(&mut self, now: u64, group: Seen, is_stopped: bool) -> Result<(), AxisError> {
        if self.ending && !matches!(self.phase, Phase::Ending(..)) {
            if self.waits() {
                self.phase = Phase::Ended;
                return Ok(());
            }
            let id = self.axis.post(Command::Stop { deceleration: None })?;
            self.phase = Phase::Ending(id, Next::Disable, now);
        }
        let has_fault_of_pause = !self.has_reset && self.has_fault_of_pause();
        let axis = &mut self.axis;
        match &mut self.phase {
            Phase::Still | Phase::Ended => {}
            Phase::Waiting { since } => {
                let since = *since.get_or_insert(now);
                while axis.event().is_some() {}
                let feedback = axis.feedback();
                if feedback.link == Link::Online && has_fault_of_pause {
                    let fault = axis.fault(feedback.status.fault);
                    self.said = Some(format!("axis {}: resets what the pause caused: {fault}", axis.name()));
                    self.has_reset = true;
                    self.phase = Phase::Running(axis.post(Command::ResetFault)?, "reset fault", Next::Wait);
                } else if !group.online && now.saturating_sub(since) <= ONLINE_WITHIN_NS {
                    // A drive of the group may still be found running, which stops them all.
                } else if feedback.link == Link::Online && is_stopped {
                    self.phase = Phase::Running(axis.post(Command::Reset)?, "reset", Next::Enable);
                } else if feedback.link == Link::Online {
                    self.phase = Phase::Running(axis.post(Command::Enable)?, "enable", Next::Home);
                } else if now.saturating_sub(since) > ONLINE_WITHIN_NS {
                    // With the time-out of no wait: it says what to look at.
                    axis.wait_online(std::time::Duration::ZERO)?;
                }
            }
            Phase::Running(id, what, next) => {
                let Some(end) = end_of(axis, *id) else { return Ok(()) };
                axis.verdict(what, &end)?;
                let next = *next;
                self.begin(next, now)?;
            }
            Phase::Moving(shuttle) => {
                shuttle.go_on(axis, now)?;
                self.cycles = shuttle.moves;
            }
            Phase::Turning(turning) => {
                turning.go_on(axis, now)?;
                self.cycles = turning.begun(now);
            }
            Phase::Swinging(wave, id, begun) => {
                if let Some(end) = end_of(axis, *id) {
                    return axis.verdict("stream", &end);
                }
                feed(axis, wave)?;
                if let Pattern::Sine(swing) = &self.pattern {
                    self.cycles = ((now - *begun) as f64 / S as f64 / swing.period_s).ceil() as u64;
                }
            }
            Phase::Ending(id, next, since) => {
                let late = now.saturating_sub(*since) > END_WITHIN_NS;
                match (end_of(axis, *id), *next) {
                    (None, _) if !late => {}
                    // Without power nothing holds its load: it stays powered.
                    (Some(_), Next::Disable) if axis.plan().load == Load::Vertical(HeldBy::Drive) => {
                        self.phase = Phase::Ended;
                    }
                    (Some(_), Next::Disable) => {
                        let id = axis.post(Command::Disable)?;
                        self.phase = Phase::Ending(id, Next::End, now);
                    }
                    // The orderly end of the master does what is left.
                    _ => self.phase = Phase::Ended,
                }
            }
        }
        Ok(())
    }

    /// Begins the step after the command that was carried out.
    fn begin(&mut self, next: Next, now: u64) -> Result<(), AxisError> {
        let axis = &mut self.axis;
        let homes = axis.lacks().homing.is_none() && !axis.feedback().status.homed;
        self.phase = match (next, &self.pattern) {
            (Next::Wait, _) => Phase::Waiting { since: Some(now) },
            (Next::Enable, _) => Phase::Running(axis.post(Command::Enable)?, "enable", Next::Home),
            (Next::Home, Pattern::Moves { .. } | Pattern::Sine(_)) if homes => {
                Phase::Running(axis.post(Command::Home)?, "home", Next::Centre)
            }
            (Next::Home | Next::Centre, Pattern::Sine(swing)) => {
                let id = axis.post(to(swing.centre, axis.profile()))?;
                Phase::Running(id, "move to the centre", Next::Move)
            }
            (_, Pattern::Moves { targets, profile, pause_ns }) => {
                Phase::Moving(Shuttle::new(targets.clone(), *profile, *pause_ns))
            }
            (_, Pattern::Velocities { velocities, hold_ns }) => {
                Phase::Turning(Turning::new(velocities.clone(), *hold_ns))
            }
            (_, Pattern::Sine(swing)) => {
                let row_s = self.period_ns as f64 * f64::from(axis.plan().divisor) / S as f64;
                let mut wave = Wave::new(*swing, 0.0, Swing::FADE, row_s, ENDLESS_S);
                feed(axis, &mut wave)?;
                Phase::Swinging(wave, axis.follow()?, now)
            }
            (_, Pattern::Still(_)) => Phase::Ended,
        };
        Ok(())
    }
}
