//! Slaves on the line that are not configured: they stay as they are, but must not answer in the name of one that is,
//! nor be dragged to a time that is not theirs.

use super::running::Running;
use crate::bus::ethercat::plan::FIRST_STATION;
use crate::bus::ethercat::slot::{Answers, Ask};
use crate::bus::ethercat::wire::frame::{Command, position};
use crate::bus::ethercat::wire::registers::{AlState, AlStatus, Features, address};
use crate::rt::Regions;
use crate::time::{MS, Time};

/// Places that are looked at, at most.
const MOST: u16 = 1_024;
/// Between two looks, once each place was looked at: while the line has no time yet, and then.
const WAIT_NS: u64 = 10 * MS;
const IDLE_NS: u64 = 100 * MS;
/// And members have so many slots between two of theirs.
const TURNS: u64 = 4;
/// Bytes from its type to its station address, and where its features stand.
const LOOK: usize = 0x12;
const FEATURES: usize = (address::FEATURES - address::TYPE) as usize;
const STATION: usize = (address::STATION - address::TYPE) as usize;

/// The look at each place that nobody has, again and again: what stands there may be changed.
#[derive(Debug)]
pub struct Guests {
    /// Places that nobody has, in front of the last one that is configured; behind it all are free.
    gaps: Box<[u16]>,
    behind: u16,
    /// The next of them to look at, and what is asked there.
    next: u16,
    step: Step,
    /// An address of ours is taken away from it then.
    is_ours: bool,
    not_before: Time,
    /// Each was looked at.
    looked: bool,
    /// One that runs on another time than the line's: in this round, and in the last one.
    found: Option<u16>,
    stranger: Option<u16>,
    ended: bool,
}

/// What is asked at a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Look,
    Clock,
    Clear,
}

impl Guests {
    /// On a line with slaves configured at these places.
    pub fn new(taken: &[u16]) -> Guests {
        let behind = taken.iter().max().map_or(0, |last| last.saturating_add(1)).min(MOST);
        Guests {
            gaps: (0..behind).filter(|place| !taken.contains(place)).collect(),
            behind,
            next: 0,
            step: Step::Look,
            is_ours: false,
            not_before: Time(0),
            looked: false,
            found: None,
            stranger: None,
            ended: false,
        }
    }

    /// Adds what it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.gaps);
    }

    /// Nothing is looked at any more; tells whether that was so already.
    pub fn end(&mut self) -> bool {
        std::mem::replace(&mut self.ended, true)
    }

    /// All that there are were looked at.
    pub fn are_looked_at(&self) -> bool {
        self.looked
    }

    /// One that runs on another time than the line's.
    pub fn stranger(&self) -> Option<u16> {
        self.found.or(self.stranger)
    }

    /// The place that is looked at.
    pub fn place(&self) -> u16 {
        let gaps = self.gaps.len() as u16;
        let behind = self.behind.saturating_add(self.next.saturating_sub(gaps));
        self.gaps.get(usize::from(self.next)).copied().unwrap_or(behind)
    }

    /// Asks for the next place, on a line of so many slaves, `timed`: that has its time; false: nobody's turn has come.
    #[inline]
    pub fn ask(&mut self, now: Time, count: u16, timed: bool, period_ns: u64, ask: &mut Ask) -> bool {
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
            Step::Clock => Running::ask(|register| Command::Aprd(place, register), ask),
            Step::Clear => {
                ask.write(Command::Apwr(place, address::STATION), &[0; 2]);
            }
        }
        if self.looked && self.step == Step::Look {
            self.not_before = now + if timed { IDLE_NS } else { WAIT_NS }.max(TURNS * period_ns);
        }
        true
    }

    fn end_round(&mut self, now: Time, period_ns: u64) {
        (self.next, self.step, self.looked) = (0, Step::Look, true);
        self.stranger = self.found.take();
        self.not_before = now + IDLE_NS.max(TURNS * period_ns);
    }

    /// What came of it; gives what the clock of one shows that runs.
    pub fn heard(&mut self, answers: &Answers<'_>) -> Option<Running> {
        let first = answers[0]?;
        let is_there = first.working_counter > 0;
        match self.step {
            Step::Look if is_there => self.heard_look(first.data, answers[1].map_or(&[], |look| look.data)),
            Step::Clock if is_there => {
                self.enter(if self.is_ours { Step::Clear } else { Step::Look });
                return Running::heard(answers).filter(Running::is_cyclic);
            }
            _ => self.enter(Step::Look),
        }
        None
    }

    fn heard_look(&mut self, status: &[u8], look: &[u8]) {
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

    /// The next question; a look is that at the next place.
    fn enter(&mut self, step: Step) {
        self.next = self.next.saturating_add(u16::from(step == Step::Look));
        self.step = step;
    }

    /// The slave at this place runs on another time than the line's.
    pub fn is_strange(&mut self, place: u16) {
        self.found = Some(place);
    }
}
