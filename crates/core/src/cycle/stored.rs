//! Records as bytes, for another process of this computer: in a memory that was left behind, or in a stream. The loop
//! stores them as they are, so their layout is fixed: each is `repr(C)` behind a byte for its kind, and what the
//! language leaves open is asserted below. Bytes are no records before they were looked at: a number that means nothing
//! makes them none.

use std::mem::offset_of;
use std::num::NonZeroU32;

use super::record::{
    CommandRecord, CycleRecord, DriveFlags, DriveRecord, EventRecord, Look, MonitorRecord, NativeRecord,
    Record, ReferenceRecord, Reply, SkippedRecord,
};
use crate::axis::{CommandId, Link, Shown, State, StopCause};
use crate::drive::record::EventCode;
use crate::time::Time;

/// The version of the layout. What it holds for is the size of a record and all that this file reads.
pub const LAYOUT: u32 = 1;

/// Bytes of a record.
pub const RECORD: usize = size_of::<Record>();

/// Where the content of a record begins, behind its kind.
const CONTENT: usize = 8;

// Of an `Option` the language fixes the layout of few types only.
const _: () = {
    assert!(RECORD == 72 && align_of::<Record>() == CONTENT);
    // SAFETY: of the same sizes, which `transmute` checks, and without padding.
    unsafe {
        assert!(std::mem::transmute::<Option<StopCause>, u8>(None) == 0);
        assert!(matches!(std::mem::transmute::<Option<i32>, [i32; 2]>(Some(5)), [1, 5]));
        let look = Some(Look { faults: 5, switches: 6 });
        assert!(matches!(std::mem::transmute::<Option<Look>, [u32; 3]>(look), [1, 5, 6]));
    }
};

/// A value in the first bytes of some.
trait Stored: Sized {
    /// The value; `None` if the bytes are too few, or mean nothing.
    fn load(bytes: &[u8]) -> Option<Self>;
    /// Writes it; there is room for it.
    fn store(&self, bytes: &mut [u8]);
}

macro_rules! numbers {
    ($($number:ty),+) => {$(impl Stored for $number {
        fn load(bytes: &[u8]) -> Option<$number> {
            bytes.first_chunk().map(|bytes| <$number>::from_ne_bytes(*bytes))
        }

        fn store(&self, bytes: &mut [u8]) {
            bytes[..size_of::<$number>()].copy_from_slice(&self.to_ne_bytes());
        }
    })+};
}

numbers!(u8, u16, u32, i32, u64, f32, f64);

/// Values that are a number each.
macro_rules! numbered {
    ($($type:ty as $number:ty: $of:expr, $to:expr;)+) => {$(impl Stored for $type {
        fn load(bytes: &[u8]) -> Option<$type> {
            <$number>::load(bytes).and_then($of)
        }

        fn store(&self, bytes: &mut [u8]) {
            let number: $number = $to(*self);
            number.store(bytes);
        }
    })+};
}

numbered! {
    bool as u8: |byte| (byte < 2).then_some(byte == 1), u8::from;
    Time as u64: |ns| Some(Time(ns)), |time: Time| time.0;
    CommandId as u64: |id| Some(CommandId(id)), |id: CommandId| id.0;
    DriveFlags as u8: DriveFlags::of, DriveFlags::bits;
    Reply as u8: |number| Reply::ALL.get(usize::from(number)).copied(), |reply| reply as u8;
    Link as u8: |number| Link::ALL.get(usize::from(number)).copied(), |link| link as u8;
    State as u8: |number| State::ALL.get(usize::from(number)).copied(), |state| state as u8;
    EventCode as u8: EventCode::of, |what| what as u8;
    Option<NonZeroU32> as u32: |number| Some(NonZeroU32::new(number)), |number: Option<_>| {
        number.map_or(0, NonZeroU32::get)
    };
    Option<StopCause> as u8: |number| match number {
        0 => Some(None),
        number => StopCause::of(number.into()).map(Some),
    }, |cause: Option<_>| cause.map_or(0, |cause| cause as u8);
    // A flag of its own in front.
    Option<i32> as [i32; 2]: |[is_some, value]| (0..2).contains(&is_some).then(|| (is_some == 1).then_some(value)),
        |value: Option<_>| [value.is_some().into(), value.unwrap_or_default()];
    Option<Look> as [u32; 3]: |[is_some, faults, switches]| {
        (is_some < 2).then(|| (is_some == 1).then_some(Look { faults, switches }))
    }, |look: Option<Look>| {
        let Look { faults, switches } = look.unwrap_or_default();
        [look.is_some().into(), faults, switches]
    };
}

