//! The states in a status word of CiA 402, and of DRIVECOM before it.

use crate::axis::State;

/// The relevant bits of each state, and their values. The CAN manual of the S300 prints bit 6 of the first as 1; the
/// standard, the AKD and the EMF2133IB have 0.
pub(super) const STATES: [(State, u16, u16); 8] = [
    (State::NotReadyToSwitchOn, 0x4F, 0x00),
    (State::SwitchOnDisabled, 0x4F, 0x40),
    (State::ReadyToSwitchOn, 0x6F, 0x21),
    (State::SwitchedOn, 0x6F, 0x23),
    (State::OperationEnabled, 0x6F, 0x27),
    (State::QuickStopActive, 0x6F, 0x07),
    (State::FaultReactionActive, 0x4F, 0x0F),
    (State::Fault, 0x4F, 0x08),
];

/// The state in a status word; [`State::Unknown`]: no valid one.
pub(super) fn state(status: u16) -> State {
    let known = STATES.iter().find(|(_, mask, value)| status & mask == *value);
    known.map_or(State::Unknown, |(state, ..)| *state)
}
