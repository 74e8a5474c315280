//! The contract between the loop and a protocol, and one folder for each protocol.
//!
//! All of [`Bus`] runs on the real-time thread: bounded work, no allocation, no lock, no wait, and no panic on any
//! bytes. No protocol knows another. [`desired`] is what the loop wants of a drive, and what shows that the drive has
//! it. Each protocol has these modules:
//!
//! | file | what | must not know |
//! |---|---|---|
//! | `wire` | bytes <-> values | state, clock, socket, allocation |
//! | `profile` | what is desired as process data, and what the replies prove | commands, sockets |
//! | `station` | the master's view of one drive: identity of replies, its reports, the next request | sockets |
//! | `bus` | stations + sockets = one [`Bus`] | the loop |
//! | `config`, `tools` | its keys in a configuration, its own commands of the program | other protocols |
//!
//! `tests/conformance` tests this contract clause by clause, for every protocol.

pub mod desired;
mod drives;
pub mod ethercat;
pub mod linudp;
pub mod modbus;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod tools;
pub mod variant;

use std::any::Any;
use std::fmt::Debug;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::Arc;

use thiserror::Error;

use self::desired::{Capabilities, Desired, Evidence, Gone};
pub use self::drives::Ends;
use self::variant::Variant;
use crate::axis::acyclic::{AcyclicEnds, Notation};
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{AxisPlan, DriveStatus, Emergency, FaultNames, Link, MonitorChannel, Observer, PlanFault};
use crate::errors::no_descriptor;
#[cfg(feature = "config")]
use crate::keys::{machine::Machine, table::Table};
use crate::net::lock::Refused;
use crate::net::{Carriers, LinkNotes};
use crate::rt::Regions;
use crate::time::Time;

/// A protocol, as the rest of the program finds it: what it is called, and what it adds.
#[derive(Debug)]
pub struct Protocol {
    /// Its name in configurations.
    pub name: &'static str,
    /// The drives that have it, for people.
    pub drives: &'static str,
    /// Reads the keys of a `[[bus]]`. What is wrong is noted on the table.
    #[cfg(feature = "config")]
    pub(crate) read: fn(&mut Table<'_>, &mut Machine) -> Box<dyn BusPlan>,
    /// The commands that it adds to the program.
    #[cfg(feature = "cli")]
    pub tools: &'static [tools::Tool],
}

/// All protocols; the next one is a folder, and one line more.
pub const PROTOCOLS: [Protocol; 3] = [linudp::REGISTERED, modbus::REGISTERED, ethercat::REGISTERED];

/// A bus as configured and checked, before any socket is open.
pub trait BusPlan: Any + Debug + Send + Sync {
    /// Its name in messages.
    fn name(&self) -> &str;

    /// The protocol's name, as in the configuration.
    fn protocol(&self) -> &'static str;

    /// Its axes, in slot order.
    fn axes(&self) -> Vec<&AxisPlan>;

    /// What contradicts itself or would not work in a cycle of `period_ns`, each with the index of its axis.
    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)>;

    /// How long a reply of drive `index` counts on its connection, ns; the next request waits for it. `None`: there
    /// is no connection, and a reply comes in the cycle of its request.
    fn reply_within_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// On a half-duplex wire: the longest time from the slot in which an exchange of drive `index` is due to its end,
    /// all turns before its own included, ns. `None`: a request leaves in the slot in which it is due.
    fn turn_within_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// How long a packet of drive `index` counts, which sends by its own clock, ns. Requests to it are due by divisor
    /// and phase whatever its link, since its watchdog needs them. `None`: it answers requests.
    fn fresh_within_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// What `check` prints of each drive in addition to its [`AxisPlan`]: address, modes, what happens if the
    /// master dies. One paragraph per drive, in slot order, one sentence per line; the address is the first line.
    fn describe(&self, period_ns: u64) -> Vec<String>;

    /// Drive `index` stops by itself within this time if the master dies, ns: its own watchdog. `None`: it does not.
    fn drive_watchdog_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// Opens the sockets and builds the bus for a cycle of `period_ns`. Sends nothing.
    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError>;

    /// Refuses a master that comes for one drive of this bus only, if that would disturb what is in use there. Only
    /// reads, and blocks for a fraction of a second: for normal threads.
    fn require_idle(&self, _carriers: &dyn Carriers) -> Result<(), OpenError> {
        Ok(())
    }

