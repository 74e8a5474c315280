//! The vendor's explicit messages: service 0x3C of class 0x64, type 1 and type 2, all big-endian.
//!
//! Facts: sheet, 5.7; what they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a type, opcode, operand, index or register that does not exist | general status 0x20 |
//! | less or more than 8 bytes | 0x13, 0x15 |
//! | a type 1 message while a Q program runs | 0x10, device state conflict |
//! | a type 1 message without room in the buffer | 0x02 |
//! | a type 1 message behind a running move | waits for it, parameters included |
//! | the alarm history | the two newest alarms in bytes 4 to 7 |
//! | a read-only index or register is written | 0x20 |
//! | ZS and ZA | have no index: they cannot be read |

use super::cip::{Failure, Served, general, refuse};
use super::drive::Drive;
use super::opcodes::{self, Operand};
use super::parameters;
use super::settings::Kind;

impl Drive {
    /// Answers one message.
    pub(super) fn vendor(&mut self, data: &[u8], out: &mut Vec<u8>) -> Served {
        let message: [u8; 8] = match data.len() {
            8 => data.try_into().map_err(|_| Failure::general(general::NOT_ENOUGH))?,
            0..8 => return refuse(general::NOT_ENOUGH),
            _ => return refuse(general::TOO_MUCH),
        };
        let [0, kind, third, fourth, rest @ ..] = message else { return refuse(general::PARAMETER) };
        let read = match kind {
            1 => self.type_1(third, fourth, rest)?,
            2 => self.type_2(third, fourth, rest)?,
            _ => return refuse(general::PARAMETER),
        };
        let [high, low] = self.status().to_be_bytes();
        // Type 1 has its register there only for those that use one.
        let third = if kind == 1 && !matches!(fourth, 0xAE) { 0 } else { third };
        out.extend([0, kind, third, fourth]);
        out.extend(read.unwrap_or([high, low, 0, 0]));
        Ok(())
    }

    fn type_1(&mut self, register: u8, opcode: u8, operand: [u8; 4]) -> Result<Option<[u8; 4]>, Failure> {
        if self.program_ns.is_some() {
            self.refused.program_runs += 1;
            return refuse(general::DEVICE_STATE);
        }
        let entry = opcodes::entry(opcode, register, Operand(operand));
        let entry = entry.ok_or(Failure::general(general::PARAMETER))?;
        if self.push(entry) { Ok(None) } else { refuse(general::RESOURCES) }
    }

    /// What it reads; `None`: the reply has the status.
    fn type_2(&mut self, opcode: u8, operand: u8, data: [u8; 4]) -> Result<Option<[u8; 4]>, Failure> {
        let unknown = Err(Failure::general(general::PARAMETER));
        match (opcode, operand) {
            (0x83, index) => {
                let Some(name) = parameters::by_index(index & 0x7F) else { return unknown };
                let word = u16::from_be_bytes([data[0], data[1]]);
                self.write((name, 0), parameters::from_word(&name, word));
                if index & 0x80 != 0 {
                    self.parameters.save_one((name, 0));
                }
            }
            (0x84, index) => {
                let Some(value) = self.indexed(index) else { return unknown };
                let [high, low] = value.to_be_bytes();
                return Ok(Some([high, low, 0, 0]));
            }
            (0x87, 0) => {
                let entry = |place| self.history.get(place).copied().unwrap_or_default().to_be_bytes();
                let ([a, b], [c, d]) = (entry(0), entry(1));
                return Ok(Some([a, b, c, d]));
            }
            (0x88, 0) => return Ok(Some(self.report().encoder.to_be_bytes())),
            (0x88, 1) => return Ok(Some(self.absolute().to_be_bytes())),
            (0x8B, output) => {
                if !self.wiring.set_output((output & 0x7F).saturating_add(1), output & 0x80 != 0) {
                    return unknown;
                }
            }
            (0x8E, 0) => self.reset(),
            (0x98, 0 | 1) => self.kill(operand == 1, false),
            (0x9E, register) => {
                if !self.write_register(register, i32::from_be_bytes(data)) {
                    return unknown;
                }
            }
            (0x9F, register) => {
                let Some(value) = self.register(register) else { return unknown };
                return Ok(Some(value.to_be_bytes()));
            }
            (0xA1, 0) | (0xFF, 0 | 1) => {}
            (0xA2, segment @ 1..=12) => self.run_segment(segment),
            (0xA3, 0 | 1) => self.stop(operand == 1, false),
            _ => return unknown,
        }
        Ok(None)
    }

