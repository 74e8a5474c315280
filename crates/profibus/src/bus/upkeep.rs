//! What the master sends of its own accord: Global_Control, a token to itself, a search for another master.

use crate::plan::ProfibusPlan;
use fieldbeat_core::time::Time;

/// When each of them is due.
#[derive(Debug)]
#[repr(C)] // What each turn looks at comes first.
pub(super) struct Upkeep {
    /// A drive is in Data_Exchange: Global_Control is sent.
    operates: bool,
    /// A round of turns has ended.
    round_over: bool,
    token: bool,
    control_at: Time,
    control_every_ns: u64,
    /// Rounds from one search to the next, and since the last one.
    gap: Option<u32>,
    rounds: u32,
    /// The address that it was for, its own, and the highest.
    gap_address: u8,
    own: u8,
    highest: u8,
}

/// The next step after a round.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Behind {
    Token,
    /// A search at this address.
    Gap(u8),
}

impl Upkeep {
    pub(super) fn new(plan: &ProfibusPlan) -> Upkeep {
        Upkeep {
            operates: false,
            round_over: false,
            token: plan.token,
            control_at: Time(0),
            control_every_ns: plan.global_control_ns,
            gap: plan.gap,
            rounds: 0,
            gap_address: plan.address,
            own: plan.address,
            highest: plan.highest_address.min(126),
        }
    }

    /// Global_Control is due from then on; `None`: no drive is there.
    pub(super) fn operate(&mut self, from: Option<Time>) {
        (self.operates, self.control_at) = (from.is_some(), from.unwrap_or(Time(0)));
    }

    /// Global_Control is due: behind a round of the drives, as long as it is not late.
    #[inline]
    pub(super) fn control_is_due(&self, now: Time, in_round: bool) -> bool {
        self.operates
            && now >= self.control_at
            && (!in_round || now >= self.control_at + self.control_every_ns)
    }

    /// Global_Control was sent.
    pub(super) fn controlled(&mut self, now: Time) {
        self.control_at = now + self.control_every_ns;
    }

    /// The last turn of a round is under way.
    #[inline]
    pub(super) fn end_round(&mut self) {
        self.round_over = self.token || self.gap.is_some();
    }

    /// A round is over.
    #[inline]
    pub(super) fn is_round_over(&self) -> bool {
        self.round_over
    }

    /// The next step after the round, which is done with, if there is time. No search is for a station of the plan.
    pub(super) fn behind_round(&mut self, has_time: bool, is_station: impl Fn(u8) -> bool) -> Option<Behind> {
        self.round_over = false;
        if !has_time {
            return None;
        }
        self.rounds += 1;
        if self.gap.is_some_and(|every| self.rounds >= every) {
            self.rounds = 0;
            for _ in 0..=self.highest {
                let next = self.gap_address + 1;
                self.gap_address = if next >= self.highest { 0 } else { next };
                if self.gap_address != self.own && !is_station(self.gap_address) {
                    return Some(Behind::Gap(self.gap_address));
                }
            }
        }
        self.token.then_some(Behind::Token)
    }
}
