//! Transfers of objects that are longer than four bytes: normal, in segments, and of all subindices at once
//! (ETG.1000.6, 5.6.2).
//!
//! Knows no object. One transfer at a time: a new one, or an abort, ends it.

use fieldbeat_ethercat::wire::mailbox::SDO_SIZE;
use fieldbeat_ethercat::wire::sdo::{AbortCode, Object};

/// Where the data of a normal transfer begins, and that of a segment.
const NORMAL: usize = SDO_SIZE;
const SEGMENT: usize = 9;
/// The most that a master may announce.
const LONGEST: usize = 4_096;
const TOGGLE: u8 = 0x10;
const LAST: u8 = 0x01;
/// The data of a segment that is not full.
const SEGMENT_LEAST: usize = 7;

/// The content of an answer after the CoE header.
pub(super) type Body = Vec<u8>;

/// The effect of a message of the master.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// This is sent to the master, and nothing is done yet.
    Answer(Body),
    /// All of an object has come: it is to be written; this is the answer.
    Write { object: Object, complete: bool, data: Vec<u8>, answer: Option<Body> },
    /// An object is to be read.
    Read { object: Object, complete: bool },
    /// There is nothing to do.
    Nothing,
}

#[derive(Debug)]
struct Upload {
    rest: Vec<u8>,
    toggle: bool,
}

#[derive(Debug)]
struct Download {
    object: Object,
    complete: bool,
    size: usize,
    data: Vec<u8>,
    toggle: bool,
}

/// The transfer that is under way.
#[derive(Debug)]
pub(super) struct Transfers {
    /// Bytes of the mailbox that the master reads.
    room: usize,
    upload: Option<Upload>,
    download: Option<Download>,
}

impl Transfers {
    pub(super) fn new(room: usize) -> Transfers {
        Transfers { room: room.max(SDO_SIZE), upload: None, download: None }
    }

    /// There is no transfer any more.
    pub(super) fn end(&mut self) {
        (self.upload, self.download) = (None, None);
    }

    /// The answer to a read of more than four bytes: as much as fits.
    pub(super) fn begin_upload(&mut self, object: Object, complete: bool, mut data: Vec<u8>) -> Body {
        let mut body = head(if complete { 0x51 } else { 0x41 }, object, (data.len() as u32).to_le_bytes());
        let rest = data.split_off(data.len().min(self.room - NORMAL));
        body.extend(data);
        self.upload = (!rest.is_empty()).then_some(Upload { rest, toggle: false });
        body
    }

    /// The next piece is requested.
    pub(super) fn upload_segment(&mut self, command: u8) -> Result<Body, AbortCode> {
        let upload = self.upload.as_mut().ok_or(AbortCode::COMMAND)?;
        let toggle = command & TOGGLE != 0;
        if toggle != upload.toggle {
            self.upload = None;
            return Err(AbortCode::TOGGLE);
        }
        let piece: Vec<u8> = upload.rest.drain(..upload.rest.len().min(self.room - SEGMENT)).collect();
        upload.toggle = !toggle;
        let is_last = upload.rest.is_empty();
        if is_last {
            self.upload = None;
        }
        let unused = SEGMENT_LEAST.saturating_sub(piece.len()) as u8;
        let mut body = vec![command & TOGGLE | unused << 1 | if is_last { LAST } else { 0 }];
        body.extend(piece);
        Ok(body)
    }

    /// A write of `size` bytes begins with these.
    pub(super) fn begin_download(
        &mut self,
        object: Object,
        complete: bool,
        size: u32,
        data: &[u8],
    ) -> Result<Step, AbortCode> {
        let size = usize::try_from(size).ok().filter(|size| *size <= LONGEST).ok_or(AbortCode::LENGTH)?;
        if data.len() > size {
            return Err(AbortCode::LENGTH);
        }
        let answer = head(0x60, object, [0; 4]);
        let data = data.to_vec();
        if data.len() == size {
            return Ok(Step::Write { object, complete, data, answer: Some(answer) });
        }
        self.download = Some(Download { object, complete, size, data, toggle: false });
        Ok(Step::Answer(answer))
    }

    /// A piece has come: `bytes` follow its command.
    pub(super) fn download_segment(&mut self, command: u8, bytes: &[u8]) -> Result<Step, AbortCode> {
        let mut download = self.download.take().ok_or(AbortCode::COMMAND)?;
        if (command & TOGGLE != 0) != download.toggle {
            return Err(AbortCode::TOGGLE);
        }
        let unused = if bytes.len() == SEGMENT_LEAST { usize::from(command >> 1 & 7) } else { 0 };
        download.data.extend(&bytes[..bytes.len() - unused.min(bytes.len())]);
        download.toggle = !download.toggle;
        let answer = vec![0x20 | command & TOGGLE];
        let is_last = command & LAST != 0;
        if download.data.len() > download.size || is_last && download.data.len() < download.size {
            return Err(AbortCode::LENGTH);
        }
        if is_last {
            let Download { object, complete, data, .. } = download;
            return Ok(Step::Write { object, complete, data, answer: Some(answer) });
        }
        self.download = Some(download);
        Ok(Step::Answer(answer))
    }
}

