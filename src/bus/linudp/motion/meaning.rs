//! From the id of a command and the values of its fields to its meaning.
//!
//! Knows the meaning of every command of the catalogue and the offsets of none: fields come in their order.

use super::catalogue::{CommandInfo, FIELDS};
use super::decoded::*;
use super::values::Kind;
use crate::bus::linudp::plan::StreamCommand;

/// What a command with these wire integers in its fields means. Each value is inside the integer type that it is cast
/// to: the field is of that type.
pub(super) fn meaning(info: &CommandInfo, values: [i64; FIELDS]) -> Option<Decoded> {
    let [a, b, c, d, e] = values;
    let sub = (info.id & 0xF) as u8;
    // 1 or 2, in the families that come in pairs.
    let second = |first: u8| 1 + (sub - first) % 2;
    Some(match (info.id >> 4, sub) {
        (0x00, 0x0) => Decoded::NoOperation,
        (0x00, 0x1) => Decoded::ControlWord(a as u16),
        (0x00, 0x2) => Decoded::LiveParameter { upid: a as u16, value: b as u32 },
        (0x00, 0x3 | 0x4) => Decoded::Outputs { x6: sub == 4, mask: a as u16, value: b as u16 },
        (0x00, 0x5) => Decoded::ControllerSet(a as u16),
        (0x00, 0x8) => Decoded::ClearEvents,
        (0x00, 0x9) => Decoded::MasterHoming(a as i32),
        (0x00, 0xF) => Decoded::ResetFirmware,
        (0x01, 0x7) => Decoded::Stop(Some(a as u32)),
        (0x02 | 0x0A, 0x7) => Decoded::Stop(None),
        (0x09, 0x7) => Decoded::StopScaled(a as u16),
        (family @ (0x01 | 0x09), 0xE | 0xF) => Decoded::ChangeProfile {
            positive: sub == 0xE,
            position: a as i32,
            profile: vad([b, c, d]),
            scaled: family == 0x09,
        },
        (0x02, 0xE | 0xF) => Decoded::Run { positive: sub == 0xE, velocity: None, acceleration: None },
        (0x0C, 0xE | 0xF) => {
            Decoded::Run { positive: sub == 0xE, velocity: Some(a as u32), acceleration: Some(b as u32) }
        }
        (0x0C, 0x5..=0x7) => {
            let start = [Start::Demand, Start::Actual, Start::Standstill][usize::from(sub - 5)];
            let motion = profile(info, &values, (Origin::Zero, start, When::Now), Shape::Trapezoid);
            Decoded::Press { motion, current: d as u16 }
        }
        (0x01 | 0x02 | 0x09..=0x0C, _) => Decoded::Move(profile(info, &values, vai(sub)?, Shape::Trapezoid)),
        (0x0E, _) => Decoded::Move(profile(info, &values, curved(sub)?, Shape::Sine)),
        (0x0F, _) => {
            Decoded::Move(profile(info, &values, curved(sub)?, Shape::Bestehorn(jerk(info, values))))
        }
        (0x3A, _) => Decoded::Move(profile(info, &values, vai(sub)?, Shape::JerkLimited(jerk(info, values)))),
        (0x0D, 0x0 | 0x1) => {
            let kind = (Origin::Captured, Start::Demand, When::Now);
            Decoded::Move(profile(info, &values, kind, Shape::Trapezoid))
        }
        (0x0D, 0x4..=0x7) => {
            let start = if sub < 6 { Start::Demand } else { Start::Actual };
            let kind = (Origin::Variable(second(4)), start, When::Now);
            Decoded::Move(profile(info, &values, kind, Shape::Trapezoid))
        }
        (0x0D, 0x9) => {
            let kind = (Origin::Actual, Start::Actual, When::Now);
            Decoded::ResetIntegratorAndMove(profile(info, &values, kind, Shape::Trapezoid))
        }
        (0x0D, 0xE | 0xF) => Decoded::StartTriggered { rising: sub == 0xE },
        (0x07, _) => Decoded::Indexing {
            sub,
            position: a as i32,
            profile: (info.fields.len() > 1).then(|| vad([b, c, d])),
        },
        (0x03, 0xA) => {
            Decoded::StreamStamped { position: a as i32, velocity: b as i32, acceleration: c as i32 }
        }
        (0x03, 0xF) => Decoded::EndStream,
        (0x03, _) => Decoded::Stream {
            command: StreamCommand::from_id(info.id)?,
            position: a as i32,
            velocity: b as i32,
            acceleration: c as i32,
        },
        (0x04, _) => Decoded::Curve(CurveStart {
            curve: a as u16,
            from_actual: sub == 1,
            when: match sub {
                0x6 | 0xA | 0xE => When::RISING,
                0x7 | 0xC | 0xF => When::FALLING,
                _ => When::Now,
            },
            fit: match sub {
                0x0 | 0x1 => CurveFit::Plain,
                0x2 | 0xA | 0xC => CurveFit::Target(b as i32),
                0x3 | 0xE | 0xF => CurveFit::TargetInTime { target: b as i32, time: c as i32 },
                0x4 => CurveFit::Scaled { offset: b as i32, time_scale: c as u16, amplitude: d as i16 },
                _ => CurveFit::InTime { offset: b as i32, time: c as i32, amplitude: d as i16 },
            },
        }),
        (0x05, 0x0) => Decoded::CurveAddress { curve: a as u16, address: b as u16 },
        (0x05, _) => Decoded::ModifyCurve {
            curve: a as u16,
            info: sub < 4,
            offset: b as u16,
            values: match sub {
                1 => Written::Short(c as i16),
                2 | 4 => Written::One(c as i32),
                5 => Written::Two([c, d].map(|value| value as i32)),
                _ => Written::Three([c, d, e].map(|value| value as i32)),
            },
        },
        (0x06, _) => Decoded::DelayedCam {
            curve: a as u16,
            delay: b as i32,
            when: match sub {
                0x9 | 0xA | 0xD => When::RISING,
                0xB | 0xC | 0xE => When::FALLING,
                _ => When::Now,
            },
            fit: match sub {
                0xA | 0xC => CamFit::TargetOver { target: c as i32, length: d as i32 },
                0xD | 0xE => CamFit::Scaled { amplitude: c as i16, length: d as i32 },
                _ => CamFit::Plain,
            },
        },
        (0x10, 0x0 | 0x1) => Decoded::EnableCams(sub == 0),
        (0x10, 0x2) => Decoded::GoToSync,
        (0x10, _) => Decoded::EncoderCounts(a as i32),
        (family @ (0x11 | 0x12), _) => {
            let cam = (family - 0x10) as u8;
            match sub {
                0x6 | 0x7 => Decoded::EnableCam { cam, enable: sub == 6 },
                0x8 => Decoded::ScaleCam { cam, amplitude: a as i16, length: b as i32 },
                _ => Decoded::Cam {
                    cam,
                    curve: a as u16,
                    start: b as i32,
                    from_actual: sub == 1,
                    fit: match sub {
                        0x2 => CamFit::Target(c as i32),
                        0x3 => CamFit::Between { start: c as i32, target: d as i32, length: e as i32 },
                        0x4 => CamFit::TargetOver { target: c as i32, length: d as i32 },
                        0x5 => CamFit::Scaled { amplitude: c as i16, length: d as i32 },
                        _ => CamFit::Plain,
                    },
                },
            }
        }
        (0x20, 0x0..=0x2) => {
            let when = [When::Now, When::RISING, When::FALLING][usize::from(sub)];
            Decoded::TableEntry { entry: a as u16, when }
        }
        (0x20, _) => Decoded::ModifyEntry {
            entry: a as u16,
            offset: b as u16,
            value: if sub == 8 { Written::Short(c as i16) } else { Written::One(c as i32) },
        },
        (0x21, _) => Decoded::Wait(match sub {
            0x0 => Wait::Time(a as u32),
            0x1 => Wait::MotionFinished,
            0x2 => Wait::InTarget,
            0x3 | 0x4 => Wait::Trigger { rising: sub == 3 },
            _ => Wait::Variable(second(8)),
        }),
        (0x22, _) => {
            let quantity = match sub / 2 {
                0 => Quantity::DemandPosition,
                1 => Quantity::ActualPosition,
                2 => Quantity::Difference,
                3 => Quantity::UnsignedDifference,
                4 => Quantity::DemandVelocity,
                5 => Quantity::ActualVelocity,
                _ => Quantity::Current,
            };
            Decoded::Wait(Wait::Until(Comparison { quantity, greater: sub & 1 == 0, limit: a as i32 }))
        }
        (0x24, 0x0..=0x3) => Decoded::Variable { variable: 1 + sub / 2, add: sub & 1 == 1, value: a as i32 },
        (0x24, 0x8 | 0x9) => Decoded::VariableToUpid { variable: second(8), upid: a as u16 },
        (0x24, 0xC | 0xD) => Decoded::UpidToVariable { variable: second(0xC), upid: a as u16 },
        (0x24, _) => Decoded::UpidToRom(a as u16),
        (0x26, 0x2..=0x5) => {
            let word = [Word::X4Inputs, Word::X6Inputs, Word::Status, Word::Warn][usize::from(sub - 2)];
            let condition = Condition::Masked { word, mask: a as u16, value: b as u16 };
            Decoded::If { condition, if_true: c as u16, if_false: d as u16 }
        }
        (family @ (0x25 | 0x26), _) => {
            let compare = |quantity| {
                Condition::Compare(Comparison { quantity, greater: sub & 1 == 1, limit: a as i32 })
            };
            let condition = match (family, sub) {
                (0x26, 0x0) => compare(Quantity::AnalogInput),
                (0x26, _) => Condition::Unknown(a as i32),
                (_, 0x0..=0x3) => compare(Quantity::Variable(1 + sub / 2)),
                (_, 0x8 | 0x9) => compare(Quantity::DemandPosition),
                (_, 0xA | 0xB) => compare(Quantity::ActualPosition),
                (_, 0xC | 0xD) => compare(Quantity::Difference),
                _ => compare(Quantity::Current),
            };
            Decoded::If { condition, if_true: b as u16, if_false: c as u16 }
        }
        (0x30 | 0x31, _) => Decoded::Winding { id: info.id, number: a as u16, revolutions: b as i32 },
        (0x38, 0x2) => Decoded::ForceTarget(a as i16),
        (0x38, _) => {
            let mut forces = info.fields.iter().zip(values).filter(|(field, _)| field.kind == Kind::Force);
            let mut force = || forces.next().map(|(_, value)| value as i16);
            Decoded::Force {
                id: info.id,
                value: a as i32,
                velocity: b as u32,
                acceleration: c as u32,
                deceleration: (info.fields.get(3)?.kind == Kind::Acceleration).then_some(d as u32),
                limit: force(),
                target: force(),
            }
        }
        (0x39, 0x0) => Decoded::CurrentMode(a as i32),
        (0x39, _) => Decoded::PositionMode,
        _ => return None,
    })
}

