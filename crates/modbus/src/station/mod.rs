//! The master's view of one Unidrive: one request after the other on its connection, and the result of each.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the station, and the life of its connection |
//! | `turns` | the blocks of its cyclic requests |
//! | `request` | the next request |
//! | `receive` | received bytes |
//! | `report` | the values of a reply: what they confirm, and the drive's report |

mod receive;
mod report;
mod request;
mod turns;

use std::mem::offset_of;
use std::sync::Arc;

use self::turns::{Cyclic, Turns};
use super::calls::{Calls, commanding};
use super::counters::Own;
use super::handshake::{BUSY_WITHIN, Finding, Found};
use super::identity::Identity;
use super::mapping::{Image, Mapping, Places};
use super::native::{Also, Native, NativePort, native};
use super::other::OtherMaster;
use super::pace::Pace;
use super::plan::UnidriveDrive;
use super::profile::{Inputs, Outputs, Profile, Proved};
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
const MOST_REFUSALS: u8 = 3;
/// A request that the drive was too busy for is no turn, so often in a row: what it never serves must not keep all
/// other parameters away.
const MOST_REPEATED: u8 = 3;

/// One drive as the master sees it. What each exchange touches is on as few lines of the cache as possible, a few of
/// them in each stage; what else there is fills the lines between them.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Station {
    /// The ids go on with the next connection.
    identity: Identity,
    /// The slot of the grid that the prepared request is for.
    grid: Time,
    connected: bool,
    /// An exchange was owed as the next request was prepared, or has left since: none is due.
    pub(super) passed: bool,
    end: End,
    /// Exchanges since the last call.
    since_call: u8,
    /// The control word sent last, on whatever connection.
    control_sent: Option<ControlWord>,
    conn: Connection,
    /// The end waits until then at the latest.
    end_by: Time,
    pace: Pace,
    reply_within_ns: u64,
    /// A window of this length is followed by so much time for a reply, in whole periods; at first it is longer
    /// than any.
    window_ns: u64,
    beyond_ns: u64,
    native: NativePort,
    profile: Profile,
    functions: ReadWrite,
    calls: Calls,
    /// The settings that make the drive follow the control word and watch it: written with the first command that
    /// needs them.
    settings: Box<[Setting]>,
    log: InputLog,
    /// The blocks at the parameters' own addresses or those of menu 0, as the drive shows them.
    turns: Turns,
    /// The request that was built last.
    room: [u8; ADU_MAX],
    also: Also,
    found: Arc<Found>,
    /// User units/s of one count of the speed feedback.
    velocity_per_count: f64,
    /// The monitored channels, and the counts in one unit of each.
    shown: Box<[(usize, f64)]>,
    inbox: [u8; ROOM],
    /// The blocks that the drive does not show.
    others: Option<Turns>,
    shows_menu_0: bool,
    /// It reports the numbers of its trips.
    reports_trips: bool,
    /// No time-out has to be set in the drive before it is enabled.
    unwatched: bool,
    opened_before: bool,
    /// The control word that the drive accepted last, or had at first, on whatever connection.
    control_taken: Option<ControlWord>,
}

/// The state that is reset with each connection: the drive's values are not known until they are read back, nor its
/// state until it reports again.
#[derive(Debug, Default)]
#[repr(C)]
struct Connection {
    /// Length of the prepared request, 0: there is none.
    length: u16,
    /// Length of the open one, and how much of it the wire has taken. The next one is built over it once all is
    /// taken.
    open: u16,
    gone: u16,
    /// Received bytes that are not a whole message yet.
    filled: u16,
    /// Exchanges that wrote; those that wrote only, in a row.
    writes: u32,
    written_in_a_row: u8,
    /// The last read was to check whether a value was accepted.
    confirmed: bool,
    /// The turn of the next block to read.
    turn: u16,
    /// The unit id of the open request.
    requested_unit: u8,
    /// Requests in a row that the drive was too busy for; writes, and reads, that were refused in a row.
    busy: u8,
    refused: (u8, u8),
    /// The number of missing settings, and whether they can be written.
    unset: u8,
    settable: bool,
    /// The trip number in the image is that of the present trip; without one, it was read since the last healthy
    /// status.
    trip_read: bool,
    /// The prepared request is the only one of the cycle that there is.
    is_only: bool,
    /// The open request, when it was sent, and the values that it writes; and the prepared one.
    requested: RequestKind,
    requested_at: Time,
    written: Outputs,
    prepared: RequestKind,
    inputs: Inputs,
    /// The revision of the profile that the last report has proved. Another one proves the same, if the drive reports
    /// the same status, and nothing was refused.
    proved: Option<Proved>,
    /// Which of status and speed were read since the last report.
    seen: Places,
    was_active: bool,
    /// The unit id of its answers, whether it follows control word and reference, and whether its time-out is set.
    unit: u8,
    obeys: bool,
    watched: bool,
    other: OtherMaster,
    /// Since when the drive has the control word that it has accepted.
    control_since: Time,
    /// The drive tripped at this instant.
    tripped_at: Option<Time>,
    /// When the power stage was last off although the drive was commanded to run.
    dark_at: Option<Time>,
    image: Image,
    /// Since when the drive is busy.
    busy_since: Time,
}

/// A line of the cache begins with each of these; and an odd number of lines lies between stations, so that not all are
/// in the same sets of it.
const _: () = {
    const LINE: usize = 64;
    assert!(offset_of!(Station, conn.requested).is_multiple_of(LINE));
    assert!(offset_of!(Station, conn.inputs).is_multiple_of(LINE));
    assert!(offset_of!(Station, conn.image).is_multiple_of(LINE));
    assert!(offset_of!(Station, pace).is_multiple_of(LINE));
    assert!(offset_of!(Station, calls).is_multiple_of(LINE));
    assert!(offset_of!(Station, turns.reads).is_multiple_of(LINE));
    assert!(offset_of!(Station, velocity_per_count).is_multiple_of(LINE));
    assert!(!(size_of::<Station>() / LINE).is_multiple_of(2));
};

