//! The contract between the loop and a protocol, and one folder a protocol.
//!
//! All of [`Bus`] runs on the real-time thread: bounded work, no allocation, no lock, no wait, and no panic on any
//! bytes. No protocol knows another. A protocol has these rooms:
//!
//! | file | what | must not know |
//! |---|---|---|
//! | `wire` | bytes <-> values | state, clock, socket, allocation |
//! | `station` | the master's view of one drive: a machine of state and time | sockets |
//! | `bus` | stations + sockets = one [`Bus`] | the loop |
//! | `sim` | the simulated drive: the same wire from the other end | the master's station |
//!
//! What a bus owes the loop is put to the test clause by clause in `tests/conformance`, which every protocol runs.

pub mod ethercat;
pub mod linudp;
pub mod modbus;

use std::any::Any;
use std::fmt::Debug;
use std::os::fd::RawFd;
use std::sync::Arc;

use thiserror::Error;

use crate::axis::acyclic::{AcyclicEnds, Notation};
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{
    AxisPlan, Emergency, Failure, FaultNames, Link, MonitorChannel, Observer, PlanFault, Row, State, Verb,
};
use crate::net::{Carriers, LinkNotes};
use crate::rt::Regions;
use crate::sim::{SimDrive, SimLine};
use crate::time::Time;

/// A bus as configured and checked, before any socket is open.
pub trait BusPlan: Debug + Send + Sync {
    /// Its name in messages.
    fn name(&self) -> &str;

    /// The protocol's name, as in the configuration.
    fn protocol(&self) -> &'static str;

    /// Its axes, in slot order.
    fn axes(&self) -> Vec<&AxisPlan>;

    /// What contradicts itself or would not work in a cycle of `period_ns`, each with the place of its axis.
    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)>;

    /// How long a reply of drive `index` counts on its connection, ns: the next request waits for it. `None`: there is
    /// no connection, and replies come in the cycle that asks.
    fn reply_within_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// What `check` says of each drive beyond its [`AxisPlan`]: address, modes, what happens if the master dies. A
    /// paragraph a drive, in slot order, a sentence a line; the address is its first line.
    fn describe(&self, period_ns: u64) -> Vec<String>;

    /// Drive `index` stops by itself within this time if the master dies, ns: its own watchdog. `None`: it does not.
    fn drive_watchdog_ns(&self, _index: usize) -> Option<u64> {
        None
    }

    /// Opens the sockets and builds the bus for a cycle of `period_ns`. Sends nothing.
    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError>;

    /// What drive `index` shows besides its process data, each variable once.
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

    /// This bus with drive `index` only, and with nothing that it shows besides. What is found running there is left
    /// so.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>>;

    /// The drives of this bus, simulated, in slot order; none if they are on a line.
    fn simulate(&self) -> Vec<Box<dyn SimDrive>>;

    /// The line of this bus, simulated, if its drives are on one.
    fn simulate_line(&self) -> Option<Box<dyn SimLine>> {
        None
    }

    /// Drive `index` makes moves and follows streams; else it turns only.
    fn takes_positions(&self, _index: usize) -> bool {
        true
    }

    /// Its drives have a common clock that can lead the grid.
    fn has_clock(&self) -> bool {
        false
    }

    /// The names of what takes part without being a drive, in the order of [`Bus::device`].
    fn devices(&self) -> Vec<&str> {
        Vec::new()
    }
}

