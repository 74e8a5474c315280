//! The log of a recorded run as the loop of a repeated one reads it.
//!
//! Each look takes what the recorded one found, in the order of the log. A repeated loop that does something else makes
//! other looks, and then its order is no help: from there to the end of the cycle each look takes the next entry of its
//! own source, whatever is before it, and the next cycle begins in order again. What counts is what leaves: the first
//! telegram that is not as recorded is the difference of both runs.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::entry::{Head, Kind, place_of};
use crate::packed::Part;
use crate::time::{MS, Time};

/// Where the log comes from: pieces of whole cycles, until there are no more.
pub type Source = Box<dyn FnMut() -> Option<Vec<u64>> + Send>;

/// The log that the loop reads.
#[derive(Debug)]
pub struct Replaying(Mutex<Player>);

struct Player {
    entries: Entries,
    /// The rest of the cycle, each entry with the looks before it that found nothing.
    left: VecDeque<(u64, Entry)>,
    /// The begin of the next cycle.
    next: Option<(u64, Entry)>,
    /// The time that the loop had last.
    now: Time,
    cycle: u64,
    /// The loop has made another look in this cycle than the recorded one.
    astray: bool,
    difference: Option<Difference>,
    first_astray: Option<Difference>,
    /// Telegrams that were compared, and their bytes.
    sent: u64,
    bytes: u64,
}

impl std::fmt::Debug for Player {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Player").field("cycle", &self.cycle).finish_non_exhaustive()
    }
}

/// One entry of the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The kind.
    pub kind: Kind,
    /// The time, if it has one of its own; else that of the one before it.
    pub at: Time,
    words: Vec<u64>,
    bytes: usize,
}

/// The entries of a log, each with so many looks before it that found what is usual.
pub struct Entries {
    source: Source,
    words: Vec<u64>,
    /// The place of the next word in them.
    at: usize,
    /// The time of the last entry.
    read: Time,
}

/// A word of the log is no entry, or its entry is not whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Broken;

/// A difference of a repeated run to the recorded one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// The cycle.
    pub cycle: u64,
    /// The difference.
    pub what: Mismatch,
}

/// The kinds of differences.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Mismatch {
    /// A telegram has other bytes.
    Sent {
        /// Which bus sends it, by its place in the plan.
        bus: usize,
        /// Which connection or message of it.
        index: usize,
        /// The bytes of the recorded run.
        recorded: Vec<u8>,
        /// The bytes of the repeated one.
        repeated: Vec<u8>,
    },
    /// A telegram is sent that is not recorded.
    More {
        /// Which bus sends it, by its place in the plan.
        bus: usize,
        /// Which connection or message of it.
        index: usize,
    },
    /// A telegram is recorded that is not sent.
    Fewer {
        /// Which bus has sent it, by its place in the plan.
        bus: usize,
        /// Which connection or message of it.
        index: usize,
    },
    /// The in-loop task requests something else.
    Task,
    /// The loop looks for something else.
    Look {
        /// The recorded kind at that place; `None`: nothing more.
        recorded: Option<Kind>,
        /// The kind that the repeated run looks for; `None`: for nothing more in this cycle.
        repeated: Option<Kind>,
    },
    /// The log itself is broken.
    Broken,
}

impl Entry {
    /// Word `index` of its payload; 0 behind it.
    pub fn word(&self, index: usize) -> u64 {
        self.words.get(index).copied().unwrap_or(0)
    }

    /// The payload behind the first `words` words.
    pub fn bytes(&self, words: usize) -> Vec<u8> {
        let all = self.words.iter().flat_map(|word| word.to_le_bytes());
        all.take(self.bytes).skip(words * size_of::<u64>()).collect()
    }

    /// The part behind its first word; `None`: it is too short.
    fn part<T: Part>(&self) -> Option<T> {
        self.words.get(1..).filter(|words| words.len() >= T::WORDS).map(T::take)
    }

