//! An open bus on the real-time thread, and what passes between it and the loop.
//!
//! All of [`Bus`] runs on the real-time thread: bounded work, no allocation, no lock, no wait, and no panic on any
//! bytes.

use std::fmt::Debug;
use std::mem::offset_of;
use std::os::fd::RawFd;
use std::sync::Arc;

use super::counters::{BusNumbers, Counters, OWN_COUNTERS};
use super::desired::{Desired, Evidence, Gone};
use super::drives::Ends;
use super::last::LastResort;
use super::native::Inputs;
use crate::axis::{DriveStatus, Emergency, Link};
use crate::net::LinkNotes;
use crate::rt::Regions;
use crate::time::Time;

/// One open bus on the real-time thread. `slots` are those of its own drives, in the order of its plan.
///
/// It carries five kinds of wire. What each of them makes of the exchange of a due slot, and the clauses for it alone:
///
/// - **A reply to each request** (LinUDP): [`Owed`](Exchange::Owed) by the deadline of its cycle, or of a later one,
///   then [`Answered`](Exchange::Answered) with a round trip. The next request leaves in its turn, whatever is owed:
///   before that the bus puts an open exchange into [`Slot::earlier`]. `ReplyWithin::Cycles`.
/// - **One request outstanding on a connection** (Modbus TCP): owed by a later deadline, and `awaited` in its own
///   window if the drive usually answers there. [`Slot::reachable`], [`helper_ended`](Bus::helper_ended),
///   `ReplyWithin::Connection`.
/// - **One frame for all drives** (EtherCAT): owed, and [`Absent`](Exchange::Absent) if the frame came back without
///   this one. [`lead`](Bus::lead), [`phase_error`](Bus::phase_error), the clock of [`numbers`](Bus::numbers), devices.
/// - **The drive's own clock** (EtherNet/IP class 1): [`OwnClock`](Exchange::OwnClock), which no packet answers; no
///   round trip, and not suspect. `ReplyWithin::OwnClock`.
/// - **Half duplex** (PROFIBUS DP): [`Queued`](Exchange::Queued) until its turn, then owed, and absent if its reply is
///   overdue. [`Waits::poll_at`], [`poll`](Bus::poll), `ReplyWithin::Turn`.
pub trait Bus: Send {
    /// Adds the memory that the bus touches on the real-time thread, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);

    /// The descriptor that is readable while a reply waits to be taken in; `None`: there is nothing to wait for at
    /// present. Queried before each wait, because a connection that returns may have another one. A bus with
    /// several sockets returns an epoll descriptor over them.
    fn fd(&self) -> Option<RawFd>;

    /// Empties the sockets of replies that came too late, wherever one could pass for another one later. Then hands
    /// the prepared requests of the due slots to the kernel and opens their exchanges, one each, with the stamp of its
    /// own sending. Where replies may come cycles later, a reply that came since the last window still closes an owed
    /// exchange here, and a due slot whose exchange is still owed is passed over. A due slot whose drive has no
    /// connection ends as unsent.
    ///
    /// On a half-duplex wire a due slot is queued, or stays so if it was, and the first in the queue is sent if the
    /// wire is free: those that are not sent in this cycle wait for the next one. A drive with its own clock is sent
    /// its request whatever its link, and its packets are taken in whether it is due or not.
    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// Takes in what has arrived, up to a bounded amount. Never waits, sends nothing. Not called in a cycle whose
    /// window [waits](Bus::waits) for nothing. Nor is it called where a wait has found nothing to read, or while only
    /// other buses miss a reply. What the window does not wait for, as the reply of a slow drive, is taken in by the
    /// next `receive` or `send`.
    fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// The replies that the window of `cycle` is open for. Queried after each call that may change it: one that knows
    /// which exchange it is need not look at all slots.
    fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits {
        Waits::for_replies(slots.iter().filter(|slot| slot.exchange.is_waited_for(cycle)).count())
    }

    /// The time of [`Waits::poll_at`] has come: it is `now`, before the deadline. If it was near, nobody has looked for
    /// what arrived since the last `receive`. On a half-duplex wire an exchange whose reply is overdue ends as absent,
    /// and once the wire is free the next queued request leaves, with its own stamp. Afterwards `poll_at` is later than
    /// `now`, or none.
    fn poll(&mut self, _cycle: &Cycle, _now: Time, _slots: &mut [Slot]) {}