/// Why a bus could not be opened. The message ends with the remedy.
#[derive(Error)]
pub enum OpenError {
    /// A socket could not be opened.
    #[error("bus {bus}: cannot bind {address}: {source}; {remedy}")]
    Bind {
        /// The bus.
        bus: String,
        /// Where it wanted to listen.
        address: std::net::SocketAddrV4,
        /// What the operating system said.
        source: std::io::Error,
        /// What to do about it.
        remedy: &'static str,
    },
    /// The connections of a bus could not be set up.
    #[error(
        "bus {bus}: cannot set up its connections: {source}; look at the limits of open files and threads (ulimit -a)"
    )]
    Streams {
        /// The bus.
        bus: String,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// An interface could not be opened.
    #[error("bus {bus}: cannot use interface {interface}: {source}; {remedy}")]
    Interface {
        /// The bus.
        bus: String,
        /// The interface.
        interface: String,
        /// What the operating system said.
        source: std::io::Error,
        /// What to do about it.
        remedy: &'static str,
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
pub trait Bus: Send {
    /// Its name in messages.
    fn name(&self) -> &str;

    /// Adds the memory that it touches on the real-time thread, to be locked with `memory = "own"`.
    fn memory(&self, regions: &mut Regions);

    /// The descriptor that is readable while a reply waits to be taken in; `None`: nothing can be waited for at
    /// present. Asked anew before each wait: a connection that returns may have another one. A bus with several has an
    /// epoll over them.
    fn fd(&self) -> Option<RawFd>;

    /// Empties the sockets of what came too late, then hands the prepared requests of the due slots to the kernel and
    /// opens their exchanges, one each. Where replies may come cycles later, one that came since the last window still
    /// closes an owed exchange here, and a due slot whose exchange is still owed is passed over. A due slot whose drive
    /// cannot be asked now, having no connection, ends as unsent.
    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// Takes in what has arrived, a bounded part of a flood. Never waits, sends nothing. True once every exchange that
    /// this window waits for is closed: those owed by its deadline, and those sent in it and awaited. Not called in a
    /// cycle that waits for none.
    fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool;

    /// Builds the requests of the slots that are due at the next send, in place, from the orders that now stand in
    /// them. May be called more than once for the same send, with the same bytes as the result, and again for a later
    /// slot if the first was passed over. An order that was replaced before its request went out is never carried out.
    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]);

    /// Starts or continues the orderly end; true once nothing more is owed to the wire. Called behind the window of a
    /// cycle, until it is true.
    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool;

    /// What was received and belongs to no drive.
    fn strangers(&self) -> Strangers;

    /// The application's end of the native process data of drive `index`, taken once before the start.
    fn native(&mut self, index: usize) -> Option<Box<dyn Any + Send>>;

    /// Why its drives cannot be asked, for normal threads; `None` for a bus that needs no connection to ask them.
    fn notes(&self) -> Option<Arc<dyn Notes>> {
        None
    }

    /// Its clock leads the grid from now on; asked once before the start, of one bus at most. Any other bus with a
    /// clock slaves it to the grid.
    fn lead(&mut self) {}

    /// How far a slot of the grid was from where the clock of this bus wants it, ns: positive is late. At most one a
    /// cycle, `None` from a cycle that was not answered. Taken behind the window; what was taken is not told again.
    fn phase_error(&mut self) -> Option<i64> {
        None
    }

    /// The application's end of the process data of the device `index`, that is no drive, taken once before the start.
    fn device(&mut self, _index: usize) -> Option<Box<dyn Any + Send>> {
        None
    }

    /// How its clock and the grid stand to each other, if it has one. Asked now and then.
    fn clock(&self) -> Option<BusClock> {
        None
    }

    /// The application's end of the acyclic access to the device `index`, that is no drive, and whether it can be
    /// asked, as the link of its feedback; taken once before the start. `None`: it has none.
    fn device_acyclic(&mut self, _index: usize) -> Option<(AcyclicEnds, Observer)> {
        None
    }

    /// The application's end of the acyclic access to drive `index`, taken once before the start. What is posted there
    /// is carried out in slices of bounded work, and ends: done, refused by the drive, or not to be had. It adds no
    /// telegram to a cycle and moves none.
    fn acyclic(&mut self, index: usize) -> Option<AcyclicEnds>;
}

/// Why the drives of a bus cannot be asked, in words: read by normal threads, whoever writes it. Where the real-time
/// thread does, it leaves numbers only, and the words are made by the reader.
pub trait Notes: Debug + Send + Sync {
    /// Why drive `index` has no connection; `None`: it has one, or its first opening is under way.
    fn get(&self, index: usize) -> Option<String>;

    /// Why the device `index`, that is no drive, is not in operation; `None`: it is.
    fn device(&self, _index: usize) -> Option<String> {
        None
    }

    /// What the kernel dropped of what arrived, as far as only a normal thread may ask for it.
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

/// What a bus is told of the cycle it works in.
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
    /// Whether what is owed by `reply_by` is owed in this window. That time was laid down some cycles before, and a
    /// clock that leads the grid moves the windows a little against it: it means the nearest one.
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
    /// The link as judged. A drive without an order is only read, whatever its link; an order that stands goes out with
    /// every request, with the probes of a lost link too: it may be the stop.
    pub link: Link,
    /// What the drive shall do.
    pub order: Order,
    /// The row to follow at the next send, while the order is to follow.
    pub row: Option<NumberedRow>,
    /// The velocity to go at from the next send on, user units/s, while the order is a jog or cyclic velocity. A jog
    /// begins with its own.
    pub velocity: f64,
    /// The torque to give from the next send on, per cent of the rated torque, while the order is cyclic torque. Above
    /// 0 it accelerates towards higher user positions, whichever way the drive counts.
    pub torque: f64,

