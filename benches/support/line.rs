//! A line of Kollmorgen drives in memory: simulated until all of them are in operation, and answered from memory from
//! then on.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use fieldbeat::axis::{Limits, State};
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive, Watchdog};
use fieldbeat::internals::bus::ethercat::cia402::StatusWord;
use fieldbeat::internals::bus::ethercat::wire::frame::{Command, FRAME_MAX, Place, datagrams};
use fieldbeat::internals::net::frames::{MAC, Unsent};
use fieldbeat::internals::net::{Carriers, Datagrams, Frames, UdpOptions};
use fieldbeat::internals::rt::{MonotonicClock, Regions};
use fieldbeat::sim::SimSegment;
use fieldbeat::sim::ethercat::EthercatSim;
use fieldbeat::time::{MS, Time};

use super::rig;

/// Inputs of a drive in its frame, 1B03h, with its AL status in front.
const INPUTS: usize = 2 + 8;
/// In the latter: actual position and status word.
const POSITION: std::ops::Range<usize> = 2..6;
const STATUS: std::ops::Range<usize> = 8..10;
/// So many frames in a row all drives have to be in operation: until the last one of a long segment has read its mode
/// and its reference by the mailbox.
const SETTLED: u32 = 1_000;
/// And so many more at most until one of them looks at no mailbox: on a long line there is always one to be looked at.
const QUIET: u32 = 200;

/// A line of so many drives, as a machine might have it.
pub fn plan(interface: &str, drives: usize) -> EthercatPlan {
    let drive = |place: usize| {
        let mut drive = KollmorgenDrive::new(format!("k{place}"), place as u16, Family::S700);
        drive.slave.watchdog = Watchdog::After(100 * MS);
        drive.axis.limits = Limits { velocity: Some(50.0), ..Limits::default() };
        drive.axis.stop.deceleration = 100.0;
        drive.axis.health.bucket = 1_000_000;
        drive.axis.enable_timeout = Duration::from_secs(60);
        drive
    };
    EthercatPlan::new(interface, (0..drives).map(drive).collect())
}

/// A frame to such a line once all its drives are in operation, and what it answers.
pub type Settled = Arc<OnceLock<(Vec<u8>, Canned)>>;

/// Opens the line of a plan in memory, by this clock.
pub struct NullLines(pub EthercatPlan, pub fn() -> Time, pub Settled);

impl Carriers for NullLines {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn frames(&self, _: &str, _: u16) -> io::Result<Box<dyn Frames>> {
        Ok(Box::new(NullLine::new(&self.0, self.1, Settled::clone(&self.2))))
    }
}

/// The master's end of such a line.
pub struct NullLine {
    now: fn() -> Time,
    sim: Option<EthercatSim>,
    drives: usize,
    exchange: Settled,
    settled: u32,
    canned: Option<Canned>,
    frame: Box<[u8; FRAME_MAX]>,
    /// Bytes of the frame that comes back; 0: there is none.
    length: usize,
}

impl NullLine {
    /// The line of `plan`, by this clock. When it is settled it tells so.
    pub fn new(plan: &EthercatPlan, now: fn() -> Time, exchange: Settled) -> NullLine {
        NullLine {
            now,
            sim: Some(EthercatSim::of(plan)),
            drives: plan.drives.len(),
            exchange,
            settled: 0,
            canned: None,
            frame: Box::new([0; FRAME_MAX]),
            length: 0,
        }
    }

    /// A line that answers like a settled one.
    pub fn settled(settled: &Settled, now: fn() -> Time) -> NullLine {
        let canned = settled.get().map(|(_, canned)| canned.clone());
        NullLine {
            now,
            sim: None,
            drives: 0,
            exchange: Settled::default(),
            settled: SETTLED,
            canned,
            frame: Box::new([0; FRAME_MAX]),
            length: 0,
        }
    }

    fn simulate(&mut self, sent: &[u8], at: Time) {
        let Some(sim) = &mut self.sim else { return };
        let frame = &mut self.frame[..self.length];
        let begin = MonotonicClock::read();
        let comes_back = sim.pass(at, frame);
        rig::forget(MonotonicClock::read().since(begin));
        if !comes_back {
            self.length = 0;
            return;
        }
        let Some(canned) = Canned::new(frame, self.drives, at) else {
            self.settled = 0;
            return;
        };
        self.settled += 1;
        let is_typical = !canned.asks || self.settled >= SETTLED + QUIET;
        if self.settled >= SETTLED && is_typical {
            let _ = self.exchange.set((sent.to_vec(), canned.clone()));
            (self.canned, self.sim) = (Some(canned), None);
        }
    }
}

