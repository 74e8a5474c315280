//! The counts of mailbox messages, 1 ... 7: which answer may belong to which request.
//!
//! By the standard each side counts its own messages (ETG.1000.4, 5.6); most slaves return the count of the request,
//! some have none. What a slave does is learned from its answers. Where counts are not returned, only the object, the
//! command and the order of the answers show what they belong to.

use super::super::wire::mailbox::Counter;

/// After so many returned counts in a row another one is not that of an answer.
const RETURNED: u8 = 2;

/// The counts of one slave.
#[derive(Clone, Copy, Debug, Default)]
pub struct Counts {
    /// Those of the request under way, a bit each: it may have gone out more than once.
    used: u8,
    counting: Counting,
    /// The count of the last answer.
    last: u8,
}

/// How it counts its answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Counting {
    /// The number of returned ones in a row, up to [`RETURNED`]; `missed`: then another one came.
    Returned { so_far: u8, missed: bool },
    /// It counts its own messages.
    Own,
}

impl Default for Counting {
    fn default() -> Counting {
        Counting::Returned { so_far: 0, missed: false }
    }
}

impl Counts {
    /// A request with this count is to go out, perhaps again for the same.
    pub(super) fn send(&mut self, counter: Counter, again: bool) {
        let before = if again { self.used } else { 0 };
        self.used = before | 1 << counter.number();
    }

    /// The request has more than one count.
    pub(super) fn is_repeated(&self) -> bool {
        self.used.count_ones() > 1
    }

    /// Whether a message with this count may be the answer to the request under way.
    pub(super) fn may_answer(&mut self, counter: u8) -> bool {
        let is_returned = self.used & 1 << (counter & 7) != 0;
        match &mut self.counting {
            _ if counter == 0 => true,
            // The same one again is a repetition of the last answer.
            Counting::Own => std::mem::replace(&mut self.last, counter) != counter,
            Counting::Returned { so_far, .. } if is_returned => {
                *so_far = (*so_far + 1).min(RETURNED);
                self.last = counter;
                true
            }
            Counting::Returned { so_far: RETURNED, missed } => {
                *missed = true;
                false
            }
            // Likewise.
            _ if counter == self.last => false,
            counting => {
                (*counting, self.last) = (Counting::Own, counter);
                true
            }
        }
    }

    /// The request was not answered.
    pub(super) fn abandon(&mut self) {
        if matches!(self.counting, Counting::Returned { missed: true, .. }) {
            // What came with another count was its answer.
            self.counting = Counting::Own;
        }
    }
}
