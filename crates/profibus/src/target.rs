//! What an acyclic call to a drive does: its address and its status as numbers, and the meaning of the status.
//!
//! | target | services | value |
//! |---|---|---|
//! | a code as a number | `READ`, `WRITE` | the raw bits of its kind |
//! | a code as a text, a record | `READ`, then `SIZE` and `PART`; `LOAD`, then `STORE` | bytes |

use std::borrow::Cow;

use super::plan::Numbers;
use super::wire::base_mode::Format;
use super::wire::drivecom::{ErrorCode, index_of};
use super::wire::errors::ErrorNumber;
use super::wire::fc;
pub use super::wire::job::Kind;
use super::wire::msac1::{Record, Refusal};
use fieldbeat_core::axis::acyclic::long::{self, Target as _};
use fieldbeat_core::axis::acyclic::{Call, CallError, Commanding};

/// A code of the drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Parameter {
    /// The number.
    pub code: u16,
    /// The subcode; 0: it has none.
    pub sub: u8,
    /// The kind that its value is taken for.
    pub kind: Kind,
}

impl Parameter {
    /// The value that a reply has in this format, and what it is: its raw bits, extended to 32 where the address does
    /// not say how many it has. An address that says something else is refused, with this status.
    pub(super) fn reported(self, format: Format, raw: u64) -> Result<(u32, Kind), u32> {
        let expected = self.kind();
        let signed = expected.integer().is_some_and(|integer| integer.signed);
        let kind = format.kind(signed).ok_or(BROKEN)?;
        match kind.integer() {
            Some(integer) if self.kind == Kind::Own => Ok((integer.number(raw) as u32, kind)),
            Some(integer) if self.kind == kind => Ok((integer.raw(raw.cast_signed()) as u32, kind)),
            _ => Err(contradicts(expected, format)),
        }
    }
}

/// The address of a call behind its answer, which says what its value is: where the address itself does not, and the
/// catalogue says something else.
pub(super) fn learned(address: u32, kind: Kind) -> u32 {
    match Target::unpack(address).and_then(Target::parameter) {
        Some(own) if own.kind == Kind::Own && kind != Kind::Own && kind != own.kind() => {
            Target::Parameter(Parameter { kind, ..own }).pack()
        }
        _ => address,
    }
}

impl Numbers {
    /// The index of a code in a parameter request; `None`: it has none.
    pub const fn index(self, code: u16) -> Option<u16> {
        match self {
            Numbers::FromTop => index_of(code),
            Numbers::Code if code > 0 => Some(code),
            Numbers::Code => None,
        }
    }
}

/// The target that a call reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Target {
    /// A code.
    Parameter(Parameter),
    /// A record of the module, by MSAC1.
    Record(Record),
}

/// The highest byte of the address of a record.
const RECORD: u8 = 0xFF;

impl long::Target for Target {
    fn pack(self) -> u32 {
        match self {
            Target::Parameter(Parameter { code, sub, kind }) => {
                let [high, low] = code.to_be_bytes();
                u32::from_be_bytes([kind as u8, high, low, sub])
            }
            Target::Record(Record { slot, index }) => u32::from_be_bytes([RECORD, 0, slot, index]),
        }
    }

    fn unpack(address: u32) -> Option<Target> {
        match address.to_be_bytes() {
            [RECORD, 0, slot, index] => Some(Target::Record(Record { slot, index })),
            [kind, high, low, sub] => {
                let kind = Kind::ALL.into_iter().find(|of| *of as u8 == kind)?;
                Some(Target::Parameter(Parameter { code: u16::from_be_bytes([high, low]), sub, kind }))
            }
        }
    }
}

impl Target {
    /// The code, if it is one.
    pub(super) fn parameter(self) -> Option<Parameter> {
        match self {
            Target::Parameter(parameter) => Some(parameter),
            Target::Record(_) => None,
        }
    }
}

/// The service of a call.
pub type Service = long::Service<Target>;

/// The calls that command a drive.
pub(super) fn commanding() -> Commanding {
    Commanding::new(refusal, [])
}

