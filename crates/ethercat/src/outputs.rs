//! Who owns each entry of the outputs of a drive: none is 0 because nobody thought of it.
//!
//! | entry | who writes it |
//! |---|---|
//! | control word 6040h, mode 6060h | the master |
//! | the target that the mode follows | the master: its setpoint |
//! | another position target | it is the actual position: nothing moves when a mode begins to follow it |
//! | one of those that the mode follows, in native mode | it is where the drive came into operation |
//! | an object of `start_up` | it keeps that value |
//! | another velocity or torque target; what 0 switches off | it is 0 |
//! | everything else: limits, windows, profiles, unknown objects | it keeps the drive's own value |
//!
//! That value is read by SDO before the outputs count.
//! While native mode runs all of them are the application's.

use super::object::Object;
use super::object::number::{CONTROL_WORD, MODE};
use super::object::pdo::Entry;
use super::plan::{KollmorgenDrive, Setpoint, Start};
use super::profile::reports_position;

/// Who writes an entry of the outputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Source {
    /// The control word of the master.
    Control,
    /// The mode of operation that the drive shall be in.
    Mode,
    /// The setpoint of the master.
    Setpoint,
    /// The actual position of the drive.
    Actual,
    /// This value, which `start_up` has.
    Configured(u64),
    /// The drive's own value.
    Own,
    /// 0, which commands nothing.
    Zero,
}

/// Why an entry has nobody who writes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unowned {
    /// The mode follows it besides the setpoint.
    Followed,
    /// It is a position target, and the drive reports no position.
    Blind,
    /// It is a setpoint of the manufacturer, of which no public manual says which modes follow it.
    Unexplained,
}

/// Who writes this entry of the outputs of `drive`.
pub(super) fn source(drive: &KollmorgenDrive, Entry { object, kind }: Entry) -> Result<Source, Unowned> {
    let setpoint = drive.setpoint();
    let configured = drive.slave.start_up.iter().rev().find(|start| start.object == object);
    match Setpoint::new(object) {
        _ if object == CONTROL_WORD => return Ok(Source::Control),
        _ if object == MODE => return Ok(Source::Mode),
        Some(target) if setpoint == Some(target) => return Ok(Source::Setpoint),
        Some(target) if !drive.native && drive.mode().is_some_and(|mode| target.is_followed(mode)) => {
            return Err(Unowned::Followed);
        }
        Some(Setpoint::Position(_)) if reports_position(drive) && kind.bytes() == 4 => {
            return Ok(Source::Actual);
        }
        Some(Setpoint::Position(_)) => return Err(Unowned::Blind),
        _ => {}
    }
    match configured {
        Some(Start { raw, .. }) => Ok(Source::Configured(*raw)),
        None if Setpoint::new(object).is_some() || is_off_at_zero(object) => Ok(Source::Zero),
        None if matches!(object.index, 0x2308 | 0x2355) => Err(Unowned::Unexplained),
        None => Ok(Source::Own),
    }
}

/// With 0 it does nothing: gaps (CiA 301, 7.4.7), offsets that are added to a target, touch probes, digital outputs and
/// their mask (CiA 402); latch control and analogue output of an AKD.
const fn is_off_at_zero(Object { index, sub }: Object) -> bool {
    matches!(index, 0x0000..=0x001F | 0x6042 | 0x60B0..=0x60B2 | 0x60B8 | 0x60FE | 0x20A4)
        || matches!((index, sub), (0x3470, 3))
}

/// The objects whose own values the outputs carry, in the order of the outputs.
pub(super) fn own(drive: &KollmorgenDrive) -> Vec<Start> {
    let is_own = |entry: &&Entry| source(drive, **entry) == Ok(Source::Own);
    let start = |entry: &Entry| Start::new(entry.object, entry.kind, 0);
    drive.outputs.entries.iter().filter(is_own).map(start).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mode::Mode;
    use crate::object::pdo::Layout;
    use crate::object::{Family, Target, Type};

    /// A drive of these outputs, and with its position in its inputs.
    fn drive(mode: i8, outputs: &[&str]) -> KollmorgenDrive {
        let entry = |text: &&str| {
            let target = Target::parse(text).unwrap();
            Entry { object: target.object, kind: target.kind.unwrap() }
        };
        let mut drive = KollmorgenDrive::new("x", 0, Family::Akd);
        drive.outputs = Layout { pdo: 0x1600, entries: outputs.iter().map(entry).collect() };
        drive.mode = (mode != 0).then_some(Mode(mode));
        drive.fit();
        drive
    }

    fn sources(drive: &KollmorgenDrive) -> Vec<Result<Source, Unowned>> {
        drive.outputs.entries.iter().map(|entry| source(drive, *entry)).collect()
    }

    #[test]
    fn the_mode_decides_which_target_is_driven() {
        use Source::{Actual, Control, Mode as Modes, Setpoint as Driven, Zero};
        let all = ["0x6040", "0x6060", "0x607A", "0x60C1:1", "0x60FF", "0x6071"];
        for (mode, targets) in [
            (0, [Driven, Actual, Zero, Zero]),
            (8, [Driven, Actual, Zero, Zero]),
            (7, [Actual, Driven, Zero, Zero]),
            (3, [Actual, Actual, Driven, Zero]),
            (4, [Actual, Actual, Zero, Driven]),
        ] {
            let owners = [&[Control, Modes][..], &targets].concat();
            assert_eq!(sources(&drive(mode, &all)), owners.into_iter().map(Ok).collect::<Vec<_>>(), "{mode}");
        }
        // The first one in the PDO decides where no mode is given, and an order does not where one is.
        let torque_first = ["0x6040", "0x6071", "0x607A"];
        assert_eq!(sources(&drive(0, &torque_first)), [Ok(Control), Ok(Driven), Ok(Actual)]);
        assert_eq!(sources(&drive(8, &torque_first)), [Ok(Control), Ok(Zero), Ok(Driven)]);
    }

    #[test]
    fn limits_and_unknown_objects_keep_the_value_of_the_drive() {
        let limits = ["0x6072", "0x60E0:0.u16", "0x60E1:0.u16", "0x607F:0.u32", "0x6080:0.u32", "0x6065"];
        let rest = ["0x607D:1.i32", "0x6081", "0x60C5:0.u32", "0x6099:1", "0x2A00:3.u8"];
        let outputs = [&["0x6040", "0x607A"][..], &limits, &rest].concat();
        let mut drive = drive(8, &outputs);
        assert!(sources(&drive)[2..].iter().all(|source| *source == Ok(Source::Own)));
        assert_eq!(own(&drive).len(), limits.len() + rest.len());
        let torque = Object::new(0x60E0, 0);
        drive.slave.start_up.push(Start::new(torque, Type::U16, 700));
        assert_eq!(sources(&drive)[3], Ok(Source::Configured(700)));
        assert!(own(&drive).iter().all(|start| start.object != torque));
    }
}
