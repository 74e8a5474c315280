//! Brings the slaves of a segment to OP, and evaluates its frames for each.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the segment, its time, and its state for others |
//! | `turns` | who owns the slot of the next frame, and receives the answers |
//! | `judge` | the slaves, and which of them took part in a frame that has come back |
//! | `slave` | one slave, step by step |
//! | `running` | a slave that runs on a clock set by another master |
//! | `clock` | the time of the segment |
//! | `topology` | who is behind whom, and how long a frame takes there |
//! | `note` | why a slave is not in operation |

pub mod clock;
pub mod judge;
pub mod note;
pub mod running;
pub mod slave;
pub mod topology;
mod turns;

use self::clock::SegmentClock;
use self::judge::{FrameState, Slaves};
use self::note::{Note, Notes};
use self::slave::{Mapped, Runs, Slave};
use self::topology::Topology;
use super::counters::Own;
use super::image::{Frame, Offsets};
use super::mode::Mode;
use super::outputs;
use super::plan::{EthercatPlan, Expected, Owner, Start};
use super::service::Service;
use super::slot::{Answers, Ask};
use super::wire::registers::AlState;
use fieldbeat_core::axis::FoundRunning;
use fieldbeat_core::bus::{BusClock, Cycle};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// The drives and devices behind the slaves, with their mailboxes.
pub trait Handler {
    /// The mailbox of a slave.
    fn service(&mut self, owner: Owner) -> Option<&mut Service>;

    /// The turn of the slave: its mailbox, which takes the requests that were posted meanwhile.
    fn advance(&mut self, owner: Owner, now: Time) -> Option<&mut Service>;

    /// The replies of the slave count from now on, in this state, or not any more.
    fn state(&mut self, owner: Owner, state: SlaveState);

    /// The own values of objects that its outputs carry.
    fn own_values(&mut self, owner: Owner, values: &[Start]);

    /// The answers to the request of its mailbox.
    fn mailbox_received(&mut self, owner: Owner, now: Time, answers: &Answers<'_>);

    /// It was switched off and on.
    fn restarted(&mut self, owner: Owner);

    /// It will be silent for a while, caused by the master.
    fn expect_silence(&mut self, owner: Owner);

    /// The outputs of a drive shall go out.
    fn wants_outputs(&self, owner: Owner) -> bool;

    /// Whether a drive has power, or is about to have it, and since which report.
    fn powered(&self, owner: Owner) -> Option<(bool, Time)>;

    /// The inputs of a slave, as a frame brought them; `in_window`: in time for the exchange of a drive.
    fn take(&mut self, owner: Owner, taken: Taken<'_>);

    /// The same of slaves that are all in OP.
    #[inline]
    fn take_all<'a>(&mut self, at: Time, in_window: bool, all: impl Iterator<Item = (Owner, &'a [u8])>) {
        all.for_each(|(owner, inputs)| self.take(owner, Taken { at, al: AlState::Op, inputs, in_window }));
    }

    /// The frame of this window came back without it, or contains nothing of it.
    fn passed_by(&mut self, owner: Owner);

    /// Counts for a drive.
    fn count(&mut self, owner: Owner, counter: Own);
}

/// The state of a slave whose replies count, or no longer.
#[derive(Clone, Copy, Debug)]
pub struct SlaveState {
    /// `None`: below SAFEOP, or not on the segment.
    pub al: Option<AlState>,
    /// The watchdog is set as configured; otherwise it was found with another one, and left so.
    pub is_watched: bool,
    /// It was found in this mode of operation, and left so.
    pub found_mode: Option<Mode>,
}

/// The inputs of a slave.
#[derive(Clone, Copy, Debug)]
pub struct Taken<'a> {
    /// When the frame was taken in.
    pub at: Time,
    /// The state that it is in.
    pub al: AlState,
    /// The inputs.
    pub inputs: &'a [u8],
    /// In time for the exchange of a drive.
    pub in_window: bool,
}

