//! All drives of one PROFIBUS wire: stations, the link layer and the port, as a [`Bus`].
//!
//! What is due is queued, and has its turn in the order of the plan, round and round. The next telegram leaves when the
//! one before is closed and the wire was idle, in `send` or in `poll`, as long as the window lasts. Global_Control, a
//! token and a search for other masters follow when the round is over; Global_Control does not wait for that for ever.

mod end;
mod queue;
mod receive;
mod turns;
mod upkeep;

use std::os::fd::RawFd;

use self::end::End;
use self::queue::Queue;
use self::upkeep::Upkeep;
use super::line::Line;
use super::notes::{ExpectedDevice, WireNotes};
use super::other::Others;
use super::plan::{LenzeDrive, ProfibusPlan};
use super::station::Station;
use fieldbeat_core::bus::native::Inputs;
use fieldbeat_core::bus::{
    Bus, BusNumbers, Cycle, Ends, Exchange, OpenError, Opened, Slot, Unmatched, Waits,
};
use fieldbeat_core::net::{Broken, Carriers, Lock, Place, Serial};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// A wire and its drives.
#[repr(C, align(64))] // What each turn touches is on two cache lines, and at the front of `line`.
pub(super) struct ProfibusBus {
    /// The drives whose exchange is queued.
    queue: Queue,
    net: Box<dyn Serial>,
    stations: Box<[Station]>,
    /// The shortest time from a turn of each drive to its next one, ns, and when that may begin; none: none has one.
    intervals: Box<[(u64, Time)]>,
    /// When the telegram under way began.
    began_at: Time,
    /// The number of turns before one may be acyclic again: each round has room for one.
    acyclic_after: usize,
    /// The wire is looked at before anything is sent: always, or in so many cycles more.
    always_looks: bool,
    watchful: u16,
    /// The drive whose turn was last: what belongs to nobody is counted for it.
    last: u8,
    upkeep: Upkeep,
    /// The drives that start up, a bit each.
    starting: u128,
    /// The slot of the grid.
    grid: Time,
    end: End,
    others: Others,
    line: Line,
    /// The own slots of each drive: divisor and phase.
    own_slots: Vec<(u64, u64)>,
    /// When the port was opened.
    opened_at: Time,
    /// Cycles that the end has waited for.
    waits: u32,
    notes: WireNotes,
    unmatched: Unmatched,
    /// The port is this master's until it is closed.
    _lock: Lock,
}

impl ProfibusBus {
    /// Begins to open the port of `plan`, which is free of faults.
    pub(super) fn open(plan: &ProfibusPlan, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let lock = carriers.lock(Place::Port(&plan.device)).map_err(|why| OpenError::InUse {
            bus: plan.name.clone(),
            what: plan.device.clone(),
            why,
        })?;
        let (mut stations, mut ends) = (Vec::new(), Ends::default());
        for drive in &plan.drives {
            let broken = || OpenError::Plan { bus: plan.name.clone(), drive: drive.axis.name.clone() };
            let (station, native, acyclic) =
                Station::new(drive, plan.address, &carriers.log()).ok_or_else(broken)?;
            stations.push(station);
            ends.push(native, acyclic);
        }
        let net = carriers.serial(&plan.device, &plan.line()).map_err(|source| OpenError::Interface {
            bus: plan.name.clone(),
            interface: plan.device.clone(),
            source,
            remedy: "look at device: a serial port, like \"/dev/ttyS1\"".to_owned(),
        })?;
        let known = |drive: &LenzeDrive| ExpectedDevice {
            address: drive.address,
            ident: drive.ident,
            configuration: drive.configuration.clone(),
        };
        let known = plan.drives.iter().map(known).collect();
        let interval = |drive: &LenzeDrive| (drive.min_slave_interval_ns, Time(0));
        let intervals: Box<[_]> = plan.drives.iter().map(interval).collect();
        let has_intervals = intervals.iter().any(|(ns, _)| *ns > 0);
        let own_slot = |drive: &LenzeDrive| (drive.axis.divisor.into(), drive.axis.phase.into());
        let notes = WireNotes::new(&plan.device, plan.address, known, net.notes());
        let bus = ProfibusBus {
            queue: Queue::default(),
            net,
            stations: stations.into(),
            intervals: if has_intervals { intervals } else { Box::default() },
            upkeep: Upkeep::new(plan),
            began_at: Time(0),
            acyclic_after: 0,
            // What an adapter holds back, or returns, is no sign of what is on the wire.
            always_looks: plan.echo || plan.bits.latency_ns > 0,
            watchful: 0,
            last: 0,
            line: Line::new(plan),
            grid: Time(0),
            starting: 0,
            own_slots: plan.drives.iter().map(own_slot).collect(),
            others: Others::new(),
            opened_at: Time(0),
            end: End::default(),
            waits: 0,
            notes: notes.clone(),
            unmatched: Unmatched::default(),
            _lock: lock,
        };
        Ok(Opened::new(bus, ends, notes))
    }

