//! The master's view of one drive: its process data, its last report, and its mailbox.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the station |
//! | `requests` | the station's own SDOs: mode, reference, monitored objects |
//!
//! It takes instants and slices, and knows no frame. What is desired of it becomes outputs in `profile`. The segment
//! reports the state of the slave, and whether inputs are of this exchange: an answer is never suspect.
//!
//! Where the setpoint is not a position, the actual position is reported as the demand: there is no demand
//! position.

pub mod requests;

use self::requests::Requests;
use super::counters::Own;
use super::faults::Clearing;
use super::native::{Native, native};
use super::object::commanding;
use super::plan::{KollmorgenDrive, Setpoint};
use super::profile::{Inputs, Profile, reports_position};
use super::service::Service;
use super::wire::mailbox::Emergency;
use super::wire::registers::AlState;
use fieldbeat_core::axis::acyclic::{self, AcyclicEnds};
use fieldbeat_core::axis::units::Unwrap;
use fieldbeat_core::axis::{self, State, Units};
use fieldbeat_core::bus::cia402::StatusWord;
use fieldbeat_core::bus::desired::{Homing, Reference};
use fieldbeat_core::bus::{Exchange, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, Time};

/// The emergency with the number of a fault comes within this time, ns, or its number stays unknown: then it is
/// this one, any error (CAN manual).
const NAMED_WITHIN_NS: u64 = 100 * MS;
const NAMED_TURNS: u64 = 6;
const ANY_ERROR: u16 = 0x1000;

/// What was read of a drive since it was switched on.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
struct Seen {
    /// The last position, and its slot of the grid; 0: there is none.
    last: i64,
    last_grid: Time,
    inputs: Inputs,
    actual: Unwrap,
    demand: Unwrap,
}

/// The same of its faults.
#[derive(Clone, Copy, Debug, Default)]
struct Faults {
    /// The newest emergency that is no warning; code 0: none.
    emergency: Emergency,
    emergency_at: Time,
    faulted_at: Option<Time>,
    warning: u16,
}

/// One drive as the master sees it.
#[derive(Debug)]
#[repr(C, align(64))] // What every exchange touches lies together: in `profile`, and behind it up to `units`.
pub struct Station {
    faults: Faults,
    pub(super) requests: Requests,
    /// Its mailbox.
    pub service: Service,
    /// What is desired as process data, and what the inputs prove.
    pub profile: Profile,
    pub(super) sent_grid: Time,
    /// Since the last report nothing has changed that could show in the next one, if its status is the same: only
    /// the values of its process data count then. That holds for exchanges before this slot; 0: for none.
    steady_until: Time,
    /// It reports its position.
    reports_position: bool,
    /// The setpoints of the outputs are its demand, and reach it.
    led: bool,
    /// The outputs of the last exchange reach the drive.
    reached: bool,
    /// What was read of it.
    seen: Seen,
    /// User units per count; user units/s of one count in a usual interval.
    unit_per_count: f64,
    rate: f64,
    interval_ns: u64,
    standstill: f64,
    /// A per per mille; user units/s per count of 606Ch.
    current_per_permille: f64,
    units: Units,
    velocity_per_count: f64,
    /// A faster motion while it homes is not a valid velocity.
    most_velocity: f64,
    /// Its setpoint is a position, and it reports its own.
    has_place: bool,
    /// The slave's state; `None`: below SAFEOP, or not there.
    al: Option<AlState>,
    named_within_ns: u64,
    /// It was found power-cycled, and that was not reported yet.
    was_restarted: bool,
    /// The application writes a parameter that may command the drive.
    commanded: bool,
}

