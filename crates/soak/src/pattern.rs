//! Patterns of motion: from target to target, from velocity to velocity, and along a streamed sine. Each goes on when
//! it is looked after, and never waits. The demo moves its axes by them too.

use super::wave::Wave;
use fieldbeat_config::soak::RENEW_EVERY_NS;
use fieldbeat_core::axis::{Axis, AxisError, Command, CommandId, Event, EventKind, Move, Profile, Target};

/// The end of command `id` of an axis, if it has come; all other events are dropped.
pub fn end_of(axis: &mut Axis, id: CommandId) -> Option<Event> {
    let mut end = None;
    while let Some(event) = axis.event() {
        if matches!(event.kind, EventKind::Ended { id: of, .. } if of == id) {
            end = Some(event);
        }
    }
    end
}

/// A move to a position.
pub fn to(position: f64, profile: Profile) -> Command {
    Command::Move(Move { target: Target::Absolute(position), profile })
}

/// Moves from target to target.
#[derive(Debug)]
pub struct Shuttle {
    targets: Vec<f64>,
    profile: Profile,
    pause_ns: u64,
    /// The place of the next target.
    next: usize,
    under_way: Option<CommandId>,
    /// It pauses until then.
    until: u64,
    /// Moves that were carried out.
    pub moves: u64,
}

impl Shuttle {
    /// Between these targets, again and again, with a pause after each move.
    pub fn new(targets: Vec<f64>, profile: Profile, pause_ns: u64) -> Shuttle {
        Shuttle { targets, profile, pause_ns, next: 0, under_way: None, until: 0, moves: 0 }
    }

    /// The next move, if the last one has ended and the pause is over. `now` is any clock that goes on.
    pub fn go_on(&mut self, axis: &mut Axis, now: u64) -> Result<(), AxisError> {
        if let Some(id) = self.under_way {
            let Some(end) = end_of(axis, id) else { return Ok(()) };
            axis.verdict("moves", &end)?;
            (self.under_way, self.until) = (None, now + self.pause_ns);
            self.moves += 1;
        }
        if now >= self.until && !self.targets.is_empty() {
            self.under_way = Some(axis.post(to(self.targets[self.next], self.profile))?);
            self.next = (self.next + 1) % self.targets.len();
        }
        Ok(())
    }
}

/// Turns at one velocity after the other.
#[derive(Debug)]
pub struct Turning {
    velocities: Vec<f64>,
    hold_ns: u64,
    /// The jog, when that began, and when it was renewed.
    jog: Option<(CommandId, u64)>,
    renewed: u64,
}

impl Turning {
    /// At these velocities, again and again, each for so long.
    pub fn new(velocities: Vec<f64>, hold_ns: u64) -> Turning {
        Turning { velocities, hold_ns: hold_ns.max(1), jog: None, renewed: 0 }
    }

    /// How many velocities have begun.
    pub fn begun(&self, now: u64) -> u64 {
        self.jog.map_or(0, |(_, begun)| (now - begun).div_ceil(self.hold_ns))
    }

    /// The velocity of now, where it is time to give it again.
    pub fn go_on(&mut self, axis: &mut Axis, now: u64) -> Result<(), AxisError> {
        let velocity = |place: u64| self.velocities[(place % self.velocities.len() as u64) as usize];
        let Some((id, begun)) = self.jog else {
            self.jog = Some((axis.jog(velocity(0))?, now));
            return Ok(());
        };
        if let Some(end) = end_of(axis, id) {
            return axis.verdict("jog", &end);
        }
        if now - self.renewed >= RENEW_EVERY_NS {
            self.renewed = now;
            axis.set_velocity(velocity((now - begun) / self.hold_ns))?;
        }
        Ok(())
    }
}

/// How many rows wait in the queue of an axis.
pub fn waiting(axis: &Axis) -> usize {
    axis.plan().stream_queue - axis.stream_room()
}

/// Queues the next rows of a wave, as many as are to wait.
pub fn feed(axis: &mut Axis, wave: &mut Wave) -> Result<(), AxisError> {
    for _ in waiting(axis)..wave.depth().min(axis.plan().stream_queue) {
        let Some(row) = wave.next() else { break };
        axis.push_row(row)?;
    }
    Ok(())
}
