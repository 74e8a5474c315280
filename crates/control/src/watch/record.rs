//! The bytes of a record in a stream. Integers and floats are little-endian.

use std::num::NonZeroU32;

use fieldbeat_core::axis::{Link, Shown, State, StopCause};
use fieldbeat_core::cycle::record::{
    CycleRecord, DriveRecord, MonitorRecord, Record, ReferenceRecord, Reply, SkippedRecord,
};

/// Bytes of a record.
pub const RECORD: usize = 72;

/// Appends the bytes of a record.
pub fn put(record: &Record, bytes: &mut Vec<u8>) {
    let end = bytes.len() + RECORD;
    // What is written is never refused.
    let _ = pass(&mut record.clone(), &mut Bytes::To(bytes));
    bytes.resize(end, 0);
}

/// A record; `None` if a number in it has no meaning here.
pub fn get(bytes: &[u8], axes: usize) -> Option<Record> {
    let mut record = match bytes.first()? {
        1 => Record::Drive(DriveRecord::default()),
        2 => Record::Cycle(CycleRecord::default()),
        3 => Record::Skipped(SkippedRecord::default()),
        4 => Record::Monitor(MonitorRecord::default()),
        5 => Record::Reference(ReferenceRecord::default()),
        _ => return None,
    };
    pass(&mut record, &mut Bytes::From(bytes))?;
    match record {
        Record::Drive(DriveRecord { axis, .. }) | Record::Monitor(MonitorRecord { axis, .. }) => {
            (usize::from(axis) < axes).then_some(record)
        }
        _ => Some(record),
    }
}

/// A record to bytes, or bytes to a record of their kind: one description of the layout for both ways. `None` if a
/// number of the bytes has no meaning here.
fn pass(record: &mut Record, bytes: &mut Bytes<'_>) -> Option<()> {
    match record {
        Record::Drive(d) => {
            1_u8.pass(bytes)?;
            d.reply = bytes.one_of(d.reply as u8, &Reply::ALL)?;
            d.link = bytes.one_of(d.link as u8, &Link::ALL)?;
            d.state = bytes.one_of(d.state as u8, &State::ALL)?;
            let mut stopped = d.stopped.map_or(0, |cause| cause as u8);
            bytes.all(&mut [&mut stopped, &mut d.command])?;
            d.stopped = match usize::from(stopped).checked_sub(1) {
                None => None,
                Some(place) => Some(*StopCause::ALL.get(place)?),
            };
            let (mut moving, mut sto_open, mut was_online) = (d.moving(), d.sto_open(), d.was_online());
            bytes.flags([&mut moving, &mut sto_open, &mut was_online])?;
            d.flags = fieldbeat_core::cycle::record::DriveFlags::new(moving, sto_open, was_online);
            bytes.all(&mut [&mut 0_u8, &mut d.index])?;
            bytes.wide(&mut d.axis)?;
            bytes.all(&mut [&mut d.phase_ns, &mut d.jitter_ns, &mut d.rtt_ns, &mut d.age_ns])?;
            bytes.all(&mut [&mut d.fault, &mut d.warning, &mut d.current, &mut d.velocity])?;
            bytes.all(&mut [&mut d.position, &mut d.demand])?;
        }
        Record::Cycle(c) => {
            let (mut is_known, mut look) = (c.look.is_some(), c.look.unwrap_or_default());
            2_u8.pass(bytes)?;
            bytes.flags([&mut is_known, &mut c.spun])?;
            [0_u8; 2].pass(bytes)?;
            bytes.wide(&mut c.missed)?;
            bytes.all(&mut [&mut c.index, &mut c.grid.0, &mut c.wake_ns, &mut c.jitter_ns])?;
            bytes.all(&mut [&mut c.stages_ns, &mut look.faults, &mut look.switches])?;
            c.look = is_known.then_some(look);
        }
        Record::Skipped(s) => {
            let (mut is_known, mut look) = (s.look.is_some(), s.look.unwrap_or_default());
            3_u8.pass(bytes)?;
            bytes.flags([&mut is_known, &mut s.spun, &mut s.woke_late, &mut s.late])?;
            bytes.all(&mut [&mut [0_u8; 6], &mut s.first, &mut s.grid.0, &mut s.count])?;
            bytes.all(&mut [&mut s.late_ns, &mut s.given_up_ns, &mut look.faults, &mut look.switches])?;
            s.look = is_known.then_some(look);
        }
        Record::Monitor(m) => {
            let (mut mask, mut values) = m.shown.to_words();
            bytes.all(&mut [&mut 4_u8, &mut mask, &mut [0_u8; 2]])?;
            bytes.wide(&mut m.axis)?;
            bytes.all(&mut [&mut m.index, &mut values])?;
            m.shown = Shown::from_words(mask, values)?;
        }
        Record::Reference(r) => {
            let (mut is_known, mut error_ns) = (r.error_ns.is_some(), r.error_ns.unwrap_or_default());
            5_u8.pass(bytes)?;
            bytes.flags([&mut is_known, &mut r.locked, &mut r.counts])?;
            bytes.all(&mut [&mut [0_u8; 6], &mut r.index, &mut error_ns, &mut r.step_ns])?;
            r.error_ns = is_known.then_some(error_ns);
        }
        // Not kept.
        Record::Command(_) | Record::Event(_) | Record::Native(_) => return None,
    }
    Some(())
}