    /// The source that its first word names.
    fn source(&self) -> u32 {
        self.word(0) as u32
    }

    /// Where it was sent, if it was.
    fn sent(&self) -> Option<(usize, usize)> {
        self.kind.is_sent().then(|| place_of(self.word(0)))
    }
}

impl std::fmt::Debug for Entries {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Entries").field("read", &self.read).finish_non_exhaustive()
    }
}

impl Entries {
    /// Those of the log that `source` gives.
    pub fn new(source: Source) -> Entries {
        Entries { source, words: Vec::new(), at: 0, read: Time(0) }
    }

    /// The next word of the log.
    fn word(&mut self) -> Option<u64> {
        while self.at >= self.words.len() {
            self.words = (self.source)()?;
            self.at = 0;
        }
        self.at += 1;
        Some(self.words[self.at - 1])
    }
}

impl Iterator for Entries {
    type Item = Result<(u64, Entry), Broken>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut looks = 0;
        loop {
            let word = self.word()?;
            let Some(head) = Head::of(word) else { return Some(Err(Broken)) };
            let words: Vec<u64> = (0..head.words()).map_while(|_| self.word()).collect();
            if words.len() < head.words() {
                return Some(Err(Broken));
            }
            looks += head.looks;
            self.read = Time(self.read.0.wrapping_add_signed(head.after_ns.into()));
            match head.kind {
                Kind::Gap => {}
                Kind::Base => self.read = Time(words.first().copied().unwrap_or(0)),
                kind => return Some(Ok((looks, Entry { kind, at: self.read, words, bytes: head.bytes }))),
            }
        }
    }
}

impl Replaying {
    /// The log that `source` gives.
    pub fn new(source: Source) -> Replaying {
        let mut player = Player {
            entries: Entries::new(source),
            left: VecDeque::new(),
            next: None,
            now: Time(0),
            cycle: 0,
            astray: false,
            difference: None,
            first_astray: None,
            sent: 0,
            bytes: 0,
        };
        player.load();
        Replaying(Mutex::new(player))
    }

    fn player(&self) -> MutexGuard<'_, Player> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The first difference of what leaves.
    pub fn difference(&self) -> Option<Difference> {
        self.player().difference.clone()
    }

    /// The first look that was another one than the recorded one.
    pub fn first_astray(&self) -> Option<Difference> {
        self.player().first_astray.clone()
    }

    /// Telegrams that were compared, and their bytes.
    pub fn compared(&self) -> (u64, u64) {
        let player = self.player();
        (player.sent, player.bytes)
    }

    /// Whether the log has no more cycle; for the time between two cycles.
    pub fn is_over(&self) -> bool {
        self.player().next.is_none()
    }

    /// The last cycle is over. `ended_before`: so is the repeated loop, which executes none of the cycles that are
    /// recorded before this one.
    pub fn end(&self, ended_before: Option<u64>) {
        let mut player = self.player();
        player.close();
        let recorded = player.next.as_ref().map(|(_, next)| next.word(0));
        if let Some(cycle) = recorded.filter(|cycle| ended_before.is_some_and(|end| *cycle < end)) {
            player.cycle = cycle;
            player.goes_astray(Some(Kind::Cycle), None);
            // Its telegrams are missing.
            player.load();
            player.close();
        }
    }

    /// A slot of the grid begins.
    pub fn cycle(&self, index: u64) {
        let mut player = self.player();
        player.close();
        player.cycle = index;
        // Slots that the recorded run executed, and this one passed over.
        while player.next.as_ref().is_some_and(|(_, next)| next.word(0) < index) {
            player.goes_astray(Some(Kind::Cycle), Some(Kind::Cycle));
            player.load();
        }
        player.left.clear();
        match player.next.as_ref().map(|(_, next)| next.word(0)) {
            Some(recorded) if recorded == index => {
                player.astray = false;
                player.load();
            }
            // The recorded run passed over this one, or ends before it.
            recorded => player.goes_astray(recorded.map(|_| Kind::Cycle), Some(Kind::Cycle)),
        }
    }

