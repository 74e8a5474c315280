//! Demand and moves of the drive: their values in SI units, and those of the wire.

/// One wire count of position, m.
pub(super) const METRE: f64 = 1e-7;
/// One wire count of velocity, m/s.
pub(super) const METRE_PER_S: f64 = 1e-6;
/// One wire count of acceleration, m/s2.
pub(super) const METRE_PER_S2: f64 = 1e-5;

/// A position and how it changes: m, m/s, m/s2.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Demand {
    pub position: f64,
    pub velocity: f64,
    pub acceleration: f64,
}

/// Velocity, acceleration and deceleration of a profile: 1 um/s, and twice 1e-5 m/s2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Vad {
    pub velocity: u32,
    pub acceleration: u32,
    pub deceleration: u32,
}

/// The origin of the value of a move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    Zero,
    Demand,
    /// The last target.
    Target,
    Actual,
}

/// Where demand position and velocity of a move start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Start {
    /// Demand position, demand velocity.
    Demand,
    /// Actual position, actual velocity.
    Actual,
    /// Actual position, velocity 0.
    Standstill,
}

/// When something starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum When {
    Now,
    /// After the running command.
    AfterActual,
    /// On an edge of the trigger input.
    Trigger,
}

/// A move to a target, all in SI units but the limits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Move {
    /// A position or a distance, m.
    pub value: f64,
    pub origin: Origin,
    pub start: Start,
    pub limits: Vad,
}
