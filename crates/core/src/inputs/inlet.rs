//! The loop's end of a queue that other threads write to.

use std::cell::Cell;

use rtrb::{Consumer, Producer, RingBuffer};

use super::entry::Kind;
use super::{InputLog, with_words};
use crate::packed::Part;

/// The consumer of a queue of the loop. With a log, only elements that a look has found are there: how many that are,
/// and which, is in the log.
#[derive(Debug)]
pub struct Inlet<T> {
    queue: Consumer<T>,
    log: InputLog,
    /// The number of elements found and not taken; counted with a log only.
    found: Cell<usize>,
    /// Of a repeated run: fills the queue with what the recorded one found.
    refill: Option<Producer<T>>,
}

impl<T: Part> Inlet<T> {
    /// The loop's end of `queue`.
    pub fn new(queue: Consumer<T>) -> Inlet<T> {
        Inlet { queue, log: InputLog::default(), found: Cell::new(0), refill: None }
    }

    /// The same with this log.
    pub fn logged(mut self, log: &InputLog) -> Inlet<T> {
        self.log = log.source();
        if log.as_replaying().is_some() {
            let (refill, queue) = RingBuffer::new(self.queue.buffer().capacity());
            (self.refill, self.queue) = (Some(refill), queue);
        }
        self
    }

    /// Whether nothing waits.
    #[inline(always)]
    pub fn is_empty(&self) -> bool {
        match self.log.is_on() {
            false => self.queue.is_empty(),
            true => self.found.get() == 0 && !self.log.flag(false, !self.queue.is_empty()),
        }
    }

    /// How many elements wait.
    #[inline]
    pub fn slots(&mut self) -> usize {
        match self.log.is_on() {
            false => self.queue.slots(),
            true => self.find(),
        }
    }

    /// The next element, which stays there.
    #[inline]
    pub fn peek(&mut self) -> Option<&T> {
        if self.log.is_on() && self.find() == 0 {
            return None;
        }
        self.queue.peek().ok()
    }

    /// Takes the next element.
    #[inline]
    pub fn pop(&mut self) -> Option<T> {
        if self.log.is_on() {
            let left = self.find().checked_sub(1)?;
            self.found.set(left);
        }
        self.queue.pop().ok()
    }

    /// Element `place`, left there.
    pub fn entry(&mut self, place: usize) -> Option<T> {
        if place == 0 {
            return self.peek().copied();
        }
        if self.log.is_on() && self.find() <= place {
            return None;
        }
        let chunk = self.queue.read_chunk(place + 1).ok()?;
        let (first, second) = chunk.as_slices();
        first.iter().chain(second).nth(place).copied()
    }

    /// Takes the first `count` elements, all or none of them.
    pub fn skip(&mut self, count: usize) {
        if self.log.is_on() {
            let Some(left) = self.find().checked_sub(count) else { return };
            self.found.set(left);
        }
        if let Ok(chunk) = self.queue.read_chunk(count) {
            chunk.commit_all();
        }
    }

    /// Looks for elements that have come, with a log. Returns how many wait.
    fn find(&mut self) -> usize {
        let found = self.found.get();
        if let Some(recording) = self.log.as_recording() {
            let slots = self.queue.slots();
            if slots == found {
                recording.nothing();
                return found;
            }
            if let Ok(chunk) = self.queue.read_chunk(slots) {
                let (first, second) = chunk.as_slices();
                let mut new = first.iter().chain(second).skip(found).peekable();
                while let Some(element) = new.next() {
                    let follows = u64::from(new.peek().is_some()) << 32 | u64::from(self.log.source);
                    with_words(follows, element, |words| recording.value(Kind::Queue, words));
                }
            }
            self.found.set(slots);
        } else if let (Some(replaying), Some(refill)) = (self.log.as_replaying(), &mut self.refill) {
            while let Some((follows, element)) = replaying.element(self.log.source) {
                if refill.push(element).is_err() || !follows {
                    break;
                }
            }
            self.found.set(self.queue.slots());
        }
        self.found.get()
    }
}
