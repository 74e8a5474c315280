//! The drives and devices behind the slaves of a segment: the stations of drives, and the ports of devices.

use std::ops::Range;
use std::sync::Arc;

use crate::counters::{DeviceCounters, Own};
use crate::image::Offsets;
use crate::native::TerminalPort;
use crate::plan::{Owner, Start};
use crate::segment::{Handler, SlaveState, Taken};
use crate::service::Service;
use crate::slot::Answers;
use crate::station::Station;
use crate::wire::registers::AlState;
use fieldbeat_core::axis::cell::Writer;
use fieldbeat_core::axis::{Emergency, Feedback, Link};
use fieldbeat_core::bus::{Counters, Exchange, Slot};
use fieldbeat_core::time::Time;

/// The master's side of a drive.
pub(super) struct DriveEnd {
    pub(super) station: Station,
    /// The slave.
    pub(super) slave: usize,
}

/// The outputs of a drive: apart from its station, since those of some drives share a cache line.
#[derive(Clone, Debug)]
pub(super) struct Outgoing {
    /// The index of the frame, and the range in it.
    pub(super) frame: u16,
    pub(super) range: Range<u16>,
    /// Outputs are built that have not been sent.
    pub(super) built: bool,
}

/// The master's side of a device.
pub(super) struct DeviceEnd {
    pub(super) service: Service,
    /// Whether its objects can be accessed.
    pub(super) reached: Writer<Feedback>,
    pub(super) port: TerminalPort,
    pub(super) offsets: Offsets,
    pub(super) operational: bool,
    /// The counters.
    pub(super) counters: Arc<DeviceCounters>,
}

/// All of them, with the slots of the drives.
pub(super) struct Endpoints<'a> {
    pub(super) drives: &'a mut [DriveEnd],
    pub(super) devices: &'a mut [DeviceEnd],
    pub(super) slots: &'a mut [Slot],
}

enum End<'a> {
    Drive(&'a mut Station, &'a mut Slot),
    Device(&'a mut DeviceEnd),
}

impl Endpoints<'_> {
    #[inline]
    fn of(&mut self, owner: Owner) -> Option<End<'_>> {
        match owner {
            Owner::Drive(index) => {
                Some(End::Drive(&mut self.drives.get_mut(index)?.station, self.slots.get_mut(index)?))
            }
            Owner::Device(index) => self.devices.get_mut(index).map(End::Device),
        }
    }
}

impl DeviceEnd {
    /// The mailbox was read: reports the next emergency to the application, if there is room for it.
    fn mailbox_received(&mut self) {
        if self.port.may_report()
            && let Some(emergency) = self.service.take_emergency()
        {
            self.port.report(Emergency { code: emergency.code, register: emergency.register });
        }
    }

    /// The slave has entered this state; `None`: below SAFEOP, or not on the segment.
    fn state(&mut self, al: Option<AlState>) {
        let was_operational = std::mem::replace(&mut self.operational, al == Some(AlState::Op));
        if was_operational && !self.operational {
            // Its outputs do not come back by themselves.
            self.port.forget();
        }
        if al.is_none() {
            self.port.publish(Time(0), false, &[]);
        }
        let mut feedback = Feedback::default();
        feedback.link = if al.is_some() { Link::Online } else { Link::Lost };
        self.reached.write(&feedback);
    }
}

impl Handler for Endpoints<'_> {
    fn service(&mut self, owner: Owner) -> Option<&mut Service> {
        Some(match self.of(owner)? {
            End::Drive(station, _) => &mut station.service,
            End::Device(device) => &mut device.service,
        })
    }

    #[inline]
    fn advance(&mut self, owner: Owner, now: Time) -> Option<&mut Service> {
        Some(match self.of(owner)? {
            End::Drive(station, slot) => {
                station.service.advance(now, slot.link, slot.guarded);
                slot.commanded = station.service.commands();
                if slot.commanded {
                    station.unsettle();
                }
                &mut station.service
            }
            End::Device(device) => {
                device.service.advance(now, Link::Online, false);
                &mut device.service
            }
        })
    }

    fn state(&mut self, owner: Owner, state: SlaveState) {
        match self.of(owner) {
            Some(End::Drive(station, slot)) => {
                station.profile.found_otherwise = !state.is_watched;
                station.operational(state.al, slot);
                if let Some(mode) = state.found_mode {
                    station.requests.found_in(mode);
                }
                slot.reachable |= state.al.is_some();
                slot.expected_silence &= state.al.is_none();
            }
            Some(End::Device(device)) => device.state(state.al),
            None => {}
        }
    }

    fn own_values(&mut self, owner: Owner, values: &[Start]) {
        if let Some(End::Drive(station, _)) = self.of(owner) {
            station.profile.own_values(values);
        }
    }

    fn mailbox_received(&mut self, owner: Owner, now: Time, answers: &Answers<'_>) {
        match self.of(owner) {
            Some(End::Drive(station, slot)) => {
                station.service.receive(now, answers, &mut slot.counters);
                station.mailbox_received(slot);
            }
            Some(End::Device(device)) => {
                let mut counters = Counters::default();
                device.service.receive(now, answers, &mut counters);
                device.counters.add(&counters);
                device.mailbox_received();
            }
            None => {}
        }
    }

    fn restarted(&mut self, owner: Owner) {
        if let Some(End::Drive(station, _)) = self.of(owner) {
            station.restarted();
        }
    }

    fn wants_outputs(&self, owner: Owner) -> bool {
        let Owner::Drive(index) = owner else { return false };
        self.drives.get(index).is_some_and(|drive| drive.station.profile.writes())
    }

    fn powered(&self, owner: Owner) -> Option<(bool, Time)> {
        let Owner::Drive(index) = owner else { return None };
        let Slot { status: report, guarded, .. } = self.slots.get(index)?;
        Some((report.state.is_powered() || *guarded, report.at))
    }

    fn expect_silence(&mut self, owner: Owner) {
        if let Some(End::Drive(_, slot)) = self.of(owner) {
            slot.expected_silence = true;
        }
    }

    #[inline(always)] // As `Station::take`.
    fn take(&mut self, owner: Owner, Taken { at, al, inputs, in_window }: Taken<'_>) {
        match self.of(owner) {
            Some(End::Drive(station, slot)) if in_window => station.take(at, inputs, al, slot),
            Some(End::Device(device)) => {
                if al != AlState::Op {
                    device.counters.count(Own::NotOperational);
                }
                device.port.publish(at, device.operational, inputs);
            }
            _ => {}
        }
    }

    #[inline(always)] // As `take`.
    fn take_all<'a>(&mut self, at: Time, in_window: bool, all: impl Iterator<Item = (Owner, &'a [u8])>) {
        let al = AlState::Op;
        // Decided once for all of them.
        if in_window {
            for (owner, inputs) in all {
                self.take(owner, Taken { at, al, inputs, in_window: true });
            }
        } else {
            for (owner, inputs) in all {
                self.take(owner, Taken { at, al, inputs, in_window: false });
            }
        }
    }

    fn passed_by(&mut self, owner: Owner) {
        self.count(owner, Own::PassedBy);
        let Some(End::Drive(_, slot)) = self.of(owner) else { return };
        if let Exchange::Owed { sent_at, .. } = slot.exchange {
            slot.exchange = Exchange::Absent { sent_at };
        }
    }

    fn count(&mut self, owner: Owner, counter: Own) {
        match self.of(owner) {
            Some(End::Drive(_, slot)) => counter.count(&mut slot.counters),
            Some(End::Device(device)) => device.counters.count(counter),
            None => {}
        }
    }
}
