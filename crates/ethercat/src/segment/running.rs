//! A slave that runs on a clock that another master has set, or this one before it was restarted.
//! The segment's time goes to all slaves with a clock. For a configured slave that is found in OP it must be the time
//! that it runs on: any other time would move its clock, and a drive goes into a fault by that (F28).

use crate::slot::{Answers, Ask};
use crate::wire::frame::Command;
use crate::wire::registers::address;

/// From the cyclic unit to the cycle of SYNC0.
pub(super) const SYNC: usize = (address::DC_CYCLE - address::DC_CONTROL) as usize + 4;
/// Cyclic operation, and SYNC0.
const CYCLIC: u8 = 1;
const SYNC0: u8 = 2;

/// The state of its cyclic unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sync0 {
    active: u8,
    /// The period of SYNC0, ns.
    cycle_ns: u32,
}

impl Sync0 {
    /// Of the registers from the cyclic unit to the cycle of SYNC0; `None`: they are too short.
    pub fn new(data: &[u8]) -> Option<Sync0> {
        let cycle = data.first_chunk::<SYNC>()?.last_chunk::<4>()?;
        Some(Sync0 { active: data[1], cycle_ns: u32::from_le_bytes(*cycle) })
    }

    /// It acts at times of its clock.
    pub fn is_cyclic(self) -> bool {
        self.active & CYCLIC != 0
    }

    /// The SYNC0 has this period. Where in a period it comes is left to it: outputs count from the next one on.
    pub fn has_period(self, period_ns: u64) -> bool {
        self.active & (CYCLIC | SYNC0) == CYCLIC | SYNC0 && u64::from(self.cycle_ns) == period_ns
    }
}

/// The state of its clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Running {
    /// The cyclic unit.
    pub sync: Sync0,
    /// The time as the frame passed it: the lower half.
    pub time: u32,
}

impl Running {
    /// Requests it, with a command that reaches the slave at a register.
    pub fn request(read: impl Fn(u16) -> Command, ask: &mut Ask) {
        ask.read(read(address::DC_CONTROL), SYNC);
        ask.read(read(address::DC_TIME), 8);
    }

    /// Takes the answer.
    pub fn receive(answers: &Answers<'_>) -> Option<Running> {
        let [Some(sync), Some(time)] = answers else { return None };
        let time = u32::from_le_bytes(*time.data.first_chunk::<4>()?);
        Some(Running { sync: Sync0::new(sync.data)?, time })
    }
}

/// The time that has this lower half and is nearest to `segment_ns`.
pub fn near(segment_ns: u64, half: u32) -> u64 {
    segment_ns.wrapping_add(i64::from(half.wrapping_sub(segment_ns as u32) as i32) as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slot::Answer;

    #[test]
    fn half_a_time_is_made_whole_near_to_the_one_that_is_known() {
        for segment in [0_u64, 5, 0xFFFF_FFFF, 0x1_0000_0000, 0x7_8000_0000] {
            for off in [-2_000_000_000_i64, -1, 0, 1, 2_000_000_000] {
                let time = segment.wrapping_add(off as u64);
                assert_eq!(near(segment, time as u32), time);
            }
        }
    }

    #[test]
    fn a_datagram_that_is_too_short_is_no_clock_sample() {
        let answers = |sync, time| {
            let of = |data| Some(Answer { working_counter: 1, data });
            [of(sync), of(time)]
        };
        let mut sync = [0; SYNC];
        sync[1] = 3;
        let running = Running::receive(&answers(&sync, &[1, 2, 0, 0])).unwrap();
        assert_eq!((running.sync.is_cyclic(), running.time), (true, 0x0201));
        assert!(running.sync.has_period(0) && !running.sync.has_period(1));
        assert_eq!(Running::receive(&answers(&sync[..SYNC - 1], &[0; 8])), None);
        assert_eq!(Running::receive(&answers(&sync, &[0; 3])), None);
        assert_eq!(Running::receive(&[None, None]), None);
    }
}
