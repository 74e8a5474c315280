//! The drive's own packets, by its own clock.
//!
//! Facts: sheet, 3.1 to 3.3. The first one goes at once after the open; one that is late goes once, and those that it
//! has missed do not go at all.

use std::net::SocketAddrV4;

use super::connections::{Like, packet_size};
use super::items::item;
use super::settings::ClockSettings;
use fieldbeat_core::time::{Time, US};

/// The packets of one input assembly to one destination.
#[derive(Debug)]
pub(super) struct Producer {
    pub key: u32,
    pub id: u32,
    pub input: u8,
    pub to: SocketAddrV4,
    pub api_us: u32,
    pub like: Like,
    clock: ClockSettings,
    random: fastrand::Rng,
    begun: Time,
    /// Which packet of its schedule is next, and how late that one is.
    place: u64,
    late_ns: u64,
    /// How many it has sent.
    sent: u32,
}

impl Producer {
    #[allow(clippy::too_many_arguments, reason = "one call, with what an open has decided")]
    pub(super) fn new(
        key: u32,
        id: u32,
        input: u8,
        to: SocketAddrV4,
        api_us: u32,
        like: Like,
        clock: ClockSettings,
        now: Time,
    ) -> Producer {
        Producer {
            key,
            id,
            input,
            to,
            api_us,
            like,
            random: fastrand::Rng::with_seed(clock.seed ^ u64::from(key).rotate_left(32)),
            clock,
            begun: now,
            place: 0,
            late_ns: 0,
            sent: 0,
        }
    }

    /// Its interval by the true time, ns.
    fn interval(&self) -> f64 {
        f64::from(self.api_us) * US as f64 * (1.0 + f64::from(self.clock.drift_ppm) / 1e6)
    }

    fn at(&self, place: u64) -> Time {
        self.begun + (place as f64 * self.interval()).round() as u64
    }

    /// When the next one leaves.
    pub(super) fn due(&self) -> Time {
        self.at(self.place) + self.late_ns
    }

    /// The next one, if it is due: what is in front of the data.
    pub(super) fn packet(&mut self, now: Time, out: &mut Vec<u8>) -> bool {
        if self.due() > now {
            return false;
        }
        let passed = (now.since(self.begun) as f64 / self.interval()) as u64;
        self.place = (self.place + 1).max(passed);
        while self.at(self.place) <= now {
            self.place += 1;
        }
        let most = self.clock.jitter_ns.min((self.interval() as u64).saturating_sub(1));
        self.late_ns = if most == 0 { 0 } else { self.random.u64(0..=most) };
        self.sent = self.sent.wrapping_add(1);
        header(self.id, self.sent, self.sent as u16, packet_size(self.input), out);
        true
    }
}

/// What is in front of the data of a class 1 packet; `size` counts from the sequence count on.
pub(super) fn header(id: u32, sequence: u32, count: u16, size: usize, out: &mut Vec<u8>) {
    out.extend([2, 0]);
    out.extend(item::SEQUENCED_ADDRESS.to_le_bytes());
    out.extend([8, 0]);
    out.extend(id.to_le_bytes());
    out.extend(sequence.to_le_bytes());
    out.extend(item::CONNECTED_DATA.to_le_bytes());
    out.extend((size as u16).to_le_bytes());
    out.extend(count.to_le_bytes());
}
