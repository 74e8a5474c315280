//! One direction of a TCP connection: its bytes in order, from segments that come twice, too late or not at all.

use super::headers::Segment;

/// The most bytes that are kept behind a segment that is missing. Then it is taken for lost.
const MOST_HELD: usize = 64 << 10;
/// The most segments that are kept so.
const MOST_SEGMENTS: usize = 64;

/// One direction of a connection.
#[derive(Debug, Default)]
pub struct Stream {
    /// The number of the segment that has opened the connection, if it is there.
    opened: Option<u32>,
    /// The number of the next byte; `None`: whatever comes.
    next: Option<u32>,
    /// Bytes in order, of which no telegram was made.
    pub bytes: Vec<u8>,
    /// The segments behind a gap.
    held: Vec<(u32, Vec<u8>)>,
}

impl Stream {
    /// Takes a segment in. Returns whether one before it is lost: its bytes then begin behind that.
    pub fn take(&mut self, segment: Segment<'_>) -> bool {
        let mut sequence = segment.sequence;
        if segment.is_first {
            // The same may come again.
            if self.opened != Some(sequence) {
                let next = Some(sequence.wrapping_add(1));
                *self = Stream { opened: Some(sequence), next, ..Stream::default() };
            }
            sequence = sequence.wrapping_add(1);
        }
        if segment.bytes.is_empty() {
            return false;
        }
        // Too far behind to be one that comes again: another connection of the same two ends.
        let behind = self.next.map_or(0, |next| next.wrapping_sub(sequence).cast_signed());
        if behind > MOST_HELD as i32 {
            *self = Stream::default();
            self.take(segment);
            return true;
        }
        self.held.push((sequence, segment.bytes.to_vec()));
        self.next.get_or_insert(sequence);
        self.append();
        let held: usize = self.held.iter().map(|(_, bytes)| bytes.len()).sum();
        (held > MOST_HELD || self.held.len() > MOST_SEGMENTS) && self.skip()
    }

    /// Goes on behind a gap; false if there is none.
    pub fn skip(&mut self) -> bool {
        let next = self.next.unwrap_or_default();
        let Some(first) = self.held.iter().map(|(sequence, _)| sequence.wrapping_sub(next)).min() else {
            return false;
        };
        self.bytes.clear();
        self.next = Some(next.wrapping_add(first));
        self.append();
        true
    }

    /// Appends what is next of what is held, and drops what was there before.
    fn append(&mut self) {
        while let Some(next) = self.next {
            let behind = |sequence: u32| sequence.wrapping_sub(next).cast_signed();
            let Some(at) = self.held.iter().position(|(sequence, _)| behind(*sequence) <= 0) else { return };
            let (sequence, bytes) = self.held.swap_remove(at);
            let known = next.wrapping_sub(sequence) as usize;
            let new = bytes.get(known..).unwrap_or_default();
            self.bytes.extend(new);
            self.next = Some(next.wrapping_add(new.len() as u32));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn segment(sequence: u32, bytes: &[u8]) -> Segment<'_> {
        Segment { sequence, is_first: false, bytes }
    }

    #[test]
    fn bytes_are_in_order_whatever_the_order_of_their_segments() {
        let all: Vec<u8> = (0..=255).collect();
        let mut random = fastrand::Rng::with_seed(4);
        for _ in 0..200 {
            let first = random.u32(..);
            let mut pieces: Vec<(usize, usize)> = (0..256).step_by(8).map(|at| (at, at + 8)).collect();
            // Some come again, in other pieces.
            for _ in 0..8 {
                let at = random.usize(..250);
                pieces.push((at, random.usize(at + 1..256)));
            }
            random.shuffle(&mut pieces);
            let mut stream = Stream::default();
            stream.take(Segment { sequence: first.wrapping_sub(1), is_first: true, bytes: &[] });
            for (from, to) in pieces {
                assert!(!stream.take(segment(first.wrapping_add(from as u32), &all[from..to])));
            }
            assert_eq!(stream.bytes, all);
            assert!(!stream.skip());
        }
    }

    #[test]
    fn another_connection_of_the_same_ends_begins_anywhere() {
        let mut stream = Stream::default();
        let opens = |sequence| Segment { sequence, is_first: true, bytes: &[] };
        stream.take(opens(1_000_000));
        assert!(!stream.take(segment(1_000_001, &[1, 2])));
        // The segment that has opened it comes again, and so does one with bytes.
        stream.take(opens(1_000_000));
        assert!(!stream.take(segment(1_000_001, &[1, 2])) && !stream.take(segment(1_000_003, &[3])));
        assert_eq!(stream.bytes, [1, 2, 3]);
        stream.take(opens(7));
        assert!(!stream.take(segment(8, &[4])));
        assert_eq!(stream.bytes, [4]);
        // One whose opening is not in the capture.
        let mut stream = Stream::default();
        assert!(!stream.take(segment(1_000_001, &[1, 2])) && stream.take(segment(1, &[5])));
        assert_eq!(stream.bytes, [5]);
    }

    #[test]
    fn a_gap_is_reported_once_and_what_is_behind_it_is_whole() {
        let mut stream = Stream::default();
        assert!(!stream.take(segment(10, &[1, 2])));
        assert!(!stream.take(segment(20, &[5, 6])));
        assert_eq!(stream.bytes, [1, 2]);
        assert!(stream.skip() && !stream.skip());
        assert_eq!(stream.bytes, [5, 6]);
        let lost = (0..=MOST_SEGMENTS as u32).any(|place| stream.take(segment(100 + 2 * place, &[7])));
        assert!(lost);
        assert_eq!(stream.bytes, [7]);
    }
}
