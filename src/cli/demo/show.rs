//! What the demo's axes do: those that take positions are homed, follow a travelling wave as streamed setpoints and
//! make one profile move each. Those that take no streams make moves there and back meanwhile, and those that take
//! velocities only turn there and back. Then all of them stop and are powered off.

use std::f64::consts::TAU;
use std::ops::Range;
use std::time::{Duration, Instant};

use fieldbeat::axis::{
    Abort, Axis, AxisError, Command, CommandId, EventKind, Move, Outcome, Row, StopCause, Target, Unit,
};
use fieldbeat::internals::config::DEMO_STREAMS_UP_TO_NS;
use fieldbeat::time::S;
use fieldbeat::{Master, MasterError};

use super::light::Light;
use crate::cli::handler::Handler;

/// Time of one swing, s.
pub const SWING_S: f64 = 2.0;
/// The wave grows and dies away within this time, s.
const FADE_S: f64 = 1.0;
/// Axes on one wave length.
const WAVE_LENGTH: f64 = 8.0;
/// How deep the streams are queued, s.
const DEPTH_S: f64 = 0.25;
/// The speed-controlled axes turn the other way after this time, s ...
const TURN_S: f64 = 2.0;
/// ... and their velocity is renewed this often.
const RENEW_EVERY: Duration = Duration::from_millis(100);

/// The wave ends so long before the show: the axes stop, make one move and are powered off.
const CLOSING: Duration = Duration::from_secs(2);
/// Whatever goes on then is stopped so long before the end: all axes ramp down and are powered off.
const RAMP: Duration = Duration::from_millis(250);

/// The master, its axes and what is shown of them meanwhile.
pub struct Show {
    pub master: Master,
    pub axes: Vec<Axis>,
    /// So many of them, the first ones, follow streams.
    pub streamers: usize,
    /// So many, those included, take positions; the others velocities only.
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

/// What can go wrong in the show.
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
        self.together("to the start", &movers, |axis| to(Swing::of(axis).centre, axis))?;
        self.wave()?;
        self.together("stop", &turners, |_| Command::Stop { deceleration: None })?;
        self.together("profile move", &movers, |axis| to(Swing::of(axis).low(), axis))?;
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

    /// The travelling wave, streamed row by row, a quarter of a second deep; and meanwhile there and back.
    fn wave(&mut self) -> Result<(), Error> {
        let length_s = self.left().as_secs_f64();
        let period_ns = self.master.plan().cycle.period_ns;
        if length_s < 2.0 * FADE_S || period_ns > DEMO_STREAMS_UP_TO_NS {
            return self.swing();
        }
        let period_s = period_ns as f64 / S as f64;
        let streamers = self.axes[..self.streamers].iter().enumerate();
        let mut waves: Vec<Wave> =
            streamers.map(|(place, axis)| Wave::new(axis, place, period_s, length_s)).collect();
        let mut ids = Vec::new();
        let mut ended = vec![None; self.streamers];
        let (mut turning, mut moving) = (Turning::default(), Moving::default());
        while waves.iter().any(|wave| wave.next < wave.rows) {
            let left_s = self.left().as_secs_f64();
            for (axis, wave) in self.axes.iter_mut().zip(&mut waves) {
                wave.end_within(left_s);
                let waiting = axis.plan().stream_queue - axis.stream_room();
                for _ in waiting..wave.depth().min(axis.plan().stream_queue) {
                    let Some(row) = wave.next() else { break };
                    axis.push_row(row)?;
                }
            }
            let (streamers, others) = self.axes.split_at_mut(self.streamers);
            let (movers, turners) = others.split_at_mut(self.movers - self.streamers);
            if ids.is_empty() {
                ids = streamers.iter_mut().map(Axis::follow).collect::<Result<_, _>>()?;
                self.light.iter_mut().for_each(Light::begin);
            }
            turning.go_on(turners)?;
            moving.go_on(movers)?;
            for ((axis, id), ended) in streamers.iter_mut().zip(&ids).zip(&mut ended) {
                while let Some(event) = axis.event() {
                    match event.kind {
                        EventKind::Ended { id: of, outcome, .. } if of == *id => *ended = Some(outcome),
                        _ => {}
                    }
                }
            }
            turners.iter_mut().for_each(|axis| while axis.event().is_some() {});
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
            let axis = self.axes[index].name();
            match ended {
                Some(Outcome::Done) => {}
                Some(outcome) => {
                    let (axis, command, fault) = (axis.to_owned(), "wave", None);
                    return Err(AxisError::Ended { axis, command, outcome, fault }.into());
                }
                None => self.wait_all("wave", &(index..index + 1), &ids[index..=index])?,
            }
        }
        Ok(())
    }

