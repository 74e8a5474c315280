//! The values that the software takes from the parameters: read once after each change, not in every step.

use super::super::demand::{METRE, Move, Origin, Start, Vad};
use super::super::parameters::Parameters;
use super::super::upids;
use fieldbeat_core::time::US;

/// How the drive is run (UPID 1450h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum RunMode {
    /// 1: motion commands.
    Commands,
    /// 3: the command table runs as soon as the drive is in state 8 and homed; motion commands are accepted, too.
    Table,
    /// One that this drive has no inputs for: motion commands are refused.
    Other,
}

/// The parameters in use.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Settings {
    pub run_mode: RunMode,
    /// The position at the home switch, and the switch in the motor's own coordinates, m.
    pub home: f64,
    pub slider_home: f64,
    /// 0.1 um.
    pub range: (i32, i32),
    /// m.
    pub lag_moving: f64,
    pub lag_standing: f64,
    pub predefined: Vad,
    /// Steps of the 16-bit commands: position, velocity, acceleration, deceleration, in wire counts.
    pub scale: (u32, u32, u32, u32),
    /// The moves that belong to the edges of the trigger.
    pub on_rise: Move,
    pub on_fall: Move,
    pub stream_period_ns: u64,
    /// The indices of the parameters that the monitoring channels report.
    pub monitored: [Option<usize>; 4],
}

impl Settings {
    pub(super) fn of(parameters: &Parameters) -> Settings {
        // Every parameter is checked against its limits when it is written, and those fit.
        let signed = |upid| parameters.used(upid) as i32;
        let unsigned = |upid| parameters.used(upid) as u32;
        let metres = |upid| parameters.used(upid) as f64 * METRE;
        // Velocity, acceleration, deceleration follow each other.
        let profile = |first: u16| Vad {
            velocity: unsigned(first),
            acceleration: unsigned(first + 1),
            deceleration: unsigned(first + 2),
        };
        // And behind a position.
        let triggered = |first: u16| Move {
            value: metres(first),
            origin: Origin::Zero,
            start: Start::Demand,
            limits: profile(first + 1),
        };
        Settings {
            run_mode: match parameters.used(upids::RUN_MODE) {
                1 => RunMode::Commands,
                3 => RunMode::Table,
                _ => RunMode::Other,
            },
            home: metres(upids::HOME_POSITION),
            slider_home: metres(upids::SLIDER_HOME_POSITION),
            range: (signed(upids::MINIMUM_POSITION), signed(upids::MAXIMUM_POSITION)),
            lag_moving: metres(upids::LAG_MOVING),
            lag_standing: metres(upids::LAG_STANDING),
            predefined: profile(upids::PREDEFINED_VELOCITY),
            scale: (
                unsigned(upids::SCALE_POSITION),
                unsigned(upids::SCALE_VELOCITY),
                unsigned(upids::SCALE_ACCELERATION),
                unsigned(upids::SCALE_DECELERATION),
            ),
            on_rise: triggered(upids::RISE_POSITION),
            on_fall: triggered(upids::FALL_POSITION),
            stream_period_ns: u64::from(unsigned(upids::STREAM_PERIOD)) * US,
            monitored: parameters.monitored(),
        }
    }
}
