//! The native process data of the drives that are chosen for a recording: read back from their buses in the cycle in
//! which they were received and sent, so that all other drives pay nothing for it.

use super::Engine;
use crate::bus::native::{NativeBytes, WantedOutputs};
use crate::bus::{Cycle, Slot};
use crate::cycle::record::{NativeRecord, Record, short};
use crate::cycle::ring::RecordWriter;
use crate::cycle::window::OpenBus;
use crate::rt::{Clock, Regions};
use crate::time::Time;

/// The chosen drives.
#[derive(Debug, Default)]
pub(super) struct Natives {
    drives: Box<[Chosen]>,
    /// The most records that all of them make at once.
    records: usize,
    /// Where the bytes of one drive after the other are put together.
    bytes: Box<NativeBytes>,
}

/// One of them.
#[derive(Debug)]
struct Chosen {
    axis: usize,
    /// The place of its bus, and its index there.
    bus: usize,
    index: usize,
    /// The newest inputs that were recorded were taken in then.
    received_at: Time,
    /// The newest outputs that were recorded left then.
    sent_at: Time,
    /// The number of its exchanges answered by then.
    answered: u64,
}

impl Natives {
    /// Adds what a cycle touches, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.drives);
        regions.add(&*self.bytes);
    }

    /// There are none.
    #[inline]
    pub(super) fn are_none(&self) -> bool {
        self.drives.is_empty()
    }
}

/// When native process data are read back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Moment {
    /// The requests have left, or wait for their turn. Only drives that have answered or reported since the last window
    /// are of interest: this one may replace their inputs.
    Sent,
    /// The window is over.
    Received,
}

impl<C: Clock> Engine<C> {
    /// Records the native process data of these axes from now on, which take at most so many records at once.
    pub fn record_native(&mut self, axes: impl Iterator<Item = usize>, records: usize) {
        let place = |axis: usize| {
            let bus = self.buses.iter().position(|open| (open.first..open.end).contains(&axis))?;
            let index = axis - self.buses[bus].first;
            Some(Chosen { axis, bus, index, received_at: Time(0), sent_at: Time(0), answered: 0 })
        };
        self.natives.drives = axes.filter_map(place).collect();
        self.natives.records = records;
    }

    /// Reports what the chosen drives have received and were sent in `cycle` since it was reported last.
    #[inline(never)]
    pub(super) fn report_native(&mut self, cycle: &Cycle, moment: Moment) {
        let Engine { natives: Natives { drives, records, bytes }, buses, slots, channels, status, .. } = self;
        let next = NativeRecord {
            index: cycle.index,
            received_ns: 0,
            axis: 0,
            total: 0,
            inputs: 0,
            offset: 0,
            bytes: [0; NativeRecord::PART],
        };
        let parts = Parts { drives: drives.iter_mut(), buses, slots, cycle, moment, bytes, next };
        status.lost_records += send(&mut channels.records, *records, parts);
    }
}

/// Puts records into the ring, `most` at most: they are built there. Returns how many were lost.
#[inline]
fn send(ring: &mut RecordWriter, most: usize, mut records: impl Iterator<Item = Record>) -> u64 {
    ring.push_some(most, records.by_ref());
    records.count() as u64
}

/// The records of one drive after the other.
struct Parts<'a> {
    drives: std::slice::IterMut<'a, Chosen>,
    buses: &'a mut [OpenBus],
    slots: &'a [Slot],
    cycle: &'a Cycle,
    moment: Moment,
    /// Those of the newest drive.
    bytes: &'a mut NativeBytes,
    /// The next record of it, without its part.
    next: NativeRecord,
}

impl Parts<'_> {
    /// Goes on to the next drive that has something to report; there may be none.
    #[inline(always)]
    fn next_drive(&mut self) -> Option<()> {
        let Parts { drives, buses, slots, cycle, moment, bytes, next } = self;
        loop {
            let chosen = drives.next()?;
            let Some(slot) = slots.get(chosen.axis) else { continue };
            let answered = std::mem::replace(&mut chosen.answered, slot.counters.answered);
            if *moment == Moment::Sent && !slot.notices.fresh && slot.counters.answered == answered {
                continue;
            }
            let Some(open) = buses.get_mut(chosen.bus) else { continue };
            let sent_at = slot.exchange.sent_at().unwrap_or_default();
            let outputs = match moment {
                _ if sent_at < cycle.grid || sent_at <= chosen.sent_at => WantedOutputs::Never,
                Moment::Sent => WantedOutputs::WithInputs,
                Moment::Received => WantedOutputs::Always,
            };
            open.is_at_work = true;
            bytes.clear();
            let received_at = open.bus.native(chosen.index).and_then(|(inputs, outgoing)| {
                let received_at = bytes.take(inputs, chosen.received_at);
                if outputs.is_now(received_at) {
                    bytes.put(outgoing);
                    chosen.sent_at = sent_at;
                }
                received_at
            });
            open.is_at_work = false;
            next.received_ns = 0;
            if let Some(at) = received_at {
                chosen.received_at = at;
                next.received_ns = short(at.since(cycle.grid));
            }
            (next.axis, next.offset) = (chosen.axis as u16, 0);
            (next.inputs, next.total) = (bytes.inputs() as u16, bytes.length() as u16);
            if next.total > 0 {
                return Some(());
            }
        }
    }
}

impl Iterator for Parts<'_> {
    type Item = Record;

    #[inline(always)]
    fn next(&mut self) -> Option<Record> {
        if self.next.offset >= self.next.total {
            self.next_drive()?;
        }
        let record = NativeRecord { bytes: *self.bytes.part(self.next.offset.into())?, ..self.next };
        self.next.offset += NativeRecord::PART as u16;
        Some(Record::Native(record))
    }
}

const _: () = assert!(NativeBytes::MOST + NativeRecord::PART <= u16::MAX as usize, "each part has its place");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cycle::record::SkippedRecord;
    use crate::cycle::ring::{self, Kept};

    #[test]
    fn a_ring_without_room_for_all_takes_what_fits_and_the_rest_is_lost() {
        let (mut ring, mut records, _) = ring::records(5, Kept::default(), &mut Regions::new());
        let of = |from: u64, count: u64| {
            (from..from + count).map(|first| Record::Skipped(SkippedRecord { first, ..Default::default() }))
        };
        assert_eq!(send(&mut ring, 4, of(0, 2)), 0, "fewer than there may be");
        // There is room for them, and not for as many as there may be.
        assert_eq!(send(&mut ring, 4, of(2, 2)), 0);
        assert_eq!(send(&mut ring, 4, of(4, 4)), 3);
        let taken: Vec<u64> = std::iter::from_fn(|| records.next()).map(Record::index).collect();
        assert_eq!(taken, [0, 1, 2, 3, 4]);
        // As soon as they are taken there is room for all.
        records.release();
        assert_eq!(send(&mut ring, 4, of(9, 4)), 0);
    }
}