    /// The variables that drive `index` reports in addition to its process data, each once.
    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; MONITOR_CHANNELS];

    /// What [`Counters::own`] counts on this bus, in order.
    fn own_counters(&self) -> &'static [OwnCounter] {
        &[]
    }

    /// The names of the fault codes of its drives.
    fn fault_names(&self) -> FaultNames {
        |_| None
    }

    /// How its drives write addresses and values for acyclic access.
    fn notation(&self) -> Arc<dyn Notation>;

    /// This bus with drive `index` only, and without anything that the drive monitors. Devices found running stay
    /// running.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>>;

    /// The IP addresses of its drives, in slot order; empty if they have none.
    fn addresses(&self) -> Vec<SocketAddrV4>;

    /// This bus in a machine that is otherwise like its own; `None`: it cannot be had so.
    fn variant(&self, _wanted: &Variant) -> Option<Box<dyn BusPlan>> {
        None
    }

    /// What drive `index` can do, in a cycle of `period_ns`.
    fn capabilities(&self, index: usize) -> Capabilities;

    /// Its drives have a common clock that can lead the grid.
    fn has_clock(&self) -> bool {
        false
    }

    /// The names of the devices that are not drives, in the order of [`Bus::device`].
    fn devices(&self) -> Vec<&str> {
        Vec::new()
    }
}

/// Why a bus could not be opened. The message ends with the remedy.
#[derive(Error)]
#[non_exhaustive]
pub enum OpenError {
    /// A socket could not be opened.
    #[error("bus {bus}: cannot bind {address}: {source}; {remedy}")]
    Bind {
        /// The bus.
        bus: String,
        /// The address to bind.
        address: SocketAddrV4,
        /// The operating system's error.
        source: std::io::Error,
        /// The remedy.
        remedy: &'static str,
    },
    /// The connections of a bus could not be set up.
    #[error(
        "bus {bus}: cannot set up its connections: {source}; {}",
        no_descriptor(.source).unwrap_or("look at the limits of open files and threads (ulimit -a)")
    )]
    Streams {
        /// The bus.
        bus: String,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// An interface could not be opened.
    #[error("bus {bus}: cannot use interface {interface}: {source}; {remedy}")]
    Interface {
        /// The bus.
        bus: String,
        /// The interface.
        interface: String,
        /// The operating system's error.
        source: std::io::Error,
        /// The remedy.
        remedy: &'static str,
    },
    /// Another master of this host uses the same interface or drive.
    #[error("bus {bus}: {what} {why}")]
    InUse {
        /// The bus.
        bus: String,
        /// The interface, or the drive with its address.
        what: String,
        /// Who uses it, and the remedy.
        why: Refused,
    },
    /// Another master already exchanges frames on the segment.
    #[error(
        "bus {bus}: another master ({mac}) already has frames on {interface}: end it, or look where the cable leads"
    )]
    OtherMaster {
        /// The bus.
        bus: String,
        /// Its interface.
        interface: String,
        /// The Ethernet address of that master.
        mac: String,
    },
    /// The segment is in use, and a master for one drive only would disturb it.
    #[error(
        "bus {bus}: {what}, and nothing may disturb it: go through the master that runs it; if that has died, start \
        it again with `fieldbeat run`, or switch the slave off and on"
    )]
    Running {
        /// The bus.
        bus: String,
        /// What is in use.
        what: String,
    },
    /// The plan of a drive contradicts itself.
    #[error("bus {bus}, drive {drive}: its cyclic parameters cannot be exchanged; `check` shows why")]
    Plan {
        /// The bus.
        bus: String,
        /// The drive.
        drive: String,
    },
}
crate::errors::debug_as_display!(OpenError);

/// One open bus on the real-time thread. `slots` are those of its own drives, in the order of its plan.
///
/// It carries five kinds of wire. What each of them makes of the exchange of a due slot, and the clauses for it alone:
///
/// - **A reply to each request** (LinUDP): [`Owed`](Exchange::Owed) by the deadline of its cycle, then
///   [`Answered`](Exchange::Answered) with a round trip.
/// - **One request outstanding on a connection** (Modbus TCP): owed by a later deadline, and `awaited` in its own
///   window if the drive usually answers there. [`Slot::reachable`], [`helper_ended`](Bus::helper_ended),
///   [`BusPlan::reply_within_ns`].
/// - **One frame for all drives** (EtherCAT): owed, and [`Absent`](Exchange::Absent) if the frame came back without
///   this one. [`lead`](Bus::lead), [`phase_error`](Bus::phase_error), [`clock`](Bus::clock), devices.
/// - **The drive's own clock** (EtherNet/IP class 1): [`OwnClock`](Exchange::OwnClock), which no packet answers; no
///   round trip, and not suspect. [`BusPlan::fresh_within_ns`].
/// - **Half duplex** (PROFIBUS DP): [`Queued`](Exchange::Queued) until its turn, then owed, and absent if its reply is
///   overdue. [`poll_at`](Bus::poll_at), [`poll`](Bus::poll), [`BusPlan::turn_within_ns`].
pub trait Bus: Send {
    /// Its name in messages.
    fn name(&self) -> &str;

    /// Adds the memory that the bus touches on the real-time thread, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);

