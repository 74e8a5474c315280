//! Parameters of a LinMot drive by their number (UPID), and how people write them.
//!
//! | address | value |
//! |---|---|
//! | `0x20A8`, `20A8h`, or a name of [`KNOWN`] | in RAM: in use now |
//! | `0x20A8.ram`, `0x20A8.rom` | in RAM, or in flash: in use after the next start |
//! | `0x20A8.both` | to write both |
//! | `0x20A8.min`, `.max`, `.default` | its limits and its default, to read |
//!
//! Only some UPIDs are known here, with type and unit; all others are numbers of 32 bits. Facts: sheet of the UPIDs
//! (SG5 manual, LinRS manual, masters in the field).

pub use super::motion::Upid;
use super::rtc;
use super::wire::RtcCommand;
use fieldbeat_core::axis::acyclic::{Call, Commanding, Integer, Quantity, Scale, hexadecimal};

/// The calls that command a drive.
pub(super) fn commanding() -> Commanding {
    Commanding::new(|call, _| rtc::refusal(call), [])
}

impl Upid {
    /// Written in RAM while power is on, it moves nothing, and changes no state: gains and feed-forwards, limits,
    /// predefined profiles, and what is monitored. All others may: the run mode (1450h), triggers and input functions,
    /// triggered targets, cams, scales and variables of commands. Of most UPIDs, the force mask of the control word
    /// among them, no public source says what they do: those count as commanding, too.
    pub(super) fn is_harmless(self) -> bool {
        matches!(
            self.0,
            0x13A0 | 0x13A2 | 0x13A6 | 0x13A8 | 0x13B4 | 0x13BA // Gains, feed-forwards, current limits.
                | 0x146E | 0x146F | 0x1473 | 0x1475 // Position and lag limits.
                | 0x14BE..=0x14C0 // The predefined profile, from the next command on.
                | 0x20A8..=0x20AB // Monitored variables.
        )
    }

    /// The first of the four sources of the monitoring channels (LinUDP V2 manual, 4.4.9).
    pub const MONITOR_SOURCE: Upid = Upid(0x20A8);

    /// The catalogue's entry.
    pub fn known(self) -> Option<&'static UpidInfo> {
        KNOWN.iter().find(|known| known.upid == self)
    }

    /// `0x20A8`, `20A8h`, or a known name.
    pub fn parse(text: &str) -> Option<Upid> {
        let hex = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
        let hex = hex.or_else(|| text.strip_suffix('h').or_else(|| text.strip_suffix('H')));
        match hex.and_then(hexadecimal).map(u16::try_from) {
            Some(Ok(upid)) => Some(Upid(upid)),
            _ => KNOWN.iter().find(|known| known.name == text).map(|known| known.upid),
        }
    }
}

impl std::fmt::Display for Upid {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "0x{:04X}", self.0)
    }
}

/// The type of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    /// Bit 0.
    Bool,
    /// 8 bits.
    U8,
    /// 8 bits, signed.
    S8,
    /// 16 bits.
    U16,
    /// 16 bits, signed.
    S16,
    /// 32 bits.
    U32,
    /// 32 bits, signed.
    S32,
    /// Four bytes of a text; the next four have the next UPID.
    Text,
}

impl Type {
    /// The numbers of its values.
    pub const fn integer(self) -> Integer {
        let (bits, signed) = match self {
            Type::Bool => (1, false),
            Type::U8 => (8, false),
            Type::S8 => (8, true),
            Type::U16 => (16, false),
            Type::S16 => (16, true),
            Type::U32 | Type::Text => (32, false),
            Type::S32 => (32, true),
        };
        Integer { bits, signed }
    }

    /// The lowest and the highest value.
    pub const fn range(self) -> (i64, i64) {
        self.integer().range()
    }

    /// The value of a raw one: smaller types are in the low bits. The other bits are not documented.
    pub const fn number(self, raw: u32) -> i64 {
        self.integer().number(raw as u64)
    }

    /// The same; `None` if the bits above are neither 0 nor the sign.
    pub fn strict_number(self, raw: u32) -> Option<i64> {
        self.integer().number_within(raw.into(), self.range())
    }

