//! Why a slave is not in operation, for normal threads: written by the cycle without a lock, made text by the
//! reader.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::slave::Missing;
use crate::object::{self, Objects};
use crate::plan::Expected;
use crate::service::ATTEMPTS;
use crate::wire::registers::{AlCode, AlState};
use crate::wire::sdo::{AbortCode, Object};
use crate::wire::sii::Fault;
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_core::rt::Regions;

/// The master's own statuses of an SDO are below; abort codes begin above.
const OWN_STATUSES: u32 = 2 * object::MAILBOX;
/// The longest time that a note has.
const MILLISECONDS: u32 = u32::MAX >> 1;

/// Why a slave is not in operation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Note {
    /// It is, or nothing is known yet.
    #[default]
    None,
    /// No slave answers at its position.
    Absent,
    /// The same, although the broadcast counts so many slaves: more than are in front of it.
    Unreachable(u16),
    /// Its SII cannot be read, or used.
    Sii(Fault),
    /// Its vendor is not the configured one.
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
    /// Its SII has a mailbox or process data elsewhere.
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
    /// Its SII has another length of a mailbox or of process data.
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
        /// Its AL status code.
        code: AlCode,
    },
    /// The same, by a code that concerns its SyncManagers, and the configuration sets another control byte of its
    /// outputs than its SII has.
    Control {
        /// As of [`State`](Note::State).
        to: AlState,
        /// Its AL status code.
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
        /// The object.
        object: Object,
        /// The abort code, or a status of the master.
        abort: AbortCode,
    },
    /// Its own value of an object in its outputs cannot be read.
    OwnValue {
        /// The object.
        object: Object,
        /// The abort code.
        abort: AbortCode,
    },
    /// It does not have an object that is written where it is, or does not let it be written.
    Omitted {
        /// The object.
        object: Object,
        /// The abort code.
        abort: AbortCode,
    },
    /// Its watchdog does not read back as set.
    Watchdog,
    /// This one of its SyncManagers does not read back as set.
    Manager(u16),
    /// It is in operation, and its SII arms no watchdog, to which the configuration leaves that.
    Unarmed,
    /// The same, and its SII has no SyncManagers.
    NoManagers,
    /// It waits for the clock of the segment.
    WaitsForClock,
    /// It waits until the grid is at its SYNC0; the distance, ns: positive is late. `None`: it is not known.
    WaitsForLock(Option<i32>),
    /// It was found in OP with other process data than configured, and is left alone.
    FoundRunning,
    /// It is being brought up.
    Starting,
    /// An object differs from its configuration.
    Differs {
        /// The object.
        object: Object,
        /// Its value there.
        found: u32,
    },
    /// Its clock does not synchronise to the segment's.
    Unsettled,
    /// Another slave has its station address, and keeps it.
    AddressTwice,
    /// An access to an object is not answered.
    Unanswered {
        /// The object.
        object: Object,
        /// It is written.
        writes: bool,
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

/// Numbers of the notes, in the highest byte.
impl Note {
    /// Those without a value: their number is their index, the others follow from 80h on.
    const PLAIN: [Note; 15] = [
        Note::None,
        Note::Absent,
        Note::NoClock,
        Note::NoLrw,
        Note::NoCoe,
        Note::Watchdog,
        Note::WaitsForClock,
        Note::FoundRunning,
        Note::Starting,
        Note::Unsettled,
        Note::AddressTwice,
        Note::Unarmed,
        Note::NoManagers,
        Note::Intruded,
        Note::NoIdentification,
    ];

    fn pack(self) -> u64 {
        let number = |kind: u8, high: u32, low: u32| {
            u64::from(kind) << 56 | u64::from(high & 0xFF_FFFF) << 32 | u64::from(low)
        };
        let memory = |usage: u8, word: u16| u32::from(usage) << 16 | u32::from(word);
        match self {
            Note::Vendor(found) => number(0x80, 0, found),
            Note::Product(found) => number(0x81, 0, found),
            Note::Revision(found) => number(0x82, 0, found),
            Note::Serial(found) => number(0x95, 0, found),
            Note::Alias { found, wanted } => number(0x96, found.into(), wanted.into()),
            Note::Identification { found, wanted } => number(0x97, found.into(), wanted.into()),
            Note::WrongPlace(place) => number(0x83, 0, place.into()),
            Note::Start { usage, own, named, length } => {
                number(0x84, memory(usage, own), u32::from(named) << 16 | u32::from(length))
            }
            Note::Length { usage, start, own, named } => {
                number(0x8d, memory(usage, start), u32::from(own) << 16 | u32::from(named))
            }
            Note::Unreachable(counted) => number(0x93, 0, counted.into()),
            Note::Fmmus(count) => number(0x85, 0, count.into()),
            Note::Manager(manager) => number(0x92, 0, manager.into()),
            Note::State { to, code } => number(0x86, to.number().into(), code.0.into()),
            Note::Control { to, code, set, own } => {
                let control = u32::from(set) << 8 | u32::from(own);
                number(0x8e, to.number().into(), control << 16 | u32::from(code.0))
            }
            Note::Slow { to, within_ms } => number(0x87, to.number().into(), within_ms),
            Note::StartUp { object, abort } => number(0x88, object.key(), abort.0),
            Note::OwnValue { object, abort } => number(0x94, object.key(), abort.0),
            Note::Omitted { object, abort } => number(0x98, object.key(), abort.0),
            Note::WaitsForLock(error) => {
                number(0x89, u32::from(error.is_some()), error.unwrap_or_default().cast_unsigned())
            }
            Note::Differs { object, found } => number(0x8a, object.key(), found),
            Note::Unanswered { object, writes, within_ms } => {
                number(0x8b, object.key(), u32::from(writes) << 31 | within_ms.min(MILLISECONDS))
            }
            Note::OtherTime(place) => number(0x8c, 0, place.into()),
            Note::NotDone(Missing { register, is_write }) => number(0x91, is_write.into(), register.into()),
            Note::Sii(fault) => number(0x90, 0, fault as u32),
            plain => {
                let kind = Note::PLAIN.iter().position(|note| *note == plain).unwrap_or_default();
                number(kind as u8, 0, 0)
            }
        }
    }

    fn unpack(packed: u64) -> Note {
        let (kind, high, low) = ((packed >> 56) as u8, (packed >> 32) as u32 & 0xFF_FFFF, packed as u32);
        let state = || AlState::new(high as u8).unwrap_or_default();
        let object = || Object::new((high >> 8) as u16, high as u8);
        let usage = (high >> 16) as u8;
        match kind {
            0x80 => Note::Vendor(low),
            0x81 => Note::Product(low),
            0x82 => Note::Revision(low),
            0x95 => Note::Serial(low),
            0x96 => Note::Alias { found: high as u16, wanted: low as u16 },
            0x97 => Note::Identification { found: high as u16, wanted: low as u16 },
            0x83 => Note::WrongPlace(low as u16),
            0x84 => Note::Start { usage, own: high as u16, named: (low >> 16) as u16, length: low as u16 },
            0x8d => Note::Length { usage, start: high as u16, own: (low >> 16) as u16, named: low as u16 },
            0x85 => Note::Fmmus(low as u8),
            0x92 => Note::Manager(low as u16),
            0x93 => Note::Unreachable(low as u16),
            0x86 => Note::State { to: state(), code: AlCode(low as u16) },
            0x8e => Note::Control {
                to: state(),
                code: AlCode(low as u16),
                set: (low >> 24) as u8,
                own: (low >> 16) as u8,
            },
            0x87 => Note::Slow { to: state(), within_ms: low },
            0x88 => Note::StartUp { object: object(), abort: AbortCode(low) },
            0x94 => Note::OwnValue { object: object(), abort: AbortCode(low) },
            0x98 => Note::Omitted { object: object(), abort: AbortCode(low) },
            0x89 => Note::WaitsForLock((high != 0).then_some(low.cast_signed())),
            0x8a => Note::Differs { object: object(), found: low },
            0x8b => Note::Unanswered {
                object: object(),
                writes: low > MILLISECONDS,
                within_ms: low & MILLISECONDS,
            },
            0x8c => Note::OtherTime(low as u16),
            0x91 => Note::NotDone(Missing { register: low as u16, is_write: high != 0 }),
            0x90 => Note::Sii(Fault::ALL.get(low as usize).copied().unwrap_or(Fault::Refused)),
            _ => Note::PLAIN.get(usize::from(kind)).copied().unwrap_or_default(),
        }
    }

    /// In words, for the slave at this position that has to be this one; `None`: there is nothing to report.
    pub fn text(self, place: u16, expected: &Expected) -> Option<String> {
        Some(format!("place {place}: {}", self.what(expected)?))
    }

    /// The same without its position.
    pub fn what(self, expected: &Expected) -> Option<String> {
        const EXCHANGED: &str = "drives or cables are exchanged: put them back";
        let wanted = |number: Option<u32>| number.map_or("any".into(), |number| format!("{number:#010x}"));
        Some(match self {
            Note::None => return None,
            Note::Absent => "nothing answers there: look at its power and at the cable in front of it".into(),
            Note::Unreachable(counted) => format!(
                "no slave answers there, although the segment has {counted}: switch it off and on, and look \
                 at the connectors in front of it"
            ),
            Note::Sii(fault) => match fault {
                Fault::Owned => {
                    "its EEPROM (SII) belongs to its processor, which does not give it up: switch it off and \
                     on, or take \"any\" for vendor, product and revision, and check_sii = false"
                }
                Fault::Busy => "its EEPROM (SII) stays busy: switch it off and on",
                Fault::Refused => "its EEPROM (SII) refuses to be read: look whether another master holds it",
                Fault::Unloaded => "it has not loaded its EEPROM (SII): it has to be written anew",
                Fault::Checksum => "its EEPROM (SII) has a wrong checksum: it has to be written anew",
                Fault::Address => {
                    "its EEPROM (SII) returns another address than the requested one: replace it"
                }
                Fault::Blank => "its EEPROM (SII) was never written: it needs that of its manufacturer",
            }
            .into(),
            Note::Vendor(found) => {
                let wanted = wanted(expected.vendor);
                format!(
                    "its vendor is {found:#010x}, not {wanted}: correct vendor, or the order of the \
                     segment"
                )
            }
            Note::Product(found) => {
                let wanted = wanted(expected.product);
                format!(
                    "its product is {found:#010x}, not {wanted}: correct product, or the order of the segment"
                )
            }
            Note::Revision(found) => {
                let wanted = wanted(expected.revision);
                format!("its revision is {found:#010x}, not {wanted}: correct revision, or leave it out")
            }
            Note::Serial(found) => {
                let wanted = wanted(expected.serial);
                format!(
                    "its serial number is {found:#010x}, not {wanted}: {EXCHANGED}, or correct serial for \
                     another drive"
                )
            }
            Note::Alias { found, wanted } => format!(
                "its station alias is {found}, not {wanted}: {EXCHANGED}, or correct alias for another drive"
            ),
            Note::Identification { found, wanted } => format!(
                "its identification is {found}, not {wanted}: {EXCHANGED}, or correct identification for \
                 another drive"
            ),
            Note::NoIdentification => {
                "it does not identify itself on request (AL control bit 5): leave identification out, and \
                 use alias or serial"
                    .into()
            }
            Note::WrongPlace(other) => {
                format!("the slave there is the one of place {other}: look at the order of the cables")
            }
            Note::Start { usage, own, named: 0, .. } => {
                let what = part(usage);
                format!(
                    "its SII has no {what} at {own:#06x}: correct the configuration, or the order of the \
                     segment"
                )
            }
            Note::Start { usage, own: 0, named, length } => format!(
                "its SII has {} at {named:#06x}, {length} bytes, which the configuration leaves out: add \
                 them",
                part(usage)
            ),
            Note::Start { usage, own, named, length } => format!(
                "its SII has {} at {named:#06x}, {length} bytes, and the configuration at {own:#06x}: \
                 correct the configuration",
                part(usage)
            ),
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
            Note::State { to, code } => {
                format!(
                    "it refuses {to}: AL status code {:#06x} ({})",
                    code.0,
                    code.name().unwrap_or("not known")
                )
            }
            Note::Control { to, code, set, own } => {
                let why = code.name().unwrap_or("not known");
                format!(
                    "it refuses {to}: AL status code {:#06x} ({why}); probably for watchdog, which makes the \
                     control byte of its outputs {set:#04x} where its SII has {own:#04x}: leave watchdog out",
                    code.0
                )
            }
            Note::Slow { to, within_ms } => format!(
                "it does not enter {to} within {within_ms} ms, and gives no error code: raise state_timeout \
                 if its description allows more"
            ),
            Note::StartUp { object: Object { index, sub }, abort: AbortCode(status) }
                if status < OWN_STATUSES =>
            {
                format!("at {index:#06x}:{sub}: {}", Objects.reason(status))
            }
            Note::StartUp { object, abort } => format!(
                "it refuses what is written to {:#06x}:{}: abort code {:#010x} ({})",
                object.index,
                object.sub,
                abort.0,
                abort.name().unwrap_or("not known")
            ),
            Note::OwnValue { object: Object { index, sub }, abort } => format!(
                "{index:#06x}:{sub} is in its outputs, and its own value of it cannot be read: abort code \
                 {:#010x} ({}); give the value in start_up",
                abort.0,
                abort.name().unwrap_or("not known")
            ),
            Note::Omitted { object: Object { index: 0x60C2, sub }, abort } => format!(
                "it does not take the cycle time (0x60c2:{sub}): abort code {:#010x} ({}); it has to find \
                 its cycle by SYNC0, or by a parameter of its own: compare that with period",
                abort.0,
                abort.name().unwrap_or("not known")
            ),
            Note::Omitted { object: Object { index, sub }, abort } => format!(
                "it does not take {index:#06x}:{sub}, and works without: abort code {:#010x} ({})",
                abort.0,
                abort.name().unwrap_or("not known")
            ),
            Note::Watchdog => "its watchdog does not read back as set".into(),
            Note::Manager(number) => {
                format!("its SyncManager {number} does not read back as set: correct its outputs and inputs")
            }
            Note::Unarmed => {
                "its SII arms no watchdog: if the master dies, only the slave itself ends its outputs; give \
                 watchdog a time, or \"off\" if it shall have none"
                    .into()
            }
            Note::NoManagers => {
                "its SII has no SyncManagers, and so arms no watchdog: if the master dies, only the slave \
                 itself ends its outputs; give watchdog a time, or \"off\" if it shall have none"
                    .into()
            }
            Note::WaitsForClock => "it waits for the clock of the first slave with sync".into(),
            Note::WaitsForLock(None) => {
                "it waits for the grid to meet its SYNC0, and for its clock to be seen".into()
            }
            Note::WaitsForLock(Some(error)) => {
                // Rounded to ten microseconds: a reader that reports each new text shall not report each cycle.
                let far = (error.unsigned_abs() + 5_000) / 10_000 * 10;
                let side = if error < 0 { "early" } else { "late" };
                format!("it waits for the grid to meet its SYNC0: a slot is about {far} us {side}")
            }
            Note::FoundRunning => {
                "it was found in OP with other process data: stop it by its own master, or take \
                 on_found_running = \"stop\""
                    .into()
            }
            Note::Starting => "it is being brought up".into(),
            Note::Differs { object: Object { index: 0x608F, sub: 1 }, found } => format!(
                "its increments per turn (0x608f:1) are {found}, not 2 to the power of prbase: correct \
                 prbase, or use check_prbase = false"
            ),
            Note::Differs { object: Object { index, sub }, found } => {
                format!(
                    "its {index:#06x}:{sub} is {found} ({found:#x}), not as configured: correct one of them"
                )
            }
            Note::Unsettled => {
                "its clock does not synchronise with that of the segment: check its distributed clock".into()
            }
            Note::AddressTwice => "another slave has its station address: switch that one off and on".into(),
            Note::Unanswered { object: Object { index, sub }, writes, within_ms } => format!(
                "it does not answer within {within_ms} ms, {ATTEMPTS} times in a row, when \
                 {index:#06x}:{sub} is {}: raise sdo_timeout, or check that it has this object",
                if writes { "written" } else { "read" }
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

/// What a SyncManager is for.
fn part(usage: u8) -> &'static str {
    ["", "mailbox out", "mailbox in", "outputs", "inputs"].get(usize::from(usage)).unwrap_or(&"a buffer")
}

/// The notes of all slaves of a segment.
#[derive(Clone, Debug, Default)]
pub struct Notes(Arc<[AtomicU64]>);

impl Notes {
    /// So many, all empty.
    pub fn new(count: usize) -> Notes {
        Notes((0..count).map(|_| AtomicU64::new(0)).collect())
    }

    /// Adds its memory, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.0);
    }

    /// Writes the note of slave `index`.
    pub fn set(&self, index: usize, note: Note) {
        if let Some(word) = self.0.get(index) {
            word.store(note.pack(), Ordering::Relaxed);
        }
    }

    /// Reads the note of slave `index`.
    pub fn get(&self, index: usize) -> Note {
        self.0.get(index).map_or(Note::None, |word| Note::unpack(word.load(Ordering::Relaxed)))
    }
}

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
            Note::StartUp { object: Object::new(0x1C12, 1), abort: AbortCode(0x0602_0000) },
            Note::StartUp { object: Object::new(0x6060, 0), abort: AbortCode(object::FULL) },
            Note::Omitted { object: Object::new(0x60C2, 2), abort: AbortCode(0x0601_0002) },
            Note::Omitted { object: Object::new(0xFFFF, 255), abort: AbortCode(u32::MAX) },
            Note::Watchdog,
            Note::Manager(3),
            Note::Unarmed,
            Note::NoManagers,
            Note::WaitsForClock,
            Note::WaitsForLock(None),
            Note::WaitsForLock(Some(-123_456)),
            Note::FoundRunning,
            Note::Starting,
            Note::Differs { object: Object::new(0x608F, 1), found: 1 << 20 },
            Note::Unsettled,
            Note::AddressTwice,
            Note::Unanswered { object: Object::new(0x608F, 1), writes: false, within_ms: 2_000 },
            Note::Unanswered { object: Object::new(0x1C12, 1), writes: true, within_ms: 100 },
            Note::OtherTime(7),
            Note::Intruded,
            Note::OwnValue { object: Object::new(0x60E0, 0), abort: AbortCode(0x0602_0000) },
            Note::NotDone(Missing { register: 0x0910, is_write: true }),
        ];
        let notes = Notes::new(1);
        for note in all {
            notes.set(0, note);
            assert_eq!(notes.get(0), note);
            assert_eq!(note.text(4, &Expected::default()).is_none(), note == Note::None);
        }
        assert_eq!(
            all.iter()
                .find(|note| matches!(note, Note::State { .. }))
                .unwrap()
                .text(1, &Expected::default())
                .unwrap(),
            "place 1: it refuses SAFEOP: AL status code 0x001d (invalid output configuration)"
        );
        for (number, fault) in Fault::ALL.into_iter().enumerate() {
            assert_eq!((fault as usize, Note::unpack(Note::Sii(fault).pack())), (number, Note::Sii(fault)));
        }
        assert_eq!(notes.get(7), Note::None);
    }
}
