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
use super::native::{Native, NativePort, native};
use super::object::commanding;
use super::plan::{KollmorgenDrive, Setpoint};
use super::profile::{Inputs, Profile};
use super::service::Service;
use super::wire::mailbox::Emergency;
use super::wire::registers::AlState;
use fieldbeat_core::axis::acyclic::{self, AcyclicEnds};
use fieldbeat_core::axis::units::Unwrap;
use fieldbeat_core::axis::{self, State};
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

/// The faults of a drive that were read since it was switched on.
#[derive(Clone, Copy, Debug, Default)]
struct Faults {
    /// The newest emergency that is no warning; code 0: none.
    emergency: Emergency,
    emergency_at: Time,
    faulted_at: Option<Time>,
    warning: u16,
}

/// One drive as the master sees it.
///
/// An exchange touches four cache lines: two of `profile`, the one of the last report behind it, and the
/// one of what values are made with, which the front of `native` shares.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Station {
    faults: Faults,
    pub(super) requests: Requests,
    /// The mailbox.
    pub service: Service,
    named_within_ns: u64,
    /// A faster motion while it homes is not a valid velocity.
    most_velocity: f64,
    /// The setpoint is a position, and it reports its own.
    has_place: bool,
    /// The slave's state; `None`: below SAFEOP, or not there.
    al: Option<AlState>,
    /// It was found power-cycled, and that was not reported yet.
    was_restarted: bool,
    /// The application writes a parameter that may command the drive.
    commanded: bool,
    demand: Unwrap,
    /// The desired state as process data, and the evidence of the inputs.
    pub profile: Profile,
    pub(super) sent_grid: Time,
    /// Since the last report nothing has changed that could show in the next one, if its status is the same: only
    /// the values of its process data count then. That holds for exchanges before this slot; 0: for none.
    steady_until: Time,
    /// The last position, and its slot of the grid; 0: there is none since the drive was switched on.
    last: i64,
    last_grid: Time,
    /// The inputs that were read last.
    inputs: Inputs,
    /// User units per count.
    unit_per_count: f64,
    /// User units/s per count of 606Ch; of a drive that does not report it, of one count of position in a usual
    /// interval.
    rate: f64,
    interval_ns: u64,
    /// One turn of a rotary axis in user units; 0: it is none.
    turn: f64,
    standstill: f64,
    /// A per per mille.
    current_per_permille: f64,
    pub(super) native: NativePort,
}

impl Station {
    /// The station of `drive` for an exchange every `interval_ns`, whose mailbox has the slot again within `turn_ns`,
    /// and the application's ends of its native process data and of its acyclic access.
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
        let profile = Profile::new(drive);
        let rate = match profile.offsets.reports_velocity() {
            true => drive.scaling.rpm_per_count * per_minute,
            false => unit_per_count * 1e9 / interval_ns.max(1) as f64,
        };
        let station = Station {
            unit_per_count,
            rate,
            interval_ns,
            turn: units.modulo.unwrap_or_default(),
            current_per_permille: drive.scaling.rated_current.map_or(f64::NAN, |rated| rated * 1e-3),
            standstill: drive.axis.stop.standstill,
            most_velocity: 2.0
                * drive.axis.limits.velocity.unwrap_or_default().max(drive.axis.profile.velocity),
            has_place: matches!(drive.setpoint(), Some(Setpoint::Position(_)))
                && profile.offsets.reports_position,
            profile,
            native,
            last: 0,
            last_grid: Time(0),
            inputs: Inputs::default(),
            demand: Unwrap::default(),
            faults: Faults::default(),
            requests: Requests::new(drive),
            service: Service::new(&drive.slave, port, turn_ns),
            al: None,
            sent_grid: Time(0),
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
        self.native.memory(regions);
        self.service.memory(regions);
    }

    /// Lets the next report take changes into account.
    pub fn unsettle(&mut self) {
        self.steady_until = Time(0);
    }

