//! A motion command as a drive reads it: everything that it executes, independent of its encoding.
//!
//! Values are wire integers, units as in `values`; they may be out of their meaningful range, since a drive has to
//! take what comes.

use super::catalogue::CommandInfo;
use super::meaning::meaning;
use crate::bus::linudp::plan::StreamCommand;
use crate::bus::linudp::wire::MotionBlock;

/// What a command says, as a drive reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decoded {
    /// 000x.
    NoOperation,
    /// 001x: the interface's control word.
    ControlWord(u16),
    /// 002x.
    LiveParameter {
        /// The parameter.
        upid: u16,
        /// Its raw value.
        value: u32,
    },
    /// 003x, 004x: digital outputs.
    Outputs {
        /// Of X6, else of X4 or X14.
        x6: bool,
        /// The outputs that change.
        mask: u16,
        /// Their levels.
        value: u16,
    },
    /// 005x: the position controller set, 0 or 1.
    ControllerSet(u16),
    /// 008x.
    ClearEvents,
    /// 009x: the actual position shall be this one, 0.1 um.
    MasterHoming(i32),
    /// 00Fx.
    ResetFirmware,
    /// A move to a target: the families 01x, 02x, 09x, 0Ax, 0Bx, 0Cx, 0Dx, 0Ex, 0Fx and 3Ax.
    Move(Move),
    /// 0C5x ... 0C7x: a move with a limited current.
    Press {
        /// The move.
        motion: Move,
        /// At most so much, mA.
        current: u16,
    },
    /// 0D9x: the integrator is reset, then the move.
    ResetIntegratorAndMove(Move),
    /// 0DEx, 0DFx: the VAI that belongs to an edge of the trigger, at once.
    StartTriggered {
        /// To the rising edge.
        rising: bool,
    },
    /// 017x with its deceleration (1e-5 m/s2); 027x and 0A7x have none and take the quick-stop deceleration.
    Stop(Option<u32>),
    /// 097x: with its deceleration in the 16-bit scaling.
    StopScaled(u16),
    /// 02Ex, 02Fx, 0CEx, 0CFx: run without end.
    Run {
        /// Towards higher positions.
        positive: bool,
        /// 1 um/s and 1e-5 m/s2; `None` takes the drive's own.
        velocity: Option<u32>,
        /// Acceleration and deceleration, 1e-5 m/s2; `None` takes the drive's own.
        acceleration: Option<u32>,
    },
    /// 01Ex, 01Fx, 09Ex, 09Fx: take another profile when the demand passes a position.
    ChangeProfile {
        /// Passes it in positive direction.
        positive: bool,
        /// The position, 0.1 um.
        position: i32,
        /// The profile from there on.
        profile: Vad,
        /// All four are in the 16-bit scaling.
        scaled: bool,
    },
    /// 070x, 071x, 07Ex, 07Fx.
    Indexing {
        /// The sub id.
        sub: u8,
        /// 0.1 um.
        position: i32,
        /// `None` takes the drive's own.
        profile: Option<Vad>,
    },
    /// 030x ... 035x: a streamed setpoint. What the command does not carry is 0.
    Stream {
        /// Which command.
        command: StreamCommand,
        /// 0.1 um.
        position: i32,
        /// 1 um/s, signed.
        velocity: i32,
        /// 1e-5 m/s2, signed.
        acceleration: i32,
    },
    /// 03Ax: a streamed setpoint with the controller's time stamp.
    StreamStamped {
        /// 0.1 um.
        position: i32,
        /// 1 um/s, signed.
        velocity: i32,
        /// 1e-5 m/s2, signed.
        acceleration: i32,
    },
    /// 03Fx.
    EndStream,
    /// 040x ... 04Fx: run a time curve.
    Curve(CurveStart),
    /// 050x: the address that a curve starts at.
    CurveAddress {
        /// The curve's id.
        curve: u16,
        /// Its address.
        address: u16,
    },
    /// 051x ... 056x: write to a curve in RAM.
    ModifyCurve {
        /// The curve's id.
        curve: u16,
        /// Into its info block, otherwise into its setpoints.
        info: bool,
        /// The offset.
        offset: u16,
        /// The values.
        values: Written,
    },
    /// 064x ... 06Ex: an encoder cam that runs after a delay.
    DelayedCam {
        /// The curve's id.
        curve: u16,
        /// Counts of the encoder.
        delay: i32,
        /// From when on it counts; `Now`: from the actual counts.
        when: When,
        /// How the curve is stretched.
        fit: CamFit,
    },
    /// 100x: encoder cams are enabled, 101x: disabled.
    EnableCams(bool),
    /// 102x: to the position that the cam has at the encoder's counts.
    GoToSync,
    /// 104x: the counts of the encoder are these.
    EncoderCounts(i32),
    /// 110x ... 115x and 120x ... 125x: start encoder cam 1 or 2.
    Cam {
        /// 1 or 2.
        cam: u8,
        /// The curve's id.
        curve: u16,
        /// Where it begins, counts of the encoder.
        start: i32,
        /// At the actual position.
        from_actual: bool,
        /// How the curve is stretched.
        fit: CamFit,
    },
    /// 116x, 117x, 126x, 127x: enable or disable encoder cam 1 or 2.
    EnableCam {
        /// 1 or 2.
        cam: u8,
        /// Or disable.
        enable: bool,
    },
    /// 118x, 128x: another amplitude and length.
    ScaleCam {
        /// 1 or 2.
        cam: u8,
        /// 0.1 %.
        amplitude: i16,
        /// Counts of the encoder.
        length: i32,
    },
    /// 200x ... 202x: start a command table entry.
    TableEntry {
        /// Its id.
        entry: u16,
        /// Now or at the trigger.
        when: When,
    },
    /// 208x, 209x: write to an entry in RAM.
    ModifyEntry {
        /// Its id.
        entry: u16,
        /// Offset from its beginning.
        offset: u16,
        /// The value.
        value: Written,
    },
    /// 210x ... 22Fx: the command table waits.
    Wait(Wait),
    /// 240x ... 243x: set a variable of the command table, or add to it.
    Variable {
        /// 1 or 2.
        variable: u8,
        /// Add, otherwise set.
        add: bool,
        /// Raw.
        value: i32,
    },
    /// 248x, 249x: a variable is written to a parameter in RAM.
    VariableToUpid {
        /// 1 or 2.
        variable: u8,
        /// The parameter.
        upid: u16,
    },
    /// 24Cx, 24Dx: a variable is read from a parameter or variable of the drive.
    UpidToVariable {
        /// 1 or 2.
        variable: u8,
        /// The source.
        upid: u16,
    },
    /// 24Ex: a parameter is copied from RAM to ROM.
    UpidToRom(u16),
    /// 250x ... 266x: the command table goes on with one of two entries.
    If {
        /// The condition.
        condition: Condition,
        /// The entry if it holds.
        if_true: u16,
        /// The entry if it does not.
        if_false: u16,
    },
    /// 304x, 305x, 310x, 311x.
    Winding {
        /// Its id.
        id: u16,
        /// Its number, if it has one.
        number: u16,
        /// Its revolutions, if it has them.
        revolutions: i32,
    },
    /// 380x ... 389x but for 382x: a move with force control.
    Force {
        /// Its id.
        id: u16,
        /// A position or a distance, 0.1 um.
        value: i32,
        /// 1 um/s.
        velocity: u32,
        /// 1e-5 m/s2.
        acceleration: u32,
        /// 1e-5 m/s2, where it has one.
        deceleration: Option<u32>,
        /// 0.1 N, where it has one.
        limit: Option<i16>,
        /// 0.1 N, where it has one.
        target: Option<i16>,
    },
    /// 382x: another target force, 0.1 N.
    ForceTarget(i16),
    /// 390x: control the current, mA.
    CurrentMode(i32),
    /// 39Fx: back to position control.
    PositionMode,
    /// Anything else.
    Unknown,
}

