//! Parameters of a Unidrive: how people write them, and where they are on the wire.
//!
//! `06.042` is parameter 42 of menu 6 of the drive itself, `4.15.009` parameter 9 of menu 15 of the module in slot 4.
//! The number of a parameter always has its three digits, as the drive's keypad and manuals write it: `6.42` could be
//! 042 to one reader and 420 to another, and is refused. Zeros in front of the menu may be left out, `6.042`.
//!
//! On the wire the address of a parameter counts parameters, with 16-bit and with 32-bit access alike; bit 14 requests
//! 32 bits, bit 15 is reserved (SI-Ethernet guide):
//!
//! ```text
//! standard:  menu * 100 + number - 1      menu 0 ... 162, number 0 ... 99
//! modified:  menu * 256 + number - 1      menu 0 ... 63,  number 0 ... 255
//! ```
//!
//! The slot is the unit identifier of the message. What is known of single parameters stands in [`catalogue`].

pub mod catalogue;

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

use fieldbeat_core::axis::acyclic::{Integer, decimal};

pub use catalogue::{Access, ParameterInfo};

/// The unit identifier of the drive itself: masters use this one; 0 is the drive as well (SI-Ethernet guide).
pub const DRIVE_UNIT: u8 = 255;
/// The unit identifier of the Ethernet interface itself, whatever slot it is in (SI-Ethernet guide).
pub const INTERFACE_UNIT: u8 = 254;
/// The highest slot: on-board Ethernet (SI-Ethernet guide).
pub const SLOT_MAX: u8 = 4;
/// Bit 14 of an address: 32-bit access.
pub const LONG: u16 = 1 << 14;
/// Bit 15 of an address: reserved.
pub const RESERVED: u16 = 1 << 15;

/// How menus and numbers make an address: Pr S.15.013 (SI-Ethernet guide). The numbers of its values are assumed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Addressing {
    /// A hundred addresses per menu: 0.
    #[default]
    Standard,
    /// 256 addresses per menu: 1.
    Modified,
}

impl Addressing {
    /// Addresses per menu.
    const fn stride(self) -> u16 {
        match self {
            Addressing::Standard => 100,
            Addressing::Modified => 256,
        }
    }

    /// The highest menu (SI-Ethernet guide).
    pub const fn menu_max(self) -> u8 {
        match self {
            Addressing::Standard => 162,
            Addressing::Modified => 63,
        }
    }

    /// The highest number of a parameter.
    pub const fn number_max(self) -> u8 {
        (self.stride() - 1) as u8
    }
}

/// How a parameter is accessed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Width {
    /// 16 bits, one register. Of a parameter with more, the low ones (assumed).
    Word,
    /// 32 bits, two registers, high word first. Of a smaller parameter, its value with its sign (assumed).
    Long,
}

impl Width {
    /// Registers of a value.
    pub const fn registers(self) -> u16 {
        match self {
            Width::Word => 1,
            Width::Long => 2,
        }
    }

    /// Bytes of a value.
    pub const fn bytes(self) -> usize {
        2 * self.registers() as usize
    }

    /// Bits of a value.
    pub const fn bits(self) -> u32 {
        16 * self.registers() as u32
    }

    pub(crate) const fn integer(self, signed: bool) -> Integer {
        Integer { bits: self.bits(), signed }
    }

    /// The lowest and the highest value.
    pub const fn range(self, signed: bool) -> (i64, i64) {
        self.integer(signed).range()
    }

    /// The value of raw bits. Higher bits are ignored.
    pub const fn number(self, raw: u32, signed: bool) -> i64 {
        self.integer(signed).number(raw as u64)
    }

    /// The raw bits of a value, 0 above them.
    pub const fn raw(self, number: i64) -> u32 {
        self.integer(false).raw(number) as u32
    }
}

/// A parameter: its slot, menu and number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Parameter {
    /// 0 = the drive's own, 1 ... 4 = that of an option module; 4 is on-board Ethernet.
    pub slot: u8,
    /// Menu.
    pub menu: u8,
    /// Number within the menu.
    pub number: u8,
}

impl Parameter {
    /// The control word.
    pub const CONTROL_WORD: Parameter = Parameter::new(6, 42);
    /// Whether the control word is obeyed.
    pub const CONTROL_WORD_ENABLE: Parameter = Parameter::new(6, 43);
    /// The commanded speed: preset reference 1.
    pub const REFERENCE: Parameter = Parameter::new(1, 21);
    /// The source of the reference.
    pub const REFERENCE_SELECTOR: Parameter = Parameter::new(1, 14);
    /// The preset that is the reference.
    pub const PRESET_SELECTOR: Parameter = Parameter::new(1, 15);
    /// The speed of the motor.
    pub const SPEED: Parameter = Parameter::new(3, 2);
    /// The load.
    pub const LOAD: Parameter = Parameter::new(4, 20);
    /// The status word.
    pub const STATUS_WORD: Parameter = Parameter::new(10, 40);
    /// The most recent trip.
    pub const TRIP: Parameter = Parameter::new(10, 20);
    /// The firmware's version.
    pub const FIRMWARE: Parameter = Parameter::new(11, 29);

