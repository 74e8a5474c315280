//! The log of a recorded run: the loop writes words into a preallocated ring, and a normal thread takes them out.
//!
//! The ring is of atomic words, so that everything on the loop's thread can write to it through a shared reference,
//! without `unsafe`: only one thread writes at any time, and its stores are plain ones. It publishes at the end of
//! each cycle, so that what the reader gets ends with a whole cycle. A log that finds no room ends with the last whole
//! cycle, and stays ended: what follows could not be repeated.

use std::sync::atomic::Ordering;

use crossbeam::utils::CachePadded;

use super::entry::{Head, Kind, MOST_BYTES, MOST_LOOKS, after_ns};
use crate::rt::Regions;
use crate::sync::{AtomicBool, AtomicU64};
use crate::time::Time;

/// The loop's end of the log.
#[derive(Debug)]
pub struct Recording {
    ring: std::sync::Arc<Ring>,
}

/// The end of the thread that takes the log out.
#[derive(Debug)]
pub struct LogReader {
    ring: std::sync::Arc<Ring>,
}

#[derive(Debug)]
struct Ring {
    words: Box<[AtomicU64]>,
    writer: CachePadded<Writer>,
    /// Words up to here are whole cycles.
    published: CachePadded<AtomicU64>,
    /// Words up to here have been taken.
    taken: CachePadded<AtomicU64>,
    /// The first cycle that is not in the log, plus 1; 0: there is none.
    ended: CachePadded<AtomicU64>,
    /// Nothing more comes.
    is_over: AtomicBool,
}

/// The state that the loop's thread alone uses.
#[derive(Debug, Default)]
struct Writer {
    /// The place of the next word; counted up over all words.
    next: AtomicU64,
    /// There is room up to here, as far as the writer knows.
    room: AtomicU64,
    /// Looks since the last entry.
    looks: AtomicU64,
    /// The time of the last entry.
    before: AtomicU64,
    /// The cycle that is being written.
    cycle: AtomicU64,
    has_ended: AtomicBool,
}

/// A place in the log, to go back to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mark {
    next: u64,
    looks: u64,
    before: u64,
}

/// Both ends of a log with room for at least so many words.
pub fn log(words: usize, regions: &mut Regions) -> (Recording, LogReader) {
    let ring = std::sync::Arc::new(Ring {
        // Written once, so that its pages are there.
        words: (0..words.next_power_of_two()).map(|_| AtomicU64::new(0)).collect(),
        writer: CachePadded::default(),
        published: CachePadded::default(),
        taken: CachePadded::default(),
        ended: CachePadded::default(),
        is_over: AtomicBool::new(false),
    });
    regions.add(&*ring.words);
    regions.add(&*ring);
    (Recording { ring: std::sync::Arc::clone(&ring) }, LogReader { ring })
}

/// Adds to a counter that one thread alone writes.
#[inline]
fn add(counter: &AtomicU64, count: u64) {
    counter.store(counter.load(Ordering::Relaxed) + count, Ordering::Relaxed);
}

impl Recording {
    /// A look found what is usual.
    #[inline]
    pub fn nothing(&self) {
        add(&self.ring.writer.looks, 1);
    }

    /// A look found this.
    #[inline]
    pub fn entry<const N: usize>(&self, kind: Kind, words: &[u64; N], bytes: &[u8]) {
        self.write(kind, 0, words, bytes);
    }

    /// The same at this time.
    #[inline(always)]
    pub fn entry_at<const N: usize>(&self, kind: Kind, at: Time, words: &[u64; N], bytes: &[u8]) {
        let before = &self.ring.writer.before;
        let after = match after_ns(Time(before.load(Ordering::Relaxed)), at) {
            Some(after) => after,
            None => self.base(at),
        };
        before.store(at.0, Ordering::Relaxed);
        self.write(kind, after, words, bytes);
    }

    /// A look found a value of these words.
    #[inline(never)]
    pub fn value(&self, kind: Kind, words: &[u64]) {
        let Some(places) = self.places(words.len()) else { return };
        put(places, self.head(kind, 0, size_of_val(words)), words, &[]);
    }

    /// The time from which differences count; the difference of an entry at it.
    #[cold]
    fn base(&self, at: Time) -> i32 {
        self.write(Kind::Base, 0, &[at.0], &[]);
        0
    }

    /// A slot of the grid begins.
    pub fn cycle(&self, index: u64) {
        let writer = &self.ring.writer;
        writer.cycle.store(index, Ordering::Relaxed);
        self.entry(Kind::Cycle, &[index], &[]);
    }

