//! Control word and status word.

use fieldbeat_core::axis::State;

/// Bits of the control word.
pub mod control {
    constants! { u16:
        START = 1 << 4; RELATIVE = 1 << 6; FAULT_RESET = 1 << 7; HALT = 1 << 8;
    }
}

/// Bits of the status word that do not belong to the state.
pub mod status {
    constants! { u16:
        VOLTAGE = 1 << 4; WARNING = 1 << 7; REMOTE = 1 << 9; TARGET_REACHED = 1 << 10; MODE_12 = 1 << 12;
        MODE_13 = 1 << 13;
    }
}

/// The control word that enables operation.
pub const ENABLE_OPERATION: u16 = 0x000F;

/// The bits of the status word for a state; bit 5 is 0 while a quick stop is active.
pub fn status_of(state: State) -> u16 {
    match state {
        State::SwitchOnDisabled => 0x40,
        State::ReadyToSwitchOn => 0x21,
        State::SwitchedOn => 0x23,
        State::OperationEnabled => 0x27,
        State::QuickStopActive => 0x07,
        State::FaultReactionActive => 0x0F,
        State::Fault => 0x08,
        _ => 0x00,
    }
}

/// Whether a bit rises from one control word to the next.
pub fn rises(before: u16, word: u16, bit: u16) -> bool {
    word & bit != 0 && before & bit == 0
}

/// The state to which a control word leads, if it is another one. Leaving a fault needs a rising edge of bit 7; with
/// that bit set a word is no other command.
pub fn next(state: State, before: u16, word: u16) -> Option<State> {
    use State::{Fault, OperationEnabled, QuickStopActive, ReadyToSwitchOn, SwitchOnDisabled, SwitchedOn};
    let is_reset = word & control::FAULT_RESET != 0;
    // Switch on, enable voltage, quick stop (0: active), enable operation.
    match (state, [0, 1, 2, 3].map(|bit| word >> bit & 1)) {
        (Fault, _) => rises(before, word, control::FAULT_RESET).then_some(SwitchOnDisabled),
        _ if is_reset => None,
        (ReadyToSwitchOn | SwitchedOn | OperationEnabled | QuickStopActive, [_, 0, ..])
        | (ReadyToSwitchOn | SwitchedOn, [_, 1, 0, _]) => Some(SwitchOnDisabled),
        (OperationEnabled, [_, 1, 0, _]) => Some(QuickStopActive),
        (SwitchOnDisabled | SwitchedOn | OperationEnabled, [0, 1, 1, _]) => Some(ReadyToSwitchOn),
        (ReadyToSwitchOn | OperationEnabled, [1, 1, 1, 0]) => Some(SwitchedOn),
        (SwitchedOn | QuickStopActive, [1, 1, 1, 1]) => Some(OperationEnabled),
        _ => None,
    }
}
