//! What is known of single codes of a Lenze drive: those that the fact sheet names, and the ramp times. A drive has
//! many more, and checks every value itself.

use super::target::{Kind, Parameter};
use fieldbeat_core::axis::acyclic::Quantity;

/// The decimals of a code that is not here: most values of these drives are 32 bits with four of them (EMF2133IB
/// manual). Newer drives have other factors.
pub const DECIMALS: u32 = 4;

/// An entry of the catalogue of codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CodeInfo {
    /// The number.
    pub code: u16,
    /// The highest subcode; 0: it has none.
    pub subcodes: u8,
    /// The name.
    pub name: &'static str,
    /// The kind of its value on the wire.
    pub kind: Kind,
    /// One count is `10^-decimals` of the unit.
    pub decimals: u32,
    /// The unit of the scaled value; empty for a plain number.
    pub unit: &'static str,
    /// It cannot be written.
    pub read_only: bool,
    /// The decimals of a value that the drive reports in 16 bits; `None`: they are not known.
    pub word_decimals: Option<u32>,
}

impl CodeInfo {
    const fn new(code: u16, name: &'static str, unit: &'static str) -> CodeInfo {
        let (kind, decimals) = (Kind::I32, DECIMALS);
        CodeInfo { code, subcodes: 0, name, kind, decimals, unit, read_only: false, word_decimals: None }
    }
}

/// The codes (EMF2133IB and E82ZAFPC manuals; the ramp times, the subcodes of C0039, and the unit of the fixed set
/// points of a drive that is not an 8200, are assumed).
pub const CODES: [CodeInfo; 6] = [
    CodeInfo::new(3, "automatic saving: 0 keeps cyclic writes off the EEPROM", ""),
    CodeInfo::new(11, "full speed: 100 % of the set point", ""),
    CodeInfo::new(12, "acceleration time of the main set point", "s"),
    CodeInfo::new(13, "deceleration time of the main set point", "s"),
    CodeInfo { subcodes: 3, ..CodeInfo::new(39, "fixed set points (JOG)", "Hz") },
    // The 9400 reports 43 degrees as 43 (E94AYCPM manual).
    CodeInfo {
        read_only: true,
        word_decimals: Some(0),
        ..CodeInfo::new(61, "temperature of the heat sink", "°C")
    },
];

impl Parameter {
    /// The catalogue's entry.
    pub fn known(self) -> Option<&'static CodeInfo> {
        CODES.iter().find(|known| known.code == self.code)
    }

    /// The kind of its value on the wire.
    pub fn kind(self) -> Kind {
        match self.kind {
            Kind::Own => self.known().map_or(Kind::I32, |known| known.kind),
            kind => kind,
        }
    }

    /// The quantity: of a kind that is named that is not known, but for some in 16 bits.
    pub fn quantity(self) -> Option<Quantity> {
        let known = self.known();
        let (decimals, unit) = match self.kind {
            Kind::Own => known.map_or((DECIMALS, ""), |known| (known.decimals, known.unit)),
            Kind::I16 | Kind::U16 => known.and_then(|known| Some((known.word_decimals?, known.unit)))?,
            _ => return None,
        };
        Quantity::decimals(decimals, unit)
    }
}
