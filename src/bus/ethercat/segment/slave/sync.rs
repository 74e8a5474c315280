//! The clock of a slave: set to the segment's, left to synchronise to it, and SYNC0 made of it.
//!
//! Delays are those of a straight line, whichever port it continues at: behind a branch they are too long by half
//! of the time in the other one. They are relative to the reference of that time. When a slave behind it becomes
//! the reference, all others stay ahead of it by its own delay, about 1 us for each slave between the two, until
//! they are set up again.

use super::{Context, Note, Slave, Step};
use crate::bus::ethercat::segment::clock::delay_ns;
use crate::bus::ethercat::segment::running::near;
use crate::bus::ethercat::wire::registers::{AlState, Difference, Links, address};
use crate::time::{MS, S, Time};

/// It is synchronised when its difference is not larger, for so many looks, each so long after the other; the wait
/// is limited to so long, and to so many cycles: each frame removes a part of the difference.
const SETTLED_NS: i64 = 1_000;
const SETTLED_LOOKS: u8 = 3;
const SETTLE_LOOK_NS: u64 = 10 * MS;
const SETTLE_NS: u64 = 10 * S;
const SETTLE_CYCLES: u64 = 20_000;
/// SYNC0 begins so long after it was set up, and at least so long after it was switched on.
const SYNC_AHEAD_NS: u64 = 100 * MS;
/// That many turns of the slot lie between the two.
const SYNC_TURNS: u64 = 4;
const SYNC_LEFT_NS: u64 = 5 * MS;

/// The offset of its offset register behind the times of its ports.
const OFFSET_AT: usize = (address::DC_OFFSET - address::DC_PORTS) as usize;

impl Slave {
    /// Its clock is the segment's.
    pub(super) fn is_reference(&self, context: &Context<'_>) -> bool {
        context.reference == Some(self.station())
    }

    /// The times of the reference at the latch; `segment_ns`: the segment's, as the master has it.
    pub(super) fn referred(
        &mut self,
        now: Time,
        context: &Context<'_>,
        segment_ns: u64,
        times: &[u8],
        links: &[u8],
    ) {
        let offset = times.get(OFFSET_AT..).and_then(<[u8]>::first_chunk::<8>);
        let segment_ns = match (received_ns(times), offset) {
            // The reference itself is set to the master's value.
            _ if self.is_reference(context) && !context.timed => segment_ns,
            // Its upper half may be missing.
            (Some(received), Some(offset)) => {
                near(segment_ns, received.wrapping_add(u64::from_le_bytes(*offset)) as u32)
            }
            _ => return,
        };
        self.enter(now, Step::OwnTimes { segment_ns, reference_loop_ns: loop_ns(times, links) });
    }

    /// Its own times at the same latch.
    pub(super) fn timed(
        &mut self,
        now: Time,
        context: &Context<'_>,
        segment_ns: u64,
        reference_loop_ns: u32,
        times: &[u8],
        links: &[u8],
    ) {
        let Some(received) = received_ns(times) else { return };
        let own_loop_ns = loop_ns(times, links);
        let is_reference = self.is_reference(context);
        let delay_ns = if is_reference { 0 } else { delay_ns(reference_loop_ns, own_loop_ns) };
        let offset = segment_ns.wrapping_add(delay_ns.into()).wrapping_sub(received);
        self.enter(now, Step::Offset { offset: self.whole(offset), delay_ns });
    }

    pub(super) fn settled(&mut self, context: &Context<'_>, good: u8, data: &[u8]) {
        let now = context.cycle.grid;
        let limit_ns = SETTLE_NS.max(context.cycle.period_ns.saturating_mul(SETTLE_CYCLES));
        let Some(bytes) = data.first_chunk::<4>() else { return };
        let off = Difference(u32::from_le_bytes(*bytes)).ns();
        let good = if off.abs() <= SETTLED_NS { good + 1 } else { 0 };
        if good >= SETTLED_LOOKS {
            self.enter(now, Step::SegmentTime);
        } else if now.since(self.since) > limit_ns {
            self.refuse(now, Note::Unsettled);
        } else {
            self.step = Step::Settle { good, next: now + SETTLE_LOOK_NS };
        }
    }

