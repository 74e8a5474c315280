//! What an acyclic call to a drive does: its [`Service`], which is its numbers and back, and the meaning of its status.
//!
//! | target | [`Read`](long::Service::Read) | [`Write`](long::Service::Write) | value |
//! |---|---|---|---|
//! | [`Parameter`](Target::Parameter) | yes, unless of the flash memory | unless `opcodes::PARAMETERS` says read-only | 16 bits, 0 above them |
//! | [`Register`](Target::Register) | yes | yes | 32 bits, 0 above them |
//! | [`Command`](Target::Command) | - | puts it into the drive's buffer | its operand, an `i64` |
//! | [`Encoder`](Target::Encoder), [`Absolute`](Target::Absolute) | yes | - | 32 bits, 0 above them |
//! | [`AlarmHistory`](Target::AlarmHistory) | yes | - | 32 bits, 0 above them |
//! | [`Output`](Target::Output) | - | sets it | 1 closed, 0 open |
//! | [`Stop`](Target::Stop), [`Kill`](Target::Kill) | - | at once | 0 with the largest deceleration (AM), 1 with the set one (DE, JL) |
//! | [`AlarmReset`](Target::AlarmReset), [`LoadProgram`](Target::LoadProgram) | - | at once | 0 |
//! | [`SaveSegment`](Target::SaveSegment) | - | at once | 1 ... 12 |
//! | [`Attribute`](Target::Attribute) | yes | eight bytes | bytes, the first one the lowest |
//!
//! Reading returns the value. Writing an attribute returns what was written; every other write returns the drive's
//! status word (see `wire::assembly::status`) as the value. A read of an attribute of more than eight bytes returns the
//! first of them, and the rest by [`Size`](long::Service::Size) and [`Part`](long::Service::Part)s of the same series
//! ([`long::read`]).
//! An attribute of any other length than eight bytes is written by [`Load`](long::Service::Load)s and a
//! [`Store`](long::Service::Store) ([`long::write()`]).
//!
//! The status of an answer is 0. That of a refusal is the drive's own, see [`refusal`], or one of the master's, from
//! [`NO_CALL`] on; [`reason`] has the words.

use std::borrow::Cow;

use super::wire::cip::Status;
use super::wire::encapsulation;
use super::wire::opcodes::{self, Parameter};
use fieldbeat_core::axis::acyclic::long;
use fieldbeat_core::axis::acyclic::{Call, CallError, Commanding};

/// In a status of the drive's own: bits 8 to 23 are the extended status.
const EXTENDED: u32 = 1 << 24;
/// A status of the encapsulation, in bits 0 to 15.
const ENCAPSULATION: u32 = 1 << 25;
/// Status of a call: there is no such call. This and those below are the master's own: nothing was sent, unless they
/// say so.
pub const NO_CALL: u32 = 1 << 26;
/// Status of a call: the target has no such value.
pub const VALUE: u32 = NO_CALL + 1;
/// Status of a call: the answer of the drive was not one to this call. It was sent.
pub const BROKEN: u32 = NO_CALL + 2;
/// Status of a call: there is no such part of the data read before it in its series.
pub const NOT_READ: u32 = NO_CALL + 3;
/// Status of a call: the value to be written was not handed over whole before it in its series.
pub const NOT_LOADED: u32 = NO_CALL + 4;

/// The service of a call.
pub type Service = long::Service<Target>;

/// The target that a call reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Target {
    /// A parameter of `opcodes::PARAMETERS`.
    Parameter {
        /// The index.
        index: u8,
        /// Also in the flash memory: only written.
        flash: bool,
    },
    /// A register: `opcodes::REGISTERS`, or '0' ... '9'.
    Register(u8),
    /// A buffered command of `opcodes::OPCODES`.
    Command {
        /// The code.
        code: u8,
        /// The register or I/O code next to its operand; 0 for most.
        field: u8,
    },
    /// The position of the encoder, counts.
    Encoder,
    /// The absolute position, steps.
    Absolute,
    /// The history of alarms.
    AlarmHistory,
    /// An output, counted from 0, up to 127.
    Output(u8),
    /// ST: stops.
    Stop,
    /// SK: stops, and discards what is buffered.
    Kill,
    /// AR: clears the fault.
    AlarmReset,
    /// QL: loads the Q program.
    LoadProgram,
    /// QS: saves a segment of it.
    SaveSegment,
    /// An attribute of a CIP object. An instance of 0 is the class itself.
    Attribute {
        /// At most `CLASS_MAX`.
        class: u16,
        /// At most `INSTANCE_MAX`.
        instance: u16,
        /// At most `ATTRIBUTE_MAX`.
        attribute: u16,
    },
}

/// An address with this bit is an attribute: 11 bits of class, 10 of instance, 10 of attribute. Others begin with the
/// byte of their kind.
const IS_ATTRIBUTE: u32 = 1 << 31;

