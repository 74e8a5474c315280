//! Records from the bytes of a memory that a process has left behind. The loop stores them as they are, so their
//! layout is fixed: each is `repr(C)` behind a byte for its kind, and what the language leaves open is asserted below.
//! Bytes are no records before they were looked at: a number that means nothing makes them none.

use std::mem::offset_of;
use std::num::NonZeroU32;

use super::record::{
    CommandRecord, CycleRecord, DriveFlags, DriveRecord, EventRecord, Look, MonitorRecord, NativeRecord,
    Record, ReferenceRecord, Reply, SkippedRecord,
};
use crate::axis::{CommandId, Link, Shown, State, StopCause};
use crate::drive::record::What;
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

/// A value at the begin of bytes; `None` if they are too few, or mean nothing.
trait Stored: Sized {
    fn load(bytes: &[u8]) -> Option<Self>;
}

macro_rules! numbers {
    ($($number:ty),+) => {$(impl Stored for $number {
        fn load(bytes: &[u8]) -> Option<$number> {
            bytes.first_chunk().map(|bytes| <$number>::from_ne_bytes(*bytes))
        }
    })+};
}

numbers!(u8, u16, u32, i32, u64, f32, f64);

/// Values that are a number each.
macro_rules! numbered {
    ($($type:ty: $of:expr;)+) => {$(impl Stored for $type {
        fn load(bytes: &[u8]) -> Option<$type> {
            Stored::load(bytes).and_then($of)
        }
    })+};
}

numbered! {
    bool: |byte: u8| (byte < 2).then_some(byte == 1);
    Time: |ns: u64| Some(Time(ns));
    CommandId: |id: u64| Some(CommandId(id));
    DriveFlags: DriveFlags::of;
    Reply: |number: u8| Reply::ALL.get(usize::from(number)).copied();
    Link: |number: u8| Link::ALL.get(usize::from(number)).copied();
    State: |number: u8| State::ALL.get(usize::from(number)).copied();
    What: What::of;
    Option<StopCause>: |number: u8| match number {
        0 => Some(None),
        number => StopCause::of(number.into()).map(Some),
    };
    Option<NonZeroU32>: |number: u32| Some(NonZeroU32::new(number));
}

impl<T: Stored, const N: usize> Stored for [T; N] {
    fn load(bytes: &[u8]) -> Option<[T; N]> {
        let values = (0..N).map_while(|at| T::load(bytes.get(at * size_of::<T>()..)?));
        values.collect::<Vec<T>>().try_into().ok()
    }
}

/// A flag of its own in front.
impl Stored for Option<i32> {
    fn load(bytes: &[u8]) -> Option<Option<i32>> {
        let [is_some, value] = Stored::load(bytes)?;
        (0..2).contains(&is_some).then(|| (is_some == 1).then_some(value))
    }
}

impl Stored for Option<Look> {
    fn load(bytes: &[u8]) -> Option<Option<Look>> {
        let [is_some, faults, switches] = <[u32; 3]>::load(bytes)?;
        (is_some < 2).then(|| (is_some == 1).then_some(Look { faults, switches }))
    }
}

impl Stored for Shown {
    fn load(bytes: &[u8]) -> Option<Shown> {
        let values = Stored::load(bytes.get(Shown::VALUES_AT..)?)?;
        Shown::from_words(Stored::load(bytes.get(Shown::MASK_AT..)?)?, values)
    }
}

/// A text lies in the memory of the process that has ended.
impl Stored for &'static str {
    fn load(_: &[u8]) -> Option<&'static str> {
        Some("(its name ended with the program)")
    }
}

/// Records from their fields.
macro_rules! stored {
    ($($Name:ident { $($field:ident),+ })+) => {$(impl Stored for $Name {
        fn load(bytes: &[u8]) -> Option<$Name> {
            Some($Name { $($field: Stored::load(bytes.get(offset_of!($Name, $field)..)?)?),+ })
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

impl Record {
    /// The record of bytes that another process has stored; `None` if they are none.
    #[doc(hidden)]
    pub fn load(bytes: &[u8]) -> Option<Record> {
        let content = bytes.get(CONTENT..)?;
        Some(match bytes[0] {
            0 => Record::Drive(Stored::load(content)?),
            1 => Record::Monitor(Stored::load(content)?),
            2 => Record::Reference(Stored::load(content)?),
            3 => Record::Cycle(Stored::load(content)?),
            4 => Record::Skipped(Stored::load(content)?),
            5 => Record::Command(Stored::load(content)?),
            6 => Record::Event(Stored::load(content)?),
            7 => Record::Native(Stored::load(content)?),
            _ => return None,
        })
    }
}
