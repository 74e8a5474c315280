//! The assemblies as bytes.
//!
//! Facts: sheet, 5.1 to 5.3. Own byte code: it shares none with the master.

use std::net::Ipv4Addr;

use super::settings::{FirmwareSettings, IdentitySettings};
use fieldbeat_ethernet_ip::plan::Layout;

/// Instances.
pub(super) const INPUT_V1: u8 = 0x64;
pub(super) const INPUT_V2: u8 = 0x65;
pub(super) const CONFIGURATION: u8 = 0x66;
pub(super) const INPUT_ONLY: u8 = 0x67;
pub(super) const LISTEN_ONLY: u8 = 0x68;
pub(super) const OUTPUT: u8 = 0x70;

/// Bytes of the outputs.
pub(super) const OUTPUT_SIZE: usize = 64;
/// Bytes of the configuration.
pub(super) const CONFIGURATION_SIZE: usize = 2;

/// Whether the drive has this input assembly. A V2 drive has that of V1, too.
pub(super) fn is_input(instance: u8, identity: &IdentitySettings) -> bool {
    instance == INPUT_V1 || instance == INPUT_V2 && identity.has_outputs()
}

/// Bytes of an input assembly.
pub(super) fn input_size(instance: u8) -> usize {
    if instance == INPUT_V1 { 30 } else { 56 }
}

/// What the drive reports.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Report {
    pub status: u16,
    pub alarm: u16,
    /// 0.1 V.
    pub voltage: u16,
    /// mA.
    pub current: i16,
    /// 0.1 °C.
    pub temperature: i16,
    /// Counts.
    pub encoder: i32,
    /// Steps.
    pub absolute: i32,
    pub error: i32,
    /// 0.25 rpm.
    pub velocity: i32,
    pub extended: u16,
    pub main: u16,
    pub outputs: u16,
    pub analog: (u16, u16),
}

impl Report {
    /// As input assembly `instance`.
    pub(super) fn append(&self, instance: u8, ip: Ipv4Addr, firmware: &FirmwareSettings, out: &mut Vec<u8>) {
        match instance {
            INPUT_V1 => self.v1(ip, firmware.extended_first, out),
            _ => self.v2(firmware.layout, out),
        }
    }

    fn v1(&self, ip: Ipv4Addr, extended_first: bool, out: &mut Vec<u8>) {
        let mut inputs = [self.extended, self.main];
        if !extended_first {
            inputs.reverse();
        }
        out.extend(ip.to_bits().to_le_bytes());
        // V1's current is in 0.01 A.
        for word in
            [self.status, self.alarm, self.voltage, (self.current / 10) as u16, self.temperature as u16]
        {
            out.extend(word.to_le_bytes());
        }
        out.extend(self.encoder.to_le_bytes());
        out.extend(self.absolute.to_le_bytes());
        let velocity = self.velocity.clamp(i16::MIN.into(), i16::MAX.into()) as i16 as u16;
        for word in [velocity, inputs[0], inputs[1], self.outputs] {
            out.extend(word.to_le_bytes());
        }
    }

    fn v2(&self, layout: Layout, out: &mut Vec<u8>) {
        let (extended, main) = (i32::from(self.extended), i32::from(self.main));
        let middle = match layout {
            Layout::Manual => [self.error, self.velocity, extended, main],
            Layout::Page => [self.velocity, extended, main, self.outputs.into()],
        };
        let first = [
            self.status.into(),
            self.alarm.into(),
            self.voltage.into(),
            self.current.into(),
            self.temperature.into(),
            self.encoder,
            self.absolute,
        ];
        let last = [0, self.analog.0.into(), self.analog.1.into()];
        out.extend(first.iter().chain(&middle).chain(&last).flat_map(|element| element.to_le_bytes()));
    }
}

/// The elements of the output assembly.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Outputs {
    pub word: u32,
    pub jog_speed: i32,
    pub jog_acceleration: i32,
    pub jog_deceleration: i32,
    pub velocity: i32,
    pub acceleration: i32,
    pub deceleration: i32,
    pub distance: i32,
    pub current: i32,
    pub letters: [u8; 2],
    pub registers: [i32; 2],
}

impl Outputs {
    /// `None`: not its size.
    pub(super) fn parse(bytes: &[u8]) -> Option<Outputs> {
        let elements: &[u8; OUTPUT_SIZE] = bytes.try_into().ok()?;
        let (elements, _) = elements.as_chunks::<4>();
        let element = |place: usize| i32::from_le_bytes(elements[place]);
        Some(Outputs {
            word: element(0) as u32,
            jog_speed: element(1),
            jog_acceleration: element(2),
            jog_deceleration: element(3),
            velocity: element(4),
            acceleration: element(5),
            deceleration: element(6),
            distance: element(7),
            current: element(8),
            letters: (element(9) as u16).to_be_bytes(),
            registers: [element(10), element(11)],
        })
    }
}
