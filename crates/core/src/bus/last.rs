//! The last resort: what stops the drives of a bus without its loop, as data. A wire whose drives have no watchdog of
//! their own says here what they are sent and how they answer; the watch and the guardian send it.
//!
//! All of it stands in memory that another process can get: telegrams, addresses, stop plans. It knows no protocol, and
//! what is sent holds whatever the loop has sent last.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::time::Duration;

use crate::axis::plan::{AxisPlan, HeldBy, Load, StopHow, StopPlan, StopThen, StopTimeout};
use crate::net::Lock;
use crate::rt::{Held, Plain, Regions};
use crate::time::{MS, Time, nanos};

/// The time from one round of a stop to the next, ns. A request that the loop still sends has a stop behind it by then.
pub const ROUND_NS: u64 = 10 * MS;

/// A drive stands if so many rounds in a row show it at least.
const LEAST_STILL: u32 = 3;

/// The last resort of the drives of one socket.
#[derive(Debug)]
pub struct LastResort {
    /// The socket of the loop, once more: a drive may obey the master that it knows and no other one.
    pub socket: UdpSocket,
    /// The drives.
    pub drives: Held<LastDrive>,
    /// The locks of the drives: while they are stopped they are not free.
    pub locks: Vec<OwnedFd>,
}

impl LastResort {
    /// That of `drives`, which are locked by these.
    ///
    /// # Errors
    ///
    /// The kernel gives no descriptors.
    pub fn new(socket: UdpSocket, drives: Vec<LastDrive>, locks: &[Lock]) -> io::Result<LastResort> {
        let locks = locks.iter().filter_map(Lock::descriptor).map(|lock| lock.try_clone_to_owned());
        Ok(LastResort { socket, drives: Held::handed(drives), locks: locks.collect::<io::Result<_>>()? })
    }

    /// The power that the newest request to drive `index` requests, for the loop's side.
    pub fn power_sent(&self, index: usize) -> PowerSent {
        PowerSent::of(self.drives.clone(), index)
    }
}

/// The newest request that left, as far as it is about power.
#[derive(Clone, Debug, Default)]
pub struct PowerSent {
    drives: Held<LastDrive>,
    index: usize,
}

impl PowerSent {
    /// That of one of these drives.
    pub fn of(drives: Held<LastDrive>, index: usize) -> PowerSent {
        PowerSent { drives, index }
    }

    /// A request has left that switches the power on, or off.
    pub fn note(&self, on: bool) {
        if let Some(drive) = self.drives.all().get(self.index) {
            drive.sent.store(if on { Power::On } else { Power::Off } as u8, Ordering::Relaxed);
        }
    }

    /// Adds the memory that it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(self.drives.all());
    }
}

/// The last request to a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Power {
    /// Nothing about its power: it is not commanded.
    Untouched = 0,
    /// To be off.
    Off = 1,
    /// To be on.
    On = 2,
}

/// One drive.
#[derive(Debug, Default)]
#[repr(C, align(64))]
pub struct LastDrive {
    /// A [`Power`].
    sent: AtomicU8,
    /// How its stop went.
    pub outcome: Outcome,
    known: StopFacts,
}

// SAFETY: numbers and atomic numbers in the layout of C.
unsafe impl Plain for LastDrive {}

/// The facts of a drive before the start. Numbers only, checked when they are read.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
struct StopFacts {
    standstill: f64,
    timeout_ns: u64,
    reply: Reply,
    address: [u8; 4],
    port: u16,
    standstill_for: u32,
    how: u8,
    then: u8,
    on_timeout: u8,
    keeps_power: u8,
    telegrams: Telegrams,
    name: Name,
}

/// The name of a drive, as much of it as there is room for.
type Name = [u8; 32];

/// The telegrams for a drive.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct Telegrams {
    /// Commands nothing: the drive shows whether it has power.
    pub look: Telegram,
    /// Halts it and keeps it controlled. It switches on a drive that is ready for that.
    pub halt: Telegram,
    /// Switches it off.
    pub off: Telegram,
}

/// One telegram.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct Telegram {
    length: u8,
    bytes: [u8; 15],
}

impl Telegram {
    /// These bytes, 15 at most.
    pub fn new(bytes: &[u8]) -> Telegram {
        let mut telegram = Telegram { length: bytes.len().min(15) as u8, ..Telegram::default() };
        telegram.bytes.iter_mut().zip(bytes).for_each(|(to, from)| *to = *from);
        telegram
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..usize::from(self.length).min(15)]
    }

    /// The head of the reply to it. No reply to a request of the loop begins so.
    pub fn echo(&self) -> &[u8] {
        &self.bytes()[..self.bytes().len().min(ECHO)]
    }
}

/// The number of bytes of a telegram that come back at the beginning of its reply.
const ECHO: usize = 8;