impl Station {
    /// The station of `drive` for an exchange every `interval_ns`, whose mailbox has the slot again within `turn_ns`,
    /// and the application's ends of its native process
    /// data and of its acyclic access.
    pub fn new(
        drive: &KollmorgenDrive,
        interval_ns: u64,
        turn_ns: u64,
        log: &InputLog,
    ) -> (Station, Native, AcyclicEnds) {
        let (application, native) = native(&drive.outputs, &drive.inputs);
        let outputs = drive.outputs.entries.iter().map(|entry| entry.object);
        let (ends, port) = acyclic::queue(drive.axis.parameter_queue, commanding(outputs));
        let (native, port) = (native.logged(log), port.logged(log));
        let units = drive.axis.units;
        let unit_per_count = 1.0 / units.counts_per_unit;
        let per_minute = drive.scaling.increments() / 60.0 * unit_per_count;
        let profile = Profile::new(drive, native);
        let station = Station {
            units,
            unit_per_count,
            velocity_per_count: drive.scaling.rpm_per_count * per_minute,
            current_per_permille: drive.scaling.rated_current.map_or(f64::NAN, |rated| rated * 1e-3),
            standstill: drive.axis.stop.standstill,
            most_velocity: 2.0
                * drive.axis.limits.velocity.unwrap_or_default().max(drive.axis.profile.velocity),
            rate: unit_per_count * 1e9 / interval_ns.max(1) as f64,
            interval_ns,
            reports_position: reports_position(drive),
            has_place: matches!(drive.setpoint(), Some(Setpoint::Position(_))) && reports_position(drive),
            profile,
            seen: Seen::default(),
            faults: Faults::default(),
            requests: Requests::new(drive),
            service: Service::new(&drive.slave, port, turn_ns),
            al: None,
            sent_grid: Time(0),
            led: false,
            reached: false,
            named_within_ns: NAMED_WITHIN_NS.max(NAMED_TURNS * turn_ns),
            was_restarted: false,
            commanded: false,
            steady_until: Time(0),
        };
        (station, application, ends)
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.profile.memory(regions);
        self.service.memory(regions);
    }

    /// What changed is taken into account with the next report.
    pub fn unsettle(&mut self) {
        self.steady_until = Time(0);
    }

    /// Writes the outputs of the exchange in slot `grid`.
    #[inline]
    pub fn encode(&mut self, grid: Time, slot: &Slot, outputs: &mut [u8]) {
        let Seen { last, inputs, .. } = &self.seen;
        let actual = || (*last as i32, inputs.operational && inputs.state == State::OperationEnabled);
        self.profile.encode(grid, &slot.desired, actual, outputs);
    }

    /// The slave has entered this state; `None`: below SAFEOP, or not on the segment.
    pub fn operational(&mut self, al: Option<AlState>, slot: &mut Slot) {
        self.unsettle();
        let before = std::mem::replace(&mut self.al, al);
        if before == al {
            return;
        }
        if before.is_none() {
            self.requests.forget();
        }
        if before == Some(AlState::Op) {
            self.leave_operation();
        }
        if al == Some(AlState::Op) {
            slot.reachable = true;
        }
    }

    fn leave_operation(&mut self) {
        self.unsettle();
        (self.seen.inputs.operational, self.led) = (false, false);
        self.profile.dropped();
    }

    /// The drive was found power-cycled. It is reported with its next report.
    pub fn restarted(&mut self) {
        self.unsettle();
        self.was_restarted = true;
        self.profile.drive_restarted();
        self.requests.forget();
        (self.seen, self.faults) = (Seen::default(), Faults::default());
    }

    /// The frame with the prepared outputs went out.
    #[inline(always)] // As `take`.
    pub fn sent(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        self.owe(sent_at, reply_by, slot);
        let is_new = self.profile.sent();
        slot.gone.grid = Some(self.profile.grid);
        if is_new || self.profile.grid >= self.steady_until {
            self.unsettle();
            self.reached = true;
            self.request();
            self.profile.sent_anew();
        }
    }

    /// A frame was sent that only reads this drive: its outputs do not count there yet.
    pub fn open(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        self.unsettle();
        self.owe(sent_at, reply_by, slot);
        self.reached = false;
        self.request();
    }

    #[inline]
    fn owe(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        slot.counters.sent += 1;
        slot.exchange = Exchange::Owed { sent_at, reply_by, awaited: false };
        self.sent_grid = self.profile.grid;
    }

    /// Its own SDOs advance once an exchange was sent: their results hold for all builds of the next one.
    #[inline(never)]
    fn request(&mut self) {
        if self.al.is_none() {
            return;
        }
        // After a parameter that may command the drive its mode is read again.
        let commanded = self.service.commands();
        if std::mem::replace(&mut self.commanded, commanded) && !commanded {
            self.requests.doubt_mode();
        }
        if !self.requests.advance(self.profile.grid, self.profile.mode_wanted(), &mut self.service) {
            return;
        }
        if let Some(mode) = self.requests.carried {
            self.profile.carry_mode(mode);
        }
        if std::mem::take(&mut self.requests.refused) {
            self.profile.mode_refused();
        }
    }

    /// It could not be handed to the wire, or the slave is not part of the exchange.
    pub fn unsent(&mut self, slot: &mut Slot) {
        slot.counters.unsent += 1;
        slot.exchange = Exchange::Unsent;
    }

