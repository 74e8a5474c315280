//! Objects written to a drive in PREOP, before its process data run (EtherCAT manual, "PDO assignment", "Cycle
//! time").

use super::object::number::{
    CYCLE_POWER, CYCLE_UNITS, INPUT_PDO, MODE, OUTPUT_PDO, RESOLUTION, RESOLUTION_TURNS,
};
use super::object::pdo::Layout;
use super::object::{Object, Type};
use super::plan::{KollmorgenDrive, Mapping, Start};

/// The objects to write, in this order: the cycle time of a drive that works by SYNC0, if it has objects for it (they
/// are optional in CiA 402, and of some drives read only); PDOs, mode, and what the plan adds.
pub fn start_up(drive: &KollmorgenDrive, period_ns: u64) -> Vec<Start> {
    let mut list = Vec::new();
    if let Some((units, power)) = cycle_time(period_ns).filter(|_| drive.slave.sync) {
        list.push(Start::if_any(CYCLE_UNITS, Type::U8, units.into()));
        list.push(Start::if_any(CYCLE_POWER, Type::I8, Type::I8.raw(power.into())));
    }
    for (assignment, layout) in [(OUTPUT_PDO, &drive.outputs), (INPUT_PDO, &drive.inputs)] {
        select(assignment, layout, drive.mapping, &mut list);
    }
    if let Some(mode) = drive.mode() {
        list.push(Start::new(MODE, Type::I8, Type::I8.raw(mode.0.into())));
    }
    list.extend_from_slice(&drive.slave.start_up);
    list
}

fn select(assignment: u16, layout: &Layout, mapping: Mapping, list: &mut Vec<Start>) {
    if mapping == Mapping::AsIs || layout.entries.is_empty() {
        return;
    }
    let start = |index, sub, kind, raw| Start::new(Object::new(index, sub), kind, raw);
    list.push(start(assignment, 0, Type::U8, 0));
    if mapping == Mapping::Free {
        list.push(start(layout.pdo, 0, Type::U8, 0));
        list.extend(mapped(layout));
        list.push(start(layout.pdo, 0, Type::U8, layout.entries.len() as u64));
    }
    list.push(start(assignment, 1, Type::U16, layout.pdo.into()));
    list.push(start(assignment, 0, Type::U8, 1));
}

/// Objects that are then compared with the drive's: its increments per turn, if it reports them (608Fh follows
/// PRBASE: assumed, so that it may be left out).
pub fn verify(drive: &KollmorgenDrive) -> Vec<Start> {
    if !drive.check_prbase {
        return Vec::new();
    }
    let increments = drive.scaling.increments() as u64;
    vec![Start::factor(RESOLUTION_TURNS, Type::U32), Start::new(RESOLUTION, Type::U32, increments)]
}

/// Objects required of a drive that is found in OP: its PDOs, and the content of those that the master maps.
pub fn verify_found(drive: &KollmorgenDrive) -> Vec<Start> {
    let mut list = Vec::new();
    for (assignment, layout) in [(OUTPUT_PDO, &drive.outputs), (INPUT_PDO, &drive.inputs)] {
        if layout.entries.is_empty() {
            continue;
        }
        list.push(Start::new(Object::new(assignment, 0), Type::U8, 1));
        list.push(Start::new(Object::new(assignment, 1), Type::U16, layout.pdo.into()));
        if drive.mapping == Mapping::Free {
            list.push(Start::new(Object::new(layout.pdo, 0), Type::U8, layout.entries.len() as u64));
            list.extend(mapped(layout));
        }
    }
    list
}

/// The entries of a PDO.
fn mapped(layout: &Layout) -> impl Iterator<Item = Start> {
    layout.entries.iter().zip(1..).map(|(entry, sub)| {
        let Object { index, sub: part } = entry.object;
        let bits = 8 * entry.kind.bytes() as u64;
        let raw = u64::from(index) << 16 | u64::from(part) << 8 | bits;
        Start::new(Object::new(layout.pdo, sub), Type::U32, raw)
    })
}

