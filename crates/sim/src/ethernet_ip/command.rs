//! The command word: what acts, and how.
//!
//! Facts: sheet, 5.3 to 5.5; what they leave open is assumed, or a setting:
//!
//! | case | what the drive does |
//! |---|---|
//! | the first word after an open | counts as a change from 0 |
//! | several bits at once | nothing, unless one of them is a stop, which acts |
//! | a value out of its range | is not taken: the one of before stays, and the command goes on |
//! | a host command that the drive does not have | nothing: no document names an alarm for it |

use super::assembly::Outputs;
use super::drive::Drive;
use super::motion::{Entry, Io, Move, Profile};
use super::parameters::{Name, is_host_command};
use super::search::Sensor;
use super::settings::{Edges, Idle, Kind};

/// Bits of the command word.
pub(super) mod word {
    pub const ENABLE: u32 = 0x2;
    pub const DISABLE: u32 = 0x4;
    pub const RELATIVE: u32 = 0x8;
    pub const ABSOLUTE: u32 = 0x10;
    pub const SENSOR: u32 = 0x20;
    pub const DOUBLE: u32 = 0x40;
    pub const SAFETY: u32 = 0x80;
    pub const MASK: u32 = 0x100;
    pub const OUTPUT: u32 = 0x200;
    pub const CHANGE: u32 = 0x400;
    pub const SEEK: u32 = 0x800;
    pub const FIND: u32 = 0x1000;
    pub const STOP: u32 = 0x4000;
    pub const STOP_GENTLY: u32 = 0x8000;
    pub const JOG: u32 = 0x1_0000;
    pub const JOG_SPEED: u32 = 0x2_0000;
    pub const HOST: u32 = 0x4_0000;
    pub const SEGMENT: u32 = 0x8_0000;
    pub const RESET: u32 = 0x10_0000;
    pub const CURRENT: u32 = 0x20_0000;
}

const STOPS: u32 = word::STOP | word::STOP_GENTLY;

impl Drive {
    /// A connection owns the drive from now on: what comes first is a change.
    pub(super) fn owned(&mut self) {
        self.last = Outputs::default();
    }

    /// It does not any more.
    pub(super) fn released(&mut self, timed_out: bool) {
        self.last = Outputs::default();
        if timed_out && self.firmware.lost_owner_stops {
            self.kill(false, false);
        }
    }

    /// The owner is idle: a word that comes meanwhile does nothing, and is no change once it runs.
    pub(super) fn idle(&mut self, outputs: &Outputs) {
        if outputs.word != 0 {
            self.last = *outputs;
        }
        if self.firmware.idle == Idle::Stops {
            self.kill(false, false);
        }
    }

    /// New data of the owner.
    pub(super) fn outputs(&mut self, outputs: &Outputs) {
        let last = std::mem::replace(&mut self.last, *outputs);
        let (before, now) = (last.word, outputs.word);
        if now == 0 {
            return;
        }
        let differs = (last.letters, last.registers) != (outputs.letters, outputs.registers);
        let again = now == word::HOST && before == word::HOST && differs;
        let stops = now & STOPS & !before != 0;
        let acts = match self.firmware.edges {
            _ if before == 0 || again => true,
            Edges::Strict => false,
            Edges::Stops => stops,
            Edges::Any => before != now,
        };
        if !acts {
            self.refused.no_edge += u64::from(before != now);
            return;
        }
        let command = match now {
            now if now & word::STOP != 0 => word::STOP,
            now if now & word::STOP_GENTLY != 0 => word::STOP_GENTLY,
            now => now,
        };
        if command.count_ones() == 1 {
            self.command(command, outputs);
        } else {
            self.refused.several_bits += 1;
        }
    }