impl<T: Stored, const N: usize> Stored for [T; N] {
    fn load(bytes: &[u8]) -> Option<[T; N]> {
        let values = (0..N).map_while(|at| T::load(bytes.get(at * size_of::<T>()..)?));
        values.collect::<Vec<T>>().try_into().ok()
    }

    fn store(&self, bytes: &mut [u8]) {
        let places = bytes.chunks_mut(size_of::<T>());
        self.iter().zip(places).for_each(|(value, bytes)| value.store(bytes));
    }
}

impl Stored for Shown {
    fn load(bytes: &[u8]) -> Option<Shown> {
        let values = Stored::load(bytes.get(Shown::VALUES_AT..)?)?;
        Shown::from_words(Stored::load(bytes.get(Shown::MASK_AT..)?)?, values)
    }

    fn store(&self, bytes: &mut [u8]) {
        let (mask, values) = self.to_words();
        mask.store(&mut bytes[Shown::MASK_AT..]);
        values.store(&mut bytes[Shown::VALUES_AT..]);
    }
}

/// A text lies in the memory of the process that has it.
impl Stored for &'static str {
    fn load(_: &[u8]) -> Option<&'static str> {
        Some("(its name ended with the program)")
    }

    fn store(&self, _: &mut [u8]) {}
}

/// Records from their fields.
macro_rules! stored {
    ($($Name:ident { $($field:ident),+ })+) => {$(impl Stored for $Name {
        fn load(bytes: &[u8]) -> Option<$Name> {
            Some($Name { $($field: Stored::load(bytes.get(offset_of!($Name, $field)..)?)?),+ })
        }

        fn store(&self, bytes: &mut [u8]) {
            $(self.$field.store(&mut bytes[offset_of!($Name, $field)..]);)+
        }
    })+};
}

stored! {
    DriveRecord {
        index, position, demand, velocity, current, phase_ns, jitter_ns, rtt_ns, age_ns, fault, warning, axis, reply,
        link, state, stopped, command, flags
    }
    MonitorRecord { index, axis, shown }
    ReferenceRecord { index, error_ns, step_ns, locked, counts }
    CycleRecord { index, grid, wake_ns, jitter_ns, stages_ns, look, missed, spun }
    SkippedRecord { first, grid, count, late_ns, given_up_ns, woke_late, late, spun, look }
    CommandRecord { index, id, words }
    EventRecord { index, id, text, values, number, axis, what, code }
    NativeRecord { index, received_ns, axis, total, inputs, offset, bytes }
}

/// The kinds of records, each by the number that stands in front of it.
macro_rules! kinds {
    ($($number:literal: $Kind:ident,)+) => {
        impl Record {
            /// The record of bytes that another process has stored; `None` if they are none.
            #[doc(hidden)]
            pub fn load(bytes: &[u8]) -> Option<Record> {
                let content = bytes.get(CONTENT..)?;
                match bytes[0] {
                    $($number => Stored::load(content).map(Record::$Kind),)+
                    _ => None,
                }
            }

            /// The bytes as they lie in memory, for another process of this computer. What is only a text is not in
            /// them.
            #[doc(hidden)]
            pub fn store(&self) -> [u8; RECORD] {
                let mut bytes = [0; RECORD];
                bytes[0] = match self {
                    $(Record::$Kind(record) => {
                        record.store(&mut bytes[CONTENT..]);
                        $number
                    })+
                };
                bytes
            }
        }
    };
}

kinds! {
    0: Drive,
    1: Monitor,
    2: Reference,
    3: Cycle,
    4: Skipped,
    5: Command,
    6: Event,
    7: Native,
}