    /// The raw form of a value: its bits, and above them 0, or its sign if `extend`.
    pub const fn raw(self, value: i64, extend: bool) -> u32 {
        if extend { value as u32 } else { self.integer().raw(value) as u32 }
    }
}

/// The drive's report on how a parameter can be used (LinUDP V2 manual, UPID list).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Usage(pub u16);

impl Usage {
    /// Can be read from RAM.
    pub const RAM_READ: u16 = 1 << 0;
    /// Can be written to RAM.
    pub const RAM_WRITE: u16 = 1 << 1;
    /// Can be read from ROM.
    pub const ROM_READ: u16 = 1 << 2;
    /// Can be written to ROM.
    pub const ROM_WRITE: u16 = 1 << 3;
    /// A live parameter: a value in RAM takes effect at once.
    pub const LIVE: u16 = 1 << 8;
    /// Not part of the configuration's hash.
    pub const NOT_HASHED: u16 = 1 << 12;

    /// All of `bits` are set.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }
}

impl std::fmt::Display for Usage {
    /// As `rw rw live`: RAM, then ROM.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let flag = |bit, letter| if self.has(bit) { letter } else { '-' };
        let ram = [flag(Usage::RAM_READ, 'r'), flag(Usage::RAM_WRITE, 'w')];
        let rom = [flag(Usage::ROM_READ, 'r'), flag(Usage::ROM_WRITE, 'w')];
        write!(f, "{}{} {}{}", ram[0], ram[1], rom[0], rom[1])?;
        if self.has(Usage::LIVE) { f.write_str(" live") } else { Ok(()) }
    }
}

/// An entry of the catalogue of UPIDs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpidInfo {
    /// The number.
    pub upid: Upid,
    /// The name here.
    pub name: &'static str,
    /// The type.
    pub kind: Type,
    /// The quantity of its counts; without a unit they are plain numbers.
    pub quantity: Quantity,
}

impl UpidInfo {
    /// The scaled value of a raw one.
    pub fn value(&self, raw: u32) -> f64 {
        let number = self.kind.number(raw) as f64;
        match self.quantity.scale {
            Scale::Decimals(decimals) => number / f64::from(10_u32.pow(decimals)),
            // To two decimals.
            Scale::Linear { per_unit, zero } => ((number / per_unit + zero) * 100.0).round() / 100.0,
        }
    }
}

const fn known(upid: u16, name: &'static str, kind: Type, decimals: u32, unit: &'static str) -> UpidInfo {
    let quantity = Quantity { scale: Scale::Decimals(decimals), unit };
    UpidInfo { upid: Upid(upid), name, kind, quantity }
}

const fn number(upid: u16, name: &'static str, kind: Type) -> UpidInfo {
    known(upid, name, kind, 0, "")
}

const fn position(upid: u16, name: &'static str) -> UpidInfo {
    known(upid, name, Type::S32, 4, "mm")
}

const fn velocity(upid: u16, name: &'static str, kind: Type) -> UpidInfo {
    known(upid, name, kind, 3, "mm/s")
}

const fn acceleration(upid: u16, name: &'static str, kind: Type) -> UpidInfo {
    known(upid, name, kind, 2, "mm/s2")
}

