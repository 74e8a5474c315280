//! How motion commands determine the demand: profiles, armed commands, and the inputs of `stream` and `time_curve`.
//!
//! Knows no telegram, no command count and no state machine. Positions are in the drive's own coordinates, SI units.

use super::codec::commands::StreamKind;
use super::demand::{Demand, METRE_PER_S, METRE_PER_S2, Move, Origin, Start, Vad, When};
use super::settings::LinMotSettings;
use super::stream::Stream;
use super::time_curve::TimeCurve;
use crate::physics::Generator;
use fieldbeat_core::time::Time;

/// The drive's quick-stop deceleration, m/s2. A parameter in the real drive, whose UPID is not known.
const QUICK_STOP: f64 = 20.0;

/// The setpoint generator of the drive and its inputs.
#[derive(Debug)]
pub(super) struct Setpoints {
    generator: Generator,
    /// Of the last profile.
    target: f64,
    /// The profile that a released freeze continues with.
    resume: Option<Vad>,
    armed: Option<Armed>,
    feed: Option<Feed>,
    /// Periods of silence that are an underflow of a stream, and setpoints that it holds.
    tolerance: (f64, usize),
    /// Of the last profile.
    limits: Vad,
    /// Sine and Bestehorn moves that came while another motion ran.
    pub(super) refused: u64,
}

/// The source of the demand instead of a profile.
#[derive(Debug)]
enum Feed {
    Stream(Stream),
    Curve(TimeCurve),
}

/// A command that waits for an event.
#[derive(Clone, Copy, Debug)]
enum Armed {
    /// The end of the running motion.
    After(Move),
    /// A trigger input. This drive has none wired, so it stays armed until it is cleared.
    Trigger,
    /// The demand passing a position.
    Passing { positive: bool, position: f64, limits: Vad },
}

impl Setpoints {
    /// Stands at `position`.
    pub(super) fn at(position: f64, plan: &LinMotSettings) -> Setpoints {
        Setpoints {
            generator: Generator::at(position),
            target: position,
            resume: None,
            armed: None,
            feed: None,
            tolerance: (plan.stream_patience, plan.stream_depth),
            limits: Vad { velocity: 0, acceleration: 0, deceleration: 0 },
            refused: 0,
        }
    }

    /// Where the last profile goes, m.
    pub(super) fn target(&self) -> f64 {
        self.target
    }

    /// The limits of the last profile.
    pub(super) fn limits(&self) -> Vad {
        self.limits
    }

    pub(super) fn demand(&self) -> Demand {
        Demand {
            position: self.generator.position(),
            velocity: self.generator.velocity(),
            acceleration: self.generator.acceleration(),
        }
    }

    /// A motion is under way, or a stream that has not begun to move yet.
    pub(super) fn is_moving(&self) -> bool {
        self.generator.is_moving() || self.feed.is_some()
    }

    /// A command waits for an event.
    pub(super) fn is_armed(&self) -> bool {
        self.armed.is_some()
    }

    /// Discards everything and stands still at `position`.
    pub(super) fn stand_at(&mut self, position: f64) {
        self.drop_all();
        self.generator.set(position, 0.0, 0.0);
        self.generator.halt();
        self.target = position;
    }

    /// Demand velocity 0 at once.
    pub(super) fn halt(&mut self) {
        self.drop_all();
        self.generator.halt();
    }

    /// Ramps down with the quick-stop deceleration, and discards its motion.
    pub(super) fn quick_stop(&mut self) {
        self.drop_all();
        self.generator.brake(QUICK_STOP);
    }

    /// Ramps down with the quick-stop deceleration; a profile can be resumed.
    pub(super) fn freeze(&mut self) {
        let resume = self.resume;
        self.quick_stop();
        self.resume = resume;
    }

    /// Continues with the frozen profile, if there was one.
    pub(super) fn resume(&mut self) {
        if let Some(Vad { velocity, acceleration, deceleration }) = self.resume {
            let [a, d] = [acceleration, deceleration].map(|ramp| f64::from(ramp) * METRE_PER_S2);
            self.generator.go_to(self.target, f64::from(velocity) * METRE_PER_S, a, d);
        }
    }

    /// A motion of the drive's own: to `target` with `velocity` and `acceleration`.
    pub(super) fn go_to(&mut self, target: f64, velocity: f64, acceleration: f64) {
        self.drop_all();
        self.target = target;
        self.generator.go_to(target, velocity, acceleration, acceleration);
    }

    /// Runs without end at `velocity`, signed.
    pub(super) fn run(&mut self, velocity: f64, acceleration: f64) {
        self.drop_motion();
        self.generator.run(velocity, acceleration);
    }

    fn drop_all(&mut self) {
        (self.resume, self.armed, self.feed) = (None, None, None);
    }