    /// The time of a reading of the clock.
    pub fn clock(&self) -> Time {
        let mut player = self.player();
        let found = player.look(&[Kind::Clock], true, |_| true);
        // Without one, the windows of a cycle come to their end.
        player.now = found
            .map_or(player.now + MS, |entry| if player.astray { entry.at.max(player.now) } else { entry.at });
        player.now
    }

    /// A look for an entry of these kinds that is one of the wanted ones; `None`: the recorded look found what is
    /// usual.
    pub fn look(&self, kinds: &[Kind], is_wanted: impl Fn(&Entry) -> bool) -> Option<Entry> {
        self.player().look(kinds, false, is_wanted)
    }

    /// The same of the part that a source hands over.
    pub fn part<T: Part>(&self, source: u32) -> Option<T> {
        self.look(&[Kind::Value], |entry| entry.source() == source)?.part()
    }

    /// The same of the next element of a queue, and whether one more follows.
    pub fn element<T: Part>(&self, source: u32) -> Option<(bool, T)> {
        let entry = self.look(&[Kind::Queue], |entry| entry.source() == source)?;
        Some((entry.word(0) >> 32 != 0, entry.part()?))
    }

    /// The next call of the in-loop task, if the recorded one made one more in this cycle; it is left there.
    pub fn peek_call<T: Part>(&self) -> Option<T> {
        let player = self.player();
        let is_next =
            |(looks, entry): &&(u64, Entry)| entry.kind == Kind::Task && (*looks == 0 || player.astray);
        player.left.iter().find(is_next)?.1.part()
    }

    /// A call of the in-loop task.
    pub fn call(&self, words: &[u64]) {
        let mut player = self.player();
        match player.look(&[Kind::Task], true, |_| true) {
            Some(entry) if entry.words.get(1..) == Some(words) => {}
            _ => player.differs(Mismatch::Task),
        }
    }

    /// The next call of the in-loop task is refused here.
    pub fn call_refused(&self) {
        let mut player = self.player();
        player.look(&[Kind::Task], true, |_| true);
        player.differs(Mismatch::Task);
    }

    /// A telegram leaves: it has to be the recorded one. `kinds` are those with which it may be recorded, and how many
    /// words are before its bytes; the first word, `to`, says where it goes. Returns its entry.
    pub fn sends(&self, kinds: &[(Kind, usize)], to: u64, bytes: &[u8]) -> Option<Entry> {
        let mut player = self.player();
        let all: Vec<Kind> = kinds.iter().map(|(kind, _)| *kind).collect();
        let found = player.look(&all, true, |entry| entry.word(0) == to);
        let (bus, index) = place_of(to);
        let Some(entry) = found else {
            player.differs(Mismatch::More { bus, index });
            return None;
        };
        let front = kinds.iter().find(|(kind, _)| *kind == entry.kind).map_or(0, |(_, front)| *front);
        let recorded = entry.bytes(front);
        if recorded != bytes {
            player.differs(Mismatch::Sent { bus, index, recorded, repeated: bytes.to_vec() });
        } else {
            player.sent += 1;
            player.bytes += bytes.len() as u64;
        }
        Some(entry)
    }
}

impl Player {
    /// The first difference counts.
    fn differs(&mut self, what: Mismatch) {
        let cycle = self.cycle;
        self.difference.get_or_insert(Difference { cycle, what });
    }

    fn goes_astray(&mut self, recorded: Option<Kind>, repeated: Option<Kind>) {
        let (cycle, what) = (self.cycle, Mismatch::Look { recorded, repeated });
        self.astray = true;
        self.first_astray.get_or_insert(Difference { cycle, what });
    }