/// The slaves of one segment.
#[derive(Debug, Default)]
pub struct Segment {
    /// The slaves, in the order of the plan.
    pub slaves: Slaves,
    frames: Box<[FrameState]>,
    /// The time of the segment.
    pub clock: SegmentClock,
    /// The slave whose clock is the segment's, or is to be.
    reference: Option<usize>,
    /// The clock of the segment leads the grid; otherwise it receives the grid's time.
    pub leads: bool,
    /// The reference's time goes to all.
    pub timed: bool,
    topology: Topology,
    /// Before that: the slave that was found running, and whose time the segment has.
    time_source: Option<usize>,
    /// The slave whose turn it is; and among the slaves on their way up, whether this slot is for them.
    turn: usize,
    climb: usize,
    climbs: bool,
    requester: Option<Requester>,
    ending: bool,
    /// Frames in a row that did not come back.
    dark: u32,
    /// Another master is on the segment: no slave is brought up, and none of its registers is written.
    pub left: bool,
    /// A slave was taken out of OP, and not by this master nor by itself.
    pub lowered: bool,
    /// Why its slaves are not in operation.
    pub notes: Notes,
    /// The remarks on those that are.
    pub remarks: Notes,
    /// The same, of the objects that they do not take.
    pub further: Notes,
    ask: Ask,
}

/// Who owns the slot of the frame that is under way.
#[derive(Clone, Copy, Debug)]
enum Requester {
    Slave(usize),
    Mailbox(usize),
    Topology,
}

/// A frame that was sent.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    /// The cycle.
    pub cycle: Cycle,
    /// The instant.
    pub at: Time,
}

/// A frame that has come back.
#[derive(Clone, Copy, Debug)]
pub struct Back<'a> {
    /// As it was sent.
    pub sent: &'a Sent,
    /// The same, with its places.
    pub frame: &'a Frame,
    /// When it was taken in.
    pub at: Time,
    /// The bytes.
    pub received: &'a [u8],
    /// The working counter of its process data.
    pub counter: u16,
    /// It came in the window of its cycle.
    pub in_window: bool,
}