    /// The inputs that answer the open exchange, of a slave in this state.
    #[inline(always)] // Of each drive and cycle: a call would cost a sixth of it.
    pub fn take(&mut self, at: Time, inputs: &[u8], al: AlState, slot: &mut Slot) {
        let Exchange::Owed { sent_at, .. } = slot.exchange else { return };
        let is_same = self.profile.offsets.status(inputs) == Some(self.seen.inputs.status.0);
        if !is_same || self.steady_until == Time(0) || al != AlState::Op || slot.anew {
            return self.take_anew(at, inputs, al, slot);
        }
        slot.exchange = Exchange::Answered { sent_at, at, suspect: false };
        slot.counters.answered += 1;
        self.profile.answered();
        self.take_values(inputs);
        self.profile.prove_values(&self.seen.inputs, &mut slot.evidence);
        self.report_values(at, inputs, slot);
        self.profile.publish(at, inputs);
    }

    /// The same where more may have changed than the values.
    #[inline(never)]
    fn take_anew(&mut self, at: Time, inputs: &[u8], al: AlState, slot: &mut Slot) {
        let Exchange::Owed { sent_at, .. } = slot.exchange else { return };
        let status = self.profile.offsets.status(inputs);
        if status == Some(0) && inputs.iter().all(|byte| *byte == 0) {
            // As the master has sent them: the slave has counted for its AL status alone.
            Own::PassedBy.count(&mut slot.counters);
            slot.exchange = Exchange::Absent { sent_at };
            return;
        }
        slot.exchange = Exchange::Answered { sent_at, at, suspect: false };
        slot.counters.answered += 1;
        let operational = al == AlState::Op;
        if operational {
            self.profile.answered();
        } else {
            Own::NotOperational.count(&mut slot.counters);
            if self.seen.inputs.operational {
                self.leave_operation();
            }
        }
        self.led = operational && self.reached && self.profile.writes();
        self.seen.inputs.operational = operational;
        self.profile.publish(at, inputs);
        self.unsettle();
        if let Some(status) = status {
            self.read(at, StatusWord(status), inputs, slot);
            let is_steady = self.reached
                && operational
                && !self.commanded
                && (self.faults.emergency.code, self.faults.faulted_at) == (0, None)
                && self.requests.are_idle(self.profile.mode_wanted())
                && self.profile.is_steady(&self.seen.inputs);
            if is_steady {
                self.steady_until = self.requests.next_show;
            }
        }
    }

    /// Its mailbox was read: takes the next emergency, if the previous one was reported. A warning, a fault, or the
    /// end of one.
    pub fn mailbox_received(&mut self, slot: &mut Slot) {
        if slot.notices.has_emergency() {
            return;
        }
        let Some(emergency) = self.service.take_emergency() else { return };
        match Clearing::of(&emergency) {
            Some(Clearing::Warning) => self.faults.warning = emergency.code,
            _ => (self.faults.emergency, self.faults.emergency_at) = (emergency, self.profile.grid),
        }
        self.unsettle();
        slot.notices.report(axis::Emergency { code: emergency.code, register: emergency.register });
    }

    /// The drive's report, in user units.
    fn read(&mut self, at: Time, status: StatusWord, received: &[u8], slot: &mut Slot) {
        let before = self.seen.inputs.status;
        (self.seen.inputs.state, self.seen.inputs.status) = (status.state(), status);
        let homing = self.profile.is_homing();
        if homing {
            // The positions have a new origin.
            self.seen.actual.reset();
            self.seen.demand.reset();
            if self.profile.is_finding_home() {
                self.requests.request_reference();
            }
        }
        let velocity = self.seen.inputs.velocity;
        self.take_values(received);
        if homing && self.profile.offsets.velocity(received).is_none() {
            let attained = status.0 & !before.0 & StatusWord::MODE_12 != 0;
            if attained || self.seen.inputs.velocity.abs() > self.most_velocity {
                // That was no motion.
                self.seen.inputs.velocity = velocity;
            }
        }
        self.take_fault(at, received);
        let Slot { status: report, notices, evidence, .. } = slot;
        report.suspect = false;
        notices.restarted |= std::mem::take(&mut self.was_restarted);
        report.state = match self.seen.inputs.state {
            // Below OP it follows no setpoint.
            State::OperationEnabled | State::QuickStopActive if !self.seen.inputs.operational => {
                State::SwitchedOn
            }
            state => state,
        };
        self.seen.inputs.is_powered = report.state.is_powered();
        let inputs = &self.seen.inputs;
        self.profile.look(inputs);
        self.profile.prove(inputs, self.requests.mode(), evidence);
        if let Some(homing) = self.profile.homing_sent(evidence.homing) {
            self.requests.attained = homing == Homing::Attained;
        }
        evidence.reference = self.requests.reference;
        // Its own mode may have come back with this report.
        let homing = self.profile.is_homing();
        report.sto_open = !inputs.is_powered && self.profile.is_sto_open();
        report.homed = !homing && self.requests.reference == Some(Reference::Set);
        report.warning =
            if status.has(StatusWord::WARNING) { u32::from(self.faults.warning.max(1)) } else { 0 };
        report.fault = u32::from(inputs.fault);
        if let Some(shown) = self.requests.take_shown() {
            (report.monitor, notices.monitor_fresh) = (*shown, true);
            if let Some((channel, status)) = self.requests.refusal.take() {
                notices.refuse_monitor(channel, status);
            }
        }
        self.led &= self.has_place && !homing && !self.profile.is_native();
        self.report_values(at, received, slot);
    }

