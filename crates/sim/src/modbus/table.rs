//! The parameters of the simulated drive: all of the catalogue, and the special properties of some.
//!
//! Knows no values in use; those live in `database`. Widths and ranges are those of the catalogue. **Defaults and
//! saved parameters are chosen** where the available manuals do not print them. A parameter that is not listed here
//! is stored, and has no effect.

use std::collections::BTreeSet;
use std::sync::LazyLock;

use fieldbeat_modbus::parameter::catalogue::{self, Known};
use fieldbeat_modbus::parameter::{self, Parameter, Width};

/// A value that the drive computes whenever it is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Variable {
    /// The reference as selected, within its limits.
    Selected,
    /// The same with its direction, and 0 while the drive does not run: the target of the ramp.
    PreRamp,
    PostRamp,
    FinalSpeed,
    Speed,
    SpeedError,
    Current,
    Load,
    Frequency,
    DcBus,
    HardwareEnable,
    Status,
    /// A bit of the status word.
    StatusBit(u8),
    /// An entry of the trip log.
    Trip(u8),
}

/// The special properties of a parameter.
#[derive(Clone, Copy, Debug)]
struct Special {
    menu: u8,
    number: u8,
    default: i32,
    saved: bool,
    variable: Option<Variable>,
}

const fn saved(menu: u8, number: u8, default: i32) -> Special {
    Special { menu, number, default, saved: true, variable: None }
}

const fn volatile(menu: u8, number: u8) -> Special {
    Special { menu, number, default: 0, saved: false, variable: None }
}

const fn shows(menu: u8, number: u8, variable: Variable) -> Special {
    Special { menu, number, default: 0, saved: false, variable: Some(variable) }
}

/// The menus of the Ethernet interface, whatever slot it is in: after all menus that the drive can have.
pub(super) const INTERFACE: u8 = 200;

const SPECIAL: &[Special] = &[
    shows(1, 1, Variable::Selected),
    shows(1, 3, Variable::PreRamp),
    saved(1, 5, 0),      // jog reference
    saved(1, 6, 30_000), // maximum reference: the motor's rated speed
    saved(1, 7, 0),      // minimum reference
    saved(1, 10, 0),     // bipolar reference
    saved(1, 14, 0),     // reference selector
    saved(1, 15, 0),     // preset selector
    saved(1, 21, 0),     // preset reference 1; the others follow
    saved(1, 22, 0),
    saved(1, 23, 0),
    saved(1, 24, 0),
    saved(1, 25, 0),
    saved(1, 26, 0),
    saved(1, 27, 0),
    saved(1, 28, 0),
    saved(1, 36, 0), // analogue reference 1
    volatile(1, 42), // reference select 2: follows REMOTE
    shows(2, 1, Variable::PostRamp),
    saved(2, 2, 1),    // ramp enable
    saved(2, 11, 200), // acceleration rate, ms/1000 rpm
    saved(2, 21, 200), // deceleration rate, ms/1000 rpm
    shows(3, 1, Variable::FinalSpeed),
    shows(3, 2, Variable::Speed),
    shows(3, 3, Variable::SpeedError),
    saved(3, 5, 5),  // zero speed threshold
    saved(3, 6, 5),  // at speed, lower limit
    saved(3, 7, 5),  // at speed, upper limit
    volatile(3, 22), // hard speed reference
    saved(3, 23, 0), // hard speed reference select
    shows(4, 1, Variable::Current),
    saved(4, 7, 2_500), // symmetrical current limit
    shows(4, 20, Variable::Load),
    shows(5, 1, Variable::Frequency),
    shows(5, 4, Variable::Speed),
    shows(5, 5, Variable::DcBus),
    saved(5, 7, 3_000),   // rated current
    saved(5, 8, 300_000), // rated speed
    saved(5, 11, 3),      // pole pairs
    saved(6, 1, 1),       // stop mode
    saved(6, 4, 5),       // start/stop logic
    saved(6, 8, 1),       // hold zero speed
    saved(6, 15, 1),      // drive enable
    shows(6, 29, Variable::HardwareEnable),
    volatile(6, 30),  // run forward
    volatile(6, 31),  // jog forward
    volatile(6, 32),  // run reverse
    volatile(6, 33),  // forward/reverse
    volatile(6, 34),  // run
    volatile(6, 39),  // not stop
    volatile(6, 42),  // control word
    saved(6, 43, 0),  // control word enable
    volatile(10, 33), // drive reset
    volatile(10, 38), // user trip
    shows(10, 40, Variable::Status),
    saved(11, 29, 1_220_010), // firmware 01.22.00.10
    saved(11, 31, 3),         // operating mode: RFC-S
    saved(11, 52, 0),         // serial number, the lower nine digits
    saved(11, 53, 0),         // and those above them
    // What menu 0 of a new drive shows: both clamps, both ramps, the selector, the limit.
    saved(22, 1, 1_007),
    saved(22, 2, 1_006),
    saved(22, 3, 2_011),
    saved(22, 4, 2_021),
    saved(22, 5, 1_014),
    saved(22, 6, 4_007),
    saved(INTERFACE + 15, 5, 502), // Modbus listening port
    saved(INTERFACE + 15, 9, 0),   // Modbus timeout, ms
    saved(INTERFACE + 15, 13, 0),  // Modbus register addressing mode
];

