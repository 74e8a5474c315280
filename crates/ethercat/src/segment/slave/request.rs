//! The request of each step.

use super::{Change, Context, FMMUS_AT_ONCE, MANAGERS_AT_ONCE, Mapped, Note, Pause, Setting, Slave, Step};
use crate::plan::Owner;
use crate::slot::Ask;
use crate::wire::frame::Command;
use crate::wire::registers::{AlState, AlStatus, Fmmu, SyncManager, address};
use crate::wire::sii;
use fieldbeat_core::time::{MS, Time};

use super::setup::WATCHDOG_DIVIDER;
use super::sync::{TIME, sync_ahead_ns};

/// Bytes from its type to its station address.
pub(super) const LOOK: usize = 0x12;
/// Behind it: its alias.
pub(super) const ALIAS: usize = 2;
/// AL status and its code; and up to the bit of device emulation.
pub(super) const AL_LOOK: usize = 6;
pub(super) const EMULATION_AT: usize = (address::EMULATION - address::AL_STATUS) as usize;
/// From AL control to AL status.
pub(super) const CONTROL: usize = (address::AL_STATUS - address::AL_CONTROL) as usize;
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
        let ends = matches!(self.step, Step::State(Change { to: AlState::Init, .. }) | Step::SiiBack { .. });
        if self.ending && !ends {
            return;
        }
        match self.step {
            Step::Rest(until) => {
                if now >= until {
                    self.enter(now, Step::Look);
                    self.request(context, ask);
                }
            }
            Step::Refused(Pause { until, .. }) if now >= until => {
                self.enter(now, Step::Look);
                self.request(context, ask);
            }
            Step::Refused(Pause { next, .. }) if now < next => {}
            Step::Look | Step::Refused(_) => {
                ask.read(self.reads(address::AL_CONTROL), CONTROL + EMULATION_AT + 1);
                let alias = if self.plan.identity.alias.is_some() { ALIAS } else { 0 };
                ask.read(self.reads(address::TYPE), LOOK + alias);
            }
            Step::Twin { station, .. } => {
                ask.read(Command::Fprd(station, address::STATION), 2);
            }
            Step::Unaddress => {
                ask.write(self.writes(address::STATION), &[0; 2]);
                // If it was set up with this address, it must not carry out the outputs of the one that has it now.
                self.request_unmap(0, ask);
            }
            Step::There(_) => self.request_there(ask),
            Step::Unmap(done) => self.request_unmap(done, ask),
            Step::FoundClock { .. } => self.request_running(ask),
            Step::SiiForce => {
                ask.write(self.writes(address::SII_OWNER), &[sii::FORCE]);
            }
            Step::SiiTake { .. } => {
                ask.write(self.writes(address::SII_OWNER), &[sii::MASTER]);
                ask.read(self.reads(address::SII_OWNER), 2);
            }
            Step::SiiBack { refused } => {
                ask.write(self.writes(address::SII_OWNER), &[sii::PROCESSOR]);
                if refused == Note::None && !self.may_be_found() && !self.ending {
                    ask.write(self.writes(address::EVENT_MASK), &EVENT_MASK.to_le_bytes());
                }
            }
            Step::Sii(reader) => {
                reader.request(|register| self.reads(register), |register| self.writes(register), ask);
            }
            Step::Identification => self.request_identification(ask),
            Step::Identified { .. } => self.request_no_identification(ask),
            Step::Found => self.request_found(ask),
            Step::FoundFmmus => self.request_found_fmmus(ask),
            Step::Check { resumes, part } => self.request_check(resumes, part, ask),
            Step::Join => self.request_join(ask),
            Step::Ports => {
                // Each loop by itself; no alias.
                ask.write(self.writes(address::PORT_LOOPS), &[0]);
                ask.write(self.writes(address::ALIAS_ENABLE), &[0]);
            }
            Step::Clear(done) => self.request_clear(done, ask),
            Step::Free { .. } | Step::Misplaced => self.request_free(ask),
            Step::Address { .. } => self.request_address(ask),
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
            Step::SyncManagers(from) => {
                for (number, manager) in self.managers_from(from) {
                    ask.write(self.writes(address::sync_manager(number)), &manager.to_bytes());
                }
            }
            Step::SyncManagersCheck(from) => {
                for (number, _) in self.managers_from(from) {
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
        match self.step {
            Step::Time if self.way.mapped == Mapped::None && self.waits_long_for_time(context) => {
                // Its mailbox can be used meanwhile.
                self.continue_timed(context.cycle.grid);
                self.request(context, ask);
            }
            Step::Time => {
                let is_there = context.timed || self.is_reference(context) && context.may_begin;
                if self.delay_ns.is_some() && is_there {
                    ask.read(self.reads(address::DC_TIME), TIME);
                    ask.write(self.writes(address::DC_FILTER), &FILTER_DEPTHS.to_le_bytes());
                }
                self.note = match context.other_time {
                    _ if !ask.is_empty() => Note::Starting,
                    Some(place) => Note::OtherTime(place),
                    None => Note::WaitsForClock,
                };
            }
            Step::Offset(Setting { offset, delay_ns, .. }) => {
                let mut bytes = [0; 12];
                bytes[..8].copy_from_slice(&offset.to_le_bytes());
                bytes[8..].copy_from_slice(&delay_ns.to_le_bytes());
                ask.write(self.writes(address::DC_OFFSET), &bytes);
                ask.write(self.writes(address::DC_SPEED), &SPEED_START.to_le_bytes());
            }
            Step::Correct(_) => {
                ask.read(self.reads(address::DC_DIFFERENCE), 4);
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

    fn request_unmap(&self, done: u8, ask: &mut Ask) {
        const ZERO: [u8; FMMUS_AT_ONCE as usize * Fmmu::SIZE] = [0; FMMUS_AT_ONCE as usize * Fmmu::SIZE];
        let left = usize::from(self.fmmus.saturating_sub(done).min(FMMUS_AT_ONCE));
        ask.write(self.writes(address::fmmu(done.into())), &ZERO[..left * Fmmu::SIZE]);
    }

    fn request_clear(&self, done: u8, ask: &mut Ask) {
        const ZERO: [u8; MANAGERS_AT_ONCE as usize * SyncManager::SIZE] =
            [0; MANAGERS_AT_ONCE as usize * SyncManager::SIZE];
        if done < self.fmmus {
            self.request_unmap(done, ask);
        }
        let managers = usize::from(self.managers.saturating_sub(done).min(MANAGERS_AT_ONCE));
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
        let times = if change.to == AlState::Op { 2 } else { 1 };
        let limit_ns = self.plan.state_timeout_ns.saturating_mul(times);
        if now.since(self.since) > limit_ns {
            let within_ms = u32::try_from(limit_ns / MS).unwrap_or(u32::MAX);
            return self.refuse(now, Note::Slow { to: change.to, within_ms });
        }
        if change.said || change.looks {
            ask.read(self.reads(address::AL_STATUS), AL_LOOK);
            return;
        }
        let control = change.acknowledge.unwrap_or(AlStatus::request(change.to));
        ask.write(self.writes(address::AL_CONTROL), &control.0.to_le_bytes());
    }

    /// Its outputs are released.
    pub(super) fn release(&mut self, now: Time) {
        self.way.mapped = Mapped::All;
        self.enter(now, Step::Up);
    }
}
