//! Why a drive is not online, from what is counted: one table a protocol, in the package of its wire.
//!
//! A reason that the wire knows by name ([`Notes::get`](super::Notes::get)) comes first, unless it is vague. Then the
//! first row holds whose symptom is there, so that the most specific ones stand first. Evaluated outside of the loop,
//! from what it has published.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use super::counters::{Counters, Unmatched};
use crate::axis::Link;

/// The counts of a drive that is not online, since it was seen online.
#[derive(Clone, Copy, Debug)]
pub struct Symptoms<'a> {
    /// The exchanges.
    pub counters: &'a Counters,
    /// It has answered before that.
    pub has_answered: bool,
    /// The messages that arrived at its bus so far and belong to no drive.
    pub unmatched: &'a Unmatched,
}

impl Symptoms<'_> {
    /// The count of the protocol's own counter of this index.
    pub fn own(&self, counter: usize) -> u64 {
        self.counters.own.get(counter).copied().unwrap_or(0)
    }

    /// `count` explains most of what was missed.
    pub fn mostly(&self, count: u64) -> bool {
        is_most(count, self.counters.missed)
    }

    /// It was never answered.
    pub fn never(&self) -> bool {
        self.counters.answered == 0 && !self.has_answered
    }
}

/// `count` is more than half of `all`.
pub fn is_most(count: u64, all: u64) -> bool {
    count > 0 && count > all / 2
}

/// A symptom, and what it means.
#[derive(Clone, Copy, Debug)]
pub struct Row {
    /// The symptom in the words of the manual: counters and states.
    pub symptom: &'static str,
    /// Whether it is there. Of a state that the wire itself notes this is [`NOTED`].
    pub holds: fn(&Symptoms<'_>) -> bool,
    /// The symptom.
    pub says: &'static str,
    /// The remedy.
    pub remedy: &'static str,
}

impl Row {
    /// The same, with what the wire knows in addition.
    pub fn with(&self, detail: &dyn fmt::Display) -> String {
        format!("{}: {detail}; {}", self.says, self.remedy)
    }
}

/// A row that the wire's own notes say, and no counter shows.
pub const NOTED: fn(&Symptoms<'_>) -> bool = |_| false;

/// The symptom and the remedy.
impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.says, self.remedy)
    }
}

/// Of a drive that is not online although nothing is wrong so far.
pub const NOT_YET: &str = "nothing is wrong so far: wait longer";

/// A link as it was seen so far by a reader: what is counted from then on says why it is not up.
#[derive(Clone, Debug, Default)]
pub struct Seen(Arc<Mutex<Last>>);

#[derive(Debug, Default)]
struct Last {
    /// The counters when it was online.
    online: Counters,
    /// Why it was not online, as far as that was known.
    why: Option<String>,
}

impl Seen {
    /// Why a drive is not online, or was not when it was lost. `noted`: the reason that its wire knows by name, and
    /// whether that is vague.
    pub fn diagnose(
        &self,
        rows: &[Row],
        (link, losses): (Link, u64),
        (counters, unmatched): (&Counters, &Unmatched),
        noted: Option<(String, bool)>,
    ) -> Option<String> {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let since = counters.since(&last.online);
        let has_answered = last.online.answered > 0;
        let symptoms = Symptoms { counters: &since, has_answered, unmatched };
        let found = || rows.iter().find(|row| (row.holds)(&symptoms)).map(Row::to_string);
        let why = match (link, noted) {
            (_, Some((note, false))) => Some(note),
            (Link::Online, _) => {
                let why = if losses == 0 { None } else { last.why.take().or_else(found) };
                *last = Last { online: *counters, why };
                return last.why.clone();
            }
            (_, noted) => found().or(noted.map(|(note, _)| note)),
        };
        last.why = why.clone().or(last.why.take());
        why
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_named_reason_comes_first_then_the_first_row_that_holds_and_a_vague_reason_last() {
        let rows = [
            Row { symptom: "", holds: |of| of.mostly(of.counters.late), says: "late", remedy: "wait" },
            Row { symptom: "", holds: |of| of.own(3) > 0, says: "own", remedy: "count" },
            Row { symptom: "", holds: NOTED, says: "noted", remedy: "-" },
        ];
        let seen = Seen::default();
        let said = |link, losses, [missed, late, own]: [u64; 3], noted: Option<bool>| {
            let mut counters = Counters { missed, late, ..Counters::default() };
            counters.own[3] = own;
            let noted = noted.map(|is_vague| ("note".to_owned(), is_vague));
            seen.diagnose(&rows, (link, losses), (&counters, &Unmatched::default()), noted)
        };
        for (link, losses, counts, noted, expected) in [
            (Link::Unseen, 0, [0, 0, 0], None, None),
            (Link::Qualifying, 0, [0, 0, 0], Some(true), Some("note")),
            (Link::Unseen, 0, [10, 6, 1], Some(false), Some("note")),
            (Link::Unseen, 0, [10, 6, 1], Some(true), Some("late: wait")),
            (Link::Unseen, 0, [10, 5, 1], None, Some("own: count")),
            (Link::Online, 0, [10, 5, 1], Some(true), None),
            // From here on: it was seen with these counts.
            (Link::Lost, 1, [20, 6, 2], None, Some("own: count")),
            (Link::Lost, 1, [20, 20, 2], None, Some("late: wait")),
            (Link::Online, 1, [20, 20, 2], None, Some("late: wait")),
            (Link::Lost, 2, [30, 20, 2], Some(true), Some("note")),
        ] {
            assert_eq!(said(link, losses, counts, noted).as_deref(), expected, "{link:?} {counts:?}");
        }
    }
}