/// Why a call of the application is refused while the power of its drive is on: it writes what is not known to be
/// harmless.
fn refusal(call: &Call, _mapped: &[u32]) -> Option<CallError> {
    let is_harmless = |parameter: Parameter| HARMLESS.contains(&parameter.code);
    let commands = !Service::written(call)?.parameter().is_some_and(is_harmless);
    commands.then_some(CallError::Commands)
}

/// Written while power is on, they move nothing, and change no state: automatic saving (C0003; sheet, 2), and the time
/// of the acceleration ramp (C0012; assumed). All others may: C0011 is the speed of a full set point, C0039 has the
/// fixed set points (sheet, 1 and 4), and a long deceleration ramp (C0013; assumed) lets a motor run on behind a stop.
/// No document at hand says which codes are control words, operating modes and sources of the set point, so that each
/// code that is not here may be one; any record may have one in it.
const HARMLESS: [u16; 2] = [3, 12];

/// Statuses of the drive's own: an [`ErrorNumber`] as it is, a [DRIVECOM error](ErrorCode) of class 1 ... 15 as it is.
/// The others are marked in their upper four bits.
const CLASSES: std::ops::RangeInclusive<u32> = 0x0100_0000..=0x0FFF_FFFF;
const MARK: u32 = 0xF000_0000;
/// A refusal by MSAC1: its three bytes.
const MSAC1: u32 = 0x1000_0000;
/// This side's own.
const OWN: u32 = 0x2000_0000;
/// The link layer of the drive refused it: the function of its answer.
const LINK: u32 = 0x3000_0000;
/// A DRIVECOM error of another class: the rest of it.
const OTHER: u32 = 0x4000_0000;

/// The drive's reply is of another kind than its address: the kind, and the format of the reply.
const KIND: u32 = 0x5000_0000;

/// There is no such call for this address.
pub const NO_CALL: u32 = OWN;
/// The code is beyond those of the path to the drive's parameters.
pub const UNREACHABLE: u32 = OWN + 1;
/// There is no path.
pub const NO_PATH: u32 = OWN + 2;
/// DP-V1 is not enabled in its parametrisation.
pub(crate) const NO_DPV1: u32 = OWN + 3;
/// Texts are not in a channel of the process data.
pub(crate) const NO_TEXT: u32 = OWN + 4;
/// The answer is none.
pub const BROKEN: u32 = OWN + 5;
/// There is no such part of what was read before.
pub const NOT_READ: u32 = OWN + 6;
/// The value handed over to be written is not whole.
pub const NOT_LOADED: u32 = OWN + 7;

/// The answer to a write is none.
pub const BROKEN_WRITE: u32 = OWN + 8;

/// The meanings of this side's own statuses, in their order.
const OWN_REASONS: [&str; 9] = [
    "it cannot be read or written so: texts and records are written whole, and have parts",
    "there is no such code on the drive's path of parameters: look at `parameters.path`",
    "the drive has no path of parameters: set `parameters.path`",
    "DP-V1 is not enabled: set bit 7 of the first byte of `user_prm`",
    "the channel in the process data has no texts: they need `parameters.path = \"msac1\"`",
    "the drive's answer cannot be understood",
    "there is no such part of the data read before",
    "the value to be written was not handed over as a whole",
    "the drive's answer cannot be understood; what was to be written may have been written",
];

/// The status of an error number.
pub(super) fn number(error: ErrorNumber) -> u32 {
    error.0.into()
}

/// The status of a DRIVECOM error.
pub(super) fn drivecom(error: ErrorCode) -> u32 {
    if CLASSES.contains(&error.0) { error.0 } else { OTHER | error.0 & !MARK }
}

/// The status of a refusal by MSAC1.
pub(super) fn msac1(why: Refusal) -> u32 {
    MSAC1 | u32::from_be_bytes([0, why.decode, why.code_1, why.code_2])
}

/// The status of a refusal by the link layer.
pub(super) fn link(function: u8) -> u32 {
    LINK | u32::from(function)
}

/// The status of a reply in this format to an address of that kind.
pub(super) fn contradicts(expected: Kind, format: Format) -> u32 {
    KIND | u32::from_be_bytes([0, 0, expected as u8, format.0])
}

