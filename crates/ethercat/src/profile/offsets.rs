//! The offsets of control word, setpoint and reported values in the PDOs of a drive, computed once from their layouts.

use crate::mode::Mode;
use crate::native::PDO_MAX;
use crate::object::Object;
use crate::object::number::{CONTROL_WORD, ERROR_CODE, INCREMENTS, POSITION, STATUS_WORD, TORQUE, VELOCITY};
use crate::object::pdo::{Entry, Layout};
use crate::outputs::{Source, source};
use crate::plan::{KollmorgenDrive, Setpoint, Start};
use fieldbeat_core::rt::Regions;

/// The inputs have an actual position.
pub fn reports_position(drive: &KollmorgenDrive) -> bool {
    let is_one =
        |object| drive.inputs.entries.iter().any(|entry| entry.object == object && entry.kind.bytes() == 4);
    is_one(POSITION) || is_one(INCREMENTS)
}

/// The offset of a value that is not there: past the end.
const NOWHERE: u16 = PDO_MAX as u16;

/// The offsets of the values in the outputs and inputs.
#[derive(Clone, Debug)]
#[repr(C)] // Dense, 16 bytes before what is rarely used.
pub struct Offsets {
    control: u16,
    setpoint: u16,
    status: u16,
    position: u16,
    velocity: u16,
    torque: u16,
    /// The setpoint has 16 bits.
    is_short: bool,
    /// There are position targets that are not the setpoint.
    pub follows: bool,
    /// It reports its position.
    pub reports_position: bool,
    rest: Box<Rest>,
    fault: u16,
}

/// The outputs without control word and setpoint.
#[derive(Clone, Debug)]
struct Rest {
    bytes: [u8; PDO_MAX],
    size: usize,
    mode: u16,
    /// The drive's own values.
    own: Box<[(Object, u16)]>,
    /// Position targets that are not the setpoint, and whether the mode follows them.
    actual: Box<[(u16, bool)]>,
}

impl Offsets {
    pub(super) fn new(drive: &KollmorgenDrive) -> Offsets {
        let (outputs, inputs) = (&drive.outputs, &drive.inputs);
        let sized = |layout: &Layout, object, bytes| {
            let is_it = |(_, entry): &(usize, Entry)| entry.object == object && entry.kind.bytes() == bytes;
            layout.places().find(is_it).map_or(NOWHERE, |(at, _)| at.min(PDO_MAX) as u16)
        };
        let setpoint = drive.setpoint().map(|setpoint| setpoint.shape().0);
        let setpoint = setpoint
            .and_then(|object| outputs.places().find(|(_, entry)| entry.object == object))
            .map(|(at, entry)| (at.min(PDO_MAX) as u16, entry.kind.bytes() == 2));
        let (setpoint, is_short) = setpoint.unwrap_or((NOWHERE, false));
        let position = match sized(inputs, POSITION, 4) {
            NOWHERE => sized(inputs, INCREMENTS, 4),
            position => position,
        };
        let rest = Rest::new(drive);
        Offsets {
            follows: !rest.actual.is_empty(),
            reports_position: reports_position(drive),
            rest: Box::new(rest),
            control: sized(outputs, CONTROL_WORD, 2),
            setpoint,
            is_short,
            status: sized(inputs, STATUS_WORD, 2),
            position,
            velocity: sized(inputs, VELOCITY, 4),
            torque: sized(inputs, TORQUE, 2),
            fault: sized(inputs, ERROR_CODE, 2),
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.rest);
        regions.add(&*self.rest.own);
        regions.add(&*self.rest.actual);
    }

    /// Writes the output PDO without control word and setpoint.
    pub(super) fn fill(&self, outputs: &mut [u8]) {
        let size = self.rest.size.min(outputs.len());
        outputs[..size].copy_from_slice(&self.rest.bytes[..size]);
    }

    /// Writes the position targets that are not the setpoint: the actual position, and one that is held where the mode
    /// follows them.
    pub(super) fn follow(&self, actual: i32, held: i32, outputs: &mut [u8]) {
        for (at, is_followed) in &self.rest.actual {
            put(outputs, *at, if *is_followed { held } else { actual }.to_le_bytes());
        }
    }

    /// This is the drive's own value of an object in the outputs.
    pub(super) fn own_value(&mut self, value: &Start) {
        let Rest { own, bytes, .. } = &mut *self.rest;
        let Some((_, at)) = own.iter().find(|(object, _)| *object == value.object) else { return };
        let (at, size) = (usize::from(*at), value.kind.bytes());
        if let Some(place) = bytes.get_mut(at..at + size) {
            place.copy_from_slice(&value.raw.to_le_bytes()[..size]);
        }
    }

    /// The outputs carry this mode, if they carry one; true: that is another one than before.
    pub(super) fn carry_mode(&mut self, mode: Mode) -> bool {
        let place = self.rest.bytes.get_mut(usize::from(self.rest.mode));
        place.is_some_and(|place| std::mem::replace(place, mode.0 as u8) != mode.0 as u8)
    }

