//! Motion commands: what a [`MotionBlock`] says. Both directions: the master builds them, the simulated drive reads
//! them.
//!
//! Knows no state: whether a drive takes a command, and what its count should be, is the business of station and sim.
//!
//! A command is a header word, `id << 4 | count`, and up to 30 parameter bytes, unused ones 0. The drive runs a command
//! only if its count differs from the last one it stored (SG5 manual, motion command interface). Values are in wire
//! units; conversion from user units rounds and checks its range in [`units`](crate::axis::units):
//!
//! | quantity | type | unit |
//! |---|---|---|
//! | position | i32 | 0.1 um |
//! | velocity | u32; i32 in streams | 1 um/s |
//! | acceleration, deceleration | u32; i32 in streams | 1e-5 m/s2 |
//! | jerk | u32 | 1e-4 m/s3 |

use super::plan::StreamCommand;
use super::wire::MotionBlock;

/// A motion command without its count: 12 bits of master and sub id, and the parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionCommand {
    /// Master id (bits 11-4) and sub id (3-0): `0x010` is "VAI go to position".
    pub id: u16,
    /// The parameters, little-endian, unused bytes 0.
    pub parameters: [u8; 30],
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

impl MotionCommand {
    /// 000x: nothing, in any state. A new count with it is stored all the same.
    pub const NO_OPERATION: MotionCommand = MotionCommand::new(0x000);
    /// 008x: disarms trigger and after-actual commands.
    pub const CLEAR_EVENTS: MotionCommand = MotionCommand::new(0x008);
    /// 00Fx: restarts the whole firmware. Send it with count 0 only, or the drive reboots in a loop.
    pub const RESET_FIRMWARE: MotionCommand = MotionCommand::new(0x00F);
    /// 027x: stop with the drive's quick-stop deceleration.
    pub const STOP_PREDEFINED: MotionCommand = MotionCommand::new(0x027);
    /// 03Fx: leave streaming.
    pub const END_STREAM: MotionCommand = MotionCommand::new(0x03F);

    /// The command `id`, all parameters 0.
    pub const fn new(id: u16) -> MotionCommand {
        MotionCommand { id, parameters: [0; 30] }
    }

    /// Parameter bytes from `at` (0 = right behind the header).
    #[inline]
    const fn with(mut self, at: usize, value: u32, bytes: usize) -> MotionCommand {
        let value = value.to_le_bytes();
        let mut index = 0;
        while index < bytes {
            self.parameters[at + index] = value[index];
            index += 1;
        }
        self
    }

    #[inline]
    const fn long(self, at: usize, value: u32) -> MotionCommand {
        self.with(at, value, 4)
    }

    const fn profile(self, position: i32, vad: Vad) -> MotionCommand {
        self.long(0, position as u32)
            .long(4, vad.velocity)
            .long(8, vad.acceleration)
            .long(12, vad.deceleration)
    }

    /// The header word with this command count, 0 ... 15.
    #[inline]
    pub const fn header(&self, count: u8) -> u16 {
        self.id << 4 | (count & 0xF) as u16
    }

    /// The block to send with this command count, 0 ... 15.
    #[inline]
    pub const fn block(&self, count: u8) -> MotionBlock {
        MotionBlock { header: self.header(count), parameters: self.parameters }
    }

    /// 001x: write the interface's control word through the motion command channel.
    pub const fn control_word(word: u16) -> MotionCommand {
        MotionCommand::new(0x001).with(0, word as u32, 2)
    }

    /// 002x: write a live parameter in RAM.
    pub const fn live_parameter(upid: u16, value: u32) -> MotionCommand {
        MotionCommand::new(0x002).with(0, upid as u32, 2).long(2, value)
    }

    /// 009x: the place where the motor stands is `position`, and it is homed.
    pub const fn master_homing(position: i32) -> MotionCommand {
        MotionCommand::new(0x009).long(0, position as u32)
    }

    /// 010x: go to `position`, from demand position and demand velocity.
    pub const fn go_to(position: i32, vad: Vad) -> MotionCommand {
        MotionCommand::new(0x010).profile(position, vad)
    }