/// A period as units and their power of ten: 2 ms are (2, -3). `None`: the drive's object cannot express it.
pub fn cycle_time(period_ns: u64) -> Option<(u8, i8)> {
    (-6..=0).rev().find_map(|power: i8| {
        let unit_ns = 10_u64.pow(u32::try_from(9 + i32::from(power)).ok()?);
        let units = u8::try_from(period_ns / unit_ns).ok()?;
        (units > 0 && period_ns.is_multiple_of(unit_ns)).then_some((units, power))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::Family;
    use fieldbeat_core::time::{MS, US};

    /// `index:subindex=value` of each.
    fn text(starts: &[Start]) -> String {
        let one =
            |start: &Start| format!("{:04X}:{}={:X}", start.object.index, start.object.sub, start.raw as u32);
        starts.iter().map(one).collect::<Vec<_>>().join(" ")
    }

    fn written(drive: &KollmorgenDrive) -> String {
        text(&start_up(drive, 2 * MS))
    }

    #[test]
    fn times_of_a_cycle_are_those_of_the_sheet() {
        for (period, expected) in
            [(2 * MS, Some((2, -3))), (250 * US, Some((25, -5))), (500 * US, Some((5, -4))), (125_500, None)]
        {
            assert_eq!(cycle_time(period), expected);
        }
    }

    #[test]
    fn a_drive_gets_its_cycle_its_pdos_and_its_mode() {
        let mut drive = KollmorgenDrive::new("x", 0, Family::S700);
        drive.slave.start_up.push(Start::new(Object::new(0x6081, 0), Type::U32, 5));
        let (cycle, rest) = ("60C2:1=2 60C2:2=FD", "6060:0=80 6081:0=5");
        let inputs = "1C13:0=0 1C13:1=1B03 1C13:0=1";
        let fixed = format!("{cycle} 1C12:0=0 1C12:1=1702 1C12:0=1 {inputs} {rest}");
        assert_eq!(written(&drive), fixed);
        drive.mapping = Mapping::AsIs;
        assert_eq!(written(&drive), format!("{cycle} {rest}"));
        assert_eq!(start_up(&drive, 2 * MS).iter().filter(|start| start.optional).count(), 2, "the cycle");
        // One that works when the frame passes has no use for it.
        drive.slave.sync = false;
        assert_eq!(written(&drive), rest);
        drive.slave.sync = true;
        // A free one is mapped before it is selected.
        drive.mapping = Mapping::Free;
        drive.outputs.pdo = 0x1600;
        let mapped = "1C12:0=0 1600:0=0 1600:1=606B0020 1600:2=60400010 1600:0=2 1C12:1=1600 1C12:0=1";
        assert!(written(&drive).starts_with(&format!("{cycle} {mapped} 1C13:0=0")), "{}", written(&drive));
    }

    #[test]
    fn a_string_is_written_as_long_as_it_is() {
        let bytes = |text: &[u8]| Start::string(RESOLUTION, Type::Text, text.to_vec()).bytes();
        assert_eq!([bytes(b"a"), bytes(b"abcd"), bytes(b"abcdefgh"), bytes(&[b'x'; 40])], [1, 4, 8, 40]);
        let number = |kind, raw| Start::new(RESOLUTION, kind, raw).bytes();
        assert_eq!([number(Type::U32, 0), number(Type::I8, 0xFF)], [4, 1]);
    }

    #[test]
    fn pdos_of_a_running_drive_are_read_and_compared() {
        let mut drive = KollmorgenDrive::new("x", 0, Family::S700);
        assert_eq!(text(&verify_found(&drive)), "1C12:0=1 1C12:1=1702 1C13:0=1 1C13:1=1B03");
        drive.mapping = Mapping::Free;
        (drive.outputs.pdo, drive.inputs.pdo) = (0x1600, 0x1A00);
        let outputs = "1C12:0=1 1C12:1=1600 1600:0=2 1600:1=606B0020 1600:2=60400010";
        let inputs = "1C13:0=1 1C13:1=1A00 1A00:0=3 1A00:1=60640020 1A00:2=60770010 1A00:3=60410010";
        assert_eq!(text(&verify_found(&drive)), format!("{outputs} {inputs}"));
    }
}
