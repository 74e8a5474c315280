//! What is known of single parameters, by menu.
//!
//! Addresses and meanings are those of the SI-Ethernet and SI-PROFIBUS guides and of masters in the field. Width,
//! decimals and range of most are in no document at hand: those are marked [`assumed`](ParameterInfo::assumed),
//! and are known of drives of this family. A drive has many more parameters, and checks every value itself.

use super::{Parameter, SLOT_MAX, Width};
pub use fieldbeat_core::axis::acyclic::Rights as Access;

/// An entry of the catalogue of parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterInfo {
    /// The parameter. Those of an Ethernet interface are given here in slot 4, and are the same in any other.
    pub parameter: Parameter,
    /// The name here.
    pub name: &'static str,
    /// The size.
    pub width: Width,
    /// It has a sign.
    pub signed: bool,
    /// One count is `10^-decimals` of the unit below: decimals are never on the wire.
    pub decimals: u32,
    /// The unit of the scaled value; empty for a plain number.
    pub unit: &'static str,
    /// Whether it can be written.
    pub access: Access,
    /// The lowest count.
    pub min: i64,
    /// The highest count.
    pub max: i64,
    /// Width, decimals or range are not from a document.
    pub assumed: bool,
}

impl ParameterInfo {
    const fn new(menu: u8, number: u8, name: &'static str, width: Width, signed: bool) -> ParameterInfo {
        let (min, max) = width.range(signed);
        ParameterInfo {
            parameter: Parameter::new(menu, number),
            name,
            width,
            signed,
            decimals: 0,
            unit: "",
            access: Access::ReadWrite,
            min,
            max,
            assumed: false,
        }
    }

    const fn scaled(self, decimals: u32, unit: &'static str) -> ParameterInfo {
        ParameterInfo { decimals, unit, ..self }
    }

    const fn within(self, min: i64, max: i64) -> ParameterInfo {
        ParameterInfo { min, max, ..self }
    }

    const fn read_only(self) -> ParameterInfo {
        ParameterInfo { access: Access::ReadOnly, ..self }
    }

    const fn assume(self) -> ParameterInfo {
        ParameterInfo { assumed: true, ..self }
    }

    const fn of_interface(self) -> ParameterInfo {
        ParameterInfo { parameter: self.parameter.in_slot(SLOT_MAX), ..self }
    }

    /// The scaled value of a count.
    pub fn value(&self, count: i64) -> f64 {
        count as f64 / f64::from(10_u32.pow(self.decimals))
    }

    /// The count nearest to a scaled value; `None`: outside of [`min`](Self::min) ... [`max`](Self::max), or NaN.
    pub fn count(&self, value: f64) -> Option<i64> {
        let count = (value * f64::from(10_u32.pow(self.decimals))).round();
        // Whatever is within the range is within an i64, and NaN is within none.
        (self.min as f64..=self.max as f64).contains(&count).then_some(count as i64)
    }
}

/// The highest speed, 0.1 rpm (assumed).
const SPEED_MAX: i64 = 500_000;
/// The highest value of a set-up parameter of menu 22: 59.999 (assumed).
pub const SETUP_MAX: u16 = 59_999;

const fn flag(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    word(menu, number, name).within(0, 1)
}

const fn word(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    ParameterInfo::new(menu, number, name, Width::Word, false)
}

const fn signed_word(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    ParameterInfo::new(menu, number, name, Width::Word, true)
}

const fn long(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    ParameterInfo::new(menu, number, name, Width::Long, true)
}

/// Menu 1 gives speeds in 32 bits and tenths (masters in the field), the other menus as well (assumed).
const fn speed(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    long(menu, number, name).scaled(1, "rpm").within(-SPEED_MAX, SPEED_MAX).assume()
}

const fn rate(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    long(menu, number, name).scaled(3, "s/1000rpm").within(0, 3_200_000).assume()
}

const fn percent(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    signed_word(menu, number, name).scaled(1, "%").assume()
}

const fn current(menu: u8, number: u8, name: &'static str) -> ParameterInfo {
    long(menu, number, name).scaled(3, "A").assume()
}

const fn gain(number: u8, name: &'static str, decimals: u32) -> ParameterInfo {
    long(3, number, name).scaled(decimals, "").within(0, 200_000).assume()
}

