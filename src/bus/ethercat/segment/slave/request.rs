//! The request of each step.

use super::{Change, Context, FMMUS_AT_ONCE, MANAGERS_AT_ONCE, Mapped, Note, Slave, Step};
use crate::bus::ethercat::plan::Owner;
use crate::bus::ethercat::slot::Ask;
use crate::bus::ethercat::wire::frame::Command;
use crate::bus::ethercat::wire::registers::{AlState, AlStatus, Fmmu, SyncManager, address};
use crate::bus::ethercat::wire::sii;
use crate::time::{S, Time};

use super::setup::WATCHDOG_DIVIDER;
use super::sync::sync_ahead_ns;

/// Bytes from its type to its station address.
pub(super) const LOOK: usize = 0x12;
/// AL status and its code.
pub(super) const AL_LOOK: usize = 6;
/// The time limit of a change of state; and of the last one, after which the drive synchronises.
const STATE_NS: u64 = 3 * S;
const OP_NS: u64 = 10 * S;
/// A drive for which OP is requested before it has seen regular cycles for a while goes into a fault (F28); how
/// many it needs is assumed.
const SYNCHRONISE_CYCLES: u64 = 200;
/// The filters of a clock at its start (SOEM, TwinCAT).
const SPEED_START: u16 = 0x1000;
const FILTER_DEPTHS: u16 = 0x0C00;
/// AssignActivate of the drive's description: the cyclic unit is the master's, SYNC0 is on.
const SYNC0_ON: [u8; 2] = [0x00, 0x03];
/// The bit of the event request that a change of state sets.
const EVENT_MASK: u16 = 0x0004;

impl Slave {
    /// Writes its request for the next frame, if it has one.
    pub fn request(&mut self, context: &Context<'_>, ask: &mut Ask) {
        let now = context.cycle.grid;
        if self.ending && !matches!(self.step, Step::State(Change { to: AlState::Init, .. })) {
            return;
        }
        match self.step {
            Step::Rest(until) => {
                if now >= until {
                    self.enter(now, Step::Look);
                    self.request(context, ask);
                }
            }
            Step::Look => {
                ask.read(self.reads(address::AL_STATUS), AL_LOOK);
                ask.read(self.reads(address::TYPE), LOOK);
            }
            Step::FoundClock => self.request_running(ask),
            Step::SiiOwner => {
                ask.write(self.writes(address::SII_OWNER), &[sii::FORCE]);
                ask.write(self.writes(address::SII_OWNER), &[sii::MASTER]);
            }
            Step::Sii(reader) => {
                reader.request(|register| self.reads(register), |register| self.writes(register), ask);
            }
            Step::Found => self.request_found(ask),
            Step::FoundFmmus => self.request_found_fmmus(ask),
            Step::Join => self.request_join(ask),
            Step::Ports => {
                // Each loop by itself; no alias; the event of AL control only.
                ask.write(self.writes(address::PORT_LOOPS), &[0; 3]);
                ask.write(self.writes(address::EVENT_MASK), &EVENT_MASK.to_le_bytes());
            }
            Step::Clear(done) => self.request_clear(done, ask),
            Step::Address { .. } => {
                // Whoever has it from another master, or from another position, loses it.
                ask.write(Command::Fpwr(self.station(), address::STATION), &[0; 2]);
                ask.write(self.writes(address::STATION), &self.station().to_le_bytes());
            }
            Step::AddressCheck { .. } => {
                ask.read(Command::Fprd(self.station(), address::STATION), 2);
            }
            Step::Mailbox => {
                for (number, manager) in self.mailbox_managers() {
                    ask.write(self.writes(address::sync_manager(number)), &manager.to_bytes());
                }
            }
            Step::Objects { .. } => {}
            Step::Watchdog => {
                ask.write(self.writes(address::WATCHDOG_DIVIDER), &WATCHDOG_DIVIDER.to_le_bytes());
                ask.write(self.writes(address::WATCHDOG), &self.watchdog().to_le_bytes());
            }
            Step::WatchdogCheck => {
                ask.read(self.reads(address::WATCHDOG_DIVIDER), 2);
                ask.read(self.reads(address::WATCHDOG), 2);
            }
            Step::SyncManagers => {
                for (number, manager) in self.managers() {
                    ask.write(self.writes(address::sync_manager(number)), &manager.to_bytes());
                }
            }
            Step::SyncManagersCheck => {
                for (number, _) in self.managers() {
                    ask.read(self.reads(address::sync_manager(number)), SyncManager::SIZE);
                }
            }
            Step::Fmmus | Step::Release => {
                let (fmmus, length) = self.fmmus();
                ask.write(self.writes(address::FMMU), &fmmus[..length]);
            }
            Step::Lock => self.request_lock(context, ask),
            Step::State(change) => self.request_state(now, change, ask),
            Step::Up => {
                let next = self.way.joined && self.go_on_joined(context);
                if !next && !self.has_al && now.since(self.since) >= super::LOOK_EVERY_NS {
                    // The image does not show its state.
                    self.enter(now, Step::Code);
                }
                if !matches!(self.step, Step::Up) {
                    self.request(context, ask);
                }
            }
            Step::Code => {
                ask.read(self.reads(address::AL_STATUS), AL_LOOK);
            }
            _ => self.request_clock(context, ask),
        }
    }