    /// The descriptor that is readable while a reply waits to be taken in; `None`: there is nothing to wait for at
    /// present. Queried before each wait, because a connection that returns may have another one. A bus with
    /// several sockets returns an epoll descriptor over them.
    fn fd(&self) -> Option<RawFd>;

    /// Empties the sockets of replies that came too late, if there can be any that would pass for others later. Then
    /// hands the prepared requests of the due slots to the kernel and opens their exchanges, one each, with the stamp
    /// of its own sending. Where replies may come cycles
    /// later, a reply that came since the last window still closes an owed exchange here, and a due slot whose
    /// exchange is still owed is passed over. A due slot whose drive has no connection ends as unsent.
    ///
    /// On a half-duplex wire a due slot is queued, or stays so if it was, and the first in the queue is sent if the
    /// wire is free: those that are not sent in this cycle wait for the next one. A drive with its own clock is sent
    /// its request whatever its link, and its packets are taken in whether it is due or not.
    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// Takes in what has arrived, up to a bounded amount. Never waits, sends nothing. Not called in a cycle whose
    /// window waits for nothing: it is open while an exchange [is waited for](Exchange::is_waited_for), and for
    /// [`poll_at`](Bus::poll_at). Nor is it called where a wait has found nothing to read, or while only other buses
    /// miss a reply. What the window does not wait for, as the reply of a slow drive, is taken in by the next
    /// `receive` or `send`.
    fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// When [`poll`](Bus::poll) is to be called, whatever the descriptor shows: when the reply on a half-duplex wire is
    /// overdue, or its idle time is over. The window stays open for it, up to its deadline. `None`: the descriptor
    /// shows all that has to be waited for. Queried only of a bus that has [`BusPlan::turn_within_ns`].
    fn poll_at(&self) -> Option<Time> {
        None
    }

    /// The time of [`poll_at`](Bus::poll_at) has come: it is `now`, before the deadline, and `receive` has taken in
    /// what arrived. On a half-duplex wire an exchange whose reply is overdue ends as absent, and once the wire is
    /// free the next queued request leaves, with its own stamp. Afterwards `poll_at` is later than `now`, or none.
    fn poll(&mut self, _cycle: &Cycle, _now: Time, _slots: &mut [Slot]) {}

    /// Builds the requests of the slots that are due at the next send, and of those that are queued, in place, from
    /// what is now desired in them. May be called more than once for the same send, with the same bytes as the result,
    /// and again for a later slot if the first was passed over. What was replaced before its request left is never
    /// carried out.
    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// Starts or continues the orderly end; true once nothing more has to be sent. Called after the window of a
    /// cycle, until it is true.
    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool;

    /// Counters of what was received and belongs to no drive.
    fn unmatched(&self) -> Unmatched;

    /// The application's ends of its drives, taken once before the start; `None`: there are none.
    fn ends(&mut self) -> Option<&mut Ends> {
        None
    }

    /// The application's end of the native process data of drive `index`.
    fn native(&mut self, index: usize) -> Option<Box<dyn Any + Send>> {
        self.ends()?.native(index)
    }

    /// Why its drives cannot be reached, for normal threads; `None` for a bus without connections.
    fn notes(&self) -> Option<Arc<dyn Notes>> {
        None
    }

    /// The thread outside of the loop that this bus depends on has ended unexpectedly: its axes are stopped. Queried
    /// once a cycle.
    fn helper_ended(&self) -> bool {
        false
    }

    /// One frame serves all of its drives: it is sent before the requests of other buses, since its reply comes while
    /// they are sent.
    fn is_one_frame(&self) -> bool {
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

    /// The application's end of the process data of device `index`, which is not a drive; taken once before the
    /// start.
    fn device(&mut self, _index: usize) -> Option<Box<dyn Any + Send>> {
        None
    }

    /// The relation of its clock and the grid, if it has a clock. Queried now and then.
    fn clock(&self) -> Option<BusClock> {
        None
    }

    /// The application's end of the acyclic access to device `index`, which is not a drive, and whether it can be
    /// reached, as the link of its feedback; taken once before the start. `None`: the device has no acyclic access.
    fn device_acyclic(&mut self, _index: usize) -> Option<(AcyclicEnds, Observer)> {
        None
    }

    /// The application's end of the acyclic access to drive `index`. Posted calls are carried out in slices of bounded
    /// work, and end as done, refused by the drive, or unavailable. They add no telegram to a cycle and delay none.
    fn acyclic(&mut self, index: usize) -> Option<AcyclicEnds> {
        self.ends()?.acyclic(index)
    }
}

/// Why the drives of a bus cannot be reached, in words: read by normal threads. A real-time writer leaves numbers
/// only, and the reader makes the words.
pub trait Notes: Debug + Send + Sync {
    /// Why drive `index` has no connection; `None`: it has one, or its first opening is under way.
    fn get(&self, index: usize) -> Option<String>;

