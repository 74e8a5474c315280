//! Unconfigured slaves on the segment: they stay as they are, but must not answer in the name of a configured one,
//! nor have their clocks adjusted to another time.

use super::running::Running;
use crate::bus::ethercat::plan::FIRST_STATION;
use crate::bus::ethercat::slot::{Answers, Ask};
use crate::bus::ethercat::wire::frame::{Command, position};
use crate::bus::ethercat::wire::registers::{AlState, AlStatus, Features, address};
use crate::rt::Regions;
use crate::time::{MS, Time};

/// The most positions that are read.
const MOST: u16 = 1_024;
/// Pause between two looks, once each position was read: while the segment has no time yet, and after that.
const WAIT_NS: u64 = 10 * MS;
const IDLE_NS: u64 = 100 * MS;
/// Slots for the slaves between two of the unconfigured slaves'.
const TURNS: u64 = 4;
/// Bytes from its type to its station address, and the offset of its features.
const LOOK: usize = 0x12;
const FEATURES: usize = (address::FEATURES - address::TYPE) as usize;
const STATION: usize = (address::STATION - address::TYPE) as usize;

/// Reads each unconfigured position, again and again: the slave there may be changed.
#[derive(Debug, Default)]
pub struct Unconfigured {
    /// Unconfigured positions before the last configured one; all positions after it are unconfigured.
    gaps: Box<[u16]>,
    behind: u16,
    /// The next of them to read, and what is requested there.
    next: u16,
    step: Step,
    /// One of our addresses is taken away from it then.
    is_ours: bool,
    not_before: Time,
    /// Each was read.
    pub are_read: bool,
    /// A slave that runs on a time other than the segment's: in this round, and in the last one.
    pub found: Option<u16>,
    other_time: Option<u16>,
    pub ended: bool,
}

/// What is requested at a position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Step {
    #[default]
    Look,
    Clock,
    Clear,
}

impl Unconfigured {
    /// On a segment with slaves configured at these positions.
    pub fn new(taken: &[u16]) -> Unconfigured {
        let behind = taken.iter().max().map_or(0, |last| last.saturating_add(1)).min(MOST);
        Unconfigured {
            gaps: (0..behind).filter(|place| !taken.contains(place)).collect(),
            behind,
            ..Unconfigured::default()
        }
    }

    /// Adds what it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.gaps);
    }

    /// A slave that runs on a time other than the segment's.
    pub fn other_time(&self) -> Option<u16> {
        self.found.or(self.other_time)
    }

    /// The position that is being read.
    pub fn place(&self) -> u16 {
        let gaps = self.gaps.len() as u16;
        let behind = self.behind.saturating_add(self.next.saturating_sub(gaps));
        self.gaps.get(usize::from(self.next)).copied().unwrap_or(behind)
    }

    /// Requests the next look, on a segment of so many slaves; `timed`: it has its time. False: it is not their
    /// turn.
    #[inline]
    pub fn request(&mut self, now: Time, count: u16, timed: bool, period_ns: u64, ask: &mut Ask) -> bool {
        if now < self.not_before || self.ended || count == 0 {
            return false;
        }
        if self.place() >= count.min(MOST) {
            self.end_round(now, period_ns);
            return false;
        }
        let place = position(self.place());
        match self.step {
            Step::Look => {
                ask.read(Command::Aprd(place, address::AL_STATUS), 2);
                ask.read(Command::Aprd(place, address::TYPE), LOOK);
            }
            Step::Clock => Running::request(|register| Command::Aprd(place, register), ask),
            Step::Clear => {
                ask.write(Command::Apwr(place, address::STATION), &[0; 2]);
            }
        }
        if self.are_read && self.step == Step::Look {
            self.not_before = now + if timed { IDLE_NS } else { WAIT_NS }.max(TURNS * period_ns);
        }
        true
    }

    fn end_round(&mut self, now: Time, period_ns: u64) {
        (self.next, self.step, self.are_read) = (0, Step::Look, true);
        self.other_time = self.found.take();
        self.not_before = now + IDLE_NS.max(TURNS * period_ns);
    }

    /// Takes the answer; returns the time of a running clock.
    pub fn receive(&mut self, answers: &Answers<'_>) -> Option<Running> {
        let first = answers[0]?;
        let is_there = first.working_counter > 0;
        match self.step {
            Step::Look if is_there => self.receive_look(first.data, answers[1].map_or(&[], |look| look.data)),
            Step::Clock if is_there => {
                self.enter(if self.is_ours { Step::Clear } else { Step::Look });
                return Running::receive(answers).filter(Running::is_cyclic);
            }
            _ => self.enter(Step::Look),
        }
        None
    }

    fn receive_look(&mut self, status: &[u8], look: &[u8]) {
        let word = |at: usize| look.get(at..).and_then(<[u8]>::first_chunk::<2>).copied();
        let station = word(STATION).map_or(0, u16::from_le_bytes);
        let features = Features(word(FEATURES).map_or(0, u16::from_le_bytes));
        let status = AlStatus(status.first_chunk::<2>().map_or(0, |bytes| u16::from_le_bytes(*bytes)));
        let place = station.wrapping_sub(FIRST_STATION);
        self.is_ours = place < self.behind && !self.gaps.contains(&place);
        let runs = status.state().is_some_and(|al| al >= AlState::SafeOp) && features.has_clock();
        self.enter(match self.is_ours {
            _ if runs => Step::Clock,
            true => Step::Clear,
            false => Step::Look,
        });
    }

    /// The next request; a look is that at the next position.
    fn enter(&mut self, step: Step) {
        self.next = self.next.saturating_add(u16::from(step == Step::Look));
        self.step = step;
    }
}
