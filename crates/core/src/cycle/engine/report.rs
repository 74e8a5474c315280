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
        *lost += u64::from(!self.records.push(record));
    }

    /// Sends the commands that an axis has taken, and its events, to the telemetry. Returns how many events and samples
    /// the axis has lost.
    fn notes(&mut self, axis: usize, controller: &mut DriveController, lost: &mut u64) -> u64 {
        while let Some(note) = controller.take_note(axis as u16) {
            self.record(note.into(), lost);
        }
        *lost += controller.take_lost_notes();
        controller.take_lost()
    }

    /// Publishes a drive, with the monitored variables that it has shown. Returns whether it has notes or losses.
    #[inline(always)] // In the usual cycle.
    fn publish(&mut self, axis: usize, controller: &mut DriveController, lost: &mut u64) -> bool {
        let mut noted = false;
        self.record(Record::Drive(controller.publish(axis as u16, &mut noted)), lost);
        if let Some(record) = controller.take_shown(axis as u16) {
            self.record(Record::Monitor(record), lost);
        }
        noted
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
        // The records are built in the ring, if each drive has one and there is room for all of them.
        let axes = self.controllers.len();
        let mut noted = false;
        let records = self.controllers.iter_mut().enumerate();
        let records =
            records.map(|(axis, controller)| Record::Drive(controller.publish(axis as u16, &mut noted)));
        if self.shows || !self.channels.records.push_all(axes, records) {
            noted = self.publish_each();
        }
        if noted {
            self.publish_notes();
        }
        // Those whose turn it is: from this one on, one in so many.
        self.numbers_turn = self.numbers_turn.checked_sub(1).unwrap_or(self.numbers_every - 1);
        let mut axis = self.numbers_turn;
        while let Some(outlet) = self.axes.get_mut(axis) {
            outlet.numbers.write(&self.controllers[axis].numbers(&self.slots[axis]));
            axis += self.numbers_every;
        }
        if self.numbers_turn == 0 {
            self.buses.iter_mut().for_each(OpenBus::publish);
        }
        self.status.planned = self.grid.planned() + 1;
        self.publish_status();
    }

    /// Publishes one drive after the other, with the monitored variables that it has shown. Returns whether an axis has
    /// notes or losses.
    #[inline(never)]
    pub(super) fn publish_each(&mut self) -> bool {
        let mut noted = false;
        let (channels, lost) = (&mut self.channels, &mut self.status.lost_records);
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            let publish = || channels.publish(axis, controller, lost);
            noted |= self.panics.run(Part::Axis(axis), publish).unwrap_or(false);
        }
        noted
    }

    /// Publishes the commands that the axes have taken, and their events.
    #[inline(never)]
    pub(super) fn publish_notes(&mut self) {
        let (channels, lost) = (&mut self.channels, &mut self.status.lost_records);
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            let notes = || channels.notes(axis, controller, lost);
            self.status.lost_events += self.panics.run(Part::Axis(axis), notes).unwrap_or(0);
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
