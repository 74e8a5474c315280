//! The firmware of every slave: the EtherCAT state machine, the mailbox, the cycle (ETG.1000.6, 6.4; ETG.1000.4,
//! 6.7).

use std::ops::Range;

use super::chip::{Chip, END};
use super::codec::registers::{AlState, SyncManager, address, al, code};
use super::codec::sii::word;
use super::manager::Manager;
use super::slave::MailboxSettings;
use super::{Application, Drive};
use fieldbeat_core::time::Time;

/// Buffers below it are no memory, but outputs.
const MEMORY: usize = 0x1000;

/// The firmware without its application.
#[derive(Debug)]
pub(super) struct Firmware {
    application: Box<dyn Application>,
    pub(super) state: AlState,
    /// Why it refused, or fell back, until that is acknowledged.
    pub(super) error: Option<u16>,
    /// The requested state of the application that it cannot enter yet.
    pending: Option<AlState>,
    /// A message that waits for room in the mailbox, and when it is ready.
    waiting: Option<(Time, Vec<u8>)>,
    /// Answers so far.
    answers: u32,
    /// The last message put there.
    last: Vec<u8>,
    /// Process data of the present cycle.
    pub(super) outputs: Vec<u8>,
    inputs: Vec<u8>,
    /// Outputs of another slave that are wired to its inputs.
    sensed: Option<Vec<u8>>,
}

impl Firmware {
    pub(super) fn new(application: Box<dyn Application>) -> Firmware {
        Firmware {
            application,
            state: AlState::Init,
            error: None,
            pending: None,
            waiting: None,
            answers: 0,
            last: Vec::new(),
            outputs: Vec::new(),
            inputs: Vec::new(),
            sensed: None,
        }
    }

    /// Outputs of another slave are at its inputs.
    pub(super) fn sense(&mut self, levels: &[u8]) {
        let sensed = self.sensed.get_or_insert_default();
        sensed.clear();
        sensed.extend_from_slice(levels);
    }

    /// The drive behind it, if there is one.
    pub(super) fn drive(&mut self) -> Option<&mut Drive> {
        self.application.drive()
    }

    /// Takes the state in which another master has left the slave.
    pub(super) fn leave(&mut self, chip: &mut Chip, status: u16, code: u16) {
        self.state = AlState::of(status).unwrap_or_default();
        self.error = (status & al::ERROR != 0).then_some(code);
        if chip.emulated_state().is_some() {
            chip.write(address::AL_CONTROL, &status.to_le_bytes());
            return;
        }
        self.application.left_in(self.state);
        self.show(chip);
    }

    /// Power cycle, or a restart of the processor alone.
    pub(super) fn restart(&mut self, now: Time) {
        self.application.restart(now);
        (self.state, self.error, self.pending) = (AlState::Init, None, None);
        self.forget();
    }

    /// The mailbox begins anew.
    fn forget(&mut self) {
        self.waiting = None;
        self.last.clear();
    }

    /// Does what is due by `now`.
    pub(super) fn work(&mut self, chip: &mut Chip, now: Time) {
        self.application.advance(now);
        self.stay(chip, now);
        if chip.requested.is_some_and(|requested| now.since(requested) >= chip.settings.reaction_ns) {
            let request = chip.take_request();
            self.take(chip, request, now);
        }
        self.follow(chip);
        if let Some(state) = self.pending {
            self.rise(chip, state, now);
        }
        if self.state != AlState::Init {
            self.mailbox(chip, now);
        }
    }

    /// Without a processor nobody decides: the state is the requested one.
    fn follow(&mut self, chip: &Chip) {
        self.state = chip.emulated_state().unwrap_or(self.state);
    }

    /// One cycle of the application. Without a processor inputs are read in every state.
    pub(super) fn cycle(&mut self, chip: &mut Chip, at: Time) {
        self.follow(chip);
        self.stay(chip, at);
        if self.state < AlState::SafeOp && chip.emulated_state().is_none() {
            return;
        }
        self.outputs.clear();
        if self.state == AlState::Op && !chip.watchdog_expired(at) {
            self.outputs.extend(chip.outputs());
            self.application.trim(&mut self.outputs);
        }
        self.inputs.clear();
        self.inputs.extend(chip.inputs());
        self.application.process(at, &self.outputs, &mut self.inputs);
        if let Some(levels) = &self.sensed {
            self.application.sense(levels, &mut self.inputs);
        }
        chip.put_inputs(&self.inputs);
        self.stay(chip, at);
    }