    /// Builds the requests of the slots that are due at the next send, and of those that are queued, in place, from
    /// what is now desired in them; called before each [`send`](Bus::send). What is desired stays the same until then,
    /// and of a slot that is queued until the next call: a request may also be built in its turn. May be called more
    /// than once for the same send, with the same bytes as the result, and again for a later slot if the first was
    /// passed over. What was replaced before its request left is never carried out.
    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// Starts or continues the orderly end; true once nothing more has to be sent. Called after the window of a
    /// cycle, until it is true.
    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool;

    /// The counts of the bus itself, and the state of its clock. Queried now and then.
    fn numbers(&self) -> BusNumbers;

    /// The newest native inputs of drive `index`, and what the request that left last has carried to it: it is there in
    /// the cycle in which that left, before the next one is prepared. `None`: it has none.
    fn native(&self, _index: usize) -> Option<(&dyn Inputs, &[u8])> {
        None
    }

    /// The thread outside of the loop that this bus depends on has ended unexpectedly: its axes are stopped. Queried
    /// once a cycle.
    fn helper_ended(&self) -> bool {
        false
    }

    /// From now on the clock of this bus leads the grid; called once before the start, on one bus at most. Any
    /// other bus with a clock synchronises its clock to the grid.
    fn lead(&mut self) {}

    /// Distance of a slot of the grid from where the clock of this bus wants it, ns: positive is late. At most one
    /// a cycle, `None` from a cycle that was not answered. Taken after the window; each value is returned once.
    fn phase_error(&mut self) -> Option<i64> {
        None
    }
}

/// The replies that the window waits for on a bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Waits {
    /// The number of replies that [are waited for](Exchange::is_waited_for), or of frames that carry all of them.
    pub replies: usize,
    /// When [`Bus::poll`] is to be called, whatever the descriptor shows: when the reply on a half-duplex wire is
    /// overdue, or its idle time is over. The window stays open for it, up to its deadline. [`NEVER`](Waits::NEVER):
    /// the descriptor shows all that has to be waited for.
    pub poll_at: Time,
}

impl Waits {
    /// No poll is wanted.
    pub const NEVER: Time = Time(u64::MAX);

    /// For so many replies, which the descriptor shows.
    pub const fn for_replies(replies: usize) -> Waits {
        Waits { replies, poll_at: Waits::NEVER }
    }
}

/// A bus that was opened, and what is taken of it before the start.
pub struct Opened {
    /// The bus, for the real-time thread.
    pub bus: Box<dyn Bus>,
    /// The application's ends.
    pub ends: Ends,
    /// Why its drives cannot be reached, for normal threads; `None` for a bus without connections.
    pub notes: Option<Arc<dyn Notes>>,
    /// The stop of the drives without the loop, where they have no watchdog of their own for a silent master. `None`:
    /// its drives stop by themselves once nothing is sent any more.
    pub last_resort: Option<LastResort>,
}

impl Opened {
    /// A bus whose drives stop by themselves.
    pub fn new(bus: impl Bus + 'static, ends: Ends, notes: impl Notes + 'static) -> Opened {
        Opened { bus: Box::new(bus), ends, notes: Some(Arc::new(notes)), last_resort: None }
    }
}

impl std::fmt::Debug for Opened {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Opened").field("ends", &self.ends).field("notes", &self.notes).finish_non_exhaustive()
    }
}

/// Why the drives of a bus cannot be reached, in words: read by normal threads. A real-time writer leaves numbers
/// only, and the reader makes the words.
pub trait Notes: Debug + Send + Sync {
    /// Why drive `index` has no connection; `None`: it has one, or its first opening is under way.
    fn get(&self, index: usize) -> Option<String>;

    /// That reason says only that nothing came: where something was counted, that says more.
    fn is_vague(&self, _index: usize) -> bool {
        false
    }

    /// Why device `index`, which is not a drive, is not in operation; `None`: it is.
    fn device(&self, _index: usize) -> Option<String> {
        None
    }

    /// The remark on drive `index` although it is in operation, since the configuration does not say it;
    /// `None`: nothing.
    fn remark(&self, _index: usize) -> Option<String> {
        None
    }

    /// The same of device `index`, which is not a drive.
    fn device_remark(&self, _index: usize) -> Option<String> {
        None
    }

    /// The counts named by `BusFacts::own_counters`, of device `index`, which is not a drive.
    fn device_counters(&self, _index: usize) -> [u64; OWN_COUNTERS] {
        [0; OWN_COUNTERS]
    }

    /// How many of the arrived datagrams the kernel dropped, where only a normal thread may query it.
    fn dropped(&self) -> u64 {
        0
    }
}

/// Connection `index` is that of drive `index`.
impl Notes for LinkNotes {
    fn get(&self, index: usize) -> Option<String> {
        LinkNotes::get(self, index)
    }
}

