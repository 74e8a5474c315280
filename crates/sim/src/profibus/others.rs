//! What else may be on the wire: a second master, and noise.

use super::link::{request, response};
use super::receiver::Receiver;
use super::settings::{ForeignSettings, LinkSettings, NoiseSettings};
use super::telegram::{self, Frame, Telegram};
use crate::SimSerial;
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::Time;

/// MinTsdr, and the silence behind a token (Tid1), bits.
const MIN_TSDR: u64 = 11;
const IDLE: u64 = 37;
/// Tsl is MaxTsdr and so many bits.
const SLOT: u64 = 16;
/// The station type of a master that waits for the token.
const WITHOUT_TOKEN: u8 = 0x20;
/// The tokens by which a silent wire is claimed.
const CLAIM: u8 = 2;

/// A second master.
#[derive(Debug)]
pub struct ForeignMaster {
    settings: ForeignSettings,
    line: SerialLine,
    receiver: Receiver,
    state: State,
    /// When it acts next. Before its first run: at once, whenever that is.
    next: Option<Time>,
    /// The request that it answers next.
    asked: Option<u8>,
    /// Telegrams that it has sent.
    pub sent: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// It is not there yet.
    Off,
    /// It is not of the kind that listens.
    Talks,
    /// It waits for silence.
    Listens,
    /// So many tokens of its claim have left.
    Claims(u8),
    /// It has the token.
    Holds,
}

impl ForeignMaster {
    pub(super) fn new(settings: ForeignSettings, line: SerialLine) -> ForeignMaster {
        ForeignMaster {
            settings,
            line,
            receiver: Receiver::new(line),
            state: State::Off,
            next: Some(Time(0)),
            asked: None,
            sent: 0,
        }
    }

    fn slot_ns(&self) -> u64 {
        let max_tsdr = LinkSettings::default().max_tsdr(self.line.rate);
        self.line.bits_ns(u64::from(max_tsdr) + SLOT)
    }

    /// It has not sent all that it is to send.
    fn has_more(&self) -> bool {
        self.settings.count.is_none_or(|count| self.sent < count)
    }

    /// It waits for Tto of silence from now on.
    fn listen(&mut self, now: Time) {
        let slots = 6 + 2 * u64::from(self.settings.address);
        (self.state, self.next) = (State::Listens, self.has_more().then(|| now + slots * self.slot_ns()));
    }

    fn begin(&mut self, now: Time) {
        match self.settings.listens {
            true => self.listen(now),
            false => (self.state, self.next) = (State::Talks, Some(now)),
        }
    }

    /// The next of its telegrams.
    fn telegram(&mut self, out: &mut Vec<u8>) {
        let turn = self.settings.telegrams.len().max(1) as u64;
        if let Some(telegram) = self.settings.telegrams.get((self.sent % turn) as usize) {
            out.extend_from_slice(telegram);
        }
        self.sent += 1;
    }

    /// A telegram of somebody else.
    fn received(&mut self, end: Time, bytes: &[u8]) {
        let own = self.settings.address;
        let of_a_master = match telegram::parse(bytes) {
            Ok(Telegram::Token { from, .. }) => from != own,
            Ok(Telegram::Frame(frame)) if frame.is_request() => {
                if frame.to == own && frame.function & 0x0F == request::FDL_STATUS {
                    self.asked = Some(frame.from);
                    self.next = Some(end + self.line.bits_ns(MIN_TSDR));
                }
                frame.from != own
            }
            _ => false,
        };
        if of_a_master && self.asked.is_none() && self.state != State::Listens {
            self.listen(end);
        }
    }
}

impl SimSerial for ForeignMaster {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        if matches!(self.state, State::Off | State::Talks) {
            return;
        }
        if self.state == State::Listens {
            self.asked = None;
            self.listen(now);
        }
        let mut receiver = std::mem::replace(&mut self.receiver, Receiver::new(self.line));
        receiver.take(now, bytes, |end, _, bytes| self.received(end, bytes));
        self.receiver = receiver;
    }

    fn next_due(&self) -> Option<Time> {
        self.next
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        if self.state == State::Off {
            if self.settings.after_ns > 0 {
                self.next = Some(now + std::mem::take(&mut self.settings.after_ns));
                return;
            }
            self.begin(now);
            if self.settings.listens {
                return;
            }
        }
        let own = self.settings.address;
        if let Some(to) = self.asked.take() {
            let function = WITHOUT_TOKEN | response::OK;
            telegram::append(&Frame { to, from: own, saps: (None, None), function, data: &[] }, false, out);
            self.listen(now + self.line.span_ns(out.len()));
            return;
        }
        match self.state {
            State::Listens | State::Claims(_) => {
                let sent = if let State::Claims(sent) = self.state { sent } else { 0 };
                telegram::append_token(own, own, out);
                self.state = if sent + 1 < CLAIM { State::Claims(sent + 1) } else { State::Holds };
            }
            _ => self.telegram(out),
        }
        let pause_ns = match (self.state, out.len()) {
            (State::Talks, _) => self.settings.every_ns.max(1),
            (_, length @ 0..=3) => self.line.span_ns(length) + self.line.bits_ns(IDLE),
            (_, length) => self.line.span_ns(length) + self.slot_ns(),
        };
        self.next = self.has_more().then(|| now + pause_ns);
    }

    fn untimed(&mut self) {
        self.receiver.untimed();
    }

    fn restart(&mut self, _now: Time) {}

    fn open_sto(&mut self, _until: Time) {}
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

    fn open_sto(&mut self, _until: Time) {}
}
