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

use std::time::Duration;

pub use super::motion::Upid;
use super::rtc;
use super::wire::{Refusal, RtcCommand};
use crate::axis::acyclic::{Call, Commanding, Notation, NotationError};

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

    /// What is known of it.
    pub fn known(self) -> Option<&'static Known> {
        KNOWN.iter().find(|known| known.upid == self)
    }

    /// `0x20A8`, `20A8h`, or a known name.
    pub fn parse(text: &str) -> Option<Upid> {
        let hex = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
        let hex = hex.or_else(|| text.strip_suffix('h').or_else(|| text.strip_suffix('H')));
        match hex.filter(|digits| !digits.starts_with('+')).map(|digits| u16::from_str_radix(digits, 16)) {
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
    /// Bits of a value, and whether it has a sign.
    const fn shape(self) -> (u32, bool) {
        match self {
            Type::Bool => (1, false),
            Type::U8 => (8, false),
            Type::S8 => (8, true),
            Type::U16 => (16, false),
            Type::S16 => (16, true),
            Type::U32 | Type::Text => (32, false),
            Type::S32 => (32, true),
        }
    }

    /// The lowest and the highest value.
    pub const fn range(self) -> (i64, i64) {
        match self.shape() {
            (bits, true) => (-(1 << (bits - 1)), (1 << (bits - 1)) - 1),
            (bits, false) => (0, (1 << bits) - 1),
        }
    }

    /// The value of a raw one: smaller types are in the low bits. The other bits are not documented.
    pub const fn number(self, raw: u32) -> i64 {
        let (bits, signed) = self.shape();
        let above = 32 - bits;
        match signed {
            true => ((raw << above) as i32 >> above) as i64,
            false => (raw << above >> above) as i64,
        }
    }

    /// The same; `None` if the bits above are neither 0 nor the sign.
    pub fn strict_number(self, raw: u32) -> Option<i64> {
        let (value, above) = (self.number(raw), 32 - self.shape().0);
        (raw == value as u32 || raw == raw << above >> above).then_some(value)
    }

    /// The raw form of a value: its bits, and above them 0, or its sign if `extend`.
    pub const fn raw(self, value: i64, extend: bool) -> u32 {
        let above = 32 - self.shape().0;
        if extend { value as u32 } else { (value as u32) << above >> above }
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
        let access = |read, write| match (self.has(read), self.has(write)) {
            (true, true) => "rw",
            (true, false) => "r-",
            (false, true) => "-w",
            (false, false) => "--",
        };
        write!(
            f,
            "{} {}",
            access(Usage::RAM_READ, Usage::RAM_WRITE),
            access(Usage::ROM_READ, Usage::ROM_WRITE)
        )?;
        if self.has(Usage::LIVE) { f.write_str(" live") } else { Ok(()) }
    }
}

/// How a raw value becomes one in its unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// One count is `10^-n` of the unit.
    Decimals(u32),
    /// Of the motor temperature: raw x 250/255 - 50 (a master in the field), to two decimals.
    MotorTemperature,
}

/// What is known of a UPID.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Known {
    /// Its number.
    pub upid: Upid,
    /// Its name here.
    pub name: &'static str,
    /// Its type.
    pub kind: Type,
    /// What a count of the drive is in the unit below.
    pub scale: Scale,
    /// The unit of the scaled value; empty for a plain number.
    pub unit: &'static str,
}

impl Known {
    /// The scaled value of a raw one.
    pub fn value(&self, raw: u32) -> f64 {
        let number = self.kind.number(raw) as f64;
        match self.scale {
            Scale::Decimals(decimals) => number / f64::from(10_u32.pow(decimals)),
            Scale::MotorTemperature => ((number * 250.0 / 255.0 - 50.0) * 100.0).round() / 100.0,
        }
    }
}

const fn known(upid: u16, name: &'static str, kind: Type, decimals: u32, unit: &'static str) -> Known {
    Known { upid: Upid(upid), name, kind, scale: Scale::Decimals(decimals), unit }
}

const fn number(upid: u16, name: &'static str, kind: Type) -> Known {
    known(upid, name, kind, 0, "")
}

const fn position(upid: u16, name: &'static str) -> Known {
    known(upid, name, Type::S32, 4, "mm")
}

