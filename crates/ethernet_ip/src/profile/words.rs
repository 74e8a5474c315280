//! The command that is wanted next, with its parameters as the wire has them.

use super::{BUSY, Holder, Rules, Seen, State, Step};
use crate::edges::{Urgency, Wanted};
use crate::native::NativeOutput;
use crate::plan::{HomingMethod, MOST_PER_REV};
use crate::wire::assembly::{Letters, Outputs, command};
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::bus::desired::{Motion, Power};

/// The host command that sets the position.
const SET_POSITION: Letters = Letters(u16::from_be_bytes(*b"SP"));

/// The target of a move, steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Target {
    Absolute(i32),
    /// From where the drive stands.
    Relative(i32),
}

impl State {
    /// The command that is wanted next, and whose it is.
    pub(super) fn wanted(
        &self,
        seen: &Seen,
        next: Option<NativeOutput>,
        rules: &Rules,
    ) -> (Holder, Option<Wanted>) {
        let stops = |word| {
            let fast = word == command::STOP_FAST;
            let urgency = if fast { Urgency::FastStop } else { Urgency::Stop };
            Some(Wanted { word, urgency, repeats: 0 })
        };
        let goes = |word| Some(Wanted { word, urgency: Urgency::None, repeats: 0 });
        let moves = |word| Some(Wanted { word, urgency: Urgency::None, repeats: self.repeats });
        let is_stop = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        let is_due = self.power_step == Step::Due;
        // It replaces an enable that is under way, and waits for no stop.
        if is_due && matches!(self.power.value, Power::Off | Power::Shutdown) {
            let off = Wanted { word: command::DISABLE, urgency: Urgency::Off, repeats: 0 };
            return (Holder::Power, Some(off));
        }
        if self.motion_step == Step::Due && is_stop {
            return (Holder::Motion, stops(self.stop_word(rules)));
        }
        if is_due {
            return match self.power.value {
                Power::QuickStop => (Holder::Power, stops(command::STOP_FAST)),
                Power::EnableOperation if !seen.has(BUSY) => (Holder::Power, goes(command::ENABLE)),
                Power::FaultReset => (Holder::Power, goes(command::RESET_ALARM)),
                _ => (Holder::Nobody, None),
            };
        }
        // Only a drive in operation moves.
        if self.power.value != Power::EnableOperation || !seen.is_enabled() || seen.has(BUSY) {
            return (Holder::Nobody, None);
        }
        match (self.motion_step, self.motion.value) {
            (Step::Clearing, _) if seen.moves() => (Holder::Clearing, stops(command::STOP)),
            (Step::Due, motion) => (Holder::Motion, rules.motion_word(motion, seen).and_then(moves)),
            (Step::Zeroing { held: false }, _) => (Holder::Motion, goes(command::HOST)),
            (Step::Settled, Motion::Native(NativeOwner::Master)) if self.refused.is_none() => {
                let next = next.filter(is_motion);
                (Holder::Native, next.and_then(|output| goes(output.outputs.command)))
            }
            _ => (Holder::Nobody, None),
        }
    }

    /// A stop along the ramp that is set, unless that of the motion that runs is flatter.
    fn stop_word(&self, rules: &Rules) -> u32 {
        match (self.motion.value, self.ramp) {
            (Motion::Ramp { deceleration }, Some(ramp)) if ramp < rules.acceleration(deceleration) => {
                command::STOP_FAST
            }
            (Motion::Ramp { .. }, _) => command::STOP,
            _ => command::STOP_FAST,
        }
    }

