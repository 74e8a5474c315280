//! The slaves on their wire in plain time, with a master that is a list of telegrams.

mod acyclic;
mod channel;
mod drive;
mod exchange;
mod link;
mod slave;
mod wire;

use std::any::Any;

use super::*;
use crate::serial::Medium;
use crate::testing::hex;
use fieldbeat_core::time::MS;

const MASTER: u8 = 2;
const SLAVE: u8 = 7;
/// The bit rates of PROFIBUS DP.
const RATES: [u32; 10] =
    [9_600, 19_200, 45_450, 93_750, 187_500, 500_000, 1_500_000, 3_000_000, 6_000_000, 12_000_000];
const START: Time = Time(1_000_000_000);

/// A wire and a master at it.
struct Bench {
    medium: Medium,
    line: SerialLine,
    now: Time,
    /// The bit of the next request; `None`: the first one to come.
    fcb: Option<bool>,
    master: u8,
    slave: u8,
}

/// An answer on the wire.
#[derive(Debug, PartialEq, Eq)]
struct Reply {
    bytes: Vec<u8>,
    /// From the end of the request to the begin of the answer, ns.
    after: u64,
}

impl Bench {
    fn of(segment: &ProfibusSegment) -> Bench {
        Bench::since(START, segment)
    }

    /// The wire begins at `now`.
    fn since(now: Time, segment: &ProfibusSegment) -> Bench {
        let (medium, line) = (Medium::new(segment.wire()), segment.line());
        let mut bench = Bench { medium, line, now, fcb: None, master: MASTER, slave: SLAVE };
        bench.run(now);
        bench
    }

    /// One slave at a rate.
    fn at(rate: u32, settings: LenzeSettings) -> Bench {
        Bench::of(&ProfibusSegment::new("/dev/ttyS1", rate, vec![settings]))
    }

    fn with(change: impl FnOnce(&mut LenzeSettings)) -> Bench {
        let mut settings = LenzeSettings::new(SLAVE);
        change(&mut settings);
        Bench::at(500_000, settings)
    }

    /// The same, in Data_Exchange and in Operate.
    fn online(change: impl FnOnce(&mut LenzeSettings)) -> Bench {
        let mut bench = Bench::with(change);
        bench.up();
        bench
    }

    fn sim(&mut self, place: usize) -> &mut LenzeSim {
        let drive: &mut dyn Any = &mut *self.medium.wire.drives[place];
        drive.downcast_mut().unwrap()
    }

    fn slave(&mut self) -> &mut LenzeSim {
        let place = self.medium.wire.drives.iter().position(|drive| {
            let drive: &dyn Any = &**drive;
            drive.downcast_ref::<LenzeSim>().is_some_and(|sim| sim.link.address() == self.slave)
        });
        self.sim(place.unwrap())
    }

    fn run(&mut self, to: Time) {
        while self.medium.step(to, &mut |_, _, _| ()) {}
        self.now = to;
    }

    fn wait(&mut self, ns: u64) {
        self.run(self.now + ns);
    }

    /// Sends bytes now; they have ended afterwards.
    fn put(&mut self, bytes: &[u8]) {
        assert_eq!(self.medium.write(self.now, bytes), bytes.len());
        self.wait(self.line.span_ns(bytes.len()));
    }

    /// What the master receives, if it begins within so long from now; behind it the wire is silent for 33 bits.
    fn take(&mut self, ns: u64) -> Option<Reply> {
        let (begin, mut bytes, mut first) = (self.now, Vec::new(), None);
        let mut end = begin + ns;
        while self.now < end {
            let due = self.medium.next_due().map_or(end, |due| due.min(end));
            self.run(due);
            let mut room = [0; 300];
            let count = self.medium.read(due, &mut room);
            if count > 0 {
                first.get_or_insert(due - self.line.span_ns(count));
                end = due + self.line.bits_ns(33);
            }
            bytes.extend_from_slice(&room[..count]);
        }
        first.map(|first| Reply { after: first.since(begin), bytes })
    }

    /// Sends a telegram behind Tsyn, and waits for its answer for a long slot time.
    fn ask(&mut self, bytes: &[u8]) -> Option<Vec<u8>> {
        self.wait(self.line.bits_ns(33));
        self.put(bytes);
        let slot = self.line.bits_ns(2_000) + self.line.span_ns(255);
        self.take(slot).map(|reply| reply.bytes)
    }

    /// A telegram as SD1 or SD2.
    fn frame(&self, saps: Option<(u8, u8)>, function: u8, data: &[u8]) -> Vec<u8> {
        let mark = if saps.is_some() { 0x80 } else { 0 };
        let mut body = vec![self.slave | mark, self.master | mark, function];
        body.extend(saps.into_iter().flat_map(|(to, from)| [to, from]));
        body.extend_from_slice(data);
        let length = body.len() as u8;
        let sum = body.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
        let head = if length == 3 { vec![0x10] } else { vec![0x68, length, length, 0x68] };
        [head, body, vec![sum, 0x16]].concat()
    }