/// Why a reply in this format is none to an address of that kind.
fn contradiction(expected: u8, format: Format) -> String {
    let named = Kind::ALL.into_iter().find(|kind| *kind as u8 == expected);
    let kinds = [true, false].map(|signed| format.kind(signed).map_or("", Kind::name));
    let fits = if kinds[0] == kinds[1] { kinds[0].to_owned() } else { kinds.join(" or .") };
    format!(
        "the drive reports {format}, and its address says {}: write .{fits} behind the code",
        named.map_or("something else", Kind::name)
    )
}

/// The meaning of a status.
pub(super) fn reason(status: u32) -> Cow<'static, str> {
    let [_, decode, code_1, code_2] = status.to_be_bytes();
    let rest = status & !MARK;
    match status & MARK {
        _ if status <= 0xFFFF => ErrorNumber(status as u16).to_string().into(),
        _ if CLASSES.contains(&status) => ErrorCode(status).to_string().into(),
        OWN => match OWN_REASONS.get(rest as usize) {
            Some(reason) => (*reason).into(),
            None => format!("status {status:#x}").into(),
        },
        MSAC1 => Refusal { decode, code_1, code_2 }.to_string().into(),
        LINK => format!("the module refused it with {}", fc::refusal(code_2)).into(),
        OTHER => format!("unknown error {rest:#010x}").into(),
        KIND => contradiction(code_1, Format(code_2)).into(),
        _ => format!("status {status:#x}").into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::acyclic::long::{LOAD, PART, READ, STORE, WRITE};

    #[test]
    fn a_status_says_which_of_the_ways_refused() {
        for (status, expected) in [
            (number(ErrorNumber(1)), "error 01h: the parameter is read-only"),
            (drivecom(ErrorCode(0x0607_0000)), "error 6/7/0000: the object does not exist"),
            (drivecom(ErrorCode(0)), "unknown error 0x00000000"),
            (drivecom(ErrorCode(0xF607_0001)), "unknown error 0x06070001"),
            (msac1(Refusal { decode: 0x80, code_1: 0xB0, code_2: 7 }), "no such index (80 B0 07)"),
            (link(3), "the module refused it with RS: service not active"),
            (link(5), "the module refused it with a function that is no refusal"),
            (
                contradicts(Kind::I32, Format(0x42)),
                "the drive reports a word of 16 bits (format 42h), and its address says i32: write .i16 or \
                 .u16 behind the code",
            ),
            (
                contradicts(Kind::I32, Format(9)),
                "the drive reports text (format 09h), and its address says i32: write .text behind the code",
            ),
            (0xA000_0000, "status 0xa0000000"),
        ] {
            assert_eq!(reason(status), expected);
        }
        let own =
            [NO_CALL, UNREACHABLE, NO_PATH, NO_DPV1, NO_TEXT, BROKEN, NOT_READ, NOT_LOADED, BROKEN_WRITE];
        assert!(own.iter().all(|own| !reason(*own).starts_with("status")));
    }

    #[test]
    fn an_address_has_one_target_and_a_write_to_it_commands_unless_listed_as_harmless() {
        for kind in Kind::ALL {
            for (code, sub) in [(0, 0), (61, 0), (39, 255), (u16::MAX, 1)] {
                let target = Target::Parameter(Parameter { code, sub, kind });
                assert_eq!(Target::unpack(target.pack()), Some(target));
            }
        }
        let record = Target::Record(Record { slot: 1, index: 255 });
        assert_eq!(Target::unpack(record.pack()), Some(record));
        for service in [Service::Read(record), Service::Write(record, 7), Service::Store(record, 8)] {
            assert_eq!(Service::of(&service.into()), Some(service));
        }
        assert_eq!((Target::unpack(0x0800_0000), Target::unpack(0xFF01_0000)), (None, None));
        let code = |code| Target::Parameter(Parameter { code, sub: 0, kind: Kind::Own });
        let record = Target::Record(Record { slot: 0, index: 47 });
        let refused = |target: Target, service| {
            refusal(&Call { service, address: target.pack(), value: 0 }, &[]).is_some()
        };
        for target in [code(39), code(11), code(13), code(135), record] {
            let services = [WRITE, STORE, READ, LOAD, PART];
            let expected = [true, true, false, false, false];
            assert_eq!(services.map(|service| refused(target, service)), expected, "{target:?}");
        }
        assert!(HARMLESS.iter().all(|harmless| !refused(code(*harmless), WRITE)));
    }
}