impl long::Target for Target {
    fn pack(self) -> u32 {
        let bytes = match self {
            Target::Attribute { class, instance, attribute } => {
                let [class, instance, attribute] = [class, instance, attribute].map(u32::from);
                return IS_ATTRIBUTE | class << 20 | instance << 10 | attribute;
            }
            Target::Parameter { index, flash } => [1, 0, u8::from(flash), index],
            Target::Register(register) => [2, 0, 0, register],
            Target::Command { code, field } => [3, 0, field, code],
            Target::Encoder => [4, 0, 0, 0],
            Target::Absolute => [5, 0, 0, 0],
            Target::AlarmHistory => [6, 0, 0, 0],
            Target::Output(index) => [7, 0, 0, index],
            Target::Stop => [8, 0, 0, 0],
            Target::Kill => [9, 0, 0, 0],
            Target::AlarmReset => [10, 0, 0, 0],
            Target::LoadProgram => [11, 0, 0, 0],
            Target::SaveSegment => [12, 0, 0, 0],
        };
        u32::from_be_bytes(bytes)
    }

    fn unpack(address: u32) -> Option<Target> {
        if address & IS_ATTRIBUTE != 0 {
            let (class, instance) = (address >> 20 & 0x7FF, address >> 10 & 0x3FF);
            // Masked to their bits.
            return Target::attribute(class as u16, instance as u16, (address & 0x3FF) as u16);
        }
        Some(match address.to_be_bytes() {
            [1, 0, flash @ (0 | 1), index] => Target::Parameter { index, flash: flash != 0 },
            [2, 0, 0, register] => Target::Register(register),
            [3, 0, field, code] => Target::Command { code, field },
            [4, 0, 0, 0] => Target::Encoder,
            [5, 0, 0, 0] => Target::Absolute,
            [6, 0, 0, 0] => Target::AlarmHistory,
            [7, 0, 0, index @ 0..=127] => Target::Output(index),
            [8, 0, 0, 0] => Target::Stop,
            [9, 0, 0, 0] => Target::Kill,
            [10, 0, 0, 0] => Target::AlarmReset,
            [11, 0, 0, 0] => Target::LoadProgram,
            [12, 0, 0, 0] => Target::SaveSegment,
            _ => return None,
        })
    }
}

impl Target {
    /// The highest class. The public ones end at 0xFF, a vendor's at 0x4FF.
    pub(crate) const CLASS_MAX: u16 = 0x7FF;
    /// The highest instance.
    pub(crate) const INSTANCE_MAX: u16 = 0x3FF;
    /// The highest attribute.
    pub(crate) const ATTRIBUTE_MAX: u16 = 0x3FF;

    /// The vendor: every device has it.
    pub const VENDOR: Target = Target::Attribute { class: 1, instance: 1, attribute: 1 };

    /// An attribute; `None`: its numbers are above the highest.
    pub fn attribute(class: u16, instance: u16, attribute: u16) -> Option<Target> {
        let fits = class <= Target::CLASS_MAX
            && instance <= Target::INSTANCE_MAX
            && attribute <= Target::ATTRIBUTE_MAX;
        fits.then_some(Target::Attribute { class, instance, attribute })
    }

    /// The parameter that it is.
    pub fn parameter(self) -> Option<Parameter> {
        let Target::Parameter { index, .. } = self else { return None };
        opcodes::PARAMETERS.into_iter().find(|parameter| parameter.index == index)
    }

    /// Whether there is a call that reads it.
    pub(crate) fn can_be_read(self) -> bool {
        match self {
            Target::Parameter { flash, .. } => !flash,
            Target::Register(_)
            | Target::Encoder
            | Target::Absolute
            | Target::AlarmHistory
            | Target::Attribute { .. } => true,
            _ => false,
        }
    }

    /// Whether there is one that writes it.
    pub(crate) fn can_be_written(self) -> bool {
        match self {
            // Bit 7 of such an index would be the flash memory of another parameter.
            Target::Parameter { .. } => self.parameter().is_some_and(|parameter| !parameter.read_only),
            Target::Encoder | Target::Absolute | Target::AlarmHistory => false,
            _ => true,
        }
    }

    /// Written while power is on, it moves nothing, and changes no state: what counts as in position (PD, PE), the
    /// lock of parameters (PK), what happens at the next power-up (PM). All others may: parameters and registers of
    /// motion and of stops, gears, currents and limits, the enable input (SI), user registers, which a Q program may
    /// use, outputs (a brake), alarm reset, stops, every other buffered command, and attributes of objects, the output
    /// assembly and the network among them.
    fn is_harmless(self) -> bool {
        const HARMLESS: [&str; 4] = ["PD", "PE", "PK", "PM"];
        match self {
            Target::Parameter { .. } => {
                self.parameter().is_some_and(|parameter| HARMLESS.contains(&parameter.name))
            }
            Target::Command { code, .. } => {
                opcodes::OPCODES.iter().any(|opcode| opcode.code == code && HARMLESS.contains(&opcode.name))
            }
            Target::Encoder | Target::Absolute | Target::AlarmHistory => true,
            _ => false,
        }
    }
}