/// Velocity, acceleration and deceleration of a profile, in wire units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Vad {
    /// 1 um/s.
    pub velocity: u32,
    /// 1e-5 m/s2.
    pub acceleration: u32,
    /// 1e-5 m/s2.
    pub deceleration: u32,
}

/// A move to a target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Move {
    /// A position or a distance, 0.1 um; 0 where `origin` gives the target alone.
    pub value: i32,
    /// What `value` is counted from.
    pub origin: Origin,
    /// Where demand position and velocity start.
    pub start: Start,
    /// When.
    pub when: When,
    /// The shape of the profile.
    pub shape: Shape,
    /// 1 um/s; `None` takes the drive's own (UPID 14BEh).
    pub velocity: Option<u32>,
    /// 1e-5 m/s2; `None` takes the drive's own (UPID 14BFh).
    pub acceleration: Option<u32>,
    /// 1e-5 m/s2; `None` takes the drive's own (UPID 14C0h).
    pub deceleration: Option<u32>,
    /// Value, velocity, acceleration and deceleration are in the 16-bit scaling (UPIDs 1455h-1458h).
    pub scaled: bool,
}

/// What the value of a move is counted from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The zero of the axis.
    Zero,
    /// The demand position.
    Demand,
    /// The last target.
    Target,
    /// The actual position.
    Actual,
    /// The captured position.
    Captured,
    /// The position of the analog input.
    Analog,
    /// The position in variable 1 or 2 of the command table.
    Variable(u8),
}

/// Where demand position and velocity of a move start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Demand position, demand velocity.
    Demand,
    /// Actual position, actual velocity.
    Actual,
    /// Actual position, velocity 0.
    Standstill,
}