    /// Another motion takes over. A command that waits for the trigger goes on waiting: only 008x clears it.
    fn drop_motion(&mut self) {
        (self.resume, self.feed) = (None, None);
        self.armed.take_if(|armed| !matches!(armed, Armed::Trigger));
    }

    /// Follows the motor, which something else moves.
    pub(super) fn follow(&mut self, actual: Demand) {
        self.drop_motion();
        self.generator.set(actual.position, actual.velocity, 0.0);
        self.target = actual.position;
    }

    /// Ramps down with this deceleration, 1e-5 m/s2, or with that of the quick stop.
    pub(super) fn stop(&mut self, deceleration: Option<u32>) {
        self.drop_motion();
        self.generator.brake(deceleration.map_or(QUICK_STOP, |d| f64::from(d) * METRE_PER_S2));
    }

    /// Takes another profile when the demand passes a position.
    pub(super) fn change_profile(&mut self, positive: bool, position: f64, limits: Vad) {
        self.armed = Some(Armed::Passing { positive, position, limits });
    }

    /// Something waits for the trigger.
    pub(super) fn arm_trigger(&mut self) {
        self.armed = Some(Armed::Trigger);
    }

    /// Nothing waits any more.
    pub(super) fn clear_events(&mut self) {
        self.armed = None;
    }

    /// A time curve gives the demand.
    pub(super) fn play(&mut self, curve: TimeCurve) {
        self.drop_motion();
        self.feed = Some(Feed::Curve(curve));
    }

    /// Leaves streaming. Buffered setpoints are dropped: the strictest reading.
    pub(super) fn end_stream(&mut self) {
        if let Some(Feed::Stream(_)) = self.feed {
            self.feed = None;
            self.generator.halt();
        }
    }

    /// A move, now or when its time has come. A move that can only start from standstill is not run while something
    /// moves.
    pub(super) fn take_move(&mut self, motion: Move, when: When, from_rest: bool, actual: Demand) {
        match when {
            When::Trigger => self.arm_trigger(),
            When::AfterActual if self.is_moving() => self.armed = Some(Armed::After(motion)),
            When::AfterActual | When::Now if from_rest && self.is_moving() => self.refused += 1,
            When::AfterActual | When::Now => self.start(motion, actual),
        }
    }

    /// Every shape runs as a trapezoid within its limits: a master sees of a shape only when it ends.
    fn start(&mut self, motion: Move, actual: Demand) {
        let base = match motion.origin {
            Origin::Demand => self.generator.position(),
            Origin::Target => self.target,
            Origin::Actual => actual.position,
            Origin::Zero => 0.0,
        };
        self.drop_motion();
        match motion.start {
            Start::Demand => {}
            Start::Actual => self.generator.set(actual.position, actual.velocity, 0.0),
            Start::Standstill => self.generator.set(actual.position, 0.0, 0.0),
        }
        self.target = base + motion.value;
        self.limits = motion.limits;
        self.resume = Some(motion.limits);
        self.resume();
    }

    /// A streamed setpoint; `configured_ns` is the period that some commands have.
    pub(super) fn take_setpoint(
        &mut self,
        command: StreamKind,
        now: Time,
        setpoint: Demand,
        configured_ns: u64,
    ) -> Result<(), u16> {
        match &mut self.feed {
            Some(Feed::Stream(stream)) if stream.command == command => stream.push(now, setpoint),
            _ => {
                let stream = Stream::begin(command, now, setpoint, configured_ns, self.tolerance)?;
                self.drop_motion();
                self.feed = Some(Feed::Stream(stream));
                Ok(())
            }
        }
    }

    /// Lets `dt_ns` pass, which end at `now`.
    pub(super) fn advance(&mut self, now: Time, dt_ns: u64, actual: Demand) -> Result<(), u16> {
        let before = self.generator.position();
        let (demand, ended) = match &mut self.feed {
            Some(Feed::Stream(stream)) => (stream.output(now)?, false),
            Some(Feed::Curve(curve)) => {
                let (demand, ended) = curve.advance(dt_ns);
                (Some(demand), ended)
            }
            None => (None, false),
        };
        match demand {
            Some(demand) => {
                self.generator.set(demand.position, demand.velocity, demand.acceleration);
                self.target = demand.position;
            }
            // Until the first setpoint of a stream is due, the motion before it goes on.
            None => self.generator.advance(dt_ns),
        }
        if ended {
            self.feed = None;
            self.generator.halt();
        }
        match self.armed {
            Some(Armed::After(motion)) if !self.is_moving() => self.start(motion, actual),
            Some(Armed::Passing { positive, position, limits }) => {
                let after = self.generator.position();
                let passed = if positive {
                    before < position && position <= after
                } else {
                    after <= position && position < before
                };
                if passed {
                    self.armed = None;
                    if self.resume.is_some() {
                        self.limits = limits;
                        self.resume = Some(limits);
                        self.resume();
                    }
                }
            }
            _ => {}
        }
        Ok(())
    }
}
