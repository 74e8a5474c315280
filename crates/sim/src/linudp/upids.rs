//! The parameters and variables of the simulated drive: every UPID whose meaning is known, one line each.
//!
//! Knows no values in use; those live in `parameters`. Numbers and meanings are those of the manuals (LinUDP V2,
//! Motion Control SW) and of masters in the field. **Types, limits and defaults are chosen**, since the available
//! manuals do not print them: only 13A2h (u16), the units of positions, velocities and accelerations, and the units
//! of 0082h, 1BCDh, 1BCEh, 1BF3h and 1CAFh are known. Which parameters are live is chosen, too: those that a master
//! sets up or changes in operation are, those that describe the machine are not.

use super::codec::channel::{Type, usage};

/// A value that the drive computes whenever it is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Variable {
    /// A value of hardware that this drive does not have.
    Constant(i64),
    OperatingMs,
    TimerUs,
    DemandCurrent,
    Status,
    Count,
    Target,
    LimitVelocity,
    LimitAcceleration,
    LimitDeceleration,
    DemandPosition,
    DemandVelocity,
    DemandAcceleration,
}

/// A parameter without access restrictions.
const CONFIG: u16 = usage::RAM_READ | usage::RAM_WRITE | usage::ROM_READ | usage::ROM_WRITE;

/// One UPID.
#[derive(Clone, Copy, Debug)]
pub(super) struct Parameter {
    pub upid: u16,
    pub kind: Type,
    pub low: i64,
    pub high: i64,
    pub default: i64,
    pub usage: u16,
    /// The source of the value, if it is not a stored one.
    pub variable: Option<Variable>,
}

impl Parameter {
    /// Can be used like this.
    pub(super) fn has(&self, usage: u16) -> bool {
        self.usage & usage == usage
    }

    /// A parameter that takes effect at the next start of the software.
    const fn config(upid: u16, kind: Type, limits: (i64, i64), default: i64) -> Parameter {
        let (low, high) = limits;
        Parameter { upid, kind, low, high, default, usage: CONFIG, variable: None }
    }

    /// A parameter that takes effect at once.
    const fn live(upid: u16, kind: Type, limits: (i64, i64), default: i64) -> Parameter {
        let usage = CONFIG | usage::LIVE;
        Parameter { usage, ..Parameter::config(upid, kind, limits, default) }
    }

    /// A fixed text, four bytes of it.
    const fn text(upid: u16, text: [u8; 4]) -> Parameter {
        let usage = usage::RAM_READ | usage::ROM_READ | usage::NOT_HASHED;
        let default = u32::from_le_bytes(text) as i64;
        Parameter { usage, ..Parameter::config(upid, Type::Stringlet, Type::Stringlet.range(), default) }
    }

    /// A value that the drive computes; in RAM only, and not writable from outside.
    const fn variable(upid: u16, kind: Type, variable: Variable) -> Parameter {
        Parameter {
            usage: usage::RAM_READ | usage::NOT_HASHED,
            variable: Some(variable),
            ..Parameter::config(upid, kind, kind.range(), 0)
        }
    }

    /// A value in RAM that every client may write.
    const fn scratch(upid: u16, kind: Type) -> Parameter {
        let usage = usage::RAM_READ | usage::RAM_WRITE | usage::LIVE | usage::NOT_HASHED;
        Parameter { usage, ..Parameter::config(upid, kind, kind.range(), 0) }
    }
}

// The UPIDs that the drive itself uses.
pub(super) const CONTROLLER_SET: u16 = 0x1393;
pub(super) const HOME_POSITION: u16 = 0x13C7;
pub(super) const SLIDER_HOME_POSITION: u16 = 0x13CA;
pub(super) const RUN_MODE: u16 = 0x1450;
pub(super) const SCALE_POSITION: u16 = 0x1455;
pub(super) const SCALE_VELOCITY: u16 = 0x1456;
pub(super) const SCALE_ACCELERATION: u16 = 0x1457;
pub(super) const SCALE_DECELERATION: u16 = 0x1458;
/// Position, velocity, acceleration, deceleration, one after the other; so at the falling edge, and without a position
/// the predefined profile.
pub(super) const RISE_POSITION: u16 = 0x145A;
pub(super) const FALL_POSITION: u16 = 0x145F;
pub(super) const MINIMUM_POSITION: u16 = 0x146E;
pub(super) const MAXIMUM_POSITION: u16 = 0x146F;
pub(super) const LAG_MOVING: u16 = 0x1473;
pub(super) const LAG_STANDING: u16 = 0x1475;
pub(super) const PREDEFINED_VELOCITY: u16 = 0x14BE;
pub(super) const STREAM_PERIOD: u16 = 0x14E6;
pub(super) const VARIABLE_1: u16 = 0x1E72;
pub(super) const VARIABLE_2: u16 = 0x1E73;
/// Of the first monitoring channel; the three others follow.
pub(super) const MONITOR_SOURCE: u16 = 0x20A8;

