//! The PDO offsets of a drive: looked up once.

use super::{CONTROL_WORD, FAULT_CODE, INCREMENTS, POSITION, STATUS_WORD, TORQUE, VELOCITY};
use crate::bus::ethercat::native::PDO_MAX;
use crate::bus::ethercat::object::Object;
use crate::bus::ethercat::object::pdo::{Entry, Layout};
use crate::bus::ethercat::plan::{KollmorgenDrive, Setpoint};

/// The largest torque of a drive: 0 would be none. If the plan does not set it, it is this, per mille (assumed: the
/// drive's own limit acts below it).
const MAXIMUM_TORQUE: Object = Object::new(0x6072, 0);
const MOST_PERMILLE: u64 = 3_000;

/// The offset of a value in its area; past the end, if it is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct At(u8);

const NOWHERE: At = At(PDO_MAX as u8);

/// The offsets of the values in the outputs and inputs.
#[derive(Clone, Debug)]
pub(super) struct Places {
    /// The outputs without control word and setpoint.
    rest: [u8; PDO_MAX],
    size: usize,
    control: At,
    setpoint: At,
    /// The setpoint has 16 bits.
    is_short: bool,
    status: At,
    position: At,
    velocity: At,
    torque: At,
    fault: At,
}

/// The drive's report, as counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Said {
    pub status: u16,
    pub position: Option<i32>,
    pub velocity: Option<i32>,
    pub torque: Option<i16>,
    pub fault: Option<u16>,
}

impl Places {
    pub(super) fn new(drive: &KollmorgenDrive) -> Places {
        let (outputs, inputs) = (&drive.outputs, &drive.inputs);
        let sized = |layout: &Layout, object, bytes| {
            let is_it = |(_, entry): &(usize, Entry)| entry.object == object && entry.kind.bytes() == bytes;
            layout.places().find(is_it).map_or(NOWHERE, |(at, _)| At::new(at))
        };
        let setpoint = drive.setpoint().map(|setpoint| match setpoint {
            Setpoint::Position(object) | Setpoint::Velocity(object) | Setpoint::Torque(object) => object,
        });
        let setpoint = setpoint
            .and_then(|object| outputs.places().find(|(_, entry)| entry.object == object))
            .map(|(at, entry)| (At::new(at), entry.kind.bytes() == 2));
        let (setpoint, is_short) = setpoint.unwrap_or((NOWHERE, false));
        let position = match sized(inputs, POSITION, 4) {
            NOWHERE => sized(inputs, INCREMENTS, 4),
            position => position,
        };
        Places {
            rest: rest(drive),
            size: outputs.size().min(PDO_MAX),
            control: sized(outputs, CONTROL_WORD, 2),
            setpoint,
            is_short,
            status: sized(inputs, STATUS_WORD, 2),
            position,
            velocity: sized(inputs, VELOCITY, 4),
            torque: sized(inputs, TORQUE, 2),
            fault: sized(inputs, FAULT_CODE, 2),
        }
    }

    /// Writes the output PDO, whole.
    #[inline]
    pub(super) fn write(&self, control: u16, setpoint: i32, outputs: &mut [u8]) {
        let size = self.size.min(outputs.len());
        outputs[..size].copy_from_slice(&self.rest[..size]);
        if self.is_short {
            let most = i32::from(i16::MAX);
            put(outputs, self.setpoint, (setpoint.clamp(-most, most) as i16).to_le_bytes());
        } else {
            put(outputs, self.setpoint, setpoint.to_le_bytes());
        }
        self.write_control(control, outputs);
    }

    /// Writes the control word over the present one.
    #[inline]
    pub(super) fn write_control(&self, control: u16, outputs: &mut [u8]) {
        put(outputs, self.control, control.to_le_bytes());
    }

    /// The control word in an output PDO.
    #[cfg(test)]
    pub(super) fn control(&self, outputs: &[u8]) -> Option<u16> {
        get(outputs, self.control).map(u16::from_le_bytes)
    }

