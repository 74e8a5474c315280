//! The request of each step.

use super::{
    Change, Context, FMMUS_AT_ONCE, MANAGERS_AT_ONCE, Mapped, Note, Pause, Phase, Setting, Slave, Step,
};
use crate::plan::Owner;
use crate::segment::running::Running;
use crate::slot::Ask;
use crate::wire::frame::{Command, position};
use crate::wire::registers::{AlState, AlStatus, Fmmu, SyncManager, address};
use crate::wire::sii;
use fieldbeat_core::time::{MS, Time};

use super::setup::{WATCHDOG_DIVIDER, WATCHDOGS};
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
/// SyncManagers of a drive in OP that are read.
const MANAGERS_FOUND: usize = 4;
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
                self.read(address::AL_CONTROL, CONTROL + EMULATION_AT + 1, ask);
                let alias = if self.plan.identity.alias.is_some() { ALIAS } else { 0 };
                self.read(address::TYPE, LOOK + alias, ask);
            }
            Step::Twin { station, .. } => {
                ask.read(Command::Fprd(station, address::STATION), 2);
            }
            Step::Unaddress => {
                self.write(address::STATION, &[0; 2], ask);
                // If it was set up with this address, it must not carry out the outputs of the one that has it now.
                self.request_unmap(0, ask);
            }
            Step::There(_) => {
                let place = position(self.plan.place);
                ask.read(Command::Aprd(place, address::AL_STATUS), 2);
                ask.read(Command::Aprd(place, address::STATION), 2);
            }
            Step::Unmap(done) => self.request_unmap(done, ask),
            Step::FoundClock { .. } => Running::request(|register| self.reads(register), ask),
            Step::SiiForce => self.write(address::SII_OWNER, &[sii::FORCE], ask),
            Step::SiiTake { .. } => {
                self.write(address::SII_OWNER, &[sii::MASTER], ask);
                self.read(address::SII_OWNER, 2, ask);
            }
            Step::SiiBack { refused } => {
                self.write(address::SII_OWNER, &[sii::PROCESSOR], ask);
                if refused == Note::None && !self.may_be_found() && !self.ending {
                    self.write(address::EVENT_MASK, &EVENT_MASK.to_le_bytes(), ask);
                }
            }
            Step::Sii(reader) => {
                reader.request(|register| self.reads(register), |register| self.writes(register), ask);
            }
            Step::Identification => {
                let control = self.present().0 | AlStatus::IDENTIFICATION;
                self.write(address::AL_CONTROL, &control.to_le_bytes(), ask);
                self.read(address::AL_STATUS, AL_LOOK, ask);
            }
            Step::Identified { .. } => {
                self.write(address::AL_CONTROL, &self.present().0.to_le_bytes(), ask);
            }
            Step::Found => {
                self.read(address::SYNC_MANAGER, MANAGERS_FOUND * SyncManager::SIZE, ask);
                self.read(address::WATCHDOG_DIVIDER, WATCHDOGS, ask);
            }
            Step::FoundFmmus => self.read(address::FMMU, self.fmmus().1, ask),
            Step::Check { resumes, part } => {
                let (register, length) = self.registers_of(part, resumes);
                self.read(register, length, ask);
            }
            Step::Join => {
                // Its inputs and AL status; after the FMMU of its outputs.
                let (fmmus, length) = self.fmmus();
                let behind = self.output_fmmus() * Fmmu::SIZE;
                self.write(address::FMMU + behind as u16, &fmmus[behind..length], ask);
            }
            Step::Ports => {
                // Each loop by itself; no alias.
                self.write(address::PORT_LOOPS, &[0], ask);
                self.write(address::ALIAS_ENABLE, &[0], ask);
            }
            Step::Clear(done) => self.request_clear(done, ask),
            Step::Free { .. } | Step::Misplaced => {
                // Whoever has its station address loses it, as an alias too.
                ask.write(Command::Fpwr(self.station(), address::ALIAS_ENABLE), &[0]);
                ask.write(Command::Fpwr(self.station(), address::STATION), &[0; 2]);
            }
            Step::Address { .. } => {
                self.write(address::STATION, &self.station().to_le_bytes(), ask);
                ask.read(Command::Fprd(self.station(), address::STATION), 2);
            }
            Step::Mailbox => self.request_managers(self.mailbox_managers(), ask),
            Step::Objects { .. } => {}
            Step::Watchdog => {
                self.write(address::WATCHDOG_DIVIDER, &WATCHDOG_DIVIDER.to_le_bytes(), ask);
                self.write(address::WATCHDOG, &self.watchdog().to_le_bytes(), ask);
            }
            Step::WatchdogCheck => {
                self.read(address::WATCHDOG_DIVIDER, 2, ask);
                self.read(address::WATCHDOG, 2, ask);
            }
            Step::SyncManagers(from) => self.request_managers(self.managers_from(from), ask),
            Step::SyncManagersCheck(from) => {
                for (number, _) in self.managers_from(from) {
                    self.read(address::sync_manager(number), SyncManager::SIZE, ask);
                }
            }
            Step::Fmmus | Step::Release => {
                let (fmmus, length) = self.fmmus();
                self.write(address::FMMU, &fmmus[..length], ask);
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
            Step::Code => self.read(address::AL_STATUS, AL_LOOK, ask),
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
                    self.read(address::DC_TIME, TIME, ask);
                    self.write(address::DC_FILTER, &FILTER_DEPTHS.to_le_bytes(), ask);
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
                self.write(address::DC_OFFSET, &bytes, ask);
                self.write(address::DC_SPEED, &SPEED_START.to_le_bytes(), ask);
            }
            Step::Settle { next, .. } if context.cycle.grid < next => {}
            Step::Correct(_) | Step::Settle { .. } => self.read(address::DC_DIFFERENCE, 4, ask),
            Step::SegmentTime => {
                // Its start must not be written while it is imminent.
                self.write(address::DC_ACTIVATION, &[0], ask);
                self.read(address::DC_TIME, 8, ask);
            }
            Step::SyncStart { ahead_ns, segment_ns } => {
                let start = self.whole(segment_ns.wrapping_add(ahead_ns));
                self.write(address::DC_START, &start.to_le_bytes(), ask);
                // SYNC1 stays off: its cycle is 0.
                self.write(address::DC_CYCLE, &context.clock.period_ns.to_le_bytes(), ask);
            }
            Step::SyncOn { .. } => self.write(address::DC_CONTROL, &SYNC0_ON, ask),
            _ => {}
        }
    }

    fn request_managers(&self, managers: impl Iterator<Item = (u16, SyncManager)>, ask: &mut Ask) {
        for (number, manager) in managers {
            self.write(address::sync_manager(number), &manager.to_bytes(), ask);
        }
    }

    fn request_unmap(&self, done: u8, ask: &mut Ask) {
        const ZERO: [u8; FMMUS_AT_ONCE as usize * Fmmu::SIZE] = [0; FMMUS_AT_ONCE as usize * Fmmu::SIZE];
        let left = usize::from(self.fmmus.saturating_sub(done).min(FMMUS_AT_ONCE));
        self.write(address::fmmu(done.into()), &ZERO[..left * Fmmu::SIZE], ask);
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
            self.write(register, &ZERO[..managers * SyncManager::SIZE], ask);
        }
        if ask.is_empty() {
            // Without a clock these registers do not exist.
            if self.features.has_clock() {
                self.write(address::DC_ACTIVATION, &[0], ask);
            }
            self.write(address::ERRORS, &[0; 8], ask);
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
            let error = error.filter(|_| self.plan.sync && !locked);
            self.note = error.map_or(Note::WaitsForLock, Note::Unlocked);
        }
    }

    fn request_state(&mut self, now: Time, change: Change, ask: &mut Ask) {
        let times = if change.to == AlState::Op { 2 } else { 1 };
        let limit_ns = self.plan.state_timeout_ns.saturating_mul(times);
        if now.since(self.since) > limit_ns {
            let within_ms = u32::try_from(limit_ns / MS).unwrap_or(u32::MAX);
            return self.refuse(now, Note::Slow { to: change.to, within_ms });
        }
        if change.phase != Phase::Requests {
            return self.read(address::AL_STATUS, AL_LOOK, ask);
        }
        let control = change.acknowledge.unwrap_or(AlStatus::request(change.to));
        self.write(address::AL_CONTROL, &control.0.to_le_bytes(), ask);
    }
}