    /// The loop has ended: the last cycle is whole.
    pub fn end(&self) {
        self.publish();
        self.ring.is_over.store(true, Ordering::Release);
    }

    /// The present place.
    #[inline]
    pub fn mark(&self) -> Mark {
        let Writer { next, looks, before, .. } = &*self.ring.writer;
        let [next, looks, before] = [next, looks, before].map(|word| word.load(Ordering::Relaxed));
        Mark { next, looks, before }
    }

    /// Whether there is no entry since `mark`.
    #[inline]
    pub fn is_at(&self, mark: Mark) -> bool {
        self.ring.writer.next.load(Ordering::Relaxed) == mark.next
    }

    /// Goes back to a mark of this cycle: what was written since then is not in the log.
    #[inline]
    pub fn go_back(&self, mark: Mark) {
        let Writer { next, looks, before, .. } = &*self.ring.writer;
        next.store(mark.next, Ordering::Relaxed);
        looks.store(mark.looks, Ordering::Relaxed);
        before.store(mark.before, Ordering::Relaxed);
    }

    /// All that was written are whole cycles.
    pub fn publish(&self) {
        let writer = &self.ring.writer;
        if !writer.has_ended.load(Ordering::Relaxed) {
            self.ring.published.store(writer.next.load(Ordering::Relaxed), Ordering::Release);
        }
    }

    #[inline(always)]
    fn write<const N: usize>(&self, kind: Kind, after_ns: i32, words: &[u64; N], bytes: &[u8]) {
        let bytes = bytes.get(..MOST_BYTES - size_of_val(words)).unwrap_or(bytes);
        let payload = N + bytes.len().div_ceil(WORD);
        let (ring, writer) = (&*self.ring, &*self.ring.writer);
        let next = writer.next.load(Ordering::Relaxed);
        let first = next as usize & (ring.words.len() - 1);
        let looks = writer.looks.load(Ordering::Relaxed);
        let end = next + 1 + payload as u64;
        // Mostly there is room, in one piece.
        if end <= writer.room.load(Ordering::Relaxed)
            && looks <= MOST_LOOKS
            && let Some(piece) = ring.words.get(first..first + 1 + payload)
            && let (whole, odd) = bytes.as_chunks()
            && let Some((place, rest)) = piece.split_first()
            && let Some((front, rest)) = rest.split_first_chunk::<N>()
        {
            let head = Head { kind, looks, bytes: size_of_val(words) + bytes.len(), after_ns };
            writer.next.store(end, Ordering::Relaxed);
            writer.looks.store(0, Ordering::Relaxed);
            place.store(head.word(), Ordering::Relaxed);
            front.iter().zip(words).for_each(|(place, word)| place.store(*word, Ordering::Relaxed));
            for (place, bytes) in rest.iter().zip(whole) {
                place.store(u64::from_le_bytes(*bytes), Ordering::Relaxed);
            }
            if let (false, Some(place)) = (odd.is_empty(), rest.last()) {
                place.store(last_word(bytes, odd), Ordering::Relaxed);
            }
        } else if let Some(places) = self.places(payload) {
            put(places, self.head(kind, after_ns, size_of_val(words) + bytes.len()), words, bytes);
        }
    }

    /// The places of an entry with so many words of payload: where they begin in the ring, and as far as they are in
    /// one piece. `None`: there is no room.
    #[inline]
    fn places(&self, payload: usize) -> Option<(&[AtomicU64], &[AtomicU64])> {
        let (ring, writer) = (&*self.ring, &*self.ring.writer);
        if writer.looks.load(Ordering::Relaxed) > MOST_LOOKS {
            self.gap();
        }
        let next = writer.next.load(Ordering::Relaxed);
        let end = next + 1 + payload as u64;
        if end > writer.room.load(Ordering::Relaxed) && !self.make_room(end) {
            return None;
        }
        writer.next.store(end, Ordering::Relaxed);
        let first = next as usize & (ring.words.len() - 1);
        let (before, from) = ring.words.split_at_checked(first)?;
        Some((before, from.get(..=payload).unwrap_or(from)))
    }

    /// The head of an entry, which has the looks so far.
    #[inline]
    fn head(&self, kind: Kind, after_ns: i32, bytes: usize) -> Head {
        let looks = &self.ring.writer.looks;
        let head = Head { kind, looks: looks.load(Ordering::Relaxed), bytes, after_ns };
        looks.store(0, Ordering::Relaxed);
        head
    }