    /// Writes the outputs of the exchange in slot `grid`.
    #[inline]
    pub fn encode(&mut self, grid: Time, slot: &Slot, outputs: &mut [u8]) {
        let Station { last, inputs, profile, native, .. } = self;
        let actual = || (*last as i32, inputs.operational && inputs.state == State::OperationEnabled);
        profile.encode(grid, &slot.desired, actual, native, outputs);
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
        (self.inputs.operational, self.profile.sent.led) = (false, false);
        self.profile.dropped();
    }

    /// The drive was found power-cycled. It is reported with its next report.
    pub fn restarted(&mut self) {
        self.unsettle();
        self.was_restarted = true;
        self.profile.drive_restarted();
        self.requests.forget();
        (self.last, self.last_grid, self.inputs) = (0, Time(0), Inputs::default());
        (self.demand, self.faults) = (Unwrap::default(), Faults::default());
    }

    /// The frame with the prepared outputs went out.
    #[inline(always)] // As `take`.
    pub fn sent(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        self.owe(sent_at, reply_by, slot);
        let is_new = self.profile.sent(&mut self.native);
        slot.gone.grid = Some(self.profile.grid);
        if is_new || self.profile.grid >= self.steady_until {
            self.unsettle();
            self.profile.sent.reached = true;
            self.request();
            self.profile.sent_anew();
        }
    }

    /// A frame was sent that only reads this drive: its outputs do not count there yet.
    pub fn open(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        self.unsettle();
        self.owe(sent_at, reply_by, slot);
        self.profile.sent.reached = false;
        self.request();
    }

    #[inline]
    fn owe(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        slot.counters.sent += 1;
        slot.exchange = Exchange::Owed { sent_at, reply_by, awaited: false };
        self.sent_grid = self.profile.grid;
    }

