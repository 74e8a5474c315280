//! The orderly end: all drives are cleared, each is unlocked.

use super::ProfibusBus;
use crate::line::Ready;
use crate::wire::dp::GlobalControl;
use fieldbeat_core::bus::{Cycle, Slot};

/// Cycles that it may wait for one telegram.
const END_WITHIN: u32 = 100;

/// How far it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum End {
    /// It has not begun.
    #[default]
    None,
    /// Global_Control with Clear is next.
    Clear,
    /// This drive is unlocked next.
    Unlock(u8),
    Over,
}

impl ProfibusBus {
    /// One step of it; true: it is over.
    pub(super) fn end(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        let now = cycle.deadline;
        self.take_in(slots);
        self.waits += 1;
        if !self.line.is_up() || self.waits > END_WITHIN {
            self.end = End::Over;
        }
        match self.line.ready(now) {
            _ if self.end == End::Over => return true,
            Ready::Overdue { job, instead, failed } => {
                self.overdue(now, job, instead, failed, slots);
                return false;
            }
            Ready::Resend => {
                self.hand_over(slots);
                return false;
            }
            Ready::Wait | Ready::Claim => return false,
            Ready::Free => self.waits = 0,
        }
        self.end = match self.end {
            End::None => End::Clear,
            End::Clear => {
                self.control(now, GlobalControl::CLEAR, slots);
                End::Unlock(0)
            }
            End::Unlock(index) => {
                let Some(station) = self.stations.get_mut(usize::from(index)) else { return true };
                if station.unlocks() && self.line.request(index, |out| station.unlock(out)).is_some() {
                    self.hand_over(slots);
                }
                End::Unlock(index + 1)
            }
            End::Over => End::Over,
        };
        for slot in slots.iter_mut() {
            slot.expected_silence = true;
        }
        self.end == End::Over
    }
}
