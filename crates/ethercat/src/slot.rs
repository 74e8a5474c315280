//! The acyclic slot of a frame: two datagrams at most, for one slave at a time.
//!
//! The owner of the slot writes its request into an [`Ask`]; the [`Answers`] come with the reply to that frame, or
//! empty if it was lost.

use super::wire::frame::Command;

/// Bytes of data that the datagrams of one slot have together.
pub const ROOM: usize = 256;
/// Datagrams of one slot.
pub const DATAGRAMS: usize = 2;

/// The request in a slot.
#[derive(Clone, Debug)]
pub struct Ask {
    commands: [(Command, usize); DATAGRAMS],
    count: usize,
    data: [u8; ROOM],
    filled: usize,
}

/// The answer of one datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer<'a> {
    /// How often it was carried out.
    pub working_counter: u16,
    /// The data read, or written.
    pub data: &'a [u8],
}

/// The answers of a slot, in the order of its datagrams; `None` where there was none, or the frame was lost.
pub type Answers<'a> = [Option<Answer<'a>>; DATAGRAMS];

impl Default for Ask {
    fn default() -> Ask {
        Ask { commands: [(Command::Nop, 0); DATAGRAMS], count: 0, data: [0; ROOM], filled: 0 }
    }
}

impl Ask {
    /// Removes the request.
    pub fn clear(&mut self) {
        (self.count, self.filled) = (0, 0);
    }

    /// There is no request.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Bytes that one more datagram may have; `None`: there is no room for another one.
    pub fn room(&self) -> Option<usize> {
        (self.count < DATAGRAMS).then_some(ROOM - self.filled)
    }

    /// Reads so many bytes. False, and nothing added, if they do not fit.
    pub fn read(&mut self, command: Command, length: usize) -> bool {
        if self.room().is_none_or(|room| length > room) {
            return false;
        }
        self.data[self.filled..self.filled + length].fill(0);
        self.commands[self.count] = (command, length);
        (self.count, self.filled) = (self.count + 1, self.filled + length);
        true
    }

    /// Writes these bytes. False, and nothing added, if they do not fit.
    pub fn write(&mut self, command: Command, data: &[u8]) -> bool {
        let at = self.filled;
        if !self.read(command, data.len()) {
            return false;
        }
        self.data[at..at + data.len()].copy_from_slice(data);
        true
    }

    /// The datagrams, each with the bytes that it writes.
    pub fn datagrams(&self) -> impl Iterator<Item = (Command, &[u8])> {
        self.commands[..self.count].iter().scan(0, |at, &(command, length)| {
            let begin = *at;
            *at += length;
            Some((command, &self.data[begin..*at]))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slot_has_two_datagrams_and_room_for_so_much() {
        let mut ask = Ask::default();
        assert!(ask.is_empty() && !ask.read(Command::Brd(0), ROOM + 1));
        assert!(ask.write(Command::Fpwr(1, 2), &[7; 200]) && !ask.read(Command::Nop, 57));
        assert!(ask.read(Command::Fprd(1, 4), 56));
        assert_eq!((ask.room(), ask.read(Command::Nop, 0)), (None, false));
        let datagrams: Vec<_> = ask.datagrams().map(|(command, data)| (command, data.to_vec())).collect();
        assert_eq!(datagrams, [(Command::Fpwr(1, 2), vec![7; 200]), (Command::Fprd(1, 4), vec![0; 56])]);
        ask.clear();
        assert!(ask.is_empty() && ask.read(Command::Nop, ROOM));
    }
}