impl Segment {
    /// The segment of `plan`, with the process data offsets of its slaves.
    pub fn new(plan: &EthercatPlan, offsets: Vec<Offsets>, period_ns: u64) -> Segment {
        let slaves = plan.slaves();
        let slave = |((owner, slave), offsets): ((Owner, &_), Offsets)| {
            let mut slave = Slave::new(owner, slave, offsets, plan.lrw);
            if let Owner::Drive(index) = owner {
                let drive = &plan.drives[index];
                slave.refuses_running = drive.axis.on_found_running == FoundRunning::Refuse;
                slave.own = outputs::own(drive).into();
            }
            slave
        };
        let count = offsets.iter().map(|offsets| offsets.frame).max().map_or(1, |last| last + 1);
        let frame = |frame| {
            let first = offsets.partition_point(|offsets| offsets.frame < frame);
            first..offsets.partition_point(|offsets| offsets.frame <= frame)
        };
        let ranges: Vec<_> = (0..count).map(frame).collect();
        let [notes, remarks, further] = [(); 3].map(|()| Notes::new(slaves.len()));
        (0..slaves.len()).for_each(|index| notes.set(index, Note::Starting));
        let places = slaves.iter().map(|(_, slave)| usize::from(slave.place) + 1).max().unwrap_or(0);
        let slaves = Slaves::new(slaves.into_iter().zip(offsets).map(slave));
        let frames = ranges.into_iter().map(|range| FrameState::new(range, &slaves)).collect();
        Segment {
            slaves,
            frames,
            clock: SegmentClock::new(period_ns, plan.ahead_of_sync_ns.unwrap_or(period_ns / 2)),
            notes,
            remarks,
            further,
            topology: Topology::new(places),
            ..Segment::default()
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.slaves.memory(regions);
        regions.add(&*self.frames);
        self.topology.memory(regions);
        self.notes.memory(regions);
        self.remarks.memory(regions);
        self.further.memory(regions);
    }

    /// All slaves are in operation, and their outputs reach them.
    #[inline]
    pub fn is_settled(&self) -> bool {
        self.slaves.are_settled
    }

    /// Slave `index` is part of the exchange.
    pub fn is_operational(&self, index: usize) -> bool {
        let is_so = |slave: &Slave| slave.reported.is_some() && slave.state_of_replies().is_some();
        self.slaves.get(index).is_some_and(is_so)
    }

    /// The outputs of slave `index` reach it.
    pub fn outputs_count(&self, index: usize) -> bool {
        self.slaves.get(index).is_some_and(|slave| slave.way.mapped == Mapped::All)
    }

    /// The relation of the clock of the segment and the grid; `None`: there is none.
    pub fn clock_status(&self) -> Option<BusClock> {
        self.slaves.iter().any(|slave| slave.plan.sync).then(|| self.clock.status())
    }

    /// The slave with this owner, its position, and who it has to be.
    pub fn slave_of(&self, owner: Owner) -> Option<(usize, u16, Expected)> {
        let slave = self.slaves.iter().position(|slave| slave.owner == owner)?;
        let plan = &self.slaves[slave].plan;
        Some((slave, plan.place, plan.identity))
    }

    /// Prepares the first frame for `cycle`: clock and slot.
    pub fn prepare(&mut self, cycle: &Cycle, first: &mut Frame, handler: &mut impl Handler) {
        let is_known = std::mem::replace(&mut self.slaves.are_timed, true);
        if !is_known {
            self.refer();
            self.begin_time();
        }
        if !self.timed && self.set_clock().is_none() {
            self.clock.forget();
        }
        // It receives our time once it has shown that its own is near.
        let follows = self.timed && !self.leads && self.clock.is_sent();
        if !is_known || follows != first.is_followed() {
            first.refer_to(self.set_clock().map(Slave::station), self.timed, follows);
        }
        self.choose(cycle, handler);
        first.request(&self.ask);
    }

    /// The slave whose clock is the segment's: the nearest one that is set, since all others are behind it; without
    /// any, the nearest that is to be set.
    fn refer(&mut self) {
        let first = |has: fn(&Slave) -> bool| self.slaves.iter().position(has);
        self.reference = first(|slave| slave.clock_set).or_else(|| first(Slave::waits_for_clock));
    }

    /// The time is sent to all slaves, once it is known that no slave runs on another one.
    fn begin_time(&mut self) {
        let is_set = self.set_clock().is_some();
        self.timed = is_set && (self.timed || self.may_have_time());
        if self.timed {
            self.time_source = None;
        }
    }

    /// All slaves were read, and none runs on a time other than the segment's.
    fn may_have_time(&self) -> bool {
        self.slaves.iter().all(|slave| slave.runs == Runs::Harmless)
    }

    /// The position of a slave that runs on a time other than the segment's.
    fn other_time(&self) -> Option<u16> {
        self.slaves.iter().find(|slave| slave.runs == Runs::Apart).map(|slave| slave.plan.place)
    }

    /// The slave whose clock is the segment's, if it is set.
    fn set_clock(&self) -> Option<&Slave> {
        Some(&self.slaves[self.reference?]).filter(|slave| slave.clock_set)
    }

    /// The segment has a time that is not that of slave `index` alone.
    fn has_time(&self, index: usize) -> bool {
        let is_running = |source: usize| source != index && self.slaves[source].way.al == Some(AlState::Op);
        self.set_clock().is_some() || self.time_source.is_some_and(is_running)
    }

    /// A frame has come back.
    pub fn receive(&mut self, back: &Back<'_>, number: usize, handler: &mut impl Handler) {
        if number == 0 {
            self.dark = 0;
        }
        let are_there = self.judge(back, number, handler);
        if number == 0 {
            let is_there = |slave: &Slave| {
                are_there || !slave.has_al || slave.offsets.frame != 0 || slave.shown_in(back.received).0 != 0
            };
            let is_there = self.set_clock().is_some_and(is_there);
            if let Some(time) = back.frame.time_of(back.received).filter(|_| is_there) {
                self.clock.sample(&back.sent.cycle, back.sent.at, time);
            }
            if let Some(requester) = self.requester.take() {
                self.answer(requester, back, handler);
            }
        }
    }

    /// Reports the state of slave `index`, if it has changed.
    fn report(&mut self, index: usize, handler: &mut impl Handler) {
        let slave = &mut self.slaves[index];
        let al = slave.state_of_replies();
        if al != slave.reported {
            let before = std::mem::replace(&mut slave.reported, al);
            let found_mode = slave.found_mode.filter(|_| slave.way.joined && before.is_none());
            let state = SlaveState { al, is_watched: slave.watched, found_mode };
            handler.state(slave.owner, state);
            self.notes.set(index, slave.note());
        }
    }

    /// Takes all slaves out of operation that this master has put there; true: done.
    pub fn shut_down(&mut self, now: Time) -> bool {
        if !std::mem::replace(&mut self.ending, true) {
            // Earlier answers no longer match the state of the slaves.
            self.requester = None;
        }
        let mut done = true;
        for slave in self.slaves.iter_mut() {
            done &= slave.shut_down(now);
        }
        done
    }
}
