//! The power stage: the control word, faults, and the loss of the cycle.

use super::*;

impl Drive {
    /// The cycle of the bus is not regular.
    pub(super) fn lose_sync(&mut self) {
        if self.al == AlState::Op {
            self.fail(Fault::SYNCHRONISATION);
            self.dropped = Some(AlCode::SYNCHRONISATION);
            self.enter(AlState::SafeOp);
        }
    }

    /// A fault: the first one stays.
    pub(super) fn fail(&mut self, fault: Fault) {
        let reset = if fault.clearing == Clearing::Reset { Reset::Always } else { Reset::Never };
        if self.power.fail(fault, reset) {
            if !matches!(self.al, AlState::Init | AlState::Boot) {
                self.mailbox.report(fault.emergency());
            }
            self.objects.set(ERROR_COUNT, 1);
            self.objects.set(LAST_ERROR, fault.code.into());
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
            self.mailbox.report(Emergency::default());
        }
        clears
    }

    /// Follows the control word.
    pub(super) fn obey(&mut self) {
        let word = ControlWord(self.objects.get(CONTROL_WORD) as u16);
        // A bit that is set already when the first word comes is not an edge.
        let before = self.control.replace(word).unwrap_or(word);
        if let Some(transition) = Transition::caused(self.state, word, before) {
            self.change(transition);
        }
        if self.state != State::OperationEnabled {
            return;
        }
        match self.mode() {
            Mode::PROFILE_POSITION => self.profile_position(word, before),
            Mode::HOMING => self.home(word, before),
            _ => {}
        }
    }

    pub(super) fn change(&mut self, transition: Transition) {
        let powers = transition.to.is_powered() && !transition.from.is_powered();
        if transition.cause == Cause::FaultReset {
            self.clear_fault();
        } else if !powers || self.power.is_enabled() {
            self.state = transition.to;
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