/// The calls that command a drive.
pub fn commanding() -> Commanding {
    Commanding::new(commands, [])
}

/// Why a call of the application is refused while the power of its drive is on: it writes something that is not known
/// to be harmless.
fn commands(call: &Call, _mapped: &[u32]) -> Option<CallError> {
    (!Service::written(call)?.is_harmless()).then_some(CallError::Commands)
}

/// The status of a call that the drive refused, from its CIP status: the general one in bits 0 to 7, an extended one in
/// bits 8 to 23 with bit 24 set.
pub fn refusal(status: Status) -> u32 {
    let extended = status.extended.map_or(0, |extended| EXTENDED | u32::from(extended) << 8);
    u32::from(status.general) | extended
}

/// The status of a call that the encapsulation of the drive refused.
pub(crate) fn encapsulation_refusal(status: encapsulation::Status) -> u32 {
    // The standard has 16 bits of them.
    ENCAPSULATION | status.0 & 0xFFFF
}

/// The meaning of a status.
pub fn reason(status: u32) -> Cow<'static, str> {
    let own = match status {
        NO_CALL => "there is no such call to a drive",
        VALUE => "it has no such value",
        BROKEN => "the drive answered something else",
        NOT_READ => "there is no such part of the data read before",
        NOT_LOADED => "the value was not handed over whole; raise parameter_queue",
        _ if status & ENCAPSULATION != 0 => {
            return encapsulation::Status(status & 0xFFFF).to_string().into();
        }
        _ => {
            let extended = (status & EXTENDED != 0).then_some((status >> 8) as u16);
            return Status { general: status as u8, extended, size: None }.to_string().into();
        }
    };
    own.into()
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use fieldbeat_core::axis::acyclic::long::Target as _;

    const ATTRIBUTE: Target = Target::Attribute { class: 0x7FF, instance: 0x3FF, attribute: 0x3FF };

    fn every_kind() -> Vec<Target> {
        let parameters = opcodes::PARAMETERS
            .iter()
            .flat_map(|p| [false, true].map(|flash| Target::Parameter { index: p.index, flash }));
        let commands =
            opcodes::OPCODES.iter().map(|opcode| Target::Command { code: opcode.code, field: 0xB2 });
        let registers = opcodes::REGISTERS.iter().map(|(register, _)| Target::Register(*register));
        use Target::{
            Absolute, AlarmHistory, AlarmReset, Encoder, Kill, LoadProgram, Output, SaveSegment, Stop,
        };
        let others = [Encoder, Absolute, AlarmHistory, Stop, Kill, AlarmReset, LoadProgram, SaveSegment];
        let more =
            [Output(0), Output(127), Target::Attribute { class: 1, instance: 1, attribute: 7 }, ATTRIBUTE];
        parameters.chain(commands).chain(registers).chain(others).chain(more).collect()
    }

    #[test]
    fn any_address_is_that_of_one_target_or_of_none() {
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..10_000 {
            let (service, address, value) = (random.u32(..10), random.u32(..), random.u64(..));
            assert!(Target::unpack(address).is_none_or(|target| target.pack() == address), "{address:#x}");
            let service = Service::of(&Call { service, address, value });
            assert_eq!(service, service.and_then(|service| Service::of(&service.into())));
        }
    }

    #[test]
    fn only_what_is_known_to_be_harmless_may_be_written_while_power_is_on() {
        let harmless = |call: Call| commands(&call, &[]).is_none();
        for target in every_kind() {
            assert!(harmless(target.read()), "{target:?}");
            for service in [Service::Size(target), Service::Part(target, 0), Service::Load(target, 0)] {
                assert!(harmless(service.into()));
            }
        }
        let parameter = |index| [false, true].map(|flash| Target::Parameter { index, flash });
        let expected = [0x71, 0x72, 0x44, 0x5D].into_iter().flat_map(parameter);
        let expected = expected.chain([0x71, 0x72, 0x44].map(|code| Target::Command { code, field: 0xB2 }));
        let expected = expected.chain([Target::Encoder, Target::Absolute, Target::AlarmHistory]);
        let written = every_kind().into_iter().filter(|target| harmless(target.write(1)));
        assert_eq!(written.collect::<HashSet<_>>(), expected.collect());
        assert!(!harmless(Service::Store(ATTRIBUTE, 1).into()));
    }
}
