//! Segments in a world: their frames, and their faults.
//!
//! A frame takes the world's latency to the segment, the segment's own time, and the latency back.

use std::any::Any;
use std::collections::VecDeque;
use std::io;
use std::os::fd::RawFd;

use super::{INBOX, Inner, World, record, taken};
use crate::fault::{Injected, Parcel, Way};
use crate::wire::Wire;
use crate::{FaultPlan, SimSegment};
use fieldbeat_core::net::Frames;
use fieldbeat_core::net::frames::{MAC, Unsent};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{S, Time};

/// A wire from the master to a segment, and the master's end of it.
struct Rail {
    wire: Wire,
    /// A carrier is open there.
    open: bool,
    inbox: VecDeque<Parcel>,
}

impl Rail {
    /// What has arrived at the master waits for its carrier.
    fn arrive(&mut self, parcel: Parcel) {
        if self.open && self.inbox.len() < INBOX {
            self.inbox.push_back(parcel);
        } else {
            self.wire.recycle(Way::Reply, parcel);
        }
    }
}

/// All segments.
#[derive(Default)]
pub(super) struct Segments(Vec<Rail>);

impl Segments {
    /// Wires to these segments.
    pub(super) fn new(segments: Vec<Box<dyn SimSegment>>) -> io::Result<Segments> {
        let mut wires = Segments::default();
        for segment in segments {
            if wires.of(segment.interface()).is_some() {
                return Err(taken(segment.interface()));
            }
            wires.0.push(Rail { wire: Wire::new(segment), open: false, inbox: VecDeque::new() });
        }
        Ok(wires)
    }

    /// A frame waits for its carrier.
    pub(super) fn readable(&self) -> bool {
        self.0.iter().any(|rail| !rail.inbox.is_empty())
    }

    /// When the next frame arrives somewhere.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.0.iter().filter_map(|rail| rail.wire.next_due()).min()
    }

    fn of(&mut self, interface: &str) -> Option<&mut Wire> {
        self.0.iter_mut().map(|rail| &mut rail.wire).find(|wire| wire.segment().interface() == interface)
    }
}

impl Inner {
    /// A frame that is due arrives; false: there is none.
    pub(super) fn deliver_frame(&mut self, due: Time) -> bool {
        let rails = self.segments.0.iter_mut();
        let arrived =
            rails.filter_map(|rail| rail.wire.take(due).map(|(_, way, parcel)| (rail, way, parcel))).next();
        let Some((rail, way, mut parcel)) = arrived else { return false };
        record(&mut self.digest, self.now, &parcel);
        self.delivered += 1;
        match way {
            Way::Request => {
                let back_ns = rail.wire.segment().delay_ns() + self.options.latency_ns;
                rail.wire.pass(self.now, self.now + back_ns, &mut parcel.bytes);
                rail.wire.recycle(way, parcel);
            }
            Way::Reply => rail.arrive(parcel),
        }
        true
    }
}

/// Faults of the segment of an interface. Each returns false, or nothing, if there is no such segment.
impl World {
    /// Cuts the cable in front of the slave at `place`, counted from 0 at the master; `None` repairs it.
    pub fn cut(&self, interface: &str, place: Option<usize>) -> bool {
        self.with_wire(interface, |wire, _| wire.segment_mut().cut(place)).is_some()
    }

    /// The slave at `place` forwards frames without receiving them, until this is taken back.
    pub fn deafen(&self, interface: &str, place: usize, deaf: bool) -> bool {
        self.with_wire(interface, |wire, _| wire.segment_mut().deafen(place, deaf)).is_some()
    }

    /// Switches the slave at `place` off and on again.
    pub fn restart_slave(&self, interface: &str, place: usize) -> bool {
        self.with_wire(interface, |wire, now| wire.segment_mut().restart(now, place)).is_some()
    }

    /// Opens the hardware enable (STO) of the drive at `place` for `ns`.
    pub fn open_sto_of_slave(&self, interface: &str, place: usize, ns: u64) -> bool {
        self.with_wire(interface, |wire, now| wire.segment_mut().open_sto(place, now + ns)).is_some()
    }

    /// The wire to the segment has the faults of `plan` from now on; its counters restart.
    pub fn set_segment_faults(&self, interface: &str, plan: FaultPlan) -> bool {
        self.with_wire(interface, |wire, _| wire.change(plan)).is_some()
    }

    /// The faults of the wire to the segment so far.
    pub fn segment_injected(&self, interface: &str) -> Option<Injected> {
        self.with_wire(interface, |wire, _| wire.injected())
    }

    /// Puts a foreign frame on the wire, to arrive at the master at the instant `at`, or now if that has passed.
    pub fn inject_frame(&self, interface: &str, bytes: &[u8], at: Time) -> bool {
        self.with_wire(interface, |wire, now| wire.inject(at.max(now), bytes)).is_some()
    }

    /// Looks at the segment itself, as it is now; nothing also if it is no `L`.
    pub fn look<L: SimSegment, R>(&self, interface: &str, look: impl FnOnce(&mut L, Time) -> R) -> Option<R> {
        self.with_wire(interface, |wire, now| {
            wire.segment_mut().advance(now);
            let segment: &mut dyn Any = wire.segment_mut();
            segment.downcast_mut().map(|segment| look(segment, now))
        })?
    }

