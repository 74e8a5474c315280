//! Why a slave is not in operation, for normal threads: written by the cycle without a lock, made text by the
//! reader.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::bus::ethercat::wire::registers::{AlCode, AlState};
use crate::bus::ethercat::wire::sdo::{AbortCode, Object};
use crate::rt::Regions;

/// Why a slave is not in operation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Note {
    /// It is, or nothing is known yet.
    #[default]
    None,
    /// No slave answers at its position.
    Absent,
    /// Its SII cannot be read.
    Sii,
    /// Its vendor is not the configured one.
    Vendor(u32),
    /// It is another product.
    Product(u32),
    /// It is another revision.
    Revision(u32),
    /// The slave there is the one of another position.
    WrongPlace(u16),
    /// Its SII has a SyncManager with other values.
    SyncManager {
        /// 1 mailbox out, 2 in, 3 outputs, 4 inputs.
        usage: u8,
        /// Its start there.
        start: u16,
        /// Its length there, bytes.
        length: u16,
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
    /// It did not enter a state in time, without an error code.
    Slow(AlState),
    /// It did not accept a value at start-up.
    StartUp {
        /// The object.
        object: Object,
        /// The abort code; 0: none.
        abort: AbortCode,
    },
    /// Its watchdog does not read back as set.
    Watchdog,
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
    /// Another slave has its station address.
    AddressTwice,
    /// A read of an object is not answered.
    Unread(Object),
    /// The slave at this position runs on a time other than the segment's.
    OtherTime(u16),
}

/// Numbers of the notes, in the highest byte.
impl Note {
    /// Those without a value: their number is their index, the others follow from 80h on.
    const PLAIN: [Note; 12] = [
        Note::None,
        Note::Absent,
        Note::Sii,
        Note::NoClock,
        Note::NoLrw,
        Note::NoCoe,
        Note::Watchdog,
        Note::WaitsForClock,
        Note::FoundRunning,
        Note::Starting,
        Note::Unsettled,
        Note::AddressTwice,
    ];

