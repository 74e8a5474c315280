//! `fieldbeat demo`: master and simulated drives in one process. The axes that take positions are homed, follow a
//! travelling wave as streamed setpoints and make one profile move each, the others turn there and back meanwhile; then
//! all of them stop and are powered off.

use std::f64::consts::TAU;
use std::ops::Range;
use std::time::{Duration, Instant};

use clap::Args;
use fieldbeat::axis::{Abort, Axis, AxisError, CommandId, Move, Outcome, Row, StopCause, Target, Unit, Verb};
use fieldbeat::bus::ethercat;
use fieldbeat::config::demo_plan;
use fieldbeat::cycle::Plan;
use fieldbeat::master::{Master, MasterError};
use fieldbeat::sim::server::SimServer;
use fieldbeat::time::{S, nanos};

use super::attendant::Attendant;
use super::interrupt::Interrupt;
use super::output::{Output, both};
use super::run::{not_whole, start};
use super::sim::serving;
use super::{Stop, complain, span};

/// Time of one swing, s.
const SWING_S: f64 = 2.0;
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

/// An EtherCAT line is brought up within a few seconds, on a busy computer too.
const ONLINE_WITHIN: Duration = Duration::from_secs(20);

/// Arguments of `demo`.
#[derive(Debug, Args)]
pub struct Demo {
    /// Length of the travelling wave.
    #[arg(long = "for", value_name = "TIME", value_parser = span, default_value = "10s")]
    duration: Duration,
    /// How many LinMot drives, beside two Unidrives and two Kollmorgens.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=128))]
    drives: u16,
    /// The period of the cycle.
    #[arg(long, value_name = "TIME", value_parser = span, default_value = "1ms")]
    period: Duration,
    #[command(flatten)]
    output: Output,
}

/// The master, its axes and what is shown of them meanwhile.
struct Show {
    master: Master,
    axes: Vec<Axis>,
    /// So many of them, the first ones, take positions; the others velocities only.
    movers: usize,
    attendant: Attendant,
}

impl Demo {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let plan = demo_plan(usize::from(self.drives), nanos(self.period)).map_err(Stop::usage)?;
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let output = self.output.prepare()?;
        let drives = plan.simulate();
        if !plan.buses.iter().any(|bus| bus.protocol() == ethercat::PROTOCOL) {
            let period = self.period;
            complain(&format!(
                "without the Kollmorgens: they take a --period of whole multiples of 250us below 3ms, of 1ms above, not {period:?}"
            ));
        }
        let server = SimServer::start(drives, serving(&plan, None))
            .map_err(|error| Stop::usage(format!("cannot simulate the drives: {error}")))?;
        let master = start(output.setup(plan), &interrupt)?;
        let output = output.serve(&master)?;

        let (movers, turners) = names(master.plan());
        let axes = movers.iter().chain(&turners).map(|name| master.axis(name));
        let axes = axes.collect::<Result<_, _>>().map_err(Stop::failed)?;
        let attendant = Attendant::new(&master, &interrupt);
        let mut show = Show { master, axes, movers: movers.len(), attendant };
        let result = show.play(self.duration);
        show.attendant.end(&show.master);
        let (summary, told) = output.finish(show.master);
        server.stop();
        let verdict = match result {
            _ if summary.has_failed() => Err(not_whole(&summary)),
            Ok(()) if interrupt.is_set() || summary.is_whole() => Ok(()),
            Ok(()) => Err(not_whole(&summary)),
            Err(error) if interrupt.is_set() && was_stopped(&error) => Ok(()),
            Err(error) => Err(Stop::failed(error)),
        };
        both(told, verdict)
    }
}

/// The names of the axes that take positions, and of those that take velocities only.
fn names(plan: &Plan) -> (Vec<String>, Vec<String>) {
    let of = |moves: bool| {
        let buses = plan.buses.iter();
        let axes = buses.flat_map(|bus| {
            let axes = bus.axes().into_iter().enumerate();
            axes.filter(move |(index, _)| bus.takes_positions(*index) == moves)
        });
        axes.map(|(_, axis)| axis.name.clone()).collect()
    };
    (of(true), of(false))
}

/// Whether the command ended because somebody asked for the end.
fn was_stopped(error: &Error) -> bool {
    match error {
        Error::Axis(AxisError::Ended {
            outcome: Outcome::Aborted(Abort::Stopped(StopCause::Shutdown)),
            ..
        })
        | Error::Axis(AxisError::Refused { .. } | AxisError::Gone { .. }) => true,
        // The latch of the shutdown answers whatever came after it.
        Error::Axis(AxisError::Ended { outcome: Outcome::Failed(_), .. }) => true,
        Error::Axis(AxisError::Full { .. } | AxisError::TimedOut { .. } | AxisError::Ended { .. }) => false,
        Error::Master(_) => true,
    }
}