    /// The actual position, not folded, and the velocity.
    #[inline(always)] // As `report_values`.
    fn take_values(&mut self, inputs: &[u8]) {
        let velocity = self.profile.offsets.velocity(inputs);
        if let Some(raw) = self.profile.offsets.position(inputs) {
            let count = self.seen.actual.next(raw);
            if velocity.is_none() {
                self.differ(count);
            }
            (self.seen.last, self.seen.last_grid) = (count, self.sent_grid);
            self.seen.inputs.position = count as f64 * self.unit_per_count + self.units.offset;
        }
        if let Some(velocity) = velocity {
            self.seen.inputs.velocity = f64::from(velocity) * self.velocity_per_count;
        }
    }

    /// What changes from report to report.
    #[inline(always)] // It has two callers, and is most of what the usual one does.
    fn report_values(&mut self, at: Time, received: &[u8], slot: &mut Slot) {
        let Slot { status: report, notices, evidence, .. } = slot;
        let (inputs, units) = (&self.seen.inputs, &self.units);
        notices.fresh = true;
        report.at = at;
        let is_led_on = self.profile.is_moving();
        report.moving = inputs.is_powered && (is_led_on || inputs.velocity.abs() > self.standstill);
        report.in_target = inputs.status.has(StatusWord::TARGET_REACHED) && !(self.led && is_led_on);
        report.position = if self.reports_position { units.folded(inputs.position) } else { f64::NAN };
        (report.demand, evidence.demand) = (report.position, inputs.position);
        if self.led {
            let count = self.seen.demand.next(self.profile.setpoint_sent());
            evidence.demand = count as f64 * self.unit_per_count + units.offset;
            report.demand = units.folded(evidence.demand);
        }
        report.velocity = inputs.velocity;
        let torque = self.profile.offsets.torque(received);
        report.current = torque.map_or(f64::NAN, |torque| f64::from(torque) * self.current_per_permille);
    }

    /// The velocity of a drive that reports none: the distance since the last exchange.
    #[inline]
    fn differ(&mut self, count: i64) {
        let passed_ns = self.sent_grid.since(self.seen.last_grid);
        let way = (count - self.seen.last) as f64;
        if passed_ns == self.interval_ns {
            self.seen.inputs.velocity = way * self.rate;
        } else if self.seen.last_grid == Time(0) {
            self.seen.inputs.velocity = 0.0;
        } else if passed_ns > 0 {
            self.seen.inputs.velocity = way * self.unit_per_count * 1e9 / passed_ns as f64;
        }
    }

    /// Takes what is known of the fault in the status.
    #[inline]
    fn take_fault(&mut self, at: Time, received: &[u8]) {
        let inputs = &mut self.seen.inputs;
        if !matches!(inputs.state, State::Fault | State::FaultReactionActive) {
            // An emergency that no fault has followed by then names no later one.
            let is_over =
                self.faults.emergency.code != 0 && at.since(self.faults.emergency_at) > self.named_within_ns;
            if self.faults.faulted_at.take().is_some() || is_over {
                self.faults.emergency = Emergency::default();
            }
            (inputs.fault, inputs.named, inputs.cold) = (0, false, false);
            return;
        }
        let since = *self.faults.faulted_at.get_or_insert(at);
        let reported = self
            .profile
            .offsets
            .fault(received)
            .filter(|code| *code != 0)
            .unwrap_or(self.faults.emergency.code);
        let waited = at.since(since) > self.named_within_ns;
        inputs.fault = if reported == 0 && waited { ANY_ERROR } else { reported };
        inputs.named = inputs.fault != 0;
        let clearing = Clearing::of(&self.faults.emergency);
        inputs.cold = matches!(clearing, Some(Clearing::ColdStart | Clearing::Never));
    }
}