/// The UPIDs that are known by name, in the order of their numbers. A type that no source states is the smallest
/// that fits the meaning.
pub const KNOWN: &[UpidInfo] = &[
    number(0x000C, "article-number", Type::Text),
    known(0x0082, "operating-hours-part", Type::U32, 0, "ms"),
    number(0x1039, "trigger-input", Type::U16),
    number(0x1393, "controller-set", Type::U16),
    number(0x13A0, "ff-acceleration-a", Type::U16),
    number(0x13A2, "p-gain-a", Type::U16),
    known(0x13A6, "max-current-a", Type::U16, 3, "A"),
    number(0x13A8, "d-gain-a", Type::U16),
    number(0x13B4, "ff-acceleration-b", Type::U16),
    known(0x13BA, "max-current-b", Type::U16, 3, "A"),
    position(0x13C7, "home-position"),
    position(0x13CA, "slider-home-position"),
    number(0x1450, "run-mode", Type::U16),
    number(0x1455, "position-scale-16", Type::U32),
    number(0x1456, "velocity-scale-16", Type::U32),
    number(0x1457, "acceleration-scale-16", Type::U32),
    number(0x1458, "deceleration-scale-16", Type::U32),
    position(0x145A, "trigger-rise-position"),
    velocity(0x145B, "trigger-rise-velocity", Type::U32),
    acceleration(0x145C, "trigger-rise-acceleration", Type::U32),
    acceleration(0x145D, "trigger-rise-deceleration", Type::U32),
    position(0x145F, "trigger-fall-position"),
    velocity(0x1460, "trigger-fall-velocity", Type::U32),
    acceleration(0x1461, "trigger-fall-acceleration", Type::U32),
    acceleration(0x1462, "trigger-fall-deceleration", Type::U32),
    position(0x146E, "minimum-position"),
    position(0x146F, "maximum-position"),
    known(0x1473, "lag-limit-moving", Type::U32, 4, "mm"),
    known(0x1475, "lag-limit-standing", Type::U32, 4, "mm"),
    velocity(0x14BE, "predefined-velocity", Type::U32),
    acceleration(0x14BF, "predefined-acceleration", Type::U32),
    acceleration(0x14C0, "predefined-deceleration", Type::U32),
    number(0x14E6, "streaming-period", Type::U32),
    number(0x1527, "cam-mode", Type::U16),
    number(0x1528, "cam-start-enable", Type::U16),
    number(0x170C, "trigger-mode", Type::U16),
    known(0x1B93, "demand-current", Type::S16, 3, "A"),
    number(0x1BA9, "cam-enabled", Type::Bool),
    known(0x1BCD, "core-temperature", Type::S16, 1, "C"),
    known(0x1BCE, "drive-temperature", Type::S16, 1, "C"),
    number(0x1BDD, "power-loss", Type::U16),
    // The low 16 bits, raw x 250/255 - 50 (a master in the field).
    UpidInfo {
        quantity: Quantity { scale: Scale::Linear { per_unit: 255.0 / 250.0, zero: -50.0 }, unit: "C" },
        ..number(0x1BF3, "motor-temperature", Type::U16)
    },
    number(0x1C00, "temperature-reserve", Type::S16),
    number(0x1C1B, "commutation-found", Type::S16),
    known(0x1CAF, "drive-timer", Type::U32, 0, "us"),
    number(0x1D51, "status-word", Type::U16),
    number(0x1DB0, "motion-count", Type::U16),
    position(0x1E0A, "target-position"),
    velocity(0x1E0B, "velocity-limit", Type::U32),
    acceleration(0x1E0C, "acceleration-limit", Type::U32),
    acceleration(0x1E0D, "deceleration-limit", Type::U32),
    position(0x1E0E, "demand-position"),
    velocity(0x1E0F, "demand-velocity", Type::S32),
    acceleration(0x1E10, "demand-acceleration", Type::S32),
    position(0x1E62, "captured-position"),
    number(0x1E72, "variable-1", Type::S32),
    number(0x1E73, "variable-2", Type::S32),
    number(0x20A8, "monitor-source-1", Type::U16),
    number(0x20A9, "monitor-source-2", Type::U16),
    number(0x20AA, "monitor-source-3", Type::U16),
    number(0x20AB, "monitor-source-4", Type::U16),
    number(0x6300, "mode-in-state-6", Type::U16),
];

/// One of the values of a UPID.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variant {
    /// In use now.
    Ram,
    /// In flash.
    Rom,
    /// RAM and ROM, to write.
    Both,
    /// The lowest value that the drive accepts.
    Minimum,
    /// The highest value that the drive accepts.
    Maximum,
    /// After a reset to default.
    Default,
}