/// The facts of the cycle that a bus works in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cycle {
    /// The slot of the grid, counted from the start. Skipped slots count.
    pub index: u64,
    /// The instant of this slot on the grid.
    pub grid: Time,
    /// The period, ns.
    pub period_ns: u64,
    /// Until when replies are taken in this cycle.
    pub deadline: Time,
}

impl Cycle {
    /// Whether what is owed by `reply_by` is owed in this window. That time was set some cycles before, and a clock
    /// that leads the grid moves the windows slightly against it: the nearest window counts.
    pub fn closes(&self, reply_by: Time) -> bool {
        reply_by <= self.deadline + self.period_ns / 2
    }
}

/// One drive between the loop and its bus.
///
/// The loop writes `due`, `guarded`, `link`, `anew` and `desired`, the bus the rest. A report that does not count is
/// replaced by the one before.
///
/// What each cycle touches lies on four cache lines: the exchange with its counts; a report with its notice; what it
/// proves; what is desired.
#[derive(Clone, Debug, Default)]
#[repr(C, align(64))]
pub struct Slot {
    /// The exchange of this drive.
    pub exchange: Exchange,
    /// The parts of `desired` that have left.
    pub gone: Gone,
    /// An exchange is due at the next send.
    pub due: bool,
    /// The drive's power is on, or may come on by a request of the loop: a call of the application that commands the
    /// drive is refused, and checked for the last time when the first telegram with it is built. False where the
    /// application owns the control word (native mode).
    pub guarded: bool,
    /// The link as evaluated by the loop. A drive of which nothing is desired is only read, whatever its link. What is
    /// desired goes out with every request, including the probes of a lost link, since it may be the stop.
    pub link: Link,
    /// A drive without a connection has one from now on: it is due next, whatever its link. The loop clears it.
    pub reachable: bool,
    /// The drive was requested to do something that makes it silent, and its power is off: its silence is expected,
    /// is no link loss, and does not stop its stop group.
    pub expected_silence: bool,
    /// A call of the application that commands the drive is under way, or its end is not known: the loop begins no
    /// enable until it is over.
    pub commanded: bool,
    /// The next report is written as a whole, as if all of it were new: the loop has not taken the last one, or has
    /// changed the status. The loop sets and clears it.
    pub anew: bool,
    /// There is something in `earlier`. The bus sets it, the loop clears it.
    pub has_earlier: bool,
    /// Exact counts of its exchanges.
    pub counters: Counters,
    /// The other news of the drive.
    pub notices: Notices,
    /// The last report of the drive.
    pub status: DriveStatus,
    /// The evidence that the drive has the desired state.
    pub evidence: Evidence,
    /// The desired state of the drive from its next request on.
    pub desired: Desired,
    /// The exchanges of earlier cycles, where the next request does not wait for a reply.
    pub earlier: Earlier,
}

// Each group begins or ends with a cache line.
const _: () = {
    assert!(offset_of!(Slot, counters) + 2 * size_of::<u64>() == 64);
    assert!((offset_of!(Slot, status) + offset_of!(DriveStatus, monitor)).is_multiple_of(64));
};

impl Slot {
    /// Opens the exchange of a request that was sent.
    #[inline]
    pub fn owe(&mut self, sent_at: Time, reply_by: Time, awaited: bool) {
        self.counters.sent += 1;
        self.exchange = Exchange::Owed { sent_at, reply_by, awaited };
    }

    /// The request could not be sent.
    pub fn unsent(&mut self) {
        self.counters.unsent += 1;
        self.exchange = Exchange::Unsent;
    }

    /// The reply to the open exchange was taken in. Returns when that was sent; `None`: none is open.
    #[inline]
    pub fn answer(&mut self, at: Time, suspect: bool) -> Option<Time> {
        let Exchange::Owed { sent_at, .. } = self.exchange else { return None };
        self.exchange = Exchange::Answered { sent_at, at, suspect };
        self.counters.answered += 1;
        Some(sent_at)
    }

    /// The open exchange has no reply.
    pub fn absent(&mut self) {
        if let Exchange::Owed { sent_at, .. } = self.exchange {
            self.exchange = Exchange::Absent { sent_at };
        }
    }

    /// When the request of the newest exchange of an earlier cycle that was answered in this one was sent.
    #[inline]
    pub fn earlier_answered(&self) -> Option<Time> {
        if self.has_earlier { self.earlier.answered() } else { None }
    }
}

/// The most exchanges of earlier cycles of one drive that are owed at once.
pub const MOST_EARLIER: usize = 6;

