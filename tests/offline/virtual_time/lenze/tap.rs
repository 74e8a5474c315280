//! A simulated drive that the world and the test share, with what was said to it; and a voice of the test on the wire.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::bus::profibus::Bits;
use fieldbeat::sim::{SerialWire, SimSerial};
use fieldbeat::time::Time;
use fieldbeat_core::net::SerialLine;
use fieldbeat_sim::profibus::{LenzeSettings, LenzeSim, ProfibusSegment};

/// Bit 6 of a function code: a request.
const REQUEST: u8 = 1 << 6;
/// Bit 7 of an address: a service access point follows.
const WITH_SAPS: u8 = 1 << 7;
/// MinTsdr, bits.
const MIN_TSDR: u64 = 11;

/// A drive, and what happens to its telegrams.
pub struct Shared {
    pub drive: LenzeSim,
    address: u8,
    /// It neither receives nor sends.
    pub unplugged: bool,
    /// So many requests to it, or answers of it, are still to be lost; and to be broken.
    pub lose: [u32; 2],
    pub spoil: [u32; 2],
    /// Of each two answers in turn it loses the first one, so that each request is repeated.
    pub flaky: bool,
    /// It answers as late as it may, and breaks its answers to a request that was repeated less often than so.
    pub slow: Option<u8>,
    /// Its last request, and how often that was repeated.
    request: (Vec<u8>, u8),
    /// So much later than by itself it answers, if it is slow.
    late_ns: u64,
    /// It answers Data_Exchange with its last answer to one, and takes nothing of it.
    pub frozen: bool,
    /// That answer begins then.
    due: Option<Time>,
    /// Its last answer to Data_Exchange.
    pub answer: Vec<u8>,
    /// Answers that the test sent in its name.
    pub forged: u64,
    /// Masters of it that died.
    pub died: u64,
    odd: bool,
    line: SerialLine,
    /// Requests to it that left the master, and when the last byte did, if they are recorded.
    pub requests: Option<Vec<(Time, Vec<u8>)>>,
}

/// The drive as the world has it, and as the test has it.
#[derive(Clone)]
pub struct Tap(Arc<Mutex<Shared>>);

impl Tap {
    pub fn lock(&self) -> MutexGuard<'_, Shared> {
        self.0.lock().unwrap()
    }
}

impl Shared {
    /// From now on it answers so much later than by itself.
    pub fn answer_late(&mut self, late_ns: u64) {
        (self.slow, self.late_ns) = (Some(0), late_ns);
    }
}

fn take(left: &mut u32) -> bool {
    let takes = *left > 0;
    *left -= u32::from(takes);
    takes
}

impl SimSerial for Tap {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        let mut shared = self.lock();
        let shared = &mut *shared;
        let is_own = matches!(bytes, [0x68, _, _, _, da, _, fc, ..]
            if da & 0x7F == shared.address && fc & REQUEST != 0);
        if is_own {
            let again = shared.request.0 == bytes;
            let repeated = if again { shared.request.1.saturating_add(1) } else { 0 };
            shared.request = (bytes.to_vec(), repeated);
        }
        if is_own && let Some(requests) = &mut shared.requests {
            requests.push((now, bytes.to_vec()));
        }
        if shared.unplugged || is_own && take(&mut shared.lose[0]) {
            return;
        }
        if shared.frozen && is_own && bytes[4] & WITH_SAPS == 0 {
            shared.due = Some(now + shared.line.bits_ns(MIN_TSDR));
            return;
        }
        if is_own && take(&mut shared.spoil[0]) {
            let mut broken = bytes.to_vec();
            broken[bytes.len() / 2] ^= 0x10;
            return shared.drive.receive(now, &broken);
        }
        shared.drive.receive(now, bytes);
    }

    fn next_due(&self) -> Option<Time> {
        let shared = self.lock();
        let late_ns = if shared.slow.is_some() { shared.late_ns } else { 0 };
        let by_itself = shared.drive.next_due().map(|due| due + late_ns);
        [by_itself, shared.due].into_iter().flatten().min()
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        let mut shared = self.lock();
        let shared = &mut *shared;
        let begin = out.len();
        if shared.due.take_if(|due| *due <= now).is_some() {
            return out.extend_from_slice(&shared.answer);
        }
        shared.drive.run(now, out);
        if out.len() == begin {
            return;
        }
        if out.get(begin + 4).is_some_and(|da| da & WITH_SAPS == 0) {
            shared.answer = out[begin..].to_vec();
        }
        shared.odd = !shared.odd;
        let breaks = shared.slow.is_some_and(|whole_from| shared.request.1 < whole_from);
        if shared.unplugged || shared.flaky && shared.odd || take(&mut shared.lose[1]) {
            out.truncate(begin);
        } else if breaks || take(&mut shared.spoil[1]) {
            let middle = (begin + out.len()) / 2;
            out[middle] ^= 0x10;
        }
    }

    fn restart(&mut self, now: Time) {
        self.lock().drive.restart(now);
    }

    fn open_sto(&mut self, until: Time) {
        self.lock().drive.open_sto(until);
    }
}

/// Telegrams, and when each is to be sent.
type Sayings = VecDeque<(Time, Vec<u8>)>;

/// Sends what the test wants on the wire, whoever speaks there.
#[derive(Clone, Default)]
pub struct Voice(Arc<Mutex<Sayings>>);

impl Voice {
    /// Sends `bytes` at `at`, in the order of the calls.
    pub fn say(&self, at: Time, bytes: &[u8]) {
        self.0.lock().unwrap().push_back((at, bytes.to_vec()));
    }
}

impl SimSerial for Voice {
    fn receive(&mut self, _: Time, _: &[u8]) {}

    fn next_due(&self) -> Option<Time> {
        self.0.lock().unwrap().front().map(|(at, _)| *at)
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        let mut sayings = self.0.lock().unwrap();
        if sayings.front().is_some_and(|(at, _)| *at <= now) {
            out.extend(sayings.pop_front().into_iter().flat_map(|(_, bytes)| bytes));
        }
    }

    fn restart(&mut self, _: Time) {}

    fn open_sto(&mut self, _: Time) {}
}

/// The drives of a wire, and the voice on it.
#[derive(Clone)]
pub struct TapWire {
    pub drives: Vec<Tap>,
    pub voice: Voice,
    segment: ProfibusSegment,
}

impl TapWire {
    pub fn new(segment: ProfibusSegment) -> TapWire {
        let line = segment.wire().line;
        let max_tsdr = Bits::usual(line.rate).max_tsdr;
        let late_ns = line.bits_ns(max_tsdr.into()) - line.bits_ns(MIN_TSDR);
        let drive = |settings: &LenzeSettings| {
            Tap(Arc::new(Mutex::new(Shared {
                drive: LenzeSim::new(settings, line),
                address: settings.address,
                unplugged: false,
                lose: [0; 2],
                spoil: [0; 2],
                flaky: false,
                slow: None,
                request: (Vec::new(), 0),
                late_ns,
                frozen: false,
                due: None,
                answer: Vec::new(),
                forged: 0,
                died: 0,
                odd: false,
                line,
                requests: None,
            })))
        };
        TapWire { drives: segment.drives.iter().map(drive).collect(), voice: Voice::default(), segment }
    }

    /// The wire for a world.
    pub fn wire(&self) -> SerialWire {
        let drives = self.drives.iter().map(|drive| Box::new(drive.clone()) as Box<dyn SimSerial>);
        let voice = Box::new(self.voice.clone()) as Box<dyn SimSerial>;
        SerialWire { drives: drives.chain([voice]).collect(), ..self.segment.wire() }
    }
}