    /// Why device `index`, which is not a drive, is not in operation; `None`: it is.
    fn device(&self, _index: usize) -> Option<String> {
        None
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

/// What a bus knows of the cycle it works in.
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
#[derive(Clone, Debug, Default)]
pub struct Slot {
    // Written by the loop.
    /// An exchange is due at the next send.
    pub due: bool,
    /// The drive's power is on, or may come on by a request of the loop: a call of the application that commands the
    /// drive is refused, and checked for the last time when the first telegram with it is built. False where the
    /// application owns the control word (native mode).
    pub guarded: bool,
    /// The link as evaluated by the loop. A drive of which nothing is desired is only read, whatever its link. What is
    /// desired goes out with every request, including the probes of a lost link, since it may be the stop.
    pub link: Link,
    /// What the drive shall do from its next request on.
    pub desired: Desired,

    // Written by the bus.
    /// The exchange of this drive.
    pub exchange: Exchange,
    /// What the drive reported last.
    pub status: DriveStatus,
    /// What else is new of it.
    pub notices: Notices,
    /// What proves that the drive has what is desired.
    pub evidence: Evidence,
    /// What has left of that.
    pub gone: Gone,
    /// Exact counts of its exchanges.
    pub counters: Counters,
    /// A drive without a connection has one from now on: it is due next, whatever its link. The loop clears it.
    pub reachable: bool,
    /// The drive was requested to do something that makes it silent, and its power is off: its silence is expected,
    /// is no link loss, and does not stop its stop group.
    pub expected_silence: bool,
    /// A call of the application that commands the drive is under way, or its end is not known: the loop begins no
    /// enable until it is over.
    pub commanded: bool,
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
        /// Until when the newest accepted packet counts: its stamp and [`BusPlan::fresh_within_ns`]. `receive` updates
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

/// What a bus reports of a drive in addition to its status. The loop clears each of them when it has taken it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Notices {
    /// The status is new. It comes with an answered exchange, and of a drive with its own clock with each accepted
    /// packet.
    pub fresh: bool,
    /// The drive was found restarted.
    pub restarted: bool,
    /// Another master was found to command the drive, or to have frames on its segment, with or without a fresh
    /// status; the loop stops the axis.
    pub other_master: bool,
    /// The monitored variables of the status came with the newest reply: not every reply carries them.
    pub monitor_fresh: bool,
    /// The drive refused to report a variable: its channel, and the drive's status.
    pub monitor_refused: Option<(u8, u32)>,
    /// The drive reported an emergency, with or without a fresh status. The loop takes one in each cycle; the next
    /// one waits until then.
    pub emergency: Option<Emergency>,
}

/// Exact counts of one drive's exchanges. `sent = answered + missed + owed`; what is queued is not sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Requests handed to the wire.
    pub sent: u64,
    /// Requests that could not be handed to the wire: the operating system refused, or there was no connection.
    pub unsent: u64,
    /// Exchanges answered in time.
    pub answered: u64,
    /// Exchanges not answered in time.
    pub missed: u64,
    /// Replies that came after their window.
    pub late: u64,
    /// Second replies to one request.
    pub duplicate: u64,
    /// Answered exchanges whose reply may be that of an earlier request.
    pub suspect: u64,
    /// Datagrams from the drive that are no reply of this protocol.
    pub malformed: u64,
    /// Well-formed replies to something that was not requested, or from the wrong port.
    pub foreign: u64,
    /// Counts that only this protocol has, as its [`BusPlan::own_counters`] name them.
    pub own: [u64; OWN_COUNTERS],
}

/// The most counters that a protocol has of its own.
pub const OWN_COUNTERS: usize = 13;

/// A counter that only one protocol has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OwnCounter {
    /// Its key in JSON and metrics: small letters and underscores.
    pub key: &'static str,
    /// What it counts, for people: one short sentence.
    pub what: &'static str,
}

/// The relation of the clock of a bus and the grid, whichever of them leads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusClock {
    /// Distance of the newest slot from where that clock wants it, ns: positive is late; `None`: not measured yet,
    /// or not any more.
    pub error_ns: Option<i64>,
    /// The distance has been inside the window for a while.
    pub locked: bool,
    /// The largest distance since the first lock, ns.
    pub error_max_ns: u64,
    /// The distance that its drives tolerate, ns.
    pub window_ns: u64,
}

/// Exact counts of what arrived at a bus and belongs to none of its drives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unmatched {
    /// Datagrams from an address that is not a drive's.
    pub datagrams: u64,
    /// Datagrams that the kernel dropped because the socket's buffer was full, whoever sent them.
    pub dropped: u64,
    /// Errors of the receiving socket.
    pub errors: u64,
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
