//! The master's view of one Unidrive: one request after the other on its connection, and the result of each.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the station, and the life of its connection |
//! | `request` | the next request |
//! | `receive` | received bytes |
//! | `report` | the values of a reply: what they confirm, and the drive's report |

mod receive;
mod report;
mod request;

use std::sync::Arc;

use self::receive::Expected;
use self::request::Template;
use super::calls::{Calls, commanding};
use super::counters::Own;
use super::echo::Echo;
use super::handshake::{BUSY_WITHIN, Finding, Found};
use super::identity::Identity;
use super::mapping::{Image, Mapping};
use super::native::{Also, Native, NativePort, native};
use super::other::OtherMaster;
use super::pace::Pace;
use super::plan::UnidriveDrive;
use super::profile::{Inputs, Outputs, Profile};
use super::read_write::ReadWrite;
use super::setup::{Purpose, Setting, settings};
use super::wire::ADU_MAX;
use super::words::ControlWord;
use fieldbeat_core::axis::acyclic::{self, AcyclicEnds};
use fieldbeat_core::bus::desired::Accepted;
use fieldbeat_core::bus::native::{Inputs as NativeInputs, NativeBytes};
use fieldbeat_core::bus::{Cycle, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::net::Broken;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// The end waits so many reply times for the drive's time-out to be disarmed.
const DISARM_WITHIN: u64 = 3;
/// A cyclic exchange that is refused so often in a row does not match the handshake, which is repeated: as it is after
/// the drive was busy for [`BUSY_WITHIN`].
const MOST_REFUSALS: u32 = 3;
/// A request that the drive was too busy for is no turn, so often in a row: what it never serves must not keep all
/// other parameters away.
const MOST_REPEATED: u8 = 3;

/// One drive as the master sees it. What each exchange touches comes first: it lies on a few lines of the cache.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Station {
    conn: Connection,
    /// Its ids go on with the next connection.
    identity: Identity,
    grid: Time,
    connected: bool,
    /// An exchange was owed as this cycle's send began: none is due.
    pub(super) passed: bool,
    /// It reports the numbers of its trips.
    reports_trips: bool,
    /// No time-out has to be set in the drive before it is enabled.
    unwatched: bool,
    end: End,
    pace: Pace,
    reply_within_ns: u64,
    /// A window of this length is followed by so much time for a reply, in whole periods; at first it is longer
    /// than any.
    window_ns: u64,
    beyond_ns: u64,
    functions: ReadWrite,
    /// The control word sent last, on whatever connection.
    control_sent: Option<ControlWord>,
    /// User units/s of one count of the speed feedback.
    velocity_per_count: f64,
    /// The monitored channels, and the counts in one unit of each.
    shown: Box<[(usize, f64)]>,
    /// The settings that make the drive follow the control word and watch it: written with the first command that
    /// needs them.
    settings: Box<[Setting]>,
    inbox: Vec<u8>,
    profile: Profile,
    native: NativePort,
    also: Also,
    calls: Calls,
    /// The requests that write, calls and settings; and those that only read.
    rooms: [[u8; ADU_MAX]; 2],
    /// The blocks at their own addresses, and those of menu 0.
    direct: Mapping,
    menu_0: Option<Mapping>,
    found: Arc<Found>,
    log: InputLog,
    opened_before: bool,
    /// The control word that the drive accepted last, or had at first, on whatever connection.
    control_taken: Option<ControlWord>,
}

/// What begins anew with each connection: the drive's values are not known until they are read back, nor its state
/// until it reports again. What each exchange touches comes first.
#[derive(Debug, Default)]
#[repr(C)]
struct Connection {
    /// Length of the prepared request, 0: there is none; and its room.
    length: usize,
    room: usize,
    /// Length of the open one, and how much of it the wire has taken. The next one is built over it once all is
    /// taken.
    open: usize,
    gone: usize,
    /// Received bytes that are not a whole message yet.
    filled: usize,
    /// The open request, when it was sent, and its unit id.
    requested: What,
    requested_unit: u8,
    requested_at: Time,
    /// The values that it writes.
    written: Outputs,
    prepared: What,
    /// The values that the prepared request writes.
    outputs: Outputs,
    /// The reply to the open request, if only one is right.
    expected: Expected,
    /// Writes, and reads, that were refused in a row; and since when the drive is busy, for so many requests.
    refused: (u32, u32),
    busy: Option<(Time, u8)>,
    inputs: Inputs,
    /// Another reply that reads back what it wrote, with the same status, reports nothing new but speeds.
    steady: bool,
    /// So many of the settings stand, and whether the others can be written.
    settable: bool,
    set: usize,
    finding: Finding,
    control: Echo,
    reference: Echo,
    other: OtherMaster,
    /// The constant parts of the requests in their rooms, if they are cyclic.
    templates: [Option<Template>; 2],
    image: Image,
    /// The last read was to check whether a value was accepted.
    confirmed: bool,
    /// Exchanges that read, and that wrote; those that wrote only, in a row.
    reads: u32,
    writes: u32,
    written_in_a_row: u8,
    /// The trip number in the image is that of the present trip; without one, it was read since the last healthy
    /// status.
    trip_read: bool,
    /// A status, a speed was read since the last report.
    seen: (bool, bool),
    was_active: bool,
    /// When the power stage was last off although the drive was commanded to run.
    dark_at: Option<Time>,
}