/// The exchanges of a drive whose replies count beyond the cycle of their request although the next request leaves
/// meanwhile. The bus puts one here before it opens the next, and takes in its reply; the loop judges those whose time
/// is up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Earlier {
    /// Those that are owed, oldest first, so many of them: when each was sent, and until when its reply counts.
    owed: [(Time, Time); MOST_EARLIER],
    count: u8,
    /// There was no room for so many.
    dropped: u8,
    /// The number of exchanges answered since the loop last looked.
    answered: u8,
    /// The longest round trip of these, ns.
    rtt_ns: u64,
    /// When the request of the newest of these was sent.
    sent_at: Time,
}

/// The loop's result of [`Earlier`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ended {
    /// The number of exchanges that were not answered in their time.
    pub missed: u32,
    /// The number of exchanges that were answered.
    pub answered: u32,
    /// The longest round trip of these, ns.
    pub rtt_ns: u64,
    /// When the request of the newest of these was sent.
    pub sent_at: Time,
}

impl Earlier {
    /// An exchange that was sent then is owed by `reply_by`, whatever is sent next. One for which there is no room any
    /// more replaces the oldest, which is missed.
    pub fn owe(&mut self, sent_at: Time, reply_by: Time) {
        if usize::from(self.count) == MOST_EARLIER {
            self.dropped = self.dropped.saturating_add(1);
            self.remove(0);
        }
        if let Some(room) = self.owed.get_mut(usize::from(self.count)) {
            *room = (sent_at, reply_by);
            self.count += 1;
        }
    }

    /// The reply to the request that was sent then has come. False: it is not owed.
    pub fn answer(&mut self, sent_at: Time, at: Time) -> bool {
        let found = self.open().iter().position(|(sent, _)| *sent == sent_at);
        if let Some(place) = found {
            self.remove(place);
            self.answered = self.answered.saturating_add(1);
            (self.rtt_ns, self.sent_at) = (self.rtt_ns.max(at.since(sent_at)), self.sent_at.max(sent_at));
        }
        found.is_some()
    }

    /// Those that are owed, oldest first: when each was sent, and until when its reply counts.
    pub fn open(&self) -> &[(Time, Time)] {
        &self.owed[..usize::from(self.count)]
    }

    /// How many of them end with the window of `cycle`.
    pub fn waited_for(&self, cycle: &Cycle) -> usize {
        self.open().iter().filter(|(_, reply_by)| cycle.closes(*reply_by)).count()
    }

    /// When the request of the newest one that was answered since the loop last looked was sent.
    pub fn answered(&self) -> Option<Time> {
        (self.answered > 0).then_some(self.sent_at)
    }

    /// The exchanges that have ended by the end of the window of `cycle`; the loop takes them.
    pub fn end(&mut self, cycle: &Cycle) -> Ended {
        let overdue = self.waited_for(cycle);
        // The oldest come first.
        (0..overdue).for_each(|_| self.remove(0));
        let missed = u32::from(std::mem::take(&mut self.dropped)) + overdue as u32;
        let answered = std::mem::take(&mut self.answered).into();
        Ended { missed, answered, rtt_ns: std::mem::take(&mut self.rtt_ns), sent_at: self.sent_at }
    }

    fn remove(&mut self, place: usize) {
        self.owed.copy_within(place + 1..usize::from(self.count), place);
        self.count -= 1;
    }
}

/// The state of a drive's exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Exchange {
    /// None.
    #[default]
    Idle,
    /// Due on a half-duplex wire, and not sent yet: it waits for its turn. Its request is built anew until it leaves.
    Queued,
    /// Sent, and owed.
    Owed {
        /// When it was sent.
        sent_at: Time,
        /// Until when the reply counts: the deadline of this cycle, or of a later one.
        reply_by: Time,
        /// The window in which it was sent stays open for the reply, although the reply may come later: for a drive
        /// that usually answers inside its window. The reply of a slow drive is taken in when it comes.
        awaited: bool,
    },
    /// Sent to a drive that sends by its own clock: nothing answers it. It is answered, without a round trip, if its
    /// slot is before `fresh_until`, and else missed. The loop decides that, and counts it.
    OwnClock {
        /// When it was sent.
        sent_at: Time,
        /// Until when the newest accepted packet counts: its stamp and `ReplyWithin::OwnClock`. `receive` updates
        /// it. 0 = none was accepted yet.
        fresh_until: Time,
    },
    /// Answered.
    Answered {
        /// When it was sent.
        sent_at: Time,
        /// When the reply was taken in.
        at: Time,
        /// The reply may be that of an earlier request; it makes no round-trip sample. Always set by a bus that cannot
        /// measure one.
        suspect: bool,
    },
    /// It was sent, and has no reply: that of all drives shows that this one did not take part in it, or it is overdue
    /// on a half-duplex wire. The loop counts it as missed.
    Absent {
        /// When it was sent.
        sent_at: Time,
    },
    /// `reply_by` passed. Set by the loop.
    Missed,
    /// The operating system refused to send.
    Unsent,
}