    /// A cycle is over: the loop has taken all of it.
    fn close(&mut self) {
        let left = std::mem::take(&mut self.left);
        if let Some((_, entry)) = left.front().filter(|_| !self.astray) {
            self.goes_astray(Some(entry.kind), None);
        }
        if let Some(to) = left.iter().find_map(|(_, entry)| entry.sent()) {
            self.differs(Mismatch::Fewer { bus: to.0, index: to.1 });
        } else if left.iter().any(|(_, entry)| entry.kind == Kind::Task) {
            self.differs(Mismatch::Task);
        }
    }

    /// A look for an entry of these kinds that is one of the wanted ones. A recorded look at this place always found
    /// one if it `must`.
    fn look(&mut self, kinds: &[Kind], must: bool, is_wanted: impl Fn(&Entry) -> bool) -> Option<Entry> {
        let fits = |entry: &Entry| kinds.contains(&entry.kind) && is_wanted(entry);
        if !self.astray {
            let next = self.left.front_mut().or(self.next.as_mut());
            match next {
                Some((looks, _)) if *looks > 0 && !must => {
                    *looks -= 1;
                    return None;
                }
                Some((0, entry)) if fits(entry) => return self.left.pop_front().map(|(_, entry)| entry),
                // The looks of the last cycle of a log are not counted.
                None if !must => return None,
                next => {
                    let recorded = next.filter(|(looks, _)| *looks == 0).map(|(_, entry)| entry.kind);
                    self.goes_astray(recorded, kinds.first().copied());
                }
            }
        }
        let at = self.left.iter().position(|(_, entry)| fits(entry))?;
        self.left.remove(at).map(|(_, entry)| entry)
    }