/// The index of a parameter in the table, at compile time: the special ones come first.
const fn at(menu: u8, number: u8) -> usize {
    let mut index = 0;
    while SPECIAL[index].menu != menu || SPECIAL[index].number != number {
        index += 1;
    }
    index
}

// The parameters that the drive itself uses.
pub(super) const JOG_REFERENCE: usize = at(1, 5);
pub(super) const MAXIMUM_REFERENCE: usize = at(1, 6);
pub(super) const MINIMUM_REFERENCE: usize = at(1, 7);
pub(super) const BIPOLAR: usize = at(1, 10);
pub(super) const REFERENCE_SELECTOR: usize = at(1, 14);
pub(super) const PRESET_SELECTOR: usize = at(1, 15);
/// Of the first preset; the others follow.
pub(super) const PRESET: usize = at(1, 21);
pub(super) const ANALOGUE_REFERENCE: usize = at(1, 36);
pub(super) const REMOTE: usize = at(1, 42);
pub(super) const RAMP_ENABLE: usize = at(2, 2);
pub(super) const ACCELERATION: usize = at(2, 11);
pub(super) const DECELERATION: usize = at(2, 21);
pub(super) const ZERO_SPEED: usize = at(3, 5);
pub(super) const AT_SPEED_BELOW: usize = at(3, 6);
pub(super) const AT_SPEED_ABOVE: usize = at(3, 7);
pub(super) const HARD_REFERENCE: usize = at(3, 22);
pub(super) const HARD_SELECT: usize = at(3, 23);
pub(super) const TORQUE_LIMIT: usize = at(4, 7);
pub(super) const RATED_CURRENT: usize = at(5, 7);
pub(super) const RATED_SPEED: usize = at(5, 8);
pub(super) const POLE_PAIRS: usize = at(5, 11);
pub(super) const STOP_MODE: usize = at(6, 1);
pub(super) const START_LOGIC: usize = at(6, 4);
pub(super) const HOLD_ZERO_SPEED: usize = at(6, 8);
pub(super) const DRIVE_ENABLE: usize = at(6, 15);
pub(super) const RUN_FORWARD: usize = at(6, 30);
pub(super) const JOG_FORWARD: usize = at(6, 31);
pub(super) const RUN_REVERSE: usize = at(6, 32);
pub(super) const REVERSE: usize = at(6, 33);
pub(super) const RUN: usize = at(6, 34);
pub(super) const NOT_STOP: usize = at(6, 39);
pub(super) const CONTROL_WORD: usize = at(6, 42);
pub(super) const CONTROL_WORD_ENABLE: usize = at(6, 43);
pub(super) const RESET: usize = at(10, 33);
pub(super) const USER_TRIP: usize = at(10, 38);
pub(super) const SERIAL: [usize; 2] = [at(11, 52), at(11, 53)];
pub(super) const MODBUS_TIMEOUT: usize = at(INTERFACE + 15, 9);
pub(super) const ADDRESSING: usize = at(INTERFACE + 15, 13);

/// The menu that says what menu 0 shows.
pub(super) const SETUP_MENU: u8 = 22;
/// How many parameters menu 0 has.
pub(super) const SETUPS: usize = 80;

/// One parameter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub menu: u8,
    pub number: u8,
    signed: bool,
    low: i32,
    high: i32,
    pub default: i32,
    writable: bool,
    /// Comes back at a restart as it was saved.
    pub saved: bool,
    pub variable: Option<Variable>,
}

