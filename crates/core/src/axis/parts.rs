//! What the application hands to the loop, as words.

use crate::axis::acyclic::{Call, Posted};
use crate::axis::command::{GroupCall, Jog, Move, NativeOwner, Profile, Setpoint, StreamRow, Target};
use crate::axis::{Command, CommandId, QueuedCommand, Row};
use crate::packed::Part;
use crate::{parts, word};

word! {
    CommandId: |id: CommandId| id.0, CommandId;
}

parts! {
    QueuedCommand { id, member, command, stream, call }
    GroupCall { parts, together, lead, id }
    StreamRow { stream, member, parts, row }
    Row { position, velocity, acceleration, last }
    Setpoint { member, parts, number, of, value }
    Posted { number, series, limit_ns, call }
    Call { service, address, value }
    Profile { velocity, acceleration, deceleration }
}

/// The [code](Command::code), and up to five words more. A code that is not known is read as a quick stop; a log of
/// another version is not read at all.
impl Part for Command {
    const WORDS: usize = 6;

    fn put(&self, words: &mut [u64]) {
        words.fill(0);
        words[0] = self.code().into();
        match *self {
            Command::Move(Move { target, profile }) => {
                let (relative, position) = match target {
                    Target::Absolute(position) => (false, position),
                    Target::Relative(distance) => (true, distance),
                };
                relative.put(&mut words[1..]);
                position.put(&mut words[2..]);
                profile.put(&mut words[3..]);
            }
            Command::Jog(Jog { velocity, acceleration }) => [velocity, acceleration].put(&mut words[1..]),
            Command::Velocity { acceleration: rate } | Command::Torque { slope: rate } => {
                rate.put(&mut words[1..])
            }
            Command::Stop { deceleration } => deceleration.put(&mut words[1..]),
            Command::Native(owner) => (owner == NativeOwner::Application).put(&mut words[1..]),
            Command::Enable
            | Command::Disable
            | Command::Home
            | Command::Follow
            | Command::QuickStop
            | Command::ResetFault
            | Command::Reset => {}
        }
    }

    fn take(words: &[u64]) -> Command {
        let rate = f64::take(&words[1..]);
        match words[0] {
            1 => Command::Enable,
            2 => Command::Disable,
            3 => Command::Home,
            4 => {
                let position = f64::take(&words[2..]);
                let target = if bool::take(&words[1..]) {
                    Target::Relative(position)
                } else {
                    Target::Absolute(position)
                };
                Command::Move(Move { target, profile: Part::take(&words[3..]) })
            }
            5 => Command::Jog(Jog { velocity: rate, acceleration: f64::take(&words[2..]) }),
            6 => Command::Velocity { acceleration: rate },
            7 => Command::Follow,
            8 => Command::Stop { deceleration: Part::take(&words[1..]) },
            10 => Command::ResetFault,
            11 => Command::Reset,
            12 if bool::take(&words[1..]) => Command::Native(NativeOwner::Application),
            12 => Command::Native(NativeOwner::Master),
            13 => Command::Torque { slope: rate },
            _ => Command::QuickStop,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::command::tests::all;

    #[test]
    fn each_command_passes_through_words() {
        let profile = Profile { velocity: 1.0, acceleration: 2.0, deceleration: 3.0 };
        let others = [
            Command::Move(Move { target: Target::Relative(5.0), profile }),
            Command::Native(NativeOwner::Application),
            Command::Stop { deceleration: Some(7.0) },
        ];
        let each = all().map(|(command, _)| command).into_iter().chain(others);
        let call = GroupCall { parts: 2, together: 1, lead: 3, id: CommandId(4) };
        for (command, call) in each.zip([None, Some(call)].into_iter().cycle()) {
            let queued = QueuedCommand { id: CommandId(7), member: 5, command, stream: 6, call };
            let mut words = [u64::MAX; QueuedCommand::WORDS];
            queued.put(&mut words);
            assert_eq!(QueuedCommand::take(&words), queued);
        }
    }
}