    /// 011x: go by `distance` from the demand position.
    pub const fn increment_demand(distance: i32, vad: Vad) -> MotionCommand {
        MotionCommand::new(0x011).profile(distance, vad)
    }

    /// 012x: move the target of the last profile by `distance`.
    pub const fn increment_target(distance: i32, vad: Vad) -> MotionCommand {
        MotionCommand::new(0x012).profile(distance, vad)
    }

    /// 013x: go to `position`, from actual position and actual velocity.
    pub const fn go_to_from_actual(position: i32, vad: Vad) -> MotionCommand {
        MotionCommand::new(0x013).profile(position, vad)
    }

    /// 014x: go to `position`, from actual position with velocity 0.
    pub const fn go_to_from_standstill(position: i32, vad: Vad) -> MotionCommand {
        MotionCommand::new(0x014).profile(position, vad)
    }

    /// 015x: go by `distance` from the actual position and velocity.
    pub const fn increment_actual(distance: i32, vad: Vad) -> MotionCommand {
        MotionCommand::new(0x015).profile(distance, vad)
    }

    /// 017x: ramp down to standstill, `deceleration` in 1e-5 m/s2, and stay controlled.
    pub const fn stop(deceleration: u32) -> MotionCommand {
        MotionCommand::new(0x017).long(0, deceleration)
    }

    /// 020x: go to `position` with the drive's own profile (UPIDs 14BEh-14C0h).
    pub const fn go_to_predefined(position: i32) -> MotionCommand {
        MotionCommand::new(0x020).long(0, position as u32)
    }

    /// 02Ex, 02Fx: run without end in positive or negative direction with the drive's own profile.
    pub const fn run_predefined(positive: bool) -> MotionCommand {
        MotionCommand::new(if positive { 0x02E } else { 0x02F })
    }

    /// 0CEx, 0CFx: run without end in positive or negative direction. The layout is known from one master in the field
    /// only.
    pub const fn run(positive: bool, velocity: u32, acceleration: u32) -> MotionCommand {
        MotionCommand::new(if positive { 0x0CE } else { 0x0CF }).long(0, velocity).long(4, acceleration)
    }

    /// 030x ... 035x: one streamed setpoint. What `command` does not carry is left out. Velocity and acceleration are
    /// signed.
    #[inline]
    pub const fn stream(
        command: StreamCommand,
        position: i32,
        velocity: i32,
        acceleration: i32,
    ) -> MotionCommand {
        let mut stream = MotionCommand::new(command.id()).long(0, position as u32);
        if command.has_velocity() {
            stream = stream.long(4, velocity as u32);
        }
        if command.has_acceleration() {
            stream = stream.long(8, acceleration as u32);
        }
        stream
    }
}

impl StreamCommand {
    /// Master and sub id.
    pub const fn id(self) -> u16 {
        match self {
            StreamCommand::P => 0x030,
            StreamCommand::Pv => 0x031,
            StreamCommand::PConfigured => 0x032,
            StreamCommand::PvConfigured => 0x033,
            StreamCommand::Pva => 0x034,
            StreamCommand::PvaConfigured => 0x035,
        }
    }

    /// The command of this id.
    pub const fn from_id(id: u16) -> Option<StreamCommand> {
        Some(match id {
            0x030 => StreamCommand::P,
            0x031 => StreamCommand::Pv,
            0x032 => StreamCommand::PConfigured,
            0x033 => StreamCommand::PvConfigured,
            0x034 => StreamCommand::Pva,
            0x035 => StreamCommand::PvaConfigured,
            _ => return None,
        })
    }

    /// Setpoints carry a velocity.
    pub const fn has_velocity(self) -> bool {
        !matches!(self, StreamCommand::P | StreamCommand::PConfigured)
    }

    /// Setpoints carry an acceleration.
    pub const fn has_acceleration(self) -> bool {
        matches!(self, StreamCommand::Pva | StreamCommand::PvaConfigured)
    }

    /// The time base is the period configured in the drive (UPID 14E6h), not the instant at which it receives.
    pub const fn has_configured_period(self) -> bool {
        matches!(
            self,
            StreamCommand::PConfigured | StreamCommand::PvConfigured | StreamCommand::PvaConfigured
        )
    }
}