    /// Writes control word and setpoint.
    #[inline]
    pub(super) fn write(&self, control: u16, setpoint: i32, outputs: &mut [u8]) {
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

    /// The status word of the input PDO, if it has one.
    #[inline]
    pub fn status(&self, inputs: &[u8]) -> Option<u16> {
        get(inputs, self.status).map(u16::from_le_bytes)
    }

    /// The actual position.
    #[inline]
    pub fn position(&self, inputs: &[u8]) -> Option<i32> {
        get(inputs, self.position).map(i32::from_le_bytes)
    }

    /// The inputs have a velocity.
    pub fn reports_velocity(&self) -> bool {
        self.velocity != NOWHERE
    }

    /// The actual velocity.
    #[inline]
    pub fn velocity(&self, inputs: &[u8]) -> Option<i32> {
        get(inputs, self.velocity).map(i32::from_le_bytes)
    }

    /// The actual torque.
    #[inline]
    pub fn torque(&self, inputs: &[u8]) -> Option<i16> {
        get(inputs, self.torque).map(i16::from_le_bytes)
    }

    /// The code of its fault.
    pub fn fault(&self, inputs: &[u8]) -> Option<u16> {
        get(inputs, self.fault).map(u16::from_le_bytes)
    }
}

#[inline]
fn put<const N: usize>(outputs: &mut [u8], at: u16, value: [u8; N]) {
    let at = usize::from(at);
    if let Some(place) = outputs.get_mut(at..at + N).and_then(|place| <&mut [u8; N]>::try_from(place).ok()) {
        *place = value;
    }
}

#[inline]
fn get<const N: usize>(inputs: &[u8], at: u16) -> Option<[u8; N]> {
    let at = usize::from(at);
    inputs.get(at..at + N)?.try_into().ok()
}

impl Rest {
    fn new(drive: &KollmorgenDrive) -> Rest {
        let mut bytes = [0; PDO_MAX];
        let (mut mode, mut own, mut actual) = (NOWHERE, Vec::new(), Vec::new());
        for (at, entry) in drive.outputs.places().filter(|(at, entry)| at + entry.kind.bytes() <= PDO_MAX) {
            match source(drive, entry) {
                Ok(Source::Mode) => {
                    mode = at as u16;
                    bytes[at] = drive.mode().map_or(0, |mode| mode.0 as u8);
                }
                Ok(Source::Actual) => {
                    let target = Setpoint::new(entry.object).zip(drive.mode());
                    actual.push((at as u16, target.is_some_and(|(target, mode)| target.is_followed(mode))));
                }
                Ok(Source::Own) => own.push((entry.object, at as u16)),
                Ok(Source::Configured(raw)) => {
                    let size = entry.kind.bytes();
                    bytes[at..at + size].copy_from_slice(&raw.to_le_bytes()[..size]);
                }
                Ok(Source::Control | Source::Setpoint | Source::Zero) | Err(_) => {}
            }
        }
        let size = drive.outputs.size().min(PDO_MAX);
        Rest { bytes, size, mode, own: own.into(), actual: actual.into() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::{Family, Type, pdo};

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
        let offsets = Offsets::new(&drive(Family::S700, 0x1702, 0x1B03));
        let mut outputs = [0xEE; 6];
        offsets.fill(&mut outputs);
        offsets.write(0x0F, 100_000, &mut outputs);
        assert_eq!(outputs, [0xA0, 0x86, 0x01, 0, 0x0F, 0]);
        let inputs = [0x40, 0xE2, 0x01, 0, 0x06, 0xFF, 0x37, 0x06];
        assert_eq!((offsets.status(&inputs), offsets.fault(&inputs)), (Some(0x0637), None));
        assert_eq!((offsets.position(&inputs), offsets.velocity(&inputs)), (Some(123_456), None));
        assert_eq!(offsets.torque(&inputs), Some(-250));
    }

    #[test]
    fn other_mapped_objects_have_planned_values_or_those_of_the_drive() {
        let mut akd = drive(Family::Akd, 0x1725, 0x1B26);
        let outputs = Object::new(0x60FE, 1);
        akd.slave.start_up.push(Start::new(outputs, Type::U32, 3));
        let mut offsets = Offsets::new(&akd);
        offsets.own_value(&Start::new(Object::new(0x6072, 0), Type::U16, 3_000));
        // Nothing of it is in the outputs.
        offsets.own_value(&Start::new(Object::new(0x6080, 0), Type::U32, 0xFFFF_FFFF));
        assert!(!offsets.carry_mode(Mode::HOMING) && !offsets.follows);
        let mut out = vec![0xEE; akd.outputs.size()];
        offsets.fill(&mut out);
        offsets.write(6, -1, &mut out);
        assert_eq!(out, [6, 0, 0xFF, 0xFF, 0xFF, 0xFF, 3, 0, 0, 0, 0, 0, 0, 0, 0xB8, 0x0B]);
    }

    #[test]
    fn a_target_that_its_mode_does_not_follow_is_the_actual_position_and_the_mode_is_carried() {
        let mut akd = drive(Family::Akd, 0x1725, 0x1B26);
        let objects = [(0x6040, 0), (0x6060, 0), (0x607A, 0), (0x60FF, 0)];
        akd.outputs = Layout::of_known(0x1600, &objects.map(|(index, sub)| Object::new(index, sub))).unwrap();
        akd.mode = Some(Mode::PROFILE_VELOCITY);
        let mut offsets = Offsets::new(&akd);
        let built = |offsets: &Offsets| {
            let mut out = [0xEE; 11];
            offsets.fill(&mut out);
            offsets.write(0x0F, 7, &mut out);
            assert!(offsets.follows);
            offsets.follow(-2, 9, &mut out);
            out
        };
        assert_eq!(built(&offsets), [0x0F, 0, 3, 0xFE, 0xFF, 0xFF, 0xFF, 7, 0, 0, 0]);
        assert!(offsets.carry_mode(Mode::HOMING) && !offsets.carry_mode(Mode::HOMING));
        assert_eq!(built(&offsets)[2], 6);
        // The same in a mode that follows it.
        (akd.mode, akd.native) = (Some(Mode::CYCLIC_POSITION), true);
        assert_eq!(built(&Offsets::new(&akd))[..7], [0x0F, 0, 8, 9, 0, 0, 0]);
    }
}