    /// An SRD with the next frame count bit, and its answer: function code and data behind the access points.
    fn srd(&mut self, saps: Option<(u8, u8)>, data: &[u8]) -> Option<(u8, Vec<u8>)> {
        let function = match self.fcb {
            None => 0x6D,
            Some(true) => 0x7D,
            Some(false) => 0x5D,
        };
        self.fcb = Some(!self.fcb.unwrap_or(true));
        let frame = self.frame(saps, function, data);
        self.ask(&frame).map(|bytes| self.open(&bytes, saps))
    }

    /// Function code and data of an answer, which has to be whole and of this slave.
    fn open(&self, bytes: &[u8], saps: Option<(u8, u8)>) -> (u8, Vec<u8>) {
        if bytes == [0xE5] {
            return (0xE5, vec![]);
        }
        let head = if bytes[0] == 0x68 { 4 } else { 1 };
        let [body @ .., sum, 0x16] = &bytes[head..] else { panic!("{bytes:02X?}") };
        assert_eq!(body.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)), *sum, "{bytes:02X?}");
        if bytes[0] == 0x68 {
            assert_eq!((bytes[1], bytes[2], bytes[3]), (body.len() as u8, body.len() as u8, 0x68));
        }
        assert_eq!((body[0] & 0x7F, body[1] & 0x7F), (self.master, self.slave), "{bytes:02X?}");
        match saps.filter(|_| body[0] & 0x80 != 0) {
            Some((to, from)) => {
                assert_eq!((body[3], body[4]), (from, to), "{bytes:02X?}");
                (body[2], body[5..].to_vec())
            }
            None => (body[2], body[3..].to_vec()),
        }
    }

    fn diagnose(&mut self) -> Vec<u8> {
        let (function, data) = self.srd(Some((60, 62)), &[]).unwrap();
        assert_eq!(function, 8);
        data
    }

    fn set_prm(&mut self, data: &[u8]) -> u8 {
        self.srd(Some((61, 62)), data).unwrap().0
    }

    fn chk_cfg(&mut self, data: &[u8]) -> u8 {
        self.srd(Some((62, 62)), data).unwrap().0
    }

    fn control(&mut self, command: u8, groups: u8) {
        let slave = std::mem::replace(&mut self.slave, 127);
        let frame = self.frame(Some((58, 62)), 0x46, &[command, groups]);
        self.slave = slave;
        assert_eq!(self.ask(&frame), None);
    }

    fn exchange(&mut self, data: &[u8]) -> (u8, Vec<u8>) {
        self.srd(None, data).unwrap()
    }

    /// Parametrised, and so configured.
    fn configured(&mut self, prm: &[u8], configuration: &[u8]) {
        assert_eq!((self.set_prm(prm), self.chk_cfg(configuration)), (0xE5, 0xE5));
        self.wait(2 * MS);
    }

    /// Another master asks from now on. The one before is returned, which may go on.
    fn master(&mut self, master: (u8, Option<bool>)) -> (u8, Option<bool>) {
        let before = (self.master, self.fcb);
        (self.master, self.fcb) = master;
        before
    }

    /// In Data_Exchange, and in Operate.
    fn up(&mut self) {
        self.diagnose();
        self.configured(&PRM, &[0xF3, 0xF1]);
        let diagnosis = self.diagnose();
        assert_eq!([diagnosis[0] & !8, diagnosis[1], diagnosis[3]], [0, 0x0C, self.master]);
        self.control(0, 0);
        assert_eq!(self.slave().misuse(), Misuse::default());
    }

    /// An exchange of the two words, without a job: status word and actual value.
    fn words(&mut self, control: u16, set_point: i16) -> (u16, i16) {
        self.cycle([0; 8], control, set_point).1
    }

    /// An exchange with a job.
    fn cycle(&mut self, job: [u8; 8], control: u16, set_point: i16) -> ([u8; 8], (u16, i16)) {
        let words = [control.to_be_bytes(), set_point.to_be_bytes()].concat();
        let (function, data) = self.exchange(&[&job[..], &words].concat());
        assert!(matches!(function, 8 | 0xA), "{function:X}");
        let word = |at: usize| u16::from_be_bytes([data[at], data[at + 1]]);
        (data[..8].try_into().unwrap(), (word(8), word(10).cast_signed()))
    }

    /// Enabled at standstill.
    fn enable(&mut self) {
        for word in [0x06, 0x07, 0x0F, 0x7F] {
            self.words(word, 0);
        }
        assert_eq!(self.slave().axis_state(), State::OperationEnabled);
    }

    /// Exchanges with these words for so long.
    fn hold(&mut self, ns: u64, control: u16, set_point: i16) -> (u16, i16) {
        let end = self.now + ns;
        loop {
            let words = self.words(control, set_point);
            if self.now >= end {
                return words;
            }
            self.wait(4 * MS);
        }
    }

    fn rpm(&mut self) -> f64 {
        let now = self.now;
        self.slave().truth(now).velocity * 60.0
    }
}

/// Lock, watchdog of 100 ms, ident 0082, DP-V1.
const PRM: [u8; 10] = [0x88, 1, 10, 11, 0x00, 0x82, 0, 0x80, 0, 0];