impl NativeInputs for Station {
    fn put(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        self.also.inputs(&self.native, since, out)
    }
}

/// The progress of the orderly end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    NotYet,
    /// The drive has to be seen off, until this instant at the latest ...
    Waiting(Time),
    /// ... then its time-out is disarmed.
    Disarming(Time),
    Done,
}

/// Room for received bytes: a whole message, and those after it.
const ROOM: usize = 2 * ADU_MAX;

/// The purpose of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    /// An acyclic call.
    Call,
    /// A setting, and its value: what is to be set, or 0 to disarm a time-out.
    Set { index: u8, value: i32 },
    /// Blocks to write and to read.
    Cyclic(Blocks),
}

impl Default for What {
    fn default() -> What {
        What::Cyclic(Blocks::default())
    }
}

/// The blocks of a cyclic request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Blocks {
    write: Option<u8>,
    read: Option<u8>,
    /// The block to write has the control word, the reference.
    control: bool,
    reference: bool,
    /// The block to read is out of turn.
    confirms: bool,
    /// The registers of both together.
    registers: u16,
}

impl Blocks {
    /// It writes and reads: FC23.
    fn is_both(&self) -> bool {
        self.write.is_some() && self.read.is_some()
    }
}

/// Why a connection has to be given up.
pub type Why = &'static str;
/// What was counted says more than these.
pub(super) const SILENT: Why = "a request was not answered within twice its time";
pub(super) const BROKE: Why = "the connection broke";