    /// Where the period is too long for streams, or the time too short: moves there and back, until it is time to
    /// close.
    fn swing(&mut self) -> Result<(), Error> {
        let mut turning = Turning::default();
        while !self.left().is_zero() {
            for end in [Swing::high, Swing::low] {
                turning.go_on(&mut self.axes[self.movers..])?;
                self.together("moves", &(0..self.movers), |axis| to(end(Swing::of(axis)), axis))?;
            }
        }
        Ok(())
    }
}

/// Moves there and back, for axes that take positions and no streams.
#[derive(Debug, Default)]
struct Moving {
    /// The move of each that is under way, and whether it is the one to the high end.
    under_way: Vec<(CommandId, bool)>,
}

impl Moving {
    /// The next move of each axis whose last one has ended.
    fn go_on(&mut self, axes: &mut [Axis]) -> Result<(), AxisError> {
        if self.under_way.is_empty() {
            let first = |axis: &mut Axis| Ok((axis.post(to(Swing::of(axis).high(), axis))?, true));
            self.under_way = axes.iter_mut().map(first).collect::<Result<_, AxisError>>()?;
        }
        for (axis, (id, is_high)) in axes.iter_mut().zip(&mut self.under_way) {
            let mut end = None;
            while let Some(event) = axis.event() {
                match event.kind {
                    EventKind::Ended { id: of, outcome, .. } if of == *id => end = Some(outcome),
                    _ => {}
                }
            }
            // A stopped axis ends the show; how its command ended says why.
            if let Some(outcome) = end
                && outcome != Outcome::Done
            {
                let axis = axis.name().to_owned();
                return Err(AxisError::Ended { axis, command: "moves", outcome, fault: None });
            }
            if end.is_some() {
                *is_high = !*is_high;
                let swing = Swing::of(axis);
                *id = axis.post(to(if *is_high { swing.high() } else { swing.low() }, axis))?;
            }
        }
        Ok(())
    }
}

/// Velocity there and back, for axes that take no positions.
#[derive(Debug, Default)]
struct Turning {
    begun: Option<Instant>,
    renewed: Option<Instant>,
}

impl Turning {
    /// The velocity of now, where it is time to give it again.
    fn go_on(&mut self, axes: &mut [Axis]) -> Result<(), AxisError> {
        let now = Instant::now();
        if self.renewed.is_some_and(|at| now - at < RENEW_EVERY) {
            return Ok(());
        }
        self.renewed = Some(now);
        let Some(begun) = self.begun else {
            self.begun = Some(now);
            return axes.iter_mut().try_for_each(|axis| axis.jog(axis.profile().velocity).map(drop));
        };
        let back = ((now - begun).as_secs_f64() / TURN_S) as u64 % 2 == 1;
        axes.iter_mut().try_for_each(|axis| {
            let velocity = axis.profile().velocity;
            axis.set_velocity(if back { -velocity } else { velocity })
        })
    }
}

fn to(position: f64, axis: &Axis) -> Command {
    Command::Move(Move { target: Target::Absolute(position), profile: axis.profile() })
}

/// How far an axis swings, in its units.
#[derive(Clone, Copy, Debug)]
struct Swing {
    centre: f64,
    amplitude: f64,
}

impl Swing {
    fn of(axis: &Axis) -> Swing {
        match axis.plan().units.unit {
            Unit::Millimetre => Swing { centre: 200.0, amplitude: 40.0 },
            Unit::Revolution => Swing { centre: 5.0, amplitude: 2.0 },
        }
    }

    fn high(self) -> f64 {
        self.centre + self.amplitude
    }

    fn low(self) -> f64 {
        self.centre - self.amplitude
    }
}

/// The rows of an axis: a sine whose amplitude grows from 0 and dies away to 0, so that the wave begins and ends at
/// standstill.
#[derive(Debug)]
struct Wave {
    swing: Swing,
    /// Of the sine, rad.
    phase: f64,
    /// Time between two rows, s.
    row_s: f64,
    rows: u64,
    /// The number of the next one.
    next: u64,
}