/// Entries of the same kind with consecutive numbers, each with a name of its own.
const fn run<const N: usize>(first: ParameterInfo, names: [&'static str; N]) -> [ParameterInfo; N] {
    let mut all = [first; N];
    let mut index = 0;
    while index < N {
        all[index].parameter.number = first.parameter.number + index as u8;
        all[index].name = names[index];
        index += 1;
    }
    all
}

macro_rules! names {
    ($stem:literal: $($number:literal)*) => { [$(concat!($stem, $number)),*] };
}

const MENU_1: &[ParameterInfo] = &[
    speed(1, 1, "reference-selected").read_only(),
    speed(1, 2, "reference-pre-skip").read_only(),
    speed(1, 3, "reference-pre-ramp").read_only(),
    speed(1, 4, "reference-offset"),
    speed(1, 5, "jog-reference").within(0, SPEED_MAX),
    speed(1, 6, "maximum-reference").within(0, SPEED_MAX),
    speed(1, 7, "minimum-reference"),
    flag(1, 8, "negative-reference-clamp").assume(),
    flag(1, 10, "bipolar-reference").assume(),
    flag(1, 11, "reference-on").read_only().assume(),
    flag(1, 12, "reverse-selected").read_only().assume(),
    flag(1, 13, "jog-selected").read_only().assume(),
    word(1, 14, "reference-selector").within(0, 6).assume(),
    word(1, 15, "preset-selector").within(0, 9).assume(),
];

const PRESETS: &[ParameterInfo] = &run(speed(1, 21, ""), names!("preset-reference-": 1 2 3 4 5 6 7 8));

const MENU_1_END: &[ParameterInfo] = &[
    speed(1, 36, "analogue-reference-1").read_only(),
    speed(1, 37, "analogue-reference-2").read_only(),
    flag(1, 41, "reference-select-1").assume(),
    flag(1, 42, "reference-select-2").assume(),
];

const MENU_2: &[ParameterInfo] = &[
    speed(2, 1, "post-ramp-reference").read_only(),
    flag(2, 2, "ramp-enable").assume(),
    flag(2, 3, "ramp-hold").assume(),
    word(2, 4, "ramp-mode").within(0, 3).assume(),
    rate(2, 11, "acceleration-rate"),
    rate(2, 21, "deceleration-rate"),
];

const MENU_3: &[ParameterInfo] = &[
    speed(3, 1, "final-speed-reference").read_only(),
    speed(3, 2, "speed-feedback").read_only(),
    speed(3, 3, "speed-error").read_only(),
    percent(3, 4, "speed-controller-output").read_only(),
    word(3, 5, "zero-speed-threshold").scaled(0, "rpm").within(0, 200).assume(),
    word(3, 6, "at-speed-lower-limit").scaled(0, "rpm").within(0, 50_000).assume(),
    word(3, 7, "at-speed-upper-limit").scaled(0, "rpm").within(0, 50_000).assume(),
    long(3, 8, "over-speed-threshold").scaled(1, "rpm").within(0, SPEED_MAX).assume(),
    gain(10, "speed-gain-p", 4),
    gain(11, "speed-gain-i", 2),
    gain(12, "speed-gain-d", 5),
    speed(3, 22, "hard-speed-reference"),
    flag(3, 23, "hard-speed-reference-select").assume(),
];

const MENU_4: &[ParameterInfo] = &[
    current(4, 1, "current-magnitude").read_only(),
    current(4, 2, "torque-current").read_only(),
    percent(4, 3, "final-torque-reference").read_only(),
    percent(4, 4, "final-current-reference").read_only(),
    percent(4, 5, "motoring-current-limit").within(0, 10_000),
    percent(4, 6, "regenerating-current-limit").within(0, 10_000),
    percent(4, 7, "symmetrical-current-limit").within(0, 10_000),
    percent(4, 8, "torque-reference").within(-10_000, 10_000),
    word(4, 11, "torque-mode").within(0, 5).assume(),
    current(4, 17, "magnetising-current").read_only(),
    percent(4, 18, "overriding-current-limit").read_only(),
    percent(4, 19, "motor-protection-accumulator").within(0, 1_000).read_only(),
    percent(4, 20, "percentage-load").read_only(),
];

const MENU_5: &[ParameterInfo] = &[
    long(5, 1, "output-frequency").scaled(1, "Hz").read_only().assume(),
    word(5, 2, "output-voltage").scaled(0, "V").read_only().assume(),
    long(5, 3, "output-power").scaled(3, "kW").read_only().assume(),
    speed(5, 4, "motor-speed").read_only(),
    word(5, 5, "dc-bus-voltage").scaled(0, "V").read_only().assume(),
    word(5, 6, "rated-frequency").scaled(1, "Hz").within(0, 5_500).assume(),
    current(5, 7, "rated-current").within(0, 10_000_000),
    long(5, 8, "rated-speed").scaled(2, "rpm").within(0, 3_300_000).assume(),
    word(5, 9, "rated-voltage").scaled(0, "V").within(0, 930).assume(),
    word(5, 10, "rated-power-factor").scaled(3, "").within(0, 1_000).assume(),
    word(5, 11, "motor-pole-pairs").within(0, 240).assume(),
];

const MENU_6: &[ParameterInfo] = &[
    word(6, 1, "stop-mode").within(0, 3).assume(),
    word(6, 3, "mains-loss-mode").within(0, 3).assume(),
    word(6, 4, "start-stop-logic").within(0, 6).assume(),
    flag(6, 8, "hold-zero-speed").assume(),
    flag(6, 15, "drive-enable"),
    flag(6, 29, "hardware-enable").read_only().assume(),
    flag(6, 30, "run-forward").assume(),
    flag(6, 31, "jog-forward").assume(),
    flag(6, 32, "run-reverse").assume(),
    flag(6, 33, "forward-reverse").assume(),
    flag(6, 34, "run").assume(),
    flag(6, 39, "not-stop").assume(),
    word(6, 42, "control-word").within(0, 32_767),
    flag(6, 43, "control-word-enable"),
];

const MENU_10: &[ParameterInfo] = &[
    flag(10, 1, "drive-healthy").read_only(),
    flag(10, 2, "drive-active").read_only(),
    flag(10, 3, "zero-speed").read_only(),
    flag(10, 4, "at-or-below-minimum-speed").read_only(),
    flag(10, 5, "below-set-speed").read_only(),
    flag(10, 6, "at-speed").read_only(),
    flag(10, 7, "above-set-speed").read_only(),
    flag(10, 8, "load-reached").read_only(),
    flag(10, 9, "current-limit-active").read_only(),
    flag(10, 10, "regenerating").read_only(),
    flag(10, 11, "braking-transistor-active").read_only(),
    flag(10, 12, "braking-resistor-alarm").read_only(),
    flag(10, 13, "reverse-commanded").read_only(),
    flag(10, 14, "reverse-running").read_only(),
    flag(10, 15, "mains-loss").read_only(),
];

const TRIPS: &[ParameterInfo] =
    &run(word(10, 20, "").read_only().assume(), names!("trip-": 0 1 2 3 4 5 6 7 8 9));

const MENU_10_END: &[ParameterInfo] = &[
    flag(10, 32, "external-trip").assume(),
    flag(10, 33, "drive-reset"),
    word(10, 34, "auto-reset-attempts").within(0, 6).assume(),
    word(10, 35, "auto-reset-delay").scaled(1, "s").within(10, 6_000).assume(),
    word(10, 38, "user-trip").within(0, 255).assume(),
    word(10, 40, "status-word").within(0, 32_767).read_only(),
];

const SUB_TRIPS: &[ParameterInfo] =
    &run(word(10, 70, "").read_only().assume(), names!("sub-trip-": 0 1 2 3 4 5 6 7 8 9));

const MENU_11: &[ParameterInfo] = &[
    ParameterInfo::new(11, 29, "firmware-version", Width::Long, false).within(0, 99_999_999).read_only(),
    word(11, 31, "operating-mode").within(0, 4).assume(),
    word(11, 44, "security").within(0, 5).assume(),
    ParameterInfo::new(11, 52, "serial-number-low", Width::Long, false)
        .within(0, 999_999_999)
        .read_only()
        .assume(),
    ParameterInfo::new(11, 53, "serial-number-high", Width::Long, false)
        .within(0, 999_999_999)
        .read_only()
        .assume(),
];

const MENU_20_WORDS: &[ParameterInfo] = &run(
    signed_word(20, 1, "").assume(),
    names!("application-word-": 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20),
);

const MENU_20_LONGS: &[ParameterInfo] = &run(
    long(20, 21, ""),
    names!("application-long-": 21 22 23 24 25 26 27 28 29 30 31 32 33 34 35 36 37 38 39 40),
);

const MENU_22: &[ParameterInfo] = &run(
    word(22, 1, "").scaled(3, "").within(0, SETUP_MAX as i64).assume(),
    names!("menu-0-setup-": 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30
        31 32 33 34 35 36 37 38 39 40 41 42 43 44 45 46 47 48 49 50 51 52 53 54 55 56 57 58 59 60 61 62 63 64 65
        66 67 68 69 70 71 72 73 74 75 76 77 78 79 80),
);

/// Menu 15 of an Ethernet interface.
const INTERFACE: &[ParameterInfo] = &[
    word(15, 5, "modbus-port").of_interface(),
    word(15, 9, "modbus-timeout").scaled(0, "ms").of_interface().assume(),
    word(15, 13, "modbus-addressing").within(0, 1).of_interface().assume(),
];

const ALL: &[&[ParameterInfo]] = &[
    MENU_1,
    PRESETS,
    MENU_1_END,
    MENU_2,
    MENU_3,
    MENU_4,
    MENU_5,
    MENU_6,
    MENU_10,
    TRIPS,
    MENU_10_END,
    SUB_TRIPS,
    MENU_11,
    MENU_20_WORDS,
    MENU_20_LONGS,
    MENU_22,
    INTERFACE,
];

/// All of them: those of the drive by menu and number, then those of an Ethernet interface.
pub fn all() -> impl Iterator<Item = &'static ParameterInfo> {
    ALL.iter().copied().flatten()
}

/// Those of one menu of a slot, 0 = the drive's own, by number.
pub fn menu(slot: u8, menu: u8) -> impl Iterator<Item = &'static ParameterInfo> {
    let is_own = slot == 0;
    all().filter(move |known| (known.parameter.slot == 0) == is_own && known.parameter.menu == menu)
}

/// The catalogue's entry of a parameter. That of an Ethernet interface is the same in every slot.
pub fn find(parameter: Parameter) -> Option<&'static ParameterInfo> {
    menu(parameter.slot, parameter.menu).find(|known| known.parameter.number == parameter.number)
}

/// The one with this name: of the drive itself, or of an Ethernet interface.
pub fn named(name: &str, is_interface: bool) -> Option<&'static ParameterInfo> {
    all().find(|known| known.name == name && (known.parameter.slot != 0) == is_interface)
}