/// What a command says, as a drive reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decoded {
    /// 000x.
    NoOperation,
    /// 001x: the interface's control word.
    ControlWord(u16),
    /// 002x.
    LiveParameter {
        /// Which.
        upid: u16,
        /// Raw.
        value: u32,
    },
    /// 008x.
    ClearEvents,
    /// 009x: the actual position shall be this one, 0.1 um.
    MasterHoming(i32),
    /// 00Fx.
    ResetFirmware,
    /// A move to a target: the families 01x, 02x, 0Bx, 0Cx, 0Ex, 0Fx and 3Ax.
    Move(Move),
    /// 017x with its deceleration (1e-5 m/s2); 027x has none and takes the quick-stop deceleration.
    Stop(Option<u32>),
    /// 02Ex, 02Fx, 0CEx, 0CFx: run without end.
    Run {
        /// Towards higher positions.
        positive: bool,
        /// 1 um/s and 1e-5 m/s2; `None` takes the drive's own.
        velocity: Option<u32>,
        /// Acceleration and deceleration, 1e-5 m/s2; `None` takes the drive's own.
        acceleration: Option<u32>,
    },
    /// 01Ex, 01Fx: take another profile when the demand passes a position.
    ChangeProfile {
        /// Passes it in positive direction.
        positive: bool,
        /// The position, 0.1 um.
        position: i32,
        /// The profile from there on.
        profile: Vad,
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
    /// 03Fx.
    EndStream,
    /// 040x ... 04Fx: a time curve by its id.
    Curve(u16),
    /// 200x ... 202x: start a command table entry.
    TableEntry(u16),
    /// Anything else.
    Unknown,
}

/// A move to a target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Move {
    /// A position or a distance, 0.1 um.
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

/// When a move starts.
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

/// The parameters behind a header. Offsets are those of the manual, counted from the header, so they begin at 2.
struct Parameters<'a>(&'a [u8; 30]);

impl Parameters<'_> {
    fn chunk<const N: usize>(&self, at: usize) -> [u8; N] {
        self.0.get(at - 2..).and_then(<[u8]>::first_chunk).copied().unwrap_or([0; N])
    }

    fn word(&self, at: usize) -> u16 {
        u16::from_le_bytes(self.chunk(at))
    }

    fn unsigned(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.chunk(at))
    }

    fn signed(&self, at: usize) -> i32 {
        i32::from_le_bytes(self.chunk(at))
    }
}