    /// Reads the entries up to the begin of the next cycle.
    fn load(&mut self) {
        self.next = None;
        self.left.clear();
        for entry in &mut self.entries {
            match entry {
                Ok(next) if next.1.kind == Kind::Cycle => {
                    self.next = Some(next);
                    return;
                }
                Ok(entry) => self.left.push_back(entry),
                Err(Broken) => return self.differs(Mismatch::Broken),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::InputLog;
    use super::super::recording::{Recording, log};
    use super::*;
    use crate::rt::Regions;

    fn recorded(work: impl FnOnce(&Recording)) -> Replaying {
        let (recording, mut reader) = log(1 << 12, &mut Regions::default());
        work(&recording);
        recording.end();
        let mut words = Vec::new();
        reader.take(&mut words);
        let mut pieces = vec![words];
        Replaying::new(Box::new(move || pieces.pop()))
    }

    #[test]
    fn each_look_finds_what_the_recorded_one_found() {
        let replaying = recorded(|log| {
            log.cycle(7);
            log.entry_at(Kind::Clock, Time(1 << 60), &[], &[]);
            (0..3_000).for_each(|_| log.nothing());
            log.entry(Kind::Value, &[3, 9], &[]);
            log.entry_at(Kind::Clock, Time((1 << 60) + 5), &[], &[]);
        });
        replaying.cycle(7);
        assert_eq!(replaying.clock(), Time(1 << 60));
        assert!((0..3_000).all(|_| replaying.part::<u64>(3).is_none()));
        assert_eq!(replaying.part::<u64>(3), Some(9));
        assert_eq!(replaying.clock(), Time((1 << 60) + 5));
        replaying.end(None);
        assert_eq!((replaying.difference(), replaying.first_astray()), (None, None));
        assert!(replaying.is_over());
    }

    #[test]
    fn other_bytes_and_telegrams_that_are_missing_or_too_many_are_differences() {
        let to = super::super::entry::of_bus;
        let both = |log: &Recording| {
            log.cycle(1);
            log.entry_at(Kind::FrameOut, Time(3), &[to(2, 0)], &[1, 2]);
            log.entry_at(Kind::FrameOut, Time(3), &[to(2, 5)], &[3]);
        };
        let what = |send: &[(usize, &[u8])]| {
            let replaying = recorded(both);
            replaying.cycle(1);
            for (index, bytes) in send {
                replaying.sends(&[(Kind::FrameOut, 1)], to(2, *index), bytes);
            }
            replaying.end(None);
            replaying.difference().map(|difference| difference.what)
        };
        assert_eq!(what(&[(0, &[1, 2]), (5, &[3])]), None);
        let sent = Mismatch::Sent { bus: 2, index: 0, recorded: vec![1, 2], repeated: vec![1, 3] };
        assert_eq!(what(&[(0, &[1, 3]), (5, &[3])]), Some(sent));
        assert_eq!(what(&[(5, &[3])]), Some(Mismatch::Fewer { bus: 2, index: 0 }));
        assert_eq!(what(&[(0, &[1, 2]), (4, &[1]), (5, &[3])]), Some(Mismatch::More { bus: 2, index: 4 }));
    }

    #[test]
    fn a_loop_that_ends_before_the_recorded_one_is_a_difference_of_its_next_cycle() {
        let to = super::super::entry::of_bus;
        let ended = |end| {
            let replaying = recorded(|log| {
                log.cycle(1);
                log.cycle(4);
                log.entry_at(Kind::FrameOut, Time(3), &[to(2, 0)], &[1, 2]);
            });
            replaying.cycle(1);
            replaying.end(end);
            (replaying.difference(), replaying.first_astray())
        };
        // It goes on, or only earlier cycles count.
        assert_eq!([ended(None), ended(Some(4))], [(None, None), (None, None)]);
        let (difference, astray) = ended(Some(5));
        assert_eq!(difference, Some(Difference { cycle: 4, what: Mismatch::Fewer { bus: 2, index: 0 } }));
        let what = Mismatch::Look { recorded: Some(Kind::Cycle), repeated: None };
        assert_eq!(astray, Some(Difference { cycle: 4, what }));
    }

    #[test]
    fn after_another_look_each_source_has_its_own_and_the_next_cycle_is_in_order_again() {
        let replaying = recorded(|log| {
            log.cycle(1);
            log.entry_at(Kind::Clock, Time(10), &[], &[]);
            log.entry(Kind::Value, &[3, 7], &[]);
            log.entry(Kind::Value, &[4, 8], &[]);
            log.entry_at(Kind::Clock, Time(20), &[], &[]);
            log.cycle(2);
            log.nothing();
            log.entry(Kind::Value, &[3, 9], &[]);
        });
        replaying.cycle(1);
        assert_eq!(replaying.clock(), Time(10));
        assert_eq!(replaying.part::<u64>(4), Some(8));
        assert_eq!((replaying.part::<u64>(4), replaying.part::<u64>(3)), (None, Some(7)));
        assert_eq!([replaying.clock(), replaying.clock()], [Time(20), Time(20) + MS]);
        replaying.cycle(2);
        assert_eq!([replaying.part::<u64>(3), replaying.part(3)], [None, Some(9)]);
        let what = Mismatch::Look { recorded: Some(Kind::Value), repeated: Some(Kind::Value) };
        assert_eq!(replaying.first_astray(), Some(Difference { cycle: 1, what }));
        assert_eq!(replaying.difference(), None);
    }

    #[test]
    fn a_log_of_broken_words_is_a_difference() {
        for words in
            [vec![u64::MAX], vec![Head { kind: Kind::Value, looks: 0, bytes: 80, after_ns: 0 }.word(), 1]]
        {
            let mut pieces = vec![words];
            let replaying = Replaying::new(Box::new(move || pieces.pop()));
            assert_eq!(replaying.difference().map(|difference| difference.what), Some(Mismatch::Broken));
            // Nothing panics.
            let log = InputLog::replaying(replaying);
            log.cycle(0);
            assert!(!log.flag(false, true));
        }
    }
}
