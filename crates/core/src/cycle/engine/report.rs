//! What a cycle publishes: feedback, records, and the numbers of the loop.

use super::panics::Part;
use super::{Channels, Engine};
use crate::cycle::record::{CycleRecord, Look, Record};
use crate::cycle::window::OpenBus;
use crate::drive::controller::DriveController;
use crate::rt::Clock;

impl Channels {
    /// Sends a record to the telemetry, or counts it as lost.
    pub(super) fn record(&mut self, record: Record, lost: &mut u64) {
        *lost += u64::from(self.records.push(record).is_err());
    }

    /// Sends the commands that an axis has taken, and its events, to the telemetry.
    fn notes(&mut self, axis: usize, controller: &mut DriveController, lost: &mut u64) {
        while let Some(note) = controller.take_note(axis as u16) {
            self.record(note.into(), lost);
        }
        *lost += controller.take_lost_notes();
    }

    /// Publishes a drive, with the monitored variables that it has shown.
    #[inline(always)] // In the usual cycle.
    fn publish(&mut self, axis: usize, controller: &mut DriveController, lost: &mut u64) {
        self.record(Record::Drive(controller.publish(axis as u16)), lost);
        if let Some(record) = controller.take_shown(axis as u16) {
            self.record(Record::Monitor(record), lost);
        }
    }
}

impl<C: Clock> Engine<C> {
    /// Reports an executed cycle. If it was late, it also reads, with a system call, what the kernel has counted
    /// against this thread.
    pub(super) fn account(&mut self, mut record: CycleRecord) {
        self.was_late = record.lateness(self.late_ns, self.deadline_ns).is_some();
        if self.was_late {
            self.status.late += 1;
            record.look = Some(self.look());
        }
        self.record(Record::Cycle(record));
    }

    pub(super) fn look(&mut self) -> Look {
        let usage = self.clock.usage();
        Look { faults: usage.page_faults() as u32, switches: usage.involuntary_switches as u32 }
    }

    pub(super) fn publish(&mut self) {
        let turn = self.status.executed;
        // The records are built in the ring, if each drive has one and there is room for all of them.
        let axes = self.controllers.len();
        let room = if self.shows { None } else { self.channels.records.write_chunk_uninit(axes).ok() };
        let (mut lost, mut noted) = (0, false);
        match room {
            Some(room) => {
                room.fill_from_iter(self.controllers.iter_mut().enumerate().map(|(axis, controller)| {
                    noted |= controller.has_notes();
                    let record = controller.publish(axis as u16);
                    lost += controller.lost();
                    Record::Drive(record)
                }));
            }
            None => (lost, noted) = self.publish_each(),
        }
        if noted {
            self.publish_notes();
        }
        // Those whose turn it is.
        let (axes, every) = (self.axes.len(), self.numbers_every);
        let first = (every - turn % every) % every;
        for axis in (first as usize..axes).step_by(every as usize) {
            self.axes[axis].numbers.write(&self.controllers[axis].numbers(&self.slots[axis]));
        }
        if first == 0 {
            self.buses.iter_mut().for_each(OpenBus::publish);
        }
        self.status.planned = self.grid.planned() + 1;
        self.status.lost_events = lost;
        self.publish_status();
    }

    /// Publishes one drive after the other, with the monitored variables that it has shown. Returns how many events and
    /// samples were lost so far, and whether an axis has notes.
    #[inline(never)]
    pub(super) fn publish_each(&mut self) -> (u64, bool) {
        let (mut lost, mut noted) = (0, false);
        let (channels, lost_records) = (&mut self.channels, &mut self.status.lost_records);
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            noted |= controller.has_notes();
            match self.panics.each {
                false => channels.publish(axis, controller, lost_records),
                true => {
                    let publish = || channels.publish(axis, controller, lost_records);
                    self.panics.guard(Part::Axis(axis), publish);
                }
            }
            lost += controller.lost();
        }
        (lost, noted)
    }

    /// Publishes the commands that the axes have taken, and their events.
    #[inline(never)]
    pub(super) fn publish_notes(&mut self) {
        let (channels, lost) = (&mut self.channels, &mut self.status.lost_records);
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            match self.panics.each {
                false => channels.notes(axis, controller, lost),
                true => {
                    self.panics.guard(Part::Axis(axis), || channels.notes(axis, controller, lost));
                }
            }
        }
    }

    /// Publishes the numbers of the loop; what changes only now and then, only if it has changed.
    pub(super) fn publish_status(&mut self) {
        match std::mem::take(&mut self.changed) || self.status.reference.is_some() {
            true => self.channels.status.write(&self.status),
            false => self.channels.status.write_words(self.status.counts().into_iter()),
        }
    }

    pub(super) fn record(&mut self, record: Record) {
        self.channels.record(record, &mut self.status.lost_records);
    }
}