    fn with_wire<R>(&self, interface: &str, f: impl FnOnce(&mut Wire, Time) -> R) -> Option<R> {
        let mut inner = self.lock();
        let now = inner.now;
        inner.segments.of(interface).map(|wire| f(wire, now))
    }

    pub(super) fn open_frames(&self, interface: &str, ethertype: u16) -> io::Result<Carriage> {
        let mut inner = self.lock();
        let mut segments = inner.segments.0.iter().map(|rail| rail.wire.segment());
        let is_it =
            |segment: &dyn SimSegment| segment.interface() == interface && segment.ethertype() == ethertype;
        let Some(index) = segments.position(is_it) else {
            let names: Vec<&str> =
                inner.segments.0.iter().map(|rail| rail.wire.segment().interface()).collect();
            let message = format!("no segment on {interface} in this world; there are: {}", names.join(", "));
            return Err(io::Error::new(io::ErrorKind::NotFound, message));
        };
        if std::mem::replace(&mut inner.segments.0[index].open, true) {
            return Err(taken(interface));
        }
        Ok(Carriage { world: self.clone(), index })
    }
}

/// The date at which the clock of every world is 0, ns since 2000-01-01: 2024-01-01.
const BEGUN_NS: u64 = 757_382_400 * S;

/// A carrier of frames in a world.
#[derive(Debug)]
pub(super) struct Carriage {
    world: World,
    index: usize,
}

impl Frames for Carriage {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let mut inner = self.world.lock();
        let begin = inner.read();
        let (now, due) = (inner.now, inner.now + inner.options.latency_ns);
        inner.segments.0[self.index].wire.depart(Way::Request, now, due, frame);
        Ok(begin)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let mut inner = self.world.lock();
        let at = inner.read();
        let rail = &mut inner.segments.0[self.index];
        let parcel = rail.inbox.pop_front()?;
        let length = parcel.bytes.len();
        let fits = length.min(room.len());
        room[..fits].copy_from_slice(&parcel.bytes[..fits]);
        rail.wire.recycle(Way::Reply, parcel);
        Some((at, length))
    }

    fn now(&mut self) -> Time {
        self.world.lock().read()
    }

    fn today_ns(&self) -> Option<u64> {
        Some(BEGUN_NS + self.world.now().0)
    }

    fn mac(&self) -> [u8; 6] {
        MAC
    }

    /// Virtual time is never real time: nothing to lock.
    fn memory(&self, _regions: &mut Regions) {}
}