impl Wave {
    /// The wave of this length, of the axis at `place`.
    fn new(axis: &Axis, place: usize, period_s: f64, length_s: f64) -> Wave {
        let row_s = period_s * f64::from(axis.plan().divisor);
        Wave {
            swing: Swing::of(axis),
            phase: TAU * place as f64 / WAVE_LENGTH,
            row_s,
            rows: (length_s / row_s).round() as u64,
            next: 0,
        }
    }

    /// Ends it sooner where its rows would take longer: on a host that skips cycles each of them costs more than its
    /// time. Only between the two fades, so that it stays smooth.
    fn end_within(&mut self, left_s: f64) {
        let fade = (FADE_S / self.row_s).ceil() as u64;
        if self.next > fade && self.next + fade < self.rows {
            let most = self.next + ((left_s / self.row_s).ceil() as u64).max(fade + 1);
            self.rows = self.rows.min(most);
        }
    }

    /// So many rows are queued at a time.
    fn depth(&self) -> usize {
        ((DEPTH_S / self.row_s) as usize).max(16)
    }
}

impl Iterator for Wave {
    type Item = Row;

    fn next(&mut self) -> Option<Row> {
        let last = self.rows.checked_sub(1)?;
        if self.next > last {
            return None;
        }
        let t = self.next as f64 * self.row_s;
        let (fade, fade_v, fade_a) = fade(t, last as f64 * self.row_s);
        let w = TAU / SWING_S;
        let (sin, cos) = (w * t - self.phase).sin_cos();
        let Swing { centre, amplitude } = self.swing;
        let is_last = self.next == last;
        self.next += 1;
        Some(Row {
            position: centre + amplitude * fade * sin,
            velocity: amplitude * (fade_v * sin + fade * w * cos),
            acceleration: amplitude * (fade_a * sin + 2.0 * fade_v * w * cos - fade * w * w * sin),
            last: is_last,
        })
    }
}

/// A smooth step up within [`FADE_S`] from the begin and down before the end, with its first and second derivative.
fn fade(t: f64, end: f64) -> (f64, f64, f64) {
    let (x, sign) = if t < end / 2.0 { (t / FADE_S, 1.0) } else { ((end - t) / FADE_S, -1.0) };
    if x >= 1.0 {
        return (1.0, 0.0, 0.0);
    }
    let x = x.max(0.0);
    // 6x^5 - 15x^4 + 10x^3: position, velocity and acceleration are 0 at both ends.
    let value = x * x * x * (10.0 + x * (6.0 * x - 15.0));
    let slope = 30.0 * x * x * (1.0 - x) * (1.0 - x) / FADE_S;
    let bend = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / (FADE_S * FADE_S);
    (value, sign * slope, bend)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_ends_in_its_time_on_a_host_that_skips_every_fifth_cycle_and_stays_smooth() {
        let (row_s, length_s) = (0.001, 8.0);
        let swing = Swing { centre: 200.0, amplitude: 40.0 };
        for share in [1.0, 0.8, 0.5] {
            let mut wave = Wave { swing, phase: 1.0, row_s, rows: (length_s / row_s) as u64, next: 0 };
            let (mut rows, mut before) = (0, Row { position: swing.centre, ..Row::default() });
            while !before.last {
                wave.end_within(length_s - f64::from(rows) * row_s / share);
                let row = wave.next().expect("it ends with its last row");
                let steepest = swing.amplitude * (TAU / SWING_S + 2.0 / FADE_S) * row_s;
                assert!((row.position - before.position).abs() <= steepest, "{before:?} {row:?}");
                assert!((row.velocity - before.velocity).abs() <= 1_000.0 * row_s, "{before:?} {row:?}");
                (rows, before) = (rows + 1, row);
            }
            assert_eq!(wave.next(), None);
            assert!((before.position - swing.centre).abs() < 1e-9 && before.velocity.abs() < 1e-9);
            let took_s = f64::from(rows) * row_s / share;
            assert!(took_s <= length_s + FADE_S / share, "{took_s} s at {share}");
            assert!(share < 1.0 || rows == 8_000, "{rows}");
        }
    }
}