impl Variant {
    /// Each with its word, and the commands that read and write it.
    const ALL: [(Variant, &'static str, Option<RtcCommand>, Option<RtcCommand>); 6] = [
        (Variant::Ram, "ram", Some(RtcCommand::READ_RAM), Some(RtcCommand::WRITE_RAM)),
        (Variant::Rom, "rom", Some(RtcCommand::READ_ROM), Some(RtcCommand::WRITE_ROM)),
        (Variant::Both, "both", None, Some(RtcCommand::WRITE_BOTH)),
        (Variant::Minimum, "min", Some(RtcCommand::READ_MINIMUM), None),
        (Variant::Maximum, "max", Some(RtcCommand::READ_MAXIMUM), None),
        (Variant::Default, "default", Some(RtcCommand::READ_DEFAULT), None),
    ];

    /// The command that reads it.
    pub const fn read(self) -> Option<RtcCommand> {
        Variant::ALL[self as usize].2
    }

    /// The command that writes it.
    pub const fn write(self) -> Option<RtcCommand> {
        Variant::ALL[self as usize].3
    }
}

/// A UPID and one of its values, as people write them.
pub fn address(text: &str) -> Option<(Upid, Variant)> {
    let (upid, word) = text.rsplit_once('.').unwrap_or((text, "ram"));
    let (variant, ..) = Variant::ALL.iter().find(|(_, known, ..)| *known == word)?;
    Some((Upid::parse(upid)?, *variant))
}

/// A call on the real-time-config channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RtcCall {
    /// The command.
    pub command: RtcCommand,
    /// Word 2: a UPID, a curve, an entry.
    pub index: u16,
    /// Words 3 and 4.
    pub value: u32,
}

impl RtcCall {
    /// That of a call, which has room for more.
    pub const fn of(&Call { service, address, value }: &Call) -> RtcCall {
        RtcCall { command: RtcCommand(service as u8), index: address as u16, value: value as u32 }
    }
}

impl From<RtcCall> for Call {
    fn from(RtcCall { command, index, value }: RtcCall) -> Call {
        call(command, index, value)
    }
}

/// The call with this command, word 2, and words 3 and 4.
pub const fn call(command: RtcCommand, index: u16, value: u32) -> Call {
    Call { service: command.0 as u32, address: index as u32, value: value as u64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_known_ones_are_in_order_and_have_names_of_their_own() {
        assert!(KNOWN.windows(2).all(|pair| pair[0].upid < pair[1].upid));
        for known in KNOWN {
            assert_eq!(Upid::parse(known.name), Some(known.upid));
            assert_eq!(known.upid.known().map(|known| known.name), Some(known.name));
        }
    }

    #[test]
    fn addresses_are_read_in_every_form() {
        for text in ["0x20A8", "20A8h", "0x20a8", "monitor-source-1", "20a8H"] {
            assert_eq!(address(text), Some((Upid(0x20A8), Variant::Ram)), "{text}");
        }
        assert_eq!(address("0x20A8.rom"), Some((Upid(0x20A8), Variant::Rom)));
        assert_eq!(address("demand-velocity.max"), Some((Upid(0x1E0F), Variant::Maximum)));
        for text in
            ["", "20A8", "0x", "h", "0x+20A", "0x120A8", "0x20A8.", "0x20A8.eeprom", ".rom", "speed", "0x-1"]
        {
            assert_eq!(address(text), None, "{text}");
        }
    }

    #[test]
    fn a_value_is_of_its_type_or_it_is_none() {
        for (kind, raw, value) in [
            (Type::Bool, 1, Some(1)),
            (Type::Bool, 2, None),
            (Type::U8, 255, Some(255)),
            (Type::U8, 256, None),
            (Type::S8, 0x80, Some(-128)),
            (Type::S8, 0xFFFF_FF80, Some(-128)),
            (Type::S8, 0x7F, Some(127)),
            (Type::S8, 0x0100, None),
            (Type::U16, 0xFFFF, Some(0xFFFF)),
            (Type::U16, 0x1_0000, None),
            (Type::S16, 0xFFFF, Some(-1)),
            (Type::S16, 0xFFFF_FFFF, Some(-1)),
            (Type::S16, 0xFFFE_FFFF, None),
            (Type::U32, u32::MAX, Some(i64::from(u32::MAX))),
            (Type::S32, u32::MAX, Some(-1)),
            (Type::Text, u32::MAX, Some(i64::from(u32::MAX))),
        ] {
            assert_eq!(kind.strict_number(raw), value, "{kind:?} {raw:X}h");
            if let Some(value) = value {
                let (low, high) = kind.range();
                assert!((low..=high).contains(&value));
                assert_eq!(kind.strict_number(kind.raw(value, false)), Some(value));
                assert_eq!(kind.strict_number(kind.raw(value, true)), Some(value));
            }
        }
        assert_eq!((Type::S16.raw(-1, false), Type::S16.raw(-1, true)), (0xFFFF, 0xFFFF_FFFF));
    }
}