impl Row {
    fn of(known: &Known) -> Row {
        let Parameter { slot, menu, number } = known.parameter;
        let bound = |limit: i64| limit.clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        let variable = match (slot, menu, number) {
            (0, 10, 1..=15) => Some(Variable::StatusBit(number - 1)),
            (0, 10, 20..=29) => Some(Variable::Trip(number - 20)),
            _ => None,
        };
        Row {
            menu: if slot == 0 { menu } else { menu + INTERFACE },
            number,
            signed: known.signed,
            low: bound(known.min),
            high: bound(known.max),
            default: bound(0_i64.clamp(known.min, known.max)),
            writable: known.access == parameter::Access::ReadWrite,
            saved: variable.is_none(),
            variable,
        }
    }

    /// Parameter 000 of a menu: the command of the next reset.
    fn command(menu: u8) -> Row {
        let (number, low, high) = (0, 0, u16::MAX.into());
        let (signed, writable, saved, variable) = (false, true, false, None);
        Row { menu, number, signed, low, high, default: 0, writable, saved, variable }
    }

    fn with(self, special: &Special) -> Row {
        let Special { default, saved, variable, .. } = *special;
        Row { default, saved, variable, ..self }
    }

    /// Whether a client may write this value.
    pub(super) fn takes(&self, value: i32) -> bool {
        self.writable && (self.low..=self.high).contains(&value)
    }

    /// The nearest permitted value.
    pub(super) fn clamp(&self, value: i32) -> i32 {
        value.clamp(self.low, self.high)
    }

    /// The value of one register.
    pub(super) fn word(&self, register: u16) -> i32 {
        Width::Word.number(register.into(), self.signed) as i32
    }

    fn key(&self) -> u16 {
        key(self.menu, self.number)
    }
}

/// All parameters: the special ones in their order, then all others.
#[derive(Debug)]
pub(super) struct Table {
    pub rows: Vec<Row>,
    /// Menu and number, and the index; in order.
    index: Vec<(u16, usize)>,
}

/// The one of all drives.
pub(super) static TABLE: LazyLock<Table> = LazyLock::new(Table::new);

impl Table {
    fn new() -> Table {
        let known: Vec<Row> = catalogue::all().map(Row::of).collect();
        let find =
            |special: &Special| known.iter().find(|row| row.key() == key(special.menu, special.number));
        // A test checks that the catalogue has them all.
        let blank = |special: &Special| Row { number: special.number, ..Row::command(special.menu) };
        let mut rows: Vec<Row> = SPECIAL
            .iter()
            .map(|special| find(special).copied().unwrap_or_else(|| blank(special)).with(special))
            .collect();
        let is_special =
            |row: &Row| SPECIAL.iter().any(|special| key(special.menu, special.number) == row.key());
        rows.extend(known.iter().filter(|row| !is_special(row)));
        let menus: BTreeSet<u8> = known.iter().map(|row| row.menu).filter(|menu| *menu < INTERFACE).collect();
        rows.extend(menus.into_iter().map(Row::command));
        let mut index: Vec<_> = rows.iter().enumerate().map(|(at, row)| (row.key(), at)).collect();
        index.sort_unstable();
        Table { rows, index }
    }

    /// The index of a parameter; those of the interface by [`INTERFACE`].
    pub(super) fn find(&self, menu: u8, number: u8) -> Option<usize> {
        let at = self.index.binary_search_by_key(&key(menu, number), |(key, _)| *key).ok()?;
        Some(self.index[at].1)
    }

    /// The same of a parameter as people write it, for an interface in this slot.
    pub(super) fn of(&self, parameter: Parameter, slot: u8) -> Option<usize> {
        match parameter.slot {
            0 if parameter.menu < INTERFACE => self.find(parameter.menu, parameter.number),
            other if other == slot => self.find(parameter.menu.checked_add(INTERFACE)?, parameter.number),
            _ => None,
        }
    }
}

const fn key(menu: u8, number: u8) -> u16 {
    (menu as u16) << 8 | number as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_in_the_catalogue_is_there_and_every_menu_has_a_parameter_000() {
        for known in catalogue::all() {
            assert!(TABLE.of(known.parameter, 4).is_some(), "{}", known.parameter);
        }
        assert!(TABLE.find(6, 0).is_some() && TABLE.find(22, 0).is_some());
        assert_eq!((TABLE.find(0, 1), TABLE.find(7, 0), TABLE.find(255, 255)), (None, None, None));
        assert_eq!(TABLE.of(Parameter::new(15, 9).in_slot(3), 4), None);
        assert_eq!(TABLE.of(Parameter::new(INTERFACE + 15, 9), 4), None);
        assert_eq!(TABLE.of(Parameter::new(15, 9).in_slot(2), 2), Some(MODBUS_TIMEOUT));
    }
}