/// When something starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// At once.
    Now,
    /// After the running command.
    AfterActual,
    /// On the trigger input.
    Trigger {
        /// Its rising edge, else its falling one.
        rising: bool,
    },
}

impl When {
    pub(super) const RISING: When = When::Trigger { rising: true };
    pub(super) const FALLING: When = When::Trigger { rising: false };
}

/// The shape of a profile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// VAI: trapezoid; may replace a running motion.
    Trapezoid,
    /// Sine VA; starts from standstill only.
    Sine,
    /// Bestehorn VAJ, jerk in 1e-4 m/s3; starts from standstill only.
    Bestehorn(u32),
    /// VAJI, jerk in 1e-4 m/s3; may replace a running motion.
    JerkLimited(u32),
}

/// A time curve that is to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CurveStart {
    /// Its id.
    pub curve: u16,
    /// It begins at the actual position, else at the demand position.
    pub from_actual: bool,
    /// When.
    pub when: When,
    /// How it is stretched.
    pub fit: CurveFit,
}

/// How a time curve is stretched. Times in 10 us, positions in 0.1 um, time scales in 0.01 %, amplitudes in 0.1 %.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurveFit {
    /// Not at all.
    Plain,
    /// So that it ends at this position.
    Target(i32),
    /// So that it ends at this position after this time.
    TargetInTime {
        /// The position.
        target: i32,
        /// The time.
        time: i32,
    },
    /// By scales.
    Scaled {
        /// Added to each position.
        offset: i32,
        /// In relation to its own time.
        time_scale: u16,
        /// In relation to its own amplitude.
        amplitude: i16,
    },
    /// By an amplitude, and so that it takes this time.
    InTime {
        /// Added to each position.
        offset: i32,
        /// Its duration.
        time: i32,
        /// In relation to its own amplitude.
        amplitude: i16,
    },
}

/// How the curve of an encoder cam is stretched. Lengths in counts, positions in 0.1 um, amplitudes in 0.1 %.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CamFit {
    /// Not at all.
    Plain,
    /// So that it ends at this position.
    Target(i32),
    /// So that it ends at this position after this length.
    TargetOver {
        /// The position.
        target: i32,
        /// The length.
        length: i32,
    },
    /// From one position to another.
    Between {
        /// Where it begins.
        start: i32,
        /// Where it ends.
        target: i32,
        /// The length.
        length: i32,
    },
    /// By an amplitude, over that length.
    Scaled {
        /// In relation to its own amplitude.
        amplitude: i16,
        /// Its length.
        length: i32,
    },
}

/// A value written into a curve or an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    /// 16 bits.
    Short(i16),
    /// 32 bits.
    One(i32),
    /// Twice 32 bits.
    Two([i32; 2]),
    /// Three times 32 bits.
    Three([i32; 3]),
}

/// What the command table waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wait {
    /// 100 us.
    Time(u32),
    /// The time in variable 1 or 2.
    Variable(u8),
    /// The end of the motion.
    MotionFinished,
    /// In target position.
    InTarget,
    /// An edge of the trigger.
    Trigger {
        /// The rising one, else the falling one.
        rising: bool,
    },
    /// Until this holds.
    Until(Comparison),
}

/// A quantity of the drive, and a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Comparison {
    /// What is compared.
    pub quantity: Quantity,
    /// It holds while the quantity is greater than the limit, else while it is less.
    pub greater: bool,
    /// In the quantity's unit.
    pub limit: i32,
}

/// What can be compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// 0.1 um.
    DemandPosition,
    /// 0.1 um.
    ActualPosition,
    /// Of demand and actual position, 0.1 um.
    Difference,
    /// The same without its sign.
    UnsignedDifference,
    /// 1 um/s.
    DemandVelocity,
    /// 1 um/s.
    ActualVelocity,
    /// 1 mA.
    Current,
    /// Variable 1 or 2 of the command table.
    Variable(u8),
    /// Raw.
    AnalogInput,
}

/// The condition of a branch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Condition {
    /// This comparison holds.
    Compare(Comparison),
    /// A word equals `value` in the bits of `mask`.
    Masked {
        /// The word.
        word: Word,
        /// The bits that count.
        mask: u16,
        /// Their required values.
        value: u16,
    },
    /// 266x: the sources do not say.
    Unknown(i32),
}

/// A word that a branch may read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Word {
    /// The inputs X4.
    X4Inputs,
    /// The inputs X6.
    X6Inputs,
    /// The status word.
    Status,
    /// The warn word.
    Warn,
}

impl Decoded {
    /// The meaning of `block`; its count is ignored.
    pub fn of(block: &MotionBlock) -> Decoded {
        CommandInfo::of(block.header >> 4)
            .and_then(|info| meaning(info, info.values(&block.parameters)))
            .unwrap_or(Decoded::Unknown)
    }
}
