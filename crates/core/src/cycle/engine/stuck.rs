//! After the wires were taken from the loop, since a cycle of it did not end: it sends nothing more, receives nothing,
//! latches every axis and ends.

use super::{Engine, Flow};
use crate::axis::StopCause;
use crate::drive::controller::DriveController;
use crate::rt::Clock;

impl<C: Clock> Engine<C> {
    /// The end of a loop that has found the wires taken.
    #[cold]
    pub(super) fn give_way(&mut self) -> Flow {
        // First, so that whoever has taken them knows that nothing follows.
        self.channels.gate.wires().give_way();
        self.latch(StopCause::LoopStuck);
        self.controllers.iter_mut().for_each(DriveController::note_stuck);
        Flow::End
    }
}