impl NativeInputs for Station {
    fn put(&self, since: Time, out: &mut NativeBytes) -> Option<Time> {
        self.also.inputs(&self.native, since, out)
    }
}

/// The progress of the orderly end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    NotYet,
    /// The drive has to be seen off ...
    Waiting,
    /// ... then its time-out is disarmed.
    Disarming,
    Done,
}

/// Room for received bytes: a whole message, and those after it.
const ROOM: usize = 2 * ADU_MAX;

/// The purpose of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RequestKind {
    /// An acyclic call.
    Call,
    /// A setting, and its value: what is to be set, or 0 to disarm a time-out.
    Set { index: u8, value: i32 },
    /// Blocks to write and to read.
    Cyclic(Cyclic),
}

impl Default for RequestKind {
    fn default() -> RequestKind {
        RequestKind::Cyclic(Cyclic::default())
    }
}

/// Why a connection has to be given up.
pub type Why = &'static str;
/// The reasons for which the counters say more.
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
        let (direct, menu_0) = mappings;
        let station = Station {
            velocity_per_count: drive.velocity(drive.map.speed.value(1)),
            reports_trips: drive.map.trip.is_some(),
            shown: shown.filter_map(|(channel, mapped)| Some((channel, (*mapped)?.raw(1.0)))).collect(),
            turns: Turns::new(direct),
            others: menu_0.map(Turns::new),
            shows_menu_0: false,
            found,
            log: log.source(),
            functions: ReadWrite::new(drive.functions),
            unwatched: drive.watchdog.timeout_ns.is_none()
                && (drive.watchdog.keypad || drive.watchdog.accept_none),
            settings: if drive.set_up { settings(drive, None).into() } else { Box::default() },
            end: End::NotYet,
            end_by: Time(0),
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
            room: [0; ADU_MAX],
            inbox: [0; ROOM],
            since_call: 0,
            conn: Connection::default(),
            control_taken: None,
            control_sent: None,
        };
        (station, application, ends)
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.shown);
        self.native.memory(regions);
        self.also.memory(regions);
        self.calls.memory(regions);
        // In the same order, whichever the drive shows.
        let mut turns = [Some(&self.turns), self.others.as_ref()];
        if self.shows_menu_0 {
            turns.reverse();
        }
        turns.into_iter().flatten().for_each(|turns| turns.memory(regions));
    }

    /// A new connection is there, with its handshake complete.
    pub fn connected(&mut self, slot: &mut Slot) {
        self.connected = true;
        let finding = self.found.get(&self.log);
        let inputs = Inputs { seen: true, status: finding.status, ..Inputs::default() };
        if finding.menu_0 != self.shows_menu_0
            && let Some(others) = &mut self.others
        {
            std::mem::swap(&mut self.turns, others);
            self.shows_menu_0 = finding.menu_0;
        }
        // A setting that is right already is not written again.
        let is_met = |setting: &&Setting| match setting.purpose {
            Purpose::Obey => finding.obeys,
            Purpose::Watch => finding.watched,
            Purpose::Menu0 => true,
        };
        let unset = (self.settings.len() - self.settings.iter().take_while(is_met).count()) as u8;
        let settable = !self.settings.is_empty();
        let Finding { unit, obeys, watched, .. } = finding;
        self.conn = Connection { inputs, unset, settable, unit, obeys, watched, ..Connection::default() };
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
        self.profile.prove(&self.conn.inputs, None, &mut slot.evidence);
        slot.reachable = true;
        slot.counters.own[Own::SecondReplies as usize] += u64::from(finding.duplicates);
        slot.counters.own[Own::Exceptions as usize] += u64::from(finding.busy);
        if std::mem::replace(&mut self.opened_before, true) {
            Own::Reopened.count(&mut slot.counters);
        }
    }

    /// The profile gets to know what the drive is set to.
    fn tell_set_up(&mut self) {
        let Connection { watched, obeys, .. } = self.conn;
        self.profile.found(watched || self.unwatched, obeys, self.conn.settable);
        self.conn.proved = None;
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
        self.identity.is_open()
            && matches!(&self.conn.requested, RequestKind::Cyclic(cyclic) if cyclic.is_both())
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
        let refused = self.conn.busy > 0 || self.conn.refused != (0, 0);
        if self.connected && (silent || refused) { self.judge(now, silent, slot) } else { None }
    }

    #[cold]
    fn judge(&mut self, now: Time, silent: bool, slot: &mut Slot) -> Option<Why> {
        let within_ns = BUSY_WITHIN * self.reply_within_ns;
        let busy = self.conn.busy > 0 && now.since(self.conn.busy_since) > within_ns;
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
        let armed = self.connected && self.conn.watched && self.time_out().is_some() && self.profile.writes();
        let off = self.conn.inputs.control() == Some(ControlWord::IDLE) && !self.conn.inputs.status.active();
        self.end = match self.end {
            // A drive that is still on keeps its watchdog.
            End::NotYet if !armed || self.profile.is_on() => End::Done,
            End::NotYet => {
                self.end_by = cycle.deadline + DISARM_WITHIN * self.reply_within_ns;
                End::Waiting
            }
            End::Waiting if off => End::Disarming,
            End::Waiting | End::Disarming if !self.connected || cycle.grid > self.end_by => End::Done,
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
}

#[cfg(test)]
mod tests;
