//! What an application can ask for, wise or not.

use fieldbeat::axis::{Command, Jog, Move, NativeOwner, Profile, Row, Target};
use fieldbeat::bus::linudp::motion::MotionCommand;
use fieldbeat::bus::linudp::{ControlWord, NativeOutput};
use fieldbeat_linudp::wire::{RtcBlock, RtcCommand};

use super::input::Input;

/// Any command.
pub fn command(input: &mut Input<'_>) -> Command {
    match input.below(16) {
        0 | 1 => Command::Enable,
        2 => Command::Disable,
        3 => Command::Home,
        4 => Command::Velocity { acceleration: speed(input) },
        5 | 6 => Command::Move(Move { target: Target::Absolute(input.number()), profile: profile(input) }),
        7 => Command::Move(Move { target: Target::Relative(input.number()), profile: profile(input) }),
        8 => Command::Jog(Jog { velocity: input.number(), acceleration: speed(input) }),
        9 => Command::Follow,
        10 => Command::Torque { slope: speed(input) },
        11 => Command::Stop { deceleration: input.flag().then(|| speed(input)) },
        12 => Command::QuickStop,
        13 => Command::ResetFault,
        14 => Command::Reset,
        _ => Command::Native(input.of(&[NativeOwner::Master, NativeOwner::Application])),
    }
}

/// Any row.
pub fn row(input: &mut Input<'_>) -> Row {
    Row {
        position: input.number(),
        velocity: input.number(),
        acceleration: input.number(),
        last: input.below(8) == 0,
    }
}

/// Anything that an application may write in native mode.
pub fn output(input: &mut Input<'_>) -> NativeOutput {
    NativeOutput {
        control: input.flag().then(|| ControlWord(input.word())),
        motion: input.flag().then(|| MotionCommand::new(input.word() & 0xFFF)),
        config: input.flag().then(|| RtcBlock::command(input.byte(), RtcCommand(input.byte()))),
    }
}

fn profile(input: &mut Input<'_>) -> Profile {
    Profile { velocity: speed(input), acceleration: speed(input), deceleration: speed(input) }
}

/// A speed or an acceleration: most are usual.
fn speed(input: &mut Input<'_>) -> f64 {
    match input.byte() {
        255 => input.number(),
        usual => (f64::from(usual) + 1.0) * 40.0,
    }
}