impl Frames for NullLine {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let at = (self.now)();
        self.length = frame.len();
        self.frame[..frame.len()].copy_from_slice(frame);
        match &mut self.canned {
            Some(canned) => canned.answer(&mut self.frame[..frame.len()], at),
            None => self.simulate(frame, at),
        }
        Ok(at)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let length = std::mem::take(&mut self.length);
        if length == 0 {
            return None;
        }
        room[..length].copy_from_slice(&self.frame[..length]);
        Some(((self.now)(), length))
    }

    fn now(&mut self) -> Time {
        (self.now)()
    }

    fn mac(&self) -> [u8; 6] {
        MAC
    }

    fn memory(&self, _: &mut Regions) {}
}

/// What a line answers whose drives are all in operation and turning.
#[derive(Clone, Debug)]
pub struct Canned {
    /// Working counters of the datagrams of every frame, and where the time of the line stands.
    counters: Vec<(usize, [u8; 2])>,
    clock: Option<(usize, u32, Time)>,
    /// Where the inputs begin, and what they are but for the positions.
    inputs_at: usize,
    inputs: Vec<u8>,
    /// Where the slot begins.
    slot: usize,
    position: u32,
    /// That frame has a slot.
    asks: bool,
}

impl Canned {
    /// As this frame has come back; `None`: not all drives are in operation.
    fn new(frame: &[u8], drives: usize, at: Time) -> Option<Canned> {
        let (mut counters, mut clock, mut inputs_at, mut slot) = (Vec::new(), None, None, 0);
        let (mut states, mut asks) = (false, false);
        for datagram in datagrams(frame).ok()?.map_while(Result::ok) {
            if states {
                // Behind the states stands the slot.
                asks = true;
                break;
            }
            let Place { at: _, length } = datagram.place;
            let end = datagram.place.data().end;
            counters.push((end, datagram.working_counter.to_le_bytes()));
            slot = datagram.place.end();
            match datagram.command()? {
                Command::Frmw(..) if datagram.working_counter > 0 => {
                    let time = u32::from_le_bytes(datagram.data.try_into().ok()?);
                    clock = Some((datagram.place.data().start, time, at));
                }
                Command::Lrw(_) if usize::from(datagram.working_counter) == 3 * drives => {
                    inputs_at = Some(datagram.place.data().start + length - drives * INPUTS);
                }
                Command::Brd(_) => states = true,
                _ => {}
            }
        }
        let inputs_at = inputs_at?;
        let inputs = frame.get(inputs_at..inputs_at + drives * INPUTS)?.to_vec();
        let is_on = |input: &[u8]| {
            let status = u16::from_le_bytes([input[STATUS.start], input[STATUS.start + 1]]);
            input[0] == 8 && StatusWord(status).state() == State::OperationEnabled
        };
        inputs.chunks(INPUTS).all(is_on).then_some(Canned {
            counters,
            clock,
            inputs_at,
            inputs,
            slot,
            position: 0,
            asks,
        })
    }

    /// Makes of a frame what comes back: every drive says that it is elsewhere than before; a mailbox that is looked at
    /// is empty.
    #[inline]
    fn answer(&mut self, frame: &mut [u8], at: Time) {
        frame[6] |= 2;
        for (place, counter) in &self.counters {
            frame[*place..place + 2].copy_from_slice(counter);
        }
        if let Some((place, time, then)) = self.clock {
            let time = time.wrapping_add(at.since(then) as u32);
            frame[place..place + 4].copy_from_slice(&time.to_le_bytes());
        }
        self.position = self.position.wrapping_add(100);
        let inputs = &mut frame[self.inputs_at..self.inputs_at + self.inputs.len()];
        inputs.copy_from_slice(&self.inputs);
        for input in inputs.chunks_exact_mut(INPUTS) {
            input[POSITION].copy_from_slice(&self.position.to_le_bytes());
        }
        if frame.len() > self.slot.max(60) {
            self.answer_slot(frame);
        }
    }

    fn answer_slot(&self, frame: &mut [u8]) {
        let behind = |place: &Place| place.at >= self.slot;
        let ends: [Option<usize>; 2] = {
            let Ok(all) = datagrams(frame) else { return };
            let mut requested = all.map_while(Result::ok).map(|datagram| datagram.place).filter(behind);
            std::array::from_fn(|_| requested.next().map(|place| place.data().end))
        };
        for end in ends.into_iter().flatten() {
            frame[end] = 1;
        }
    }
}
