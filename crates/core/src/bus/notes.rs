//! What is wrong, by name, for normal threads: the loop writes a word without a lock and without waiting, and who reads
//! it makes it text.

use std::sync::Arc;

use crossbeam::atomic::AtomicCell;

use crate::rt::Regions;

/// In a word of its own: it is written at once.
#[derive(Clone, Copy, Debug, Default)]
#[repr(align(8))]
struct Word<N>(N);

/// The newest note on each of several drives, slaves or wires: a wire's own enumeration, eight bytes at most. Clones
/// are the same notes.
#[derive(Clone, Debug, Default)]
pub struct NoteCells<N: Copy>(Arc<[AtomicCell<Word<N>>]>);

impl<N: Copy + Default> NoteCells<N> {
    /// `count` cells, each with the default.
    pub fn new(count: usize) -> NoteCells<N> {
        const { assert!(AtomicCell::<Word<N>>::is_lock_free(), "a note does not fit a word") };
        NoteCells((0..count).map(|_| AtomicCell::default()).collect())
    }

    /// Adds what the loop writes, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.0);
    }

    /// Writes note `index`, if there is one.
    pub fn set(&self, index: usize, note: N) {
        if let Some(cell) = self.0.get(index) {
            cell.store(Word(note));
        }
    }

    /// Note `index`; the default if there is none.
    pub fn get(&self, index: usize) -> N {
        self.0.get(index).map_or(N::default(), |cell| cell.load().0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    enum Note {
        #[default]
        None,
        Near(u16),
        Far {
            small: u8,
            large: u32,
        },
    }

    #[test]
    fn each_place_has_its_own_note_and_one_that_is_not_there_none() {
        let notes = NoteCells::<Note>::new(2);
        assert_eq!(notes.get(0), Note::None);
        let far = Note::Far { small: 0xFF, large: u32::MAX };
        let reader = notes.clone();
        for (index, note) in [(0, Note::Near(7)), (1, far), (2, far), (0, Note::Near(u16::MAX))] {
            notes.set(index, note);
            assert_eq!(reader.get(index), if index < 2 { note } else { Note::None });
        }
        assert_eq!(reader.get(1), far);
    }
}