    /// The serial number: the lower nine digits, and those above them (assumed).
    pub const SERIAL: [Parameter; 2] = [Parameter::new(11, 52), Parameter::new(11, 53)];

    /// A parameter of the drive itself.
    pub const fn new(menu: u8, number: u8) -> Parameter {
        Parameter { slot: 0, menu, number }
    }

    /// The same of the module in `slot`.
    pub const fn in_slot(self, slot: u8) -> Parameter {
        Parameter { slot, ..self }
    }

    /// The address for access of this width; `None`: this addressing has none for it. Slots do not matter.
    pub const fn address(self, addressing: Addressing, width: Width) -> Option<u16> {
        if self.menu > addressing.menu_max() || self.number > addressing.number_max() {
            return None;
        }
        let place = self.menu as u16 * addressing.stride() + self.number as u16;
        // The drive adds 1 to the address: 00.000 cannot be addressed.
        let Some(address) = place.checked_sub(1) else { return None };
        Some(match width {
            Width::Word => address,
            Width::Long => address | LONG,
        })
    }

    /// Some addressing reaches it.
    pub const fn is_reached(self) -> bool {
        self.address(Addressing::Standard, Width::Word).is_some()
            || self.address(Addressing::Modified, Width::Word).is_some()
    }

    /// The parameter at an address; `None`: there is none. The slot is 0: see [`slot`].
    pub const fn from_address(address: u16, addressing: Addressing) -> Option<(Parameter, Width)> {
        if address & RESERVED != 0 {
            return None;
        }
        let width = if address & LONG == 0 { Width::Word } else { Width::Long };
        let place = (address & !LONG) + 1;
        let (menu, number) = (place / addressing.stride(), place % addressing.stride());
        if menu > addressing.menu_max() as u16 {
            return None;
        }
        Some((Parameter::new(menu as u8, number as u8), width))
    }

    /// The unit identifier, in a drive whose own is `drive`.
    pub const fn unit(self, drive: u8) -> u8 {
        if self.slot == 0 { drive } else { self.slot }
    }

    /// The parameter `count` numbers further in the same menu.
    pub const fn offset(self, count: u8) -> Option<Parameter> {
        match self.number.checked_add(count) {
            Some(number) => Some(Parameter { number, ..self }),
            None => None,
        }
    }

    /// The value of a set-up parameter of menu 22 that shows this one in menu 0: `menu.number` with three decimals
    /// (assumed). `None`: it cannot be shown there.
    pub const fn to_setup(self) -> Option<u16> {
        let setup = self.menu as u32 * 1000 + self.number as u32;
        if self.slot == 0 && setup <= catalogue::SETUP_MAX as u32 { Some(setup as u16) } else { None }
    }

    /// The parameter that a set-up parameter of menu 22 shows; `None`: there is no such parameter.
    pub const fn from_setup(setup: u16) -> Option<Parameter> {
        let (menu, number) = (setup / 1000, setup % 1000);
        if setup > catalogue::SETUP_MAX || number > u8::MAX as u16 {
            return None;
        }
        Some(Parameter::new(menu as u8, number as u8))
    }

    /// The catalogue's entry.
    pub fn known(self) -> Option<&'static ParameterInfo> {
        catalogue::find(self)
    }
}

/// The slot of a unit identifier: 0 for the drive itself; `None`: no slot has it; 254 is the interface.
pub const fn slot(unit: u8) -> Option<u8> {
    match unit {
        0 | DRIVE_UNIT => Some(0),
        1..=SLOT_MAX => Some(unit),
        _ => None,
    }
}

impl fmt::Display for Parameter {
    /// As `06.042` or `4.15.009`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.slot != 0 {
            write!(f, "{}.", self.slot)?;
        }
        write!(f, "{:02}.{:03}", self.menu, self.number)
    }
}

/// Text that is not a parameter.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
#[error(
    "no parameter; write menu.number with three digits of the number, 06.042, or slot.menu.number, 4.15.009"
)]
pub struct ParseError;
fieldbeat_core::debug_as_display!(ParseError);

impl FromStr for Parameter {
    type Err = ParseError;

    /// `06.042`, `6.042`, or with a slot 0 ... 4 `1.06.042`. Refused unless some addressing reaches it.
    fn from_str(text: &str) -> Result<Parameter, ParseError> {
        let mut parts = text.rsplit('.');
        let number = parts.next().and_then(|part| digits(part, 3, 3)).ok_or(ParseError)?;
        let menu = parts.next().and_then(|part| digits(part, 1, 3)).ok_or(ParseError)?;
        let slot = match parts.next() {
            Some(part) => digits(part, 1, 1).filter(|slot| *slot <= SLOT_MAX).ok_or(ParseError)?,
            None => 0,
        };
        let parameter = Parameter { slot, menu, number };
        if parts.next().is_none() && parameter.is_reached() { Ok(parameter) } else { Err(ParseError) }
    }
}

/// A number of so many digits and nothing else.
fn digits(text: &str, least: usize, most: usize) -> Option<u8> {
    decimal(text).filter(|_| (least..=most).contains(&text.len()))
}

#[cfg(test)]
mod tests;
