//! What has happened to an axis since its last record: the commands that it has taken and begun, and its events, in
//! their order. Both are rare; each cycle only looks at a flag.

use std::collections::VecDeque;

use super::record::{CommandRecord, EventRecord};
use crate::rt::{self, Regions};

/// Room for events that are no ends of commands.
const EVENTS: usize = 32;

/// A command is taken, begins and ends, all in one cycle at most.
const NOTES_A_COMMAND: usize = 3;

/// One of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Note {
    /// A command was taken, or begins.
    Command(CommandRecord),
    /// An event.
    Event(EventRecord),
}

/// Those of one axis.
#[derive(Debug)]
pub struct Journal {
    notes: VecDeque<Note>,
    lost: u64,
}

impl Journal {
    /// Of an axis that may have so many commands under way.
    pub fn new(commands: usize, regions: &mut Regions) -> Journal {
        Journal { notes: rt::deque(NOTES_A_COMMAND * commands + EVENTS, regions), lost: 0 }
    }

    /// Takes a note. The slot of a command, and the axis of an event, are filled in when it is taken out.
    pub(super) fn note(&mut self, note: Note) {
        // Never allocates.
        if self.notes.len() == self.notes.capacity() {
            self.lost += 1;
        } else {
            self.notes.push_back(note);
        }
    }

    /// The oldest note, as one of axis `axis` in slot `index`.
    pub(super) fn take(&mut self, axis: u16, index: u64) -> Option<Note> {
        let mut note = self.notes.pop_front()?;
        match &mut note {
            Note::Command(command) => command.index = index,
            Note::Event(event) => event.axis = axis,
        }
        Some(note)
    }

    /// How many found no room since the last call.
    pub(super) fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::EventKind;

    #[test]
    fn entries_without_room_are_counted() {
        let mut journal = Journal::new(1, &mut Regions::default());
        let room = journal.notes.capacity();
        assert!(room >= NOTES_A_COMMAND + EVENTS);
        for _ in 0..room + 2 {
            journal.note(Note::Event(EventRecord::new(7, 0, EventKind::Restarted, None)));
        }
        assert_eq!((journal.notes.capacity(), journal.take_lost(), journal.take_lost()), (room, 2, 0));
        let first = journal.take(5, 8);
        assert_eq!(first, Some(Note::Event(EventRecord::new(7, 5, EventKind::Restarted, None))));
    }
}
