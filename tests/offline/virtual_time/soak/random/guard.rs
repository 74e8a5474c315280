//! What a soak test must not do to one axis, by the true state of its drive.
//!
//! | rule | statement |
//! |---|---|
//! | `moves` | an axis that is barred comes to rest, and does not move again |
//! | `enabled` | an axis that is not to move gets no power |
//! | `reset` | only a fault that the pause caused is reset, once, before the axis is enabled |
//! | `limits` | powered, it stays within its limits |
//! | `line` | an axis that is given up is named by one line of each process |
//!
//! An axis is barred once it is given up, or once it, or an axis of its stop group, was stopped for a reason that no
//! pause excuses. So is one that is not to move.

use fieldbeat::axis::{Feedback, Link, State, StopCause};
use fieldbeat::sim::Truth;

use crate::virtual_time::oracle::machine::Scale;

/// Turns with a good wire from the bar to standstill: some reports, the stop request, the stop's time-out and what
/// follows it.
const STOPS: u32 = 150;
/// An axis that stood may be pushed for so many turns, if its drive reports in each of them: until three reports in a
/// row have shown its motion, behind the one that was under way, and the stop has got through.
const PUSHED: u32 = 10;
const REPORTS: u32 = 1 + 3;
/// It stands after so many turns.
const STANDS: u32 = 20;
/// A limit is left for so many turns: until the master has stopped it.
const OUTSIDE: u32 = 40;
/// A motor overshoots its velocity by this factor.
const FAST: f64 = 1.3;
/// A fault of before its restart may be reported for so many turns.
const RESTARTS: u32 = 60;
/// Turns in which the soak test has seen a stop, and said so.
const SAYS: u32 = 40;