    /// Falls back if it cannot stay in OP.
    fn stay(&mut self, chip: &mut Chip, at: Time) {
        let (expired, dropped) = (chip.watchdog_expired(at), self.application.dropped());
        if self.state != AlState::Op || chip.emulated_state().is_some() {
            return;
        }
        let code = match dropped {
            Some(code) => code,
            None if expired => {
                // The application is informed; its answer does not count.
                let _ = self.application.may_enter(at, AlState::SafeOp);
                // That of a Kollmorgen S300 ... S700 is not known; of the codes in its manual only that of
                // synchronisation would fit.
                code::WATCHDOG
            }
            None => return,
        };
        (self.state, self.error, self.pending) = (AlState::SafeOp, Some(code), None);
        self.show(chip);
    }

    pub(super) fn show(&self, chip: &mut Chip) {
        chip.show_state(self.state, self.error.is_some(), self.error.unwrap_or(code::NONE));
    }

    /// Takes a request of the master's.
    fn take(&mut self, chip: &mut Chip, request: u16, now: Time) {
        if self.error.is_some() && request & al::ERROR == 0 {
            return;
        }
        (self.error, self.pending) = (None, None);
        chip.identifies = request & al::IDENTIFICATION != 0;
        match AlState::of(request) {
            None => self.refuse(code::UNKNOWN_STATE),
            Some(state) if state == self.state => {}
            Some(state) if !leads(self.state, state) => self.refuse(code::INVALID_REQUEST),
            Some(state) if state < self.state => {
                // The application is informed; its answer does not count.
                let _ = self.application.may_enter(now, state);
                self.enter(chip, state, now);
            }
            Some(state) => self.rise(chip, state, now),
        }
        self.show(chip);
    }

    fn refuse(&mut self, code: u16) {
        (self.error, self.pending) = (Some(code), None);
    }

    /// Enters a higher state, if everything is ready for it.
    fn rise(&mut self, chip: &mut Chip, state: AlState, now: Time) {
        match self.check(chip, state).and_then(|()| self.application.may_enter(now, state)) {
            Ok(()) => self.enter(chip, state, now),
            Err(code::NONE) => self.pending = Some(state),
            Err(code) => {
                self.refuse(code);
                self.show(chip);
            }
        }
    }

    fn enter(&mut self, chip: &mut Chip, state: AlState, now: Time) {
        if self.state == AlState::Init || state == AlState::Init {
            self.forget();
        }
        if state == AlState::PreOp && chip.settings.sii_access.read_in_preop {
            chip.give_sii();
        }
        let rises = state > std::mem::replace(&mut self.state, state);
        chip.met.exact_managers += u32::from(rises && !chip.settings.managers.is_empty());
        self.pending = None;
        if state == AlState::Op {
            // The watchdog runs from here on.
            chip.feed(now);
        }
        self.show(chip);
        if state == AlState::SafeOp && rises {
            self.inputs.clear();
            self.inputs.extend(chip.inputs());
            self.application.actual(&mut self.inputs);
            chip.put_inputs(&self.inputs);
        }
    }

    /// Faults of the SyncManagers for a state.
    fn check(&self, chip: &Chip, state: AlState) -> Result<(), u16> {
        match state {
            AlState::PreOp if chip.settings.sii_access.read_in_preop && !chip.has_sii() => Err(code::NO_SII),
            AlState::PreOp
                if chip.settings.sii.get(word::PROTOCOLS).is_some_and(|protocols| *protocols != 0) =>
            {
                let fits = |n: usize, output| chip.managers.get(n).is_some_and(|m| m.is_mailbox(output));
                if fits(0, true) && fits(1, false) { self.compare(chip, state) } else { Err(code::MAILBOX) }
            }
            AlState::SafeOp | AlState::Op => {
                self.compare(chip, state).and_then(|()| self.check_process(chip))
            }
            _ => Ok(()),
        }
    }