/// How a drive answers such a telegram: little-endian words at fixed places.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct Reply {
    /// The drives' states without power, a bit each.
    pub unpowered: u64,
    /// User units of one count of the position.
    pub unit: f64,
    /// The bits of the status word of which one is set while the drive moves.
    pub moving: u16,
    /// Where the status word is.
    pub status_at: u8,
    /// Where the state is, a byte.
    pub state_at: u8,
    /// Where the position is, 32 bits.
    pub position_at: u8,
}

/// The state that a drive shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighted {
    /// The power stage may be on.
    pub powered: bool,
    /// The setpoint generator is running.
    pub moving: bool,
    /// The position, counts.
    pub position: i32,
}

impl Reply {
    /// The state that a reply to `telegram` shows; `None`: it is none.
    pub fn read(&self, telegram: &Telegram, bytes: &[u8]) -> Option<Sighted> {
        let rest = |at: u8| bytes.get(usize::from(at)..);
        let status = u16::from_le_bytes(*rest(self.status_at)?.first_chunk()?);
        let state = *rest(self.state_at)?.first()?;
        let position = i32::from_le_bytes(*rest(self.position_at)?.first_chunk()?);
        // A state that is not known counts as one with power, so that nothing is done because of it.
        let powered = self.unpowered.checked_shr(state.into()).is_none_or(|states| states & 1 == 0);
        let is_reply = bytes.starts_with(telegram.echo());
        is_reply.then_some(Sighted { powered, moving: status & self.moving != 0, position })
    }
}

impl LastDrive {
    /// The drive of `axis` at `address`, in a cycle of `period_ns`: what halts it and keeps it controlled, what
    /// switches it off, and how it answers both.
    pub fn new(
        axis: &AxisPlan,
        period_ns: u64,
        address: SocketAddrV4,
        telegrams: Telegrams,
        reply: Reply,
    ) -> LastDrive {
        let stop = &axis.stop;
        // As long as its exchanges in the cycle.
        let still_ns =
            period_ns.saturating_mul(axis.divisor.into()).saturating_mul(stop.standstill_for.into());
        let rounds = u32::try_from(still_ns.div_ceil(ROUND_NS)).unwrap_or(u32::MAX);
        let mut name = Name::default();
        name.iter_mut().zip(axis.name.as_bytes()).for_each(|(to, from)| *to = *from);
        let known = StopFacts {
            standstill: stop.standstill,
            timeout_ns: nanos(stop.timeout),
            reply,
            address: address.ip().octets(),
            port: address.port(),
            standstill_for: rounds.max(LEAST_STILL),
            how: stop.how as u8,
            then: stop.then as u8,
            on_timeout: stop.on_timeout as u8,
            keeps_power: (axis.load == Load::Vertical(HeldBy::Drive)).into(),
            telegrams,
            name,
        };
        LastDrive { known, ..LastDrive::default() }
    }

    /// The power that was requested last.
    pub fn sent(&self) -> Power {
        match self.sent.load(Ordering::Relaxed) {
            0 => Power::Untouched,
            1 => Power::Off,
            // Or whatever a dying process has made of it: a halt moves nothing.
            _ => Power::On,
        }
    }

    /// It is sent off from now on.
    pub fn note_off(&self) {
        self.sent.store(Power::Off as u8, Ordering::Relaxed);
    }

    /// The name; a long one is cut.
    pub fn name(&self) -> String {
        let end = self.known.name.iter().position(|byte| *byte == 0).unwrap_or(self.known.name.len());
        String::from_utf8_lossy(&self.known.name[..end]).into_owned()
    }

    /// The address.
    pub fn address(&self) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::from(self.known.address), self.known.port)
    }

    /// The telegrams to send.
    pub fn telegrams(&self) -> Telegrams {
        self.known.telegrams
    }

    /// How it answers.
    pub fn reply(&self) -> Reply {
        self.known.reply
    }

    /// How it is stopped, and what becomes of its load. The master's own ramp needs the loop: the drive's quick stop
    /// takes its place.
    pub fn stop(&self) -> (StopPlan, Load) {
        let StopFacts { how, then, on_timeout, keeps_power, standstill, standstill_for, timeout_ns, .. } =
            self.known;
        let is = |number: u8, value: u8| number == value;
        let plan = StopPlan {
            how: if is(how, StopHow::Coast as u8) { StopHow::Coast } else { StopHow::Quick },
            deceleration: 0.0,
            then: if is(then, StopThen::Hold as u8) { StopThen::Hold } else { StopThen::Disable },
            timeout: Duration::from_nanos(timeout_ns),
            on_timeout: match is(on_timeout, StopTimeout::Hold as u8) {
                true => StopTimeout::Hold,
                false => StopTimeout::Disable,
            },
            standstill,
            standstill_for,
            group: None,
        };
        (plan, if keeps_power == 0 { Load::Level } else { Load::Vertical(HeldBy::Drive) })
    }
}