    fn pack(self) -> u64 {
        let number = |kind: u8, high: u32, low: u32| {
            u64::from(kind) << 56 | u64::from(high & 0xFF_FFFF) << 32 | u64::from(low)
        };
        match self {
            Note::Vendor(found) => number(0x80, 0, found),
            Note::Product(found) => number(0x81, 0, found),
            Note::Revision(found) => number(0x82, 0, found),
            Note::WrongPlace(place) => number(0x83, 0, place.into()),
            Note::SyncManager { usage, start, length } => {
                number(0x84, usage.into(), u32::from(start) << 16 | u32::from(length))
            }
            Note::Fmmus(count) => number(0x85, 0, count.into()),
            Note::State { to, code } => number(0x86, to.number().into(), code.0.into()),
            Note::Slow(to) => number(0x87, to.number().into(), 0),
            Note::StartUp { object, abort } => number(0x88, object.key(), abort.0),
            Note::WaitsForLock(error) => {
                number(0x89, u32::from(error.is_some()), error.unwrap_or_default().cast_unsigned())
            }
            Note::Differs { object, found } => number(0x8a, object.key(), found),
            Note::Unread(object) => number(0x8b, object.key(), 0),
            Note::OtherTime(place) => number(0x8c, 0, place.into()),
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
        match kind {
            0x80 => Note::Vendor(low),
            0x81 => Note::Product(low),
            0x82 => Note::Revision(low),
            0x83 => Note::WrongPlace(low as u16),
            0x84 => Note::SyncManager { usage: high as u8, start: (low >> 16) as u16, length: low as u16 },
            0x85 => Note::Fmmus(low as u8),
            0x86 => Note::State { to: state(), code: AlCode(low as u16) },
            0x87 => Note::Slow(state()),
            0x88 => Note::StartUp { object: object(), abort: AbortCode(low) },
            0x89 => Note::WaitsForLock((high != 0).then_some(low.cast_signed())),
            0x8a => Note::Differs { object: object(), found: low },
            0x8b => Note::Unread(object()),
            0x8c => Note::OtherTime(low as u16),
            _ => Note::PLAIN.get(usize::from(kind)).copied().unwrap_or_default(),
        }
    }

    /// In words, for the slave at this position; `None`: there is nothing to report.
    pub fn text(self, place: u16) -> Option<String> {
        let what = match self {
            Note::None => return None,
            Note::Absent => "nothing answers there: look at its power and at the cable in front of it".into(),
            Note::Sii => "its SII cannot be read: look whether another master holds it".into(),
            Note::Vendor(found) => format!("its vendor is {found:#010x}: correct vendor, or the order of the segment"),
            Note::Product(found) => {
                format!("its product is {found:#010x}: correct product, or the order of the segment")
            }
            Note::Revision(found) => format!("its revision is {found:#010x}: correct revision, or leave it out"),
            Note::WrongPlace(other) => {
                format!("the slave there is the one of place {other}: look at the order of the cables")
            }
            Note::SyncManager { usage, start, length } => {
                let what = ["", "mailbox out", "mailbox in", "outputs", "inputs"].get(usize::from(usage));
                let what = what.unwrap_or(&"a buffer");
                format!("its SII has {what} at {start:#06x}, {length} bytes: correct the configuration")
            }
            Note::Fmmus(count) => {
                format!("it has {count} FMMUs, too few for outputs and inputs: leave one of them out")
            }
            Note::NoClock => "it has no distributed clock: take sync = false".into(),
            Note::NoLrw => "it does not know LRW: take lrw = false for its bus".into(),
            Note::NoCoe => "its SII names no CoE: leave out mailbox, or check the order of the segment".into(),
            Note::State { to, code } => {
                format!("it refuses {to}: AL status code {:#06x} ({})", code.0, code.name().unwrap_or("not known"))
            }
            Note::Slow(to) => format!("it does not enter {to}, and gives no error code"),
            Note::StartUp { object, abort: AbortCode(0) } => {
                format!("it does not answer when {:#06x}:{} is written", object.index, object.sub)
            }
            Note::StartUp { object, abort } => format!(
                "it refuses what is written to {:#06x}:{}: abort code {:#010x} ({})",
                object.index,
                object.sub,
                abort.0,
                abort.name().unwrap_or("not known")
            ),
            Note::Watchdog => "its watchdog does not read back as set".into(),
            Note::WaitsForClock => "it waits for the clock of the first slave with sync".into(),
            Note::WaitsForLock(None) => "it waits for the grid to meet its SYNC0, and for its clock to be seen".into(),
            Note::WaitsForLock(Some(error)) => {
                // Rounded to ten microseconds: a reader that reports each new text shall not report each cycle.
                let far = (error.unsigned_abs() + 5_000) / 10_000 * 10;
                let side = if error < 0 { "early" } else { "late" };
                format!("it waits for the grid to meet its SYNC0: a slot is about {far} us {side}")
            }
            Note::FoundRunning => {
                "it was found in OP with other process data: stop it by its own master, or take on_found_running = \
                \"stop\""
                    .into()
            }
            Note::Starting => "it is being brought up".into(),
            Note::Differs { object: Object { index: 0x608F, sub: 1 }, found } => format!(
                "its increments per turn (0x608f:1) are {found}, not 2 to the power of prbase: correct prbase, or \
                use check_prbase = false"
            ),
            Note::Differs { object: Object { index, sub }, found } => {
                format!("its {index:#06x}:{sub} is {found} ({found:#x}), not as configured: correct one of them")
            }
            Note::Unsettled => "its clock does not synchronise with that of the segment: check its distributed \
                clock".into(),
            Note::AddressTwice => "another slave has its station address: switch that one off and on".into(),
            Note::Unread(object) => {
                format!("it does not answer when {:#06x}:{} is read", object.index, object.sub)
            }
            Note::OtherTime(other) => format!(
                "the slave at place {other} runs on a clock that another master has set, and would lose it: stop \
                that slave, or switch it off"
            ),
        };
        Some(format!("place {place}: {what}"))
    }
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
            Note::Sii,
            Note::Vendor(0x6A),
            Note::Product(0x0300_0600),
            Note::Revision(u32::MAX),
            Note::WrongPlace(3),
            Note::SyncManager { usage: 3, start: 0x1100, length: 6 },
            Note::Fmmus(2),
            Note::NoClock,
            Note::NoLrw,
            Note::NoCoe,
            Note::State { to: AlState::SafeOp, code: AlCode(0x1D) },
            Note::Slow(AlState::Op),
            Note::StartUp { object: Object::new(0x1C12, 1), abort: AbortCode(0x0602_0000) },
            Note::StartUp { object: Object::new(0x6060, 0), abort: AbortCode(0) },
            Note::Watchdog,
            Note::WaitsForClock,
            Note::WaitsForLock(None),
            Note::WaitsForLock(Some(-123_456)),
            Note::FoundRunning,
            Note::Starting,
            Note::Differs { object: Object::new(0x608F, 1), found: 1 << 20 },
            Note::Unsettled,
            Note::AddressTwice,
            Note::Unread(Object::new(0x608F, 1)),
            Note::OtherTime(7),
        ];
        let notes = Notes::new(1);
        for note in all {
            notes.set(0, note);
            assert_eq!(notes.get(0), note);
            assert_eq!(note.text(4).is_none(), note == Note::None);
        }
        assert_eq!(
            all[12].text(1).unwrap(),
            "place 1: it refuses SAFEOP: AL status code 0x001d (invalid output configuration)"
        );
        assert_eq!(notes.get(7), Note::None);
    }
}
