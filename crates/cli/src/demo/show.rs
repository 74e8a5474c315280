//! What the demo's axes do: those that take positions are homed, follow a travelling wave as streamed setpoints and
//! make one profile move each. Those that take no streams make moves there and back meanwhile, and those that take
//! velocities only turn there and back. Then all of them stop and are powered off.

use std::f64::consts::TAU;
use std::ops::Range;
use std::time::{Duration, Instant};

use fieldbeat_config::demo::DEMO_STREAMS_UP_TO_NS;
use fieldbeat_config::soak::Swing;
use fieldbeat_core::axis::{Abort, Axis, AxisError, Command, CommandId, EventKind, Outcome, StopCause, Unit};
use fieldbeat_core::time::{S, nanos};
use fieldbeat_master::{Master, MasterError};
use fieldbeat_soak::pattern::{Shuttle, Turning, feed, to, waiting};
use fieldbeat_soak::wave::Wave;

use super::light::Light;
use crate::handler::Handler;

/// Time of one swing, s.
pub const SWING_S: f64 = 2.0;
/// The wave grows and dies away within so many swings.
const FADE: f64 = 0.5;
/// Axes on one wave length.
const WAVE_LENGTH: f64 = 8.0;
/// The speed-controlled axes turn the other way after this time.
const TURN: Duration = Duration::from_secs(2);

/// The wave ends so long before the show: the axes stop, make one move and are powered off.
const CLOSING: Duration = Duration::from_secs(2);
/// Whatever goes on then is stopped so long before the end: all axes ramp down and are powered off.
const RAMP: Duration = Duration::from_millis(250);

/// The master, its axes and what is shown of them meanwhile.
pub struct Show {
    pub master: Master,
    pub axes: Vec<Axis>,
    /// The number of them, the first ones, that follow streams.
    pub streamers: usize,
    /// The number of them, those included, that take positions; the others take velocities only.
    pub movers: usize,
    /// All that is shown has ended by then.
    pub end: Instant,
    pub handler: Handler,
    /// That of the terminals, if there are any.
    pub light: Option<Light>,
}

/// Whether the command ended because the end was requested.
pub fn was_stopped(error: &Error) -> bool {
    match error {
        Error::Axis(AxisError::Ended {
            outcome: Outcome::Aborted(Abort::Stopped(StopCause::Shutdown)),
            ..
        })
        | Error::Axis(AxisError::Refused { .. } | AxisError::Gone { .. }) => true,
        // The latch of the shutdown answers whatever came after it.
        Error::Axis(AxisError::Ended { outcome: Outcome::Failed(_), .. }) => true,
        Error::Axis(_) => false,
        Error::Master(_) | Error::NotOnline(_) | Error::Over => true,
    }
}

/// The errors of the show.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Axis(#[from] AxisError),
    #[error(transparent)]
    Master(#[from] MasterError),
    #[error("{0}; --for 60s gives them more time")]
    NotOnline(MasterError),
    /// The time for the show has passed. No failure: what goes on is stopped in order.
    #[error("the time of --for has passed")]
    Over,
}

impl Show {
    pub fn play(&mut self) -> Result<(), Error> {
        let (all, movers, turners) = (0..self.axes.len(), 0..self.movers, self.movers..self.axes.len());
        self.together("enable", &all, |_| Command::Enable)?;
        self.together("home", &movers, |_| Command::Home)?;
        self.together("to the start", &movers, |axis| to(swing(axis).centre, axis.profile()))?;
        self.wave()?;
        self.together("stop", &turners, |_| Command::Stop { deceleration: None })?;
        self.together("profile move", &movers, |axis| to(low(axis), axis.profile()))?;
        self.together("stop", &all, |_| Command::Stop { deceleration: None })?;
        self.together("disable", &all, |_| Command::Disable)
    }

    /// Time that is left, without the closing.
    fn left(&self) -> Duration {
        self.end.saturating_duration_since(Instant::now() + CLOSING)
    }

    /// Looks after the master and the light while `what` goes on.
    fn look(&mut self, what: &str) {
        self.handler.look(&self.master, what);
        self.light.iter_mut().for_each(Light::go_on);
    }

    /// Whether it is time for the orderly end, whatever goes on.
    fn is_over(&self) -> bool {
        Instant::now() + RAMP > self.end
    }

    /// Waits for the drives, and shows meanwhile how they come up.
    pub fn wait_online(&mut self) -> Result<(), Error> {
        let begun = Instant::now();
        loop {
            match self.master.wait_online(Duration::from_millis(50)) {
                Err(MasterError::NotOnline { .. }) if !self.is_over() => {
                    self.handler.look_while_waiting(&self.master);
                }
                Err(MasterError::NotOnline { missing, .. }) => {
                    let waited = Duration::from_millis(begun.elapsed().as_millis() as u64);
                    return Err(Error::NotOnline(MasterError::NotOnline { waited, missing }));
                }
                waited => return Ok(waited?),
            }
        }
    }

    /// One command for several axes at once, and the wait for the last of them.
    fn together(
        &mut self,
        what: &'static str,
        axes: &Range<usize>,
        command: impl Fn(&Axis) -> Command,
    ) -> Result<(), Error> {
        let several = &mut self.axes[axes.clone()];
        let ids: Vec<CommandId> =
            several.iter_mut().map(|axis| axis.post(command(axis))).collect::<Result<_, _>>()?;
        self.wait_all(what, axes, &ids)
    }

