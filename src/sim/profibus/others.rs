//! What else may be on the wire: a second master, and noise. Both are devices that only send.

use super::settings::{ForeignSettings, NoiseSettings};
use crate::sim::SimSerial;
use crate::time::Time;

/// A second master. It sends at its own times, whatever is on the wire.
#[derive(Debug)]
pub struct ForeignMaster {
    settings: ForeignSettings,
    /// Before its first run: at once, whenever that is.
    next: Option<Time>,
    begun: bool,
    /// Telegrams that it has sent.
    pub sent: u64,
}

impl ForeignMaster {
    pub(super) fn new(settings: ForeignSettings) -> ForeignMaster {
        ForeignMaster { settings, next: Some(Time(0)), begun: false, sent: 0 }
    }
}

impl SimSerial for ForeignMaster {
    fn receive(&mut self, _now: Time, _bytes: &[u8]) {}

    fn next_due(&self) -> Option<Time> {
        self.next
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        if !std::mem::replace(&mut self.begun, true) && self.settings.after_ns > 0 {
            self.next = Some(now + self.settings.after_ns);
            return;
        }
        let turn = self.settings.telegrams.len().max(1) as u64;
        if let Some(telegram) = self.settings.telegrams.get((self.sent % turn) as usize) {
            out.extend_from_slice(telegram);
        }
        self.sent += 1;
        let more = self.settings.count.is_none_or(|count| self.sent < count);
        self.next = more.then(|| now + self.settings.every_ns.max(1));
    }

    fn restart(&mut self, _now: Time) {}

    fn inhibit(&mut self, _until: Time) {}
}

/// Random bytes at random times.
#[derive(Debug)]
pub struct Noise {
    settings: NoiseSettings,
    random: fastrand::Rng,
    /// `None` before its first run.
    next: Option<Time>,
    /// Bursts so far.
    pub bursts: u64,
}

impl Noise {
    pub(super) fn new(settings: NoiseSettings) -> Noise {
        Noise { settings, random: fastrand::Rng::with_seed(settings.seed), next: None, bursts: 0 }
    }
}

impl SimSerial for Noise {
    fn receive(&mut self, _now: Time, _bytes: &[u8]) {}

    fn next_due(&self) -> Option<Time> {
        Some(self.next.unwrap_or_default())
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        if self.next.is_some() {
            let count = self.random.u8(1..=self.settings.bytes.max(1));
            out.extend((0..count).map(|_| self.random.u8(..)));
            self.bursts += 1;
        }
        let pause_ns = self.random.u64(1..=self.settings.every_ns.max(1).saturating_mul(2));
        self.next = Some(now + pause_ns);
    }

    fn restart(&mut self, _now: Time) {}

    fn inhibit(&mut self, _until: Time) {}
}