    /// Its own time, as this frame read it.
    pub(super) fn segment_time(&mut self, now: Time, context: &Context<'_>, data: &[u8]) {
        let Some(own) = data.first_chunk::<8>().map(|bytes| u64::from_le_bytes(*bytes)) else { return };
        let segment_ns = near(context.clock.time(context.cycle, context.sent_at), own as u32);
        let ahead_ns = own.wrapping_sub(segment_ns);
        let segment_ns = context.clock.sync_from(segment_ns.wrapping_add(sync_ahead_ns(context)));
        self.enter(now, Step::SyncStart { ahead_ns, segment_ns });
    }

    /// The start of SYNC0 by its own clock.
    pub(super) fn sync_start(&self, ahead_ns: u64, segment_ns: u64) -> u64 {
        self.whole(segment_ns.wrapping_add(ahead_ns))
    }

    /// SYNC0 was switched on: its start must lie ahead, or there is none.
    pub(super) fn sync_on(&mut self, now: Time, context: &Context<'_>, segment_ns: u64) {
        let left = segment_ns.wrapping_sub(context.clock.time(context.cycle, context.sent_at)) as i64;
        let in_time = left > SYNC_LEFT_NS as i64;
        self.enter(now, if in_time { Step::to(AlState::SafeOp) } else { Step::SegmentTime });
    }

    /// A time that its clock can have.
    fn whole(&self, ns: u64) -> u64 {
        if self.features.has_long_clock() { ns } else { u64::from(ns as u32) }
    }

    /// The values written to its delay and offset were accepted.
    pub(super) fn offset_set(&mut self, now: Time) {
        self.clock_set = true;
        self.enter(now, Step::Filter);
    }

    /// The registers of its clock at the latch: to the end of its offset.
    pub(super) const TIMES: (u16, usize) = (address::DC_PORTS, OFFSET_AT + 8);
}

/// How long before its begin SYNC0 is set up.
pub(super) fn sync_ahead_ns(context: &Context<'_>) -> u64 {
    SYNC_AHEAD_NS + SYNC_TURNS * context.turn_ns
}

/// When the processing unit received the latch, by the slave's own clock.
fn received_ns(times: &[u8]) -> Option<u64> {
    let at = usize::from(address::DC_RECEIVED - address::DC_PORTS);
    times.get(at..)?.first_chunk::<8>().map(|bytes| u64::from_le_bytes(*bytes))
}

/// From the first port to the last open one: how long a frame is under way behind this slave; 0: there is no slave.
fn loop_ns(times: &[u8], links: &[u8]) -> u32 {
    let links = Links(links.first_chunk::<2>().map_or(0, |bytes| u16::from_le_bytes(*bytes)));
    let port = |n: u8| {
        let bytes = times.get(4 * usize::from(n)..)?.first_chunk::<4>();
        bytes.map(|bytes| u32::from_le_bytes(*bytes))
    };
    let Some(first) = port(0) else { return 0 };
    let behind = (1..4).filter(|n| links.link(*n) && links.open(*n));
    behind.filter_map(port).map(|back| back.wrapping_sub(first)).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_under_way_behind_a_slave_until_it_is_back_at_the_last_open_port() {
        let mut times = [0; 0x28];
        for (n, time) in [(0, u32::MAX - 99), (1, 200_u32), (2, 777), (3, 900)] {
            times[4 * n..4 * n + 4].copy_from_slice(&time.to_le_bytes());
        }
        let links = |open: &[u16]| {
            let closed = [0, 1, 2, 3].into_iter().filter(|n| !open.contains(n)).map(|n| 1 << (8 + 2 * n));
            (open.iter().map(|n| 1 << (4 + n)).sum::<u16>() | closed.sum::<u16>()).to_le_bytes()
        };
        for (open, wanted) in
            [(&[0_u16][..], 0), (&[0, 1], 300), (&[0, 2], 877), (&[0, 3], 1_000), (&[0, 1, 3], 1_000)]
        {
            assert_eq!(loop_ns(&times, &links(open)), wanted, "{open:?}");
        }
        assert_eq!(loop_ns(&times[..3], &links(&[0, 1])) + loop_ns(&times, &[]), 0);
    }
}
