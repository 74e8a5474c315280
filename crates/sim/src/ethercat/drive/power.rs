//! The power stage: the control word, faults, and the loss of the cycle.

use super::*;

impl Drive {
    /// The cycle of the bus is not regular.
    pub(super) fn lose_sync(&mut self) {
        if self.al == AlState::Op {
            self.fail(fault::SYNCHRONISATION);
            self.dropped = Some(code::SYNCHRONISATION);
            self.enter(AlState::SafeOp);
        }
    }

    /// A fault: the first one stays.
    pub(super) fn fail(&mut self, code: u16) {
        let reset = if category(code) == RESET { Reset::Always } else { Reset::Never };
        if self.power.fail(code, reset) {
            if !matches!(self.al, AlState::Init | AlState::Boot) {
                self.mailbox.report(code, error_register(code), category(code));
            }
            self.objects.set(ERROR_COUNT, 1);
            self.objects.set(LAST_ERROR, code.into());
            // Faults that could destroy hardware switch off at once, all others stop first.
            let stops = self.state.is_powered() && reset == Reset::Always;
            self.state = if stops { State::FaultReactionActive } else { State::Fault };
        }
    }

    /// Clears a clearable fault; false: it is not, or its reaction is still under way.
    pub(super) fn clear_fault(&mut self) -> bool {
        let clears = self.state == State::Fault && self.power.reset();
        if clears {
            self.state = State::SwitchOnDisabled;
            self.mailbox.report(0, 0, 0);
        }
        clears
    }

    /// Follows the control word.
    pub(super) fn obey(&mut self) {
        let word = self.objects.get(CONTROL_WORD) as u16;
        // A bit that is set already when the first word comes is not an edge.
        let before = self.control.replace(word).unwrap_or(word);
        if let Some(state) = cia402::next(self.state, before, word) {
            self.change(state);
        }
        if self.state != State::OperationEnabled {
            return;
        }
        match self.mode() {
            mode::PROFILE_POSITION => self.profile_position(word, before),
            mode::HOMING => self.home(word, before),
            _ => {}
        }
    }

    pub(super) fn change(&mut self, state: State) {
        let powers = state.is_powered() && !self.state.is_powered();
        if self.state == State::Fault {
            self.clear_fault();
        } else if !powers || self.power.is_enabled() {
            self.state = state;
            if self.state == State::OperationEnabled {
                self.hold();
            }
        }
    }

    /// Control word and setpoints do not count any more.
    pub(super) fn lock_setpoints(&mut self) {
        self.control = None;
        self.state = match self.state {
            State::OperationEnabled | State::QuickStopActive => State::QuickStopActive,
            State::SwitchedOn | State::ReadyToSwitchOn => State::SwitchOnDisabled,
            state => state,
        };
    }
}