    /// Takes over a port that was opened.
    #[cold]
    fn opened(&mut self, now: Time) {
        let is_timed = self.net.is_timed();
        self.line.opened(now, is_timed);
        self.opened_at = now;
        self.always_looks |= !is_timed;
        if self.net.discard().is_err() {
            self.unmatched.errors += 1;
        }
    }

    /// The port can no longer be used.
    #[cold]
    fn broken(&mut self, broken: Broken, slots: &mut [Slot]) {
        self.line.closed();
        if broken == Broken::Absent {
            return;
        }
        let why = match broken {
            Broken::Closed => "the other end has closed it",
            _ => "the port has failed: look at its adapter",
        };
        self.net.abandon(0, why);
        (self.queue, self.starting) = (Queue::default(), 0);
        self.upkeep.operate(None);
        for (station, slot) in self.stations.iter_mut().zip(slots) {
            station.cut_off(slot);
        }
    }
}

impl Bus for ProfibusBus {
    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        self.notes.memory(regions);
        regions.add(&*self.own_slots);
        regions.add(&*self.intervals);
        regions.add(&*self.stations);
        self.stations.iter().for_each(|station| station.memory(regions));
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.grid = cycle.grid;
        if self.net.opened().is_some() {
            self.opened(cycle.grid);
        }
        self.look(slots);
        self.watchful = self.watchful.saturating_sub(1);
        let takes = self.line.is_up() && self.end == End::None;
        let mut bit = 1_u128;
        for slot in slots.iter_mut() {
            // One that is queued stays so: here it is made sure of, after a panic in its turn for example.
            let waits = matches!(slot.exchange, Exchange::Idle | Exchange::Missed | Exchange::Queued);
            if slot.due && waits {
                if takes {
                    slot.exchange = Exchange::Queued;
                    self.queue.push(bit);
                } else {
                    slot.unsent();
                }
            }
            bit <<= 1;
        }
        self.go_on(cycle, cycle.grid, slots);
        if self.starting != 0 {
            self.let_start(cycle, slots);
        }
        if self.others.has_gone(cycle.grid) {
            self.notes.set_other(None);
        }
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        self.take_in(slots);
    }

    fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits {
        if let Some(free_at) = self.line.free_at() {
            return match self.queue.is_empty() && !self.upkeep.is_round_over() {
                true => Waits::for_replies(0),
                false if self.intervals.is_empty() => Waits { replies: 0, poll_at: free_at },
                false => Waits { replies: 0, poll_at: free_at.max(self.next_turn_at()) },
            };
        }
        let owed = self.line.waits_for().and_then(|index| slots.get(usize::from(index)));
        let replies = owed.is_some_and(|slot| slot.exchange.is_waited_for(cycle)).into();
        Waits { replies, poll_at: self.line.look_at(false).unwrap_or(Waits::NEVER) }
    }

    fn poll(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        self.look(slots);
        self.go_on(cycle, now, slots);
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        for (station, slot) in self.stations.iter_mut().zip(slots) {
            if slot.due || slot.exchange == Exchange::Queued {
                station.prepare(cycle, slot);
            }
        }
    }

    fn native(&self, index: usize) -> Option<(&dyn Inputs, &[u8])> {
        let station = self.stations.get(index)?;
        Some((station.native(), station.sent_outputs()))
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        self.end(cycle, slots)
    }

    fn numbers(&self) -> BusNumbers {
        self.unmatched.into()
    }

    fn helper_ended(&self) -> bool {
        self.net.has_ended()
    }
}