    // Written by the bus.
    /// The exchange of this drive.
    pub exchange: Exchange,
    /// How far the order is.
    pub progress: Progress,
    /// What the drive last said.
    pub report: Report,
    /// What was sent and what came of it.
    pub counters: Counters,
    /// A drive that could not be asked can be asked from now on: it is due next, whatever its link. The loop clears it.
    pub reachable: bool,
    /// The drive was asked for something that makes it silent, and its power is off: its silence is nobody else's
    /// affair.
    pub excused: bool,
}

/// What a drive shall do. A new serial is a new order and replaces the one before it; the same one is carried out once.
/// It outlives missed exchanges and refused sends. What the drive cannot do ends as unsupported in the first `prepare`.
/// A relative move and a jog keep to the position limits of the axis: only the bus knows where they lead.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Order {
    /// 0 = none yet.
    pub serial: u64,
    /// What; `None` = keep the state the drive is in.
    pub verb: Option<Verb>,
}

/// A row and its number: the same number is the same row, not to be run twice.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NumberedRow {
    /// Grows by one a row.
    pub number: u64,
    /// The row.
    pub row: Row,
}

/// How far the station is with the order of this serial.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Of which order.
    pub serial: u64,
    /// `None` = still working on it.
    pub end: Option<Result<(), Failure>>,
}

/// The state of a drive's exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Exchange {
    /// None.
    #[default]
    Idle,
    /// Sent, and owed.
    Owed {
        /// When it was sent.
        sent_at: Time,
        /// Until when the reply counts: the deadline of this cycle, or of a later one.
        reply_by: Time,
        /// The window in which it was sent stays open for it, although it may come later.
        awaited: bool,
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
    /// It was sent, and what came back says that this drive was not part of it. The loop calls it missed.
    Absent,
    /// `reply_by` passed. The loop says so.
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
}

/// What a drive last said, in user units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Report {
    /// New since the loop last looked; the loop clears it.
    pub fresh: bool,
    /// The drive was found restarted; the loop clears it.
    pub restarted: bool,
    /// When it was taken in.
    pub at: Time,
    /// State of the drive.
    pub state: State,
    /// Homed, as the drive says.
    pub homed: bool,
    /// The drive's setpoint generator is running.
    pub moving: bool,
    /// In the target window, as the drive says.
    pub in_target: bool,
    /// The drive's hardware enable (STO) is missing.
    pub inhibited: bool,
    /// It may be one request old.
    pub suspect: bool,
    /// Actual position, user units; NaN if the drive tells none, like the three below.
    pub position: f64,
    /// Demand position, user units.
    pub demand: f64,
    /// Actual velocity, user units/s.
    pub velocity: f64,
    /// Motor current, A.
    pub current: f64,
    /// Warning word, 0 = none.
    pub warning: u32,
    /// Fault code, 0 = none.
    pub fault: u32,
    /// What the drive shows besides.
    pub monitor: [Option<f64>; MONITOR_CHANNELS],
    /// `monitor` came with the newest reply: not every one says something of it. The loop clears it.
    pub monitor_fresh: bool,
    /// The drive refused to show a variable: which channel, and its status. The loop clears it.
    pub monitor_refused: Option<(u8, u32)>,
    /// The drive told an emergency, whether an exchange brought anything new or not. The loop takes it in each cycle:
    /// the next one waits until it has.
    pub emergency: Option<Emergency>,
}

/// Exact counts of one drive's exchanges. `sent = answered + missed + owed`.
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
    /// What came from the drive and is no reply of this protocol.
    pub malformed: u64,
    /// Well-formed replies to something that was not asked, or from the wrong port.
    pub foreign: u64,
    /// What only this protocol counts, as its [`BusPlan::own_counters`] name them.
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

/// How the clock of a bus and the grid stand to each other, whichever of them leads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusClock {
    /// How far the newest slot was from where that clock wants it, ns: positive is late; `None`: it was not seen yet,
    /// or is not any more.
    pub error_ns: Option<i64>,
    /// It has been where its drives want it for a while.
    pub locked: bool,
    /// The largest distance since that was so for the first time, ns.
    pub error_max_ns: u64,
    /// How far off its drives bear it, ns.
    pub window_ns: u64,
}

/// Exact counts of what arrived at a bus and is put down to none of its drives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Strangers {
    /// Datagrams from an address that is no drive's.
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