    /// Writes the looks that do not fit into an entry.
    #[cold]
    fn gap(&self) {
        let mut looks = self.ring.writer.looks.load(Ordering::Relaxed);
        while looks > MOST_LOOKS {
            self.ring.writer.looks.store(MOST_LOOKS, Ordering::Relaxed);
            self.write(Kind::Gap, 0, &[], &[]);
            looks -= MOST_LOOKS;
        }
        self.ring.writer.looks.store(looks, Ordering::Relaxed);
    }

    /// Looks how much was taken; false if there still is no room up to `end`.
    #[cold]
    fn make_room(&self, end: u64) -> bool {
        let (ring, writer) = (&*self.ring, &*self.ring.writer);
        let has_ended = writer.has_ended.load(Ordering::Relaxed);
        let room = ring.taken.load(Ordering::Acquire) + ring.words.len() as u64;
        if has_ended || end > room {
            if !has_ended {
                writer.has_ended.store(true, Ordering::Relaxed);
                writer.room.store(0, Ordering::Relaxed);
                ring.ended.store(writer.cycle.load(Ordering::Relaxed) + 1, Ordering::Release);
            }
            return false;
        }
        writer.room.store(room, Ordering::Relaxed);
        true
    }
}

/// Bytes of a word.
const WORD: usize = size_of::<u64>();

/// The bytes of the last word that are not in whole ones.
#[inline]
fn last_word(bytes: &[u8], odd: &[u8]) -> u64 {
    match bytes.last_chunk() {
        Some(last) => u64::from_le_bytes(*last) >> (8 * (WORD - odd.len())),
        None => odd.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte)),
    }
}

/// Writes an entry to these places: behind the end of the ring comes its begin.
#[inline(never)]
fn put((begin, from): (&[AtomicU64], &[AtomicU64]), head: Head, words: &[u64], bytes: &[u8]) {
    let mut places = from.iter().chain(begin);
    let mut push = |word: u64| {
        if let Some(place) = places.next() {
            place.store(word, Ordering::Relaxed);
        }
    };
    push(head.word());
    words.iter().for_each(|word| push(*word));
    let (whole, odd) = bytes.as_chunks();
    whole.iter().for_each(|bytes| push(u64::from_le_bytes(*bytes)));
    if !odd.is_empty() {
        push(last_word(bytes, odd));
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        self.ring.is_over.store(true, Ordering::Release);
    }
}

impl LogReader {
    /// Appends the whole cycles that were not taken yet to `out`; false once nothing more will come.
    pub fn take(&mut self, out: &mut Vec<u64>) -> bool {
        let is_over = self.ring.is_over.load(Ordering::Acquire);
        let taken = self.ring.taken.load(Ordering::Relaxed);
        let published = self.ring.published.load(Ordering::Acquire);
        let mask = self.ring.words.len() as u64 - 1;
        let words = (taken..published).filter_map(|place| self.ring.words.get((place & mask) as usize));
        out.extend(words.map(|word| word.load(Ordering::Relaxed)));
        self.ring.taken.store(published, Ordering::Release);
        !is_over
    }

    /// The first cycle that the log does not have, since there was no room for it.
    pub fn ended_at(&self) -> Option<u64> {
        self.ring.ended.load(Ordering::Acquire).checked_sub(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_far_apart_and_many_looks_have_entries_of_their_own() {
        let (recording, mut reader) = log(64, &mut Regions::default());
        recording.entry_at(Kind::Clock, Time(1 << 50), &[], &[]);
        (0..5_000).for_each(|_| recording.nothing());
        recording.entry_at(Kind::Clock, Time((1 << 50) - 3), &[], &[]);
        recording.end();
        let mut words = Vec::new();
        reader.take(&mut words);
        let kinds: Vec<_> = [0, 2, 3, 4, 5].map(|at| Head::of(words[at]).unwrap()).into();
        assert_eq!(
            kinds.iter().map(|head| (head.kind, head.looks, head.after_ns)).collect::<Vec<_>>(),
            [
                (Kind::Base, 0, 0),
                (Kind::Clock, 0, 0),
                (Kind::Gap, MOST_LOOKS, 0),
                (Kind::Gap, MOST_LOOKS, 0),
                (Kind::Clock, 5_000 - 2 * MOST_LOOKS, -3),
            ]
        );
    }
}
