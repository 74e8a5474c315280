//! Addresses of the guides and of masters in the field, every address there and back, and the catalogue. Any text and
//! any value are those of the fuzz target `modbus_wire`.

use super::*;

fn parameter(text: &str) -> Parameter {
    text.parse().unwrap_or_else(|error| panic!("{text}: {error}"))
}

#[test]
fn reference_addresses_of_the_guides_and_of_masters_in_the_field() {
    let golden = "00.001 0000, 01.006 0069, 01.014 0071, 01.015 0072, 01.021 0078, 02.001 00C8, 03.002 012D, \
                  03.022 0141, 04.001 0190, 04.020 01A3, 05.001 01F4, 05.005 01F8, 06.015 0266, 06.042 0281, \
                  06.043 0282, 10.001 03E8, 10.002 03E9, 10.020 03FB, 10.033 0408, 10.038 040D, 10.040 040F, \
                  11.029 0468, 20.021 07E4";
    for (text, word) in golden.split(", ").map(|pair| pair.split_once(' ').unwrap()) {
        let word = u16::from_str_radix(word, 16).unwrap();
        // One of 32 bits has bit 14 besides.
        for (width, address) in [(Width::Word, word), (Width::Long, 0x4000 + word)] {
            let parameter = parameter(text);
            assert_eq!(parameter.address(Addressing::Standard, width), Some(address), "{text}");
            assert_eq!(Parameter::from_address(address, Addressing::Standard), Some((parameter, width)));
        }
    }
}

/// Modified addressing has 256 parameters a menu and 64 menus; the edges of the standard one are those of the
/// SI-Ethernet guide: 163.84 would be the end of 14 bits, 162.99 is that of the menus.
#[test]
fn the_edges_of_both_addressings_are_those_of_the_guides() {
    use Addressing::{Modified, Standard};
    for (addressing, text, address) in [
        (Standard, "162.099", Some(16298)),
        (Standard, "01.000", Some(99)),
        (Standard, "06.100", None),
        (Modified, "00.001", Some(0)),
        (Modified, "06.042", Some(6 * 256 + 41)),
        (Modified, "06.255", Some(7 * 256 - 2)),
        (Modified, "63.255", Some(0x3FFE)),
        (Modified, "64.001", None),
    ] {
        assert_eq!(parameter(text).address(addressing, Width::Word), address, "{text}");
        let long = address.map(|address| 0x4000 + address);
        assert_eq!(parameter(text).address(addressing, Width::Long), long, "{text}");
    }
    assert_eq!(Parameter::from_address(16299, Standard), None);
    assert_eq!(Parameter::from_address(0x3FFF, Modified), None);
    for addressing in [Standard, Modified] {
        // Nothing is at 00.000, and bit 15 is reserved.
        assert_eq!(Parameter::default().address(addressing, Width::Word), None);
        assert!((0x8000..=0xFFFF).all(|address| Parameter::from_address(address, addressing).is_none()));
    }
}

#[test]
fn every_address_is_one_parameter_and_back() {
    for addressing in [Addressing::Standard, Addressing::Modified] {
        let mut count = 0;
        for address in 0..0x8000 {
            if let Some((parameter, width)) = Parameter::from_address(address, addressing) {
                assert_eq!(parameter.address(addressing, width), Some(address));
                assert_eq!(parameter.to_string().parse(), Ok(parameter));
                count += 1;
            }
        }
        let all = (usize::from(addressing.menu_max()) + 1) * (usize::from(addressing.number_max()) + 1) - 1;
        assert_eq!(count, 2 * all);
    }
}

#[test]
fn a_parameter_is_written_as_the_manuals_do() {
    for text in ["06.042", "6.042", "0.06.042"] {
        assert_eq!(parameter(text), Parameter::CONTROL_WORD);
    }
    for (parameter, text) in [
        (Parameter::new(6, 42), "06.042"),
        (Parameter::new(6, 42).in_slot(1), "1.06.042"),
        (Parameter::new(162, 99), "162.099"),
    ] {
        assert_eq!((parameter.to_string().as_str(), text.parse()), (text, Ok(parameter)));
    }
    // What could be two parameters is none.
    let none = "6.42|06.42|06.4|06.0042|06||.|06.|.042|06..042|06.042.|+6.042|06.+42|06.04a| 06.042|06.042 \
         |5.06.042|01.06.042|1.1.06.042|-1.06.042|00.000|163.001|64.100|06.256|0006.042|06.\u{661}42|06,042";
    for text in none.split('|') {
        assert_eq!(text.parse::<Parameter>(), Err(ParseError), "{text}");
    }
}

#[test]
fn slots_are_units_and_the_drive_has_two() {
    assert_eq!(Parameter::CONTROL_WORD.unit(DRIVE_UNIT), 255);
    assert_eq!(Parameter::CONTROL_WORD.unit(0), 0);
    assert_eq!(parameter("4.15.009").unit(DRIVE_UNIT), 4);
    for unit in 0..=255 {
        let expected = match unit {
            0 | 255 => Some(0),
            1..=4 => Some(unit),
            _ => None,
        };
        assert_eq!(slot(unit), expected);
    }
}