    /// The steps of its clock.
    fn request_clock(&mut self, context: &Context<'_>, ask: &mut Ask) {
        let (register, length) = Slave::TIMES;
        match self.step {
            Step::Latch => {
                let is_there = context.timed || self.is_reference(context) && context.may_begin;
                if !context.timing_taken && is_there {
                    ask.write(Command::Bwr(address::DC_PORTS), &[0; 4]);
                }
                self.note = match context.other_time {
                    _ if !ask.is_empty() => Note::Starting,
                    Some(place) => Note::OtherTime(place),
                    None => Note::WaitsForClock,
                };
            }
            Step::ReferenceTimes { .. } => {
                let reference = context.reference.unwrap_or_else(|| self.station());
                ask.read(Command::Fprd(reference, register), length);
                ask.read(Command::Fprd(reference, address::LINKS), 2);
            }
            Step::OwnTimes { .. } => {
                ask.read(self.reads(register), length);
                ask.read(self.reads(address::LINKS), 2);
            }
            Step::Offset { offset, delay_ns } => {
                ask.write(self.writes(address::DC_OFFSET), &offset.to_le_bytes());
                ask.write(self.writes(address::DC_DELAY), &delay_ns.to_le_bytes());
            }
            Step::Filter => {
                ask.write(self.writes(address::DC_FILTER), &FILTER_DEPTHS.to_le_bytes());
                ask.write(self.writes(address::DC_SPEED), &SPEED_START.to_le_bytes());
            }
            Step::Settle { next, .. } if context.cycle.grid >= next => {
                ask.read(self.reads(address::DC_DIFFERENCE), 4);
            }
            Step::SegmentTime => {
                // Its start must not be written while it is imminent.
                ask.write(self.writes(address::DC_ACTIVATION), &[0]);
                ask.read(self.reads(address::DC_TIME), 8);
            }
            Step::SyncStart { ahead_ns, segment_ns } => {
                let start = self.sync_start(ahead_ns, segment_ns);
                ask.write(self.writes(address::DC_START), &start.to_le_bytes());
                // SYNC1 stays off: its cycle is 0.
                ask.write(self.writes(address::DC_CYCLE), &context.clock.period_ns.to_le_bytes());
            }
            Step::SyncOn { .. } => {
                ask.write(self.writes(address::DC_CONTROL), &SYNC0_ON);
            }
            _ => {}
        }
    }

    fn request_clear(&self, done: u8, ask: &mut Ask) {
        const ZERO: [u8; FMMUS_AT_ONCE as usize * Fmmu::SIZE] = [0; FMMUS_AT_ONCE as usize * Fmmu::SIZE];
        let left = |count: u8, at_once: u8| usize::from(count.saturating_sub(done).min(at_once));
        let fmmus = left(self.fmmus, FMMUS_AT_ONCE);
        if fmmus > 0 {
            ask.write(self.writes(address::fmmu(done.into())), &ZERO[..fmmus * Fmmu::SIZE]);
        }
        let managers = left(self.managers, MANAGERS_AT_ONCE);
        if managers > 0 {
            let register = address::sync_manager(done.into());
            ask.write(self.writes(register), &ZERO[..managers * SyncManager::SIZE]);
        }
        if ask.is_empty() {
            // Without a clock these registers do not exist.
            if self.features.has_clock() {
                ask.write(self.writes(address::DC_ACTIVATION), &[0]);
            }
            ask.write(self.writes(address::ERRORS), &[0; 8]);
        }
    }

    /// In SAFEOP: a drive has to see regular cycles first, and SYNC0 where the grid wants it.
    fn request_lock(&mut self, context: &Context<'_>, ask: &mut Ask) {
        let now = context.cycle.grid;
        let sync_ns = if self.plan.sync { sync_ahead_ns(context) } else { 0 };
        let synchronised = match self.owner {
            Owner::Drive(_) => sync_ns + SYNCHRONISE_CYCLES * context.cycle.period_ns,
            Owner::Device(_) => sync_ns,
        };
        let locked = !self.plan.sync || context.clock.is_locked();
        if locked && now.since(self.since) >= synchronised {
            self.note = Note::Starting;
            self.enter(now, Step::to(AlState::Op));
            self.request(context, ask);
        } else {
            let error = context.clock.error_ns().and_then(|error| i32::try_from(error).ok());
            self.note = Note::WaitsForLock(error.filter(|_| self.plan.sync && !locked));
        }
    }

    fn request_state(&mut self, now: Time, change: Change, ask: &mut Ask) {
        let limit = if change.to == AlState::Op { OP_NS } else { STATE_NS };
        if now.since(self.since) > limit {
            return self.refuse(now, Note::Slow(change.to));
        }
        if change.said {
            ask.read(self.reads(address::AL_STATUS), AL_LOOK);
            return;
        }
        // INIT is requested together with the acknowledgement of any present error.
        let wanted = match change.to {
            AlState::Init => AlStatus::request(AlState::Init).acknowledge(),
            to => AlStatus::request(to),
        };
        let control = change.acknowledge.unwrap_or(wanted);
        ask.write(self.writes(address::AL_CONTROL), &control.0.to_le_bytes());
    }

    /// Its outputs are released.
    pub(super) fn release(&mut self, now: Time) {
        self.way.mapped = Mapped::All;
        self.enter(now, Step::Up);
    }
}