    /// The own SDOs advance once an exchange was sent: their results hold for all builds of the next one.
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
        let is_same = self.profile.offsets.status(inputs) == Some(self.inputs.status.0);
        if !is_same || self.steady_until == Time(0) || al != AlState::Op || slot.anew {
            return self.take_anew(at, inputs, al, slot);
        }
        slot.exchange = Exchange::Answered { sent_at, at, suspect: false };
        slot.counters.answered += 1;
        self.profile.answered();
        self.take_values(inputs, false);
        self.profile.prove_values(&self.inputs, &mut slot.evidence);
        self.report_values(at, inputs, slot);
        self.publish(at, inputs);
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
            if self.inputs.operational {
                self.leave_operation();
            }
        }
        self.profile.sent.led = operational && self.profile.sent.reached && self.profile.writes();
        self.inputs.operational = operational;
        self.publish(at, inputs);
        self.unsettle();
        if let Some(status) = status {
            self.read(at, StatusWord(status), inputs, slot);
            let is_steady = self.profile.sent.reached
                && operational
                && !self.commanded
                && (self.faults.emergency.code, self.faults.faulted_at) == (0, None)
                && self.requests.are_idle(self.profile.mode_wanted())
                && self.profile.is_steady(&self.inputs);
            if is_steady {
                self.steady_until = self.requests.next_show;
            }
        }
    }

    /// The mailbox was read: takes the next emergency, if the previous one was reported. A warning, a fault, or the
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
        let before = self.inputs.status;
        (self.inputs.state, self.inputs.status) = (status.state(), status);
        let homing = self.profile.is_homing();
        if homing {
            // The positions have a new origin.
            self.demand.reset();
            if self.profile.is_finding_home() {
                self.requests.request_reference();
            }
        }
        let velocity = self.inputs.velocity;
        self.take_values(received, homing || self.last_grid == Time(0));
        if homing && self.profile.offsets.velocity(received).is_none() {
            let attained = status.0 & !before.0 & StatusWord::MODE_12 != 0;
            if attained || self.inputs.velocity.abs() > self.most_velocity {
                // That was no motion.
                self.inputs.velocity = velocity;
            }
        }
        self.take_fault(at, received);
        let Slot { status: report, notices, evidence, .. } = slot;
        report.suspect = false;
        notices.restarted |= std::mem::take(&mut self.was_restarted);
        report.state = match self.inputs.state {
            // Below OP it follows no setpoint.
            State::OperationEnabled | State::QuickStopActive if !self.inputs.operational => State::SwitchedOn,
            state => state,
        };
        self.inputs.is_powered = report.state.is_powered();
        let inputs = &self.inputs;
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
        self.profile.sent.led &= self.has_place && !homing && !self.profile.is_native();
        self.report_values(at, received, slot);
    }

    /// The actual position, not folded, and the velocity. `begins`: the positions before have another origin, or there
    /// are none.
    #[inline(always)] // As `report_values`.
    fn take_values(&mut self, inputs: &[u8], begins: bool) {
        let velocity = self.profile.offsets.velocity(inputs);
        if let Some(velocity) = velocity {
            self.inputs.velocity = f64::from(velocity) * self.rate;
        }
        if let Some(raw) = self.profile.offsets.position(inputs) {
            // The one that is congruent and nearest to the last one.
            let count = match begins {
                true => i64::from(raw),
                false => self.last + i64::from(raw.wrapping_sub(self.last as i32)),
            };
            if velocity.is_none() {
                self.differ(count);
            }
            (self.last, self.last_grid) = (count, self.sent_grid);
            self.inputs.position = count as f64 * self.unit_per_count + self.profile.origin;
        }
    }

    /// Takes the values that change from report to report.
    #[inline(always)] // It has two callers, and is most of what the usual one does.
    fn report_values(&mut self, at: Time, received: &[u8], slot: &mut Slot) {
        let Slot { status: report, notices, evidence, .. } = slot;
        let inputs = &self.inputs;
        notices.fresh = true;
        report.at = at;
        let is_led_on = self.profile.is_moving();
        report.moving = inputs.is_powered && (is_led_on || inputs.velocity.abs() > self.standstill);
        report.in_target =
            inputs.status.has(StatusWord::TARGET_REACHED) && !(self.profile.sent.led && is_led_on);
        report.position =
            if self.profile.offsets.reports_position { self.folded(inputs.position) } else { f64::NAN };
        (report.demand, evidence.demand) = (report.position, inputs.position);
        if self.profile.sent.led {
            let count = self.demand.next(self.profile.setpoint_sent());
            evidence.demand = count as f64 * self.unit_per_count + self.profile.origin;
            report.demand = self.folded(evidence.demand);
        }
        report.velocity = inputs.velocity;
        let torque = self.profile.offsets.torque(received);
        report.current = torque.map_or(f64::NAN, |torque| f64::from(torque) * self.current_per_permille);
    }

    /// A position on a rotary axis within one turn.
    #[inline]
    fn folded(&self, position: f64) -> f64 {
        if self.turn == 0.0 { position } else { position.rem_euclid(self.turn) }
    }

    /// Publishes the inputs to the application.
    #[inline(never)] // Inlined, it costs more: `take` needs its registers.
    fn publish(&mut self, at: Time, inputs: &[u8]) {
        match inputs.try_into() {
            // Those of most drives.
            Ok(inputs) => self.native.publish_array::<8>(at, 0, inputs),
            Err(_) => self.native.publish(at, 0, inputs),
        }
    }

    /// The velocity of a drive that reports none: the distance since the last exchange.
    #[inline]
    fn differ(&mut self, count: i64) {
        let passed_ns = self.sent_grid.since(self.last_grid);
        let way = (count - self.last) as f64;
        if passed_ns == self.interval_ns {
            self.inputs.velocity = way * self.rate;
        } else if self.last_grid == Time(0) {
            self.inputs.velocity = 0.0;
        } else if passed_ns > 0 {
            self.inputs.velocity = way * self.unit_per_count * 1e9 / passed_ns as f64;
        }
    }

    /// Takes what is known of the fault in the status.
    #[inline]
    fn take_fault(&mut self, at: Time, received: &[u8]) {
        let inputs = &mut self.inputs;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_touches_two_cache_lines_behind_those_of_the_profile() {
        use std::mem::offset_of;
        let begin = offset_of!(Station, sent_grid);
        assert_eq!((begin % 64, offset_of!(Station, profile) + size_of::<Profile>()), (0, begin));
        assert_eq!(
            (offset_of!(Station, unit_per_count), offset_of!(Station, native)),
            (begin + 64, begin + 112)
        );
    }
}