impl Exchange {
    /// Whether the window of `cycle` stays open for it.
    pub fn is_waited_for(&self, cycle: &Cycle) -> bool {
        match *self {
            Exchange::Owed { sent_at, reply_by, awaited } => {
                cycle.closes(reply_by) || (awaited && sent_at >= cycle.grid)
            }
            _ => false,
        }
    }

    /// When its request was sent, as long as that is known.
    #[inline]
    pub fn sent_at(&self) -> Option<Time> {
        match *self {
            Exchange::Owed { sent_at, .. }
            | Exchange::OwnClock { sent_at, .. }
            | Exchange::Answered { sent_at, .. }
            | Exchange::Absent { sent_at } => Some(sent_at),
            Exchange::Idle | Exchange::Queued | Exchange::Missed | Exchange::Unsent => None,
        }
    }
}

/// The notices of a bus about a drive in addition to its status. The loop clears each of them when it has taken it. The
/// one that comes with most reports stands last, next to the status.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Notices {
    monitor_refused: Option<(u8, u32)>,
    emergency: Option<Emergency>,
    /// The status is new. It comes with an answered exchange, and of a drive with its own clock with each accepted
    /// packet.
    pub fresh: bool,
    /// The drive was found restarted: by reports that prove it, as [`Capabilities::power_reports`] counts them, since
    /// what was known of the drive is discarded at once.
    ///
    /// [`Capabilities::power_reports`]: super::desired::Capabilities::power_reports
    pub restarted: bool,
    /// Another master was found, as certainly, to command the drive, or to have frames on its segment, with or without
    /// a fresh status; the loop stops the axis.
    pub other_master: bool,
    /// The monitored variables of the status came with the newest reply: not every reply carries them.
    pub monitor_fresh: bool,
    /// An emergency or a refused variable was not taken yet.
    has_more: bool,
}

impl Notices {
    /// There is a fresh status, and nothing else but monitored variables of it.
    #[inline]
    pub fn is_report_only(&self) -> bool {
        let Notices { restarted, other_master, has_more, .. } = *self;
        self.fresh && !(restarted | other_master | has_more)
    }

    /// There is an emergency, or a refused variable.
    #[inline]
    pub fn has_more(&self) -> bool {
        self.has_more
    }

    /// The loop has not taken the last emergency yet: it takes one in each cycle, and the next one waits until then.
    pub fn has_emergency(&self) -> bool {
        self.emergency.is_some()
    }

    /// The drive reported an emergency, with or without a fresh status.
    pub fn report(&mut self, emergency: Emergency) {
        (self.emergency, self.has_more) = (Some(emergency), true);
    }

    /// The drive refused to report a variable: its channel, and the drive's status.
    pub fn refuse_monitor(&mut self, channel: u8, status: u32) {
        (self.monitor_refused, self.has_more) = (Some((channel, status)), true);
    }

    /// The emergency; once.
    pub fn take_emergency(&mut self) -> Option<Emergency> {
        self.has_more = self.monitor_refused.is_some();
        self.emergency.take()
    }

    /// The refused variable; once.
    pub fn take_refused(&mut self) -> Option<(u8, u32)> {
        self.has_more = self.emergency.is_some();
        self.monitor_refused.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::{MS, US};

    #[test]
    fn an_exchange_is_owed_in_the_nearest_window_wherever_the_grid_was_led_meanwhile() {
        let window = |slots: u64, led_ns: i64| {
            let grid = Time((100 * MS + slots * MS).saturating_add_signed(led_ns));
            Cycle { index: slots, grid, period_ns: MS, deadline: grid + 500 * US }
        };
        let reply_by = window(0, 0).deadline + 20 * MS;
        let owed = Exchange::Owed { sent_at: window(0, 0).grid, reply_by, awaited: false };
        // Twenty steps of at most a hundredth of the period.
        for led_ns in [-200_000, -1, 0, 1, 200_000] {
            for (slots, closes) in [(18, false), (19, false), (20, true), (21, true)] {
                let cycle = window(slots, led_ns);
                assert_eq!(cycle.closes(reply_by), closes, "{slots} slots later, led by {led_ns} ns");
                assert_eq!(owed.is_waited_for(&cycle), closes);
            }
        }
    }
}