    /// The value at an index of table 3.
    fn indexed(&self, index: u8) -> Option<u16> {
        if let Some(name) = parameters::by_index(index) {
            return Some(parameters::to_word(&name, self.parameters.get(&name)));
        }
        let report = self.report();
        Some(match index {
            0x80 => report.status,
            0x81 => report.alarm,
            0x82 => report.main,
            0x83 => report.analog.0,
            0x84 => (report.encoder >> 16) as u16,
            0x85 => report.encoder as u16,
            0x86 => report.voltage,
            0x87 => report.temperature as u16,
            0x88 => (report.current / 10) as u16,
            0x89 => 0,
            0x8A => report.error as u16,
            0x8B => report.velocity as u16,
            0x8C => self.target_velocity() as u16,
            0x8D => report.extended,
            0x8E => self.letter.into(),
            0x90 => self.sub_model.into(),
            0x92 => 0,
            0x91 => u16::from(self.kind == Kind::StepServo),
            0x94 => (self.firmware.buffer - self.buffer.len().min(self.firmware.buffer)) as u16,
            0x95 => report.outputs,
            _ => return None,
        })
    }

    /// The velocity that it is to have, 0.25 rpm.
    fn target_velocity(&self) -> i32 {
        use crate::power::{Aim, RPM};
        match self.aim {
            Aim::Velocity { speed, .. } => (speed / RPM * 4.0).round() as i32,
            Aim::GoTo { speed, .. } if self.power.is_moving() => (speed / RPM * 4.0).round() as i32,
            _ => 0,
        }
    }

    /// The value of a Q register; `None`: there is none.
    fn register(&self, code: u8) -> Option<i32> {
        let report = self.report();
        Some(match code {
            b'0'..=b'9' => self.registers[usize::from(code - b'0')],
            b'A' => self.parameters.get(b"AC"),
            b'B' => self.parameters.get(b"DE"),
            b'C' => self.parameters.get(b"DC"),
            b'D' => self.parameters.get(b"DI"),
            b'V' => self.parameters.get(b"VE"),
            b'M' | b'J' => self.parameters.get(b"JS"),
            b'P' | b'l' => report.absolute,
            b'e' => report.encoder,
            b's' => report.status.into(),
            b'f' => report.alarm.into(),
            b'x' => report.error,
            b'v' => report.velocity,
            b'w' => self.target_velocity(),
            b't' => report.temperature.into(),
            b'u' => report.voltage.into(),
            b'q' => report.current.into(),
            b'i' => report.main.into(),
            b'y' => report.outputs.into(),
            _ => return None,
        })
    }

    /// Writes a Q register; false: there is none, or it only reads.
    pub(super) fn write_register(&mut self, code: u8, value: i32) -> bool {
        let name = match code {
            b'0'..=b'9' => {
                self.registers[usize::from(code - b'0')] = value;
                return true;
            }
            b'A' => b"AC",
            b'B' => b"DE",
            b'C' => b"DC",
            b'D' => b"DI",
            b'V' => b"VE",
            b'M' | b'J' => b"JS",
            _ => return false,
        };
        self.write((*name, 0), value);
        if code == b'J' {
            self.update_jog(self.parameters.get(b"JS"));
        }
        true
    }
}
