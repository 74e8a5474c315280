//! The clock of a world: time passes when it is read.

use super::*;

/// The clock of a [`World`].
#[derive(Clone, Debug)]
pub struct WorldClock(pub(super) World);

impl Clock for WorldClock {
    fn now(&mut self) -> Time {
        self.0.lock().read()
    }

    fn sleep_until(&mut self, at: Time) {
        let mut inner = self.0.lock();
        let late = std::mem::take(&mut inner.hold_up_ns) + if at > inner.now { inner.wake_late() } else { 0 };
        let at = at.max(inner.now) + late;
        inner.run(at);
    }

    /// Every carrier of the world counts as in `set`: none of them has a descriptor.
    fn wait(&mut self, _set: &mut PollSet, until: Time) -> bool {
        let mut inner = self.0.lock();
        let begin = inner.now;
        let arrived = loop {
            let datagram = inner.ports.iter().any(|port| !port.inbox.is_empty());
            if datagram
                || inner.links.readable()
                || inner.segments.readable()
                || inner.wires.readable(inner.now)
            {
                break true;
            }
            match inner.next_due() {
                Some(due) if due <= until.max(inner.now) => inner.run(due),
                _ => break false,
            }
        };
        let end = if arrived { inner.now } else { inner.now.max(until) };
        let late = if end > begin { inner.wake_late() } else { 0 };
        inner.run(end + late);
        arrived
    }

    fn spin(&mut self) {
        let mut inner = self.0.lock();
        let at = inner.now + SPIN_NS;
        inner.run(at);
    }

    fn spin_until(&mut self, at: Time) -> Time {
        let mut inner = self.0.lock();
        let at = at.max(inner.now);
        inner.run(at);
        inner.read()
    }

    fn suspended_ns(&mut self) -> u64 {
        self.0.lock().suspended_ns
    }
}