/// The segment is free again, as when a socket is closed.
impl Drop for Carriage {
    fn drop(&mut self) {
        let mut inner = self.world.lock();
        let rail = &mut inner.segments.0[self.index];
        rail.open = false;
        rail.inbox.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Simulated;
    use crate::testing::Tally;
    use crate::world::WorldOptions;
    use fieldbeat_core::net::Carriers;
    use fieldbeat_core::rt::{Clock, PollSet};
    use fieldbeat_core::time::{MS, US};

    const NAME: &str = "eth7";
    const TYPE: u16 = Tally::TYPE;

    fn segments(faults: FaultPlan) -> Simulated {
        let segment = |name| Box::new(Tally::new(name, faults.clone()));
        Simulated { segments: vec![segment("eth6"), segment(NAME)], ..Simulated::default() }
    }

    fn world(faults: FaultPlan) -> (World, Box<dyn Frames>) {
        let world =
            World::new(segments(faults), WorldOptions { read_ns: 0, ..WorldOptions::default() }).unwrap();
        let carrier = world.frames(NAME, TYPE).unwrap();
        (world, carrier)
    }

    /// All that has arrived.
    fn take(carrier: &mut dyn Frames) -> Vec<Vec<u8>> {
        let mut room = [0; 60];
        std::iter::from_fn(|| carrier.receive(&mut room).map(|(_, length)| room[..length].to_vec())).collect()
    }

    /// The reply to a frame within 1 ms.
    fn exchange(world: &World, carrier: &mut dyn Frames, number: u8) -> Vec<Vec<u8>> {
        carrier.send(&[number, 0, 9]).unwrap();
        world.advance(MS);
        take(carrier)
    }

    #[test]
    fn a_frame_takes_both_ways_and_the_line_and_wakes_the_waiting() {
        let (world, mut carrier) = world(FaultPlan { answer_ns: 1_000, ..FaultPlan::default() });
        let begin = world.now();
        assert_eq!(carrier.send(&[1, 0, 9]), Ok(begin));
        assert_eq!(take(&mut *carrier), [[0; 0]; 0]);
        let back = begin + 40 * US + 1_700;
        let mut set = PollSet::default();
        assert!(!world.clock().wait(&mut set, begin + 41_699));
        assert!(world.clock().wait(&mut set, begin + MS));
        assert_eq!((world.now(), world.delivered()), (back, 2));
        let mut room = [0; 2];
        assert_eq!(
            carrier.receive(&mut room),
            Some((back, 3)),
            "what is longer than the room is cut off and reported"
        );
        assert_eq!(room, [1, 2]);
        assert_eq!(carrier.receive(&mut room), None);
        assert_eq!(world.look(NAME, |segment: &mut Tally, _| segment.passed), Some(1));
        assert_eq!(world.look("eth6", |segment: &mut Tally, _| segment.passed), Some(0));
    }

    #[test]
    fn the_cable_the_ears_and_the_switches_of_each_slave_can_be_pulled() {
        let (world, mut carrier) = world(FaultPlan::default());
        let mut exchange = |number| exchange(&world, &mut *carrier, number);
        assert!(world.cut(NAME, Some(1)));
        assert_eq!(exchange(1), [[1, 1, 9]]);
        assert!(world.cut(NAME, Some(0)));
        assert_eq!(exchange(2), [[0; 0]; 0], "nobody sends it back");
        assert!(world.cut(NAME, None) && world.deafen(NAME, 0, true));
        assert_eq!(exchange(3), [[3, 1, 9]]);
        assert!(world.deafen(NAME, 0, false));
        assert_eq!(exchange(4), [[4, 2, 9]]);
        assert!(world.restart_slave(NAME, 1) && world.open_sto_of_slave(NAME, 0, 5));
        let until = [world.now() + 5, Time::default()];
        let look = |segment: &mut Tally, now| (segment.restarts, segment.sto_open, segment.lived == now);
        world.advance(MS);
        assert_eq!(world.look(NAME, look), Some(([0, 1], until, true)));
    }

    #[test]
    fn each_fault_does_to_frames_what_its_name_says() {
        let only = |change: fn(&mut FaultPlan)| {
            let (world, mut carrier) = world(FaultPlan::default());
            let mut plan = FaultPlan { delay_ns: 5 * MS, ..FaultPlan::default() };
            change(&mut plan);
            assert!(world.set_segment_faults(NAME, plan));
            let got: Vec<_> = (0..4).map(|number| exchange(&world, &mut *carrier, number)).collect();
            world.advance(20 * MS);
            (got, take(&mut *carrier), world.segment_injected(NAME).unwrap())
        };
        let (got, _, injected) = only(|plan| plan.drop = 1.0);
        assert_eq!((got.concat().len(), injected.dropped), (0, 4));
        let (got, late, injected) = only(|plan| plan.delay = 1.0);
        assert_eq!((got.concat().len(), late.len(), injected.delayed), (0, 4, 8));
        let (got, _, injected) = only(|plan| plan.duplicate = 1.0);
        assert_eq!((got[3].len(), injected.duplicated), (4, 4 + 8), "twice each way");
        let (got, _, injected) = only(|plan| plan.reorder = 1.0);
        assert_eq!((got.concat().len(), injected.reordered), (4, 4));
        assert_eq!(got[1], [vec![0, 2, 9], vec![1, 2, 9]], "exchanged on both ways");
        let (got, _, injected) = only(|plan| plan.wrong_id = 1.0);
        assert_eq!((&got[1], injected.wrong_id), (&vec![vec![0x81, 2, 9]], 4));
        let (got, _, injected) = only(|plan| plan.corrupt = 1.0);
        assert_eq!((got.concat().len(), injected.corrupted, injected.dropped), (0, 4, 0), "whole frames");
        let (got, _, injected) = only(|plan| (plan.stall, plan.stall_ns) = (1.0, 3_500_000));
        assert_eq!((got.concat().len(), injected.stalled), (0, 4));
    }

    #[test]
    fn restarts_and_open_enables_go_round_the_slaves() {
        let (world, mut carrier) = world(FaultPlan { restart: 1.0, ..FaultPlan::default() });
        (0..5).for_each(|number| drop(exchange(&world, &mut *carrier, number)));
        assert_eq!(world.look(NAME, |segment: &mut Tally, _| segment.restarts), Some([3, 2]));
        let plan = FaultPlan { sto: 1.0, sto_ns: 7, ..FaultPlan::default() };
        assert!(world.set_segment_faults(NAME, plan));
        let begin = world.now();
        (0..2).for_each(|number| drop(exchange(&world, &mut *carrier, number)));
        let sto_open = world.look(NAME, |segment: &mut Tally, _| segment.sto_open);
        assert_eq!(sto_open, Some([begin + 7, begin + MS + 7]));
    }

    #[test]
    fn a_foreign_frame_arrives_at_its_instant_and_only_where_somebody_listens() {
        let (world, mut carrier) = world(FaultPlan { drop: 1.0, ..FaultPlan::default() });
        let begin = world.now();
        assert!(world.inject_frame(NAME, &[5; 4], begin + MS) && world.inject_frame("eth6", &[6; 4], begin));
        assert!(world.clock().wait(&mut PollSet::default(), begin + 2 * MS));
        assert_eq!((world.now(), take(&mut *carrier)), (begin + MS, vec![vec![5; 4]]));
        assert!(world.inject_frame(NAME, &[7; 4], begin));
        drop(carrier);
        world.advance(MS);
        assert!(take(&mut *world.frames(NAME, TYPE).unwrap()).is_empty());
    }
}