/// What can go wrong in the show.
#[derive(Debug, thiserror::Error)]
enum Error {
    #[error(transparent)]
    Axis(#[from] AxisError),
    #[error(transparent)]
    Master(#[from] MasterError),
}

impl Show {
    fn play(&mut self, duration: Duration) -> Result<(), Error> {
        self.wait_online()?;
        let (all, movers, turners) = (0..self.axes.len(), 0..self.movers, self.movers..self.axes.len());
        self.together("enable", &all, |_| Verb::Enable)?;
        self.together("home", &movers, |_| Verb::Home)?;
        self.together("to the start", &movers, |axis| to(Swing::of(axis).centre, axis))?;
        self.wave(duration)?;
        self.together("stop", &turners, |_| Verb::Stop { deceleration: None })?;
        self.together("profile move", &movers, |axis| to(Swing::of(axis).low(), axis))?;
        self.together("stop", &all, |_| Verb::Stop { deceleration: None })?;
        self.together("disable", &all, |_| Verb::Disable)
    }

    /// Waits for the drives, and shows meanwhile how they come up.
    fn wait_online(&mut self) -> Result<(), MasterError> {
        let begun = Instant::now();
        loop {
            match self.master.wait_online(Duration::from_millis(50)) {
                Err(MasterError::NotOnline { .. }) if begun.elapsed() < ONLINE_WITHIN => {
                    self.attendant.look(&self.master, "waiting for the drives");
                }
                Err(MasterError::NotOnline { missing, .. }) => {
                    return Err(MasterError::NotOnline { waited: ONLINE_WITHIN, missing });
                }
                waited => return waited,
            }
        }
    }

    /// One verb for several axes at once, and the wait for the last of them.
    fn together(
        &mut self,
        what: &'static str,
        axes: &Range<usize>,
        verb: impl Fn(&Axis) -> Verb,
    ) -> Result<(), Error> {
        let several = &mut self.axes[axes.clone()];
        let ids: Vec<CommandId> =
            several.iter_mut().map(|axis| axis.post(verb(axis))).collect::<Result<_, _>>()?;
        self.wait_all(what, axes, &ids)
    }

    fn wait_all(&mut self, what: &'static str, axes: &Range<usize>, ids: &[CommandId]) -> Result<(), Error> {
        let begun = Instant::now();
        for (axis, id) in self.axes[axes.clone()].iter_mut().zip(ids) {
            let limit = axis.plan().home_timeout;
            loop {
                match axis.wait(*id, what, Duration::from_millis(50)) {
                    Err(AxisError::TimedOut { .. }) if begun.elapsed() < limit => {
                        self.attendant.look(&self.master, what);
                    }
                    ended => break ended?,
                }
            }
        }
        Ok(())
    }

    /// The travelling wave, streamed row by row, a quarter of a second deep; and meanwhile there and back.
    fn wave(&mut self, duration: Duration) -> Result<(), Error> {
        let length_s = duration.as_secs_f64().max(2.0 * FADE_S);
        let period_s = self.master.plan().cycle.period_ns as f64 / S as f64;
        let movers = self.axes[..self.movers].iter().enumerate();
        let mut waves: Vec<Wave> =
            movers.map(|(place, axis)| Wave::new(axis, place, period_s, length_s)).collect();
        let mut ids = Vec::new();
        let mut turning = Turning::default();
        while waves.iter().any(|wave| wave.next < wave.rows) {
            for (axis, wave) in self.axes.iter_mut().zip(&mut waves) {
                let waiting = axis.plan().stream_queue - axis.stream_room();
                for _ in waiting..wave.depth().min(axis.plan().stream_queue) {
                    let Some(row) = wave.next() else { break };
                    axis.push_row(row)?;
                }
            }
            let (movers, turners) = self.axes.split_at_mut(self.movers);
            if ids.is_empty() {
                ids = movers.iter_mut().map(Axis::follow).collect::<Result<_, _>>()?;
            }
            turning.go_on(turners)?;
            self.attendant.look(&self.master, "wave");
            // A stopped axis takes no more rows; how its command ended says why.
            if self.axes.iter().any(|axis| axis.feedback().stopped.is_some()) {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        self.wait_all("wave", &(0..self.movers), &ids)
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

fn to(position: f64, axis: &Axis) -> Verb {
    Verb::Move(Move { target: Target::Absolute(position), profile: axis.profile() })
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
