//! The parameters of the simulated drive.
//!
//! Knows no values in use; those live in `database`. Numbers and meanings are those of the SI-Ethernet and SI-PROFIBUS
//! guides and of masters in the field. **Widths, ranges, defaults and saved parameters are chosen** where the available
//! manuals do not print them.

use std::collections::BTreeSet;
use std::sync::LazyLock;

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

/// The menus of the Ethernet interface, whatever slot it is in: after all menus that the drive can have.
pub(super) const INTERFACE: u8 = 200;
/// The menu whose parameters name those that menu 0 shows.
pub(super) const SETUP_MENU: u8 = 22;
/// How many parameters menu 0 has.
pub(super) const SETUPS: usize = 80;

/// One parameter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub menu: u8,
    pub number: u8,
    /// The value of 16 bits has a sign.
    signed: bool,
    low: i32,
    high: i32,
    pub default: i32,
    writable: bool,
    /// Comes back at a restart as it was saved.
    pub saved: bool,
    pub variable: Option<Variable>,
}

const fn word(menu: u8, number: u8, low: i32, high: i32) -> Row {
    let default = if low > 0 { low } else { 0 };
    let (signed, writable, saved, variable) = (low < 0, true, true, None);
    Row { menu, number, signed, low, high, default, writable, saved, variable }
}

const fn flag(menu: u8, number: u8) -> Row {
    word(menu, number, 0, 1)
}

/// With 32 bits.
const fn long(menu: u8, number: u8, low: i32, high: i32) -> Row {
    Row { signed: true, ..word(menu, number, low, high) }
}

/// In 0.1 rpm, both directions.
const fn speed(menu: u8, number: u8) -> Row {
    long(menu, number, -SPEED_MAX, SPEED_MAX)
}

/// In mA.
const fn current(menu: u8, number: u8) -> Row {
    long(menu, number, i32::MIN, i32::MAX)
}

/// In 0.1 %.
const fn percent(menu: u8, number: u8) -> Row {
    word(menu, number, -0x8000, 0x7FFF)
}

impl Row {
    const fn of(self, default: i32) -> Row {
        Row { default, ..self }
    }

    const fn volatile(self) -> Row {
        Row { saved: false, ..self }
    }

    const fn read_only(self) -> Row {
        Row { writable: false, ..self }
    }

    const fn shows(self, variable: Variable) -> Row {
        Row { variable: Some(variable), writable: false, saved: false, ..self }
    }