impl Decoded {
    /// What `block` says; its count is not looked at.
    pub fn of(block: &MotionBlock) -> Decoded {
        let p = Parameters(&block.parameters);
        let sub = (block.header >> 4 & 0xF) as u8;
        match block.header >> 8 {
            0x00 => match sub {
                0x0 => Decoded::NoOperation,
                0x1 => Decoded::ControlWord(p.word(2)),
                0x2 => Decoded::LiveParameter { upid: p.word(2), value: p.unsigned(4) },
                0x8 => Decoded::ClearEvents,
                0x9 => Decoded::MasterHoming(p.signed(2)),
                0xF => Decoded::ResetFirmware,
                _ => Decoded::Unknown,
            },
            0x01 => match sub {
                0x7 => Decoded::Stop(Some(p.unsigned(2))),
                0xE | 0xF => Decoded::ChangeProfile {
                    positive: sub == 0xE,
                    position: p.signed(2),
                    profile: Vad {
                        velocity: p.unsigned(6),
                        acceleration: p.unsigned(10),
                        deceleration: p.unsigned(14),
                    },
                },
                _ => profile(vai(sub), &p, Shape::Trapezoid, [6, 10, 14]),
            },
            0x02 => match sub {
                0x7 => Decoded::Stop(None),
                0xE | 0xF => Decoded::Run { positive: sub == 0xE, velocity: None, acceleration: None },
                0x5 | 0x6 => Decoded::Unknown,
                _ => profile(vai(sub), &p, Shape::Trapezoid, [NONE; 3]),
            },
            0x03 => match (StreamCommand::from_id(block.header >> 4), sub) {
                (Some(command), _) => Decoded::Stream {
                    command,
                    position: p.signed(2),
                    velocity: if command.has_velocity() { p.signed(6) } else { 0 },
                    acceleration: if command.has_acceleration() { p.signed(10) } else { 0 },
                },
                (None, 0xF) => Decoded::EndStream,
                (None, _) => Decoded::Unknown,
            },
            0x04 => match sub {
                0x8 | 0x9 | 0xB | 0xD => Decoded::Unknown,
                _ => Decoded::Curve(p.word(2)),
            },
            0x0B => match sub {
                0x5..=0x7 => Decoded::Unknown,
                _ => profile(vai(sub), &p, Shape::Trapezoid, [6, NONE, NONE]),
            },
            0x0C => match sub {
                0x5..=0x7 => Decoded::Unknown,
                0xE | 0xF => Decoded::Run {
                    positive: sub == 0xE,
                    velocity: Some(p.unsigned(2)),
                    acceleration: Some(p.unsigned(6)),
                },
                _ => profile(vai(sub), &p, Shape::Trapezoid, [6, 10, 10]),
            },
            0x0E | 0x0F => {
                let shape = match block.header >> 8 {
                    0x0E => Shape::Sine,
                    _ => Shape::Bestehorn(p.unsigned(14)),
                };
                profile(curved(sub), &p, shape, [6, 10, 10])
            }
            0x20 if sub <= 2 => Decoded::TableEntry(p.word(2)),
            0x3A if sub <= 1 => profile(vai(sub), &p, Shape::JerkLimited(p.unsigned(18)), [6, 10, 14]),
            _ => Decoded::Unknown,
        }
    }
}

/// In [`profile`]: the command does not carry this.
const NONE: usize = 0;

/// A move of this kind, its velocity, acceleration and deceleration from these offsets; the position stands at 2 in every
/// family.
fn profile(
    kind: Option<(Origin, Start, When)>,
    p: &Parameters<'_>,
    shape: Shape,
    offsets: [usize; 3],
) -> Decoded {
    let Some((origin, start, when)) = kind else { return Decoded::Unknown };
    let [velocity, acceleration, deceleration] = offsets.map(|at| (at != NONE).then(|| p.unsigned(at)));
    Decoded::Move(Move {
        value: p.signed(2),
        origin,
        start,
        when,
        shape,
        velocity,
        acceleration,
        deceleration,
    })
}

/// The sub ids that the trapezoidal families share.
fn vai(sub: u8) -> Option<(Origin, Start, When)> {
    Some(match sub {
        0x0 => (Origin::Zero, Start::Demand, When::Now),
        0x1 => (Origin::Demand, Start::Demand, When::Now),
        0x2 => (Origin::Target, Start::Demand, When::Now),
        0x3 => (Origin::Zero, Start::Actual, When::Now),
        0x4 => (Origin::Zero, Start::Standstill, When::Now),
        0x5 => (Origin::Actual, Start::Actual, When::Now),
        0x6 => (Origin::Actual, Start::Standstill, When::Now),
        0x8 => (Origin::Zero, Start::Demand, When::AfterActual),
        0xA | 0xC => (Origin::Zero, Start::Demand, When::Trigger { rising: sub == 0xA }),
        0xB | 0xD => (Origin::Target, Start::Demand, When::Trigger { rising: sub == 0xB }),
        _ => return None,
    })
}