/// Positions, 0.1 um.
const POSITION: (i64, i64) = Type::S32.range();
/// A quarter of the range of u32, which no unit conversion overflows. 1 um/s and 1e-5 m/s2.
const RATE: (i64, i64) = (1, 1 << 30);
const WORD: (i64, i64) = Type::U16.range();
/// Limits of a position lag limit, 0.1 um: 1 um ... 1 m.
const LAG: (i64, i64) = (10, 10_000_000);

/// All of them, by rising UPID.
#[rustfmt::skip]
pub(super) const PARAMETERS: &[Parameter] = {
    use Type::{Bool, S16, S32, U8, U16, U32};
    use Variable as V;
    type P = Parameter;
    &[
        P::text(0x000C, *b"FIEL"), // article number 1
        P::text(0x000D, *b"DBEA"), // article number 2
        P::text(0x000E, *b"T SI"), // article number 3
        P::text(0x000F, *b"M\0\0\0"), // article number 4
        P::variable(0x0082, U32, V::OperatingMs), // operating hours, sub part (ms)
        P::config(0x100E, U16, WORD, 2_000), // logic supply, lower limit (10 mV)
        P::config(0x1010, U16, WORD, 2_800), // logic supply, upper limit (10 mV)
        P::config(0x1018, U16, WORD, 4_000), // motor supply, lower warning (10 mV)
        P::config(0x1019, U16, WORD, 3_600), // motor supply, lower error (10 mV)
        P::config(0x101A, U16, WORD, 8_600), // motor supply, upper warning (10 mV)
        P::config(0x101B, U16, WORD, 9_000), // motor supply, upper error (10 mV)
        P::config(0x1039, U16, (0, 31), 0), // trigger input function
        P::config(0x1060, U8, (0, 63), 0), // input function 1
        P::config(0x1061, U8, (0, 63), 0), // input function 2
        P::config(0x1062, U8, (0, 63), 0), // input function 3
        P::config(0x1063, U8, (0, 63), 0), // input function 4
        P::config(0x1070, U8, (0, 63), 0), // output function 1
        P::config(0x1071, U8, (0, 63), 0), // output function 2
        P::config(0x1072, U8, (0, 63), 0), // output function 3
        P::live(CONTROLLER_SET, U16, (0, 1), 0), // active position controller set (0 = A, 1 = B)
        P::live(0x13A0, U16, WORD, 0), // set A: acceleration feed forward
        P::live(0x13A2, U16, WORD, 150), // set A: P gain
        P::live(0x13A6, U16, WORD, 15_000), // set A: maximum current (mA)
        P::live(0x13A8, U16, WORD, 200), // set A: D gain
        P::live(0x13B4, U16, WORD, 0), // set B: acceleration feed forward
        P::live(0x13BA, U16, WORD, 15_000), // set B: maximum current (mA)
        P::config(HOME_POSITION, S32, POSITION, 0), // home position (0.1 um)
        P::config(SLIDER_HOME_POSITION, S32, POSITION, 0), // slider home position (0.1 um)
        P::live(RUN_MODE, U16, (1, 0x10), 1), // run mode
        P::live(SCALE_POSITION, U32, (1, 65_536), 1_000), // position of the 16-bit commands (0.1 um a step)
        P::live(SCALE_VELOCITY, U32, (1, 65_536), 1_000), // velocity of the 16-bit commands (um/s a step)
        P::live(SCALE_ACCELERATION, U32, (1, 65_536), 10_000), // acceleration of the 16-bit commands (1e-5 m/s2 a step)
        P::live(SCALE_DECELERATION, U32, (1, 65_536), 10_000), // deceleration of the 16-bit commands (1e-5 m/s2 a step)
        P::live(RISE_POSITION, S32, POSITION, 0), // trigger rise: position (0.1 um)
        P::live(0x145B, U32, RATE, 1_000_000), // trigger rise: velocity (um/s)
        P::live(0x145C, U32, RATE, 1_000_000), // trigger rise: acceleration (1e-5 m/s2)
        P::live(0x145D, U32, RATE, 1_000_000), // trigger rise: deceleration (1e-5 m/s2)
        P::live(FALL_POSITION, S32, POSITION, 0), // trigger fall: position (0.1 um)
        P::live(0x1460, U32, RATE, 1_000_000), // trigger fall: velocity (um/s)
        P::live(0x1461, U32, RATE, 1_000_000), // trigger fall: acceleration (1e-5 m/s2)
        P::live(0x1462, U32, RATE, 1_000_000), // trigger fall: deceleration (1e-5 m/s2)
        P::live(MINIMUM_POSITION, S32, POSITION, -10_000_000), // minimum position (0.1 um)
        P::live(MAXIMUM_POSITION, S32, POSITION, 10_000_000), // maximum position (0.1 um)
        P::live(LAG_MOVING, U32, LAG, 50_000), // position lag limit, always (0.1 um)
        P::live(LAG_STANDING, U32, LAG, 50_000), // position lag limit, standing (0.1 um)
        P::live(PREDEFINED_VELOCITY, U32, RATE, 1_000_000), // predefined VAI: velocity (um/s)
        P::live(0x14BF, U32, RATE, 1_000_000), // predefined VAI: acceleration (1e-5 m/s2)
        P::live(0x14C0, U32, RATE, 1_000_000), // predefined VAI: deceleration (1e-5 m/s2)
        P::live(STREAM_PERIOD, U32, (100, 1_000_000), 1_000), // streaming period (us)
        P::config(0x1527, U16, (0, 3), 0), // cam mode
        P::config(0x1528, U16, (0, 1), 0), // cam start enable
        P::config(0x154A, U8, (0, 100), 0), // triggered cam 1: id
        P::config(0x154B, U32, Type::U32.range(), 0), // triggered cam 1: delay (counts)
        P::config(0x154C, U8, (0, 100), 0), // triggered cam 2: id
        P::config(0x154D, U32, Type::U32.range(), 0), // triggered cam 2: delay (counts)
        P::config(0x170C, U16, (0, 3), 0), // trigger mode
        P::variable(0x1B8D, U32, V::Constant(0x8000_1B8D)), // a monitor source of unknown meaning
        P::variable(0x1B93, S16, V::DemandCurrent), // demand current (mA)
        P::variable(0x1BA9, Bool, V::Constant(0)), // cam enabled
        P::variable(0x1BCD, S16, V::Constant(400)), // drive core temperature (0.1 C)
        P::variable(0x1BCE, S16, V::Constant(412)), // highest drive temperature (0.1 C)
        P::variable(0x1BDD, U16, V::Constant(0)), // power loss
        P::variable(0x1BF3, U16, V::Constant(82)), // motor temperature (x 250/255 - 50 C)
        P::variable(0x1C00, S16, V::Constant(35)), // temperature reserve (C)
        P::variable(0x1C1B, S16, V::Constant(0)), // commutation offset found
        P::variable(0x1CAF, U32, V::TimerUs), // drive timer (us)
        P::variable(0x1D51, U16, V::Status), // status word
        P::variable(0x1DB0, U16, V::Count), // low nibble: motion command count
        P::variable(0x1E0A, S32, V::Target), // VAI target position (0.1 um)
        P::variable(0x1E0B, U32, V::LimitVelocity), // VAI velocity limit (um/s)
        P::variable(0x1E0C, U32, V::LimitAcceleration), // VAI acceleration limit (1e-5 m/s2)
        P::variable(0x1E0D, U32, V::LimitDeceleration), // VAI deceleration limit (1e-5 m/s2)
        P::variable(0x1E0E, S32, V::DemandPosition), // demand position (0.1 um)
        P::variable(0x1E0F, S32, V::DemandVelocity), // demand velocity (um/s)
        P::variable(0x1E10, S32, V::DemandAcceleration), // demand acceleration (1e-5 m/s2)
        P::variable(0x1E62, S32, V::Constant(0)), // captured position (0.1 um)
        P::scratch(VARIABLE_1, S32), // command table variable 1
        P::scratch(VARIABLE_2, S32), // command table variable 2
        P::live(MONITOR_SOURCE, U16, WORD, 0x1E0F), // monitoring channel 1: UPID
        P::live(0x20A9, U16, WORD, 0x1E10), // monitoring channel 2: UPID
        P::live(0x20AA, U16, WORD, 0x1BCD), // monitoring channel 3: UPID
        P::live(0x20AB, U16, WORD, 0x1D51), // monitoring channel 4: UPID
        P::config(0x30D4, Bool, (0, 1), 0), // Easy Steps: enable
        P::config(0x30D5, Bool, (0, 1), 0), // Easy Steps: auto start
        P::config(0x3100, S32, POSITION, 0), // Easy Steps: first position (0.1 um)
        P::config(0x6300, U16, (0, 3), 0), // mode in state 6
    ]
};

/// The index of `upid`, or of the next one after it, in [`PARAMETERS`].
pub(super) fn from(upid: u16) -> usize {
    PARAMETERS.partition_point(|parameter| parameter.upid < upid)
}

/// The index of `upid` in [`PARAMETERS`].
pub(super) fn find(upid: u16) -> Option<usize> {
    let index = from(upid);
    PARAMETERS.get(index).is_some_and(|parameter| parameter.upid == upid).then_some(index)
}
