//! Watches the application's sign of life.

use crate::axis::Pulse;
use crate::bus::Cycle;
use crate::inputs::InputLog;
use crate::rt::Regions;

/// Counts the slots since the application's last beat.
#[derive(Debug)]
pub struct Heartbeat {
    pulse: Pulse,
    log: InputLog,
    /// The most slots without a beat; `None`: not watched.
    most: Option<u64>,
    beats: u64,
    /// The slot in which the last beat was seen.
    beaten_at: u64,
}

impl Heartbeat {
    /// A watch over `pulse` that allows `limit_ns` without a beat.
    pub fn new(pulse: Pulse, log: InputLog, limit_ns: Option<u64>, period_ns: u64) -> Heartbeat {
        let most = limit_ns.map(|limit| limit.div_ceil(period_ns.max(1)));
        Heartbeat { beats: pulse.count(), pulse, log, most, beaten_at: 0 }
    }

    /// The memory that it touches besides itself.
    pub fn memory(&self, regions: &mut Regions) {
        self.pulse.memory(regions);
    }

    /// Whether the application was silent for too long; called once a cycle.
    pub fn is_silent(&mut self, cycle: &Cycle) -> bool {
        let Some(most) = self.most else { return false };
        let beats = self.log.value(self.beats, self.pulse.count());
        if beats != self.beats {
            (self.beats, self.beaten_at) = (beats, cycle.index);
        }
        cycle.index - self.beaten_at > most
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::{MS, Time};

    #[test]
    fn silence_is_counted_in_slots_and_ends_with_a_beat() {
        let pulse = Pulse::default();
        let mut watch = Heartbeat::new(pulse.clone(), InputLog::default(), Some(5 * MS), 2 * MS);
        let at = |index| Cycle { index, grid: Time(0), period_ns: 2 * MS, deadline: Time(0) };
        assert!(!watch.is_silent(&at(3)));
        assert!(watch.is_silent(&at(4)));
        pulse.beat();
        assert!(!watch.is_silent(&at(5)) && !watch.is_silent(&at(8)) && watch.is_silent(&at(9)));
        assert!(!Heartbeat::new(pulse, InputLog::default(), None, MS).is_silent(&at(u64::MAX)));
    }
}
