//! The wire between a master and a simulated segment, with its faults: common to both carriers of frames.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::fault::{Datagram, DriveFault, Injected, Injector, Parcel, Queue, Way};
use super::{FaultPlan, SimSegment};
use fieldbeat_core::time::Time;

/// The most frames under way in one direction; more are lost.
const UNDER_WAY: usize = 1_024;
/// Placeholder addresses of the two ends, where faults and digests need an address.
const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);
const SEGMENT: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 2);

/// A segment and its wire.
pub(super) struct Wire {
    segment: Box<dyn SimSegment>,
    injector: Injector,
    /// The frames under way, by [`Way`].
    under_way: [Queue; 2],
}

impl Wire {
    pub(super) fn new(segment: Box<dyn SimSegment>) -> Wire {
        Wire {
            injector: Injector::of_frames(segment.faults()),
            under_way: [Queue::new(UNDER_WAY), Queue::new(UNDER_WAY)],
            segment,
        }
    }

    pub(super) fn segment(&self) -> &dyn SimSegment {
        &*self.segment
    }

    pub(super) fn segment_mut(&mut self) -> &mut dyn SimSegment {
        &mut *self.segment
    }

    /// Uses the faults of `plan` from now on; the counts restart.
    pub(super) fn change(&mut self, plan: FaultPlan) {
        self.injector.change(plan);
    }

    /// The faults of its frames so far.
    pub(super) fn injected(&self) -> Injected {
        self.injector.injected()
    }

    /// A frame leaves at one end, to be at the other one at `due` without a fault.
    pub(super) fn depart(&mut self, way: Way, now: Time, due: Time, bytes: &[u8]) {
        let (from, to) = match way {
            Way::Request => (MASTER, SEGMENT),
            Way::Reply => (SEGMENT, MASTER),
        };
        let frame = Datagram { from, to, bytes };
        let fault = self.injector.pass(way, now, due, frame, |_| {}, &mut self.under_way[way as usize]);
        let Some(fault) = fault else { return };
        let place = fault.place(self.injector.injected(), self.segment.slaves());
        match fault {
            DriveFault::Restart => self.segment.restart(now, place),
            DriveFault::OpenSto(until) => self.segment.open_sto(place, until),
        }
    }

    /// A foreign frame, to be at the master at `due`.
    pub(super) fn inject(&mut self, due: Time, bytes: &[u8]) {
        let queue = &mut self.under_way[Way::Reply as usize];
        let parcel = queue.parcel(Datagram { from: SEGMENT, to: MASTER, bytes });
        queue.push(due, parcel);
    }

    /// A frame that has arrived at the segment passes through it, and leaves again to be at the master at `due`;
    /// false: it does not come back.
    pub(super) fn pass(&mut self, now: Time, due: Time, frame: &mut [u8]) -> bool {
        let comes_back = self.segment.pass(now, frame);
        if comes_back {
            self.depart(Way::Reply, now, due, frame);
        }
        comes_back
    }

    /// When the next frame arrives at an end.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.under_way.iter().filter_map(Queue::next_due).min()
    }

    /// Takes out a frame that has arrived by `now`, and when it did.
    pub(super) fn take(&mut self, now: Time) -> Option<(Time, Way, Parcel)> {
        if let Some((at, parcel)) = self.under_way[Way::Request as usize].pop(now) {
            return Some((at, Way::Request, parcel));
        }
        let (at, mut parcel) = self.under_way[Way::Reply as usize].pop(now)?;
        if parcel.from != SEGMENT {
            self.segment.mislabel(&mut parcel.bytes);
        }
        Some((at, Way::Reply, parcel))
    }

    /// Returns the buffer of a parcel that was taken out.
    pub(super) fn recycle(&mut self, way: Way, parcel: Parcel) {
        self.under_way[way as usize].recycle(parcel);
    }
}