#[test]
fn a_setup_parameter_of_menu_22_says_menu_and_number() {
    assert_eq!(Parameter::REFERENCE.to_setup(), Some(1_021));
    assert_eq!(Parameter::STATUS_WORD.to_setup(), Some(10_040));
    assert_eq!(Parameter::from_setup(10_040), Some(Parameter::STATUS_WORD));
    assert_eq!(parameter("1.06.042").to_setup(), None);
    assert_eq!(Parameter::new(60, 1).to_setup(), None);
    assert_eq!(Parameter::from_setup(1_256), None);
    assert_eq!(Parameter::from_setup(60_001), None);
}

#[test]
fn widths_cut_and_extend() {
    assert_eq!((Width::Word.number(0xFFFF, true), Width::Word.number(0xFFFF, false)), (-1, 0xFFFF));
    assert_eq!(Width::Word.number(0x1234_8000, true), -32768);
    assert_eq!((Width::Long.number(u32::MAX, true), Width::Long.number(u32::MAX, false)), (-1, 0xFFFF_FFFF));
    assert_eq!((Width::Word.raw(-1), Width::Long.raw(-1)), (0xFFFF, 0xFFFF_FFFF));
    for (width, signed) in
        [(Width::Word, true), (Width::Word, false), (Width::Long, true), (Width::Long, false)]
    {
        let (low, high) = width.range(signed);
        for value in [low, low + 1, 0, high - 1, high] {
            assert_eq!(width.number(width.raw(value), signed), value, "{width:?} {signed}");
        }
    }
}

#[test]
fn the_catalogue_is_in_order_and_every_name_is_its_own() {
    let all: Vec<&ParameterInfo> = catalogue::all().collect();
    let place = |known: &ParameterInfo| (known.parameter.slot, known.parameter.menu, known.parameter.number);
    assert!(all.windows(2).all(|pair| place(pair[0]) < place(pair[1])));
    for known in all {
        assert_eq!(known.parameter.known(), Some(known));
        assert_eq!(catalogue::named(known.name, known.parameter.slot != 0), Some(known));
        assert!(known.parameter.address(Addressing::Standard, known.width).is_some());
        let (low, high) = known.width.range(known.signed);
        assert!(low <= known.min && known.min < known.max && known.max <= high, "{known:?}");
    }
}

#[test]
fn parameters_that_master_and_drive_depend_on_are_listed() {
    for (parameter, width, decimals, access) in [
        (Parameter::CONTROL_WORD, Width::Word, 0, Access::ReadWrite),
        (Parameter::CONTROL_WORD_ENABLE, Width::Word, 0, Access::ReadWrite),
        (Parameter::REFERENCE, Width::Long, 1, Access::ReadWrite),
        (Parameter::REFERENCE_SELECTOR, Width::Word, 0, Access::ReadWrite),
        (Parameter::PRESET_SELECTOR, Width::Word, 0, Access::ReadWrite),
        (Parameter::SPEED, Width::Long, 1, Access::ReadOnly),
        (Parameter::LOAD, Width::Word, 1, Access::ReadOnly),
        (Parameter::STATUS_WORD, Width::Word, 0, Access::ReadOnly),
        (Parameter::TRIP, Width::Word, 0, Access::ReadOnly),
        (Parameter::FIRMWARE, Width::Long, 0, Access::ReadOnly),
    ] {
        let known = parameter.known().unwrap_or_else(|| panic!("{parameter}"));
        assert_eq!((known.width, known.decimals, known.access), (width, decimals, access), "{parameter}");
    }
    assert_eq!(parameter("10.029").known().map(|known| known.name), Some("trip-9"));
    assert_eq!(parameter("20.040").known().map(|known| known.name), Some("application-long-40"));
    assert_eq!(parameter("22.080").known().map(|known| known.name), Some("menu-0-setup-80"));
    assert_eq!(parameter("22.081").known(), None);
    // The interface's menu is the same in every slot, and not that of the drive.
    for slot in 1..=4 {
        let known = Parameter::new(15, 9).in_slot(slot).known();
        assert_eq!(known.map(|known| known.name), Some("modbus-timeout"));
    }
    assert_eq!(parameter("15.009").known(), None);
    assert_eq!(catalogue::menu(0, 6).count(), 14);
}

#[test]
fn scaled_values_are_rounded_and_kept_within_the_range() {
    let speed = Parameter::REFERENCE.known().unwrap();
    assert_eq!((speed.value(15_000), speed.value(-5)), (1500.0, -0.5));
    assert_eq!(
        (speed.count(1500.0), speed.count(-0.46), speed.count(0.04)),
        (Some(15_000), Some(-5), Some(0))
    );
    assert_eq!((speed.count(50_000.0), speed.count(50_000.06)), (Some(500_000), None));
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX] {
        assert_eq!(speed.count(value), None, "{value}");
    }
}
