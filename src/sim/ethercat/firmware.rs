//! The firmware of every slave: the EtherCAT state machine, the mailbox, the cycle (ETG.1000.6, 6.4; ETG.1000.4,
//! 6.7).

use std::ops::Range;

use super::chip::Chip;
use super::manager::Manager;
use super::{Application, Drive};
use crate::bus::ethercat::wire::registers::{AlCode, AlState, AlStatus};
use crate::time::Time;

/// Standard codes that every slave has.
const UNKNOWN_STATE: AlCode = AlCode(0x0012);
const MAILBOX: AlCode = AlCode(0x0016);
/// Buffers below it are no memory, but outputs.
const MEMORY: usize = 0x1000;

/// The firmware without its application.
#[derive(Debug)]
pub(super) struct Firmware {
    application: Box<dyn Application>,
    watchdog_code: AlCode,
    reaction_ns: u64,
    has_mailbox: bool,
    state: AlState,
    /// Why it refused, or fell back, until that is acknowledged.
    error: Option<AlCode>,
    /// The requested state of the application that it cannot enter yet.
    pending: Option<AlState>,
    /// A message that waits for room in the mailbox.
    waiting: Option<Vec<u8>>,
    /// The last message put there.
    last: Vec<u8>,
    /// Process data of the present cycle.
    outputs: Vec<u8>,
    inputs: Vec<u8>,
}

impl Firmware {
    pub(super) fn new(
        application: Box<dyn Application>,
        watchdog_code: AlCode,
        reaction_ns: u64,
        has_mailbox: bool,
    ) -> Firmware {
        Firmware {
            application,
            watchdog_code,
            reaction_ns,
            has_mailbox,
            state: AlState::Init,
            error: None,
            pending: None,
            waiting: None,
            last: Vec::new(),
            outputs: Vec::new(),
            inputs: Vec::new(),
        }
    }

    /// The state it is in.
    pub(super) fn state(&self) -> AlState {
        self.state
    }

    /// Why it refused, or fell back, until that is acknowledged.
    pub(super) fn error(&self) -> Option<AlCode> {
        self.error
    }

    /// The drive behind it, if there is one.
    pub(super) fn drive(&mut self) -> Option<&mut Drive> {
        self.application.drive()
    }

    /// It is in OP, as another master has left it.
    pub(super) fn run(&mut self, chip: &mut Chip) {
        self.state = AlState::Op;
        self.show(chip);
    }

    /// Power cycle.
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
        if chip.requested().is_some_and(|requested| now.since(requested) >= self.reaction_ns) {
            let request = chip.take_request();
            self.take(chip, request, now);
        }
        if let Some(state) = self.pending {
            self.rise(chip, state, now);
        }
        if self.state != AlState::Init {
            self.mailbox(chip, now);
        }
    }

    /// One cycle of the application.
    pub(super) fn cycle(&mut self, chip: &mut Chip, at: Time) {
        self.stay(chip, at);
        if self.state < AlState::SafeOp {
            return;
        }
        self.outputs.clear();
        if self.state == AlState::Op {
            self.outputs.extend(chip.outputs());
        }
        self.inputs.clear();
        self.inputs.extend(chip.inputs());
        self.application.process(at, &self.outputs, &mut self.inputs);
        chip.put_inputs(&self.inputs);
        self.stay(chip, at);
    }

    /// Falls back if it cannot stay in OP.
    fn stay(&mut self, chip: &mut Chip, at: Time) {
        let (expired, dropped) = (chip.watchdog_expired(at), self.application.dropped());
        if self.state != AlState::Op {
            return;
        }
        let code = match dropped {
            Some(code) => code,
            None if expired => {
                // It is informed, not asked.
                let _ = self.application.may_enter(at, AlState::SafeOp);
                self.watchdog_code
            }
            None => return,
        };
        (self.state, self.error, self.pending) = (AlState::SafeOp, Some(code), None);
        self.show(chip);
    }

    fn show(&self, chip: &mut Chip) {
        chip.show_state(self.state, self.error.is_some(), self.error.unwrap_or(AlCode::NONE));
    }

    /// Takes a request of the master's.
    fn take(&mut self, chip: &mut Chip, request: AlStatus, now: Time) {
        if self.error.is_some() && !request.error() {
            return;
        }
        (self.error, self.pending) = (None, None);
        match request.state() {
            None => self.refuse(UNKNOWN_STATE),
            Some(state) if state == self.state => {}
            Some(state) if !leads(self.state, state) => self.refuse(AlCode::INVALID_REQUEST),
            Some(state) if state < self.state => {
                // It is informed, not asked.
                let _ = self.application.may_enter(now, state);
                self.enter(chip, state, now);
            }
            Some(state) => self.rise(chip, state, now),
        }
        self.show(chip);
    }

    fn refuse(&mut self, code: AlCode) {
        (self.error, self.pending) = (Some(code), None);
    }

    /// Enters a higher state, if everything is ready for it.
    fn rise(&mut self, chip: &mut Chip, state: AlState, now: Time) {
        match self.check(chip, state).and_then(|()| self.application.may_enter(now, state)) {
            Ok(()) => self.enter(chip, state, now),
            Err(AlCode::NONE) => self.pending = Some(state),
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
        (self.state, self.pending) = (state, None);
        if state == AlState::Op {
            // The watchdog runs from here on.
            chip.feed(now);
        }
        self.show(chip);
    }

    /// Faults of the SyncManagers for a state.
    fn check(&self, chip: &Chip, state: AlState) -> Result<(), AlCode> {
        match state {
            AlState::PreOp if self.has_mailbox => {
                let fits = |n: usize, output| chip.managers().get(n).is_some_and(|m| m.is_mailbox(output));
                if fits(0, true) && fits(1, false) { Ok(()) } else { Err(MAILBOX) }
            }
            AlState::SafeOp | AlState::Op => self.check_process(chip),
            _ => Ok(()),
        }
    }

    fn check_process(&self, chip: &Chip) -> Result<(), AlCode> {
        let managers: Vec<&Manager> = chip.managers().iter().filter(|manager| manager.is_on()).collect();
        let areas: Vec<Range<usize>> =
            managers.iter().map(|manager| manager.footprint()).filter(|area| area.start >= MEMORY).collect();
        if areas.iter().any(|area| area.end > chip.memory_end()) || overlap(areas) {
            return Err(AlCode::SYNC_MANAGER);
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
        if chip.takes_repeat() && self.waiting.is_none() && !self.last.is_empty() && chip.has_room() {
            self.waiting = Some(self.last.clone());
        }
        self.post(chip);
        if chip.has_room() {
            let mut message = Vec::new();
            if self.application.message(&mut message) {
                self.waiting = Some(message);
                self.post(chip);
            }
        }
        let is_due = chip.filled().is_some_and(|filled| now.since(filled) >= self.reaction_ns);
        if is_due && self.waiting.is_none() {
            let request = chip.take_message();
            let mut reply = Vec::new();
            if self.application.mailbox(&request, &mut reply) {
                self.waiting = Some(reply);
                self.post(chip);
            }
        }
    }

    /// Puts the waiting message into the mailbox, if that is empty.
    fn post(&mut self, chip: &mut Chip) {
        if !chip.has_room() {
            return;
        }
        if let Some(message) = self.waiting.take() {
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