/// What a rule says that was broken.
pub type Breach = (&'static str, String);

/// An axis.
pub struct Guard {
    pub is_to_move: bool,
    scale: Scale,
    range: Option<(f64, f64)>,
    is_silence: fn(u32) -> bool,
    /// It must not move, since so many turns with a good wire; it has stood since.
    pub barred: bool,
    since: u32,
    has_stood: bool,
    moving: u32,
    standing: u32,
    outside: u32,
    powered: bool,
    fault: u32,
    /// Its drive was restarted so many turns ago, which clears its faults.
    restarted: u32,
    /// Of this process: it is resumed; the axis was given up before; its power came on; what its pause caused was
    /// reset; the latch; its lines.
    resumed: bool,
    given_up_before: bool,
    enabled: bool,
    has_reset: bool,
    /// Another program, or a dead one, may switch it on, which this process only reads.
    lent: bool,
    stopped: Option<StopCause>,
    pub lines: u32,
}

impl Guard {
    pub fn new(
        is_to_move: bool,
        scale: Scale,
        range: Option<(f64, f64)>,
        is_silence: fn(u32) -> bool,
    ) -> Guard {
        Guard {
            is_to_move,
            scale,
            range,
            is_silence,
            barred: !is_to_move,
            since: 0,
            has_stood: false,
            moving: 0,
            standing: 0,
            outside: 0,
            powered: false,
            fault: 0,
            restarted: u32::MAX,
            resumed: false,
            given_up_before: false,
            enabled: false,
            has_reset: false,
            lent: false,
            stopped: None,
            lines: 0,
        }
    }

    /// A process begins, in which the axis is barred from the begin on or not.
    pub fn begin(&mut self, resumed: bool, barred: bool, truth: Truth) {
        self.barred = barred || !self.is_to_move;
        (self.resumed, self.given_up_before) = (resumed, barred && self.is_to_move);
        (self.enabled, self.has_reset, self.lent) = (false, false, false);
        (self.stopped, self.lines) = (None, 0);
        (self.since, self.powered) = (0, truth.powered);
    }

    pub fn bar(&mut self) {
        if !self.barred {
            (self.barred, self.since, self.has_stood, self.moving) = (true, 0, false, 0);
        }
    }

    /// Its drive was restarted, which clears its faults.
    pub fn restarted(&mut self) {
        (self.fault, self.restarted) = (0, 0);
    }

    /// Another program may move it for a while.
    pub fn pushed(&mut self) {
        (self.has_stood, self.moving, self.standing) = (false, 0, 0);
        self.lend();
    }

    /// Its power may come on by what this process has not sent.
    pub fn lend(&mut self) {
        self.lent |= !self.enabled;
    }

    /// It was given up before this process.
    pub fn was_given_up(&self) -> bool {
        self.given_up_before
    }

    /// It is given up in this process, or was before.
    pub fn is_given_up(&self) -> bool {
        self.given_up_before || self.lines > 0
    }

    /// A fault of it was reset in this process.
    pub fn has_reset(&self) -> bool {
        self.has_reset
    }

    /// It has stopped for another reason than before, and whether a pause excuses that.
    pub fn stops(&mut self, feedback: &Feedback) -> Option<(StopCause, bool)> {
        let before = std::mem::replace(&mut self.stopped, feedback.stopped);
        let cause = feedback.stopped.filter(|_| before != feedback.stopped)?;
        let is_tolerated = match cause {
            StopCause::Shutdown | StopCause::Group | StopCause::FoundRunning => true,
            StopCause::DriveFault => self.may_reset(feedback.status.fault),
            _ => false,
        };
        Some((cause, is_tolerated))
    }

    /// A pause may have caused this fault.
    fn may_reset(&self, fault: u32) -> bool {
        let is_of_pause = self.resumed && (self.is_silence)(fault);
        is_of_pause && self.is_to_move && !self.given_up_before && !self.enabled && !self.has_reset
    }

    /// One turn is over. `reached`: the wire is good. `pushed`: another program may have moved it.
    pub fn turn(
        &mut self,
        truth: Truth,
        feedback: &Feedback,
        reached: bool,
        pushed: bool,
    ) -> Result<(), Breach> {
        let rises = truth.powered && !std::mem::replace(&mut self.powered, truth.powered);
        let is_moving = truth.powered && truth.velocity.abs() > self.scale.still;
        // The power of a drive that was found running, or rising, is that of the process before.
        let is_found = feedback.stopped == Some(StopCause::FoundRunning);
        self.enabled = !is_found && (self.enabled || rises && feedback.status.state != State::Fault);
        if rises && !self.is_to_move && !pushed {
            return Err(("enabled", format!("{truth:?}; {feedback:?}")));
        }
        self.fault(feedback)?;
        self.standing = if is_moving { 0 } else { self.standing + 1 };
        if self.barred {
            self.since += u32::from(reached);
            self.has_stood |= self.standing >= STANDS;
            self.moving = if is_moving { self.moving + u32::from(reached) } else { 0 };
            let pushed_for = PUSHED + REPORTS * (self.scale.report_turns - 1);
            let most = if self.has_stood { pushed_for } else { STOPS };
            if self.moving > most && !pushed {
                return Err(("moves", format!("{truth:?}; {feedback:?}")));
            }
        }
        let fast = is_moving && truth.velocity.abs() > FAST * self.scale.velocity;
        let beyond = is_moving
            && truth.homed
            && feedback.status.homed
            && self.range.is_some_and(|(low, high)| {
                let margin = 3.0 * self.scale.near;
                truth.position > high + margin && truth.velocity > 0.0
                    || truth.position < low - margin && truth.velocity < 0.0
            });
        self.outside = if fast || beyond { self.outside + 1 } else { 0 };
        if self.outside > OUTSIDE {
            return Err(("limits", format!("{truth:?}; {feedback:?}")));
        }
        Ok(())
    }

    fn fault(&mut self, feedback: &Feedback) -> Result<(), Breach> {
        self.restarted = self.restarted.saturating_add(1);
        if feedback.link != Link::Online || feedback.age > 0 || self.restarted < RESTARTS {
            return Ok(());
        }
        let fault = feedback.status.fault;
        let before = std::mem::replace(&mut self.fault, fault);
        if before != 0 && fault == 0 && !self.may_reset(before) {
            return Err(("reset", format!("fault {before:#06x}: {feedback:?}")));
        }
        self.has_reset |= before != 0 && fault == 0;
        Ok(())
    }

    /// The axis is named by as many lines as it is to be, after `given_up` by the soak test.
    pub fn named(&self, given_up: bool, ending: bool) -> Result<(), Breach> {
        let is_late = self.is_to_move && self.barred && self.since > SAYS && !ending;
        let least = u32::from(given_up || is_late);
        let most = u32::from(given_up);
        if (least..=most).contains(&self.lines) {
            return Ok(());
        }
        Err(("line", format!("{} lines, given up: {given_up}, barred: {}", self.lines, self.barred)))
    }

    /// At the end: without power, or at rest where only its drive holds its load; `own`: if this process moved it.
    pub fn ended(&self, truth: Truth, is_held: bool, own: bool) -> Result<(), Breach> {
        let is_own = self.enabled && !self.barred;
        let moves = truth.powered && truth.velocity.abs() > self.scale.still;
        let is_wrong = if is_held { is_own && !truth.powered } else { truth.powered && !self.lent };
        if (moves || is_wrong) && (is_own || !own) {
            return Err(("end", format!("{truth:?}")));
        }
        Ok(())
    }
}