const fn velocity(upid: u16, name: &'static str, kind: Type) -> Known {
    known(upid, name, kind, 3, "mm/s")
}

const fn acceleration(upid: u16, name: &'static str, kind: Type) -> Known {
    known(upid, name, kind, 2, "mm/s2")
}

/// The UPIDs that are known by name, in the order of their numbers. A type that no source states is the smallest
/// that fits the meaning.
pub const KNOWN: &[Known] = &[
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
    // The low 16 bits.
    Known { scale: Scale::MotorTemperature, ..known(0x1BF3, "motor-temperature", Type::U16, 0, "C") },
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
    const WORDS: [(&'static str, Variant); 6] = [
        ("ram", Variant::Ram),
        ("rom", Variant::Rom),
        ("both", Variant::Both),
        ("min", Variant::Minimum),
        ("max", Variant::Maximum),
        ("default", Variant::Default),
    ];

    /// The command that reads it.
    pub const fn read(self) -> Option<RtcCommand> {
        match self {
            Variant::Ram => Some(RtcCommand::READ_RAM),
            Variant::Rom => Some(RtcCommand::READ_ROM),
            Variant::Both => None,
            Variant::Minimum => Some(RtcCommand::READ_MINIMUM),
            Variant::Maximum => Some(RtcCommand::READ_MAXIMUM),
            Variant::Default => Some(RtcCommand::READ_DEFAULT),
        }
    }

    /// The command that writes it.
    pub const fn write(self) -> Option<RtcCommand> {
        match self {
            Variant::Ram => Some(RtcCommand::WRITE_RAM),
            Variant::Rom => Some(RtcCommand::WRITE_ROM),
            Variant::Both => Some(RtcCommand::WRITE_BOTH),
            Variant::Minimum | Variant::Maximum | Variant::Default => None,
        }
    }
}

/// A UPID and one of its values, as people write them.
pub fn address(text: &str) -> Option<(Upid, Variant)> {
    let (upid, variant) = match text.rsplit_once('.') {
        Some((upid, word)) => {
            (upid, Variant::WORDS.iter().find(|(known, _)| *known == word).map(|(_, variant)| *variant)?)
        }
        None => (text, Variant::Ram),
    };
    Some((Upid::parse(upid)?, variant))
}

/// A call on the real-time-config channel: command, word 2, words 3 and 4.
pub const fn call(command: RtcCommand, index: u16, value: u32) -> Call {
    Call { service: command.0 as u32, address: index as u32, value: value as u64 }
}

const FORM: &str =
    "0x20A8, 20A8h or a name, with .rom, .both, .min, .max or .default for another value than that in RAM";

/// Time limit for reading a value, or writing one to RAM.
const RAM_LIMIT: Duration = Duration::from_secs(1);
/// Time limit for writing one to flash: the drive may stall meanwhile (sheet, 5.6), for how long is not known. As
/// long as stopping its software.
const FLASH_LIMIT: Duration = Duration::from_secs(20);

/// Addresses and values of LinMot drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Upids;

impl Upids {
    fn find(text: &str) -> Result<(Upid, Variant), NotationError> {
        address(text).ok_or(NotationError::Address { form: FORM })
    }

    fn kind(text: &str) -> Type {
        address(text).and_then(|(upid, _)| upid.known()).map_or(Type::U32, |known| known.kind)
    }
}

impl Notation for Upids {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn read(&self, address: &str) -> Result<Call, NotationError> {
        let (upid, variant) = Upids::find(address)?;
        // A value written to both reads the same from either.
        let command = variant.read().unwrap_or(RtcCommand::READ_RAM);
        Ok(call(command, upid.0, 0))
    }

    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let (upid, variant) = Upids::find(address)?;
        let instead = "the UPID itself, .rom or .both";
        let command = variant.write().ok_or(NotationError::ReadOnly { instead })?;
        let value = u32::try_from(value).map_err(|_| NotationError::Value {
            value: value.to_string(),
            form: "a number of 32 bits".to_owned(),
        })?;
        Ok(call(command, upid.0, value))
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let (upid, _) = Upids::find(address)?;
        let known = upid.known();
        let (low, high) = match known {
            Some(known) => known.kind.range(),
            // Of whatever sign: the bits are the same.
            None => (i64::from(i32::MIN), i64::from(u32::MAX)),
        };
        let number = match text {
            "true" => Some(1),
            "false" => Some(0),
            _ => match text.strip_prefix("0x") {
                // The bits as they stand.
                Some(digits) if !digits.starts_with(['+', '-']) => {
                    i64::from_str_radix(digits, 16).ok().map(|bits| {
                        let raw = u32::try_from(bits).ok();
                        // Bits that the type does not have are out of its range.
                        raw.map_or(Some(bits), |raw| {
                            known.map_or(Some(bits), |known| known.kind.strict_number(raw))
                        })
                        .unwrap_or(bits)
                    })
                }
                _ => text.parse().ok(),
            },
        };
        match number {
            // Cut to 32 bits, as a signed value is sent.
            Some(number) if (low..=high).contains(&number) => Ok(u64::from(number as u32)),
            Some(_) => Err(NotationError::Range { value: text.to_owned(), low, high }),
            None => Err(NotationError::Value {
                value: text.to_owned(),
                form: format!("a whole number, {low} ... {high}, or its bits as 0x..."),
            }),
        }
    }

    fn number(&self, address: &str, raw: u64) -> i64 {
        Upids::kind(address).number(raw as u32)
    }

    fn show(&self, text: &str, raw: u64) -> String {
        let raw = raw as u32;
        match address(text).and_then(|(upid, _)| upid.known()) {
            Some(Known { kind: Type::Text, .. }) => {
                let letters = raw.to_le_bytes().map(char::from);
                let letters: String = letters.into_iter().filter(char::is_ascii_graphic).collect();
                format!("\"{letters}\" (0x{raw:X})")
            }
            Some(known) if known.unit.is_empty() => format!("{} (0x{raw:X})", known.kind.number(raw)),
            Some(known) => {
                format!("{} (0x{raw:X}) = {} {}", known.kind.number(raw), known.value(raw), known.unit)
            }
            None => format!("{raw} (0x{raw:X})"),
        }
    }

    fn reason(&self, status: u32) -> String {
        // The channel refuses with a status byte.
        Refusal::of(status as u8).to_string()
    }

    fn limit(&self, call: &Call) -> Duration {
        match RtcCommand(call.service as u8) {
            RtcCommand::WRITE_ROM | RtcCommand::WRITE_BOTH => FLASH_LIMIT,
            _ => RAM_LIMIT,
        }
    }

    fn read_back(&self, text: &str) -> Vec<String> {
        match address(text) {
            Some((upid, Variant::Both)) => vec![upid.to_string(), format!("{upid}.rom")],
            _ => vec![text.to_owned()],
        }
    }

    fn is_same(&self, text: &str, written: u64, read: u64) -> bool {
        let (written, read) = (written as u32, read as u32);
        // A drive keeps as much of a value as the parameter has room for, with or without its sign above.
        let kinds = match address(text).and_then(|(upid, _)| upid.known()) {
            Some(known) => &[known.kind][..],
            None => &[Type::U32, Type::S16, Type::S8][..],
        };
        let values = |kind: &Type| (kind.strict_number(written), kind.strict_number(read));
        kinds.iter().any(|kind| matches!(values(kind), (Some(written), Some(read)) if written == read))
    }
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
    fn each_variant_has_its_command() {
        let read = |text: &str| Upids.read(text).map(|call| (call.service, call.address));
        assert_eq!(read("0x20A8"), Ok((0x11, 0x20A8)));
        assert_eq!(read("0x20A8.rom"), Ok((0x10, 0x20A8)));
        assert_eq!(read("0x20A8.min"), Ok((0x15, 0x20A8)));
        assert_eq!(read("0x20A8.max"), Ok((0x16, 0x20A8)));
        assert_eq!(read("0x20A8.default"), Ok((0x17, 0x20A8)));
        let write = |text: &str| Upids.write(text, 7).map(|call| (call.service, call.value));
        assert_eq!(write("0x20A8"), Ok((0x13, 7)));
        assert_eq!(write("0x20A8.rom"), Ok((0x12, 7)));
        assert_eq!(write("0x20A8.both"), Ok((0x14, 7)));
        assert!(matches!(write("0x20A8.min"), Err(NotationError::ReadOnly { .. })));
        assert!(matches!(Upids.write("0x20A8", 1 << 32), Err(NotationError::Value { .. })));
    }

    #[test]
    fn values_keep_their_sign_and_their_range() {
        for (address, text, raw) in [
            ("home-position", "-5", 0xFFFF_FFFB),
            ("home-position", "0xFFFFFFFB", 0xFFFF_FFFB),
            ("monitor-source-1", "0x1E0F", 0x1E0F),
            ("cam-enabled", "true", 1),
            ("0x3000", "4294967295", 0xFFFF_FFFF),
            ("0x3000", "-1", 0xFFFF_FFFF),
        ] {
            assert_eq!(Upids.value(address, text), Ok(raw), "{address} {text}");
        }
        for (address, text) in [
            ("monitor-source-1", "65536"),
            ("monitor-source-1", "-1"),
            ("monitor-source-1", "0x11E0F"),
            ("0x3000", "4294967296"),
            ("0x3000", "0x100000000"),
        ] {
            let wrong = Upids.value(address, text);
            assert!(matches!(wrong, Err(NotationError::Range { .. })), "{address} {text}: {wrong:?}");
        }
        for (address, text) in [
            ("home-position", "1.5"),
            ("0x3000", ""),
            ("0x3000", "0x+5"),
            ("0x3000", "0x-5"),
            ("0x3000", "12mm"),
            ("0x3000", "99999999999999999999"),
        ] {
            let wrong = Upids.value(address, text);
            assert!(matches!(wrong, Err(NotationError::Value { .. })), "{address} {text}: {wrong:?}");
        }
        assert_eq!(Upids.show("home-position", 0xFFFF_FFFB), "-5 (0xFFFFFFFB) = -0.0005 mm");
        assert_eq!(Upids.show("0x20A8", 0x1E0F), "7695 (0x1E0F)");
        assert_eq!(Upids.show("article-number", 0x4C45_4946), "\"FIEL\" (0x4C454946)");
        assert_eq!(Upids.number("core-temperature", 0xFFFE), -2);
        for (raw, celsius) in [(0, -50.0), (51, 0.0), (82, 30.39), (255, 200.0), (0x7_0052, 30.39)] {
            assert_eq!(Upid(0x1BF3).known().map(|known| known.value(raw)), Some(celsius), "{raw}");
        }
        assert_eq!(Upids.show("motor-temperature", 82), "82 (0x52) = 30.39 C");
        assert!(Upids.reason(0xC0).contains("no such UPID"));
    }

    #[test]
    fn what_is_written_to_flash_is_given_its_time() {
        let limit = |text: &str| Upids.write(text, 7).map(|call| Upids.limit(&call));
        assert_eq!(limit("0x20A8"), Ok(RAM_LIMIT));
        assert_eq!(limit("0x20A8.rom"), Ok(FLASH_LIMIT));
        assert_eq!(limit("0x20A8.both"), Ok(FLASH_LIMIT));
        assert_eq!(Upids.read("0x20A8.rom").map(|call| Upids.limit(&call)), Ok(RAM_LIMIT));
    }

    #[test]
    fn what_was_written_is_known_again_in_both_memories_and_in_every_size() {
        assert_eq!(Upids.read_back("monitor-source-1.both"), ["0x20A8", "0x20A8.rom"]);
        assert_eq!(Upids.read_back("monitor-source-1.rom"), ["monitor-source-1.rom"]);
        for (address, written, read, same) in [
            // Of a type that nobody knows here: what a parameter of 16 or 8 bits makes of it.
            ("0x3100", 0xFFFF_FFFF, 0xFFFF_FFFF, true),
            ("0x3100", 0xFFFF_FFFF, 0xFFFF, true),
            ("0x3100", 0xFFFF_FFFF, 0xFF, true),
            ("0x3100", 0xFFFF_FFFE, 0xFFFF, false),
            ("0x3100", 0xFFFF, 0xFFFF_FFFF, true),
            ("0x3100", 0x12345, 0x2345, false),
            ("0x3100", 0x1_0000, 0, false),
            ("0x3100", 5, 5, true),
            ("0x3100", 5, 6, false),
            ("home-position", 0xFFFF_FFFF, 0xFFFF, false),
            ("monitor-source-1", 0x1E0F, 0x1E0F, true),
            ("core-temperature", 0xFFFF_FFFE, 0xFFFE, true),
        ] {
            assert_eq!(Upids.is_same(address, written, read), same, "{address} {written:X}h {read:X}h");
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
