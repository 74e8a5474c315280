//! The power states of CiA 402: the one transition to request next.

use crate::axis::State;
use crate::bus::desired::{Capabilities, Power};

/// The next request on the way into operation of a drive in this state, which has taken the last one; `None`: it makes
/// the next step by itself, or has none to make.
pub fn towards_operation(state: State, wanted: Power, can: &Capabilities) -> Option<Power> {
    match state {
        State::ReadyToSwitchOn if can.switches_on_at_once => Some(Power::EnableOperation),
        State::ReadyToSwitchOn => Some(Power::SwitchOn),
        State::SwitchedOn => Some(Power::EnableOperation),
        // One that the master has requested ends with the request.
        State::QuickStopActive if can.leaves_quick_stop || wanted == Power::QuickStop => {
            Some(Power::EnableOperation)
        }
        State::SwitchOnDisabled => Some(Power::Shutdown),
        _ => None,
    }
    .filter(|next| *next != wanted)
}

/// The request that changes nothing of a drive in this state. It never switches on a drive that is off.
pub fn as_found(state: State) -> Power {
    match state {
        State::OperationEnabled => Power::EnableOperation,
        State::SwitchedOn => Power::SwitchOn,
        State::QuickStopActive | State::FaultReactionActive => Power::QuickStop,
        State::ReadyToSwitchOn => Power::Shutdown,
        State::Unknown | State::NotReadyToSwitchOn | State::SwitchOnDisabled | State::Fault => Power::Off,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::desired::Generator;
    use State::{QuickStopActive, ReadyToSwitchOn, SwitchOnDisabled, SwitchedOn, Unknown};

    #[test]
    fn each_state_has_one_next_transition_and_none_is_requested_twice() {
        let all = Capabilities::of(Generator::Drive { velocities: None });
        let steps = Capabilities { switches_on_at_once: false, ..all };
        let stays = Capabilities { leaves_quick_stop: false, ..all };
        let (operate, shutdown) = (Some(Power::EnableOperation), Some(Power::Shutdown));
        for (can, state, wanted, next) in [
            (&all, SwitchOnDisabled, Power::Off, shutdown),
            (&all, SwitchOnDisabled, Power::Shutdown, None),
            (&all, ReadyToSwitchOn, Power::Shutdown, operate),
            (&steps, ReadyToSwitchOn, Power::Shutdown, Some(Power::SwitchOn)),
            (&steps, ReadyToSwitchOn, Power::SwitchOn, None),
            (&steps, SwitchedOn, Power::SwitchOn, operate),
            (&all, QuickStopActive, Power::SwitchOn, operate),
            (&stays, QuickStopActive, Power::SwitchOn, None),
            // The master's own ends with its request.
            (&stays, QuickStopActive, Power::QuickStop, operate),
            (&all, Unknown, Power::Off, None),
        ] {
            assert_eq!(towards_operation(state, wanted, can), next, "{state} {wanted:?} {can:?}");
        }
    }
}