    fn command(&mut self, command: u32, outputs: &Outputs) {
        if self.firmware.ignores_stops && self.enabled && command & (STOPS | word::DISABLE) != 0 {
            self.refused.unsupported += 1;
            return;
        }
        let [first, second] = outputs.registers.map(|register| Io::new(register as u16));
        let sensor = |kind| first.map(|io| Move::Sensor(kind, io));
        let kind = match command {
            word::ENABLE => return self.enable(true),
            word::DISABLE => return self.enable(false),
            word::STOP => return self.kill(false, false),
            word::STOP_GENTLY => return self.kill(true, false),
            word::RESET => return self.reset(),
            word::JOG => return self.jog(outputs),
            word::JOG_SPEED => {
                if self.write_jog_speed(outputs.jog_speed) {
                    self.update_jog(outputs.jog_speed);
                }
                return;
            }
            word::HOST => return self.host(outputs.letters, outputs.registers),
            word::SEGMENT => {
                match u8::try_from(outputs.registers[0]) {
                    Ok(number @ 1..=12) => {
                        self.push(Entry::Segment(number));
                    }
                    _ => self.refused.out_of_range += 1,
                }
                return;
            }
            word::CURRENT if self.kind == Kind::StepServo && outputs.current.abs() <= 2_000 => {
                self.write((*b"GC", 0), outputs.current);
                return;
            }
            word::RELATIVE => Some(Move::Relative),
            word::ABSOLUTE => Some(Move::Absolute),
            word::SENSOR => sensor(Sensor::Stop),
            word::DOUBLE => first.zip(second).map(|(first, second)| Move::Double(first, second)),
            word::SAFETY => sensor(Sensor::Safety),
            word::MASK => sensor(Sensor::Mask),
            word::OUTPUT => first.map(Move::Output),
            word::CHANGE => Some(Move::Change),
            word::SEEK => sensor(Sensor::Home),
            word::FIND => Some(Move::FindHome),
            _ => None,
        };
        let Some(kind) = kind else {
            self.refused.unsupported += 1;
            return;
        };
        for (name, value) in [
            (b"VE", outputs.velocity),
            (b"AC", outputs.acceleration),
            (b"DE", outputs.deceleration),
            (b"DI", outputs.distance),
        ] {
            self.write((*name, 0), value);
        }
        let profile = self.profile();
        self.start(kind, profile);
    }

    fn jog(&mut self, outputs: &Outputs) {
        self.write_jog_speed(outputs.jog_speed);
        self.write((*b"JA", 0), outputs.jog_acceleration);
        self.write((*b"JL", 0), outputs.jog_deceleration);
        let profile = self.jog_profile(outputs.jog_speed);
        self.start(Move::Jog, profile);
    }

    /// JS has no sign: that is the direction. False: out of its range.
    fn write_jog_speed(&mut self, signed: i32) -> bool {
        self.write((*b"JS", 0), signed.checked_abs().unwrap_or(i32::MAX))
    }

    /// A move with the parameters of now, whenever its turn comes.
    fn start(&mut self, kind: Move, profile: Profile) {
        if !self.enabled {
            return self.raise(super::drive::alarm::NO_MOVE);
        }
        self.push(Entry::Move(kind, Some(profile)));
    }

    /// A host command.
    fn host(&mut self, letters: Name, [first, second]: [i32; 2]) {
        if !is_host_command(&letters, self.kind == Kind::StepServo) {
            self.refused.unknown_command += 1;
            return;
        }
        // The first of three is '1'.
        let index = u8::try_from(first).ok().and_then(|digit| digit.checked_sub(b'0'));
        match &letters {
            b"SP" => self.set_position(first),
            b"SA" => self.save(),
            b"SO" => match Io::new(first as u16) {
                Some(io) => self.set_output(io),
                None => self.refused.out_of_range += 1,
            },
            b"RL" => {
                let known = u8::try_from(first).is_ok_and(|code| self.write_register(code, second));
                self.refused.out_of_range += u64::from(!known);
            }
            b"HA" | b"HL" | b"HV" => self.write_one_of_three(letters, index, second),
            b"MO" if self.kind == Kind::Stepper => self.write_one_of_three(letters, index, second),
            b"EH" | b"AZ" | b"FX" => self.refused.unsupported += 1,
            _ => {
                self.write((letters, 0), first);
            }
        }
    }

    fn write_one_of_three(&mut self, name: Name, index: Option<u8>, value: i32) {
        match index.filter(|index| (1..=3).contains(index)) {
            Some(index) => {
                self.write((name, index), value);
            }
            None => self.refused.out_of_range += 1,
        }
    }
}
