//! Why a slave is not in operation, for normal threads: written by the cycle without a lock, made text by the
//! reader.

use super::slave::Missing;
use crate::object::{self, Objects};
use crate::plan::Expected;
use crate::service::ATTEMPTS;
use crate::wire::registers::{AlCode, AlState};
use crate::wire::sdo::AbortCode;
use crate::wire::sii::Fault;
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_core::bus::notes::NoteCells;

/// The master's own statuses of an SDO are below; abort codes begin above.
const OWN_STATUSES: u32 = 2 * object::MAILBOX;
/// A code that no sheet names.
const UNKNOWN: &str = "not known";
/// The note on a slave whose SYNC0 is away from the grid.
const MEETS: &str = "it waits for the grid to meet its SYNC0";

/// Why a slave is not in operation. An object is its index and its subindex, so that each note fits a word.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Note {
    /// It is, or nothing is known yet.
    #[default]
    None,
    /// No slave answers at its position.
    Absent,
    /// The same, although the broadcast counts so many slaves: more than are in front of it.
    Unreachable(u16),
    /// The SII cannot be read, or used.
    Sii(Fault),
    /// The vendor is not the configured one.
    Vendor(u32),
    /// It is another product.
    Product(u32),
    /// It is another revision.
    Revision(u32),
    /// It is another one of its kind, with this serial number.
    Serial(u32),
    /// It has another alias.
    Alias {
        /// The alias there; 0: none.
        found: u16,
        /// The configured one.
        wanted: u16,
    },
    /// It identifies itself otherwise.
    Identification {
        /// As it does.
        found: u16,
        /// As configured.
        wanted: u16,
    },
    /// It does not identify itself.
    NoIdentification,
    /// The slave there is the one of another position.
    WrongPlace(u16),
    /// The SII has a mailbox or process data elsewhere.
    Start {
        /// 1 mailbox out, 2 in, 3 outputs, 4 inputs.
        usage: u8,
        /// The configured start; 0: none is configured there.
        own: u16,
        /// The start in its SII; 0: it has none, or no more.
        named: u16,
        /// The length there, bytes.
        length: u16,
    },
    /// The SII has another length of a mailbox or of process data.
    Length {
        /// As of [`Start`](Note::Start).
        usage: u8,
        /// The start of both.
        start: u16,
        /// The configured length, bytes.
        own: u16,
        /// The length in its SII.
        named: u16,
    },
    /// It has too few FMMUs.
    Fmmus(u8),
    /// It has no distributed clock.
    NoClock,
    /// It does not support LRW.
    NoLrw,
    /// It has no mailbox for CoE.
    NoCoe,
    /// It did not enter a state.
    State {
        /// The state.
        to: AlState,
        /// The AL status code.
        code: AlCode,
    },
    /// The same, by a code that concerns its SyncManagers, and the configuration sets another control byte of its
    /// outputs than its SII has.
    Control {
        /// As of [`State`](Note::State).
        to: AlState,
        /// The AL status code.
        code: AlCode,
        /// The control byte as set.
        set: u8,
        /// The one of its SII, or the usual one.
        own: u8,
    },
    /// It did not enter a state in time, without an error code.
    Slow {
        /// The state.
        to: AlState,
        /// The time that it had, ms.
        within_ms: u32,
    },
    /// It did not accept a value at start-up, or its answer cannot be used.
    StartUp {
        /// The index of the object.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The abort code, or a status of the master.
        abort: AbortCode,
    },
    /// The own value of an object in its outputs cannot be read.
    OwnValue {
        /// The index of the object.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The abort code.
        abort: AbortCode,
    },
    /// It does not have an object that is written where it is, or does not let it be written.
    Omitted {
        /// The index of the object.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The abort code.
        abort: AbortCode,
    },
    /// The watchdog does not read back as set.
    Watchdog,
    /// This one of its SyncManagers does not read back as set.
    Manager(u16),
    /// It is in operation, and its SII arms no watchdog, to which the configuration leaves that.
    Unarmed,
    /// The same, and its SII has no SyncManagers.
    NoManagers,
    /// It waits for the clock of the segment.
    WaitsForClock,
    /// It waits until the grid is at its SYNC0, how far that is off is not known.
    WaitsForLock,
    /// The same; the distance, ns: positive is late.
    Unlocked(i32),
    /// It was found in OP with other process data than configured, and is left alone.
    FoundRunning,
    /// It is being brought up.
    Starting,
    /// An object differs from its configuration.
    Differs {
        /// The index of the object.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The value there.
        found: u32,
    },
    /// The clock does not synchronise to the segment's.
    Unsettled,
    /// Another slave has its station address, and keeps it.
    AddressTwice,
    /// An object does not answer when it is read.
    Unread {
        /// The index of the object.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The time that each of the attempts had, ms.
        within_ms: u32,
    },
    /// The same when it is written.
    Unwritten {
        /// The index of the object.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The time that each of the attempts had, ms.
        within_ms: u32,
    },
    /// It is there, and does not carry out a request.
    NotDone(Missing),
    /// The slave at this position runs on a time other than the segment's.
    OtherTime(u16),
    /// Another master has changed its state or its settings, and it is set up again.
    Intruded,
}