impl Station {
    /// The station of `drive`, and the application's ends of its native process
    /// data and of its acyclic access.
    pub fn new(
        drive: &UnidriveDrive,
        mappings: (Mapping, Option<Mapping>),
        found: Arc<Found>,
        log: &InputLog,
    ) -> (Station, Native, AcyclicEnds) {
        let (application, native, also) = native(drive.map.also.len());
        let outputs = [drive.map.control.parameter, drive.map.reference.parameter];
        let (ends, port) = acyclic::queue(drive.axis.parameter_queue, commanding(outputs));
        let (native, port) = (native.logged(log), port.logged(log));
        let shown = drive.map.show.iter().enumerate();
        let station = Station {
            velocity_per_count: drive.velocity(drive.map.speed.value(1)),
            reports_trips: drive.map.trip.is_some(),
            shown: shown.filter_map(|(channel, mapped)| Some((channel, (*mapped)?.raw(1.0)))).collect(),
            direct: mappings.0,
            menu_0: mappings.1,
            found,
            log: log.source(),
            functions: ReadWrite::new(drive.functions),
            unwatched: drive.watchdog.timeout_ns.is_none()
                && (drive.watchdog.keypad || drive.watchdog.accept_none),
            settings: if drive.set_up { settings(drive, None).into() } else { Box::default() },
            end: End::NotYet,
            reply_within_ns: drive.reply_within_ns,
            window_ns: u64::MAX,
            beyond_ns: 0,
            pace: Pace::new(),
            profile: Profile::new(drive),
            calls: Calls::new(port, drive.addressing),
            native,
            also,
            connected: false,
            opened_before: false,
            passed: false,
            identity: Identity::default(),
            grid: Time(0),
            rooms: [[0; ADU_MAX]; 2],
            inbox: vec![0; ROOM],
            conn: Connection::default(),
            control_taken: None,
            control_sent: None,
        };
        (station, application, ends)
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.inbox);
        regions.add(&*self.shown);
        self.native.memory(regions);
        self.also.memory(regions);
        self.calls.memory(regions);
        for mapping in std::iter::once(&self.direct).chain(&self.menu_0) {
            mapping.memory(regions);
        }
    }

    /// A new connection is there, with its handshake complete.
    pub fn connected(&mut self, slot: &mut Slot) {
        self.connected = true;
        let finding = self.found.get(&self.log);
        let velocity = f64::from(finding.speed) * self.velocity_per_count;
        let inputs = Inputs { seen: true, status: finding.status, velocity, ..Inputs::default() };
        // A setting that is right already is not written again.
        let is_met = |setting: &&Setting| match setting.purpose {
            Purpose::Obey => finding.obeys,
            Purpose::Watch => finding.watched,
            Purpose::Menu0 => true,
        };
        let set = self.settings.iter().take_while(is_met).count();
        let settable = !self.settings.is_empty();
        self.conn = Connection { finding, inputs, set, settable, ..Connection::default() };
        self.tell_set_up();
        self.identity.reconnected();
        self.functions.reconnected();
        // It stands still, and has neither the last accepted control word nor the last one sent.
        let known = [self.control_taken, self.control_sent];
        if self.control_sent.is_some() && !finding.status.active() && !known.contains(&Some(finding.control))
        {
            slot.notices.restarted = true;
            (self.control_taken, self.control_sent) = (None, None);
            self.profile.drive_restarted();
        }
        // Until it has accepted another one, this is no sign of a restart.
        self.control_taken = self.control_taken.or(Some(finding.control));
        slot.evidence.accepted = Accepted::default();
        self.profile.prove(&self.conn.inputs, &mut slot.evidence);
        slot.reachable = true;
        slot.counters.own[Own::SecondReplies as usize] += u64::from(finding.duplicates);
        slot.counters.own[Own::Exceptions as usize] += u64::from(finding.busy);
        if std::mem::replace(&mut self.opened_before, true) {
            Own::Reopened.count(&mut slot.counters);
        }
    }

    /// The profile gets to know what the drive is set to.
    fn tell_set_up(&mut self) {
        let Finding { watched, obeys, .. } = self.conn.finding;
        self.profile.found(watched || self.unwatched, obeys, self.conn.settable);
    }

    /// The connection is gone.
    pub(super) fn disconnected(&mut self) {
        self.connected = false;
        if self.identity.is_open() {
            self.pace.unanswered();
        }
        self.calls.lost();
    }

    /// A request was not answered yet, or half a message has come.
    #[inline]
    pub(super) fn owes(&self) -> bool {
        self.identity.is_open() || self.conn.filled > 0
    }

    /// The open request writes and reads: FC23.
    fn reads_and_writes(&self) -> bool {
        self.identity.is_open() && matches!(self.conn.requested, What::Cyclic(blocks) if blocks.is_both())
    }

    /// The connection has ended at the other end, or broken: in words.
    pub(super) fn ended(&mut self, broken: Broken, slot: &mut Slot) -> Why {
        let counter = if self.conn.filled > 0 { Own::CutOff } else { Own::Closed };
        counter.count(&mut slot.counters);
        let closed = matches!(broken, Broken::Closed | Broken::Failed(libc::ECONNRESET | libc::EPIPE));
        let on_both = closed && self.reads_and_writes() && self.functions.closed();
        self.disconnected();
        match broken {
            _ if on_both => "the drive closes it on FC23; FC16 and FC03 are used from now on",
            Broken::Closed => {
                "the drive has closed the connection; end other masters and tools that are connected to it"
            }
            _ => BROKE,
        }
    }

    /// Why the connection has to be given up, if it has.
    #[inline]
    pub(super) fn gives_up(&mut self, now: Time, slot: &mut Slot) -> Option<Why> {
        let silent = self.identity.is_open() && now.since(self.conn.requested_at) > 2 * self.reply_within_ns;
        let refused = self.conn.busy.is_some() || self.conn.refused != (0, 0);
        if self.connected && (silent || refused) { self.judge(now, silent, slot) } else { None }
    }

    #[cold]
    fn judge(&mut self, now: Time, silent: bool, slot: &mut Slot) -> Option<Why> {
        let within_ns = BUSY_WITHIN * self.reply_within_ns;
        let busy = self.conn.busy.is_some_and(|(since, _)| now.since(since) > within_ns);
        let why = match () {
            () if silent => SILENT,
            () if busy => "the drive is busy all the time",
            () if self.conn.refused.0.max(self.conn.refused.1) < MOST_REFUSALS => return None,
            () if self.functions.is_only() => {
                "the drive refuses its requests by FC23: use function = \"auto\" if it does not have it"
            }
            () => "the drive refuses its cyclic parameters",
        };
        Own::GivenUp.count(&mut slot.counters);
        self.disconnected();
        Some(why)
    }

    /// Starts or continues the orderly end: true once nothing more has to be sent to this drive.
    pub(super) fn shut_down(&mut self, cycle: &Cycle) -> bool {
        let armed =
            self.connected && self.conn.finding.watched && self.time_out().is_some() && self.profile.writes();
        let off = self.conn.inputs.control == Some(ControlWord::IDLE) && !self.conn.inputs.status.active();
        self.end = match self.end {
            // A drive that is still on keeps its watchdog.
            End::NotYet if !armed || self.profile.is_on() => End::Done,
            End::NotYet => End::Waiting(cycle.deadline + DISARM_WITHIN * self.reply_within_ns),
            End::Waiting(until) if off => End::Disarming(until),
            End::Waiting(until) | End::Disarming(until) if !self.connected || cycle.grid > until => End::Done,
            same => same,
        };
        self.end == End::Done
    }

    /// The index of the time-out among the settings.
    fn time_out(&self) -> Option<usize> {
        self.settings.iter().position(|setting| setting.purpose == Purpose::Watch)
    }

    /// The orderly end is complete: no more requests.
    pub(super) fn has_ended(&self) -> bool {
        self.end == End::Done
    }

    fn mapping(&self) -> &Mapping {
        used(&self.direct, &self.menu_0, self.conn.finding.menu_0)
    }
}

/// The blocks of the drive's requests: those of menu 0 where it shows them.
#[inline]
fn used<'a>(direct: &'a Mapping, menu_0: &'a Option<Mapping>, in_menu_0: bool) -> &'a Mapping {
    menu_0.as_ref().filter(|_| in_menu_0).unwrap_or(direct)
}

#[cfg(test)]
mod tests;