fn vad([velocity, acceleration, deceleration]: [i64; 3]) -> Vad {
    Vad { velocity: velocity as u32, acceleration: acceleration as u32, deceleration: deceleration as u32 }
}

fn jerk(info: &CommandInfo, values: [i64; FIELDS]) -> u32 {
    let jerk = info.fields.iter().zip(values).find(|(field, _)| field.kind == Kind::Jerk);
    jerk.map_or(0, |(_, value)| value as u32)
}

/// A move of this kind. Its fields may be a position, then a velocity, then none, one or two accelerations; a
/// single one is the deceleration too, except in the family 0B, which has none.
fn profile(
    info: &CommandInfo,
    values: &[i64; FIELDS],
    (origin, start, when): (Origin, Start, When),
    shape: Shape,
) -> Move {
    let of = |kinds: [Kind; 2]| {
        let fields = info.fields.iter().zip(values).filter(move |(field, _)| kinds.contains(&field.kind));
        fields.map(|(_, value)| *value)
    };
    let value = of([Kind::Position, Kind::ScaledPosition]).next().unwrap_or(0) as i32;
    let velocity = of([Kind::Velocity, Kind::ScaledVelocity]).next().map(|value| value as u32);
    let mut ramps = of([Kind::Acceleration, Kind::ScaledAcceleration]).map(|value| value as u32);
    let acceleration = ramps.next();
    let scaled = info.fields.iter().any(|field| field.kind == Kind::ScaledPosition);
    Move {
        value,
        origin,
        start,
        when,
        shape,
        velocity,
        acceleration,
        deceleration: ramps.next().or(acceleration),
        scaled,
    }
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
        0x9 => (Origin::Analog, Start::Demand, When::Now),
        0xA => (Origin::Zero, Start::Demand, When::RISING),
        0xB => (Origin::Target, Start::Demand, When::RISING),
        0xC => (Origin::Zero, Start::Demand, When::FALLING),
        0xD => (Origin::Target, Start::Demand, When::FALLING),
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
        0x9 => (Origin::Analog, Start::Demand, When::Now),
        0xA => (Origin::Zero, Start::Demand, When::RISING),
        0xB => (Origin::Demand, Start::Demand, When::RISING),
        0xC => (Origin::Zero, Start::Demand, When::FALLING),
        0xD => (Origin::Demand, Start::Demand, When::FALLING),
        _ => return None,
    })
}