/// The bytes of a record, behind which it is written, or from whose front it is read.
enum Bytes<'a> {
    To(&'a mut Vec<u8>),
    From(&'a [u8]),
}

/// A value of some bytes; `None` where there are too few.
trait Value {
    fn pass(&mut self, bytes: &mut Bytes<'_>) -> Option<()>;
}

macro_rules! numbers {
    ($($number:ty),*) => {$(impl Value for $number {
        fn pass(&mut self, bytes: &mut Bytes<'_>) -> Option<()> {
            match bytes {
                Bytes::To(to) => to.extend_from_slice(&self.to_le_bytes()),
                Bytes::From(from) => {
                    let (taken, rest) = from.split_first_chunk()?;
                    (*self, *from) = (<$number>::from_le_bytes(*taken), rest);
                }
            }
            Some(())
        }
    })*};
}

numbers!(u8, u16, u32, i32, u64, f32, f64);

/// 0 stands for none.
impl Value for Option<NonZeroU32> {
    fn pass(&mut self, bytes: &mut Bytes<'_>) -> Option<()> {
        let mut number = self.map_or(0, NonZeroU32::get);
        number.pass(bytes)?;
        *self = NonZeroU32::new(number);
        Some(())
    }
}

impl<T: Value, const N: usize> Value for [T; N] {
    fn pass(&mut self, bytes: &mut Bytes<'_>) -> Option<()> {
        self.iter_mut().try_for_each(|value| value.pass(bytes))
    }
}

impl Bytes<'_> {
    fn all(&mut self, values: &mut [&mut dyn Value]) -> Option<()> {
        values.iter_mut().try_for_each(|value| value.pass(self))
    }

    /// As 32 bits.
    fn wide(&mut self, value: &mut u16) -> Option<()> {
        let mut wide = u32::from(*value);
        wide.pass(self)?;
        *value = u16::try_from(wide).ok()?;
        Some(())
    }

    /// One of a few values, by its `code`: its place among them.
    fn one_of<T: Copy>(&mut self, mut code: u8, all: &[T]) -> Option<T> {
        code.pass(self)?;
        all.get(usize::from(code)).copied()
    }

    /// A byte, from its lowest bit on.
    fn flags<const N: usize>(&mut self, flags: [&mut bool; N]) -> Option<()> {
        let mut byte = flags.iter().rev().fold(0_u8, |byte, flag| byte << 1 | u8::from(**flag));
        byte.pass(self)?;
        flags.into_iter().enumerate().for_each(|(bit, flag)| *flag = byte >> bit & 1 != 0);
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::Emergency;
    use fieldbeat_core::cycle::record::{Look, measured};
    use fieldbeat_core::time::Time;

    fn records() -> Vec<Record> {
        vec![
            Record::Drive(DriveRecord {
                index: u64::MAX,
                axis: 1,
                reply: Reply::Unsent,
                link: Link::Lost,
                state: State::Fault,
                stopped: Some(StopCause::GroupFailed),
                command: 12,
                moving: true,
                sto_open: true,
                was_online: true,
                phase_ns: measured(1),
                jitter_ns: None,
                rtt_ns: measured(u64::MAX),
                age_ns: measured(4),
                fault: 5,
                warning: 6,
                emergency: Some(Emergency { code: 0x4310, register: 8 }.into()),
                current: -1.5,
                velocity: 2.5,
                position: f64::MIN,
                demand: 1e-9,
            }),
            Record::Monitor(MonitorRecord {
                index: u64::MAX - 1,
                axis: 1,
                shown: [Some(-0.25), None, Some(f64::MAX), None].into(),
            }),
            Record::Reference(ReferenceRecord {
                index: 25,
                error_ns: Some(i32::MIN),
                step_ns: -26,
                locked: true,
                counts: true,
            }),
            Record::Reference(ReferenceRecord { index: 27, ..ReferenceRecord::default() }),
            Record::Cycle(CycleRecord {
                index: 7,
                grid: Time(8),
                wake_ns: 9,
                spun: true,
                jitter_ns: 10,
                stages_ns: [11, 12, 13, 14, 15, 16],
                missed: 17,
                look: Some(Look { faults: 18, switches: 19 }),
            }),
            Record::Skipped(SkippedRecord {
                first: 20,
                grid: Time(21),
                count: 22,
                late_ns: 23,
                given_up_ns: 24,
                woke_late: true,
                late: true,
                spun: false,
                look: None,
            }),
        ]
    }

    #[test]
    fn what_is_sent_is_received_and_an_axis_that_is_not_known_is_none() {
        for record in records() {
            let mut bytes = Vec::new();
            put(&record, &mut bytes);
            assert_eq!((bytes.len(), get(&bytes, 2)), (RECORD, Some(record)));
            let is_of_axis = matches!(record, Record::Drive(_) | Record::Monitor(_));
            assert_eq!(get(&bytes, 1).is_none(), is_of_axis);
        }
    }
}
