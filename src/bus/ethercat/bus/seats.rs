//! The drives and devices behind the members of a segment: the stations of drives, and the ports of devices.

use crate::axis::cell::Writer;
use crate::axis::{Emergency, Feedback, Link};
use crate::bus::ethercat::cia402::Mode;
use crate::bus::ethercat::counters::Own;
use crate::bus::ethercat::image::Spot;
use crate::bus::ethercat::line::{Crew, Taken};
use crate::bus::ethercat::native::TerminalPort;
use crate::bus::ethercat::plan::Owner;
use crate::bus::ethercat::service::Service;
use crate::bus::ethercat::station::Station;
use crate::bus::ethercat::wire::registers::AlState;
use crate::bus::{Counters, Exchange, Slot};
use crate::time::Time;

/// The drives and devices behind the members of the segment.
pub(super) struct Seats {
    pub(super) stations: Vec<Station>,
    /// For each drive: outputs are built that have not been sent.
    pub(super) built: Vec<bool>,
    pub(super) spots: Vec<Spot>,
    /// The members of the drives.
    pub(super) members: Vec<usize>,
    pub(super) devices: Vec<DeviceSeat>,
}

/// The master's side of a device.
pub(super) struct DeviceSeat {
    pub(super) service: Service,
    /// Whether its objects can be accessed.
    pub(super) reached: Writer<Feedback>,
    pub(super) port: TerminalPort,
    pub(super) spot: Spot,
    pub(super) operational: bool,
}

impl DeviceSeat {
    /// Its mailbox was read: reports the next emergency to the application, if there is room for it.
    fn mailbox_heard(&mut self) {
        if self.port.may_tell()
            && let Some(emergency) = self.service.take_emergency()
        {
            self.port.tell(Emergency { code: emergency.code, register: emergency.register });
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
        let link = if al.is_some() { Link::Online } else { Link::Lost };
        self.reached.write(&Feedback { link, ..Feedback::default() });
    }
}

impl Crew for Seats {
    fn service(&mut self, owner: Owner) -> Option<&mut Service> {
        match owner {
            Owner::Drive(index) => self.stations.get_mut(index).map(Station::service),
            Owner::Device(index) => self.devices.get_mut(index).map(|device| &mut device.service),
        }
    }

    fn advance(&mut self, owner: Owner, now: Time, slots: &mut [Slot]) {
        match owner {
            Owner::Drive(index) => {
                if let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index)) {
                    let service = station.service();
                    service.advance(now, slot.link, slot.guarded);
                    slot.commanded = service.commands();
                }
            }
            Owner::Device(index) => {
                if let Some(device) = self.devices.get_mut(index) {
                    device.service.advance(now, Link::Online, false);
                }
            }
        }
    }

    fn state(&mut self, owner: Owner, al: Option<AlState>, slots: &mut [Slot]) {
        match owner {
            Owner::Drive(index) => {
                if let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index)) {
                    station.operational(al, slot);
                    slot.reachable |= al.is_some();
                    slot.expected_silence &= al.is_none();
                }
            }
            Owner::Device(index) => {
                if let Some(device) = self.devices.get_mut(index) {
                    device.state(al);
                }
            }
        }
    }

    fn mailbox_heard(&mut self, owner: Owner, slots: &mut [Slot]) {
        match owner {
            Owner::Drive(index) => {
                if let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index)) {
                    station.mailbox_heard(slot);
                }
            }
            Owner::Device(index) => {
                if let Some(device) = self.devices.get_mut(index) {
                    device.mailbox_heard();
                }
            }
        }
    }

    fn restarted(&mut self, owner: Owner) {
        if let Owner::Drive(index) = owner
            && let Some(station) = self.stations.get_mut(index)
        {
            station.restarted();
        }
    }

    fn wants_outputs(&self, owner: Owner) -> bool {
        match owner {
            Owner::Drive(index) => self.stations.get(index).is_some_and(Station::wants_outputs),
            Owner::Device(index) => self.devices.get(index).is_some_and(|device| device.port.is_written()),
        }
    }

    fn watched(&mut self, owner: Owner, is_watched: bool) {
        if let Owner::Drive(index) = owner
            && let Some(station) = self.stations.get_mut(index)
        {
            station.watched(is_watched);
        }
    }

    fn found_in(&mut self, owner: Owner, mode: Mode) {
        if let Owner::Drive(index) = owner
            && let Some(station) = self.stations.get_mut(index)
        {
            station.found_in(mode);
        }
    }

    fn excuse(&mut self, owner: Owner, slots: &mut [Slot]) {
        if let Owner::Drive(index) = owner
            && let Some(slot) = slots.get_mut(index)
        {
            slot.expected_silence = true;
        }
    }

    #[inline]
    fn take(&mut self, owner: Owner, taken: Taken<'_>, slots: &mut [Slot]) {
        let Taken { at, al, inputs, in_window } = taken;
        match owner {
            Owner::Drive(index) => {
                if let (Some(station), Some(slot)) = (self.stations.get_mut(index), slots.get_mut(index))
                    && in_window
                    && matches!(slot.exchange, Exchange::Owed { .. })
                {
                    station.take(at, inputs, al, slot);
                }
            }
            Owner::Device(index) => {
                if let Some(device) = self.devices.get_mut(index) {
                    device.port.publish(at, device.operational, inputs);
                }
            }
        }
    }

    fn passed_by(&mut self, owner: Owner, slots: &mut [Slot]) {
        let Owner::Drive(index) = owner else { return };
        let Some(slot) = slots.get_mut(index) else { return };
        Own::PassedBy.count(&mut slot.counters);
        if let Exchange::Owed { sent_at, .. } = slot.exchange {
            slot.exchange = Exchange::Absent { sent_at };
        }
    }

    fn counters<'a>(&self, owner: Owner, slots: &'a mut [Slot]) -> Option<&'a mut Counters> {
        match owner {
            Owner::Drive(index) => slots.get_mut(index).map(|slot| &mut slot.counters),
            Owner::Device(_) => None,
        }
    }
}
