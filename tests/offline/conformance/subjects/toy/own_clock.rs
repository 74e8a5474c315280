//! The toy that sends by its own clock, as a drive on EtherNet/IP does: its packets have numbers of their own and
//! answer nothing.
//!
//! A simulated drive speaks here only when it is sent something, so that several packets between two requests are the
//! suite's to inject.

use fieldbeat::time::Time;
use fieldbeat_core::bus::contract::Notices;
use fieldbeat_core::bus::{Exchange, Slot};

use super::{Answer, Defect, Station};
use crate::conformance::line::PERIOD;

/// From one packet to the next, a little more than a cycle: now and then none comes between two requests.
const INTERVAL: u64 = PERIOD + PERIOD / 16;

/// A packet counts for so long: for up to five exchanges.
pub(super) const FRESH_WITHIN: u64 = 9 * PERIOD / 2;

/// The packets of one drive.
#[derive(Default)]
pub(super) struct Packets {
    number: u8,
    next: Time,
}

impl Packets {
    /// The number of the packet that is due at `now`, if one is.
    pub(super) fn due(&mut self, now: Time) -> Option<u8> {
        if now < self.next {
            return None;
        }
        self.next = Time((now.0 / INTERVAL + 1) * INTERVAL);
        self.number = self.number.wrapping_add(1);
        Some(self.number)
    }
}

impl Station {
    /// The exchange of a request that has left.
    pub(super) fn exchange(&self, sent_at: Time, notices: &mut Notices) -> Exchange {
        notices.fresh |= self.is(Defect::IsFreshWithEachExchange);
        Exchange::OwnClock { sent_at, fresh_until: self.fresh_until }
    }

    /// Takes a packet in, if it is the newest. Its number is the `sequence`.
    pub(super) fn accept(&mut self, at: Time, packet: &Answer, slot: &mut Slot) {
        // After a silence of that length a connection is opened anew, and its first packet has any number.
        let opened = at >= self.fresh_until || self.is(Defect::TakesOlderPackets);
        match packet.sequence.wrapping_sub(self.answer.sequence).cast_signed() {
            1.. => {}
            _ if opened => {}
            0 => {
                slot.counters.duplicate += 1;
                return;
            }
            _ => {
                slot.counters.late += 1;
                return;
            }
        }
        self.fresh_until =
            at + if self.is(Defect::IsNeverTooOld) { 1_000_000 * PERIOD } else { FRESH_WITHIN };
        if let Exchange::OwnClock { fresh_until, .. } = &mut slot.exchange {
            *fresh_until = self.fresh_until;
        }
        self.read(at, packet, slot);
    }
}