impl Note {
    /// In words, for the slave at this position that has to be this one; `None`: there is nothing to report.
    pub fn text(self, place: u16, expected: &Expected) -> Option<String> {
        Some(format!("place {place}: {}", self.what(expected)?))
    }

    /// The same without its position.
    pub fn what(self, expected: &Expected) -> Option<String> {
        const ORDER: &str = "the order of the segment";
        let hex = |number: u32| format!("{number:#010x}");
        let any = |wanted: Option<u32>| wanted.map_or("any".into(), hex);
        let other = |what: &str, found: u32, wanted: Option<u32>, or: &str| {
            format!("its {what} is {found:#010x}, not {}: correct {what}, or {or}", any(wanted))
        };
        let exchanged = |what: &str, key: &str, found: String, wanted: String| {
            format!(
                "its {what} is {found}, not {wanted}: drives or cables are exchanged: put them back, or correct \
                 {key} for another drive"
            )
        };
        let refused = |to: AlState, code: AlCode| {
            format!("it refuses {to}: AL status code {:#06x} ({})", code.0, code.name().unwrap_or(UNKNOWN))
        };
        let aborted =
            |abort: AbortCode| format!("abort code {:#010x} ({})", abort.0, abort.name().unwrap_or(UNKNOWN));
        Some(match self {
            Note::None => return None,
            Note::Absent => "nothing answers there: look at its power and at the cable in front of it".into(),
            Note::Unreachable(counted) => format!(
                "no slave answers there, although the segment has {counted}: switch it off and on, and look \
                 at the connectors in front of it"
            ),
            Note::Sii(fault) => {
                let why = match fault {
                    Fault::Owned => {
                        "belongs to its processor, which does not give it up: switch it off and on, or take \
                         \"any\" for vendor, product and revision, and check_sii = false"
                    }
                    Fault::Busy => "stays busy: switch it off and on",
                    Fault::Refused => "refuses to be read: look whether another master holds it",
                    Fault::Unloaded => {
                        return Some("it has not loaded its EEPROM (SII): it has to be written anew".into());
                    }
                    Fault::Checksum => "has a wrong checksum: it has to be written anew",
                    Fault::Address => "returns another address than the requested one: replace it",
                    Fault::Blank => "was never written: it needs that of its manufacturer",
                };
                format!("its EEPROM (SII) {why}")
            }
            Note::Vendor(found) => other("vendor", found, expected.vendor, ORDER),
            Note::Product(found) => other("product", found, expected.product, ORDER),
            Note::Revision(found) => other("revision", found, expected.revision, "leave it out"),
            Note::Serial(found) => exchanged("serial number", "serial", hex(found), any(expected.serial)),
            Note::Alias { found, wanted } => {
                exchanged("station alias", "alias", found.to_string(), wanted.to_string())
            }
            Note::Identification { found, wanted } => {
                exchanged("identification", "identification", found.to_string(), wanted.to_string())
            }
            Note::NoIdentification => {
                "it does not identify itself on request (AL control bit 5): leave identification out, and \
                 use alias or serial"
                    .into()
            }
            Note::WrongPlace(other) => {
                format!("the slave there is the one of place {other}: look at the order of the cables")
            }
            Note::Start { usage, own, named: 0, .. } => {
                format!("its SII has no {} at {own:#06x}: correct the configuration, or {ORDER}", part(usage))
            }
            Note::Start { usage, own, named, length } => {
                let there = format!("its SII has {} at {named:#06x}, {length} bytes", part(usage));
                match own {
                    0 => format!("{there}, which the configuration leaves out: add them"),
                    _ => format!("{there}, and the configuration at {own:#06x}: correct the configuration"),
                }
            }
            Note::Length { usage, start, own, named } => format!(
                "its SII has {named} bytes of {} at {start:#06x}, and the configuration {own}: correct the \
                configuration, or use check_sii = false",
                part(usage)
            ),
            Note::Fmmus(count) => {
                format!("it has {count} FMMUs, too few for its outputs and inputs: leave out some of them")
            }
            Note::NoClock => "it has no distributed clock: take sync = false".into(),
            Note::NoLrw => "it does not know LRW: take lrw = false for its bus".into(),
            Note::NoCoe => {
                "its SII names no CoE: leave out mailbox, or check the order of the segment".into()
            }
            Note::State { to, code } => refused(to, code),
            Note::Control { to, code, set, own } => format!(
                "{}; probably for watchdog, which makes the control byte of its outputs {set:#04x} where its \
                 SII has {own:#04x}: leave watchdog out",
                refused(to, code)
            ),
            Note::Slow { to, within_ms } => format!(
                "it does not enter {to} within {within_ms} ms, and gives no error code: raise state_timeout \
                 if its description allows more"
            ),
            Note::StartUp { index, sub, abort: AbortCode(status) } if status < OWN_STATUSES => {
                format!("at {index:#06x}:{sub}: {}", Objects.reason(status))
            }
            Note::StartUp { index, sub, abort } => {
                format!("it refuses what is written to {index:#06x}:{sub}: {}", aborted(abort))
            }
            Note::OwnValue { index, sub, abort } => format!(
                "{index:#06x}:{sub} is in its outputs, and its own value of it cannot be read: {}; give the \
                 value in start_up",
                aborted(abort)
            ),
            Note::Omitted { index: 0x60C2, sub, abort } => format!(
                "it does not take the cycle time (0x60c2:{sub}): {}; it has to find its cycle by SYNC0, or by \
                 a parameter of its own: compare that with period",
                aborted(abort)
            ),
            Note::Omitted { index, sub, abort } => {
                format!("it does not take {index:#06x}:{sub}, and works without: {}", aborted(abort))
            }
            Note::Watchdog => "its watchdog does not read back as set".into(),
            Note::Manager(number) => {
                format!("its SyncManager {number} does not read back as set: correct its outputs and inputs")
            }
            Note::Unarmed | Note::NoManagers => {
                let has = if self == Note::Unarmed { "arms" } else { "has no SyncManagers, and so arms" };
                format!(
                    "its SII {has} no watchdog: if the master dies, only the slave itself ends its outputs; \
                     give watchdog a time, or \"off\" if it shall have none"
                )
            }
            Note::WaitsForClock => "it waits for the clock of the first slave with sync".into(),
            Note::WaitsForLock => format!("{MEETS}, and for its clock to be seen"),
            Note::Unlocked(error) => {
                // Rounded to ten microseconds: a reader that reports each new text shall not report each cycle.
                let far = (error.unsigned_abs() + 5_000) / 10_000 * 10;
                let side = if error < 0 { "early" } else { "late" };
                format!("{MEETS}: a slot is about {far} us {side}")
            }
            Note::FoundRunning => {
                "it was found in OP with other process data: stop it by its own master, or take \
                 on_found_running = \"stop\""
                    .into()
            }
            Note::Starting => "it is being brought up".into(),
            Note::Differs { index: 0x608F, sub: 1, found } => format!(
                "its increments per turn (0x608f:1) are {found}, not 2 to the power of prbase: correct \
                 prbase, or use check_prbase = false"
            ),
            Note::Differs { index, sub, found } => format!(
                "its {index:#06x}:{sub} is {found} ({found:#x}), not as configured: correct one of them"
            ),
            Note::Unsettled => {
                "its clock does not synchronise with that of the segment: check its distributed clock".into()
            }
            Note::AddressTwice => "another slave has its station address: switch that one off and on".into(),
            Note::Unread { index, sub, within_ms } | Note::Unwritten { index, sub, within_ms } => format!(
                "it does not answer within {within_ms} ms, {ATTEMPTS} times in a row, when \
                 {index:#06x}:{sub} is {}: raise sdo_timeout, or check that it has this object",
                if matches!(self, Note::Unread { .. }) { "read" } else { "written" }
            ),
            Note::Intruded => {
                "another master, or a tool, has changed its state or its settings: end that; it is set up \
                 again"
                    .into()
            }
            Note::NotDone(Missing { register, is_write }) => {
                let what = if is_write { "take what is written to" } else { "return what is read from" };
                format!("it is there, and does not {what} register {register:#06x}: switch it off and on")
            }
            Note::OtherTime(other) => format!(
                "the slave at place {other} runs on a clock that another master has set, and would lose it: \
                 stop that slave, or switch it off"
            ),
        })
    }
}