    /// Compares the SyncManagers that a state needs with the wanted ones: start, length, control, and whether they
    /// are on.
    fn compare(&self, chip: &Chip, state: AlState) -> Result<(), u16> {
        for (n, wanted) in chip.settings.managers.iter().enumerate() {
            let is_due = wanted.is_mailbox() || state >= AlState::SafeOp;
            let set = chip.managers.get(n).map(|manager| manager.setting).unwrap_or_default();
            let fits = SyncManager { activate: wanted.activate, ..set } == *wanted;
            if is_due && wanted.length > 0 && !(fits && set.activate & 1 == wanted.activate & 1) {
                return Err(match (wanted.is_mailbox(), wanted.is_output()) {
                    (true, _) => code::MAILBOX,
                    (false, true) => code::OUTPUTS,
                    (false, false) => code::INPUTS,
                });
            }
        }
        Ok(())
    }

    fn check_process(&self, chip: &Chip) -> Result<(), u16> {
        let managers: Vec<&Manager> = chip.managers.iter().filter(|manager| manager.is_on()).collect();
        let areas: Vec<Range<usize>> =
            managers.iter().map(|manager| manager.footprint()).filter(|area| area.start >= MEMORY).collect();
        if areas.iter().any(|area| area.end > END) || overlap(areas) {
            return Err(code::SYNC_MANAGER);
        }
        let bytes = |output| -> usize {
            managers
                .iter()
                .filter(|manager| manager.is_process(output))
                .map(|manager| manager.area().len())
                .sum()
        };
        self.application.check_sizes(bytes(true), bytes(false))
    }

    /// Serves the mailbox: one message at a time.
    fn mailbox(&mut self, chip: &mut Chip, now: Time) {
        let is_requested = chip.takes_repeat();
        chip.met.unheeded_repeats += u32::from(is_requested && !chip.settings.mailbox.resends);
        let again = is_requested && chip.settings.mailbox.resends && self.waiting.is_none();
        if again && !self.last.is_empty() && chip.has_room() {
            self.waiting = Some((now, self.last.clone()));
        }
        self.post(chip, now);
        if chip.has_room() && self.waiting.is_none() {
            let mut message = Vec::new();
            if self.application.message(&mut message) {
                self.waiting = Some((now, message));
                self.post(chip, now);
            }
        }
        let is_due = chip.filled.is_some_and(|filled| now.since(filled) >= chip.settings.reaction_ns);
        if is_due && self.waiting.is_none() {
            let request = chip.take_message();
            let mut reply = Vec::new();
            if self.application.mailbox(&request, &mut reply) {
                self.answer(chip, reply, now);
                self.post(chip, now);
            }
        }
    }

    /// Takes an answer of the application, at once, late or not at all.
    fn answer(&mut self, chip: &mut Chip, reply: Vec<u8>, now: Time) {
        self.answers += 1;
        let MailboxSettings { delay_ns, delay_every, lose_every, .. } = chip.settings.mailbox;
        let is_one_of = |every: u32| every > 0 && self.answers.is_multiple_of(every);
        if is_one_of(lose_every) {
            chip.met.lost_answers += 1;
            return;
        }
        let late_ns = if is_one_of(delay_every) { delay_ns } else { 0 };
        chip.met.late_answers += u32::from(late_ns > 0);
        self.waiting = Some((now + late_ns, reply));
    }

    /// Puts the waiting message into the mailbox, if that is empty.
    fn post(&mut self, chip: &mut Chip, now: Time) {
        if !chip.has_room() {
            return;
        }
        if let Some((_, message)) = self.waiting.take_if(|(ready, _)| *ready <= now) {
            chip.put_message(&message);
            self.last = message;
        }
    }
}

/// Whether two of these overlap.
fn overlap(mut areas: Vec<Range<usize>>) -> bool {
    areas.sort_by_key(|area| area.start);
    areas.windows(2).any(|pair| pair[1].start < pair[0].end)
}

/// Whether a transition leads from one state to another.
fn leads(from: AlState, to: AlState) -> bool {
    use AlState::{Boot, Init, Op, PreOp, SafeOp};
    match (from, to) {
        (_, Init) | (Init, PreOp | Boot) | (PreOp, SafeOp) | (SafeOp, PreOp | Op) | (Op, PreOp | SafeOp) => {
            true
        }
        _ => from == to,
    }
}

#[cfg(test)]
mod tests;