    fn wait_all(&mut self, what: &'static str, axes: &Range<usize>, ids: &[CommandId]) -> Result<(), Error> {
        let begun = Instant::now();
        for (index, id) in axes.clone().zip(ids) {
            let limit = self.axes[index].plan().home_timeout;
            loop {
                match self.axes[index].wait(*id, what, Duration::from_millis(50)) {
                    Err(AxisError::TimedOut { .. }) if self.is_over() => return Err(Error::Over),
                    Err(AxisError::TimedOut { .. }) if begun.elapsed() < limit => self.look(what),
                    ended => break ended?,
                }
            }
            // No other end is waited for: what else happened is shown by the handler.
            while self.axes[index].event().is_some() {}
        }
        Ok(())
    }

    /// The travelling wave, streamed row by row, a second deep; and meanwhile there and back.
    fn wave(&mut self) -> Result<(), Error> {
        let length_s = self.left().as_secs_f64();
        let period_ns = self.master.plan().cycle.period_ns;
        if length_s < 2.0 * FADE * SWING_S || period_ns > DEMO_STREAMS_UP_TO_NS {
            return self.swing();
        }
        let period_s = period_ns as f64 / S as f64;
        let streamers = self.axes[..self.streamers].iter().enumerate();
        let mut waves: Vec<Wave> = (streamers)
            .map(|(place, axis)| {
                let row_s = period_s * f64::from(axis.plan().divisor);
                Wave::new(swing(axis), TAU * place as f64 / WAVE_LENGTH, FADE, row_s, length_s)
            })
            .collect();
        let mut ids = Vec::new();
        let mut ended = vec![None; self.streamers];
        let begun = Instant::now();
        let (mut turning, mut moving) = (self.turning(), self.moving());
        while waves.iter().any(Wave::goes_on) {
            let left_s = self.left().as_secs_f64();
            for (axis, wave) in self.axes.iter_mut().zip(&mut waves) {
                wave.end_within(left_s, waiting(axis));
                feed(axis, wave)?;
            }
            let (streamers, others) = self.axes.split_at_mut(self.streamers);
            let (movers, turners) = others.split_at_mut(self.movers - self.streamers);
            if ids.is_empty() {
                ids = streamers.iter_mut().map(Axis::follow).collect::<Result<_, _>>()?;
                self.light.iter_mut().for_each(Light::begin);
            }
            let now = nanos(begun.elapsed());
            for (axis, turning) in turners.iter_mut().zip(&mut turning) {
                turning.go_on(axis, now)?;
            }
            for (axis, moving) in movers.iter_mut().zip(&mut moving) {
                moving.go_on(axis, now)?;
            }
            for ((axis, id), ended) in streamers.iter_mut().zip(&ids).zip(&mut ended) {
                while let Some(event) = axis.event() {
                    match event.kind {
                        EventKind::Ended { id: of, .. } if of == *id => *ended = Some(event),
                        _ => {}
                    }
                }
            }
            self.look("wave");
            // A stopped axis takes no more rows; how its command ended says why.
            if self.axes.iter().any(|axis| axis.feedback().stopped.is_some()) {
                break;
            }
            if self.is_over() {
                return Err(Error::Over);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        for (index, ended) in ended.into_iter().enumerate() {
            match ended {
                Some(event) => self.axes[index].verdict("wave", &event)?,
                None => self.wait_all("wave", &(index..index + 1), &ids[index..=index])?,
            }
        }
        Ok(())
    }

    /// Where the period is too long for streams, or the time too short: moves there and back, until it is time to
    /// close.
    fn swing(&mut self) -> Result<(), Error> {
        let (begun, mut turning) = (Instant::now(), self.turning());
        while !self.left().is_zero() {
            for end in [high, low] {
                for (axis, turning) in self.axes[self.movers..].iter_mut().zip(&mut turning) {
                    turning.go_on(axis, nanos(begun.elapsed()))?;
                }
                self.together("moves", &(0..self.movers), |axis| to(end(axis), axis.profile()))?;
            }
        }
        Ok(())
    }

    /// Velocity there and back, for axes that take no positions.
    fn turning(&self) -> Vec<Turning> {
        let turning = |axis: &Axis| {
            let velocity = axis.profile().velocity;
            Turning::new(vec![velocity, -velocity], nanos(TURN))
        };
        self.axes[self.movers..].iter().map(turning).collect()
    }

    /// Moves there and back, for axes that take positions and no streams.
    fn moving(&self) -> Vec<Shuttle> {
        let moving = |axis: &Axis| Shuttle::new(vec![high(axis), low(axis)], axis.profile(), 0);
        self.axes[self.streamers..self.movers].iter().map(moving).collect()
    }
}

/// How far an axis swings, in its units.
fn swing(axis: &Axis) -> Swing {
    let (centre, amplitude) = match axis.plan().units.unit {
        Unit::Millimetre => (200.0, 40.0),
        Unit::Revolution => (5.0, 2.0),
    };
    Swing { centre, amplitude, period_s: SWING_S }
}

fn high(axis: &Axis) -> f64 {
    swing(axis).centre + swing(axis).amplitude
}

fn low(axis: &Axis) -> f64 {
    swing(axis).centre - swing(axis).amplitude
}