/// The sub ids of sine and Bestehorn; they start from standstill.
fn curved(sub: u8) -> Option<(Origin, Start, When)> {
    Some(match sub {
        0x0 => (Origin::Zero, Start::Demand, When::Now),
        0x1 => (Origin::Demand, Start::Demand, When::Now),
        0x4 => (Origin::Zero, Start::Standstill, When::Now),
        0x6 => (Origin::Actual, Start::Standstill, When::Now),
        0x8 => (Origin::Zero, Start::Demand, When::AfterActual),
        0xA | 0xC => (Origin::Zero, Start::Demand, When::Trigger { rising: sub == 0xA }),
        0xB | 0xD => (Origin::Demand, Start::Demand, When::Trigger { rising: sub == 0xB }),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const VAD: Vad = Vad { velocity: 1_000_000, acceleration: 2_000_000, deceleration: 3_000_000 };

    const TRAPEZOID: Move = Move {
        value: -5,
        origin: Origin::Zero,
        start: Start::Demand,
        when: When::Now,
        shape: Shape::Trapezoid,
        velocity: Some(1_000_000),
        acceleration: Some(2_000_000),
        deceleration: Some(3_000_000),
    };

    #[test]
    fn golden_example_of_the_manual() {
        // LinUDP V2 manual: VAI go to 10 mm with 1 m/s and 10 m/s2, count 0.
        let vad = Vad { velocity: 1_000_000, acceleration: 1_000_000, deceleration: 1_000_000 };
        let block = MotionCommand::go_to(100_000, vad).block(0);
        let mut bytes = block.header.to_le_bytes().to_vec();
        bytes.extend(block.parameters);
        let golden = [
            0x00, 0x01, 0xA0, 0x86, 0x01, 0x00, 0x40, 0x42, 0x0F, 0x00, 0x40, 0x42, 0x0F, 0x00, 0x40, 0x42,
            0x0F, 0x00,
        ];
        assert_eq!(bytes[..18], golden);
        assert_eq!(bytes[18..], [0; 14]);
    }

    #[test]
    fn a_header_is_id_and_count() {
        let stop = MotionCommand::stop(1);
        assert_eq!((stop.header(0), stop.header(5), stop.header(0x1F)), (0x0170, 0x0175, 0x017F));
        assert_eq!(MotionCommand::new(0x210).header(3), 0x2103);
    }

    #[test]
    fn every_constructor_is_read_back() {
        let moves = [
            (MotionCommand::go_to(-5, VAD), TRAPEZOID),
            (MotionCommand::increment_demand(-5, VAD), Move { origin: Origin::Demand, ..TRAPEZOID }),
            (MotionCommand::increment_target(-5, VAD), Move { origin: Origin::Target, ..TRAPEZOID }),
            (MotionCommand::go_to_from_actual(-5, VAD), Move { start: Start::Actual, ..TRAPEZOID }),
            (MotionCommand::go_to_from_standstill(-5, VAD), Move { start: Start::Standstill, ..TRAPEZOID }),
            (
                MotionCommand::increment_actual(-5, VAD),
                Move { origin: Origin::Actual, start: Start::Actual, ..TRAPEZOID },
            ),
            (
                MotionCommand::go_to_predefined(-5),
                Move { velocity: None, acceleration: None, deceleration: None, ..TRAPEZOID },
            ),
        ];
        for (command, expected) in moves {
            assert_eq!(Decoded::of(&command.block(7)), Decoded::Move(expected));
        }
        let others = [
            (MotionCommand::NO_OPERATION, Decoded::NoOperation),
            (MotionCommand::CLEAR_EVENTS, Decoded::ClearEvents),
            (MotionCommand::RESET_FIRMWARE, Decoded::ResetFirmware),
            (MotionCommand::STOP_PREDEFINED, Decoded::Stop(None)),
            (MotionCommand::END_STREAM, Decoded::EndStream),
            (MotionCommand::control_word(0x083F), Decoded::ControlWord(0x083F)),
            (
                MotionCommand::live_parameter(0x14BE, 7_000_000),
                Decoded::LiveParameter { upid: 0x14BE, value: 7_000_000 },
            ),
            (MotionCommand::master_homing(i32::MIN), Decoded::MasterHoming(i32::MIN)),
            (MotionCommand::stop(u32::MAX), Decoded::Stop(Some(u32::MAX))),
            (
                MotionCommand::run_predefined(false),
                Decoded::Run { positive: false, velocity: None, acceleration: None },
            ),
            (
                MotionCommand::run(true, 1, 2),
                Decoded::Run { positive: true, velocity: Some(1), acceleration: Some(2) },
            ),
        ];
        for (command, expected) in others {
            assert_eq!(Decoded::of(&command.block(15)), expected);
        }
    }

    #[test]
    fn streams_carry_what_their_command_has_and_signs() {
        use StreamCommand as S;
        for (command, velocity, acceleration) in [
            (S::P, 0, 0),
            (S::Pv, -2, 0),
            (S::PConfigured, 0, 0),
            (S::PvConfigured, -2, 0),
            (S::Pva, -2, -3),
            (S::PvaConfigured, -2, -3),
        ] {
            let block = MotionCommand::stream(command, -1, -2, -3).block(1);
            assert_eq!(block.header >> 4, command.id());
            let stream = Decoded::Stream { command, position: -1, velocity, acceleration };
            assert_eq!(Decoded::of(&block), stream);
            assert_eq!(S::from_id(command.id()), Some(command));
        }
        assert_eq!(S::from_id(0x036), None);
    }

    #[test]
    fn the_other_families_have_their_layouts() {
        // SG5 manual: offsets from the header, P@2 V@6 A@10 D@14 J@14 or J@18.
        let at = |id: u16, longs: &[u32]| {
            longs.iter().enumerate().fold(MotionCommand::new(id), |c, (n, v)| c.long(4 * n, *v)).block(0)
        };
        let p = -5_i32 as u32;
        let same = Move { deceleration: Some(2_000_000), ..TRAPEZOID };
        assert_eq!(
            Decoded::of(&at(0x0B0, &[p, 1_000_000])),
            Decoded::Move(Move { acceleration: None, deceleration: None, ..TRAPEZOID })
        );
        assert_eq!(Decoded::of(&at(0x0C0, &[p, 1_000_000, 2_000_000])), Decoded::Move(same));
        assert_eq!(
            Decoded::of(&at(0x0E0, &[p, 1_000_000, 2_000_000])),
            Decoded::Move(Move { shape: Shape::Sine, ..same })
        );
        assert_eq!(
            Decoded::of(&at(0x0F8, &[p, 1_000_000, 2_000_000, 9])),
            Decoded::Move(Move { shape: Shape::Bestehorn(9), when: When::AfterActual, ..same })
        );
        assert_eq!(
            Decoded::of(&at(0x3A1, &[p, 1_000_000, 2_000_000, 3_000_000, 9])),
            Decoded::Move(Move { shape: Shape::JerkLimited(9), origin: Origin::Demand, ..TRAPEZOID })
        );
        assert_eq!(
            Decoded::of(&at(0x01A, &[p, 1_000_000, 2_000_000, 3_000_000])),
            Decoded::Move(Move { when: When::Trigger { rising: true }, ..TRAPEZOID })
        );
        assert_eq!(
            Decoded::of(&at(0x01F, &[p, 1_000_000, 2_000_000, 3_000_000])),
            Decoded::ChangeProfile { positive: false, position: -5, profile: VAD }
        );
        assert_eq!(Decoded::of(&at(0x040, &[17])), Decoded::Curve(17));
        assert_eq!(Decoded::of(&at(0x202, &[17])), Decoded::TableEntry(17));
        for unknown in [0x00A, 0x019, 0x025, 0x036, 0x048, 0x0B7, 0x0C5, 0x0E2, 0x203, 0x3A2, 0x999] {
            assert_eq!(Decoded::of(&at(unknown, &[])), Decoded::Unknown, "{unknown:03X}");
        }
    }

    proptest! {
        #[test]
        fn any_block_is_read_and_its_count_changes_nothing(
            header in any::<u16>(),
            parameters in any::<[u8; 30]>(),
            count in 0_u16..16,
        ) {
            let read = Decoded::of(&MotionBlock { header, parameters });
            let counted = MotionBlock { header: header & !0xF | count, parameters };
            prop_assert_eq!(Decoded::of(&counted), read);
        }

        #[test]
        fn any_go_to_keeps_its_values(value in any::<i32>(), v in any::<u32>(), a in any::<u32>(), d in any::<u32>()) {
            let vad = Vad { velocity: v, acceleration: a, deceleration: d };
            let expected =
                Move { value, velocity: Some(v), acceleration: Some(a), deceleration: Some(d), ..TRAPEZOID };
            prop_assert_eq!(Decoded::of(&MotionCommand::go_to(value, vad).block(3)), Decoded::Move(expected));
        }
    }
}