/// A message of eight bytes.
pub(super) fn head(command: u8, object: Object, [a, b, c, d]: [u8; 4]) -> Body {
    let [low, high] = object.index.to_le_bytes();
    vec![command, low, high, object.sub, a, b, c, d]
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAME: Object = Object::new(0x1008, 0);

    /// A text of 40 bytes as a master reads it, and the number of segments.
    fn uploaded(room: usize) -> (Vec<u8>, usize) {
        let mut transfers = Transfers::new(room);
        let text: Vec<u8> = (0..40).collect();
        let first = transfers.begin_upload(NAME, false, text);
        assert_eq!(first[..8], [0x41, 0x08, 0x10, 0, 40, 0, 0, 0]);
        let (mut got, mut count) = (first[8..].to_vec(), 0);
        while got.len() < 40 {
            let body = transfers.upload_segment(0x60 | if count % 2 == 1 { TOGGLE } else { 0 }).unwrap();
            let used = (body.len() - 1).min(if body.len() <= 8 {
                7 - usize::from(body[0] >> 1 & 7)
            } else {
                usize::MAX
            });
            got.extend(&body[1..1 + used]);
            count += 1;
            assert_eq!(body[0] & LAST != 0, got.len() == 40);
        }
        assert_eq!(transfers.upload_segment(0x60), Err(AbortCode::COMMAND), "it has ended");
        (got, count)
    }

    #[test]
    fn a_long_text_comes_at_once_or_in_segments_as_it_fits() {
        let text: Vec<u8> = (0..40).collect();
        assert_eq!(uploaded(1_024), (text.clone(), 0));
        assert_eq!(uploaded(56), (text.clone(), 0));
        assert_eq!(uploaded(55), (text.clone(), 1));
        assert_eq!(uploaded(32), (text.clone(), 2));
        assert_eq!(uploaded(16), (text, 6));
    }

    #[test]
    fn a_toggle_that_does_not_change_ends_the_transfer() {
        let mut transfers = Transfers::new(16);
        transfers.begin_upload(NAME, true, vec![1; 20]);
        assert!(transfers.upload_segment(0x60).is_ok());
        assert_eq!(transfers.upload_segment(0x60), Err(AbortCode::TOGGLE));
        assert_eq!(transfers.upload_segment(0x70), Err(AbortCode::COMMAND));
        transfers.begin_download(NAME, false, 9, &[]).unwrap();
        assert_eq!(transfers.download_segment(TOGGLE, &[1; 7]), Err(AbortCode::TOGGLE));
        assert_eq!(transfers.download_segment(0, &[1; 7]), Err(AbortCode::COMMAND));
        transfers.begin_upload(NAME, false, vec![1; 20]);
        transfers.end();
        assert_eq!(transfers.upload_segment(0x60), Err(AbortCode::COMMAND));
    }

    #[test]
    fn a_long_value_is_written_once_all_of_it_has_come() {
        let mut transfers = Transfers::new(16);
        let begun = transfers.begin_download(NAME, true, 10, &[]).unwrap();
        assert_eq!(begun, Step::Answer(vec![0x60, 0x08, 0x10, 0, 0, 0, 0, 0]));
        assert_eq!(transfers.download_segment(0, &[1; 7]), Ok(Step::Answer(vec![0x20])));
        let last = transfers.download_segment(TOGGLE | 4 << 1 | LAST, &[2; 7]).unwrap();
        let data = vec![1, 1, 1, 1, 1, 1, 1, 2, 2, 2];
        assert_eq!(last, Step::Write { object: NAME, complete: true, data, answer: Some(vec![0x30]) });
        let whole = transfers.begin_download(NAME, false, 5, &[5; 5]).unwrap();
        assert!(matches!(whole, Step::Write { complete: false, .. }));
        // More than announced, less than announced, more than there can be.
        assert_eq!(transfers.begin_download(NAME, false, 5, &[5; 6]), Err(AbortCode::LENGTH));
        assert_eq!(transfers.begin_download(NAME, false, u32::MAX, &[]), Err(AbortCode::LENGTH));
        for (command, bytes) in [(0, &[1; 12][..]), (LAST, &[1; 7])] {
            transfers.begin_download(NAME, false, 10, &[]).unwrap();
            assert_eq!(transfers.download_segment(command, bytes), Err(AbortCode::LENGTH));
        }
    }
}