/// The purpose of a SyncManager.
fn part(usage: u8) -> &'static str {
    ["", "mailbox out", "mailbox in", "outputs", "inputs"].get(usize::from(usage)).unwrap_or(&"a buffer")
}

/// The notes of all slaves of a segment.
pub type Notes = NoteCells<Note>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_comes_back_as_it_was_written_and_says_what_to_do() {
        let all = [
            Note::None,
            Note::Absent,
            Note::Unreachable(u16::MAX),
            Note::Sii(Fault::Checksum),
            Note::Sii(Fault::Blank),
            Note::Vendor(0x6A),
            Note::Product(0x0300_0600),
            Note::Revision(u32::MAX),
            Note::Serial(u32::MAX),
            Note::Alias { found: 0, wanted: u16::MAX },
            Note::Identification { found: u16::MAX, wanted: 1 },
            Note::NoIdentification,
            Note::WrongPlace(3),
            Note::Start { usage: 3, own: 0x1180, named: 0x1100, length: 6 },
            Note::Start { usage: 4, own: 0xFFFF, named: 0, length: 0 },
            Note::Start { usage: 4, own: 0, named: 0xFFFF, length: 0xFFFF },
            Note::Length { usage: 4, start: 0xFFFF, own: 1, named: 0xFFFF },
            Note::Fmmus(2),
            Note::NoClock,
            Note::NoLrw,
            Note::NoCoe,
            Note::State { to: AlState::SafeOp, code: AlCode(0x1D) },
            Note::Control { to: AlState::SafeOp, code: AlCode(0x1D), set: 0x64, own: 0x24 },
            Note::Slow { to: AlState::Op, within_ms: 10_000 },
            Note::StartUp { index: 0x1C12, sub: 1, abort: AbortCode(0x0602_0000) },
            Note::StartUp { index: 0x6060, sub: 0, abort: AbortCode(object::FULL) },
            Note::Omitted { index: 0x60C2, sub: 2, abort: AbortCode(0x0601_0002) },
            Note::Omitted { index: 0xFFFF, sub: 255, abort: AbortCode(u32::MAX) },
            Note::Watchdog,
            Note::Manager(3),
            Note::Unarmed,
            Note::NoManagers,
            Note::WaitsForClock,
            Note::WaitsForLock,
            Note::Unlocked(-123_456),
            Note::FoundRunning,
            Note::Starting,
            Note::Differs { index: 0x608F, sub: 1, found: 1 << 20 },
            Note::Unsettled,
            Note::AddressTwice,
            Note::Unread { index: 0x608F, sub: 1, within_ms: 2_000 },
            Note::Unwritten { index: 0x1C12, sub: 1, within_ms: u32::MAX },
            Note::OtherTime(7),
            Note::Intruded,
            Note::OwnValue { index: 0x60E0, sub: 0, abort: AbortCode(0x0602_0000) },
            Note::NotDone(Missing { register: 0x0910, is_write: true }),
        ];
        let notes = Notes::new(1);
        for note in all {
            notes.set(0, note);
            assert_eq!(notes.get(0), note);
            assert_eq!(note.text(4, &Expected::default()).is_none(), note == Note::None);
        }
        let refused = Note::State { to: AlState::SafeOp, code: AlCode(0x1D) }.text(1, &Expected::default());
        let text = "place 1: it refuses SAFEOP: AL status code 0x001d (invalid output configuration)";
        assert_eq!(refused.as_deref(), Some(text));
        assert_eq!(notes.get(7), Note::None);
    }
}