    /// The parameters of the command that begins.
    pub(super) fn parameters(
        &self,
        holder: Holder,
        seen: &Seen,
        next: Option<NativeOutput>,
        rules: &Rules,
    ) -> Outputs {
        let Rules { units, homing, .. } = rules;
        let before = self.outputs;
        if holder == Holder::Native {
            return next.map_or(before, |output| output.outputs);
        }
        if holder != Holder::Motion {
            return before;
        }
        match (self.motion_step, self.motion.value) {
            (Step::Zeroing { .. }, _) => {
                Outputs { letters: SET_POSITION, register_1: 0, register_2: 0, ..before }
            }
            (_, Motion::Move { position, profile }) => Outputs {
                velocity: rules.speed(profile.velocity),
                acceleration: rules.acceleration(profile.acceleration),
                deceleration: rules.acceleration(profile.deceleration),
                distance: match rules.target(position, seen.demand) {
                    Target::Absolute(distance) | Target::Relative(distance) => distance,
                },
                ..before
            },
            (_, Motion::Velocity { velocity, acceleration }) => {
                let ramp = rules.acceleration(acceleration);
                Outputs {
                    jog_speed: rules.signed_speed(velocity),
                    jog_acceleration: ramp,
                    jog_deceleration: ramp,
                    ..before
                }
            }
            (_, Motion::Ramp { deceleration }) => {
                let ramp = rules.acceleration(deceleration);
                Outputs { deceleration: ramp, jog_deceleration: ramp, ..before }
            }
            (_, Motion::Home) => homing.as_ref().map_or(before, |homing| {
                let ramp = rules.acceleration(homing.acceleration);
                Outputs {
                    velocity: rules.speed(homing.velocity),
                    acceleration: ramp,
                    deceleration: ramp,
                    distance: (homing.distance * units.counts_per_unit).round() as i32,
                    register_1: homing.input.into(),
                    register_2: 0,
                    ..before
                }
            }),
            _ => before,
        }
    }
}

impl Rules {
    pub(super) fn motion_word(&self, motion: Motion, seen: &Seen) -> Option<u32> {
        Some(match motion {
            Motion::Move { position, .. } => match self.target(position, seen.demand) {
                Target::Absolute(_) => command::MOVE_ABSOLUTE,
                Target::Relative(_) => command::MOVE_RELATIVE,
            },
            Motion::Velocity { .. } if seen.jogs() => command::JOG_SPEED,
            Motion::Velocity { .. } => command::JOG,
            Motion::Home => match self.homing.as_ref()?.method {
                HomingMethod::Seek => command::SEEK_HOME,
                HomingMethod::Find => command::FIND_HOME,
            },
            _ => return None,
        })
    }

    /// Not zero: with a zero the drive would never arrive. What the wire cannot carry was refused before.
    pub(super) fn speed(&self, velocity: f64) -> u32 {
        ((velocity * self.velocity).abs().round() as u32).max(1)
    }

    /// With its direction, and not zero.
    pub(super) fn signed_speed(&self, velocity: f64) -> i32 {
        let speed = self.speed(velocity) as i32;
        if velocity * self.velocity < 0.0 { -speed } else { speed }
    }

    pub(super) fn acceleration(&self, acceleration: f64) -> u32 {
        ((acceleration * self.acceleration).abs().round() as u32).clamp(1, MOST_PER_REV as u32)
    }

    /// How a drive that stands at `demand` is sent to a position. What it makes of a position behind the end of its
    /// counts is not documented: it may go round the other way. There it is sent by the distance. No way of a linear
    /// axis leads over that end.
    pub(super) fn target(&self, position: f64, demand: i64) -> Target {
        let target = self.position(position, demand);
        let way = target.wrapping_sub(demand as i32);
        match (demand as i32).checked_add(way) {
            None if self.units.modulo.is_some() => Target::Relative(way),
            _ => Target::Absolute(target),
        }
    }

    /// The count of a rotary axis wraps around, in the drive as here.
    pub(super) fn position(&self, position: f64, demand: i64) -> i32 {
        let from = if self.units.modulo.is_some() { demand } else { 0 };
        let counts = ((position - self.units.offset) * self.units.counts_per_unit).round();
        let way = (counts - from as f64) as i32;
        (from + i64::from(way)) as i32
    }
}

/// A motion that the drive makes until its end.
pub(super) fn is_begun(motion: Motion) -> bool {
    matches!(motion, Motion::Move { .. } | Motion::Velocity { .. } | Motion::Home)
}

/// True if the application commands something in native mode while the master keeps the drive running, and not its
/// power.
pub(super) fn is_motion(output: &NativeOutput) -> bool {
    let word = output.outputs.command;
    word != command::IDLE && word & (command::ENABLE | command::DISABLE | command::RESET_ALARM) == 0
}