    /// Reads the input PDO; `None`: it has no status word.
    #[inline]
    pub(super) fn read(&self, inputs: &[u8]) -> Option<Said> {
        Some(Said {
            status: u16::from_le_bytes(get(inputs, self.status)?),
            position: get(inputs, self.position).map(i32::from_le_bytes),
            velocity: get(inputs, self.velocity).map(i32::from_le_bytes),
            torque: get(inputs, self.torque).map(i16::from_le_bytes),
            fault: get(inputs, self.fault).map(u16::from_le_bytes),
        })
    }
}

impl At {
    fn new(at: usize) -> At {
        At(at.min(PDO_MAX) as u8)
    }
}

#[inline]
fn put<const N: usize>(outputs: &mut [u8], at: At, value: [u8; N]) {
    if let Some(place) = outputs.get_mut(usize::from(at.0)..).and_then(<[u8]>::first_chunk_mut) {
        *place = value;
    }
}

#[inline]
fn get<const N: usize>(inputs: &[u8], at: At) -> Option<[u8; N]> {
    inputs.get(usize::from(at.0)..)?.first_chunk().copied()
}

/// The other outputs: as the plan writes the objects at the start, otherwise 0.
fn rest(drive: &KollmorgenDrive) -> [u8; PDO_MAX] {
    let mut rest = [0; PDO_MAX];
    for (at, entry) in drive.outputs.places() {
        let planned = drive.slave.start_up.iter().rev().find(|start| start.object == entry.object);
        let raw = match (planned, entry.object) {
            (Some(start), _) => start.raw,
            (None, MAXIMUM_TORQUE) => MOST_PERMILLE,
            (None, _) => 0,
        };
        let bytes = entry.kind.bytes();
        if let Some(place) = rest.get_mut(at..at + bytes) {
            place.copy_from_slice(&raw.to_le_bytes()[..bytes]);
        }
    }
    rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::ethercat::object::{Family, pdo};
    use crate::bus::ethercat::plan::Start;

    fn drive(family: Family, outputs: u16, inputs: u16) -> KollmorgenDrive {
        let mut drive = KollmorgenDrive::new("x", 0, family);
        for layout in pdo::fixed(family) {
            match layout.pdo {
                number if number == outputs => drive.outputs = layout,
                number if number == inputs => drive.inputs = layout,
                _ => {}
            }
        }
        drive
    }

    #[test]
    fn outputs_and_inputs_are_those_of_the_sheet() {
        let places = Places::new(&drive(Family::S700, 0x1702, 0x1B03));
        let mut outputs = [0xEE; 6];
        places.write(0x0F, 100_000, &mut outputs);
        assert_eq!(outputs, [0xA0, 0x86, 0x01, 0, 0x0F, 0]);
        assert_eq!(places.control(&outputs), Some(0x0F));
        let said = places.read(&[0x40, 0xE2, 0x01, 0, 0x06, 0xFF, 0x37, 0x06]).unwrap();
        assert_eq!((said.status, said.position, said.torque), (0x0637, Some(123_456), Some(-250)));
        assert_eq!((said.velocity, said.fault), (None, None));
    }

    #[test]
    fn what_else_is_mapped_is_as_planned_and_no_torque_is_taken_away() {
        let mut akd = drive(Family::Akd, 0x1725, 0x1B26);
        let outputs = Object::new(0x60FE, 1);
        akd.slave.start_up.push(Start {
            object: outputs,
            kind: crate::bus::ethercat::object::Type::U32,
            raw: 3,
        });
        let places = Places::new(&akd);
        let mut out = vec![0xEE; akd.outputs.size()];
        places.write(6, -1, &mut out);
        assert_eq!(out, [6, 0, 0xFF, 0xFF, 0xFF, 0xFF, 3, 0, 0, 0, 0, 0, 0, 0, 0xB8, 0x0B]);
    }

    #[test]
    fn areas_that_are_too_short_are_neither_read_nor_written_beyond() {
        let places = Places::new(&drive(Family::S700, 0x1702, 0x1B03));
        for length in 0..6 {
            let mut outputs = vec![0; length];
            places.write(0x0F, -1, &mut outputs);
        }
        assert!((0..8).all(|length| places.read(&vec![0; length]).is_none()));
    }
}