/// How the stop of a drive went, written by whoever stops it.
#[derive(Debug, Default)]
#[repr(C)]
pub struct Outcome {
    /// Replies to it.
    replies: AtomicU64,
    /// When it was seen at standstill first, ns after the wires were taken, and 1; 0: never.
    stood: AtomicU64,
    /// The same of its power being off.
    off: AtomicU64,
}

impl Outcome {
    /// One more reply.
    pub fn count_reply(&self) {
        self.replies.store(self.replies() + 1, Ordering::Relaxed);
    }

    /// It stands, so long after the wires were taken.
    pub fn set_stood(&self, after: Time) {
        self.stood.store(after.0 + 1, Ordering::Relaxed);
    }

    /// The power is off.
    pub fn set_off(&self, after: Time) {
        self.off.store(after.0 + 1, Ordering::Relaxed);
    }

    /// Replies to it.
    pub fn replies(&self) -> u64 {
        self.replies.load(Ordering::Relaxed)
    }

    /// When it was seen at standstill, ns after the wires were taken.
    pub fn stood_ns(&self) -> Option<u64> {
        self.stood.load(Ordering::Relaxed).checked_sub(1)
    }

    /// When its power was seen off, ns after the wires were taken.
    pub fn off_ns(&self) -> Option<u64> {
        self.off.load(Ordering::Relaxed).checked_sub(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::units::Units;

    const REPLY: Reply = Reply {
        unpowered: 0b10111,
        unit: 1e-4,
        moving: 1 << 13 | 1 << 9,
        status_at: 8,
        state_at: 11,
        position_at: 12,
    };

    #[test]
    fn monitored_values_are_read_at_the_place_that_the_wire_declares() {
        let halt = Telegram::new(&[1, 0, 0, 0, 7, 0, 0, 0, 0x2F, 0]);
        let bytes = [1, 0, 0, 0, 7, 0, 0, 0, 0, 0x20, 0, 8, 0x10, 0, 0, 0];
        assert_eq!(REPLY.read(&halt, &bytes), Some(Sighted { powered: true, moving: true, position: 16 }));
        let mut off = bytes;
        (off[9], off[11]) = (0, 2);
        assert_eq!(REPLY.read(&halt, &off), Some(Sighted { powered: false, moving: false, position: 16 }));
        // A state of newer firmware.
        off[11] = 200;
        assert!(REPLY.read(&halt, &off).unwrap().powered);
        // A reply to the loop, and those that are cut.
        assert_eq!(REPLY.read(&halt, &[&[1, 0, 0, 0, 15], &bytes[5..]].concat()), None);
        (0..bytes.len()).for_each(|end| assert_eq!(REPLY.read(&halt, &bytes[..end]), None, "{end}"));
    }

    #[test]
    fn a_drive_is_the_same_in_other_memory() {
        let mut axis = AxisPlan::new("spindle", Units::millimetres(1_000.0));
        axis.stop.how = StopHow::Coast;
        axis.stop.on_timeout = StopTimeout::Hold;
        axis.stop.then = StopThen::Hold;
        axis.load = Load::Vertical(HeldBy::Drive);
        let address = "10.0.0.7:49360".parse().unwrap();
        let [look, halt, off] = [&[7, 8, 9], &[1, 2, 3], &[4, 5, 6]].map(|bytes| Telegram::new(bytes));
        let telegrams = Telegrams { look, halt, off };
        let held = Held::handed(vec![LastDrive::new(&axis, MS, address, telegrams, REPLY)]);
        let other = held.descriptor().unwrap().try_clone_to_owned().unwrap();
        let other = Held::<LastDrive>::received(other).unwrap();
        let sent = PowerSent::of(held, 0);
        let drive = other.first();
        assert_eq!((drive.name().as_str(), drive.address()), ("spindle", address));
        let Telegrams { look, halt, off } = drive.telegrams();
        assert_eq!([look, halt, off].map(|telegram| telegram.bytes()[0]), [7, 1, 4]);
        let (stop, load) = drive.stop();
        assert_eq!(
            (stop.how, stop.then, stop.on_timeout),
            (StopHow::Coast, StopThen::Hold, StopTimeout::Hold)
        );
        assert_eq!((stop.timeout, load), (axis.stop.timeout, axis.load));
        assert_eq!(drive.sent(), Power::Untouched);
        for (on, power) in [(true, Power::On), (false, Power::Off)] {
            sent.note(on);
            assert_eq!(drive.sent(), power);
        }
        // Its own ramp is the master's.
        let level =
            LastDrive::new(&AxisPlan::new("y", Units::millimetres(1_000.0)), MS, address, telegrams, REPLY);
        assert_eq!((level.stop().0.how, level.stop().1), (StopHow::Quick, Load::Level));
        assert_eq!(level.outcome.stood_ns(), None);
        level.outcome.set_stood(Time(0));
        assert_eq!((level.outcome.stood_ns(), level.outcome.off_ns()), (Some(0), None));
    }
}