    const fn at(self, number: u8) -> Row {
        Row { number, ..self }
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
    pub(super) fn word(&self, register: [u8; 2]) -> i32 {
        if self.signed { i16::from_be_bytes(register).into() } else { u16::from_be_bytes(register).into() }
    }

    fn key(&self) -> u16 {
        key(self.menu, self.number)
    }
}

/// The highest speed, 0.1 rpm.
const SPEED_MAX: i32 = 500_000;
const WORD: i32 = 0xFFFF;

/// The parameters with an effect, or with a value of their own.
const ROWS: &[Row] = &[
    speed(1, 1).shows(Variable::Selected),
    speed(1, 3).shows(Variable::PreRamp),
    long(1, 5, 0, SPEED_MAX),            // jog reference
    long(1, 6, 0, SPEED_MAX).of(30_000), // maximum reference: the motor's rated speed
    speed(1, 7),                         // minimum reference
    flag(1, 10),                         // bipolar reference
    word(1, 14, 0, 6),                   // reference selector
    word(1, 15, 0, 9),                   // preset selector
    speed(1, 21),                        // preset reference 1; the others follow
    speed(1, 22),
    speed(1, 23),
    speed(1, 24),
    speed(1, 25),
    speed(1, 26),
    speed(1, 27),
    speed(1, 28),
    speed(1, 36).read_only(), // analogue reference 1
    flag(1, 42).volatile(),   // reference select 2: follows REMOTE
    speed(2, 1).shows(Variable::PostRamp),
    flag(2, 2).of(1),                  // ramp enable
    long(2, 11, 0, 3_200_000).of(200), // acceleration rate, ms/1000 rpm
    long(2, 21, 0, 3_200_000).of(200), // deceleration rate, ms/1000 rpm
    speed(3, 1).shows(Variable::FinalSpeed),
    speed(3, 2).shows(Variable::Speed),
    speed(3, 3).shows(Variable::SpeedError),
    word(3, 5, 0, 200).of(5),    // zero speed threshold
    word(3, 6, 0, 50_000).of(5), // at speed, lower limit
    word(3, 7, 0, 50_000).of(5), // at speed, upper limit
    speed(3, 22).volatile(),     // hard speed reference
    flag(3, 23),                 // hard speed reference select
    current(4, 1).shows(Variable::Current),
    word(4, 7, 0, 10_000).of(2_500), // symmetrical current limit
    percent(4, 20).shows(Variable::Load),
    long(5, 1, i32::MIN, i32::MAX).shows(Variable::Frequency),
    speed(5, 4).shows(Variable::Speed),
    word(5, 5, 0, WORD).shows(Variable::DcBus),
    long(5, 7, 0, 10_000_000).of(3_000),  // rated current
    long(5, 8, 0, 3_300_000).of(300_000), // rated speed
    word(5, 11, 0, 240).of(3),            // pole pairs
    word(6, 1, 0, 3).of(1),               // stop mode
    word(6, 4, 0, 6).of(5),               // start/stop logic
    flag(6, 8).of(1),                     // hold zero speed
    flag(6, 15).of(1),                    // drive enable
    flag(6, 29).shows(Variable::HardwareEnable),
    flag(6, 30).volatile(),            // run forward
    flag(6, 31).volatile(),            // jog forward
    flag(6, 32).volatile(),            // run reverse
    flag(6, 33).volatile(),            // forward/reverse
    flag(6, 34).volatile(),            // run
    flag(6, 39).volatile(),            // not stop
    word(6, 42, 0, 0x7FFF).volatile(), // control word
    flag(6, 43),                       // control word enable
    flag(10, 33).volatile(),           // drive reset
    word(10, 38, 0, 255).volatile(),   // user trip
    word(10, 40, 0, 0x7FFF).shows(Variable::Status),
    long(11, 29, 0, 99_999_999).read_only().of(1_220_010), // firmware 01.22.00.10
    word(11, 31, 0, 4).of(3),                              // operating mode: RFC-S
    long(11, 52, 0, 999_999_999).read_only(),              // serial number, the lower nine digits
    long(11, 53, 0, 999_999_999).read_only(),              // and those above them
    // The parameters that menu 0 of a new drive shows: both clamps, both ramps, the selector, the limit.
    setup(1).of(1_007),
    setup(2).of(1_006),
    setup(3).of(2_011),
    setup(4).of(2_021),
    setup(5).of(1_014),
    setup(6).of(4_007),
    word(INTERFACE + 15, 5, 0, WORD).of(502), // Modbus listening port
    word(INTERFACE + 15, 9, 0, WORD),         // Modbus timeout, ms
    flag(INTERFACE + 15, 13),                 // Modbus register addressing mode
];

const fn setup(number: u8) -> Row {
    word(SETUP_MENU, number, 0, 59_999)
}

/// Parameters that are stored and have no effect: the first one of a row, and the number of the last one.
const STORED: &[(Row, u8)] = &[
    (speed(1, 2).read_only(), 2),
    (speed(1, 4), 4),
    (flag(1, 8), 8),
    (flag(1, 11).read_only(), 13),
    (speed(1, 37).read_only(), 37),
    (flag(1, 41), 41),
    (flag(2, 3), 3),
    (word(2, 4, 0, 3), 4),
    (percent(3, 4).read_only(), 4),
    (long(3, 8, 0, SPEED_MAX), 8),
    (long(3, 10, 0, 200_000), 12),
    (current(4, 2).read_only(), 2),
    (percent(4, 3).read_only(), 4),
    (word(4, 5, 0, 10_000), 6),
    (word(4, 8, -10_000, 10_000), 8),
    (word(4, 11, 0, 5), 11),
    (current(4, 17).read_only(), 17),
    (percent(4, 18).read_only(), 18),
    (word(4, 19, 0, 1_000).read_only(), 19),
    (word(5, 2, 0, WORD).read_only(), 2),
    (long(5, 3, i32::MIN, i32::MAX).read_only(), 3),
    (word(5, 6, 0, 5_500), 6),
    (word(5, 9, 0, 930), 9),
    (word(5, 10, 0, 1_000), 10),
    (word(6, 3, 0, 3), 3),
    (flag(10, 32), 32),
    (word(10, 34, 0, 6), 34),
    (word(10, 35, 10, 6_000), 35),
    (word(10, 70, 0, WORD).read_only(), 79),
    (word(11, 44, 0, 5), 44),
    (percent(20, 1), 20),
    (long(20, 21, i32::MIN, i32::MAX), 40),
    (setup(7), SETUPS as u8),
];

/// The index of a parameter in the table, at compile time: those with an effect come first.
const fn at(menu: u8, number: u8) -> usize {
    let mut index = 0;
    while ROWS[index].menu != menu || ROWS[index].number != number {
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
pub(super) const RATED_SPEED: usize = at(5, 8);
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

/// All parameters: those of `ROWS` in their order, then all others.
#[derive(Debug)]
pub(super) struct Table {
    pub rows: Vec<Row>,
    /// Menu and number, and the index; in order.
    index: Vec<(u16, usize)>,
}

/// The one of all drives.
pub(super) static TABLE: LazyLock<Table> = LazyLock::new(|| {
    let mut rows = ROWS.to_vec();
    rows.extend((1..=15).map(|bit| flag(10, bit).shows(Variable::StatusBit(bit - 1))));
    rows.extend((0..10).map(|entry| word(10, 20 + entry, 0, WORD).shows(Variable::Trip(entry))));
    rows.extend(
        STORED.iter().flat_map(|(first, last)| (first.number..=*last).map(|number| first.at(number))),
    );
    // Parameter 000 of each menu: the command of the next reset.
    let menus = BTreeSet::from_iter(rows.iter().map(|row| row.menu).filter(|menu| *menu < INTERFACE));
    rows.extend(menus.into_iter().map(|menu| word(menu, 0, 0, WORD).volatile()));
    let mut index: Vec<_> = rows.iter().enumerate().map(|(at, row)| (row.key(), at)).collect();
    index.sort_unstable();
    Table { rows, index }
});

impl Table {
    /// The index of a parameter; those of the interface by [`INTERFACE`].
    pub(super) fn find(&self, menu: u8, number: u8) -> Option<usize> {
        let at = self.index.binary_search_by_key(&key(menu, number), |(key, _)| *key).ok()?;
        Some(self.index[at].1)
    }
}

const fn key(menu: u8, number: u8) -> u16 {
    (menu as u16) << 8 | number as u16
}
